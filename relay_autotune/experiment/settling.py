# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Judge whether the measurement is at rest, how noisy it is, and whether it leaves its rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray

# Samples needed for a constant, and for a noise band: 50 give a standard deviation to 10 %, since
# its relative standard error is 1/sqrt(2 n).
CONSTANT_SAMPLES = 20
NOISE_SAMPLES = 50

# Without noise, a transient is over when no more than this part of it is left.
_REMAINDER = 0.01

# Latest end of the settling that is told, as a multiple of the time so far.
_FURTHEST = 20.0

# Rounding of a constant: differences below this many units in the last place are no signal.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)

# A measurement has left its rest when this many samples in a row are further away on one side than
# so many standard deviations, and so many times its resolution.
_OUTSIDE_SAMPLES = 5
_OUTSIDE_STD = 5.0
_OUTSIDE_STEPS = 5.0
# The earlier half of the samples before is not rest if without it this many times less is left
# about the line.
_MOVED = 3.0
# Relative to the measurement: what rounding in a sensor or a simulation may add up to.
_UNSEEN = 1e-9

NO_REST_AT = "the measurement rested at"
"""How the reason begins if the process does not rest at the baseline."""


@dataclass(frozen=True)
class RestState:
    """The measurement while the command was at the baseline.

    :param mean: mean measurement over the window [y].
    :param slope: slope of the straight line through the window [y/s].
    :param noise_std: standard deviation about that line [y]; 0 for a constant.
    :param span: duration of the window [s].
    :param samples: number of samples in the window.
    :param range_seen: largest minus smallest measurement since the start of the settling [y].
    """

    mean: float
    slope: float
    noise_std: float
    span: float
    samples: int
    range_seen: float

    def __str__(self) -> str:
        return (
            f"its slope {self.slope:.3g} y/s over {self.span:.3g} s against a noise standard "
            f"deviation of {self.noise_std:.3g} y"
        )

    @property
    def drift(self) -> float:
        """How far the straight line moves over the window [y]."""
        return abs(self.slope) * self.span

    @property
    def is_steady(self) -> bool:
        """True if the drift over the window does not matter.

        One of these must hold: it is within three standard errors of the line's slope under noise
        alone; within one standard deviation of the noise (a third of the hysteresis); or within
        1 % of the whole range since the settling began (the end of a transient without noise).
        """
        return self.span > 0.0 and self.drift <= self.tolerable

    @property
    def tolerable(self) -> float:
        """The largest drift over the window that does not matter [y]."""
        by_chance = 3.0 * self.noise_std * math.sqrt(12.0 / self.samples)
        return max(by_chance, self.noise_std, _REMAINDER * self.range_seen)


NOT_SETTLED = RestState(math.nan, math.nan, math.nan, 0.0, 0, 0.0)
"""Placeholder before the state of rest is known."""


def rest_state(time: FloatArray, measurement: FloatArray, window: int) -> RestState:
    """Fit a straight line to the last samples.

    :param time: instants of the samples since the settling began [s], shape (n,).
    :param measurement: the samples [y], shape (n,), n >= 1.
    :param window: number of samples at the end to which the line is fitted, from 1 to n.
    """
    t, y = time[-window:], measurement[-window:]
    range_seen = float(np.max(measurement) - np.min(measurement))
    span = float(t[-1] - t[0])
    rounding = _ROUNDING * float(np.max(np.abs(y)))
    if float(np.max(y) - np.min(y)) <= rounding:
        # The rounded mean of equal numbers may differ from them in the last digit, and the
        # set-point must lie exactly on a constant measurement.
        return RestState(float(y[-1]), 0.0, 0.0, span, window, range_seen)
    mean = float(np.mean(y))
    if span <= 0.0 or window < 3:
        return RestState(mean, 0.0, float(np.std(y)), span, window, range_seen)
    # Scaled to the window, so that the squares neither overflow nor vanish.
    x = (t - t[0]) / span
    x = x - np.mean(x)
    rise = float(np.sum(x * (y - mean)) / np.sum(x * x))
    residual = y - mean - rise * x
    noise = math.sqrt(float(np.sum(residual * residual)) / (window - 2))
    if noise <= rounding:
        noise = 0.0
    return RestState(mean, rise / span, noise, span, window, range_seen)


class RestWatch:
    """See that the measurement leaves the rest that it showed before the first command.

    A straight line through the n samples before gives the mean, the slope and the noise. At a
    distance of x samples from their middle, the process at rest may be as far from the mean as::

        |slope| x + 5 noise sqrt(1 + 1/m + 12 x^2 / (m n^2)) + resolution (5 + x/n)

    which is a drift that was there before, either way, the error of the line, and the steps of the
    sensor. m is the number of independent samples among the n: fewer than n if the noise is slow.
    The resolution is the smallest step between two samples that differ. Time is counted in
    samples, since those before may have come by another clock. Where the earlier half of the n
    scatters far more, only the later half counts.

    :param before: measurements before the first command, the newest last [y]; where they are fewer
        than 20, the first samples of the experiment complete them.
    """

    def __init__(self, before: Sequence[float]) -> None:
        self._before = [float(value) for value in before]
        self._last = self._before[-1] if self._before else math.nan
        steps = (abs(b - a) for a, b in zip(self._before, self._before[1:], strict=False))
        self._resolution = min((step for step in steps if step > 0.0), default=math.inf)
        self._rest = NOT_SETTLED
        self._independent = math.nan
        self._since = 0
        self._outside = 0

    def leaves(self, measurement: float) -> str:
        """Take a sample [y]; return where the measurement rested and is, empty while it rests."""
        step = abs(measurement - self._last)
        if step > 0.0:
            self._resolution = min(self._resolution, step)
        self._last = measurement
        if len(self._before) < CONSTANT_SAMPLES:
            self._before.append(measurement)
            return ""
        if not self._rest.samples:
            self._learn()
        self._since += 1
        rest, n = self._rest, self._rest.samples
        away = measurement - rest.mean
        if abs(away) <= self._allowed(0.5 * (n - 1) + self._since):
            self._outside = 0
            return ""
        side = 1 if away > 0.0 else -1
        self._outside = side * (max(side * self._outside, 0) + 1)
        if abs(self._outside) < _OUTSIDE_SAMPLES:
            return ""
        return f"{NO_REST_AT} {rest.mean:.6g} y and is at {measurement:.6g} y"

    def moved_to(self, mean: float) -> str:
        """Return how far the measurement has gone in the settling, empty where it is no distance.

        A drift that the samples before cannot exclude is no reason to end the tune, but to tell.

        :param mean: measurement at the end of the settling [y].
        """
        rest = self._rest
        steps = self._resolution if math.isfinite(self._resolution) else 0.0
        least = max(_OUTSIDE_STD * rest.noise_std, _OUTSIDE_STEPS * steps, _UNSEEN * abs(mean))
        if not rest.samples or abs(mean - rest.mean) <= least:
            return ""
        return f"{NO_REST_AT} {rest.mean:.6g} y before the first command, and at {mean:.6g} y"

    def _learn(self) -> None:
        y = np.array(self._before)
        self._rest = rest = _about_line(y)
        while len(y) >= 2 * CONSTANT_SAMPLES:
            later = _about_line(y[len(y) // 2 :])
            if _MOVED * later.noise_std >= rest.noise_std:
                break
            # It came to rest only lately.
            y, self._rest, rest = y[len(y) // 2 :], later, later
        n = len(y)
        at = np.arange(n, dtype=np.float64)
        residual = y - rest.mean - rest.slope * (at - 0.5 * (n - 1))
        squares = float(np.sum(residual * residual))
        alike = float(np.sum(residual[1:] * residual[:-1])) / squares if squares > 0.0 else 0.0
        alike = max(alike, 0.0)
        self._independent = max(n * (1.0 - alike) / (1.0 + alike), 2.0)

    def _allowed(self, x: float) -> float:
        rest, m = self._rest, self._independent
        n = rest.samples
        line = math.sqrt(1.0 + 1.0 / m + 12.0 * x * x / (m * n * n))
        steps = self._resolution if math.isfinite(self._resolution) else 0.0
        steps = max(steps, _UNSEEN * abs(rest.mean))
        return (
            abs(rest.slope) * x
            + _OUTSIDE_STD * rest.noise_std * line
            + steps * (_OUTSIDE_STEPS + x / n)
        )


def _about_line(measurement: FloatArray) -> RestState:
    return rest_state(np.arange(len(measurement), dtype=np.float64), measurement, len(measurement))


class Settling:
    """Decide when to test the measurement for rest, so that all tests together cost little.

    The window is the later half of all samples, or the last :data:`NOISE_SAMPLES` if these are
    more, so that a transient at the start leaves it. The next test comes when there are a quarter
    more samples than at the last one.
    """

    def __init__(self) -> None:
        self.rest = NOT_SETTLED
        """What the last look has found."""
        self._next_look = CONSTANT_SAMPLES
        # End of the last window [s], and the time in which the slope fell by the factor e [s].
        self._at = self._fades_in = math.nan

    def is_due(self, samples: int) -> bool:
        """Return True if it is time for a test.

        :param samples: number of samples since the settling began.
        """
        return samples >= self._next_look

    def look(self, time: FloatArray, measurement: FloatArray) -> tuple[RestState, bool]:
        """Return the state of rest, and True if it is steady and the noise band is known.

        :param time: instants of all samples since the settling began [s], shape (n,).
        :param measurement: the samples [y], shape (n,).
        """
        samples = len(time)
        self._next_look = _look_after(samples)
        window = min(samples, max(NOISE_SAMPLES, (samples + 1) // 2))
        rest = rest_state(time, measurement, window)
        self._compare(float(time[-1]), rest)
        known = rest.noise_std == 0.0 or samples >= NOISE_SAMPLES
        return rest, known and rest.is_steady

    def _compare(self, at: float, rest: RestState) -> None:
        """Keep how fast the slope has become smaller between the middles of two windows."""
        ratio = self.rest.slope / rest.slope if rest.slope else math.nan
        between = (at - 0.5 * rest.span) - (self._at - 0.5 * self.rest.span)
        self._fades_in = between / math.log(ratio) if ratio > 1.0 else math.nan
        self.rest, self._at = rest, at

    def expected_end(self, interval: float) -> float:
        """Return when the measurement will be steady, if its slope fades as it did [s].

        :param interval: mean interval of the samples [s].
        :returns: the time since the settling began; NaN: it cannot be told.
        """
        samples, rest = self._next_look, self.rest
        while samples < NOISE_SAMPLES:
            samples = _look_after(samples)
        if not rest.samples or rest.is_steady:
            return samples * interval
        if not (self._fades_in > 0.0 and interval > 0.0):
            return math.nan
        middle = self._at - 0.5 * rest.span
        while (at := samples * interval) < _FURTHEST * self._at:
            # By then the window is the later half of all samples.
            fades = math.exp(-(0.75 * at - middle) / self._fades_in)
            if abs(rest.slope) * fades * 0.5 * at <= rest.tolerable:
                return at
            samples = _look_after(samples)
        return math.nan


def _look_after(samples: int) -> int:
    """Return the number of samples at the look after one at ``samples``."""
    return samples + max(1, samples // 4)
