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

import math
from collections.abc import Callable, Sequence
from functools import partial

from relay_autotune.experiment.oscillation import Oscillation
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.relay_law import Relay
from relay_autotune.experiment.samples import Run, State
from relay_autotune.experiment.settling import (
    LAST_LOOK,
    LAST_LOOK_SAMPLES,
    NOISE_SAMPLES,
    DirectionWatch,
    ResponseDetector,
    RestState,
    RestWatch,
    Settling,
    rest_state,
)
from relay_autotune.text import duration

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


# Cycles that a tune usually takes beyond those that must agree.
_USUAL_EXTRA = 2
SMALL_CYCLES = 2
"""Oscillations that a given amplitude takes longer where it begins small: one, and the way on."""


class Procedure(Run):
    """Answer samples, one state after the other, until the procedure is over.

    Each state is a method that answers a sample, bound to the data that only this state needs.

    :param parameters: the user's parameters, valid.
    :param baseline: command of the operating point [u].
    :param until_converged: False: agreement of the cycles does not end it.
    :param from_small: True: a given amplitude begins at a quarter of that.
    :param before: measurements before the first command, where the baseline is the present command
        [y]; None: the baseline may lead the process elsewhere.
    """

    def __init__(
        self,
        parameters: ExperimentParameters,
        baseline: float,
        *,
        until_converged: bool = True,
        from_small: bool = False,
        before: Sequence[float] | None = None,
    ) -> None:
        super().__init__(parameters, baseline, from_small=from_small)
        settling = Settling()
        self._answer: Callable[[float, float], float] = partial(self._settle, settling)
        """Take the last sample, its time without gaps [s] and the measurement [y]; return the
        command [u]."""
        self._tell: Callable[[float, float], str] = partial(self._tell_settling, settling)
        """Say what the present state waits for and sees, after the same sample."""

        self._until_converged = until_converged
        self._watch = None if before is None else RestWatch(before)
        self._oscillation: Oscillation | None = None
        self._settled_at = math.nan
        self._grow_after = math.inf
        self._probe_ends = math.inf

    @property
    def latest(self) -> float:
        """Deadline of the present part, from the first sample, gaps not counted [s].

        It grows when a part begins, or takes longer than before; an experiment beyond it has
        failed. Infinite if only max_duration limits the part.
        """
        if self._oscillation is not None:
            return self._oscillation.latest
        if self.state is State.PROBE:
            return self._probe_ends
        if self.state is State.KICK:
            return self._settled_at + _BEYOND * self._kick_limit()
        if self.parameters.max_duration > 0.0:
            return math.inf
        return _BEYOND * (self._settling_limit() + self.parameters.settle_time)

    def _settling_limit(self) -> float:
        return max(SETTLING_LIMIT, SETTLING_SAMPLES * self.trace.interval)

    def _where(self) -> str:
        """Return the present state as the end of a sentence."""
        return {
            State.SETTLING: "while settling",
            State.KICK: f"while waiting for the measurement to leave its rest {self.rest.mean:g}",
            State.PROBE: "while finding the sign of the process gain",
        }.get(self.state, f"after {self.counted}")

    # SETTLING

    def _settle(self, settling: Settling, t: float, y: float) -> float:
        n = len(self.trace)
        if self._watch is not None and (told := self._watch.leaves(y)):
            return self.end(
                State.FAILED,
                f"{told}, {t:.3g} s after {self.baseline:g} u was commanded: {self.baseline:g} "
                f"u is not the present command, or a load came; set the command at which the "
                f"process rests",
            )
        settle_time = self.parameters.settle_time
        if settle_time > 0.0:
            if t >= settle_time and n >= _LEAST_SETTLING_SAMPLES:
                return self._settled(self._rest_over_settle_time())
            return self.baseline
        if not settling.is_due(n):
            return self.baseline
        rest, settled = settling.look(*self.trace.columns(0, n)[:2])
        # A constant measurement may not have responded to a wrong baseline yet.
        if settled and (self._watch is None or n >= NOISE_SAMPLES):
            return self._settled(rest)
        if t > SETTLING_LIMIT and n >= SETTLING_SAMPLES and not self.parameters.max_duration:
            return self.end(
                State.FAILED,
                f"the measurement was not steady within {t:g} s, {rest}: wait until the process "
                f"is at rest, or give settle_time to start anyway",
            )
        return self.baseline

    def _tell_settling(self, settling: Settling, t: float, _: float) -> str:
        p, interval, rest = self.parameters, self.trace.interval, settling.rest
        if p.settle_time > 0.0:
            return f"settling, {duration(t)} of {duration(p.settle_time)}"
        end = settling.expected_end(interval)
        about = f" of about {duration(end)}" if end > t else ""
        told = f"settling, {duration(t)}{about}"
        if not rest.samples or rest.is_steady:
            count = round(t / interval) + 1 if interval > 0.0 else 1
            return f"{told}: sample {count} of at least {NOISE_SAMPLES} for the noise"
        told += f": still {rest.motion}"
        if about:
            return told
        limit = p.max_duration or self._settling_limit()
        return f"{told}, not slower than before; it may take {duration(limit)} in all"

    def _rest_over_settle_time(self) -> RestState:
        """Accept the rest after settle_time, because the user chose that time."""
        n = len(self.trace)
        rest = rest_state(*self.trace.columns(0, n)[:2], n)
        if not rest.is_steady:
            self.notes.append(f"the measurement was not steady after settle_time, {rest}")
        return rest

    def _settled(self, rest: RestState) -> float:
        p = self.parameters
        self.rest = rest
        if self._watch is not None and (told := self._watch.moved_to(rest.mean)):
            self.notes.append(
                f"{told} under the baseline {self.baseline:g} u: look whether that is the "
                f"present command"
            )
        self._settled_at = self.trace.seen[-1]
        self.kicked_at = self.trace.time[-1]
        self.setpoint = rest.mean if math.isnan(p.setpoint) else p.setpoint
        self.hysteresis = p.hysteresis if p.hysteresis > 0.0 else 3.0 * rest.noise_std
        return self._kick()

    # KICK

    def _kick(self) -> float:
        t, y = self.trace.seen[-1], self.trace.measurement[-1]
        # With a given sign, kick towards the set-point, unless the measurement is already there.
        is_high = self.process_gain_sign == 0 or self._starts_high(t, y)
        detector = ResponseDetector(self.rest, t)
        self.state = State.KICK
        patience = _PATIENT if self.levels.from_small else 1.0
        self._grow_after = patience * max(
            _GROWTH_SETTLINGS * self._settled_at, _GROWTH_SAMPLES * self.trace.interval
        )
        self._answer = partial(self._await_response, detector, is_high, t)
        self._tell = partial(self._tell_kick, detector.band, is_high, t)
        return self._level(is_high)

    def _tell_kick(self, band: float, is_high: bool, start: float, t: float, y: float) -> str:
        limit = self._settled_at + self._kick_limit() - start
        wait = f", for {duration(limit)} at most" if math.isfinite(limit) else ""
        return (
            f"stepped to {self._level(is_high):g}, no response after {duration(t - start)}: the "
            f"measurement {y:.6g} is to leave {self.rest.mean:.6g} -/+ {band:.2g}{wait}"
        )

    def _level(self, is_high: bool) -> float:
        return self.levels.high if is_high else self.levels.low

    def _starts_high(self, t: float, y: float) -> bool:
        return Relay(self.process_gain_sign, self.setpoint, self.hysteresis, t, y).is_high

    def _await_response(
        self, detector: ResponseDetector, is_high: bool, start: float, t: float, y: float
    ) -> float:
        if detector.add(t, y):
            self.dead_time_seen = detector.last_inside - start
            self.response_time = detector.first_outside - start
            if self.levels.from_small:
                self.levels.begin_small()
            elif self.levels.can_grow:
                # A response that only just exceeds the noise says too little.
                self.levels.grow()
            if self.process_gain_sign == 0:
                return self._probe(detector, t, y)
            return self._relay(doubtful=False)
        if self.levels.can_grow and t - start >= self._grow_after:
            self.levels.grow()
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
            f"{self.baseline:g} for {t - start:g} s, and the measurement {still}: check that "
            f"command and measurement belong to one loop, or give a larger amplitude",
        )

    def _kick_limit(self) -> float:
        if self.parameters.max_duration > 0.0:
            return math.inf
        return max(KICK_LIMIT, KICK_SETTLINGS * self._settled_at)

    # PROBE

    def _probe(self, detector: ResponseDetector, t: float, y: float) -> float:
        interval = max(self.response_time, _PROBE_SAMPLES * self.trace.interval)
        watch = DirectionWatch(interval, t, self.rest, detector.side)
        watch.add(t, y)
        self.state = State.PROBE
        looks = max(LAST_LOOK * interval, LAST_LOOK_SAMPLES * self.trace.interval)
        self._probe_ends = t + _BEYOND * looks
        self._answer = partial(self._find_direction, watch, t + interval)
        self._tell = partial(self._tell_probe, detector.side)
        return self.levels.high

    def _tell_probe(self, side: int, t: float, y: float) -> str:
        return (
            f"the measurement went {'up' if side > 0 else 'down'} after "
            f"{duration(self.response_time)}; at {self.trace.command[-1]:g} it is {y:.6g}, and "
            f"shows whether it stays on that side, for "
            f"{duration(max(self._probe_ends - t, 0.0))} at most"
        )

    def _find_direction(
        self, watch: DirectionWatch, pulse_end: float, t: float, y: float
    ) -> float:
        sign = watch.add(t, y)
        if sign == 0:
            return self.levels.high if t < pulse_end else self.baseline
        if watch.remains < self.noise_std:
            # The pulse left no deviation: noise had looked like a response.
            if self.levels.from_small:
                self.levels.begin_larger()
            return self._kick()
        self.process_gain_sign = sign
        return self._relay(doubtful=True)

    # RELAY

    def _relay(self, *, doubtful: bool) -> float:
        self.state = State.RELAY
        self._oscillation = Oscillation(
            self,
            doubtful=doubtful,
            first_limit=self._kick_limit(),
            until_converged=self._until_converged,
        )
        self._answer, self._tell = self._oscillation.answer, self._oscillation.tell
        return self._oscillation.command


def how_long(
    parameters: ExperimentParameters, interval: float, limit: float, *, from_small: bool = False
) -> str:
    """Say how long a tune may take, before it begins.

    :param parameters: the experiment's parameters.
    :param interval: mean interval of the samples [s]; 0: not known.
    :param limit: longest settling [s].
    :param from_small: whether a given amplitude begins at a quarter of that.
    """
    if parameters.settle_time > 0.0:
        settles = f"{duration(parameters.settle_time)} at rest"
    else:
        least = NOISE_SAMPLES * interval
        settles = f"{duration(least)} or more" if least > 0.0 else "some time"
        settles += f" until the measurement is steady, {duration(limit)} at most"
    usual = parameters.min_cycles + _USUAL_EXTRA + from_small * SMALL_CYCLES
    told = f"it takes {settles}, then one step and about {usual} oscillations of the loop"
    if parameters.max_duration > 0.0:
        return f"{told}, {duration(parameters.max_duration)} at most in all"
    return told
