# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How a running node reads a number out of a message of any type."""

from __future__ import annotations

import importlib
import random

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Byte, Float64

from relay_autotune.bag.definitions import Channel, find_definition, message_type
from relay_autotune.errors import FieldError, ParameterError
from relay_autotune.nodes import gains_place
from relay_autotune.nodes.live_types import (
    CommandMessage,
    command_reader,
    reader_of,
    struct_of,
)
from relay_autotune.nodes.relay import require_reported
from relay_autotune.nodes.tables import CONTROLLER_PARAMETERS

JOINTS = [f"arm_{k}" for k in range(7)]


def test_a_joint_is_found_by_its_name_in_a_thousand_orders() -> None:
    reader, chance = reader_of("sensor_msgs/msg/JointState", "velocity[arm_2]"), random.Random(3)
    order = JOINTS
    for k in range(1000):
        # The order stays for a while, and changes between two messages.
        order = chance.sample(JOINTS, 7) if k % 3 == 0 else order
        value = {name: chance.random() for name in order}
        message = JointState(name=order, velocity=[value[name] for name in order])
        assert reader.value(message) == value["arm_2"]


def test_an_element_is_lost_and_found_again() -> None:
    reader = reader_of("sensor_msgs/msg/JointState", "position[left]")
    there = JointState(name=["right", "left"], position=[1.0, 2.0])
    for _ in range(2):
        assert reader.value(there) == 2.0
        with pytest.raises(FieldError, match=r"has no 'left'; it has right, lef; write .*\[lef\]"):
            reader.value(JointState(name=["right", "lef"], position=[1.0, 2.0]))
        with pytest.raises(FieldError, match="has length 2, but the array 1"):
            reader.value(JointState(name=["right", "left"], position=[1.0]))


def test_numbers_of_other_kinds() -> None:
    twist = TwistStamped()
    twist.twist.linear.x, twist.header.stamp.sec = 0.25, 3
    reader = reader_of("geometry_msgs/msg/TwistStamped", "twist.linear.x")
    assert reader.value(twist) == 0.25
    assert reader.stamp_ns is not None and reader.stamp_ns(twist) == 3_000_000_000
    assert reader_of("std_msgs/msg/Byte", "data").value(Byte(data=b"\x07")) == 7.0
    cells = reader_of("sensor_msgs/msg/BatteryState", "cell_voltage[1]")
    assert cells.value(BatteryState(cell_voltage=[3.5, 3.25])) == 3.25
    levels = reader_of("diagnostic_msgs/msg/DiagnosticArray", "status[name=pump].level")
    status = [DiagnosticStatus(name="fan"), DiagnosticStatus(name="pump", level=b"\x02")]
    assert levels.value(DiagnosticArray(status=status)) == 2.0
    with pytest.raises(FieldError, match="the elements' name has no 'pump'; it has fan"):
        levels.value(DiagnosticArray(status=status[:1]))


@pytest.mark.parametrize(
    ("field", "sentence"),
    [
        ("velocity", r"is not a number; .* such as velocity\[NAME\]"),
        ("speed[left]", r"no field 'speed\[left\]'; it has position\[NAME\], velocity\[NAME\]"),
        ("header.frame_id", "is not a number"),
        ("velocity[2", "expected one such as .* velocity"),
    ],
)
def test_fields_that_are_none_are_refused_when_the_node_starts(field: str, sentence: str) -> None:
    with pytest.raises(ParameterError, match=f"measurement_field: .*{sentence}"):
        reader_of("sensor_msgs/msg/JointState", field)


def test_a_type_is_called_as_the_graph_calls_it_however_it_was_typed() -> None:
    """The type that was typed was compared with that of publishers, and with a table."""
    assert reader_of("std_msgs/Float64", "data").type_name == "std_msgs/msg/Float64"
    assert CommandMessage("std_msgs/Float64").type_name == "std_msgs/msg/Float64"


def test_a_type_that_is_not_installed_is_refused() -> None:
    with pytest.raises(ParameterError, match="expected an installed message type"):
        reader_of("sensor_msgs/msg/JointStates", "position[left]")


@pytest.mark.parametrize(
    "name",
    ["sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState",
     "std_msgs/msg/Float64MultiArray",
     "trajectory_msgs/msg/JointTrajectory", "diagnostic_msgs/msg/DiagnosticArray",
     "geometry_msgs/msg/TwistWithCovarianceStamped", "relay_autotune_msgs/msg/RelayExperiment"],
)  # fmt: skip
def test_a_class_has_the_fields_of_its_definition(name: str) -> None:
    package, _, short = name.split("/")
    text = find_definition(name).text.encode()
    recorded = message_type(Channel(1, "/t", name, "cdr", "ros2msg", text))
    assert struct_of(getattr(importlib.import_module(f"{package}.msg"), short)) == recorded


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"relay_on": "command"}, "which is for relay_on setpoint with path passthrough"),
        ({"path": "takeover"}, "found setpoint and takeover"),
        ({"controller_command_field": "force[left]"}, "controller_command_field: sensor_msgs/"),
    ],
)
def test_a_controller_that_cannot_report_its_command_is_refused(
    given: dict[str, str], sentence: str
) -> None:
    values = {
        "measurement_type": "sensor_msgs/msg/JointState",
        "controller_command_field": "effort[left]",
        "relay_on": "setpoint",
        "path": "passthrough",
    }
    read = command_reader(values)
    assert read is not None
    assert read(JointState(name=["arm", "left"], effort=[1.0, 2.0])) == 2.0
    with pytest.raises(ParameterError, match=sentence):
        require_reported(values | given)
        command_reader(values | given)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"controller_command_field": "effort[left]"}, "controller_command_field is given, which"),
        ({"command_field": "linear.x"}, "command_field is given, which is for apply_to together"),
    ],
)
def test_parameters_of_another_nodes_set_point_need_that_node(
    given: dict[str, str], sentence: str
) -> None:
    defaults = {each.name: each.default for each in CONTROLLER_PARAMETERS}
    assert gains_place.setpoint_message(defaults).kind is Float64
    with pytest.raises(ParameterError, match=sentence):
        gains_place.setpoint_message(defaults | given)
