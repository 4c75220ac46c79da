# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Read the response to the first step of the relay: its start and its direction."""

from __future__ import annotations

import math

from relay_autotune.experiment.settling import RestState

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
        self._run = 0
        self._run_side = 0
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
        if side != self._run_side or self._run == 0:
            if self._run > 0:
                # A jump from one side to the other is noise, and counts as inside.
                self.last_inside = self._latest
            self._run, self._run_side = 0, side
            self.first_outside = time
        self._run += 1
        self._latest = time
        if self._run < self._run_needed:
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

    def _is_level(self) -> bool:
        half = len(self._means) // 2
        least = (1.0 - _LEVEL) * self.largest
        return all(
            mean >= least - 3.0 * error
            for mean, error in zip(self._means[half:], self._errors[half:], strict=True)
        )

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
        # For half of the time, so that a passage through the rest does not count.
        half = len(self._means) // 2
        largest = self.largest
        return all(
            abs(mean) <= max(_BACK * largest, 2.0 * error)
            for mean, error in zip(self._means[half:], self._errors[half:], strict=True)
        )
