# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Signs of life of identifier_node, so that others wait for its results, but not for ever."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node

from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import STEADY

TOPIC = "identifier_status"
# Interval of the signs of life during a computation [s].
EVERY = 1.0

_EXPERIMENT, _STATE = "experiment", "state"
_WORKING, _DONE = "working", "done"


class SignsOfLife:
    """Publish which experiments are in work.

    :param node: identifier_node.
    """

    def __init__(self, node: Node) -> None:
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._publisher = quality.publisher(node, DiagnosticStatus, TOPIC, quality.RESULT)
        self._working: list[str] = []
        self._stage = _WORKING
        self._timer = node.create_timer(EVERY, self._tell, clock=STEADY, autostart=False)

    def work_on(self, experiment_id: str) -> None:
        """Give signs of life until the work is done.

        :param experiment_id: the experiment in work.
        """
        self._working.append(experiment_id)
        self._publish(experiment_id, _WORKING, "")
        self._timer.reset()

    def at(self, stage: str) -> None:
        """Note what the work is at; any thread may call it.

        :param stage: such as ``comparing structures``.
        """
        self._stage = stage

    def _tell(self) -> None:
        for experiment_id in self._working:
            self._publish(experiment_id, _WORKING, "")

    def done(self, experiment_id: str, lacking: str) -> None:
        """Publish that all results of an experiment are out.

        :param experiment_id: its id.
        :param lacking: why model or gains are missing; empty: both were published.
        """
        if experiment_id in self._working:
            self._working.remove(experiment_id)
        if not self._working:
            self._timer.cancel()
        self._publish(experiment_id, _DONE, lacking)

    def _publish(self, experiment_id: str, state: str, reason: str) -> None:
        values = {_EXPERIMENT: experiment_id, _STATE: state}
        self._publisher.publish(
            DiagnosticStatus(
                level=DiagnosticStatus.WARN if reason else DiagnosticStatus.OK,
                name=self._name,
                message=reason or (self._stage if state == _WORKING else state),
                values=[KeyValue(key=key, value=value) for key, value in values.items()],
            )
        )


def said_by(message: Any) -> tuple[str, bool, str]:
    """Return experiment id, whether it is still in work, and a text.

    That is what the work is at, or after it why results are missing; empty: neither is told.

    :param message: the `DiagnosticStatus`.
    """
    values = {pair.key: pair.value for pair in message.values}
    working = values.get(_STATE) == _WORKING
    told = message.message != _WORKING if working else message.level != DiagnosticStatus.OK
    return values.get(_EXPERIMENT, ""), working, message.message if told else ""
