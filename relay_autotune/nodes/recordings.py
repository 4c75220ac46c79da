# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The bags of experiments: opened at the start, closed once model and gains are in them.

A thread writes the bag, so that no callback waits for a disk.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.timer import Timer

from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.errors import BagError
from relay_autotune.nodes.lifetime import STEADY
from relay_autotune.nodes.quality import for_bag
from relay_autotune.text import duration

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
        self._samples: SimpleQueue[tuple[int, int, float, int, float]] = SimpleQueue()
        self._messages: SimpleQueue[tuple[str, int, Any]] = SimpleQueue()
        self._opened = threading.Event()
        self._closing = threading.Event()
        self._finished: Callable[[], object] = bool
        self._writer: BagWriter | None = None
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

    def wait_until_open(self, timeout: float) -> None:
        """Wait at most ``timeout`` seconds until the folder was created or could not be."""
        self._opened.wait(timeout)

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
            self._writer = BagWriter(
                self.path, self._topics, start_ns=self._start_ns, custom=self._facts
            )
        except (BagError, ImportError, OSError) as error:
            self.failure = f"not recorded: {error}"
        finally:
            self._opened.set()
        closing = False
        while not closing:
            # Sleep for a period: a wake-up for each sample would compete with the relay.
            closing = self._closing.wait(FLUSH_PERIOD)
            self._guarded(self._drain)
        self._guarded(self._finish)

    def _guarded(self, action: Callable[[BagWriter], None]) -> None:
        writer = self._writer
        if self.failure is None and writer is not None:
            try:
                action(writer)
            except Exception as error:  # noqa: BLE001  a recorder must not end an experiment
                self.failure = str(error) or type(error).__name__
        if self.failure is not None:
            # Nothing is written after a failure, so empty the queues.
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

    def _finish(self, writer: BagWriter) -> None:
        writer.close()
        self._finished()

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
# With signs of life of the identifier, the wait may take this many times the timeout.
LONGEST = 30.0
# The identifier works as long as its last sign of life is not older than this [s].
HEARD_WITHIN = 2.5
# Wait after the identifier has finished, for messages that are still on their way [s].
ON_THE_WAY = 0.5


class _Recording:
    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self.missing = list(RESULTS)
        self.waiting = False
        self.timer: Timer | None = None
        self.until = 0.0
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
        recorder = Recorder(
            Path(directory).expanduser() / experiment_id,
            [
                Topic(
                    end.topic_name,
                    MESSAGES.get(name, "std_msgs/msg/Float64"),
                    for_bag(end.qos_profile),
                )
                for name, end in self._ends().items()
            ],
            start_ns=time.time_ns(),
            facts={name: self._names[name] for name in ("measurement", "command")}
            | {"experiment_id": experiment_id},
        )
        recorder.wait_until_open(OPEN_WITHIN)
        self._open[experiment_id] = _Recording(recorder)
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
        recording.recorder.message(self._names[name], time_ns, message)
        if name in recording.missing and message.final:
            recording.missing.remove(name)
            if recording.waiting and not recording.missing:
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
        elif time.monotonic() < recording.until:
            recording.heard_at, recording.stage = time.monotonic(), text
            recording.timer.reset()

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
        recording.waiting = True
        recording.closed = closed
        if not recording.missing:
            self.close(experiment_id, "with model and gains")
            return

        def late() -> None:
            missing = " and ".join(recording.missing)
            recording.reason = (
                recording.reason or f"identifier_node did not send them within {timeout:g} s"
            )
            self.close(experiment_id, f"without {missing}: {recording.reason}")

        recording.waits_since = time.monotonic()
        recording.until = recording.waits_since + LONGEST * timeout
        recording.timer = self._node.create_timer(max(timeout, 1e-3), late, clock=STEADY)

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
        log, lacks = self._node.get_logger(), recording.waiting and recording.missing

        def say() -> None:
            told = f"the recording {recording.recorder.path} is closed {why}"
            # A line of code has one severity; with another one the logger raises.
            if lacks:
                log.warning(told)
            else:
                log.info(told)

        recording.recorder.close(say)

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
