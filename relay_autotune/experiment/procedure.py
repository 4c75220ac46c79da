# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The procedure of a relay experiment, state by state.

The states, the command in each of them, and what ends it::

    SETTLING   the baseline               steady, or settle_time over            -> KICK
    KICK       one level of the relay     response seen, sign of the gain given  -> RELAY
                                          response seen, sign unknown            -> PROBE
    PROBE      the high level for a       direction clear                        -> RELAY
               moment, then the baseline  nothing left of the response           -> KICK
    RELAY      the relay's                cycles agree, or max_cycles            -> COMPLETED

A part that takes too long leads to FAILED. The ends that are possible in any state, ABORTED or
FAILED, belong to :mod:`relay_autotune.experiment.experiment`. In COMPLETED, ABORTED and FAILED the
command stays at the baseline.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from functools import partial

from relay_autotune.experiment.faults import count_cycles
from relay_autotune.experiment.narration import (
    while_finding_direction,
    while_settling,
    while_waiting_for_response,
)
from relay_autotune.experiment.oscillation import Oscillation
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.relay_law import Levels, Relay
from relay_autotune.experiment.samples import Samples
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
from relay_autotune.record.record import Cycle, Outcome, RelaySettings

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
_PATIENT = 10.0


class State(enum.IntEnum):
    """The state of an experiment."""

    SETTLING = 1
    KICK = 2
    PROBE = 3
    RELAY = 4
    COMPLETED = 5
    ABORTED = 6
    FAILED = 7


_ENDS = {Outcome.COMPLETED: State.COMPLETED, Outcome.FAILED: State.FAILED}


class Procedure:
    """Answer samples, one state after the other, until the procedure is over.

    Each state is a method that answers a sample, bound to the data that only this state needs.

    :param parameters: the user's parameters, valid.
    :param baseline: command of the operating point [u].
    :param samples: the samples so far; each is appended before it is answered.
    :param until_converged: False: agreement of the cycles does not end it.
    :param from_small: True: a given amplitude begins at a quarter of that.
    :param before: measurements before the first command, where the baseline is the present command
        [y]; None: the baseline may lead the process elsewhere.
    """

    def __init__(
        self,
        parameters: ExperimentParameters,
        baseline: float,
        samples: Samples,
        *,
        until_converged: bool = True,
        from_small: bool = False,
        before: Sequence[float] | None = None,
    ) -> None:
        self.state = State.SETTLING
        """The present state."""
        self.reason = ""
        """Why it ended, a sentence for people; empty before."""
        self.rest = NOT_SETTLED
        """The measurement at rest at the baseline."""
        self.dead_time_seen = math.nan
        """Time from the kick to the last sample before the response [s]; NaN until it is seen."""
        self.kicked_at = math.nan
        """Time of the first kick [s]; NaN before."""
        settling = Settling()
        self.answer: Callable[[float, float], float] = partial(self._settle, settling)
        """Take the last sample, its time without gaps [s] and the measurement [y]; return the
        command [u]."""
        self.tell: Callable[[float, float], str] = partial(self._tell_settling, settling)
        """Say what the present state waits for and sees, after the same sample."""

        self._parameters = parameters
        self._samples = samples
        self._baseline = baseline
        self._levels = Levels(parameters, baseline, from_small=from_small)
        self._until_converged = until_converged
        self._watch = None if before is None else RestWatch(before)
        self._sign = parameters.process_gain_sign
        self._oscillation: Oscillation | None = None
        self._notes: list[str] = []
        self._settled_at = math.nan
        self._setpoint = math.nan
        self._hysteresis = math.nan
        self._response_time = math.nan
        self._grow_after = math.inf
        self._probe_ends = math.inf

    @property
    def sign(self) -> int:
        """Sign of the process gain, 0 while unknown."""
        return self._oscillation.sign if self._oscillation else self._sign

    @property
    def latest(self) -> float:
        """Deadline of the present part, independent of its own rules [s]."""
        if self._oscillation is not None:
            return self._oscillation.latest
        if self.state is State.PROBE:
            return self._probe_ends
        if self.state is State.KICK:
            return self._settled_at + _BEYOND * self._kick_limit()
        if self._parameters.max_duration > 0.0:
            return math.inf
        longest = max(SETTLING_LIMIT, SETTLING_SAMPLES * self._samples.interval)
        return _BEYOND * (longest + self._parameters.settle_time)

    @property
    def cycles(self) -> list[Cycle]:
        """The whole cycles."""
        return self._oscillation.cycles if self._oscillation else []

    @property
    def is_tried(self) -> bool:
        """True unless levels that began small have not shown yet that the process follows."""
        return not self._levels.from_small or bool(
            self._oscillation and self._oscillation.is_tried
        )

    @property
    def switches(self) -> int:
        """Number of switches of the relay so far."""
        return self._oscillation.switches if self._oscillation else 0

    @property
    def cycle_start(self) -> list[int]:
        """Index of the first sample of each cycle, the unfinished one included."""
        return self._oscillation.cycle_start if self._oscillation else []

    @property
    def settings(self) -> RelaySettings | None:
        """The relay's settings; None until the measurement has settled.

        While the sign of the process gain is not known, ``reverse_acting`` is False.
        """
        if not self.rest.samples:
            return None
        return RelaySettings(
            setpoint=self._setpoint,
            baseline=self._baseline,
            amplitude=self._levels.amplitude,
            bias=self._levels.bias,
            hysteresis=self._hysteresis,
            extra_delay=self._parameters.extra_delay,
            sample_period=self._parameters.sample_period,
            reverse_acting=self.sign < 0,
        )

    def end(self, state: State, reason: str) -> float:
        """End the experiment and return the safe command.

        :param state: COMPLETED, ABORTED or FAILED.
        :param reason: why, a sentence for people.
        """
        self.state = state
        notes = self._oscillation.notes if self._oscillation else []
        self.reason = "; ".join((reason, *self._notes, *notes))
        return self._baseline

    def where(self) -> str:
        """Return the present state as the end of a sentence."""
        return {
            State.SETTLING: "while settling",
            State.KICK: f"while waiting for the measurement to leave its rest {self.rest.mean:g}",
            State.PROBE: "while finding the sign of the process gain",
        }.get(self.state, f"after {count_cycles(self.cycles)}")

    # SETTLING

    def _settle(self, settling: Settling, t: float, y: float) -> float:
        n = len(self._samples)
        if self._watch is not None and (told := self._watch.leaves(y)):
            return self.end(
                State.FAILED,
                f"{told}, {t:.3g} s after {self._baseline:g} u was commanded: {self._baseline:g} "
                f"u is not the present command, or a load came; set the command at which the "
                f"process rests",
            )
        settle_time = self._parameters.settle_time
        if settle_time > 0.0:
            if t >= settle_time and n >= _LEAST_SETTLING_SAMPLES:
                return self._settled(self._rest_over_settle_time())
            return self._baseline
        if not settling.is_due(n):
            return self._baseline
        rest, settled = settling.look(*self._samples.columns(0, n)[:2])
        # A constant measurement may not have responded to a wrong baseline yet.
        if settled and (self._watch is None or n >= NOISE_SAMPLES):
            return self._settled(rest)
        if t > SETTLING_LIMIT and n >= SETTLING_SAMPLES and not self._parameters.max_duration:
            return self.end(
                State.FAILED,
                f"the measurement was not steady within {t:g} s, {rest}: wait until the process "
                f"is at rest, or give settle_time to start anyway",
            )
        return self._baseline

    def _tell_settling(self, settling: Settling, t: float, _: float) -> str:
        p, interval = self._parameters, self._samples.interval
        limit = p.max_duration or max(SETTLING_LIMIT, SETTLING_SAMPLES * interval)
        return while_settling(settling, t, interval, p.settle_time, limit)

    def _rest_over_settle_time(self) -> RestState:
        """Accept the rest after settle_time, because the user chose that time."""
        n = len(self._samples)
        rest = rest_state(*self._samples.columns(0, n)[:2], n)
        if not rest.is_steady:
            self._notes.append(f"the measurement was not steady after settle_time, {rest}")
        return rest

    def _settled(self, rest: RestState) -> float:
        p = self._parameters
        self.rest = rest
        if self._watch is not None and (told := self._watch.moved_to(rest.mean)):
            self._notes.append(
                f"{told} under the baseline {self._baseline:g} u: look whether that is the "
                f"present command"
            )
        self._settled_at = self._samples.seen[-1]
        self.kicked_at = self._samples.time[-1]
        self._setpoint = rest.mean if math.isnan(p.setpoint) else p.setpoint
        self._hysteresis = p.hysteresis if p.hysteresis > 0.0 else 3.0 * rest.noise_std
        return self._kick()

    # KICK

    def _kick(self) -> float:
        t, y = self._samples.seen[-1], self._samples.measurement[-1]
        # With a given sign, kick towards the set-point, unless the measurement is already there.
        is_high = self.sign == 0 or self._starts_high(t, y)
        detector = ResponseDetector(self.rest, t)
        self.state = State.KICK
        patience = _PATIENT if self._levels.from_small else 1.0
        self._grow_after = patience * max(
            _GROWTH_SETTLINGS * self._settled_at, _GROWTH_SAMPLES * self._samples.interval
        )
        self.answer = partial(self._await_response, detector, is_high, t)
        self.tell = partial(self._tell_kick, detector.band, is_high, t)
        return self._level(is_high)

    def _tell_kick(self, band: float, is_high: bool, start: float, t: float, y: float) -> str:
        limit = self._settled_at + self._kick_limit() - start
        level = self._level(is_high)
        return while_waiting_for_response(level, t - start, y, self.rest.mean, band, limit)

    def _level(self, is_high: bool) -> float:
        return self._levels.high if is_high else self._levels.low

    def _starts_high(self, t: float, y: float) -> bool:
        return Relay(self.sign, self._setpoint, self._hysteresis, t, y).is_high

    def _await_response(
        self, detector: ResponseDetector, is_high: bool, start: float, t: float, y: float
    ) -> float:
        if detector.add(t, y):
            self.dead_time_seen = detector.last_inside - start
            self._response_time = detector.first_outside - start
            if self._levels.from_small:
                self._levels.begin_small()
            elif self._levels.can_grow:
                # A response that only just exceeds the noise says too little.
                self._levels.grow()
            if self.sign == 0:
                return self._probe(detector, t, y)
            return self._relay(doubtful=False)
        if self._levels.can_grow and t - start >= self._grow_after:
            self._levels.grow()
            self._grow_after *= 2.0
        level = self._level(is_high)
        if t - self._settled_at <= self._kick_limit():
            return level
        still = (
            f"stayed within {detector.band:g} of its rest {self.rest.mean:g}"
            if detector.band
            else f"stayed at {self.rest.mean:g}"
        )
        return self.end(
            State.FAILED,
            f"no response to the kick: the command was {level:g} instead of "
            f"{self._baseline:g} for {t - start:g} s, and the measurement {still}: check that "
            f"command and measurement belong to one loop, or give a larger amplitude",
        )

    def _kick_limit(self) -> float:
        if self._parameters.max_duration > 0.0:
            return math.inf
        return max(KICK_LIMIT, KICK_SETTLINGS * self._settled_at)

    # PROBE

    def _probe(self, detector: ResponseDetector, t: float, y: float) -> float:
        interval = max(self._response_time, _PROBE_SAMPLES * self._samples.interval)
        watch = DirectionWatch(interval, t, self.rest, detector.side)
        watch.add(t, y)
        self.state = State.PROBE
        looks = max(LAST_LOOK * interval, LAST_LOOK_SAMPLES * self._samples.interval)
        self._probe_ends = t + _BEYOND * looks
        self.answer = partial(self._find_direction, watch, t + interval)
        self.tell = partial(self._tell_probe, detector.side)
        return self._levels.high

    def _tell_probe(self, side: int, t: float, y: float) -> str:
        level, left = self._samples.command[-1], self._probe_ends - t
        return while_finding_direction(self._response_time, side, level, y, left)

    def _find_direction(
        self, watch: DirectionWatch, pulse_end: float, t: float, y: float
    ) -> float:
        sign = watch.add(t, y)
        if sign == 0:
            return self._levels.high if t < pulse_end else self._baseline
        if watch.remains < self.rest.noise_std:
            # The pulse left no deviation: noise had looked like a response.
            return self._kick()
        self._sign = sign
        return self._relay(doubtful=True)

    # RELAY

    def _relay(self, *, doubtful: bool) -> float:
        self.state = State.RELAY
        self._oscillation = Oscillation(
            self._parameters,
            self._baseline,
            self._samples,
            self._levels,
            self.rest,
            setpoint=self._setpoint,
            hysteresis=self._hysteresis,
            sign=self._sign,
            doubtful=doubtful,
            response_time=self._response_time,
            first_limit=self._kick_limit(),
            until_converged=self._until_converged,
        )
        self.answer, self.tell = self._follow, self._oscillation.tell
        return self._oscillation.command

    def _follow(self, t: float, y: float) -> float:
        oscillation = self._oscillation
        assert oscillation is not None
        command = oscillation.answer(t, y)
        if oscillation.verdict is None:
            return command
        outcome, reason = oscillation.verdict
        return self.end(_ENDS[outcome], reason)
