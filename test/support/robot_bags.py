# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Recordings of a robot with several joints, of which some were moved by a relay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sampled_relay import simulate_sampled_relay

from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record, RelaySettings

START = 1_790_000_000_000_000_000
PERIOD = 0.01
# The fields that these messages have in ros-controls' control_msgs.
DEFINITIONS = {
    "control_msgs/msg/SingleDOFState": "string name\nfloat64 reference\nfloat64 feedback\n"
    "float64 feedback_dot\nfloat64 error\nfloat64 error_dot\nfloat64 time_step\nfloat64 output\n",
    "control_msgs/msg/MultiDOFStateStamped": "std_msgs/Header header\n"
    "control_msgs/SingleDOFState[] dof_states\n",
    "control_msgs/msg/MultiDOFCommand": "string[] dof_names\nfloat64[] values\n"
    "float64[] values_dot\n",
    "control_msgs/msg/JointTrajectoryControllerState": "std_msgs/Header header\n"
    "string[] joint_names\n"
    + "".join(
        f"trajectory_msgs/JointTrajectoryPoint {field}\n"
        for field in ("reference", "feedback", "error", "output")
    )
    + "string[] multi_dof_joint_names\nfloat64 speed_scaling_factor\n",
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    "control_msgs/msg/DynamicJointState": "std_msgs/Header header\nstring[] joint_names\n"
    "control_msgs/InterfaceValue[] interface_values\n",
}
STORE = get_typestore(Stores.ROS2_JAZZY)
for _name, _text in DEFINITIONS.items():
    STORE.register(get_types_from_msg(_text, _name))


def model_of(place: int) -> TransferFunction:
    """Return the process of the joint at a place, each another one."""
    return TransferFunction.fopdt(2.0 - 0.7 * place, 0.2 + 0.1 * place, 0.05)


def ros(name: str, *values: Any) -> Any:
    return STORE.types[name](*values)


def doubles(values: Sequence[float]) -> Any:
    return np.array(values, dtype=float)


class Robot:
    """Joints that a relay moves or that rest, in the time of one test.

    :param joints: their names.
    :param moved: those that the relay moves.
    :param samples: number of samples.
    """

    def __init__(self, joints: Sequence[str], moved: Sequence[str], samples: int = 600) -> None:
        self.joints, self.samples = list(joints), samples
        self._mixed = Random(2)
        chance = np.random.default_rng(3)
        levels = RelaySettings(setpoint=0.0, baseline=0.0, amplitude=1.0, bias=0.3, hysteresis=0.1)
        self.records: dict[str, Record] = {}
        self.velocity = {name: 1e-3 * chance.standard_normal(samples) for name in joints}
        self.command = {name: np.full(samples, 0.5) for name in joints}
        for name in moved:
            noise = chance.normal(0.0, 0.01, samples)
            model = model_of(self.joints.index(name))
            record = simulate_sampled_relay(model, levels, period=PERIOD, noise=noise)
            self.records[name] = record
            self.velocity[name], self.command[name] = record.measurement, record.command

    def mixed(self) -> list[str]:
        """Return the joints in another order with each call."""
        return self._mixed.sample(self.joints, len(self.joints))

    def header(self, k: int) -> Any:
        ns = START + round(1e9 * PERIOD * k)
        stamp = ros("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)
        return ros("std_msgs/msg/Header", stamp, "base")

    def joint_state(self, k: int) -> Any:
        order, name = self.mixed(), "sensor_msgs/msg/JointState"
        velocity = [self.velocity[joint][k] for joint in order]
        position = doubles([0.0] * len(order))
        return ros(name, self.header(k), order, position, doubles(velocity), doubles([]))

    def dynamic_state(self, k: int) -> Any:
        order, kind = self.mixed(), "control_msgs/msg/InterfaceValue"
        values = [
            ros(kind, ["effort", "velocity"], doubles([3.0, self.velocity[joint][k]]))
            for joint in order
        ]
        return ros("control_msgs/msg/DynamicJointState", self.header(k), order, values)

    def commands(self, k: int) -> Any:
        layout = ros("std_msgs/msg/MultiArrayLayout", [], 0)
        values = doubles([self.command[joint][k] for joint in self.joints])
        return ros("std_msgs/msg/Float64MultiArray", layout, values)

    def controller_state(self, k: int) -> Any:
        states = [
            ros("control_msgs/msg/SingleDOFState", name, 0.0, self.velocity[name][k], 0.0,
                -self.velocity[name][k], 0.0, PERIOD, self.command[name][k])
            for name in self.mixed()
        ]  # fmt: skip
        return ros("control_msgs/msg/MultiDOFStateStamped", self.header(k), states)

    def trajectory(self, k: int) -> Any:
        order, none = self.mixed(), doubles([])
        span = ros("builtin_interfaces/msg/Duration", 0, 0)
        velocity = doubles([self.velocity[name][k] for name in order])
        effort = doubles([self.command[name][k] for name in order])
        point = "trajectory_msgs/msg/JointTrajectoryPoint"
        wanted = ros(point, none, doubles([0.0] * len(order)), none, none, span)
        return ros(
            "control_msgs/msg/JointTrajectoryControllerState", self.header(k), order,
            wanted, ros(point, none, velocity, none, none, span), wanted,
            ros(point, none, none, none, effort, span), [], 1.0,
        )  # fmt: skip

    def named_commands(self, k: int) -> Any:
        order = self.mixed()
        values = doubles([self.command[joint][k] for joint in order])
        return ros("control_msgs/msg/MultiDOFCommand", order, values, values)


def write_robot(path: Path, samples: int, **topics: tuple[str, Callable[[int], Any]]) -> Path:
    """Write a bag of topics, each a type and what makes its messages.

    :param topics: by name, with `__` for a slash.
    """
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        channels = {}
        for topic, (kind, _) in topics.items():
            text = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
            schema = writer.register_schema(kind, "ros2msg", text)
            name = "/" + topic.replace("__", "/")
            channels[topic] = writer.register_channel(name, "cdr", schema)
        for k in range(samples):
            for number, (topic, (kind, make)) in enumerate(topics.items()):
                # A command answers the sample before it.
                stamp = START + round(1e9 * PERIOD * k) + number * 10**5
                data = bytes(STORE.serialize_cdr(make(k), kind))
                writer.add_message(channels[topic], stamp, data, stamp, k)
        writer.finish()
    return path
