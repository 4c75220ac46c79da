# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A loop whose controller is another node: gains by parameters, the set-point by a topic."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node

from relay_autotune.control.controller import is_usable
from relay_autotune.errors import FieldError, NotReadyError, ParameterError
from relay_autotune.nodes import quality
from relay_autotune.nodes.live_types import CommandMessage, reader_of
from relay_autotune.nodes.tune_parameters import MESSAGE_PARAMETERS

# A controller without a command for this time counts as silent [s].
_SILENCE = 2.0


def reported_by(
    values: Mapping[str, Any],
) -> tuple[Callable[[Any], float] | None, CommandMessage]:
    """Return what reads the other node's command from the measurement's messages, and set-points.

    :param values: the parameters of controller_node.
    :return: the reader, None: these messages do not have it; what writes a set-point.
    :raises ParameterError: if they cannot have it, or nothing is done with a parameter.
    """
    field, target = values["controller_command_field"], values["apply_to"]
    if field and target:
        message = (values[each.name] for each in MESSAGE_PARAMETERS)
        read = reader_of(values["measurement_type"], field, "controller_command_field").value
        return read, CommandMessage(*message)
    said = [each.name for each in MESSAGE_PARAMETERS if values[each.name] != each.default]
    if field or said:
        raise ParameterError(
            f"{'controller_command_field' if field else said[0]} is given, which is for apply_to "
            f"together with controller_command_field: the set-point of another node in a message "
            f"of its own"
        )
    return None, CommandMessage()


class RemoteLoop:
    """Hear another node's controller, and move its set-point.

    :param node: this node.
    :param target: name of the other node.
    :param setpoint: its set-point until one is received [y]; NaN: not known.
    :param setpoints: writes a set-point into its message.
    :param disturbed: called with the reason when another node moves the set-point.
    """

    def __init__(
        self,
        node: Node,
        target: str,
        setpoint: float,
        setpoints: CommandMessage,
        disturbed: Callable[[str], None],
    ) -> None:
        self.command = math.nan
        """The last command received [u]; NaN before the first."""
        self._target = target
        self._heard_at = 0.0
        self.setpoint = setpoint
        """The set-point in force [y]; NaN: not known."""
        self._setpoints = setpoints
        self._disturbed = disturbed
        self._offset = 0.0
        # Own set-points that have not come back yet over the topic, where others may publish, too.
        self._on_the_way: list[float] = []
        self._publisher = quality.publisher(node, setpoints.kind, "setpoint", quality.COMMAND)
        quality.subscription(node, setpoints.kind, "setpoint", self._on_setpoint, quality.COMMAND)

    def hear_command(self, command: float) -> None:
        """Take a command of the other node [u]."""
        if is_usable(command):
            self.command = command
            self._heard_at = time.monotonic()

    def why_silent(self) -> str:
        """Return a sentence if the other node has stopped sending commands, else ""."""
        silent = time.monotonic() - self._heard_at
        if silent < _SILENCE:
            return ""
        return f"no command of {self._target} for {silent:.3g} s"

    def require_ready(self) -> None:
        """Refuse a loop in which the effect of a set-point step could not be seen.

        :raises NotReadyError: with the reason.
        """
        topic, target = self._publisher.topic_name, self._target
        if math.isnan(self.setpoint):
            raise NotReadyError(
                f"the set-point of {target} is not known: publish it on {topic}, or give "
                "initial_setpoint"
            )
        # One subscription is the node's own.
        if self._publisher.get_subscription_count() < 2:
            raise NotReadyError(
                f"nobody takes a set-point from {topic}: remap it to the topic of {target}"
            )
        if math.isnan(self.command):
            raise NotReadyError(f"no command of {target} has been heard")
        if reason := self.why_silent():
            raise NotReadyError(reason)

    def move(self, offset: float) -> None:
        """Put a step on the set-point [y]; 0: none."""
        if offset == self._offset:
            return
        self._offset = offset
        value = self.setpoint + offset
        self._on_the_way.append(self._setpoints.on_wire(value))
        self._publisher.publish(self._setpoints.written(value))

    def wait_for_setpoint(self, timeout: Duration) -> None:
        """Wait until the last set-point has arrived.

        :param timeout: how long at most.
        """
        self._publisher.wait_for_all_acked(timeout)

    def _on_setpoint(self, message: Any) -> None:
        try:
            value = self._setpoints.value(message)
        except FieldError as error:
            self._disturbed(f"another node set a set-point that cannot be read: {error}")
            return
        if value in self._on_the_way:
            self._on_the_way.remove(value)
            return
        if not is_usable(value):
            return
        changed = value != self.setpoint + self._offset
        # The new set-point is in force already, so there is no step to take back.
        self.setpoint, self._offset = value, 0.0
        if changed:
            self._disturbed(f"another node set the set-point to {value:g}")
