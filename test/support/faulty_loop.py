# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A simulated loop around a relay_node, fast enough for a fault in half a second.

The process is of first order with dead time. The relay runs in another process of the machine. The
kinds of loop differ in the message types, in the source of a sample's time, and in when the sensor
publishes.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import deque
from collections.abc import Callable
from random import Random
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from loop_rig import LATCHED, RELIABLE, Process, Rig
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Float64, Float64MultiArray

from relay_autotune.reasons import Code
from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment

BASELINE, SAFE, REST = 1.0, 0.75, 5.0
PERIOD = 0.005
DEAD_TIME = 0.025
TIME_CONSTANT = 0.05
RELAY = {
    "amplitude": 0.5,
    "baseline": BASELINE,
    "safe_command": SAFE,
    "settle_time": 0.1,
    # A busy machine may keep this loop waiting for seconds.
    "measurement_timeout": 10.0,
    "controller_timeout": 1.0,
    "feedback_timeout": 0.4,
    "max_cycles": 100,
    "min_cycles": 100,
    "process_gain_sign": 1,
}
# Default values of the parameters that a fault may change.
DEFAULTS = {
    "amplitude": 0.5,
    "target_amplitude": 0.0,
    "measurement_timeout": 10.0,
    "measurement_max": math.inf,
    "command_min": -math.inf,
    "command_max": math.inf,
    "command_rate": 0.0,
    "max_deviation": 0.0,
    "max_duration": 0.0,
    "max_half_cycle": 0.0,
    # Set in this order, min_cycles never exceeds max_cycles.
    "max_cycles": 100,
    "min_cycles": 100,
}
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    # A numeric field of a stamped message in, an array of ros2_control out.
    "stamped": {
        "measurement_type": "relay_autotune_msgs/msg/RelayCycle",
        "measurement_field": "settings.setpoint",
        "command_type": "std_msgs/msg/Float64MultiArray",
    },
    "clock": {"use_sim_time": True, "command_type": "std_msgs/msg/Float32"},
    # A busy machine may delay this loop for as long as 20 repetitions.
    "on change": {"repeat_period": 0.025},
    # A joint in an order that changes with each message, and an axis of a Twist.
    "joint": {
        "measurement_type": "sensor_msgs/msg/JointState",
        "measurement_field": "velocity[left]",
        "command_type": "geometry_msgs/msg/TwistStamped",
        "command_field": "twist.linear.x",
        # The value of a parameter is YAML itself: a text of YAML needs quotes.
        "command_message": "'{header: {frame_id: base}, twist: {angular: {z: 0.25}}}'",
    },
    # A joint of a group; the others hold what they were told.
    "group": {
        "command_type": "std_msgs/msg/Float64MultiArray",
        "command_field": "data[1]",
        "command_others": "other_commands",
        "command_period": 0.05,
    },
}
JOINTS = ("left", "right", "arm")
_COMMANDS: dict[str, tuple[Any, Callable[[Any], float]]] = {
    "plain": (Float64, lambda message: message.data),
    "stamped": (Float64MultiArray, lambda message: message.data[0]),
    "clock": (Float32, lambda message: message.data),
    "on change": (Float64, lambda message: message.data),
    "joint": (TwistStamped, lambda message: _of_twist(message)),
    "group": (Float64MultiArray, lambda message: message.data[1]),
}
# A sensor that publishes on change has this resolution, and a slower process by this factor.
_RESOLUTION, _SLOWER = 0.01, 2.0
_CLOCK_START = 100.0

_TYPES = {
    float: (ParameterType.PARAMETER_DOUBLE, "double_value"),
    int: (ParameterType.PARAMETER_INTEGER, "integer_value"),
    str: (ParameterType.PARAMETER_STRING, "string_value"),
    bool: (ParameterType.PARAMETER_BOOL, "bool_value"),
}


def _of_twist(message: TwistStamped) -> float:
    """Return the command, after a check of all that is beside it."""
    assert message.header.frame_id == "base" and message.header.stamp.sec > 1_000_000_000
    assert message.twist.angular.z == 0.25 and message.twist.linear.y == 0.0
    return float(message.twist.linear.x)


class Loop:
    """The process on the topics, and a record of the relay's messages.

    :param rig: the rig that runs the relay.
    :param kind: one of `KINDS`.
    :param slower: factor on its times, where a busy machine must not change its dynamics.
    """

    def __init__(self, rig: Rig, kind: str = "plain", *, slower: float = 1.0) -> None:
        self.rig, self.kind = rig, kind
        self.commands: list[float] = []
        self.messages: list[Any] = []
        self.joints = JOINTS
        self.experiments: list[Any] = rig.listen("relay_experiment", RelayExperiment)
        self.gains = rig.listen("pi_gains", PidGains)
        self.cycles = rig.listen("relay_cycle", RelayCycle)
        self.status = rig.listen("/diagnostics", DiagnosticArray, QoSProfile(depth=50))
        command, value = _COMMANDS[kind]

        def hear(message: Any) -> None:
            self.messages.append(message)
            self.commands.append(value(message))

        rig.node.create_subscription(command, "command", hear, RELIABLE)
        self.speaks_on_change = kind == "on change"
        self.slower = _SLOWER if self.speaks_on_change else slower
        self.publisher: Any = None
        self.sensor_comes()
        self.clock = rig.node.create_publisher(Clock, "/clock", 10) if kind == "clock" else None
        self.process: Process | None = None
        self.mixed = Random(1)
        self.values = dict(DEFAULTS)
        self.count = 0
        self.born = time.monotonic()
        self.reset()
        self.timer = rig.node.create_timer(PERIOD * self.slower, self.step)

    # The process.

    def sensor_comes(self) -> None:
        """Create the sensor's publisher."""
        kind = {"stamped": RelayCycle, "joint": JointState}.get(self.kind, Float64)
        # A value published only on change must be latched for a relay that starts later.
        profile = LATCHED if self.speaks_on_change else 100
        self.publisher = self.rig.node.create_publisher(kind, "measurement", profile)
        self.said = math.nan

    def sensor_leaves(self) -> None:
        """Remove the sensor's publisher."""
        self.rig.node.destroy_publisher(self.publisher)
        self.publisher = None

    def reset(self) -> None:
        """Bring the process to rest, and undo the changes of a fault."""
        self.state, self.gain = 0.0, 2.0
        self.alter: Callable[[float], float | None] = lambda y: y
        self.clock_error = 0.0
        self.clock_stands = False
        self.stuck_at: float | None = None
        self.joints = JOINTS
        self.now = time.monotonic()
        self.on_the_way = deque([(self.now, 0.0)])

    def step(self) -> None:
        self.count += 1
        before, self.now = self.now, time.monotonic()
        command = self.commands[-1] if self.commands else BASELINE
        if self.stuck_at is not None:
            command = self.stuck_at
        if command == SAFE:
            # The next tune must begin at rest at the baseline.
            command = BASELINE
        self.on_the_way.append((self.now + DEAD_TIME * self.slower, command - BASELINE))
        while self.on_the_way[1][0] <= self.now:
            self.on_the_way.popleft()
        pushed = self.gain * self.on_the_way[0][1]
        passed = (self.now - before) / (TIME_CONSTANT * self.slower)
        self.state += (pushed - self.state) * -math.expm1(-passed)
        y = self.alter(REST + self.state + self.noise())
        if y is None or self.publisher is None:
            return
        if self.speaks_on_change:
            y = _RESOLUTION * round(y / _RESOLUTION)
            if y == self.said:
                return
            self.said = y
        self.publish(float(y))

    def stick(self) -> None:
        """Keep the actuator at its position until :meth:`release`."""
        self.stuck_at = self.commands[-1]

    def release(self) -> None:
        """Let the actuator follow its command again."""
        self.stuck_at = None

    def noise(self) -> float:
        return 1e-4 * math.sin(7.0 * self.count**2)

    def publish(self, value: float) -> None:
        if self.clock is not None and not self.clock_stands:
            message = Clock()
            # As fast as the process, also where a busy machine misses samples.
            now = _CLOCK_START + self.now - self.born + self.clock_error
            message.clock.sec, message.clock.nanosec = divmod(round(now * 1e9), 1_000_000_000)
            self.clock.publish(message)
        if self.kind == "stamped":
            stamped = RelayCycle()
            stamped.settings.setpoint = value
            ns = time.time_ns() + round(1e9 * self.clock_error)
            stamp = stamped.header.stamp
            stamp.sec, stamp.nanosec = divmod(ns, 1_000_000_000)
            self.publisher.publish(stamped)
        elif self.kind == "joint":
            names = self.mixed.sample(self.joints, len(self.joints))
            state = JointState(
                name=names, velocity=[value if n == "left" else -7.0 for n in names]
            )
            state.header.stamp = self.rig.node.get_clock().now().to_msg()
            self.publisher.publish(state)
        else:
            self.publisher.publish(Float64(data=value))

    # The relay.

    def start(self, code: str = "", output: int | None = None) -> Process:
        """Start a relay_node, or Python code instead.

        :param output: its output, a pipe or a terminal; None: its log.
        """
        parameters = {**RELAY, **KINDS[self.kind]}
        if code:
            parameters["record_directory"] = str(self.rig.records)
            self.process = self.rig.start_python("broken_relay", code, **parameters)
        else:
            self.process = self.rig.relay(output=output, **parameters)
        self.mixed = Random(1)
        self.values = dict(DEFAULTS)
        return self.process

    def set(self, **values: Any) -> None:
        """Set the parameters of the relay that differ."""
        changed = {k: v for k, v in values.items() if self.values.get(k) != v}
        if not changed:
            return
        parameters = []
        for name, value in changed.items():
            kind, field = _TYPES[type(value)]
            parameters.append(
                Parameter(name=name, value=ParameterValue(type=kind, **{field: value}))
            )
        request = SetParameters.Request(parameters=parameters)
        for result in self.rig.call(SetParameters, "relay_node/set_parameters", request).results:
            assert result.successful, result.reason
        self.values.update(changed)

    def begin(self) -> None:
        """Restore the state before a tune, and clear the messages of the last one."""
        self.reset()
        del self.experiments[:], self.status[:], self.gains[:], self.cycles[:]
        # The first tune must begin like the later ones.
        self.commands[:] = self.commands[-1:] or [SAFE]

    def tune(self) -> Any:
        self.begin()
        return self.rig.tune()

    @property
    def switches(self) -> int:
        """Number of switches of the relay so far; below zero before the kick."""
        # The changes to the baseline and to the kick's level are no switches.
        return sum(a != b for a, b in itertools.pairwise(self.commands)) - 2

    def until_it_oscillates(self, switches: int = 5) -> None:
        self.rig.until(lambda: self.switches >= switches or self.experiments, "an oscillation")
        assert not self.experiments, self.experiments[-1].reason

    def ended(self) -> Any:
        return self.rig.until(lambda: self.experiments, "the record")[-1]

    def is_said(self, text: str) -> bool:
        """Return True if the newest diagnostics have a text."""
        return any(text in s.message for m in self.status[-3:] for s in m.status)

    def check_the_end(self, why: Code | tuple[Code, ...], safe: float = SAFE) -> Any:
        """Check that a tune ended safely and with a reason; return its record."""
        ended = self.ended()
        assert ended.why.code in (why if isinstance(why, tuple) else (why,)), ended.reason
        assert ended.outcome in (RelayExperiment.ABORTED, RelayExperiment.FAILED)
        self.rig.until(lambda: self.commands[-1] == safe, "the safe command")
        self.rig.until(lambda: self.is_said(ended.reason), "the diagnostics")
        assert not self.gains
        return ended

    def check_that_it_stays(self, safe: float = SAFE) -> None:
        """Check that each further measurement is answered with the safe command."""
        self.reset()
        count = len(self.commands)
        self.rig.until(lambda: len(self.commands) > count + 5, "commands after the tune")
        assert set(self.commands[count:]) == {safe}


__all__ = ["BASELINE", "DEFAULTS", "KINDS", "LATCHED", "PERIOD", "RELAY", "SAFE", "Loop"]
