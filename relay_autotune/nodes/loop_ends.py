# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The commands of relay_node, and the loop around it.

The command of the present controller is passed through, interrupted for a tune, and comes back
after it.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from std_msgs.msg import Bool, Float64

from relay_autotune.errors import FieldError, NotReadyError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.nodes import quality, watch
from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.nodes.live_types import CommandMessage
from relay_autotune.reasons import Code, Reason

# Interval and largest number of repeats of the safe command until it is acknowledged.
# Fast DDS asks for acknowledgements when the publisher's history is full, else every 3 s.
REPEAT_SAFE = Duration(seconds=0.01)
REPEATS = 15


# The last numbers that may still be on their way.
_OWN_KEPT = 256


class CommandPublisher:
    """A topic on which numbers go out, each in a message of its own.

    :param node: the node.
    :param messages: writes them.
    :param topic: unresolved name of the topic.
    :param heard: True: the node hears the topic, too, and asks which of its numbers are its own.
    :param options: of the publisher.
    """

    def __init__(
        self,
        node: ServedNode,
        messages: CommandMessage,
        topic: str,
        *,
        heard: bool = False,
        **options: Any,
    ) -> None:
        self.messages = messages
        self.publisher: Publisher = quality.publisher(
            node, messages.kind, topic, quality.COMMAND, **options
        )
        self.topic: str = self.publisher.topic_name
        # Looked up once, because they are called for each measurement.
        self._written, self._publish = messages.written, self.publisher.publish
        self._heard, self._on_the_way = heard, deque[float](maxlen=_OWN_KEPT)
        self.last: float | None = None
        """The number published last; None: there was none."""
        self.is_fresh = False
        """Set to True by each number."""

    def send(self, value: float) -> None:
        """Publish a number, unless the other elements of its message are not known yet."""
        message = self._written(value)
        if message is None:
            return
        if self._heard:
            self._on_the_way.append(self.messages.on_wire(value))
        self._publish(message)
        self.last, self.is_fresh = value, True

    def is_own(self, value: float) -> bool:
        """Tell whether a number on the topic, where others may publish, is one of these.

        :param value: the number, as a receiver reads it; each of these comes once.
        """
        if value not in self._on_the_way:
            return False
        self._on_the_way.remove(value)
        return True


# Number of the controller's last commands that are averaged.
_KEPT = 200
# Return time when no oscillation has shown how fast the process is [s].
_RETURN_TIME = 5.0


class BumplessTransfer:
    """The present controller's command, and the command to the actuator when no tune runs.

    Without a tune, each command of the controller is passed on at once. After a tune, a silence of
    the controller or a start from a known command, the controller's command may differ from the
    actuator's. The difference shrinks to zero along a straight line over the return time, so that
    the actuator sees no bump.

    :param send: publishes a command.
    """

    def __init__(self, send: Callable[[float], None]) -> None:
        self._send = send
        self.last = math.nan
        """The controller's last command [u]; NaN before the first."""
        self._arrived = -math.inf
        self._kept: deque[float] = deque(maxlen=_KEPT)
        self._active = False
        self._left_at = math.nan
        self._offset = 0.0
        self._return_from = -math.inf
        self._return_time = _RETURN_TIME

    @property
    def age(self) -> float:
        """Time since the controller's last command [s]; inf before the first."""
        return time.monotonic() - self._arrived

    def mean(self) -> float:
        """Return the mean of the controller's last commands [u]; NaN before the first."""
        return sum(self._kept) / len(self._kept) if self._kept else math.nan

    def hear(self, command: float) -> float | None:
        """Take a command of the controller; return the command sent to the actuator, or None.

        :param command: [u]; one that is not finite is not passed on.
        """
        if not math.isfinite(command):
            return None
        now = time.monotonic()
        self.last, self._arrived = command, now
        if self._active:
            return None
        if not math.isnan(self._left_at):
            # First command since: its difference from the last one would be the bump.
            self._offset, self._return_from = self._left_at - command, now
            self._left_at = math.nan
        self._kept.append(command)
        passed = command + self._offset_at(now)
        self._send(passed)
        return passed

    def note(self, command: float) -> None:
        """Note a command that the controller has sent to the actuator directly [u]."""
        if math.isfinite(command):
            self.last, self._arrived = command, time.monotonic()
            self._kept.append(command)

    def take_over(self) -> None:
        """Stop passing on the controller's commands."""
        self._active = True
        self._offset = 0.0

    def give_back(self, command: float, return_time: float) -> None:
        """Pass the controller's commands on again.

        :param command: the actuator's present command [u]; NaN: change over without a return.
        :param return_time: time in which the difference shrinks to zero [s]; 0: 5 s.
        """
        self._active = False
        self._left_at = command
        self._return_time = return_time if return_time > 0.0 else _RETURN_TIME

    def _offset_at(self, now: float) -> float:
        if self._offset == 0.0:
            return 0.0
        left = 1.0 - (now - self._return_from) / self._return_time
        if left <= 0.0:
            self._offset = 0.0
            return 0.0
        return left * self._offset


# The graph is looked at each fourth time.
_OF_GRAPH = 4


class LoopSupervisor:
    """Command, watch sensor and other nodes of the loop, and hand the command over and back.

    :param node: relay_node.
    :param sensor: its measurement.
    :param now_ns: returns the time for the stamps of commands [ns].
    :param stop: ends a running tune; takes the reason.
    """

    def __init__(
        self,
        node: Any,
        sensor: watch.Sensor,
        now_ns: Callable[[], int],
        stop: Callable[[Reason], None],
    ) -> None:
        self._node, self.sensor, self._stop = node, sensor, stop
        quality.require_apart(node)
        commands = CommandMessage(
            *map(self._value, ("command_type", "command_field", "command_message")),
            taken=self._value("command_others") == "other_commands",
            now_ns=now_ns,
        )
        # True if the controller commands the actuator itself and reports how; the relay then sends
        # nothing but set-points.
        self._is_reported = bool(self._value("controller_command_field"))
        plain = CommandMessage() if self._is_reported else commands
        # /diagnostics and the answer to a start report an incompatible QoS.
        self._takeover = self._value("path") == "takeover"
        self.command = CommandPublisher(
            node, plain, "command", heard=self._takeover, **quality.OVERRIDABLE
        )
        self.setpoint: CommandPublisher | None = None
        """Where set-points go out; None: the relay does not move them."""
        if self._value("relay_on") == "setpoint":
            messages = commands if self._is_reported else CommandMessage()
            self.setpoint = CommandPublisher(node, messages, "setpoint")
        self.relay = self.setpoint or self.command
        """Where the relay's levels go out."""
        self.own = self.relay if self._is_reported else self.command
        """Where the message goes out that the node was given, and that may have to be repeated."""
        self.handover = BumplessTransfer(self.command.send)
        initial = self._value("initial_command")
        # The actuator is there already; the controller may be elsewhere.
        self.handover.give_back(initial, self._value("return_time"))
        self.held: float | None = None if math.isnan(initial) else initial
        """The command that is held where nobody else commands [u]; None: none was sent yet."""
        # Returns it for each measurement; None: it stays.
        self._after: Callable[[float], float] | None = None
        self._experiment: RelayExperiment | None = None
        self._overtime: watch.Overtime
        self._was_connected = self._driven = False
        self.problem = ""
        """A problem that an operator must act on, or ""."""
        # Time of the last feedback; inf: there is no feedback.
        self._feedback_at = math.inf
        self._follow: watch.FollowWatch | None = None
        self._hold = node.create_publisher(Bool, "hold_request", quality.RESULT)
        self._hold.publish(Bool(data=False))
        self._messages = self.own.messages
        self._topic = self.command.topic
        kind, often = self._messages.kind, quality.MEASUREMENT
        hears = partial(quality.subscription, node)
        if self._takeover:
            hears(kind, "command", self._on_command, quality.COMMAND)
        elif not self._is_reported:
            self._controller = hears(Float64, "controller_command", self._on_controller, often)
        if self._value("command_others") == "other_commands":
            hears(kind, "other_commands", self._on_others, often)
        self.repeat_period: float = self._value("command_period")
        """Time without a command after which the last is sent again [s]; 0: never."""
        if self.repeat_period > 0.0:
            # A command is between one and two looks old when it is sent again.
            node.create_timer(0.5 * self.repeat_period, self._send_again, clock=STEADY)
        hears(Float64, "command_feedback", self._on_feedback, often)
        self._watches = (
            watch.Watch(sensor.problem),
            watch.Watch(self._several, every=_OF_GRAPH),
            watch.Watch(self._second_commander, every=_OF_GRAPH),
            watch.Watch(lambda: self._overtime.problem()),
            watch.Watch(self._silent_controller),
            watch.Watch(self._silent_feedback),
            watch.Watch(self._hold_for_silent_controller, in_tune=None),
            # No sample of a tune may be missed.
            watch.Watch(sensor.look, in_tune=False, every=_OF_GRAPH),
        )
        self._looks = 0
        self._timer = node.create_timer(watch.LOOK_EVERY, self._look, clock=STEADY)

    def _value(self, name: str) -> Any:
        return self._node.get_parameter(name).value

    @property
    def _controller_timeout(self) -> float:
        """Longest silence of a present controller [s]; one that answers samples waits for them."""
        by_rate = watch.SILENT_INTERVALS * self.sensor.samples.interval
        return max(float(self._value("controller_timeout")), by_rate)

    @property
    def is_driven(self) -> bool:
        """True while another node's commands reach the actuator."""
        tuning = self._experiment is not None and self.setpoint is None
        return self._driven and not tuning

    @property
    def is_connected(self) -> bool:
        """True if commands of a present controller arrive on controller_command."""
        return not self._takeover and self.handover.age <= self._controller_timeout

    def mean_command(self) -> float:
        """Return the mean of the present controller's last commands [u]; NaN without controller.

        In takeover the controller is already silent here, and its last commands still count.
        """
        known = self._takeover or self.is_connected
        return self.handover.mean() if known else math.nan

    def require_alone(self) -> None:
        """Refuse a start if another node publishes command or measurement, or has this name.

        :raises NotReadyError: with the name of that node, or because a relay on the set-point has
            no controller.
        """
        if several := self._several():
            raise NotReadyError(several)
        if self.setpoint is not None and not self.is_connected:
            raise NotReadyError(Code.NO_CONTROLLER())
        if self._takeover and self._driven:
            if self.handover.age <= self._controller_timeout:
                raise NotReadyError(Code.BUSY_COMMAND(topic=self._topic))
        elif problem := self._second_commander():
            raise NotReadyError(problem)

    def _several(self) -> Reason | None:
        """Return a reason if there is a second sensor, controller or relay_node."""
        several = watch.second_source(self._node, self.sensor.subscription)
        if not several and not self._takeover and not self._is_reported:
            several = watch.second_source(self._node, self._controller)
        return several or watch.namesake(self._node)

    def _second_commander(self) -> Reason | None:
        """Return a reason if another node commands, which it may in takeover."""
        return None if self._takeover else watch.second_publisher(self._node, self._topic)

    def take(self, experiment: RelayExperiment) -> None:
        """Take the command for a tune.

        :param experiment: the tune.
        """
        self._was_connected = self.is_connected
        self._experiment = experiment
        pause = max(self.sensor.timeout, self.sensor.repeat_period)
        simulated = self._value("use_sim_time")
        self._overtime = watch.Overtime(experiment, pause, simulated=simulated)
        self.sensor.begin()
        if self.setpoint is None:
            self.handover.take_over()
            if not self._node.count_publishers("command_feedback"):
                # No feedback now is no fault; feedback that starts later is checked from then on.
                self._feedback_at = math.inf
            timeout = self._value("feedback_timeout")
            self._follow = watch.FollowWatch(self._tolerance(experiment), timeout)
        self._hold.publish(Bool(data=self.setpoint is None))

    def _tolerance(self, experiment: RelayExperiment) -> Callable[[], float]:
        """Return the function that gives the largest distance of actuator and command [u]."""
        given = float(self._value("feedback_tolerance")) or 0.5 * experiment.parameters.amplitude

        def tolerance() -> float:
            # While the amplitude still grows, it may be too small for a sticking valve. The first
            # cycle that counts has the final amplitude.
            settings = experiment.settings if experiment.cycle_count else None
            return math.inf if settings is None else 0.5 * settings.amplitude

        return (lambda: given) if given else tolerance

    def give_back(self, experiment: RelayExperiment, command: float) -> None:
        """Give the command back after a tune: bumpless, or at once if the process cannot wait.

        :param experiment: the tune that ended.
        :param command: the actuator's present command [u].
        """
        self._hold.publish(Bool(data=False))
        self._experiment, self._follow = None, None
        period = experiment.cycles[-1].period if experiment.cycle_count else 0.0
        at_once = experiment.policy.give_back or self.setpoint is not None
        left = math.nan if at_once else command
        self.handover.give_back(left, self._value("return_time") or period)
        self._driven = self._driven and not self._takeover
        if self.setpoint is None:
            self.held, self._after = command, experiment.after_end

    def answer(self, measurement: float) -> None:
        """Answer a measurement [y] while no tune runs, unless another node commands."""
        if self.is_driven:
            return
        if self._after is not None:
            self.held = self._after(measurement)
        if self.held is not None:
            self.command.send(self.held)

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

    def leave(self) -> None:
        """Stop passing on a controller's commands; send the safe command if one is given."""
        self.handover.take_over()
        if self._takeover:
            return
        safe = self._value("safe_command")
        if math.isfinite(safe):
            self.send_until_acknowledged(safe)
        self._node.get_logger().warning(
            f"nobody passes on what comes on {self._controller.topic_name} any more: the command "
            f"stays at {self.command.last:g}"
        )

    # Callbacks.

    def _look(self) -> None:
        """Let those look whose state it is: the only supervision in the node."""
        self._looks += 1
        for each in self._watches:
            looks = each.in_tune in (None, self._experiment is not None)
            if looks and self._looks % each.every == 0 and (reason := each.problem()):
                self._stop(reason)
        # A silent sensor is missed at once.
        left = self.sensor.left if self._experiment is not None else math.inf
        watch.again(self._timer, min(watch.LOOK_EVERY, left))

    def _silent_controller(self) -> Reason | None:
        silent = self.handover.age
        if not self._was_connected or silent <= self._controller_timeout:
            return None
        heard = self.sensor.subscription if self._is_reported else self._controller
        return Code.SILENT_CONTROLLER(topic=heard.topic_name, silence=silent)

    def _silent_feedback(self) -> Reason | None:
        silent = time.monotonic() - self._feedback_at
        if self._follow is None or silent <= 2.0 * self._value("feedback_timeout"):
            return None
        return Code.SILENT_FEEDBACK(silence=silent)

    def _on_controller(self, message: Float64) -> None:
        passed, tune = self.handover.hear(message.data), self._experiment
        if passed is not None:
            self._driven, self.problem = True, ""
        elif tune is not None and tune.policy.give_back and self.is_connected:
            tune.safe_command = self.handover.last

    def _on_command(self, message: Any) -> None:
        """Take a message on the command topic, where other nodes may publish, too."""
        try:
            command = self._messages.value(message)
        except FieldError as error:
            self._stop(Code.FOREIGN_COMMAND(topic=self._topic, unread=str(error)))
            return
        if self.command.is_own(command):
            return
        if self._experiment is not None:
            must = "hold or track"
            self._stop(Code.FOREIGN_COMMAND(topic=self._topic, command=command, hold=must))
        # A foreign command means that its sender controls the loop again.
        self._driven = True
        self.handover.note(command)

    def _on_others(self, message: Any) -> None:
        messages = self._messages
        messages.take_others(message)
        if messages.why_unknown:
            self._stop(Code.OTHERS_UNKNOWN(why=messages.why_unknown))

    def _send_again(self) -> None:
        """Send the last command again if none has gone out since the last look."""
        own = self.own
        if own.is_fresh:
            own.is_fresh = False
        elif own.last is not None and not self.is_driven:
            own.send(own.last)

    def _on_feedback(self, message: Float64) -> None:
        self._feedback_at = time.monotonic()
        tune, commanded = self._experiment, self.command.last
        # The first command of a tune answers its first sample.
        if self._follow is None or tune is None or not tune.sample_count or commanded is None:
            return
        if self._follow.add(self._feedback_at, commanded, message.data):
            at = {"command": commanded, "position": message.data, **self._follow.rail}
            self._stop(Code.NOT_FOLLOWING(**at))

    def _hold_for_silent_controller(self) -> None:
        if self._takeover or self._is_reported or not self.is_driven:
            return
        timeout = self._controller_timeout
        if self.handover.age <= timeout:
            return
        given = self._value("safe_command")
        safe = self.handover.mean() if math.isnan(given) else given
        self._driven = False
        # The safe command goes out before the log message.
        self.held, self._after = safe, None
        self.command.send(safe)
        self.handover.give_back(safe, self._value("return_time"))
        self.problem = (
            f"{self._controller.topic_name} has been silent for more than {timeout:g} s; the "
            f"command is held at {safe:g} until it comes again"
        )
        self._node.get_logger().error(self.problem)
