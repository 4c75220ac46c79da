# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Commands within messages of any type, and what stands beside them."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from types import ModuleType
from typing import Any, ClassVar

import pytest
from geometry_msgs.msg import Twist, Wrench
from rosidl_parser import definition
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Float64MultiArray

from relay_autotune.errors import ParameterError
from relay_autotune.nodes.live_types import CommandMessage
from relay_autotune.nodes.tune_client import TuneClient

NAMES = ("command_type", "command_field", "command_message", "command_others")

MULTI, DOUBLES = "std_msgs/msg/Float64MultiArray", "control_msgs/msg/MultiDOFCommand"
STAMP = 1_790_000_000_123_456_789


def commands(type_name: str, field: str, given: str = "", *, taken: bool = False) -> Any:
    return CommandMessage(type_name, field, given, taken=taken, now_ns=lambda: STAMP)


@pytest.fixture
def multi_dof(monkeypatch: pytest.MonkeyPatch) -> None:
    """Provide control_msgs/MultiDOFCommand, which does not come with the common interfaces."""

    class MultiDOFCommand:
        SLOT_TYPES: ClassVar = (
            definition.UnboundedSequence(definition.UnboundedString()),
            definition.UnboundedSequence(definition.BasicType("double")),
            definition.UnboundedSequence(definition.BasicType("double")),
        )

        def __init__(self) -> None:
            self.dof_names: list[str] = []
            self.values: list[float] = []
            self.values_dot: list[float] = []

        @classmethod
        def get_fields_and_field_types(cls) -> dict[str, str]:
            doubles = "sequence<double>"
            return {"dof_names": "sequence<string>", "values": doubles, "values_dot": doubles}

    MultiDOFCommand.__module__ = "control_msgs.msg._multi_dof_command"
    package, messages = ModuleType("control_msgs"), ModuleType("control_msgs.msg")
    messages.MultiDOFCommand = MultiDOFCommand  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "control_msgs", package)
    monkeypatch.setitem(sys.modules, "control_msgs.msg", messages)


def test_one_number_one_element_and_one_axis() -> None:
    assert commands("std_msgs/msg/Float64", "data").written(1.5).data == 1.5
    assert list(commands(MULTI, "data").written(1.5).data) == [1.5]
    twist = commands("geometry_msgs/msg/Twist", "linear.x", "{angular: {z: 1}}").written(0.5)
    expected = Twist()
    expected.linear.x, expected.angular.z = 0.5, 1.0
    assert twist == expected
    wrench = Wrench()
    wrench.force.z = -2.0
    assert commands("geometry_msgs/msg/Wrench", "force.z").written(-2.0) == wrench


def test_the_others_of_a_group_stay_as_given() -> None:
    group = commands(MULTI, "data[1]", "{data: [0.5, 0, -1]}")
    for command in (3.0, -4.0):
        assert list(group.written(command).data) == [0.5, command, -1.0]
        assert group.value(group.written(command)) == command


def test_a_joint_by_its_name_and_the_stamp_of_now() -> None:
    given = "{name: [left, right], effort: [0.25, 0.0]}"
    joint = commands("sensor_msgs/msg/JointState", "effort[right]", given).written(7.0)
    assert list(joint.effort) == [0.25, 7.0]
    assert joint.header.stamp.sec * 10**9 + joint.header.stamp.nanosec == STAMP


def test_the_others_follow_what_a_topic_said() -> None:
    group = commands(MULTI, "data[1]", taken=True)
    assert group.written(1.0) is None
    assert group.why_unknown == "no message has come on other_commands"
    group.take_others(Float64MultiArray(data=[5.0, 0.0]))
    assert not group.why_unknown
    assert list(group.written(1.0).data) == [5.0, 1.0]
    # One that lacks the joint changes nothing, and says so.
    group.take_others(Float64MultiArray(data=[6.0]))
    assert "does not fit: data[1]: the array has length 1" in group.why_unknown
    assert list(group.written(2.0).data) == [5.0, 2.0]
    named = commands("sensor_msgs/msg/JointState", "velocity[left]", taken=True)
    for order in (["left", "arm"], ["arm", "left"]):
        named.take_others(JointState(name=order, velocity=[9.0, 9.0]))
        found = named.written(1.0)
        assert dict(zip(found.name, found.velocity, strict=True)) == {"left": 1.0, "arm": 9.0}


@pytest.mark.usefixtures("multi_dof")
def test_degrees_of_freedom_by_name_in_the_order_that_was_given() -> None:
    given = "{dof_names: [b, a], values: [0, 0.5], values_dot: [0, 0]}"
    found = commands(DOUBLES, "values[a]", given).written(2.0)
    assert (found.dof_names, list(found.values)) == (["b", "a"], [0.0, 2.0])
    with pytest.raises(ParameterError, match="2 dof_names, 2 values, 0 values_dot"):
        commands(DOUBLES, "values[a]", "{dof_names: [b, a], values: [0, 0.5]}")
    with pytest.raises(ParameterError, match=r"has no 'c'; it has b, a"):
        commands(DOUBLES, "values[c]", given)
    with pytest.raises(ParameterError, match=r"write values\[a\]"):
        commands(DOUBLES, "values[1]", given)


def test_a_float32_is_compared_as_it_comes_back() -> None:
    single = commands("std_msgs/msg/Float32", "data")
    assert single.on_wire(0.1) != 0.1
    assert single.on_wire(0.1) == pytest.approx(0.1, rel=1e-7)
    assert single.value(Float32(data=single.on_wire(0.1))) == single.on_wire(0.1)
    assert commands("std_msgs/msg/Float64", "data").on_wire(0.1) == 0.1


@pytest.mark.parametrize(
    ("type_name", "field", "given", "sentence"),
    [
        ("std_msgs/msg/Nothing", "data", "", "command_type is 'std_msgs/msg/Nothing', expected"),
        ("geometry_msgs/msg/Twist", "data", "", r"has no field 'data'; it has linear\.x"),
        ("std_msgs/msg/Int16", "data", "", "is a int16; expected a float32 or float64"),
        (MULTI, "data", "{data: [0, 1]}", r"expected one of them, such as data\[0\]"),
        (MULTI, "data[1]", "", r"the array has length 0; give all elements by command_message"),
        (MULTI, "data[1]", "{dat: [0]}", "command_message has dat, expected one of the fields"),
        (MULTI, "data[1]", "{data: [0, x]}", r"data is \[0, 'x'\], expected sequence<double>"),
        (MULTI, "data[1]", "[0, 1]", "expected fields and values"),
        (MULTI, "data[1]", "{data: [", "which is not YAML"),
        ("geometry_msgs/msg/Twist", "linear.x", "{linear: 1}", "linear is 1, expected geometry"),
        ("sensor_msgs/msg/JointState", "effort[l]", "", "has no 'l'; it has no names; give all"),
    ],
)
def test_what_cannot_be_commanded_is_refused(
    type_name: str, field: str, given: str, sentence: str
) -> None:
    with pytest.raises(ParameterError, match=sentence):
        commands(type_name, field, given)


@pytest.mark.parametrize(
    ("field", "message", "others", "sent"),
    [
        ("data", "", "command_message", [2.5]),
        ("data[1]", "{data: [0.0, 1.0]}", "command_message", [0.0, 2.5]),
        ("data[2]", "", "other_commands", [0.0, 1.0, 2.5]),
    ],
)
def test_commands_are_heard_as_the_node_sends_them(
    field: str, message: str, others: str, sent: list[float]
) -> None:
    """A page said of the only element of an array that it is one of several."""
    client: Any = TuneClient.__new__(TuneClient)
    kind = "std_msgs/msg/Float64MultiArray"
    given = dict(zip(NAMES, (kind, field, message, others), strict=True))
    client.name, client.values = "/relay_node", lambda _, names: {n: given[n] for n in names}
    client._topic_of = lambda *_, **__: "/commands"
    hears: list[Any] = []
    client._hearing = lambda _kind, _topic, take: hears.append(take) or nullcontext()
    heard: list[float] = []
    with client.command_watch(heard.append, print)():
        hears[0](Float64MultiArray(data=sent))
    assert heard == [2.5]


def test_two_sources_of_the_others_are_refused() -> None:
    with pytest.raises(ParameterError, match="expected one source"):
        commands(MULTI, "data[1]", "{data: [0, 1]}", taken=True)
    with pytest.raises(ParameterError, match="such as data\\[0\\]"):
        commands(MULTI, "data", taken=True)
