# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Publishers and subscriptions of relay_node, with their quality of service."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from relay_autotune.nodes import quality, signs_of_life
from relay_autotune.nodes.live_types import CommandMessage, Reader
from relay_autotune.nodes.quality import Following
from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment, TransferFunction

# Interval and largest number of repeats of the safe command until it is acknowledged.
# Fast DDS asks for acknowledgements when the publisher's history is full, else every 3 s.
REPEAT_SAFE = Duration(seconds=0.01)
REPEATS = 15


class Outlet:
    """A topic on which numbers go out, each in a message of its own.

    :param node: the node.
    :param messages: writes them.
    :param topic: unresolved name of the topic.
    :param overridable: True: parameters may change the quality of service.
    """

    def __init__(
        self, node: Node, messages: CommandMessage, topic: str, *, overridable: bool = False
    ) -> None:
        self.messages = messages
        self.publisher: Publisher = quality.publisher(
            node, messages.kind, topic, quality.COMMAND, overridable=overridable
        )
        self.topic: str = self.publisher.topic_name
        # Looked up once, because they are called for each measurement.
        self._written, self._publish = messages.written, self.publisher.publish
        self.sent: Callable[[float], None] | None = None
        """Called with each number before it is published."""
        self.last: float | None = None
        """The number published last; None: there was none."""
        self.is_fresh = False
        """Set to True by each number."""

    def send(self, value: float) -> None:
        """Publish a number, unless the other elements of its message are not known yet."""
        message = self._written(value)
        if message is None:
            return
        if self.sent is not None:
            self.sent(value)
        self._publish(message)
        self.last, self.is_fresh = value, True


class Ends:
    """Publishers and subscriptions of relay_node.

    :param node: the node.
    :param on_measurement: called with each measurement and the middleware's facts about it.
    :param on_renewed: called with a subscription that replaces that of the measurement; None: not.
    :param on_result: called with the topic's unresolved name and each model or gains.
    :param on_status: called with each sign of life of the identifier.
    :param cycles_kept: number of cycles kept for late subscribers (depth of the latched topic).
    :param reader: how the measurement is read from its messages.
    :param commands: writes what the relay sends into its message.
    :param relay_on_setpoint: True if the relay publishes set-points.
    :param is_reported: True if the controller commands the actuator itself and reports how; the
        relay then sends nothing but set-points.
    """

    def __init__(
        self,
        node: Node,
        *,
        on_measurement: Callable[[Any, dict[str, Any]], None],
        on_renewed: Callable[[Subscription], None] | None,
        on_result: Callable[[str, Any], None],
        on_status: Callable[[Any], None],
        cycles_kept: int,
        reader: Reader,
        commands: CommandMessage,
        relay_on_setpoint: bool = False,
        is_reported: bool = False,
    ) -> None:
        # /diagnostics and the answer to a start report an incompatible QoS.
        self.is_reported = is_reported
        self.command = Outlet(
            node, CommandMessage() if is_reported else commands, "command", overridable=True
        )
        self.setpoint: Outlet | None = None
        """Where set-points go out; None: the relay does not move them."""
        if relay_on_setpoint:
            self.setpoint = Outlet(node, commands if is_reported else CommandMessage(), "setpoint")
        self.relay = self.setpoint or self.command
        """Where the relay's levels go out."""
        self.own = self.relay if is_reported else self.command
        """Where the message goes out that the node was given, and that may have to be repeated."""
        self.cycles = quality.publisher(
            node, RelayCycle, "relay_cycle", quality.latched(cycles_kept)
        )
        self.progress = quality.publisher(node, RelayExperiment, "relay_progress", quality.RESULT)
        self.experiments = quality.publisher(
            node, RelayExperiment, "relay_experiment", quality.RESULT
        )
        self.diagnostics = quality.publisher(node, DiagnosticArray, "/diagnostics", 1)
        self.reader = reader
        self._sensor = Following(
            node, reader.kind, reader.type_name, "measurement", on_measurement, on_renewed
        )
        self.models, self.gains = (
            quality.subscription(node, kind, name, partial(on_result, name), quality.RESULT)
            for kind, name in ((TransferFunction, "transfer_function"), (PidGains, "pi_gains"))
        )
        quality.subscription(
            node, DiagnosticStatus, signs_of_life.TOPIC, on_status, quality.RESULT
        )

    @property
    def measurement(self) -> Subscription:
        """The subscription of the measurement that is in force."""
        return self._sensor.subscription

    def follow_sensor(self) -> None:
        """Take the measurement best effort if its publisher offers no more."""
        self._sensor.follow()

    def recorded(self) -> dict[str, Any]:
        """Return the publishers and subscriptions to record, by the topics' unresolved names."""
        return {
            "measurement": self.measurement,
            "command": self.command.publisher,
            "relay_cycle": self.cycles,
            "relay_experiment": self.experiments,
            "transfer_function": self.models,
            "pi_gains": self.gains,
        }

    def send_until_acknowledged(self, command: float) -> tuple[int, bool]:
        """Publish the relay's output until every subscriber has acknowledged it.

        :param command: the command [u], or the set-point [y].
        :return: how often it was published, and whether it was acknowledged.
        """
        for count in range(1, REPEATS + 1):
            self.relay.send(command)
            if self.relay.publisher.wait_for_all_acked(REPEAT_SAFE):
                return count, True
        return REPEATS, False
