# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the states of a running experiment share: samples, facts, and how a state ends."""

from __future__ import annotations

import enum
import math
from array import array
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.relay_law import Levels
from relay_autotune.experiment.settling import NOT_SETTLED, RestState
from relay_autotune.reasons import Reason

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


class State(enum.IntEnum):
    """The state of an experiment."""

    SETTLING = 1
    KICK = 2
    PROBE = 3
    RELAY = 4
    COMPLETED = 5
    ABORTED = 6
    FAILED = 7


@dataclass(frozen=True)
class Facts:
    """What the states have found, each for those after it."""

    rest: RestState = NOT_SETTLED
    """The measurement at rest at the baseline."""
    settled_at: float = math.nan
    """When it was known, gaps not counted [s]."""
    kicked_at: float = math.nan
    """Time of the kick from the first sample on [s]; NaN before."""
    setpoint: float = math.nan
    """Middle of the relay's band [y]; NaN until the measurement has settled."""
    hysteresis: float = math.nan
    """Its half width [y]."""
    sign: int = 0
    """Sign of the process gain, 1 or -1 as given or found; 0 while unknown."""
    side: int = 0
    """Side of the rest on which the response began, 1 or -1; 0 before."""
    dead_time_seen: float = math.nan
    """Time from the kick to the last sample before the response [s]; NaN until it is seen.

    Without noise the dead time lies between this and one sample interval more. With noise this
    time is longer: the response must first leave the noise band."""
    response_time: float = math.nan
    """Time from the kick to the first sample of the response [s]; NaN until it is seen."""


@dataclass(frozen=True)
class Setup:
    """What every state of an experiment has.

    :param parameters: the user's parameters, valid.
    :param baseline: command of the operating point [u].
    :param until_converged: False: agreement of the cycles does not end it.
    """

    parameters: ExperimentParameters
    baseline: float
    until_converged: bool
    levels: Levels
    """The levels of the relay."""
    trace: Samples
    """The samples so far; each is appended before it is answered."""
    notes: list[Reason]
    """What else is to be known of the experiment, in the order in which it was found."""

    @property
    def now(self) -> tuple[float, float]:
        """Time without gaps [s] and measurement [y] of the last sample."""
        return self.trace.seen[-1], self.trace.measurement[-1]

    def level(self, *, is_high: bool) -> float:
        """Return a level of the relay [u]."""
        return self.levels.high if is_high else self.levels.low


class Event(enum.Enum):
    """What ends a state."""

    STEADY = enum.auto()
    """The measurement is at rest."""
    RESPONSE = enum.auto()
    """The process has responded to the kick, and the sign of its gain is given."""
    UNSIGNED_RESPONSE = enum.auto()
    """The process has responded, and the sign is not known."""
    DIRECTION = enum.auto()
    """The sign has been found."""
    NO_DIRECTION = enum.auto()
    """Nothing is left of the response."""


@dataclass(frozen=True)
class Left:
    """A state has ended by an event, with what is known then."""

    event: Event
    facts: Facts


@dataclass(frozen=True)
class Ended:
    """The experiment has ended.

    :param state: COMPLETED, ABORTED or FAILED.
    :param why: the reason.
    """

    state: State
    why: Reason


Answer = float | Left | Ended
"""What a state makes of a sample: a command [u], or its end."""


def failed(why: Reason) -> Ended:
    """Return the end of an experiment that has failed."""
    return Ended(State.FAILED, why)
