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
        plain = CommandMessage()
        self.is_reported = is_reported
        self.commands = commands
        self._setpoints = commands if is_reported else plain
        passed = plain if is_reported else commands
        self._written = passed.written
        self.setpoint = None
        if relay_on_setpoint:
            self.setpoint = quality.publisher(
                node, self._setpoints.kind, "setpoint", quality.COMMAND
            )
        self.command = quality.publisher(
            node, passed.kind, "command", quality.COMMAND, overridable=True
        )
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
        self.sent: Callable[[float], None] | None = None
        """Called with each command before it is published."""
        # Looked up once, because it is called for each measurement.
        self._publish = self.command.publish
        self.last: float | None = None
        """The last number that the relay's message carried; None: there was none."""
        self.is_fresh = False
        """Set to True by each command."""

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
            "command": self.command,
            "relay_cycle": self.cycles,
            "relay_experiment": self.experiments,
            "transfer_function": self.models,
            "pi_gains": self.gains,
        }

    def send(self, command: float) -> None:
        """Publish a command, unless the other elements of its message are not known yet."""
        message = self._written(command)
        if message is None:
            return
        if self.sent is not None:
            self.sent(command)
        self._publish(message)
        self.last, self.is_fresh = command, True

    def send_setpoint(self, setpoint: float) -> None:
        """Publish a set-point."""
        assert self.setpoint is not None
        message = self._setpoints.written(setpoint)
        if message is None:
            return
        self.setpoint.publish(message)
        if self.is_reported:
            self.last, self.is_fresh = setpoint, True

    def send_again(self) -> None:
        """Publish the last command again, or the last set-point if these alone are sent."""
        if self.last is not None:
            (self.send_setpoint if self.is_reported else self.send)(self.last)

    @property
    def sent_to(self) -> Publisher:
        """The publisher of what the relay's message carries."""
        return self.setpoint if self.is_reported and self.setpoint else self.command

    def relay(self, value: float) -> None:
        """Publish the relay's output: a command, or a set-point."""
        if self.setpoint is None:
            self.send(value)
        else:
            self.send_setpoint(value)

    def send_until_acknowledged(self, command: float) -> tuple[int, bool]:
        """Publish the relay's output until every subscriber has acknowledged it.

        :param command: the command [u], or the set-point [y].
        :return: how often it was published, and whether it was acknowledged.
        """
        for count in range(1, REPEATS + 1):
            self.relay(command)
            if (self.setpoint or self.command).wait_for_all_acked(REPEAT_SAFE):
                return count, True
        return REPEATS, False
