# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the states of a relay experiment share, and those before the relay: settle, kick, probe.

A state takes samples. It returns a command for each, or the state after it, and keeps what it
has found in the :class:`Run`. :mod:`relay_autotune.experiment.experiment` has the table of what
follows.
"""

from __future__ import annotations

import enum
import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.relay_law import Levels, Relay
from relay_autotune.experiment.settling import (
    LAST_LOOK,
    LAST_LOOK_SAMPLES,
    NOISE_SAMPLES,
    NOT_SETTLED,
    DirectionWatch,
    ResponseDetector,
    RestState,
    RestWatch,
    Settling,
    rest_state,
)
from relay_autotune.reasons import Code, Reason
from relay_autotune.record.record import Cycle
from relay_autotune.text import duration

# An interval counts at most this many times the mean of the intervals before it: a gap in the
# samples, or a step of their clock, says nothing about the process. The pauses of a sensor that
# publishes only on change are shorter.
GAP = 300.0
# For this many first intervals, the mean is that of the shorter half: one of them may be a gap.
_FIRST = 20
# Numbers beyond this are no measurements, and their squares may overflow.
_LARGEST = 1e100
# More samples than this with the same time mean that the clock stands still.
_LONGEST_REPEAT = 10_000


class Samples:
    """Columns that grow by one sample at a time at little cost, and return any part as arrays."""

    def __init__(self) -> None:
        self.origin = math.nan
        """Instant of the first sample, on the caller's axis [s]; NaN before it."""
        self.time = array("d")
        """Instants [s from the first sample]."""
        self.seen = array("d")
        """Instants without the time of gaps in the samples and steps of their clock [s]."""
        self.measurement = array("d")
        """Measurements [y]."""
        self.command = array("d")
        """Commands [u]; one fewer while a sample is being answered."""
        self._gaps = 0.0
        self._steps = self._repeats = 0

    def add(self, time: float, measurement: float) -> Reason | None:
        """Append a sample that is not answered yet, or return why it cannot be used.

        :param time: its instant [s], on any axis.
        :param measurement: [y].
        """
        if not -_LARGEST < measurement < _LARGEST:
            return Code.BAD_MEASUREMENT(samples=len(self), value=measurement)
        if not -_LARGEST < time < _LARGEST:
            return Code.BAD_TIME(samples=len(self), time=time)
        if not self.time:
            self.origin = float(time)
        t = float(time) - self.origin
        if self.time and t <= self.time[-1]:
            if t < self.time[-1]:
                return Code.TIME_BACKWARDS(before=self.time[-1], time=t)
            self._repeats += 1
            if self._repeats >= _LONGEST_REPEAT:
                return Code.TIME_REPEATS(samples=_LONGEST_REPEAT, time=t)
        else:
            self._repeats = 0
        self._append(t, float(measurement))
        return None

    def _append(self, time: float, measurement: float) -> None:
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


@dataclass
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
    response_time: float = math.nan
    """Time from the kick to the first sample of the response [s]; NaN until it is seen."""


@dataclass
class Run:
    """What the states of an experiment share: what it was given, and what they have found.

    :param parameters: the user's parameters, valid.
    :param baseline: command of the operating point [u].
    :param until_converged: False: agreement of the cycles does not end it.
    """

    parameters: ExperimentParameters
    baseline: float
    until_converged: bool
    levels: Levels
    """The levels of the relay."""
    trace: Samples = field(default_factory=Samples)
    """The samples so far; each is appended before it is answered."""
    facts: Facts = field(default_factory=Facts)
    notes: list[Reason] = field(default_factory=list)
    """What else is to be known of the experiment, in the order in which it was found."""
    cycles: tuple[Cycle, ...] = ()
    """The whole cycles of the relay so far."""
    cycle_start: tuple[int, ...] = ()
    """Index of the first sample of each cycle, as in a record."""
    switches: int = 0
    """Number of switches of the relay so far; two of them are a half cycle."""

    @property
    def now(self) -> tuple[float, float]:
        """Time without gaps [s] and measurement [y] of the last sample."""
        return self.trace.seen[-1], self.trace.measurement[-1]

    def level(self, *, is_high: bool) -> float:
        """Return a level of the relay [u]."""
        return self.levels.high if is_high else self.levels.low

    @property
    def is_tried(self) -> bool:
        """True unless the levels began small and it is not known yet whether the process follows.

        Until then the cycles may be those of an actuator that is at its ends.
        """
        return not self.levels.from_small or len(self.cycles) >= TRIED


Answer = float | State | Reason
"""What a state makes of a sample: a command [u], the state after it, or why all ends."""


SETTLING_LIMIT = 600.0
"""Longest settling without settle_time [s]; or 500 samples, if these take longer."""
SETTLING_SAMPLES = 500
KICK_LIMIT = 600.0
"""Longest wait for a response, and then for the first switch, without max_duration [s]; or 50
times the settling, if that is longer."""
KICK_SETTLINGS = 50.0

# Least number of samples for a line and a standard deviation, also with settle_time.
_LEAST_SETTLING_SAMPLES = 5
# Multiple of its limit at which a part fails that its own rules did not end.
_BEYOND = 2.0
# Least number of samples in an interval of the probe.
_PROBE_SAMPLES = 2
# An amplitude that is not given begins to grow after this part of the settling, or a number of
# samples. Each size lasts as long as all smaller ones together, so that a long dead time does not
# make the amplitude much too large.
_GROWTH_SETTLINGS = 0.25
_GROWTH_SAMPLES = 20
# Factor of that time for a given amplitude that begins small, which stays small until its
# response is known.
_SMALL_STAYS = 10.0

# Cycles that a tune usually takes beyond those that must agree.
_USUAL_EXTRA = 2
# If the levels started at a quarter, the swings are compared after this many cycles.
TRIED = 2
SMALL_CYCLES = 2
"""Oscillations that a given amplitude takes longer where it begins small: one, and the way on."""


def _settling_limit(run: Run) -> float:
    return max(SETTLING_LIMIT, SETTLING_SAMPLES * run.trace.interval)


def kick_limit(run: Run) -> float:
    """Return the longest wait for a response, and then for the first switch [s]."""
    if run.parameters.max_duration > 0.0:
        return math.inf
    return max(KICK_LIMIT, KICK_SETTLINGS * run.facts.settled_at)


class Settle:
    """Hold the baseline until the measurement is steady, or settle_time is over.

    :param run: of the experiment.
    :param before: measurements before the first command, where the baseline is the present command
        [y]; None: the baseline may lead the process elsewhere.
    """

    where = "while settling"

    def __init__(self, run: Run, before: Sequence[float] | None) -> None:
        self._run = run
        self._settling = Settling()
        self._watch = None if before is None else RestWatch(before)
        self.command = run.baseline

    @property
    def latest(self) -> float:
        """Deadline [s]."""
        if self._run.parameters.max_duration > 0.0:
            return math.inf
        return _BEYOND * (_settling_limit(self._run) + self._run.parameters.settle_time)

    def answer(self, t: float, y: float) -> Answer:
        """Take the last sample."""
        run, p, n = self._run, self._run.parameters, len(self._run.trace)
        baseline = run.baseline
        if self._watch is not None and self._watch.leaves(y):
            rest = self._watch.rested_at
            return Code.NOT_AT_BASELINE(rest=rest, value=y, time=t, baseline=baseline)
        if p.settle_time > 0.0:
            if t < p.settle_time or n < _LEAST_SETTLING_SAMPLES:
                return baseline
            # Whatever the rest, since the user chose that time.
            rest_then = rest_state(*run.trace.columns(0, n)[:2], n)
            if not rest_then.is_steady:
                run.notes.append(Code.NOTE_NOT_STEADY(motion=str(rest_then)))
            return self._settled(rest_then)
        if not self._settling.is_due(n):
            return baseline
        found, settled = self._settling.look(*run.trace.columns(0, n)[:2])
        # A constant measurement may not have responded to a wrong baseline yet.
        if settled and (self._watch is None or n >= NOISE_SAMPLES):
            return self._settled(found)
        if t > SETTLING_LIMIT and n >= SETTLING_SAMPLES and not p.max_duration:
            return Code.NOT_STEADY(time=t, motion=str(found))
        return baseline

    def _settled(self, rest: RestState) -> State:
        run, p, trace, watch = self._run, self._run.parameters, self._run.trace, self._watch
        if watch is not None and watch.has_moved_to(rest.mean):
            moved = {"rest": watch.rested_at, "value": rest.mean}
            run.notes.append(Code.NOTE_MOVED(**moved, baseline=run.baseline))
        facts = run.facts
        facts.rest = rest
        facts.settled_at = trace.seen[-1]
        facts.kicked_at = trace.time[-1]
        facts.setpoint = rest.mean if math.isnan(p.setpoint) else p.setpoint
        facts.hysteresis = p.band(rest.noise_std)
        return State.KICK

    def status(self, t: float, _: float) -> str:
        """Say what it waits for and sees."""
        p, interval, rest = self._run.parameters, self._run.trace.interval, self._settling.rest
        if p.settle_time > 0.0:
            return f"settling, {duration(t)} of {duration(p.settle_time)}"
        end = self._settling.expected_end(interval)
        about = f" of about {duration(end)}" if end > t else ""
        now = f"settling, {duration(t)}{about}"
        if not rest.samples or rest.is_steady:
            count = round(t / interval) + 1 if interval > 0.0 else 1
            return f"{now}: sample {count} of at least {NOISE_SAMPLES} for the noise"
        now += f": still {rest.motion}"
        if about:
            return now
        limit = p.max_duration or _settling_limit(self._run)
        return f"{now}, not slower than before; it may take {duration(limit)} in all"


class Kick:
    """Hold one level of the relay until the measurement leaves its rest.

    :param run: of the experiment, with the rest.
    """

    def __init__(self, run: Run) -> None:
        self._run, facts = run, run.facts
        self._begun, y = run.now
        # With a given sign, kick towards the set-point, unless the measurement is already there.
        self._is_high = (
            facts.sign == 0
            or Relay(facts.sign, facts.setpoint, facts.hysteresis, self._begun, y).is_high
        )
        self._detector = ResponseDetector(facts.rest, self._begun)
        self._limit = kick_limit(run)
        self.latest = facts.settled_at + _BEYOND * self._limit
        """Deadline [s]."""
        stays = _SMALL_STAYS if run.levels.from_small else 1.0
        self._grow_after = stays * max(
            _GROWTH_SETTLINGS * facts.settled_at, _GROWTH_SAMPLES * run.trace.interval
        )
        self.where = f"while waiting for the measurement to leave its rest {facts.rest.mean:g}"

    @property
    def command(self) -> float:
        """The level [u]."""
        return self._run.level(is_high=self._is_high)

    def answer(self, t: float, y: float) -> Answer:
        """Take the last sample."""
        levels, facts, detector = self._run.levels, self._run.facts, self._detector
        since = t - self._begun
        if detector.add(t, y):
            if levels.from_small:
                levels.begin_small()
            elif levels.can_grow:
                # A response that only just exceeds the noise says too little.
                levels.grow()
            facts.side = detector.side
            facts.response_time = detector.first_outside - self._begun
            return State.RELAY if facts.sign else State.PROBE
        if levels.can_grow and since >= self._grow_after:
            levels.grow()
            self._grow_after *= 2.0
        if t - facts.settled_at <= self._limit:
            return self.command
        rest, band = facts.rest.mean, detector.band
        stayed = {"band": band, "rest": rest} if band else {"still": rest}
        baseline = self._run.baseline
        return Code.NO_RESPONSE(level=self.command, baseline=baseline, time=since, **stayed)

    def status(self, t: float, y: float) -> str:
        """Say what it waits for and sees."""
        facts = self._run.facts
        rest, limit = facts.rest.mean, facts.settled_at + self._limit - self._begun
        wait = f", for {duration(limit)} at most" if math.isfinite(limit) else ""
        return (
            f"stepped to {self.command:g} u, no response after {duration(t - self._begun)}: the "
            f"measurement {y:.6g} y is to leave {rest:.6g} -/+ {self._detector.band:.2g} y{wait}"
        )


class Probe:
    """Hold the high level for a moment, then the baseline, until the sign of the gain is clear.

    :param run: of the experiment, with the response.
    """

    where = "while finding the sign of the process gain"

    def __init__(self, run: Run) -> None:
        self._run, facts = run, run.facts
        t, y = run.now
        interval = max(facts.response_time, _PROBE_SAMPLES * run.trace.interval)
        self._watch = DirectionWatch(interval, t, facts.rest, facts.side)
        self._watch.add(t, y)
        self._pulse_end = t + interval
        looks = max(LAST_LOOK * interval, LAST_LOOK_SAMPLES * run.trace.interval)
        self.latest = t + _BEYOND * looks
        """Deadline [s]."""
        self.command = run.levels.high

    def answer(self, t: float, y: float) -> Answer:
        """Take the last sample."""
        run, levels, sign = self._run, self._run.levels, self._watch.add(t, y)
        if sign == 0:
            return levels.high if t < self._pulse_end else run.baseline
        if self._watch.remains < run.facts.rest.noise_std:
            # The pulse left no deviation: noise had looked like a response.
            if levels.from_small:
                levels.begin_larger()
            return State.KICK
        run.facts.sign = sign
        return State.RELAY

    def status(self, t: float, y: float) -> str:
        """Say what it waits for and sees."""
        run, facts = self._run, self._run.facts
        return (
            f"the measurement went {'up' if facts.side > 0 else 'down'} after "
            f"{duration(facts.response_time)}; at {run.trace.command[-1]:g} u it is "
            f"{y:.6g} y, and shows whether it stays on that side, for "
            f"{duration(max(self.latest - t, 0.0))} at most"
        )


def how_long(
    parameters: ExperimentParameters, interval: float, *, from_small: bool = False
) -> str:
    """Say how long a tune may take, before it begins.

    :param parameters: the experiment's parameters.
    :param interval: mean interval of the samples [s]; 0: not known.
    :param from_small: whether a given amplitude begins at a quarter of that.
    """
    if parameters.settle_time > 0.0:
        settles = f"{duration(parameters.settle_time)} at rest"
    else:
        least = NOISE_SAMPLES * interval
        settles = f"{duration(least)} or more" if least > 0.0 else "some time"
        settles += f" until the measurement is steady, {duration(SETTLING_LIMIT)} at most"
    usual = parameters.min_cycles + _USUAL_EXTRA + from_small * SMALL_CYCLES
    sentence = f"it takes {settles}, then one step and about {usual} oscillations of the loop"
    if parameters.max_duration > 0.0:
        return f"{sentence}, {duration(parameters.max_duration)} at most in all"
    return sentence
