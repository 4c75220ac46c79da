# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""One experiment in relay_node: its time base, its stamps and its messages."""

from __future__ import annotations

import array
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

# numpy imports this at its first median; load it now, since it takes 20 ms in a tune.
import numpy.ma

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import RecordError
from relay_autotune.exchange.messages import (
    fill_cycle,
    fill_experiment,
    fill_settings,
    fill_whys,
    set_stamp,
    start_seconds,
)
from relay_autotune.experiment.early_end import EarlyEnd
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.faults import ClockWatch
from relay_autotune.experiment.phases import State
from relay_autotune.nodes.goals import TuneGoal
from relay_autotune.nodes.quality import QUIET_AFTER_GO
from relay_autotune.nodes.recording import Recording, Sample
from relay_autotune.record.record import Record, RelaySettings
from relay_autotune_msgs.msg import RelayCycle
from relay_autotune_msgs.msg import RelayExperiment as ExperimentMessage

# A measurement waits no longer than this for its callback, unless a clock was set back [ns].
_LONGEST_WAIT_NS = 1_000_000_000


class Session:
    """A relay experiment fed with the samples of a topic.

    The time of a sample is the first of these that applies: ``k * sample_period`` for sample k, if
    the experiment has a sample period; the node's clock, if it is simulated; the time of arrival,
    if samples are repeated, so that samples and repeats are on one clock; the middleware's source
    stamp.

    :param experiment: the state machine.
    :param recording: of it.
    :param clock: the simulated clock [ns]; None: time is real.
    :param repeats: True if a measurement is a sample again while the sensor is silent.
    :param one_clock: True if the stamp of a sample is the time of the command, too.
    :param goal: of the action; None: the service has started it.
    """

    def __init__(
        self,
        experiment: RelayExperiment,
        recording: Recording,
        *,
        clock: Callable[[], int] | None = None,
        repeats: bool = False,
        one_clock: bool = False,
        goal: TuneGoal | None = None,
    ) -> None:
        self.experiment = experiment
        self.goal = goal
        self.id = experiment.experiment_id
        self.recording = recording
        self.start_ns = 0
        self.published_cycles = 0
        self.published_state = State.SETTLING
        self.early: EarlyEnd | None = None
        """Ends the experiment once an interval is narrow enough; None: not used."""
        self.lost_samples = 0
        self._step = experiment.step
        self._period = experiment.parameters.sample_period
        self._clock = clock
        self._one_clock = one_clock
        self.sample_count = 0
        """Number of samples answered."""
        self._last = (0, 0, 0.0, 0.0)
        self._first_answer_ns = 0
        self._repeats, self._repeated_ns = repeats, 0
        self.may_be_no_repeat = False
        self._received_ns = array.array("q")
        self._sent_ns = array.array("q")
        self.clocks = ClockWatch()

    def answer(self, measurement: float, source: int | None, received: int | None) -> float | None:
        """Take a measurement; return the command, or None for no answer.

        :param measurement: [y].
        :param source: when it was measured [ns]; None: not known.
        :param received: when it arrived [ns]; None: not known.
        """
        if self._period > 0.0:
            return self._answer_by_number(measurement, source)
        received = received or time.time_ns()
        if self._clock is not None:
            source = received = self._clock()
        elif self._repeats:
            if 0 < self._repeated_ns - received < _LONGEST_WAIT_NS:
                # The message waited in the queue while the value before it was repeated.
                received = self._repeated_ns
            source = received
        else:
            source = source or received
            if self._one_clock:
                # A simulated robot's clock may run at another pace than ours.
                received = source
        command = self._answer_at(received, source, measurement, self._step)
        start = self.start_ns
        stepped = self.clocks.add((source - start) * 1e-9, (received - start) * 1e-9)
        if stepped is not None:
            command = self.experiment.abort(stepped)
            self._last = (received, source, measurement, command)
        return command

    def repeat(self, measurement: float, ago: float = 0.0) -> float:
        """Take the last measurement for a sample again; return the command.

        :param measurement: the sensor's last value, possibly from before the tune [y].
        :param ago: age of the repeated sample [s].
        """
        now = self._repeated_ns = self.now_ns() - round(1e9 * ago)
        return self._answer_at(now, now, measurement, self.experiment.repeat)

    def now_ns(self) -> int:
        """Return the present time on the clock of the experiment [ns]."""
        return time.time_ns() if self._clock is None else self._clock()

    def answered(self) -> None:
        """Note that the last answer was sent; to be called right after sending."""
        received, source, measurement, command = self._last
        if self._period > 0.0 or self._one_clock:
            # Sample number and period, or the stamps, are the only clock of such an experiment.
            received = sent = source
        elif self._clock is not None:
            sent = self._clock()
        else:
            sent = time.time_ns()
        self._received_ns.append(received)
        self._sent_ns.append(sent)
        self._hand_on((received, source, measurement, sent, command))

    def _hand_on(self, sample: Sample) -> None:
        self.recording.sample(sample)

    def record(self) -> Record:
        """Return the whole record.

        :raises RecordError: if there was no sample.
        """
        received = (np.array(self._received_ns) - self.start_ns) * 1e-9
        sent = (np.array(self._sent_ns) - self.start_ns) * 1e-9
        by_number = self._period > 0.0
        return self.experiment.record(
            receive_time=None if by_number else received,
            command_time=None if by_number else sent,
            start=start_seconds(self.start_ns),
            lost_samples=self.lost_samples,
        )

    def cycle_message(self, index: int) -> RelayCycle:
        """Return the message of a finished cycle.

        :param index: number of the cycle.
        """
        experiment = self.experiment
        first, stop = experiment.cycle_start[index], experiment.cycle_start[index + 1] + 1
        begin = 0 if index == 0 else first
        columns = experiment.samples(begin, stop)
        message = RelayCycle()
        fill_cycle(
            message,
            experiment.cycles[index],
            settings=experiment.settings,
            experiment_id=self.id,
            start_ns=self.start_ns,
            time=columns[0],
            measurement=columns[1],
            command=columns[2],
            lead_in=first - begin,
        )
        return message

    def message(self, *, arrays: bool = True) -> ExperimentMessage:
        """Return the message of the whole record.

        :param arrays: False: a summary, without the samples.
        """
        experiment = self.experiment
        message = ExperimentMessage()
        try:
            fill_experiment(message, self.record(), arrays=arrays)
        except RecordError:
            # The tune ended before its first sample: an outcome, but no record.
            fill_settings(message.settings, experiment.settings)
            message.experiment_id = self.id
            message.outcome = int(experiment.outcome)
            message.reason = experiment.reason
            fill_whys(message, experiment.why)
            message.noise_std = math.nan
        if self.sample_count:
            set_stamp(message.header.stamp, self.start_ns)
        if self.early is not None:
            message.sought, message.sought_width = self.early.sought, self.early.wanted
        return message

    def facts(self, lost: int) -> dict[str, object]:
        """Return what /diagnostics tells of the running tune, by name.

        :param lost: samples that the middleware has lost so far.
        """
        experiment = self.experiment
        return {
            "state": experiment.state.name.lower(),
            "experiment": self.id,
            "cycles": experiment.cycle_count,
            "noise standard deviation": experiment.noise_std,
            "samples": self.sample_count,
            "lost samples": lost,
            "clock drift [s]": self.clocks.drift,
        }

    def _answer_at(
        self, received: int, source: int, measurement: float, step: Callable[[float, float], float]
    ) -> float:
        """Take a sample with its stamps [ns]; return the command."""
        if self.sample_count == 0:
            self.start_ns = source
        self.sample_count += 1
        # Relative to the first sample: a float of seconds since 1970 cannot hold microseconds.
        command = step((source - self.start_ns) * 1e-9, measurement)
        self._last = (received, source, measurement, command)
        return command

    def _answer_by_number(self, measurement: float, source: int | None) -> float | None:
        k = self.sample_count
        if k == 0:
            self.start_ns = source or time.time_ns()
        elif k == 1 and self._is_repeat(measurement, source):
            return None
        self.sample_count = k + 1
        sampled = k * self._period
        command: float = self._step(sampled, measurement)
        stamp = self.start_ns + round(sampled * 1e9)
        self._last = (stamp, stamp, measurement, command)
        if k == 0:
            self._first_answer_ns = time.time_ns()
        return command

    def _is_repeat(self, measurement: float, source: int | None) -> bool:
        if source is None:
            return False
        since_answer = (source - self._first_answer_ns) * 1e-9
        if since_answer < 0.0:
            return True
        crossed = measurement == self._last[2] and since_answer < 0.5 * QUIET_AFTER_GO
        self.may_be_no_repeat = crossed
        return crossed

    def answer_after_all(self) -> float | None:
        """Answer the sample that `answer` dropped as a repeat, if no sample has followed."""
        if not self.may_be_no_repeat or self.sample_count != 1:
            return None
        self.may_be_no_repeat = False
        return self._answer_by_number(self._last[2], None)


# A relay experiment on the set-point: the present loop stays closed.


class SetpointSession(Session):
    """A session whose record holds the controller's commands, not the set-points.

    The controller answers a sample after the relay has seen it. So the command of a sample is
    known only at the next sample.

    :param actual: returns the last command to the actuator [u].
    """

    def __init__(self, *args: Any, actual: Callable[[], float], **options: Any) -> None:
        super().__init__(*args, **options)
        self._actual = actual
        self._commands: list[float] = []
        self._last_sample: Sample | None = None

    def _hand_on(self, sample: Sample | None) -> None:
        if self._last_sample is not None:
            command = self._actual()
            self._commands.append(command)
            super()._hand_on((*self._last_sample[:4], command))
        self._last_sample = sample

    def record(self) -> Record:
        """Return the record, with the controller's commands.

        While the experiment runs, the answer to the last sample may be missing; the previous
        command stands in for it.

        :raises RecordError: if there was no sample.
        """
        if self.experiment.finished:
            self._hand_on(None)
        record = super().record()
        commands = np.array(self._commands[: len(record)])
        if commands.size < len(record):
            commands = np.append(commands, np.full(len(record) - commands.size, self._actual()))
        settings = record.settings
        if settings is not None:
            settings = _settings_of(settings, commands, record)
        return replace(record, command=commands, settings=settings)


def _settings_of(settings: RelaySettings, commands: FloatArray, record: Record) -> RelaySettings:
    moved = np.flatnonzero(record.command != record.command[0])
    before = commands[: max(moved[0], 1)] if moved.size else commands[:1]
    rest = float(before.mean())
    low, high = float(commands.min()), float(commands.max())
    return replace(
        settings,
        baseline=rest,
        amplitude=0.5 * (high - low) or math.ulp(rest),
        bias=0.5 * (high + low) - rest,
        reverse_acting=False,
    )
