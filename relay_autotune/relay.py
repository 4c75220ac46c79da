"""The relay experiment: a state machine fed with samples, answering with commands.

The states, the command in each of them, and what ends it::

    SETTLING   the baseline               steady, or settle_time over            -> KICK
    KICK       one level of the relay     response seen, sign of the gain given  -> RELAY
                                          response seen, sign unknown            -> PROBE
    PROBE      the high level for a       direction clear                        -> RELAY
               moment, then the baseline  nothing left of the response           -> KICK
    RELAY      the relay's                cycles agree, or max_cycles            -> COMPLETED

From each of them: :meth:`RelayExperiment.abort`, or a measurement outside its limits, leads to
ABORTED; a sample that cannot be used, or a part that takes too long, to FAILED. In COMPLETED,
ABORTED and FAILED the command is the baseline, for good.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from relay_autotune.cycles import next_cycle
from relay_autotune.kick import DirectionWatch, ResponseDetector
from relay_autotune.record import Cycle, FloatArray, Outcome, Record, RelaySettings
from relay_autotune.relay_law import Patience, Relay
from relay_autotune.relay_parameters import PARAMETERS, ExperimentParameters, Parameter
from relay_autotune.samples import Samples
from relay_autotune.settling import NOT_SETTLED, RestState, Settling, rest_state

__all__ = ["PARAMETERS", "ExperimentParameters", "Parameter", "RelayExperiment", "State"]

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
# A stay at the low level shorter than this part of the time that the process took to respond
# cannot be an answer of the process: it is noise at a switch, and no cycle begins after it.
_SHORT_STAY = 0.5
# Numbers beyond this overflow when squared, and are no measurements of anything.
_LARGEST = 1e100
# So many samples with one and the same time come from a clock that stands still.
_LONGEST_REPEAT = 10_000


class State(enum.IntEnum):
    """Where an experiment is."""

    SETTLING = 1
    KICK = 2
    PROBE = 3
    RELAY = 4
    COMPLETED = 5
    ABORTED = 6
    FAILED = 7


_OUTCOMES = {
    State.COMPLETED: Outcome.COMPLETED,
    State.ABORTED: Outcome.ABORTED,
    State.FAILED: Outcome.FAILED,
}

_SIGNS = {1: "positive", -1: "negative"}


class RelayExperiment:
    """Run one relay experiment: call :meth:`step` for each measurement, send what it returns.

    The experiment has no clock; time comes in with the samples, on any origin. It does not raise
    on bad data: it ends, and :attr:`reason` says why.

    :param parameters: what the user set.
    :param baseline: command of the operating point [u], which is also the safe command.
    :param experiment_id: the id that the record will carry.
    :raises ParameterError: if a parameter is out of range, or some contradict each other.
    """

    def __init__(
        self, parameters: ExperimentParameters, baseline: float, experiment_id: str = ""
    ) -> None:
        parameters.validate(baseline)
        self.parameters = parameters
        self.experiment_id = experiment_id
        self.safe_command = float(baseline)
        self._low = baseline + parameters.relay_bias - parameters.amplitude
        self._high = baseline + parameters.relay_bias + parameters.amplitude

        self._samples = Samples()
        self._origin = math.nan
        self._repeats = 0

        # Each state is a method that answers a sample, bound to what it alone needs.
        self._state = State.SETTLING
        self._answer: Callable[[float, float], float] = partial(self._settle, Settling())
        self._reason = ""
        self._notes: list[str] = []

        self._rest = NOT_SETTLED
        self._settled_at = math.nan
        self._setpoint = math.nan
        self._hysteresis = math.nan
        self._sign = parameters.process_gain_sign
        self._dead_time = math.nan
        self._response_time = math.nan
        self._cycle_start: list[int] = []
        self._cycles: list[Cycle] = []

    @property
    def state(self) -> State:
        """Where the experiment is."""
        return self._state

    @property
    def finished(self) -> bool:
        """True once the experiment has ended, however it ended."""
        return self._state in _OUTCOMES

    @property
    def outcome(self) -> Outcome:
        """How it ended: completed; aborted by someone or by a limit; failed; UNKNOWN before."""
        return _OUTCOMES.get(self._state, Outcome.UNKNOWN)

    @property
    def reason(self) -> str:
        """Why it ended, a sentence for people; empty before."""
        return self._reason

    @property
    def settings(self) -> RelaySettings | None:
        """What the relay does; None until the measurement has settled.

        While the sign of the process gain is not known, ``reverse_acting`` is False.
        """
        if not self._rest.samples:
            return None
        return RelaySettings(
            setpoint=self._setpoint,
            baseline=self.safe_command,
            amplitude=self.parameters.amplitude,
            bias=self.parameters.relay_bias,
            hysteresis=self._hysteresis,
            sample_period=self.parameters.sample_period,
            reverse_acting=self._sign < 0,
        )

    @property
    def noise_std(self) -> float:
        """Standard deviation of the measurement at rest [y]; NaN until it has settled."""
        return self._rest.noise_std

    @property
    def rest_measurement(self) -> float:
        """Mean measurement at rest at the baseline [y]; NaN until it has settled."""
        return self._rest.mean

    @property
    def dead_time_seen(self) -> float:
        """Time from the kick to the last sample before the response [s]; NaN until it is seen.

        Without noise the dead time lies between this and one sample interval more. With noise
        this is longer, by the time that the response takes to leave the noise band.
        """
        return self._dead_time

    @property
    def process_gain_sign(self) -> int:
        """1 or -1 as given or found; 0 while unknown."""
        return self._sign

    @property
    def cycles(self) -> tuple[Cycle, ...]:
        """The whole cycles so far."""
        return tuple(self._cycles)

    @property
    def cycle_count(self) -> int:
        """Number of whole cycles so far."""
        return len(self._cycles)

    @property
    def cycle_start(self) -> tuple[int, ...]:
        """Index of the first sample of each cycle, see :class:`~relay_autotune.record.Record`."""
        return tuple(self._cycle_start)

    @property
    def sample_count(self) -> int:
        """Number of samples recorded."""
        return len(self._samples)

    @property
    def elapsed(self) -> float:
        """Time from the first sample to the last [s]."""
        return self._samples.time[-1] if self._samples else 0.0

    @property
    def progress(self) -> float:
        """How much of the experiment is done, from 0 to 1, as far as one can tell."""
        if self._state is State.RELAY:
            done = len(self._cycles)
            left = max(self.parameters.min_cycles + 1 - done, 1)
            return 0.1 + 0.9 * done / (done + left)
        return {State.SETTLING: 0.0, State.KICK: 0.05, State.PROBE: 0.05}.get(self._state, 1.0)

    def samples(self, first: int, stop: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return time [s], measurement [y] and command [u] of the samples first to stop - 1."""
        return self._samples.columns(first, stop)

    def record(
        self,
        receive_time: Sequence[float] | FloatArray | None = None,
        command_time: Sequence[float] | FloatArray | None = None,
        start: float = 0.0,
        lost_samples: int = 0,
    ) -> Record:
        """Return all that was recorded so far, whether or not the experiment has ended.

        The sample that ended it is the last one, if it was a number at a possible time; the
        samples after the end are not recorded.

        :param receive_time: when each sample arrived [s], on the relay's clock, counted from the
            time of the first sample; entries beyond the samples recorded are dropped.
        :param command_time: when each answer left [s], likewise.
        :param start: time of the first sample [s since the epoch].
        :param lost_samples: samples that the middleware is known to have lost.
        :raises RecordError: if there is no sample.
        """
        n = len(self._samples)
        time, measurement, command = self._samples.columns(0, n)
        return Record(
            time=time,
            measurement=measurement,
            command=command,
            receive_time=np.array([] if receive_time is None else receive_time[:n]),
            command_time=np.array([] if command_time is None else command_time[:n]),
            settings=self.settings,
            noise_std=self.noise_std,
            cycle_start=self.cycle_start,
            outcome=self.outcome,
            reason=self._reason,
            experiment_id=self.experiment_id,
            start=start,
            lost_samples=lost_samples,
        )

    def step(self, time: float, measurement: float) -> float:
        """Take one sample and return the command that answers it.

        :param time: when the sample was taken [s], on any origin; equal times are allowed.
        :param measurement: the sample [y].
        :returns: the command [u]; after the end always the baseline.
        """
        if self._state in _OUTCOMES:
            return self.safe_command
        problem = self._unusable(time, measurement)
        if problem is not None:
            return self._end(State.FAILED, problem)
        samples = self._samples
        if not samples:
            self._origin = float(time)
        t, y = float(time) - self._origin, float(measurement)
        samples.time.append(t)
        samples.measurement.append(y)
        p = self.parameters
        if not p.measurement_min <= y <= p.measurement_max:
            command = self._limit_passed(t, y)
        elif 0.0 < p.max_duration < t:
            command = self._too_long()
        else:
            command = self._answer(t, y)
        samples.command.append(command)
        return command

    def abort(self, reason: str, time: float | None = None) -> float:
        """End the experiment from outside; do nothing if it has ended already.

        :param reason: why, for people.
        :param time: when [s], on the axis of :meth:`step`; default: at the last sample.
        :returns: the safe command, to be sent now.
        """
        if self.finished:
            return self.safe_command
        at = self.elapsed if time is None or not self._samples else time - self._origin
        return self._end(State.ABORTED, f"{reason} (at {at:.6g} s, {self._where()})")

    # What ends an experiment in any state.

    def _end(self, state: State, reason: str) -> float:
        self._state = state
        self._reason = "; ".join((reason, *self._notes))
        return self.safe_command

    def _unusable(self, time: float, measurement: float) -> str | None:
        """Say why a sample cannot be used; None if it can."""
        samples = self._samples
        if not -_LARGEST < measurement < _LARGEST:
            return (
                f"the measurement after {len(samples)} samples is {measurement:g}, expected a "
                f"finite number: check the sensor"
            )
        if not -_LARGEST < time < _LARGEST:
            return f"the time after {len(samples)} samples is {time:g} s, expected a finite number"
        if not samples:
            return None
        last, t = samples.time[-1], float(time) - self._origin
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

    def _limit_passed(self, t: float, y: float) -> float:
        p = self.parameters
        return self._end(
            State.ABORTED,
            f"the measurement {y:g} at {t:g} s is outside its limits, {p.measurement_min:g} to "
            f"{p.measurement_max:g}",
        )

    def _too_long(self) -> float:
        return self._end(
            State.FAILED,
            f"max_duration {self.parameters.max_duration:g} s was over {self._where()}: allow "
            f"more time or fewer cycles",
        )

    def _where(self) -> str:
        return {
            State.SETTLING: "while settling",
            State.KICK: "while waiting for a response to the kick",
            State.PROBE: "while finding the sign of the process gain",
        }.get(self._state, f"after {len(self._cycles)} whole cycles")

    # SETTLING

    def _settle(self, settling: Settling, t: float, _: float) -> float:
        n = len(self._samples)
        settle_time = self.parameters.settle_time
        if settle_time > 0.0:
            if t >= settle_time and n >= _LEAST_SETTLING_SAMPLES:
                return self._settled(self._rest_over_settle_time())
            return self.safe_command
        if not settling.is_due(n):
            return self.safe_command
        rest, settled = settling.look(*self._samples.columns(0, n)[:2])
        if settled:
            return self._settled(rest)
        if t > SETTLING_LIMIT and n >= SETTLING_SAMPLES:
            return self._end(
                State.FAILED,
                f"the measurement was not steady within {t:g} s, {rest}: wait until the process "
                f"is at rest, or give settle_time to start anyway",
            )
        return self.safe_command

    def _rest_over_settle_time(self) -> RestState:
        """Take what there is: who gives a settle_time has decided that it is enough."""
        n = len(self._samples)
        rest = rest_state(*self._samples.columns(0, n)[:2], n)
        if not rest.is_steady:
            self._notes.append(f"the measurement was not steady after settle_time, {rest}")
        return rest

    def _settled(self, rest: RestState) -> float:
        p = self.parameters
        self._rest = rest
        self._settled_at = self.elapsed
        self._setpoint = rest.mean if math.isnan(p.setpoint) else p.setpoint
        self._hysteresis = p.hysteresis if p.hysteresis > 0.0 else 3.0 * rest.noise_std
        return self._kick()

    # KICK

    def _kick(self) -> float:
        t, y = self._samples.time[-1], self._samples.measurement[-1]
        # With the sign given, towards the set-point, if that is not where the measurement is.
        is_high = self._sign == 0 or self._relay_from(t, y).is_high
        level = self._high if is_high else self._low
        detector = ResponseDetector(self._rest, t)
        self._state = State.KICK
        self._answer = partial(self._await_response, detector, level, t, len(self._samples) - 1)
        return level

    def _await_response(
        self,
        detector: ResponseDetector,
        level: float,
        start: float,
        first: int,
        t: float,
        y: float,
    ) -> float:
        if detector.add(t, y):
            self._dead_time = detector.last_inside - start
            self._response_time = detector.first_outside - start
            if self._sign == 0:
                return self._probe(detector, start, first)
            return self._relay(t, y, doubtful=False)
        if t - start <= self._kick_limit():
            return level
        still = (
            f"stayed within {detector.band:g} of its rest {self._rest.mean:g}"
            if detector.band
            else f"stayed at {self._rest.mean:g}"
        )
        return self._end(
            State.FAILED,
            f"no response to the kick: the command was {level:g} instead of "
            f"{self.safe_command:g} for {t - start:g} s, and the measurement {still}: check that "
            f"command and measurement belong to one loop, or give a larger amplitude",
        )

    def _kick_limit(self) -> float:
        return max(KICK_LIMIT, KICK_SETTLINGS * self._settled_at)

    # PROBE

    def _probe(self, detector: ResponseDetector, start: float, first: int) -> float:
        time, measurement, _ = self._samples.columns(first, len(self._samples))
        interval = max(self._response_time, _PROBE_SAMPLES * self._samples.interval)
        watch = DirectionWatch(interval, start, self._rest, detector.side)
        for t, y in zip(time, measurement, strict=True):
            watch.add(float(t), float(y))
        self._state = State.PROBE
        self._answer = partial(self._find_direction, watch, detector.band, start + 2.0 * interval)
        return self._high

    def _find_direction(
        self, watch: DirectionWatch, band: float, pulse_end: float, t: float, y: float
    ) -> float:
        watch.add(t, y)
        sign = watch.verdict()
        if sign == 0:
            return self._high if t < pulse_end else self.safe_command
        if watch.largest <= band:
            # The pulse left nothing behind: noise had looked like a response.
            return self._kick()
        self._sign = sign
        return self._relay(t, y, doubtful=True)

    # RELAY

    def _relay(self, t: float, y: float, *, doubtful: bool) -> float:
        p = self.parameters
        relay = self._relay_from(t, y)
        patience = Patience(p.amplitude, p.relay_bias)
        patience.learn(self._response_time, self._samples.interval)
        if p.hysteresis > 0.0 or not math.isnan(p.setpoint):
            # How far the first switch is from the rest is then the user's choice, and the time
            # to respond says nothing of it.
            patience.limit = self._kick_limit()
        self._state = State.RELAY
        self._answer = partial(self._follow, relay, patience, doubtful)
        return self._high if relay.is_high else self._low

    def _relay_from(self, t: float, y: float) -> Relay:
        return Relay(self._sign, self._setpoint, self._hysteresis, t, y)

    def _follow(
        self, relay: Relay, patience: Patience, doubtful: bool, t: float, y: float
    ) -> float:
        if relay.update(t, y):
            patience.learn(relay.last_stay, self._samples.interval)
            if relay.is_high and relay.last_stay >= _SHORT_STAY * self._response_time:
                return self._begin_cycle()
        elif t - relay.since > patience.limit:
            return self._no_return(doubtful, t, y)
        return self._high if relay.is_high else self._low

    def _begin_cycle(self) -> float:
        self._cycle_start.append(len(self._samples) - 1)
        if len(self._cycle_start) > 1:
            self._cycles.append(self._cycle_that_ended())
            if self._cycles[-1].converged:
                return self._complete(
                    f"{len(self._cycles)} cycles, of which the last {self.parameters.min_cycles} "
                    f"agree within {self.parameters.cycle_tolerance:g} of half period and "
                    f"amplitude, noise and sample interval allowed for"
                )
            if len(self._cycles) >= self.parameters.max_cycles:
                return self._complete(
                    f"max_cycles, {self.parameters.max_cycles}, reached; the last "
                    f"{self.parameters.min_cycles} do not agree within "
                    f"{self.parameters.cycle_tolerance:g} of half period and amplitude"
                )
        return self._high

    def _cycle_that_ended(self) -> Cycle:
        first, last = self._cycle_start[-2:]
        time, measurement, command = self._samples.columns(first, last + 1)
        return next_cycle(
            self._cycles,
            time,
            measurement,
            command,
            middle=self.safe_command + self.parameters.relay_bias,
            reverse_acting=self._sign < 0,
            noise_std=self.noise_std,
            min_cycles=self.parameters.min_cycles,
            tolerance=self.parameters.cycle_tolerance,
        )

    def _complete(self, reason: str) -> float:
        disturbed = sum(cycle.disturbed for cycle in self._cycles)
        if disturbed:
            self._notes.append(f"{disturbed} of the cycles have a long gap in their samples")
        return self._end(State.COMPLETED, reason)

    def _no_return(self, doubtful: bool, t: float, y: float) -> float:
        """Fail, or, if the sign was found by the probe and no cycle bears it out, reverse it."""
        if doubtful and not self._cycles:
            self._notes.append(
                f"the process gain was first taken for {_SIGNS[self._sign]}: the measurement did "
                f"not come back; give process_gain_sign to spare the process that"
            )
            self._sign = -self._sign
            self._cycle_start.clear()
            return self._relay(t, y, doubtful=False)
        return self._end(
            State.FAILED,
            f"no oscillation {self._where()}: the measurement is {y:g} and did not come back to "
            f"{self._setpoint:g} -/+ {self._hysteresis:g} in time: the amplitude may be too small "
            f"for the hysteresis or the set-point, a load may have come, or process_gain_sign "
            f"(taken as {_SIGNS[self._sign]}) may be wrong",
        )
