# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Faults of the sensor and of the clock that stamps its samples."""

from __future__ import annotations

import math

# If less than this part of the samples at rest equals the one before, the noise changes every
# sample, and this many equal samples in a row cannot be chance.
_RARELY_EQUAL = 0.05
_FROZEN_SAMPLES = 20
# Otherwise the run of equal samples is compared with the longest run of the cycles before.
_FROZEN_RATIO = 3.0

# Samples needed for the difference of the clocks; smallest step that counts [s]; time after which
# a larger difference is a step and not a delay [s]; part of a drift that is followed at a sample.
_STEP_SAMPLES = 10
_STEP_LEAST = 0.05
_STEP_LASTS = 1.0
_FOLLOWED = 1e-3


class FrozenWatch:
    """Recognise a sensor that repeats one value.

    A sensor with noise is frozen after 20 equal samples. If equal samples are normal (a coarse
    resolution, a slow converter, a process without noise), it is judged after the first whole
    cycle: it is frozen after three times the longest run of equal samples so far plus 20 samples.
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

    The delay of a sample varies, and a busy machine may delay many of them. But no sample arrives
    before it was sent, and a backlog is soon worked off. So a drop of receive minus source time is
    a step at once; a rise is a step if it lasts for a second and 10 samples.
    """

    def __init__(self) -> None:
        self._first: list[float] = []
        self._begin = self._reference = math.nan
        self._late_since = math.nan
        self._late = 0

    @property
    def drift(self) -> float:
        """Change of the difference of the clocks since the start [s]."""
        return 0.0 if math.isnan(self._begin) else self._reference - self._begin

    def add(self, source: float, receive: float) -> str:
        """Take the two times of a sample; return a sentence if a clock has stepped, else "".

        :param source: when it was taken, on the sensor's clock [s].
        :param receive: when it arrived, on our clock [s].
        """
        difference = receive - source
        if len(self._first) < _STEP_SAMPLES:
            self._first.append(difference)
            self._begin = self._reference = min(self._first)
            return ""
        moved = difference - self._reference
        if moved > _STEP_LEAST:
            if self._late == 0:
                self._late_since = receive
            self._late += 1
            lasting = receive - self._late_since > _STEP_LASTS and self._late >= _STEP_SAMPLES
            return self._said(difference) if lasting else ""
        self._late = 0
        if moved < -_STEP_LEAST:
            return self._said(difference)
        # A drift is followed, a step is not.
        self._reference += moved if moved < 0.0 else _FOLLOWED * moved
        return ""

    def _said(self, difference: float) -> str:
        return (
            f"a clock has stepped: receive minus source time went from {self._reference:.4g} s to "
            f"{difference:.4g} s; stop what sets the clocks, or give sample_period"
        )


# Numbers beyond this are no measurements, and their squares may overflow.
_LARGEST = 1e100
# More samples than this with the same time mean that the clock stands still.
_LONGEST_REPEAT = 10_000


class SampleCheck:
    """Recognise numbers that are no measurements, and times that do not advance."""

    def __init__(self) -> None:
        self._samples = 0
        self._repeats = 0

    def problem(self, time: float, measurement: float, last: float, origin: float) -> str | None:
        """Take a sample; return why it cannot be used, None if it can.

        :param time: its instant [s].
        :param measurement: [y].
        :param last: instant of the previous sample, from the first one [s]; -inf: there is none.
        :param origin: instant of the first sample [s].
        """
        count = self._samples
        self._samples += 1
        if not -_LARGEST < measurement < _LARGEST:
            return (
                f"the measurement after {count} samples is {measurement:g}, expected a "
                f"finite number: check the sensor"
            )
        if not -_LARGEST < time < _LARGEST:
            return f"the time after {count} samples is {time:g} s, expected a finite number"
        if last == -math.inf:
            return None
        t = float(time) - origin
        if t > last:
            self._repeats = 0
            return None
        if t < last:
            return (
                f"time went backwards, from {last:g} s to {t:g} s after the first sample: check "
                f"the clock that stamps the measurement"
            )
        self._repeats += 1
        if self._repeats < _LONGEST_REPEAT:
            return None
        return (
            f"{_LONGEST_REPEAT} samples carry the same time, {t:g} s after the first: check the "
            f"clock that stamps the measurement"
        )
