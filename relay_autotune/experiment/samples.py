# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The samples of a running experiment."""

from __future__ import annotations

from array import array
from itertools import pairwise

import numpy as np

from relay_autotune.arrays import FloatArray

# An interval counts at most this many times the mean of the intervals before it: a gap in the
# samples, or a step of their clock, says nothing about the process. The pauses of a sensor that
# publishes only on change are shorter.
GAP = 300.0
# For this many first intervals, the mean is that of the shorter half: one of them may be a gap.
_FIRST = 20


class Samples:
    """Columns that grow by one sample at a time at little cost, and return any part as arrays."""

    def __init__(self) -> None:
        self.time = array("d")
        """Instants [s from the first sample]."""
        self.seen = array("d")
        """Instants without the time of gaps in the samples and steps of their clock [s]."""
        self.measurement = array("d")
        """Measurements [y]."""
        self.command = array("d")
        """Commands [u]; one fewer while a sample is being answered."""
        self._gaps = 0.0
        self._steps = 0

    def add(self, time: float, measurement: float) -> None:
        """Append a sample that is not answered yet.

        :param time: its instant [s from the first sample], not before the last one.
        :param measurement: [y].
        """
        # Several samples at one instant (a clock in steps) count as one interval.
        if self.time and time > self.time[-1]:
            if self._steps < _FIRST:
                self._gaps = self._first_gaps(time)
            else:
                longest = GAP * self.seen[-1] / self._steps
                self._gaps += max(0.0, time - self.time[-1] - longest)
            self._steps += 1
        self.time.append(time)
        self.seen.append(time - self._gaps)
        self.measurement.append(measurement)

    def _first_gaps(self, time: float) -> float:
        # Recompute all first intervals, because the very first one may be the gap.
        steps = sorted(b - a for a, b in pairwise((*self.time, time)) if b > a)
        shorter = steps[: (len(steps) + 1) // 2]
        return sum(max(0.0, step - GAP * sum(shorter) / len(shorter)) for step in steps)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def interval(self) -> float:
        """Mean interval between samples without gaps [s]; 0 for fewer than two."""
        return self.seen[-1] / (len(self.seen) - 1) if len(self.seen) > 1 else 0.0

    def columns(self, first: int, stop: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return copies of time, measurement and command of the samples first to stop - 1.

        While a sample is being answered, it has no command yet.
        """
        time, measurement, command = (
            # A copy: an array that shares the column's memory would keep it from growing.
            np.array(column[first:stop], dtype=np.float64)
            for column in (self.time, self.measurement, self.command)
        )
        return time, measurement, command
