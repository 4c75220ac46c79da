"""A FOPDT by its closed form, many times as fast as the general way."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from relay_autotune.identification.waveform.factors import Denominator, Lag
from relay_autotune.identification.waveform.structures import RationalStructure
from relay_autotune.record.record import Input, PiecewiseLinear

FloatArray = NDArray[np.float64]


class Fopdt(RationalStructure):
    """``K exp(-D s)/(tau s + 1)``, theta = (log tau, D)."""

    def columns(
        self, theta: FloatArray, time: FloatArray, u: Input
    ) -> tuple[FloatArray, FloatArray]:
        """Return the unit-gain response and its derivatives.

        Between two delayed changes the lag moves from s_k towards the level U_k,

            r = U_k + (s_k - U_k) exp(-delta/tau),   dr/dD = -(U_k - r)/tau,

        and dr/dtau follows the same recursion from change to change.

        :param theta: (log tau, D).
        :param time: sample times [s], shape (n,).
        :param u: the input; its deviation from ``u.initial`` acts.
        :return: shapes (1, n) and (2, 1, n).
        """
        if isinstance(u, PiecewiseLinear):
            return super().columns(theta, time, u)
        tau, dead_time = math.exp(float(theta[0])), float(theta[1])
        levels = (u.values - u.initial).tolist()
        gaps = np.diff(u.times) / tau
        decay = np.exp(-gaps).tolist()
        state, slope = [0.0], [0.0]
        s = q = 0.0
        for level, gap, a in zip(levels, gaps.tolist(), decay, strict=False):
            away = s - level
            q = a * (q + away * gap)
            s = level + away * a
            state.append(s)
            slope.append(q)
        delayed = time - dead_time
        segment = u.times.searchsorted(delayed, side="right") - 1
        k = np.maximum(segment, 0)
        delta = (delayed - u.times[k]) / tau
        e = np.exp(-np.maximum(delta, 0.0))
        level_at = np.array(levels)[k]
        part = (np.array(state)[k] - level_at) * e
        values = np.stack((level_at + part, np.array(slope)[k] * e + part * delta, part / tau))
        values[:, segment < 0] = 0.0
        return values[:1], values[1:, None, :]


FOPDT = Fopdt("fopdt", Denominator((Lag(),)))
