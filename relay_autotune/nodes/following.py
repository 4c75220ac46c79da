# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A subscription that takes what its publishers offer: sensors often publish best effort."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from relay_autotune.nodes import quality

FOLLOW_EVERY = 0.2
"""How often a publisher is looked for that the subscription cannot hear [s]."""


class Following:
    """Subscribe reliably, and best effort once a publisher offers no more.

    A reliable subscription receives nothing from a best effort publisher, and a best effort one
    would lose samples of a reliable publisher without need. A reliability that the user gives by
    ``qos_overrides`` stays as it is.

    :param node: the node.
    :param kind: the message class.
    :param type_name: its name, such as ``std_msgs/msg/Float64``.
    :param topic: unresolved name of the topic.
    :param callback: takes each message.
    :param renewed: called with a subscription that replaces the one before, which ends then.
    """

    def __init__(
        self,
        node: Any,
        kind: Any,
        type_name: str,
        topic: str,
        callback: Callable[..., None],
        renewed: Callable[[Subscription], None] | None = None,
    ) -> None:
        self._node = node
        self._kind, self._type_name = kind, type_name
        self._topic = topic
        self._callback = callback
        self._renewed = renewed
        self.subscription: Subscription = quality.subscription(
            node, kind, topic, callback, quality.MEASUREMENT, overridable=True
        )
        """The subscription in force."""
        name = self.subscription.topic_name
        given = f"qos_overrides.{name}.subscription.reliability"
        self._is_given = given in node._parameter_overrides

    @property
    def is_best_effort(self) -> bool:
        """True if samples may be lost on the way."""
        reliability = self.subscription.qos_profile.reliability
        return bool(reliability == ReliabilityPolicy.BEST_EFFORT)

    def follow(self) -> None:
        """Subscribe anew if a publisher is there that this subscription cannot hear."""
        name = self.subscription.topic_name
        if self._is_given or self.is_best_effort:
            return
        if self._node.count_publishers(name) <= self.subscription.get_publisher_count():
            return
        offered = [
            end
            for end in self._node.get_publishers_info_by_topic(name)
            if end.topic_type == self._type_name
            and end.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        ]
        if not offered:
            return
        old, profile = self.subscription, self.subscription.qos_profile
        self.subscription = quality.subscription(
            self._node,
            self._kind,
            self._topic,
            self._callback,
            QoSProfile(
                history=profile.history,
                depth=profile.depth,
                durability=profile.durability,
                reliability=ReliabilityPolicy.BEST_EFFORT,
            ),
        )
        if self._renewed is not None:
            self._renewed(self.subscription)
        self._node.destroy_subscription(old)
        self._node.get_logger().info(
            f"{name} is taken best effort, as {quality.who(offered[0])} offers it: samples that "
            f"are lost on the way are counted"
        )
