# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The relay experiment: it takes samples, answers with commands and records both."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ParameterError
from relay_autotune.experiment.faults import (
    FrozenWatch,
    ProportionalHold,
    SafePolicy,
    SampleCheck,
    SilenceWatch,
)
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.procedure import Procedure
from relay_autotune.experiment.samples import State
from relay_autotune.record.record import Outcome, Record

__all__ = ["ExperimentParameters", "RelayExperiment", "SafePolicy", "State"]

_BASELINE = SafePolicy()


class RelayExperiment(Procedure):
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

    :mod:`relay_autotune.experiment.procedure` has the states. In any state, :meth:`abort` and a
    measurement outside its limits end the experiment as ABORTED; an unusable sample, a frozen
    sensor and max_duration end it as FAILED. Bad data raise no exception: :attr:`reason` says why
    the experiment ended. There is no clock here: time comes with the samples, from any origin.

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
        super().__init__(
            parameters,
            baseline,
            until_converged=until_converged,
            from_small=from_small,
            before=before,
        )
        self.experiment_id = experiment_id
        self.safe_command = self.baseline if math.isnan(policy.command) else policy.command
        """Command after an abort or a failure, without proportional hold of the process [u]."""
        self._policy = policy
        self._hold: ProportionalHold | None = None
        self._frozen = FrozenWatch()
        self._silence = SilenceWatch()
        self._check = SampleCheck()
        self._origin = math.nan

    @property
    def finished(self) -> bool:
        """True once the experiment has ended, however it ended."""
        return self.state >= State.COMPLETED

    @property
    def outcome(self) -> Outcome:
        """How it ended: completed, aborted (on request or at a limit), failed; UNKNOWN before."""
        return Outcome[self.state.name] if self.finished else Outcome.UNKNOWN

    @property
    def reason(self) -> str:
        """Why it ended, a sentence for people; empty before."""
        if not self.why_ended:
            return ""
        reason, repeated = "; ".join((self.why_ended, *self.notes)), self._silence.repeated
        if not repeated:
            return reason
        told = f"{reason}; {repeated} samples repeat the one before, since the sensor was silent"
        silent = self._silence.silence
        if self.outcome is Outcome.COMPLETED or not silent > 0.0:
            return told
        return f"{told}, at the end for {silent:.3g} s: check it first"

    @property
    def status(self) -> str:
        """What it waits for and what it sees, or how it ended, a sentence for people."""
        trace = self.trace
        if self.finished:
            return f"{self.outcome.name.lower()}: {self.reason}"
        if not trace:
            return "waiting for the first measurement"
        return self._tell(trace.seen[-1], trace.measurement[-1])

    @property
    def sample_count(self) -> int:
        """Number of samples recorded."""
        return len(self.trace)

    @property
    def elapsed(self) -> float:
        """Time from the first sample to the last [s]."""
        return self.trace.time[-1] if self.trace else 0.0

    @property
    def cycles_left(self) -> int:
        """Estimated number of cycles until the end; at least 1 while it runs."""
        return max(self.parameters.min_cycles + 1 - self.cycle_count, 0 if self.finished else 1)

    @property
    def remaining(self) -> float:
        """Expected time until the end [s]; NaN before the first whole cycle."""
        if self.finished:
            return 0.0
        return self.cycles_left * self.cycles[-1].period if self.cycles else math.nan

    @property
    def progress(self) -> float:
        """Estimated part of the experiment that is done, from 0 to 1."""
        if self.state is State.RELAY:
            done = self.cycle_count
            return 0.1 + 0.9 * done / (done + self.cycles_left)
        return {State.SETTLING: 0.0, State.KICK: 0.05, State.PROBE: 0.05}.get(self.state, 1.0)

    def samples(self, first: int, stop: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return time [s], measurement [y] and command [u] of the samples first to stop - 1."""
        return self.trace.columns(first, stop)

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
        n = len(self.trace.command)
        time, measurement, command = self.trace.columns(0, n)
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
        trace = self.trace
        if self.finished:
            return self.after_end(measurement)
        last = trace.time[-1] if trace else -math.inf
        problem = self._check.problem(time, measurement, last, self._origin)
        if problem is not None:
            self.end(State.FAILED, problem)
            return self._ended(math.nan)
        if not trace:
            self._origin = float(time)
        t, y = float(time) - self._origin, float(measurement)
        trace.add(t, y)
        over = self._passes_limit(t, y) or self._is_dead(t, y, repeated=repeated)
        command = self.baseline if over else self._answer(trace.seen[-1], y)
        if self.state >= State.COMPLETED:
            command = self._ended(y)
        elif self.parameters.command_rate > 0.0:
            command = self._rate_limited(command)
        trace.command.append(command)
        return command

    def after_end(self, measurement: float) -> float:
        """Return the command that answers a measurement after the end [u].

        :param measurement: [y]; NaN: no measurement.
        """
        if self._hold is not None:
            return self._hold.command(measurement)
        if self.state is State.COMPLETED and not self._policy.give_back:
            return self.baseline
        return self.safe_command

    def conclude(self, reason: str) -> float:
        """Complete the experiment now, with the data so far; do nothing if it has ended.

        :param reason: why, for people.
        :returns: the command of :meth:`after_end` [u], to be sent now.
        :raises ParameterError: before the first half cycle, when too little is known.
        """
        if not self.finished:
            if self.switches < 2:
                raise ParameterError(
                    "an experiment cannot be completed before its first half cycle; abort it"
                )
            self.end(State.COMPLETED, reason)
            self._ended(math.nan)
        return self.after_end(self._last_measurement())

    def abort(self, reason: str, time: float | None = None) -> float:
        """End the experiment from outside; do nothing if it has ended already.

        :param reason: why, for people.
        :param time: when [s], on the axis of :meth:`step`; default: at the last sample.
        :returns: the command of :meth:`after_end` [u], to be sent now.
        """
        if not self.finished:
            at = self.elapsed if time is None or not self.trace else time - self._origin
            self.end(State.ABORTED, f"{reason} (at {at:.6g} s, {self._where()})")
            self._ended(math.nan)
        return self.after_end(self._last_measurement())

    def _last_measurement(self) -> float:
        return self.trace.measurement[-1] if self.trace else math.nan

    def _ended(self, measurement: float) -> float:
        if self._policy.hold and not self._policy.give_back:
            self._hold = ProportionalHold.after(self.settings, self.cycles, self._policy.gain)
        return self.after_end(measurement)

    def _rate_limited(self, wanted: float) -> float:
        samples = self.trace
        if len(samples) < 2:
            return wanted
        before = samples.command[-1]
        step = self.parameters.command_rate * (samples.time[-1] - samples.time[-2])
        return min(max(wanted, before - step), before + step)

    def _passes_limit(self, t: float, y: float) -> bool:
        """End the experiment if the last sample passes a limit; return True if it does."""
        p, resting = self.parameters, self.state is State.SETTLING
        if not p.measurement_min <= y <= p.measurement_max:
            self.end(
                State.ABORTED,
                f"the measurement {y:g} at {t:g} s is outside its limits, {p.measurement_min:g} "
                f"to {p.measurement_max:g}",
            )
        elif p.max_deviation > 0.0 and not resting and self._deviation(y) > p.max_deviation:
            self.end(
                State.ABORTED,
                f"the measurement {y:g} at {t:g} s is {self._deviation(y):g} away from the "
                f"set-point, more than max_deviation, {p.max_deviation:g}",
            )
        elif 0.0 < p.max_duration < t:
            self.end(
                State.FAILED,
                f"max_duration {p.max_duration:g} s was over {self._where()}: allow more time "
                f"or fewer cycles",
            )
        elif (seen := self.trace.seen[-1]) > self.latest:
            self.end(
                State.FAILED,
                f"the experiment was not over after {seen:.4g} s, longer than its parts may take, "
                f"{self._where()}: let the process rest and look at the recording first",
            )
        return self.finished

    def _is_dead(self, t: float, y: float, *, repeated: bool) -> bool:
        """End the experiment if the sensor is silent or frozen; return True if so."""
        if repeated:
            longest = max((cycle.period for cycle in self.cycles), default=math.inf)
            if self._silence.repeat(t, longest_cycle=longest):
                self.end(
                    State.FAILED,
                    f"the measurement does not respond any more: silent for "
                    f"{self._silence.silence:.3g} s, much longer than before, "
                    f"{self._where()}; check the sensor",
                )
            return self.finished
        self._silence.hear(t, relaying=self.state is State.RELAY)
        resting = self.state is State.SETTLING
        if self._frozen.add(y, at_rest=resting, in_cycles=bool(self.cycles)):
            self.end(
                State.FAILED,
                f"the sensor is frozen: its last {self._frozen.run} samples are all {y:g}, "
                f"{self._where()}; check the sensor",
            )
        return self.finished

    def _deviation(self, y: float) -> float:
        settings = self.settings
        return abs(y - settings.setpoint) if settings is not None else 0.0
