# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Check whether a sample can be used."""

from __future__ import annotations

import math

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
