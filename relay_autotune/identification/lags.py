"""Responses of lags to the recorded input, with derivatives, as the waveform fit needs them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from relay_autotune.models import TransferFunction
from relay_autotune.record import PiecewiseConstant

FloatArray = NDArray[np.float64]


# Dead times tried at the start, as shares of the longest one.
_SHARES = (0.0, 0.01, 0.03, 0.06, 0.1, 0.15, 0.2, 0.27, 0.35, 0.45, 0.55, 0.67, 0.8, 0.95)


class Fopdt:
    """``K exp(-D s)/(tau s + 1)``: K is linear, tau and D are not."""

    structure = "fopdt"
    parameters = ("gain", "time_constant", "dead_time")

    @staticmethod
    def columns(
        theta: FloatArray, time: FloatArray, u: PiecewiseConstant
    ) -> tuple[FloatArray, FloatArray]:
        """Return the unit-gain response and its derivatives.

        Between two delayed changes the lag moves from s_k towards the level U_k,

            r = U_k + (s_k - U_k) exp(-delta/tau),   dr/dD = -(U_k - r)/tau,

        and dr/dtau follows the same recursion from change to change.

        :param theta: (tau, D) [s].
        :param time: sample times [s], shape (n,).
        :param u: the input; its deviation from ``u.initial`` acts.
        :return: columns of the linear parameters, shape (1, n), and their derivatives, shape
            (2, 1, n).
        """
        tau, dead_time = float(theta[0]), float(theta[1])
        levels = (u.values - u.initial).tolist()
        gaps = np.diff(u.times)
        decay = np.exp(-gaps / tau).tolist()
        state = [0.0]
        slope = [0.0]
        s = q = 0.0
        for level, gap, a in zip(levels, gaps.tolist(), decay, strict=False):
            away = s - level
            q = a * (q + away * gap / (tau * tau))
            s = level + away * a
            state.append(s)
            slope.append(q)
        segment = np.searchsorted(u.times, time - dead_time, side="right") - 1
        moved = segment >= 0
        k = np.maximum(segment, 0)
        level_at = np.array(levels)[k]
        delta = np.where(moved, time - dead_time - u.times[k], 0.0)
        e = np.exp(-delta / tau)
        away_at = np.array(state)[k] - level_at
        part = away_at * e
        r = np.where(moved, level_at + part, 0.0)
        by_tau = np.where(moved, np.array(slope)[k] * e + part * delta / (tau * tau), 0.0)
        by_dead_time = np.where(moved, part / tau, 0.0)
        return r[None, :], np.stack((by_tau, by_dead_time))[:, None, :]

    @staticmethod
    def relaxation(theta: FloatArray, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how a free initial state dies away, and its derivatives.

        :param theta: (tau, D) [s].
        :param time: sample times [s], shape (n,).
        :return: shapes (1, n) and (2, 1, n).
        """
        tau = float(theta[0])
        since = time - time[0]
        e = np.exp(-since / tau)
        by_tau = e * since / (tau * tau)
        return e[None, :], np.stack((by_tau, np.zeros_like(e)))[:, None, :]

    @staticmethod
    def starts(shortest: float, longest: float) -> tuple[FloatArray, FloatArray]:
        """Return a coarse grid: shapes, here (tau,), and dead times to try with each of them.

        :param shortest: smallest time that the samples resolve [s].
        :param longest: longest stretch in which the dead time must lie [s].
        :return: shapes, shape (s, m - 1), and dead times [s], shape (d,).
        """
        taus = np.geomspace(0.5 * shortest, 30.0 * longest, 14)
        return taus[:, None], longest * np.array(_SHARES)

    @staticmethod
    def scale(theta: FloatArray) -> FloatArray:
        """Return the size of a unit step in each direction: a relative one for tau [s]."""
        return np.array((theta[0], theta[0] + theta[1]))

    @staticmethod
    def move(theta: FloatArray, step: FloatArray) -> FloatArray:
        """Return theta after a step in units of :meth:`scale`, within its bounds."""
        tau = theta[0] * math.exp(min(max(float(step[0]), -1.0), 1.0))
        dead_time = theta[1] + (theta[0] + theta[1]) * min(max(float(step[1]), -0.3), 0.3)
        return np.array((tau, max(dead_time, 0.0)))

    @staticmethod
    def model(values: FloatArray) -> TransferFunction:
        """Return the transfer function of (K, tau, D)."""
        return TransferFunction.fopdt(float(values[0]), float(values[1]), float(values[2]))
