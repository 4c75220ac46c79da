"""The procedure of a relay experiment, state by state.

The states, the command in each of them, and what ends it::

    SETTLING   the baseline               steady, or settle_time over            -> KICK
    KICK       one level of the relay     response seen, sign of the gain given  -> RELAY
                                          response seen, sign unknown            -> PROBE
    PROBE      the high level for a       direction clear                        -> RELAY
               moment, then the baseline  nothing left of the response           -> KICK
    RELAY      the relay's                cycles agree, or max_cycles            -> COMPLETED

A part that takes too long leads to FAILED. What may end an experiment in any state, and leads to
ABORTED or FAILED, is not of the procedure but of :mod:`relay_autotune.relay`. In COMPLETED,
ABORTED and FAILED the command is the baseline, for good.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from functools import partial

from relay_autotune.cycles import next_cycle
from relay_autotune.kick import DirectionWatch, ResponseDetector
from relay_autotune.record import Cycle, RelaySettings
from relay_autotune.relay_law import Patience, Relay
from relay_autotune.relay_parameters import ExperimentParameters
from relay_autotune.samples import Samples
from relay_autotune.settling import NOT_SETTLED, RestState, Settling, rest_state

SETTLING_LIMIT = 600.0
"""Longest settling [s], where settle_time does not say; or 500 samples, if these take longer."""
SETTLING_SAMPLES = 500
KICK_LIMIT = 600.0
"""Longest wait for a response, and then for the first switch [s], where max_duration does not
say; or 50 times the settling, if that is longer."""
KICK_SETTLINGS = 50.0

# With fewer samples a line and a standard deviation mean nothing, whatever settle_time says.
_LEAST_SETTLING_SAMPLES = 5
# An interval of the probe has at least this many samples.
_PROBE_SAMPLES = 2
# A stay at the low level shorter than this part of the longest stay (less, in proportion to how
# unequally a biased relay pushes), or of half the time that the process took to respond, cannot be
# an answer of the process: it is noise at a switch, and no cycle begins after it.
_SHORT_STAY = 0.2

_SIGNS = {1: "positive", -1: "negative"}


class State(enum.IntEnum):
    """Where an experiment is."""

    SETTLING = 1
    KICK = 2
    PROBE = 3
    RELAY = 4
    COMPLETED = 5
    ABORTED = 6
    FAILED = 7


class Procedure:
    """Answer samples, one state after the other, until the procedure is over.

    Each state is a method that answers a sample, bound to what it alone needs.

    :param parameters: what the user set, valid.
    :param baseline: command of the operating point [u].
    :param samples: the samples so far; each is appended before it is answered.
    """

    def __init__(
        self, parameters: ExperimentParameters, baseline: float, samples: Samples
    ) -> None:
        self.state = State.SETTLING
        """The present state."""
        self.reason = ""
        """Why it ended, a sentence for people; empty before."""
        self.rest = NOT_SETTLED
        """The measurement at rest at the baseline."""
        self.sign = parameters.process_gain_sign
        """Sign of the process gain, 0 while unknown."""
        self.dead_time_seen = math.nan
        """Time from the kick to the last sample before the response [s]; NaN until it is seen."""
        self.cycle_start: list[int] = []
        """Index of the first sample of each cycle, the unfinished one included."""
        self.cycles: list[Cycle] = []
        """The whole cycles."""
        self.answer: Callable[[float, float], float] = partial(self._settle, Settling())
        """Take the time [s] and the measurement [y] of the last sample; return the command [u]."""

        self._parameters = parameters
        self._samples = samples
        self._baseline = baseline
        self._low = baseline + parameters.relay_bias - parameters.amplitude
        self._high = baseline + parameters.relay_bias + parameters.amplitude
        self._notes: list[str] = []
        self._settled_at = math.nan
        self._setpoint = math.nan
        self._hysteresis = math.nan
        self._response_time = math.nan

    @property
    def settings(self) -> RelaySettings | None:
        """What the relay does; None until the measurement has settled.

        While the sign of the process gain is not known, ``reverse_acting`` is False.
        """
        if not self.rest.samples:
            return None
        return RelaySettings(
            setpoint=self._setpoint,
            baseline=self._baseline,
            amplitude=self._parameters.amplitude,
            bias=self._parameters.relay_bias,
            hysteresis=self._hysteresis,
            sample_period=self._parameters.sample_period,
            reverse_acting=self.sign < 0,
        )

    def end(self, state: State, reason: str) -> float:
        """End the experiment; return the command that is safe.

        :param state: COMPLETED, ABORTED or FAILED.
        :param reason: why, a sentence for people.
        """
        self.state = state
        self.reason = "; ".join((reason, *self._notes))
        return self._baseline

    def where(self) -> str:
        """Return where the procedure is, to end a sentence with."""
        return {
            State.SETTLING: "while settling",
            State.KICK: f"while waiting for the measurement to leave its rest {self.rest.mean:g}",
            State.PROBE: "while finding the sign of the process gain",
        }.get(self.state, f"after {_count(len(self.cycles))}")

    # SETTLING

    def _settle(self, settling: Settling, t: float, _: float) -> float:
        n = len(self._samples)
        settle_time = self._parameters.settle_time
        if settle_time > 0.0:
            if t >= settle_time and n >= _LEAST_SETTLING_SAMPLES:
                return self._settled(self._rest_over_settle_time())
            return self._baseline
        if not settling.is_due(n):
            return self._baseline
        rest, settled = settling.look(*self._samples.columns(0, n)[:2])
        if settled:
            return self._settled(rest)
        if t > SETTLING_LIMIT and n >= SETTLING_SAMPLES and not self._parameters.max_duration:
            return self.end(
                State.FAILED,
                f"the measurement was not steady within {t:g} s, {rest}: wait until the process "
                f"is at rest, or give settle_time to start anyway",
            )
        return self._baseline

    def _rest_over_settle_time(self) -> RestState:
        """Take what there is: who gives a settle_time has decided that it is enough."""
        n = len(self._samples)
        rest = rest_state(*self._samples.columns(0, n)[:2], n)
        if not rest.is_steady:
            self._notes.append(f"the measurement was not steady after settle_time, {rest}")
        return rest

    def _settled(self, rest: RestState) -> float:
        p = self._parameters
        self.rest = rest
        self._settled_at = self._samples.time[-1]
        self._setpoint = rest.mean if math.isnan(p.setpoint) else p.setpoint
        self._hysteresis = p.hysteresis if p.hysteresis > 0.0 else 3.0 * rest.noise_std
        return self._kick()

    # KICK

    def _kick(self) -> float:
        t, y = self._samples.time[-1], self._samples.measurement[-1]
        # With the sign given, towards the set-point, if that is not where the measurement is.
        is_high = self.sign == 0 or self._relay_from(t, y).is_high
        level = self._high if is_high else self._low
        detector = ResponseDetector(self.rest, t)
        self.state = State.KICK
        self.answer = partial(self._await_response, detector, level, t)
        return level

    def _await_response(
        self, detector: ResponseDetector, level: float, start: float, t: float, y: float
    ) -> float:
        if detector.add(t, y):
            self.dead_time_seen = detector.last_inside - start
            self._response_time = detector.first_outside - start
            if self.sign == 0:
                return self._probe(detector, t, y)
            return self._relay(t, y, doubtful=False)
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
        self.answer = partial(self._find_direction, watch, t + interval)
        return self._high

    def _find_direction(
        self, watch: DirectionWatch, pulse_end: float, t: float, y: float
    ) -> float:
        sign = watch.add(t, y)
        if sign == 0:
            return self._high if t < pulse_end else self._baseline
        if watch.remains < self.rest.noise_std:
            # The pulse left nothing behind: noise had looked like a response.
            return self._kick()
        self.sign = sign
        return self._relay(t, y, doubtful=True)

    # RELAY

    def _relay(self, t: float, y: float, *, doubtful: bool) -> float:
        p = self._parameters
        relay = self._relay_from(t, y)
        patience = Patience(p.amplitude, p.relay_bias)
        patience.learn(self._response_time, self._samples.interval)
        if p.hysteresis > 0.0 or not math.isnan(p.setpoint):
            # How far the first switch is from the rest is then the user's choice, and the time
            # to respond says nothing of it.
            patience.limit = self._kick_limit()
        self.state = State.RELAY
        self.answer = partial(self._follow, relay, patience, doubtful)
        return self._high if relay.is_high else self._low

    def _relay_from(self, t: float, y: float) -> Relay:
        return Relay(self.sign, self._setpoint, self._hysteresis, t, y)

    def _follow(
        self, relay: Relay, patience: Patience, doubtful: bool, t: float, y: float
    ) -> float:
        if relay.update(t, y):
            patience.learn(relay.last_stay, self._samples.interval)
            if relay.is_high and not self._is_noise(relay):
                return self._begin_cycle()
        elif t - relay.since > patience.limit:
            return self._no_return(doubtful, t, y)
        return self._high if relay.is_high else self._low

    def _is_noise(self, relay: Relay) -> bool:
        p = self._parameters
        balance = (p.amplitude - abs(p.relay_bias)) / (p.amplitude + abs(p.relay_bias))
        longest = max(balance * relay.longest_stay, 0.5 * self._response_time)
        return relay.last_stay < _SHORT_STAY * longest

    def _begin_cycle(self) -> float:
        self.cycle_start.append(len(self._samples) - 1)
        if len(self.cycle_start) > 1:
            self.cycles.append(self._cycle_that_ended())
            if self.cycles[-1].converged:
                return self._complete(
                    f"{len(self.cycles)} cycles, of which the last {self._parameters.min_cycles} "
                    f"agree within {self._parameters.cycle_tolerance:g} of half period and "
                    f"amplitude, noise and sample interval allowed for"
                )
            if len(self.cycles) >= self._parameters.max_cycles:
                return self._complete(
                    f"max_cycles, {self._parameters.max_cycles}, reached; the last "
                    f"{self._parameters.min_cycles} do not agree within "
                    f"{self._parameters.cycle_tolerance:g} of half period and amplitude"
                )
        return self._high

    def _cycle_that_ended(self) -> Cycle:
        first, last = self.cycle_start[-2:]
        time, measurement, command = self._samples.columns(first, last + 1)
        return next_cycle(
            self.cycles,
            time,
            measurement,
            command,
            middle=self._baseline + self._parameters.relay_bias,
            reverse_acting=self.sign < 0,
            noise_std=self.rest.noise_std,
            min_cycles=self._parameters.min_cycles,
            tolerance=self._parameters.cycle_tolerance,
        )

    def _complete(self, reason: str) -> float:
        disturbed = sum(cycle.disturbed for cycle in self.cycles)
        if disturbed:
            self._notes.append(f"{disturbed} of the cycles have a long gap in their samples")
        return self.end(State.COMPLETED, reason)

    def _no_return(self, doubtful: bool, t: float, y: float) -> float:
        """Fail, or, if the sign was found by the probe and no cycle bears it out, reverse it."""
        if doubtful and not self.cycles:
            self._notes.append(
                f"the process gain was first taken for {_SIGNS[self.sign]}: the measurement did "
                f"not come back; give process_gain_sign to spare the process that"
            )
            self.sign = -self.sign
            self.cycle_start.clear()
            return self._relay(t, y, doubtful=False)
        return self.end(
            State.FAILED,
            f"no oscillation {self.where()}: the measurement is {y:g} and did not come back to "
            f"{self._setpoint:g} -/+ {self._hysteresis:g} in time: the amplitude may be too small "
            f"for the hysteresis or the set-point, a load may have come, or process_gain_sign "
            f"(taken as {_SIGNS[self.sign]}) may be wrong",
        )


def _count(cycles: int) -> str:
    return f"{cycles} whole cycle{'' if cycles == 1 else 's'}"
