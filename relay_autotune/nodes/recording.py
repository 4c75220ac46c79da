# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The recording of an experiment in relay_node, from its start until model and gains are in it.

A thread writes it, so that no callback waits for a disk.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.timer import Timer

from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
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

Sample = tuple[int, int, float, int, float]
"""When a sample was received and measured [ns], the measurement, when it was answered [ns], and by
which command."""


class Recording:
    """Record one experiment; any error becomes a sentence of `problem`, never an exception.

    :param node: the node, whose timers and log are used.
    :param ends: the publisher or subscription of each topic, by the topic's unresolved name:
        ``measurement``, ``command`` and those of ``MESSAGES``.
    :param directory: where its folder is created.
    :param experiment_id: id of the experiment, which names the folder.
    """

    def __init__(
        self, node: Node, ends: Mapping[str, Any], directory: str, experiment_id: str
    ) -> None:
        # Absolute, since whoever reads the path may be in another folder.
        self.path = Path(directory).expanduser().absolute() / experiment_id
        self._failure = ""
        self._is_told = False
        self._node = node
        self._names = {name: end.topic_name for name, end in ends.items()}
        self._topics = [
            Topic(end.topic_name, MESSAGES.get(name, FLOAT64), for_bag(end.qos_profile))
            for name, end in ends.items()
        ]
        self._samples: SimpleQueue[Sample] = SimpleQueue()
        self._messages: SimpleQueue[tuple[str, int, Any]] = SimpleQueue()
        self._opened, self._closing = threading.Event(), threading.Event()
        self._finished: Callable[[], None]
        # The results that it lacks, and for how long it waits for them.
        self._missing = list(RESULTS)
        self._timer: Timer | None = None
        self._until = self._timeout = self._patience = 0.0
        self._waits_since = self._heard_at = -math.inf
        self._reason = self._stage = ""
        self._closed: Callable[[str], None] | None = None
        # Looked up once, because it is called for each sample.
        self.sample: Callable[[Sample], None] = self._samples.put
        """Record a sample and its answer, once the answer is out."""
        self._thread = threading.Thread(
            target=self._run, args=(time.time_ns(),), name="recorder", daemon=True
        )
        self._thread.start()
        self._opened.wait(OPEN_WITHIN)

    @property
    def is_closed(self) -> bool:
        """True once nothing more can be recorded."""
        return self._closing.is_set()

    @property
    def is_waiting(self) -> bool:
        """True while it waits for model and gains after the end of the tune."""
        return self._timer is not None

    def message(self, name: str, time_ns: int, message: Any) -> None:
        """Record another message; ignore it if the recording is closed.

        :param name: unresolved name of the topic.
        :param time_ns: when it was sent or received [ns since the epoch].
        :param message: the message, which must not be changed afterwards.
        """
        if self.is_closed:
            return
        self._messages.put((self._names[name], time_ns, message))
        if name in self._missing and message.final:
            self._missing.remove(name)
            if self._closed is not None and not self._missing:
                self.close("with model and gains")

    def note_progress(self, working: bool, text: str) -> None:
        """Take a sign of life of the identifier.

        :param working: True if it still works on the experiment.
        :param text: what the work is at, or why model or gains will not come; "": not known.
        """
        timer = self._timer
        if timer is None:
            return
        if not working:
            self._reason = text or self._reason
            timer.timer_period_ns = min(timer.timer_period_ns, round(ON_THE_WAY * 1e9))
            timer.reset()
            return
        now = time.monotonic()
        if text != self._stage:
            # It gets on.
            self._until = now + self._patience
        if now < self._until:
            self._heard_at, self._stage = now, text
            timer.reset()
        else:
            self._reason = (
                f"identifier_node has not got on from {text or 'its first work'} for "
                f"{duration(self._patience)}"
            )

    def awaited(self) -> str:
        """Say what it waits for after the end of the tune; "" if it waits for nothing."""
        if not self.is_waiting:
            return ""
        now = time.monotonic()
        is_there = self._node.count_publishers(self._names["pi_gains"]) > 0
        heard_at = max(self._heard_at, self._waits_since if is_there else -math.inf)
        if heard_at > now - HEARD_WITHIN:
            stage = f": {self._stage}" if self._stage else " so far"
            return f"computing the model, {duration(now - self._waits_since)}{stage}"
        silent = duration(now - max(self._waits_since, self._heard_at))
        return f"waiting for identifier_node, {silent} of {duration(self._timeout)} at most"

    def close_with_results(self, timeout: float, closed: Callable[[str], None]) -> None:
        """Close it once model and gains are in it, or after a timeout.

        :param timeout: how long to wait from the end, or from the last sign of life [s].
        :param closed: called with a sentence on the missing results, "" if none is missing.
        """
        self._closed = closed
        if not self._missing:
            self.close("with model and gains")
            return
        silent = "a recording alone was asked for"
        if timeout > 0.0:
            silent = f"identifier_node did not send them within {timeout:g} s"
        self._waits_since = time.monotonic()
        self._timeout, self._patience = timeout, LONGEST * timeout
        self._until = self._waits_since + self._patience
        self._timer = self._node.create_timer(
            max(timeout, 1e-3), lambda: self.wait_no_longer(silent), clock=STEADY
        )

    def wait_no_longer(self, reason: str) -> None:
        """Close it without the results that it lacks, if it waits for them.

        :param reason: why they are missing, unless identifier_node has given another one.
        """
        if not self.is_waiting:
            return
        self._reason = self._reason or reason
        self.close(f"without {' and '.join(self._missing)}: {self._reason}")

    def close(self, why: str) -> None:
        """Close it, unless it is; its thread finishes it.

        :param why: end of the sentence "the recording is closed ...".
        """
        if self.is_closed:
            return
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        log, sentence = self._node.get_logger(), f"the recording {self.path} is closed {why}"
        # A line of code has one severity; with another one the logger raises.
        self._finished = lambda: log.info(sentence)
        if self._closed is not None and self._missing:
            self._finished = lambda: log.warning(sentence)
        self._closing.set()
        if self._closed is not None:
            missing = " and no ".join(self._missing)
            cause = f": {self._reason}" if self._reason else ""
            self._closed(f"no {missing}{cause}" if missing else "")

    def problem(self) -> str:
        """Return what is wrong with it, or ""; it is logged once."""
        if self._failure and not self._is_told:
            self._is_told = True
            self._node.get_logger().error(f"the tune goes on, but {self._failure}")
        return self._failure

    def join(self, timeout: float) -> None:
        """Wait until the bag is finished, and log if it is not.

        :param timeout: how long to wait at most [s].
        """
        self._thread.join(timeout)
        if self._thread.is_alive():
            self._node.get_logger().error(
                f"the recording {self.path} could not be finished within {timeout:g} s"
            )

    # Its thread.

    def _run(self, start_ns: int) -> None:
        names = {name: self._names[name] for name in ("measurement", "command")}
        try:
            writer = BagWriter(
                self.path,
                self._topics,
                start_ns=start_ns,
                custom=names | {"experiment_id": self.path.name},
            )
            self._opened.set()
            # Sleep for a period: a wake-up for each sample would compete with the relay.
            while not self._closing.wait(FLUSH_PERIOD):
                self._drain(writer)
            self._drain(writer)
            writer.close()
            self._finished()
        except Exception as error:  # noqa: BLE001  a recorder must not end an experiment
            problem = str(error) or type(error).__name__
            self._failure = problem if self._opened.is_set() else f"not recorded: {problem}"
            self._opened.set()
            # Nothing is written after a failure, so the queues are emptied.
            while not self._closing.wait(FLUSH_PERIOD):
                for queue in (self._samples, self._messages):
                    list(_taken_from(queue))

    def _drain(self, writer: BagWriter) -> None:
        command, measurement = self._names["command"], self._names["measurement"]
        for count, (received, source, value, sent, answer) in enumerate(
            _taken_from(self._samples), 1
        ):
            writer.write(measurement, received, source, encode_float64(value))
            writer.write(command, sent, sent, encode_float64(answer))
            if count % PORTION == 0 and not self._closing.is_set():
                time.sleep(PAUSE)
        for topic, time_ns, message in _taken_from(self._messages):
            writer.write(topic, time_ns, time_ns, serialize_message(message))
        writer.flush()


def _taken_from(queue: SimpleQueue[Any]) -> Any:
    """Yield what is in a queue."""
    with contextlib.suppress(Empty):
        while True:
            yield queue.get_nowait()
