# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The measurement before the relay switches: rest, noise, and response to the first step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray

# Samples needed for a constant, and for a noise band: 50 give a standard deviation to 10 %, since
# its relative standard error is 1/sqrt(2 n).
CONSTANT_SAMPLES = 20
NOISE_SAMPLES = 50

# Without noise, a transient is over when no more than this part of it is left.
_REMAINDER = 0.01

# Latest end of the settling that is predicted, as a multiple of the time so far.
_FURTHEST = 20.0

# Samples in each mean that shows a slow movement.
_BLOCK = 5
# Standard deviations of white noise that such means may differ by: the range of ten exceeds
# it once in 200,000 times.
_MOVED_BY = 4.0

# Rounding of a constant: differences below this many units in the last place are no signal.
_ROUNDING = 8.0 * float(np.finfo(np.float64).eps)

# A measurement has left its rest when this many samples in a row are further away on one side than
# this many standard deviations and this many times its resolution.
_OUTSIDE_SAMPLES = 5
_OUTSIDE_STD = 5.0
_OUTSIDE_STEPS = 5.0
# The earlier half of the samples before is not rest if without it this many times less is left
# about the line.
_MOVED = 3.0
# Relative to the measurement: what rounding in a sensor or a simulation may add up to.
_UNSEEN = 1e-9


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
    def motion(self) -> str:
        """How the measurement moves, in words, such as "falling 0.2 y/s"."""
        return f"{'rising' if self.slope > 0.0 else 'falling'} {abs(self.slope):.2g} y/s"

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


def slow_movement(measurement: FloatArray) -> tuple[float, float]:
    """Return how far samples move slowly, and how far noise alone may seem to move them [y, y].

    The movement is the range of the means of five samples each, whatever its course: a transient
    that dies out, or that returns, has a small slope in the end. The noise is that of the second
    differences, which a slow movement does not enlarge as it does the scatter about a line.

    :param measurement: samples at equal intervals, the newest last [y], shape (n,), n >= 10.
    """
    blocks = measurement[len(measurement) % _BLOCK :].reshape(-1, _BLOCK).mean(axis=1)
    # White noise of variance 1 has second differences of variance 1 + 4 + 1.
    noise = math.sqrt(float(np.mean(np.diff(measurement, 2) ** 2)) / 6.0)
    return float(np.ptp(blocks)), _MOVED_BY * noise


def resolution(measurement: FloatArray) -> float:
    """Return the smallest difference between two samples that follow each other, 0: none [y].

    :param measurement: the samples [y], shape (n,).
    """
    steps = abs(measurement[1:] - measurement[:-1])
    steps = steps[steps > 0.0]
    return float(steps.min()) if steps.size else 0.0


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
        self._resolution = resolution(np.array(self._before))
        self._rest = NOT_SETTLED
        self._independent = math.nan
        self._since = 0
        self._outside = 0

    @property
    def rested_at(self) -> float:
        """Mean of the measurements before [y]; NaN while they are too few."""
        return self._rest.mean

    def leaves(self, measurement: float) -> bool:
        """Take a sample [y]; return True if the measurement has left its rest."""
        step = abs(measurement - self._last)
        if step > 0.0:
            self._resolution = min(self._resolution or step, step)
        self._last = measurement
        if len(self._before) < CONSTANT_SAMPLES:
            self._before.append(measurement)
            return False
        if not self._rest.samples:
            self._learn()
        self._since += 1
        rest, n = self._rest, self._rest.samples
        away = measurement - rest.mean
        if abs(away) <= self._allowed(0.5 * (n - 1) + self._since):
            self._outside = 0
            return False
        side = 1 if away > 0.0 else -1
        self._outside = side * (max(side * self._outside, 0) + 1)
        return abs(self._outside) >= _OUTSIDE_SAMPLES

    def has_moved_to(self, mean: float) -> bool:
        """Return True if the measurement has gone a distance in the settling.

        A drift that the samples before cannot exclude is no reason to end the tune, but to tell.

        :param mean: measurement at the end of the settling [y].
        """
        rest = self._rest
        steps = _OUTSIDE_STEPS * self._resolution
        least = max(_OUTSIDE_STD * rest.noise_std, steps, _UNSEEN * abs(mean))
        return bool(rest.samples) and abs(mean - rest.mean) > least

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
        steps = max(self._resolution, _UNSEEN * abs(rest.mean))
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
        :returns: the time since the settling began; NaN: it cannot be predicted.
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


# White noise exceeds three standard deviations on one side three times in a row once in 4e8
# samples; without noise one sample is enough.
_BAND = 3.0
_RUN = 3

# First look and last look of the watch, in intervals; the last one also after a least number of
# samples. Without noise and dead time the response is seen at the first sample, and then the
# interval says nothing about the speed of the process.
_FIRST_LOOK = 5
LAST_LOOK = 50
LAST_LOOK_SAMPLES = 200

# Parts of the largest deviation: a smaller change counts as level; a smaller deviation counts as
# back at rest; a larger remainder at the last look decides against the sum.
_LEVEL = 0.05
_BACK = 0.15
_LEFT = 0.5


class ResponseDetector:
    """Find the sample at which the measurement leaves the noise band about its rest for good.

    The response is seen when the deviation exceeds three standard deviations of the noise on the
    same side in three successive samples (in one, where there is no noise). It is dated back to
    the first of them.

    :param rest: the measurement at rest.
    :param start: instant of the kick [s].
    """

    def __init__(self, rest: RestState, start: float) -> None:
        self._rest = rest.mean
        self.band = _BAND * rest.noise_std
        """Half width of the band about the rest [y]."""
        self._run_needed = _RUN if rest.noise_std > 0.0 else 1
        self._latest = start
        # Samples in a row outside the band, negative below it.
        self._run = 0
        self.side = 0
        """Side of the rest on which the response began, 1 or -1; set once it is seen."""
        self.last_inside = start
        """Instant of the last sample before the response [s]."""
        self.first_outside = math.nan
        """Instant of the first sample of the response [s]."""

    def add(self, time: float, measurement: float) -> bool:
        """Take one sample after the kick; return True once the response is seen."""
        deviation = measurement - self._rest
        side = 1 if deviation > self.band else -1 if deviation < -self.band else 0
        if side == 0:
            self._run = 0
            self.last_inside = time
            return False
        if side * self._run <= 0:
            if self._run:
                # A jump from one side to the other is noise, and counts as inside.
                self.last_inside = self._latest
            self._run, self.first_outside = 0, time
        self._run += side
        self._latest = time
        if abs(self._run) < self._run_needed:
            return False
        self.side = side
        return True


class DirectionWatch:
    """Find the sign of the process gain from the response to a short pulse.

    The command was high until the process responded, stays high for the same time again, and then
    returns to the baseline. Time is counted in intervals of the time to respond. The side on which
    the response began is not enough, because of processes with inverse response. The deviation
    after the pulse decides: without inverse response it stays, or returns to rest from the same
    side; with inverse response it crosses the rest to the other side. With the command at the
    baseline only the pulse moves the process, so waiting costs time but little excursion.

    From the fifth interval on, with m the mean deviations of the intervals so far (0 in the first,
    before the response), positive on the first side:

    - if the sum of m is negative: the other side;
    - if m was level for half of the time (an integrating or very slow process), or returns more
      and more slowly with a geometric limit at the rest or before it, or was at rest for half of
      the time: the first side;
    - after 50 intervals and 200 samples: the side on which half of the largest deviation or more
      is left; else the side of the sum of m.

    An unstable process runs away meanwhile, so its sign must be given.

    :param interval: length of an interval [s], > 0.
    :param start: instant at which the response was seen [s].
    :param rest: the measurement at rest.
    :param side: side on which the response began, 1 or -1.
    """

    def __init__(self, interval: float, start: float, rest: RestState, side: int) -> None:
        self.sign = 0
        """Sign of the process gain, 0 while it is not clear."""
        self._interval = interval
        self._rest = rest.mean
        self._noise_std = rest.noise_std
        self._side = side
        self._end = start + interval
        self._sum = 0.0
        self._count = 0
        self._samples = 0
        self._means = [0.0]
        self._errors = [0.0]

    @property
    def largest(self) -> float:
        """The largest mean deviation of an interval to either side [y]."""
        return max(abs(m) for m in self._means)

    @property
    def remains(self) -> float:
        """The largest mean deviation after the interval in which the response was seen [y]."""
        return max((abs(m) for m in self._means[2:]), default=0.0)

    def add(self, time: float, measurement: float) -> int:
        """Take one sample, from the one on at which the response was seen; return the sign."""
        if time >= self._end and self._count > 0:
            self._means.append(self._side * self._sum / self._count)
            self._errors.append(self._noise_std / math.sqrt(self._count))
            self.sign = self._verdict()
            self._sum, self._count = 0.0, 0
            # A gap in the samples must not create empty intervals.
            self._end = max(self._end, time - self._interval) + self._interval
        self._sum += measurement - self._rest
        self._count += 1
        self._samples += 1
        return self.sign

    def _verdict(self) -> int:
        if len(self._means) < _FIRST_LOOK:
            return 0
        total = sum(self._means)
        uncertainty = math.sqrt(sum(e * e for e in self._errors))
        if total < -3.0 * uncertainty:
            return -self._side
        if self._is_level() or self._tends_back() or self._is_back():
            return self._side
        if len(self._means) >= LAST_LOOK and self._samples >= LAST_LOOK_SAMPLES:
            return self._side if self._balance() >= 0.0 else -self._side
        return 0

    def _balance(self) -> float:
        quarter = self._means[-(-3 * len(self._means) // 4) :]
        left = sum(quarter) / len(quarter)
        return left if abs(left) >= _LEFT * self.largest else sum(self._means)

    def _later_half(self) -> Iterator[tuple[float, float]]:
        """Yield mean and error of the later intervals: a passage through the rest is shorter."""
        half = len(self._means) // 2
        return zip(self._means[half:], self._errors[half:], strict=True)

    def _is_level(self) -> bool:
        least = (1.0 - _LEVEL) * self.largest
        return all(mean >= least - 3.0 * error for mean, error in self._later_half())

    def _tends_back(self) -> bool:
        """Extrapolate the return from the largest deviation, from three equal parts."""
        size = (len(self._means) - self._means.index(max(self._means))) // 3
        if size == 0:
            return False
        tail = self._means[-3 * size :]
        first, second, third = (sum(tail[k * size : (k + 1) * size]) / size for k in range(3))
        slowing = (first - second) - (second - third)
        # slowing is m - 2 m' + m'', with six times the variance of one part.
        uncertainty = math.sqrt(6.0 / size) * max(self._errors[-3 * size :])
        if not first > second > third or slowing <= 3.0 * uncertainty:
            return False
        end = third - (second - third) ** 2 / slowing
        return end >= -_BACK * self.largest

    def _is_back(self) -> bool:
        back = _BACK * self.largest
        return all(abs(mean) <= max(back, 2.0 * error) for mean, error in self._later_half())
