"""Read the response to the first step of the relay: when it is seen, and which way it goes."""

from __future__ import annotations

import math

from relay_autotune.settling import RestState

# White noise leaves three standard deviations on one side three times in a row once in 4e8
# samples; without noise one sample is enough.
_BAND = 3.0
_RUN = 3

# The watch looks no earlier than after so many intervals, and decides at the latest after so many.
_FIRST_LOOK = 5
_LAST_LOOK = 20

# Fractions: of the largest deviation that is still there; of growth since half the time; of the
# largest deviation, so near to the rest that it counts as there.
_STILL_THERE = 0.75
_GROWN = 1.5
_BACK = 0.15


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
        """1 or -1 once the response is seen: the side of the rest on which it began."""
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
                # It jumped from one side to the other: noise, which counts as inside.
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

    The command is high for two intervals (an interval is the time that the process took to
    respond) and then rests at the baseline. The side on which the response began is not the
    answer for a process with inverse response; what remains after the pulse is: a process that
    answers straight keeps its deviation or goes back to rest from the side where it was, one with
    inverse response goes through the rest to the other side. While the command rests the process
    is moved no further than by the pulse, so looking on costs time and no excursion.

    From the fifth interval on, with m the mean deviations of the intervals so far:

    - the sum of m has the other side: that is the answer;
    - the last m is still at least 0.75 of the largest, and grew by less than half since half the
      time (a slow or integrating process), or grows ever faster with the command at rest (an
      unstable process or a high order): the first side is the answer;
    - m goes back ever more slowly, and its geometric continuation ends at the rest or before;
      or it was within 0.15 of the largest for a quarter of the time: the first side is the
      answer;
    - after 20 intervals the sum of m decides.

    :param interval: length of an interval [s], > 0.
    :param start: instant of the kick [s].
    :param rest: the measurement at rest.
    :param side: side on which the response began, 1 or -1.
    """

    def __init__(self, interval: float, start: float, rest: RestState, side: int) -> None:
        self._interval = interval
        self._rest = rest.mean
        self._noise_std = rest.noise_std
        self._side = side
        self._end = start + interval
        self._sum = 0.0
        self._count = 0
        self._means: list[float] = []
        self._errors: list[float] = []

    def add(self, time: float, measurement: float) -> None:
        """Take one sample; the samples since the kick, in order."""
        if time >= self._end and self._count > 0:
            self._close()
            # A gap in the samples must not leave intervals without any.
            self._end = max(self._end, time - self._interval) + self._interval
        self._sum += measurement - self._rest
        self._count += 1

    def _close(self) -> None:
        # Counted positive on the side on which the response began.
        self._means.append(self._side * self._sum / self._count)
        self._errors.append(self._noise_std / math.sqrt(self._count))
        self._sum, self._count = 0.0, 0

    @property
    def intervals(self) -> int:
        """Number of whole intervals seen."""
        return len(self._means)

    @property
    def largest(self) -> float:
        """The largest mean deviation of an interval to either side [y]."""
        return max((abs(m) for m in self._means), default=0.0)

    def verdict(self) -> int:
        """Return the sign of the process gain, 1 or -1, or 0 while it is not clear."""
        m = self._means
        n = len(m)
        if n < _FIRST_LOOK:
            return 0
        total = sum(m)
        uncertainty = math.sqrt(sum(e * e for e in self._errors))
        if total < -3.0 * uncertainty:
            return -self._side
        if self._stays() or self._tends_back() or self._is_back():
            return self._side
        if n >= _LAST_LOOK:
            return self._side if total >= 0.0 else -self._side
        return 0

    def _stays(self) -> bool:
        m = self._means
        half = m[(len(m) + 1) // 2 - 1]
        if m[-1] < _STILL_THERE * max(m):
            return False
        speeds_up = m[-1] - m[-2] > m[-2] - m[-3] > 0.0
        return m[-1] <= _GROWN * half or speeds_up

    def _tends_back(self) -> bool:
        before, after = self._means[-3] - self._means[-2], self._means[-2] - self._means[-1]
        slowing = before - after
        # The variance of slowing is that of m - 2 m' + m'', six times that of one mean.
        if not 0.0 < after < before or slowing <= 3.0 * math.sqrt(6.0) * max(self._errors[-3:]):
            return False
        end = self._means[-1] - after * after / slowing
        return end >= -_BACK * self.largest

    def _is_back(self) -> bool:
        # For a quarter of the time, so that passing through the rest is not taken for staying.
        quarter = -(-len(self._means) // 4)
        largest = self.largest
        return all(
            abs(mean) <= max(_BACK * largest, 2.0 * error)
            for mean, error in zip(self._means[-quarter:], self._errors[-quarter:], strict=True)
        )
