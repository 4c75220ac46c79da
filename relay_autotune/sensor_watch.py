"""Watch the sensor: does it still measure, and do its clock and ours go alike."""

from __future__ import annotations

import math
from collections import deque

# Where less than this part of the samples at rest equals the one before, the sensor's noise makes
# every sample another one; so many equal ones in a row are then not by chance.
_RARELY_EQUAL = 0.05
_FROZEN_SAMPLES = 20
# Elsewhere a run of equal samples is compared with the longest one of the cycles before.
_FROZEN_RATIO = 3.0

# A step between two clocks shows in the least of so many differences, since a late sample is no
# step; it counts from this size on [s].
_STEP_SAMPLES = 10
_STEP_LEAST = 0.05


class FrozenWatch:
    """Recognise a sensor that says the same again and again.

    A sensor with noise is frozen after 20 equal samples. One that repeats itself anyhow (a coarse
    resolution, a slow converter, a process without noise) is judged once a whole cycle was seen,
    by three times the longest run of equal samples so far and 20 samples more.
    """

    def __init__(self) -> None:
        self._last = math.nan
        self._pairs = self._equal = 0
        self._run = 1
        self._longest = 1
        self._noisy = False

    @property
    def run(self) -> int:
        """Number of equal samples, the last one included."""
        return self._run

    def add(self, measurement: float, *, at_rest: bool, in_cycles: bool) -> bool:
        """Take a sample; return True if the sensor is frozen.

        :param measurement: the sample [y].
        :param at_rest: True before the kick.
        :param in_cycles: True once a whole cycle was seen.
        """
        same = measurement == self._last
        self._last = measurement
        if at_rest:
            self._pairs += 1
            self._equal += same
        if not same:
            if not at_rest:
                self._longest = max(self._longest, self._run)
            self._run = 1
            self._noisy = (
                self._pairs > _FROZEN_SAMPLES and self._equal < _RARELY_EQUAL * self._pairs
            )
            return False
        self._run += 1
        if self._noisy:
            return self._run > _FROZEN_SAMPLES
        return in_cycles and self._run > _FROZEN_SAMPLES + _FROZEN_RATIO * self._longest


class ClockWatch:
    """Recognise a step between the clock that stamps samples and the clock that receives them.

    What a sample takes on its way varies, but not its least: the smallest difference of receive
    and source time over 10 samples is compared with that over the first 10. A step forward of the
    source's clock shows at once, since nothing arrives before it was sent.
    """

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_STEP_SAMPLES)
        self._reference = math.nan

    @property
    def drift(self) -> float:
        """How far the clocks have moved against each other since the start [s]."""
        if len(self._recent) < _STEP_SAMPLES:
            return 0.0
        return min(self._recent) - self._reference

    def add(self, source: float, receive: float) -> str:
        """Take the two times of a sample; return a sentence if a clock has stepped, else "".

        :param source: when it was taken, on the sensor's clock [s].
        :param receive: when it arrived, on ours [s].
        """
        difference = receive - source
        self._recent.append(difference)
        if len(self._recent) < _STEP_SAMPLES:
            return ""
        if math.isnan(self._reference):
            self._reference = min(self._recent)
        least = min(self._recent)
        moved = least - self._reference
        if abs(moved) <= _STEP_LEAST:
            # A drift is followed, a step is not.
            self._reference += 0.01 * moved
            return ""
        return (
            f"a clock has stepped: receive minus source time went from {self._reference:.4g} s to "
            f"{least:.4g} s; stop what sets the clocks, or give sample_period"
        )
