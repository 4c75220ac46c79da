"""A loop whose controller is another node: gains by its parameters, the set-point by a topic."""

from __future__ import annotations

import math
from collections.abc import Callable

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import Float64

from relay_autotune.control.gains import Controller
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.nodes import quality
from relay_autotune.nodes.remote_gains import RemoteGains
from relay_autotune.nodes.verifier import NotVerifiable


class RemoteLoop:
    """Apply gains to another node's controller, take them back, and move its set-point.

    :param node: the node that does.
    :param gains: the other node's parameters.
    :param setpoint: its set-point until one is heard [y]; NaN: not known.
    :param disturbed: called with the reason when somebody else moves the set-point.
    """

    def __init__(
        self, node: Node, gains: RemoteGains, setpoint: float, disturbed: Callable[[str], None]
    ) -> None:
        self.target = gains.target
        self.command = math.nan
        """The last command heard [u]; NaN: none."""
        self._gains = gains
        self._setpoint = setpoint
        self._disturbed = disturbed
        self._before: dict[str, float] | None = None
        self._offset = 0.0
        # What was published comes back by the topic, where others publish, too.
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

    async def apply(self, gains: Controller) -> None:
        """Set gains, all or none, and keep those before.

        :param gains: the gains.
        :raises RelayAutotuneError: if they are not in force.
        """
        self._before = await self._gains.write(gains)

    async def revert(self) -> tuple[bool, str]:
        """Bring back the gains before; return whether they are, and a sentence."""
        if self._before is None:
            return False, "nothing was applied"
        try:
            await self._gains.restore(self._before)
        except RelayAutotuneError as error:
            return False, str(error)
        self._before = None
        return True, f"{self.target} has its gains of before"

    async def ready(self) -> Controller:
        """Return the gains in force.

        :raises RelayAutotuneError: if it could not be seen what a step of the set-point does.
        """
        topic = self._publisher.topic_name
        if math.isnan(self._setpoint):
            raise NotVerifiable(
                f"the set-point of {self.target} is not known: publish it on {topic}, or give "
                "initial_setpoint"
            )
        # One of the subscriptions is the node's own.
        if self._publisher.get_subscription_count() < 2:
            raise NotVerifiable(
                f"nobody takes a set-point from {topic}: remap it to the topic of {self.target}"
            )
        if math.isnan(self.command):
            raise NotVerifiable(f"no command of {self.target} has been heard")
        return await self._gains.controller()

    def move(self, offset: float) -> None:
        """Put a step on the set-point [y]; 0: none."""
        if offset == self._offset:
            return
        self._offset = offset
        value = self._setpoint + offset
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
        if math.isnan(message.data):
            return
        # It is in force already: there is nothing to go back to.
        self._setpoint, self._offset = message.data, 0.0
        self._disturbed(f"another node set the set-point to {message.data:g}")
