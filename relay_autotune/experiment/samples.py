# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The samples of a running experiment, and what its parts know from them."""

from __future__ import annotations

import enum
import math
from array import array
from itertools import pairwise

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.relay_law import Levels
from relay_autotune.experiment.settling import NOT_SETTLED
from relay_autotune.record.record import Cycle, RelaySettings

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


# If the levels started at a quarter, the swings are compared after this many cycles.
_TRIED = 2


class State(enum.IntEnum):
    """The state of an experiment."""

    SETTLING = 1
    KICK = 2
    PROBE = 3
    RELAY = 4
    COMPLETED = 5
    ABORTED = 6
    FAILED = 7


class Run:
    """What is known of a running experiment: each of its parts reads it and adds to it.

    :param parameters: the user's parameters, valid.
    :param baseline: command of the operating point [u].
    :param from_small: True: a given amplitude begins at a quarter of that.
    """

    def __init__(
        self, parameters: ExperimentParameters, baseline: float, *, from_small: bool = False
    ) -> None:
        self.parameters = parameters
        self.baseline = float(baseline)
        self.levels = Levels(parameters, self.baseline, from_small=from_small)
        """The levels of the relay."""
        self.state = State.SETTLING
        """The present state."""
        self.why_ended = ""
        """Why it ended, a sentence for people without the notes; empty before."""
        self.trace = Samples()
        """The samples so far; each is appended before it is answered."""
        self.rest = NOT_SETTLED
        """The measurement at rest at the baseline."""
        self.setpoint = self.hysteresis = math.nan
        """Middle and half width of the relay's band [y]; NaN until the measurement has settled."""
        self.process_gain_sign = parameters.process_gain_sign
        """1 or -1 as given or found; 0 while unknown."""
        self.kicked_at = math.nan
        """Time of the kick from the first sample on [s]; NaN before."""
        self.dead_time_seen = math.nan
        """Time from the kick to the last sample before the response [s]; NaN until it is seen.

        Without noise the dead time lies between this and one sample interval more. With noise
        this time is longer: the response must first leave the noise band."""
        self.response_time = math.nan
        """Time from the kick to the first sample of the response [s]; NaN until it is seen."""
        self.cycles: tuple[Cycle, ...] = ()
        """The whole cycles so far."""
        self.cycle_start: tuple[int, ...] = ()
        """Index of the first sample of each cycle, as in a record."""
        self.switches = 0
        """Number of switches of the relay so far; two of them are a half cycle."""
        self.notes: list[str] = []
        """Sentences that follow the reason of the end."""

    def end(self, state: State, reason: str) -> float:
        """End the experiment and return the safe command.

        :param state: COMPLETED, ABORTED or FAILED.
        :param reason: why, a sentence for people.
        """
        self.state, self.why_ended = state, reason
        return self.baseline

    @property
    def settings(self) -> RelaySettings | None:
        """The relay's settings; None until the measurement has settled.

        While the sign of the process gain is not known, ``reverse_acting`` is False.
        """
        if not self.rest.samples:
            return None
        return RelaySettings(
            setpoint=self.setpoint,
            baseline=self.baseline,
            amplitude=self.levels.amplitude,
            bias=self.levels.bias,
            hysteresis=self.hysteresis,
            extra_delay=self.parameters.extra_delay,
            sample_period=self.parameters.sample_period,
            reverse_acting=self.process_gain_sign < 0,
        )

    @property
    def is_tried(self) -> bool:
        """True unless the levels began small and it is not known yet whether the process follows.

        Until then the cycles may be those of an actuator that is at its ends.
        """
        return not self.levels.from_small or len(self.cycles) >= _TRIED

    @property
    def noise_std(self) -> float:
        """Standard deviation of the measurement at rest [y]; NaN until it has settled."""
        return self.rest.noise_std

    @property
    def rest_measurement(self) -> float:
        """Mean measurement at rest at the baseline [y]; NaN until it has settled."""
        return self.rest.mean

    @property
    def cycle_count(self) -> int:
        """Number of whole cycles so far."""
        return len(self.cycles)

    @property
    def counted(self) -> str:
        """The number of whole cycles in words."""
        return f"{len(self.cycles)} whole cycle{'' if len(self.cycles) == 1 else 's'}"
