# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""One experiment in relay_node: its time base, its stamps, its messages and its recording.

The bag is opened at the start, and closed once model and gains are in it. A thread writes it, so
that no callback waits for a disk.
"""

from __future__ import annotations

import array
import contextlib
import itertools
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

# numpy imports this at its first median; load it now, since it takes 20 ms in a tune.
import numpy.ma
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.timer import Timer

from relay_autotune.arrays import FloatArray
from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.errors import ParameterError, RecordError
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
from relay_autotune.nodes.lifetime import STEADY
from relay_autotune.nodes.live_types import reader_of
from relay_autotune.nodes.quality import QUIET_AFTER_GO, for_bag
from relay_autotune.record.record import Record, RelaySettings
from relay_autotune.text import duration
from relay_autotune_msgs.msg import RelayCycle
from relay_autotune_msgs.msg import RelayExperiment as ExperimentMessage

# A measurement waits no longer than this for its callback, unless a clock was set back [ns].
_LONGEST_WAIT_NS = 1_000_000_000

# When a sample was received and measured [ns], the measurement, when it was answered [ns], and by
# which command.
_Sample = tuple[int, int, float, int, float]


class Session:
    """A relay experiment fed with the samples of a topic.

    The time of a sample is the first of these that applies: ``k * sample_period`` for sample k, if
    a sample period is given; the node's clock, if it is simulated; the time of arrival, if samples
    are repeated, so that samples and repeats are on one clock; the middleware's source stamp.

    :param experiment: the state machine.
    :param experiment_id: the id that every message of the experiment carries.
    :param sample_period: period of the samples [s]; 0: they are stamped.
    :param clock: the simulated clock [ns]; None: time is real.
    :param repeats: True if a measurement is a sample again while the sensor is silent.
    :param one_clock: True if the stamp of a sample is the time of the command, too.
    """

    def __init__(
        self,
        experiment: RelayExperiment,
        experiment_id: str,
        *,
        sample_period: float = 0.0,
        clock: Callable[[], int] | None = None,
        repeats: bool = False,
        one_clock: bool = False,
    ) -> None:
        self.experiment = experiment
        self.id = experiment_id
        self.start_ns = 0
        self.published_cycles = 0
        self.told_state = State.SETTLING
        self.early: EarlyEnd | None = None
        """Ends the experiment once an interval is narrow enough; None: not used."""
        self.lost_samples = 0
        self._step = experiment.step
        self._period = sample_period
        self._clock = clock
        self._one_clock = one_clock
        self.sample_count = 0
        """Number of samples answered."""
        self._last = (0, 0, 0.0, 0.0)
        self._first_answer_ns = 0
        self._repeated_ns = 0
        self.may_be_no_repeat = False
        self._received_ns = array.array("q")
        self._sent_ns = array.array("q")
        self.clocks = ClockWatch()
        self.sample: Callable[[_Sample], None] | None = None
        """Takes each sample and its answer, once the answer is out; None: nobody does."""
        if sample_period > 0.0:
            self.answer = self._answer_by_number
        elif clock is not None:
            self.answer = self._answer_by_clock
        elif repeats:
            self.answer = self._answer_by_arrival
        else:
            self.answer = self._answer_by_stamp

    answer: Callable[[float, int | None, int | None], float | None]
    """Take a measurement, when it was measured and when it arrived [ns]; None: not known. Return
    the command, or None for no answer."""

    @property
    def has_news(self) -> bool:
        """True if a cycle or a state is not told yet, or the early end must be checked."""
        experiment = self.experiment
        if experiment.cycle_count != self.published_cycles:
            return True
        if experiment.state is not self.told_state:
            return True
        return self.early is not None and self.early.is_due(experiment)

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

    def _hand_on(self, sample: _Sample) -> None:
        if self.sample is not None:
            self.sample(sample)

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

    def _answer_by_stamp(
        self, measurement: float, source: int | None, received: int | None
    ) -> float:
        received = received or time.time_ns()
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

    def _answer_by_arrival(self, measurement: float, _: int | None, received: int | None) -> float:
        received = received or time.time_ns()
        if 0 < self._repeated_ns - received < _LONGEST_WAIT_NS:
            # The message waited in the queue while the value before it was repeated.
            received = self._repeated_ns
        return self._answer_at(received, received, measurement, self._step)

    def _answer_by_clock(self, measurement: float, *_: int | None) -> float:
        now = self.now_ns()
        return self._answer_at(now, now, measurement, self._step)

    def _answer_by_number(
        self, measurement: float, source: int | None, _: int | None = None
    ) -> float | None:
        k = self.sample_count
        if k == 0:
            self.start_ns = source or time.time_ns()
        elif k == 1 and self._repeats(measurement, source):
            return None
        self.sample_count = k + 1
        sampled = k * self._period
        command: float = self._step(sampled, measurement)
        stamp = self.start_ns + round(sampled * 1e9)
        self._last = (stamp, stamp, measurement, command)
        if k == 0:
            self._first_answer_ns = time.time_ns()
        return command

    def _repeats(self, measurement: float, source: int | None) -> bool:
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


def reported_by(values: Mapping[str, Any]) -> Callable[[Any], float] | None:
    """Return what reads the controller's command from the measurement's messages.

    :param values: the fixed parameters of relay_node.
    :return: None: these messages do not have it.
    :raises ParameterError: if they cannot have it, or nothing is done with it.
    """
    field = values["controller_command_field"]
    if not field:
        return None
    if values["relay_on"] != "setpoint" or values["path"] != "passthrough":
        raise ParameterError(
            f"controller_command_field is {field!r}, which is for relay_on setpoint with path "
            f"passthrough: found {values['relay_on']} and {values['path']}"
        )
    return reader_of(values["measurement_type"], field, "controller_command_field").value


class SetpointSession(Session):
    """A session whose record holds the controller's commands, not the set-points.

    The controller answers a sample after the relay has seen it. So the command of a sample is
    known only at the next sample.

    :param actual: returns the last command to the actuator [u].
    """

    def __init__(self, *args: Any, actual: Callable[[], float], **options: Any) -> None:
        super().__init__(*args, **options)
        self._actual = actual
        self._told: list[float] = []
        self._last_sample: _Sample | None = None

    def _hand_on(self, sample: _Sample | None) -> None:
        if self._last_sample is not None:
            told = self._actual()
            self._told.append(told)
            super()._hand_on((*self._last_sample[:4], told))
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
        told = np.array(self._told[: len(record)])
        if told.size < len(record):
            told = np.append(told, np.full(len(record) - told.size, self._actual()))
        settings = record.settings
        if settings is not None:
            settings = _settings_of(settings, told, record)
        return replace(record, command=told, settings=settings)


def _settings_of(settings: RelaySettings, told: FloatArray, record: Record) -> RelaySettings:
    moved = np.flatnonzero(record.command != record.command[0])
    rest = float(told[: moved[0]].mean()) if moved.size and moved[0] > 0 else float(told[0])
    low, high = float(told.min()), float(told.max())
    return replace(
        settings,
        baseline=rest,
        amplitude=0.5 * (high - low) or math.ulp(rest),
        bias=0.5 * (high + low) - rest,
        reverse_acting=False,
    )


# Flush interval: the longest part that a killed process can lose [s].
FLUSH_PERIOD = 0.5

# The thread writes PORTION samples at a time and then yields the interpreter to the relay [s].
PORTION = 8
PAUSE = 5e-4

# Load the writer now, and not in the thread of the first experiment.
with contextlib.suppress(ImportError):
    import mcap.writer  # noqa: F401


class Recorder:
    """Record an experiment; any error becomes a sentence in `failure`, never an exception.

    :param path: the folder to create.
    :param topics: the topics to record; the first is the measurement, the second the command.
    :param start_ns: the present time [ns since the epoch].
    :param facts: facts about the bag, for its metadata.
    """

    def __init__(
        self, path: Path, topics: Sequence[Topic], *, start_ns: int, facts: Mapping[str, str]
    ) -> None:
        self.path = path
        self.failure: str | None = None
        self._topics = tuple(topics)
        self._measurement, self._command = (topic.name for topic in self._topics[:2])
        self._start_ns = start_ns
        self._facts = dict(facts)
        self._samples: SimpleQueue[_Sample] = SimpleQueue()
        self._messages: SimpleQueue[tuple[str, int, Any]] = SimpleQueue()
        self.opened = threading.Event()
        """Set once the folder was created or could not be."""
        self._closing = threading.Event()
        self._finished: Callable[[], object] = bool
        # Looked up once, because it is called for each sample.
        self.sample = self._samples.put
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    sample: Any
    """Record ``(receive_ns, source_ns, measurement, command_ns, command)``."""

    def message(self, topic: str, time_ns: int, message: Any) -> None:
        """Record another message, which must not be changed afterwards.

        :param topic: resolved name of one of the topics given at the start.
        :param time_ns: when it was sent or received [ns since the epoch].
        :param message: the message.
        """
        self._messages.put((topic, time_ns, message))

    def close(self, finished: Callable[[], None]) -> None:
        """Request the end of the bag; returns at once.

        :param finished: called by the recorder's thread once the bag is complete.
        """
        self._finished = finished
        self._closing.set()

    def join(self, timeout: float) -> bool:
        """Wait until the bag is finished, for ``timeout`` seconds at most; True if it is."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            writer = BagWriter(
                self.path, self._topics, start_ns=self._start_ns, custom=self._facts
            )
            self.opened.set()
            # Sleep for a period: a wake-up for each sample would compete with the relay.
            while not self._closing.wait(FLUSH_PERIOD):
                self._drain(writer)
            self._drain(writer)
            writer.close()
            self._finished()
        except Exception as error:  # noqa: BLE001  a recorder must not end an experiment
            told = str(error) or type(error).__name__
            self.failure = told if self.opened.is_set() else f"not recorded: {told}"
            self.opened.set()
            # Nothing is written after a failure, so the queues are emptied.
            while not self._closing.wait(FLUSH_PERIOD):
                self._discard()

    def _drain(self, writer: BagWriter) -> None:
        with contextlib.suppress(Empty):
            for count in itertools.count(1):
                received, source, measurement, sent, command = self._samples.get_nowait()
                writer.write(self._measurement, received, source, encode_float64(measurement))
                writer.write(self._command, sent, sent, encode_float64(command))
                if count % PORTION == 0 and not self._closing.is_set():
                    time.sleep(PAUSE)
        with contextlib.suppress(Empty):
            while True:
                topic, time_ns, message = self._messages.get_nowait()
                writer.write(topic, time_ns, time_ns, serialize_message(message))
        writer.flush()

    def _discard(self) -> None:
        for queue in (self._samples, self._messages):
            with contextlib.suppress(Empty):
                while True:
                    queue.get_nowait()


MESSAGES = {
    "relay_cycle": "relay_autotune_msgs/msg/RelayCycle",
    "relay_experiment": "relay_autotune_msgs/msg/RelayExperiment",
    "transfer_function": "relay_autotune_msgs/msg/TransferFunction",
    "pi_gains": "relay_autotune_msgs/msg/PidGains",
}
RESULTS = ("transfer_function", "pi_gains")

# How long a start waits for the recording's folder [s].
OPEN_WITHIN = 0.3
# With signs of life of the identifier, one stage of its work may take this many times the timeout.
LONGEST = 30.0
# The identifier works as long as its last sign of life is not older than this [s].
HEARD_WITHIN = 2.5
# Wait after the identifier has finished, for messages that are still on their way [s].
ON_THE_WAY = 0.5


class _Recording(Recorder):
    """A recorder, and the results that it waits for."""

    def __init__(self, *args: Any, **facts: Any) -> None:
        super().__init__(*args, **facts)
        self.missing = list(RESULTS)
        self.timer: Timer | None = None
        self.until = self.patience = 0.0
        self.waits_since = self.heard_at = -math.inf
        self.reason = self.stage = ""
        self.closed: Callable[[str], None] | None = None


class Recordings:
    """The recordings of a node's experiments.

    :param node: the node, whose timers and log are used.
    :param ends: returns the publisher or subscription of each topic, by the topic's unresolved
        name: ``measurement``, ``command`` and those of ``MESSAGES``.
    """

    def __init__(self, node: Node, ends: Callable[[], dict[str, Any]]) -> None:
        self._node = node
        self._ends = ends
        self._names = {name: end.topic_name for name, end in ends().items()}
        self._open: dict[str, _Recording] = {}
        self._paths: dict[str, str] = {}
        self._last: Recorder | None = None
        self._reported = ""

    def begin(self, experiment_id: str, directory: str) -> tuple[Callable[[Any], None], str]:
        """Open the recording of an experiment.

        :param experiment_id: its id, which names the folder.
        :param directory: where the folder is made.
        :return: the function that records a sample, and a sentence on the folder or the failure.
        """
        recorder = _Recording(
            Path(directory).expanduser() / experiment_id,
            [
                Topic(
                    end.topic_name,
                    MESSAGES.get(name, FLOAT64),
                    for_bag(end.qos_profile),
                )
                for name, end in self._ends().items()
            ],
            start_ns=time.time_ns(),
            facts={name: self._names[name] for name in ("measurement", "command")}
            | {"experiment_id": experiment_id},
        )
        recorder.opened.wait(OPEN_WITHIN)
        self._open[experiment_id] = recorder
        self._last = recorder
        if len(self._paths) > 1:
            self._paths.pop(next(iter(self._paths)))
        self._paths[experiment_id] = str(recorder.path)
        said = self.problem() or f"recorded in {recorder.path}"
        return recorder.sample, said

    def problem(self) -> str:
        """Return what is wrong with the newest recording, or ""; a new problem is logged."""
        problem = self._last.failure if self._last is not None else None
        if problem and problem != self._reported:
            self._reported = problem
            self._node.get_logger().error(f"the tune goes on, but {problem}")
        return problem or ""

    def message(self, experiment_id: str, name: str, time_ns: int, message: Any) -> None:
        """Record a message of an experiment; ignore it if no such recording is open.

        :param experiment_id: the id of the experiment.
        :param name: unresolved name of the topic.
        :param time_ns: when it was sent or received [ns since the epoch].
        :param message: the message, which must not be changed afterwards.
        """
        recording = self._open.get(experiment_id)
        if recording is None:
            return
        recording.message(self._names[name], time_ns, message)
        if name in recording.missing and message.final:
            recording.missing.remove(name)
            if recording.closed is not None and not recording.missing:
                self.close(experiment_id, "with model and gains")

    def path_of(self, experiment_id: str) -> str:
        """Return the folder of a recording; "" if nothing could be recorded.

        :param experiment_id: the id of the experiment; only the newest two are known.
        """
        return self._paths.get(experiment_id, "") if not self.problem() else ""

    def told(self, experiment_id: str, working: bool, text: str) -> None:
        """Take a sign of life of the identifier.

        :param experiment_id: the experiment that it works on, or has finished.
        :param working: True if it still works on it.
        :param text: what the work is at, or why model or gains will not come; "": not told.
        """
        recording = self._open.get(experiment_id)
        if recording is None or recording.timer is None:
            return
        if not working:
            recording.reason = text or recording.reason
            period = min(recording.timer.timer_period_ns, round(ON_THE_WAY * 1e9))
            recording.timer.timer_period_ns = period
            recording.timer.reset()
            return
        now = time.monotonic()
        if text != recording.stage:
            # It gets on.
            recording.until = now + recording.patience
        if now < recording.until:
            recording.heard_at, recording.stage = now, text
            recording.timer.reset()
        else:
            recording.reason = (
                f"identifier_node has not got on from {text or 'its first work'} for "
                f"{duration(recording.patience)}"
            )

    def awaited(self, experiment_id: str, timeout: float) -> str:
        """Say what a recording waits for after the end of its tune; "" if it waits for nothing.

        :param experiment_id: the id of the experiment.
        :param timeout: as of `close_with_results` [s].
        """
        recording = self._open.get(experiment_id)
        if recording is None or recording.timer is None:
            return ""
        now = time.monotonic()
        is_there = self._node.count_publishers(self._names["pi_gains"]) > 0
        heard_at = max(recording.heard_at, recording.waits_since if is_there else -math.inf)
        if heard_at > now - HEARD_WITHIN:
            stage = f": {recording.stage}" if recording.stage else " so far"
            return f"computing the model, {duration(now - recording.waits_since)}{stage}"
        silent = duration(now - max(recording.waits_since, recording.heard_at))
        return f"waiting for identifier_node, {silent} of {duration(timeout)} at most"

    def close_with_results(
        self, experiment_id: str, timeout: float, closed: Callable[[str], None]
    ) -> None:
        """Close a recording once model and gains are in it, or after a timeout.

        :param experiment_id: the id of the experiment.
        :param timeout: how long to wait from the end, or from the last sign of life [s].
        :param closed: called with a sentence on the missing results, "" if none is missing.
        """
        recording = self._open.get(experiment_id)
        if recording is None:
            return
        recording.closed = closed
        if not recording.missing:
            self.close(experiment_id, "with model and gains")
            return

        silent = "a recording alone was asked for"
        if timeout > 0.0:
            silent = f"identifier_node did not send them within {timeout:g} s"
        late = partial(self.wait_no_longer, experiment_id, silent)
        recording.waits_since = time.monotonic()
        recording.patience = LONGEST * timeout
        recording.until = recording.waits_since + recording.patience
        recording.timer = self._node.create_timer(max(timeout, 1e-3), late, clock=STEADY)

    def wait_no_longer(self, experiment_id: str, reason: str) -> None:
        """Close a recording without the results that it lacks.

        :param experiment_id: the id of the experiment.
        :param reason: why they are missing, unless identifier_node has told another one.
        """
        recording = self._open.get(experiment_id)
        if recording is not None:
            recording.reason = recording.reason or reason
            missing = " and ".join(recording.missing)
            self.close(experiment_id, f"without {missing}: {recording.reason}")

    def close(self, experiment_id: str, why: str) -> None:
        """Close a recording; its thread finishes it.

        :param experiment_id: the id of the experiment.
        :param why: end of the sentence "the recording is closed ...".
        """
        recording = self._open.pop(experiment_id, None)
        if recording is None:
            return
        if recording.timer is not None:
            self._node.destroy_timer(recording.timer)
        if recording.closed is not None:
            missing = " and no ".join(recording.missing)
            cause = f": {recording.reason}" if recording.reason else ""
            recording.closed(f"no {missing}{cause}" if missing else "")
        log = self._node.get_logger()
        lacks = recording.closed is not None and recording.missing

        def say() -> None:
            told = f"the recording {recording.path} is closed {why}"
            # A line of code has one severity; with another one the logger raises.
            if lacks:
                log.warning(told)
            else:
                log.info(told)

        recording.close(say)

    def close_all(self, why: str, timeout: float) -> None:
        """Close all recordings and wait for the newest to be finished.

        :param why: end of the sentence "the recording is closed ...".
        :param timeout: how long to wait at most [s].
        """
        for experiment_id in list(self._open):
            self.close(experiment_id, why)
        if self._last is not None and not self._last.join(timeout):
            self._node.get_logger().error(
                f"the recording {self._last.path} could not be finished within {timeout:g} s"
            )
