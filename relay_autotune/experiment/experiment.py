# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The relay experiment: it takes samples, answers with commands and records both.

The states, the command in each of them, and what leads from one to the next::

    SETTLING   the baseline               steady, or settle_time over            -> KICK
    KICK       one level of the relay     response seen, sign of the gain given  -> RELAY
                                          response seen, sign unknown            -> PROBE
    PROBE      the high level for a       direction clear                        -> RELAY
               moment, then the baseline  nothing left of the response           -> KICK
    RELAY      the relay's                cycles agree, or max_cycles            -> COMPLETED

In any state, a watch of the list below, a part that takes too long, or a request from outside
leads to ABORTED or FAILED. In these and in COMPLETED the command is that of the policy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ParameterError
from relay_autotune.experiment.faults import (
    FrozenWatch,
    SafePolicy,
    SilenceWatch,
    proportional_hold,
)
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import (
    Facts,
    Kick,
    Probe,
    Run,
    Settle,
    State,
)
from relay_autotune.experiment.relay_law import Levels
from relay_autotune.experiment.switching import Switching
from relay_autotune.reasons import NONE, Code, Reason, Value, other
from relay_autotune.record.record import Cycle, Outcome, Record, RelaySettings

_BASELINE = SafePolicy()

Phase = Settle | Kick | Probe | Switching
"""A state of an experiment, with the data that only this state needs.

``command`` answers the sample with which it begins [u], ``latest`` is its deadline, gaps not
counted [s], inf: max_duration alone limits it; ``where`` is the state as the end of a sentence.
``answer`` takes the last sample, its time without gaps [s] and the measurement [y]; ``status``
says what it waits for and sees, after the same sample.
"""

# How an experiment ends by its reason; for any other it has failed.
_ENDS = {
    Code.OUTSIDE_LIMITS: State.ABORTED,
    Code.TOO_FAR: State.ABORTED,
    Code.CYCLES_AGREE: State.COMPLETED,
    Code.MAX_CYCLES: State.COMPLETED,
}

_PHASES: Mapping[State, Callable[[Run], Phase]] = {
    State.KICK: Kick,
    State.PROBE: Probe,
    State.RELAY: Switching,
}


class RelayExperiment:
    """Run one relay experiment: call :meth:`step` for each measurement and send its command.

    >>> from relay_autotune import (
    ...     ExperimentParameters, RelayExperiment, TransferFunction, VirtualProcess)
    >>> oven = VirtualProcess(
    ...     TransferFunction.fopdt(1.65, 20.0, 10.0), rest_measurement=40.0, rest_command=2.0)
    >>> test = RelayExperiment(ExperimentParameters(amplitude=1.0), baseline=2.0)
    >>> t = 0.0
    >>> while not test.finished:
    ...     oven.command(test.step(t, oven.measure(t)))
    ...     t += 0.2
    >>> test.outcome.name, test.cycle_count
    ('COMPLETED', 3)
    >>> record = test.record()

    Bad data raise no exception: :attr:`why` and :attr:`reason` say why the experiment ended. There
    is no clock here: time comes with the samples, from any origin.

    :param parameters: the user's parameters.
    :param baseline: command of the operating point [u].
    :param experiment_id: the id that the record will carry.
    :param policy: how the process is left at the end.
    :param until_converged: False: cycles that agree do not end it, but :meth:`conclude` or
        max_cycles does.
    :param from_small: True: a given amplitude begins at a quarter for a cycle, and the experiment
        fails if the measurement swings no wider at the full amplitude: the actuator is then at
        its ends. It has no effect where the experiment finds the amplitude.
    :param before: the last measurements before it [y], where the baseline is the present command:
        it fails if the measurement leaves that rest while settling. None: the baseline may lead
        the process to another operating point.
    :raises ParameterError: if a parameter is out of range, or some contradict each other.
    """

    def __init__(
        self,
        parameters: ExperimentParameters,
        baseline: float,
        experiment_id: str = "",
        *,
        policy: SafePolicy = _BASELINE,
        until_converged: bool = True,
        from_small: bool = False,
        before: Sequence[float] | None = None,
    ) -> None:
        parameters.validate(baseline)
        self.parameters = parameters
        self.baseline = float(baseline)
        self.experiment_id = experiment_id
        self.safe_command = self.baseline if math.isnan(policy.command) else policy.command
        """Command after an abort or a failure, without proportional hold of the process [u]."""
        self.state = State.SETTLING
        """The present state."""
        self._levels = Levels(parameters, self.baseline, from_small=from_small)
        self._run = Run(parameters, self.baseline, until_converged, self._levels)
        self._run.facts.sign = parameters.process_gain_sign
        self._trace = self._run.trace
        self._phase: Phase = Settle(self._run, before)
        self._why = NONE
        self.policy = policy
        """How the process is left at the end."""
        self._hold: Callable[[float], float] | None = None
        self._frozen = FrozenWatch()
        self._silence = SilenceWatch()

    # What is known of it.

    @property
    def facts(self) -> Facts:
        """What has been found so far."""
        return self._run.facts

    @property
    def cycles(self) -> tuple[Cycle, ...]:
        """The whole cycles so far."""
        return self._run.cycles

    @property
    def cycle_start(self) -> tuple[int, ...]:
        """Index of the first sample of each cycle, as in a record."""
        return self._run.cycle_start

    @property
    def switches(self) -> int:
        """Number of switches of the relay so far; two of them are a half cycle."""
        return self._run.switches

    @property
    def is_tried(self) -> bool:
        """True unless it is not known yet whether the actuator follows the levels."""
        return self._run.is_tried

    @property
    def latest(self) -> float:
        """Deadline of the present state, from the first sample, gaps not counted [s].

        It grows when a state begins, or takes longer than before; an experiment beyond it has
        failed. Infinite if only max_duration limits the state.
        """
        return self._phase.latest

    @property
    def settings(self) -> RelaySettings | None:
        """The relay's settings; None until the measurement has settled.

        While the sign of the process gain is not known, ``reverse_acting`` is False.
        """
        facts = self.facts
        if not facts.rest.samples:
            return None
        return RelaySettings(
            setpoint=facts.setpoint,
            baseline=self.baseline,
            amplitude=self._levels.amplitude,
            bias=self._levels.bias,
            hysteresis=facts.hysteresis,
            extra_delay=self.parameters.extra_delay,
            sample_period=self.parameters.sample_period,
            reverse_acting=facts.sign < 0,
        )

    @property
    def noise_std(self) -> float:
        """Standard deviation of the measurement at rest [y]; NaN until it has settled."""
        return self.facts.rest.noise_std

    @property
    def cycle_count(self) -> int:
        """Number of whole cycles so far."""
        return len(self.cycles)

    @property
    def finished(self) -> bool:
        """True once the experiment has ended, however it ended."""
        return self.state >= State.COMPLETED

    @property
    def outcome(self) -> Outcome:
        """How it ended: completed, aborted (on request or at a limit), failed; UNKNOWN before."""
        return Outcome[self.state.name] if self.finished else Outcome.UNKNOWN

    @property
    def why(self) -> Reason:
        """Why it ended, with notes; its code is NONE before."""
        if not self._why:
            return NONE
        notes, silent = [*self._run.notes], self._silence.silence
        if repeated := self._silence.repeated:
            at_end = self.outcome is not Outcome.COMPLETED and silent > 0.0
            notes.append(
                Code.NOTE_REPEATED(samples=repeated, **({"silence": silent} if at_end else {}))
            )
        return self._why.plus(*notes)

    @property
    def reason(self) -> str:
        """Why it ended, a sentence for people; empty before."""
        return str(self.why)

    @property
    def status(self) -> str:
        """What it waits for and what it sees, or how it ended, a sentence for people."""
        if self.finished:
            return f"{self.outcome.name.lower()}: {self.reason}"
        if not self._trace:
            return "waiting for the first measurement"
        return self._phase.status(*self._run.now)

    @property
    def sample_count(self) -> int:
        """Number of samples recorded."""
        return len(self._trace)

    @property
    def elapsed(self) -> float:
        """Time from the first sample to the last [s]."""
        return self._trace.time[-1] if self._trace else 0.0

    @property
    def cycles_left(self) -> int:
        """Estimated number of cycles until the end; at least 1 while it runs."""
        return max(self.parameters.min_cycles + 1 - self.cycle_count, 0 if self.finished else 1)

    @property
    def remaining(self) -> float:
        """Expected time until the end [s]; NaN before the first whole cycle."""
        if self.finished:
            return 0.0
        if not self.cycles:
            return math.nan
        last = self.cycles[-1]
        return max(last.start + (1 + self.cycles_left) * last.period - self.elapsed, 0.0)

    @property
    def progress(self) -> float:
        """Estimated part of the experiment that is done, from 0 to 1."""
        if self.state is State.RELAY:
            done = self.cycle_count
            return 0.1 + 0.9 * done / (done + self.cycles_left)
        return {State.SETTLING: 0.0, State.KICK: 0.05, State.PROBE: 0.05}.get(self.state, 1.0)

    def samples(self, first: int, stop: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return time [s], measurement [y] and command [u] of the samples first to stop - 1."""
        return self._trace.columns(first, stop)

    def record(
        self,
        receive_time: Sequence[float] | FloatArray | None = None,
        command_time: Sequence[float] | FloatArray | None = None,
        start: float = 0.0,
        lost_samples: int = 0,
    ) -> Record:
        """Return the record so far, also while the experiment runs.

        The last sample is the one that ended the experiment, if it was usable; samples after the
        end are not recorded.

        :param receive_time: when each sample arrived [s], on the relay's clock, counted from the
            time of the first sample; entries beyond the samples recorded are dropped.
        :param command_time: when each answer left [s], likewise.
        :param start: time of the first sample [s since the epoch].
        :param lost_samples: samples that the middleware is known to have lost.
        :raises RecordError: if there is no sample.
        """
        # If the caller raised while a sample was being answered, that sample has no answer.
        n = len(self._trace.command)
        time, measurement, command = self._trace.columns(0, n)
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
            reason=self.reason,
            why=self.why,
            experiment_id=self.experiment_id,
            start=start,
            lost_samples=lost_samples,
        )

    def step(self, time: float, measurement: float) -> float:
        """Take one sample and return the command that answers it.

        :param time: when the sample was taken [s], on any origin; equal times are allowed.
        :param measurement: the sample [y].
        :returns: the command [u]; after the end the command of :meth:`after_end`.
        """
        return self._take(time, measurement, repeated=False)

    def repeat(self, time: float, measurement: float) -> float:
        """Take the last measurement again as a sample, because the sensor was silent.

        For a sensor that publishes only on change, silence means that the value is the same. The
        record holds the sample like any other.

        :param time: the present time [s], on the axis of :meth:`step`.
        :param measurement: the sensor's last value [y].
        :returns: as :meth:`step`.
        """
        return self._take(time, measurement, repeated=True)

    def _take(self, time: float, measurement: float, *, repeated: bool) -> float:
        trace = self._trace
        if self.finished:
            return self.after_end(measurement)
        if (problem := trace.add(time, measurement)) is not None:
            return self._end(State.FAILED, problem, math.nan)
        t, y = trace.time[-1], trace.measurement[-1]
        end = self._passes_limit(t, y) or self._is_dead(t, y, repeated=repeated)
        found = end or self._phase.answer(trace.seen[-1], y)
        if isinstance(found, State):
            self.state = found
            self._phase = _PHASES[found](self._run)
            found = self._phase.command
        if isinstance(found, Reason):
            command = self._end(_ENDS.get(found.code, State.FAILED), found, y)
        else:
            command = self._rate_limited(found)
        trace.command.append(command)
        return command

    def after_end(self, measurement: float) -> float:
        """Return the command that answers a measurement after the end [u].

        :param measurement: [y]; NaN: no measurement.
        """
        if self._hold is not None:
            return self._hold(measurement)
        if self.state is State.COMPLETED and not self.policy.give_back:
            return self.baseline
        return self.safe_command

    def conclude(self, reason: Reason | str) -> float:
        """Complete the experiment now, with the data so far; do nothing if it has ended.

        :param reason: why; a sentence stands for a reason without a code.
        :returns: the command of :meth:`after_end` [u], to be sent now.
        :raises ParameterError: before the first half cycle, when too little is known.
        """
        if not self.finished:
            if self.switches < 2:
                raise ParameterError(
                    "an experiment cannot be completed before its first half cycle; abort it"
                )
            self._end(State.COMPLETED, _reason(reason), math.nan)
        return self.after_end(self._last_measurement())

    def abort(self, reason: Reason | str, time: float | None = None) -> float:
        """End the experiment from outside; do nothing if it has ended already.

        :param reason: why; a sentence stands for a reason without a code.
        :param time: when [s], on the axis of :meth:`step`; default: at the last sample.
        :returns: the command of :meth:`after_end` [u], to be sent now.
        """
        if not self.finished:
            at = self.elapsed if time is None or not self._trace else time - self._trace.origin
            why = _reason(reason).plus(ended_at=at, where=self._phase.where)
            self._end(State.ABORTED, why, math.nan)
        return self.after_end(self._last_measurement())

    def _last_measurement(self) -> float:
        return self._trace.measurement[-1] if self._trace else math.nan

    def _end(self, state: State, why: Reason, measurement: float) -> float:
        """End the experiment; return the command that answers a measurement [u]."""
        self.state, self._why = state, why
        if self.policy.hold and not self.policy.give_back:
            self._hold = proportional_hold(self.settings, self.cycles, self.policy.gain)
        return self.after_end(measurement)

    def _rate_limited(self, wanted: float) -> float:
        samples, rate = self._trace, self.parameters.command_rate
        if rate == 0.0 or len(samples) < 2:
            return wanted
        before = samples.command[-1]
        step = rate * (samples.time[-1] - samples.time[-2])
        return min(max(wanted, before - step), before + step)

    @property
    def _moved_by(self) -> dict[str, Value]:
        """What has moved the process, for the reason at a limit."""
        if self.state is State.SETTLING:
            return {"baseline": self.baseline}
        return {"amplitude": self._levels.amplitude}

    # The watches of every state.

    def _passes_limit(self, t: float, y: float) -> Reason | None:
        """Return a reason to end if the last sample passes a limit."""
        p = self.parameters
        low, high = p.measurement_min, p.measurement_max
        if not low <= y <= high:
            return Code.OUTSIDE_LIMITS(value=y, time=t, low=low, high=high, **self._moved_by)
        if p.max_deviation > 0.0 and (away := abs(y - self.facts.setpoint)) > p.max_deviation:
            most = p.max_deviation
            return Code.TOO_FAR(value=y, time=t, away=away, most=most, **self._moved_by)
        if 0.0 < p.max_duration < t:
            return Code.MAX_DURATION(limit=p.max_duration, where=self._phase.where)
        if (seen := self._trace.seen[-1]) > self._phase.latest:
            return Code.TOO_LONG(time=seen, where=self._phase.where)
        return None

    def _is_dead(self, t: float, y: float, *, repeated: bool) -> Reason | None:
        """Return a reason to end if the sensor is silent or frozen."""
        if repeated:
            longest = max((cycle.period for cycle in self.cycles), default=math.inf)
            if not self._silence.repeat(t, longest_cycle=longest):
                return None
            return Code.SILENT_TOO_LONG(silence=self._silence.silence, where=self._phase.where)
        self._silence.hear(t, relaying=self.state is State.RELAY)
        resting = self.state is State.SETTLING
        if not self._frozen.add(y, at_rest=resting, in_cycles=bool(self.cycles)):
            return None
        return Code.FROZEN_SENSOR(samples=self._frozen.run, value=y, where=self._phase.where)


def _reason(reason: Reason | str) -> Reason:
    return other(reason) if isinstance(reason, str) else reason
