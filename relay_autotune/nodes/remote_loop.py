# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A loop whose controller is another node: gains by parameters, the set-point by a topic."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import Float64

from relay_autotune.control.controller import is_usable
from relay_autotune.nodes import quality
from relay_autotune.nodes.remote_gains import RemoteGains
from relay_autotune.nodes.verifier import NotVerifiable

# A controller without a command for this time counts as silent [s].
_SILENCE = 2.0


class RemoteLoop:
    """Hear another node's controller, and move its set-point.

    :param node: this node.
    :param gains: the other node's parameters.
    :param setpoint: its set-point until one is received [y]; NaN: not known.
    :param disturbed: called with the reason when another node moves the set-point.
    """

    def __init__(
        self, node: Node, gains: RemoteGains, setpoint: float, disturbed: Callable[[str], None]
    ) -> None:
        self.command = math.nan
        """The last command received [u]; NaN before the first."""
        self._gains = gains
        self._heard_at = 0.0
        self.setpoint = setpoint
        """The set-point in force [y]; NaN: not known."""
        self._disturbed = disturbed
        self._offset = 0.0
        # Own set-points that have not come back yet over the topic, where others may publish, too.
        self._on_the_way: list[float] = []
        self._publisher = node.create_publisher(
            Float64,
            "setpoint",
            quality.COMMAND,
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
        )
        node.create_subscription(
            Float64,
            "setpoint",
            self._on_setpoint,
            quality.COMMAND,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )

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
        return f"no command of {self._gains.name} for {silent:.3g} s"

    def require_ready(self) -> None:
        """Refuse a loop in which the effect of a set-point step could not be seen.

        :raises NotVerifiable: with the reason.
        """
        topic, target = self._publisher.topic_name, self._gains.name
        if math.isnan(self.setpoint):
            raise NotVerifiable(
                f"the set-point of {target} is not known: publish it on {topic}, or give "
                "initial_setpoint"
            )
        # One subscription is the node's own.
        if self._publisher.get_subscription_count() < 2:
            raise NotVerifiable(
                f"nobody takes a set-point from {topic}: remap it to the topic of {target}"
            )
        if math.isnan(self.command):
            raise NotVerifiable(f"no command of {target} has been heard")
        if reason := self.why_silent():
            raise NotVerifiable(reason)

    def move(self, offset: float) -> None:
        """Put a step on the set-point [y]; 0: none."""
        if offset == self._offset:
            return
        self._offset = offset
        value = self.setpoint + offset
        self._on_the_way.append(value)
        self._publisher.publish(Float64(data=value))

    def wait_for_setpoint(self, timeout: Duration) -> None:
        """Wait until the last set-point has arrived.

        :param timeout: how long at most.
        """
        self._publisher.wait_for_all_acked(timeout)

    def _on_setpoint(self, message: Float64) -> None:
        if message.data in self._on_the_way:
            self._on_the_way.remove(message.data)
            return
        if not is_usable(message.data):
            return
        changed = message.data != self.setpoint + self._offset
        # The new set-point is in force already, so there is no step to take back.
        self.setpoint, self._offset = message.data, 0.0
        if changed:
            self._disturbed(f"another node set the set-point to {message.data:g}")
