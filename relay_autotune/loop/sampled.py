# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The sampled controller: at a sampling period, within the limits of its actuator.

The filter is exact for a measurement that is linear between samples. So its lag is the same at
every sampling period, and without a filter the derivative is the difference quotient. The integral
is advanced by the backward rule, with Astrom and Hagglund's back-calculation against windup. At a
limit, its change in one sample is bounded by the range of the limits, so that one outlier hardly
moves it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller

Motion = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Limits:
    """Range of the command.

    :param low: least command [u].
    :param high: largest command [u].
    """

    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise TuningError(
                f"the command's limits leave no range, found {self.low:g} to {self.high:g}"
            )

    def clip(self, command: float) -> float:
        """Return the command within the limits [u]."""
        return min(max(command, self.low), self.high)


UNLIMITED = Limits()


def require_period(period: float) -> None:
    """Refuse an invalid sampling period.

    :param period: s.
    :raises TuningError: if it is not positive and finite.
    """
    if not 0.0 < period < math.inf:
        raise TuningError(f"the sampling period must be > 0 s and finite, found {period:g} s")


def filter_elements(tf: Any, period: float, of: ModuleType = math) -> tuple[Any, ...]:
    """Return the elements of :func:`filter_matrices`: those of F by rows, of g0, of g1.

    :param tf: time constants of the filter, positive [s]; a number, or any shape with numpy.
    :param period: s.
    :param of: where the functions are, ``math`` or ``numpy``.
    """
    # The poles lie at (-1 +- j)/tf, and a is the period in time constants. The closed form is
    # faster than a matrix exponential with BLAS, whose threads need time to synchronise.
    a = period / tf
    decay, cosine, sine = of.exp(-a), of.cos(a), of.sin(a)
    late, away = of.expm1(-a), 2.0 * of.sin(0.5 * a) ** 2
    turn = (cosine + sine, tf * sine, -2.0 / tf * sine, cosine - sine)
    step = (away - sine - late * (cosine + sine), 2.0 / tf * decay * sine)
    # Response to a measurement that rises from 0 to 1 within the period.
    ramp = (1.0 + (late * cosine - away) / a, step[0] / period)
    return (*(decay * t for t in turn), step[0] - ramp[0], step[1] - ramp[1], *ramp)


def without_filter(period: float) -> tuple[float, ...]:
    """Return what :func:`filter_elements` gives as tf goes to 0.

    :param period: s.
    """
    return (0.0, 0.0, 0.0, 0.0, 0.0, -1.0 / period, 1.0, 1.0 / period)


def has_filter(tf: Any, period: float) -> Any:
    """Return whether a time constant is long enough to be a filter at a period.

    :param tf: s, any shape.
    :param period: s.
    """
    return tf > 1e-6 * period


def filter_matrices(tf: float, period: float) -> Motion:
    """Return the matrices that advance ``(yf, dyf/dt)`` by one period.

    ``x = F x + g0 y + g1 y_next`` with ``yf + tf yf' + tf^2/2 yf'' = y``.

    :param tf: time constant of the filter [s]; 0: none.
    :param period: s.
    :return: F of shape (2, 2), g0 and g1 of shape (2,).
    """
    used = has_filter(tf, period)
    found = np.array(filter_elements(tf, period) if used else without_filter(period))
    return found[:4].reshape(2, 2), found[4:6], found[6:]


class PidLaw:
    """The control law of one sample: filter, integral, and back-calculation at the limits.

    The gains are given with each sample, so that they may change at any sample.

    :param measurement: initial value of the filter [y].
    :param integral: initial value of the integral [u].
    """

    def __init__(self, measurement: float, integral: float) -> None:
        self.integral = integral
        """The integral [u]."""
        self._filter = np.array([measurement, 0.0])
        self._last = measurement

    def hear(self, motion: Motion, measurement: float) -> None:
        """Take a measurement, which is linear since the one before.

        :param motion: matrices of the filter for the interval, see :func:`filter_matrices`.
        :param measurement: y.
        """
        turn, past, present = motion
        self._filter = turn @ self._filter + past * self._last + present * measurement
        self._last = measurement

    def replace_last(self, measurement: float) -> None:
        """Replace the last measurement by another one at the same instant [y]."""
        self._last = measurement

    def proportional(self, c: Controller, setpoint: float) -> float:
        """Return the command without the integral [u].

        :param c: the gains.
        :param setpoint: y.
        """
        value, slope = self._filter
        return float(c.kc * (c.b * setpoint - value - c.td * slope))

    def command(self, c: Controller, setpoint: float, interval: float, limits: Limits) -> float:
        """Advance the integral and return the command within the limits [u].

        :param c: the gains.
        :param setpoint: y.
        :param interval: time since the sample before [s].
        :param limits: range of the command.
        """
        before = self.integral
        self.integral += float(c.i * interval * (setpoint - self._filter[0]))
        part = self.proportional(c, setpoint)
        wanted = part + self.integral
        given = limits.clip(wanted)
        if given != wanted and c.tracking > 0.0:
            pull = min(1.0, interval / c.tracking)
            drawn = self.integral + pull * (given - wanted)
            # One sample moves the integral by at most `pull` times the range of the limits,
            room = pull * (limits.high - limits.low)
            drawn = min(max(drawn, before - room), before + room)
            # and it gives no command beyond the limits, neither now nor at the set-point.
            rest = c.kc * (c.b - 1.0) * setpoint
            low, high = limits.low - max(rest, part), limits.high - min(rest, part)
            self.integral = min(max(drawn, low), high)
        return given


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Deviations from the operating point in a closed loop.

    :param time: s, shape (n,).
    :param measurement: y, shape (n,), without the noise.
    :param command: u, shape (n,), held from each sample to the next.
    """

    time: FloatArray
    measurement: FloatArray
    command: FloatArray
