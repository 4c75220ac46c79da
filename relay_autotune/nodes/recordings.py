# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The bags of experiments: opened at the start, closed once model and gains are in them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.timer import Timer

from relay_autotune.bag.writer import Topic
from relay_autotune.nodes.lifetime import STEADY
from relay_autotune.nodes.quality import for_bag
from relay_autotune.nodes.recorder import Recorder
from relay_autotune.text import duration

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
        self.reason = ""
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

    def told(self, experiment_id: str, working: bool, lacking: str) -> None:
        """Take a sign of life of the identifier.

        :param experiment_id: the experiment that it works on, or has finished.
        :param working: True if it still works on it.
        :param lacking: why model or gains will not come; "": both were sent.
        """
        recording = self._open.get(experiment_id)
        if recording is None or recording.timer is None:
            return
        if not working:
            recording.reason = lacking or recording.reason
            period = min(recording.timer.timer_period_ns, round(ON_THE_WAY * 1e9))
            recording.timer.timer_period_ns = period
            recording.timer.reset()
        elif time.monotonic() < recording.until:
            recording.heard_at = time.monotonic()
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
            return f"computing the model, {duration(now - recording.waits_since)} so far"
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
