# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Elements of arrays by their names, in any order, in bytes and in Python objects alike."""

from __future__ import annotations

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from relay_autotune.bag.bag_file import McapFile
from relay_autotune.bag.cdr import Path
from relay_autotune.bag.definitions import Channel, message_type
from relay_autotune.bag.field_path import reading, some_numbers, steps_of
from relay_autotune.bag.topics import Topics
from relay_autotune.errors import BagError, FieldError, SelectionError

# Fields as those of sensor_msgs/JointState, control_msgs/MultiDOFCommand, MultiDOFStateStamped,
# DynamicJointState and JointTrajectoryControllerState.
SEPARATOR = "=" * 80
DEFINITIONS = {
    "x_msgs/msg/Joints": "string frame\nstring[] name\nfloat64[] position\nfloat64[] velocity\n",
    "x_msgs/msg/Command": "string[] dof_names\nfloat64[] values\nstring[] other\nfloat32 last\n",
    "x_msgs/msg/Late": "float64[] values\nstring[] joint_names\n",
    "x_msgs/msg/States": f"x_msgs/State[] dof_states\n{SEPARATOR}\nMSG: x_msgs/State\n"
    "int16 id\nstring name\nfloat64 feedback\nuint8 last\n",
    "x_msgs/msg/Dynamic": "string[] joint_names\nx_msgs/Values[] interface_values\n"
    f"{SEPARATOR}\nMSG: x_msgs/Values\nstring[] interface_names\nfloat64[] values\n",
    "x_msgs/msg/Trajectory": "string[] joint_names\nx_msgs/Point feedback\n"
    f"string[] multi_dof_joint_names\n{SEPARATOR}\nMSG: x_msgs/Point\nfloat64[] positions\n",
    "x_msgs/msg/Two": "string[] name\nstring[] joint_names\nfloat64[] values\n",
}
JOINTS = ["left", "right", "lef", "left_wheel", "é", "7", "arm/joint 1"]


class Kind:
    """A type of these definitions, its messages and their bytes."""

    def __init__(self, name: str) -> None:
        self.name, text = f"x_msgs/msg/{name}", DEFINITIONS[f"x_msgs/msg/{name}"]
        self.store = get_typestore(Stores.EMPTY)
        self.store.register(get_types_from_msg(text, self.name))
        self.root = message_type(Channel(1, "/t", self.name, "cdr", "ros2msg", text.encode()))

    def make(self, *values, kind=""):
        return self.store.types[f"x_msgs/msg/{kind}" if kind else self.name](*values)

    def path(self, text):
        return Path(self.root, steps_of(self.root, text, "/t"))

    def read(self, text, messages, little=True):
        """Return the numbers in the bytes of messages, and which of them have it."""
        data = [
            bytes(self.store.serialize_cdr(m, self.name, little_endian=little)) for m in messages
        ]
        # Bytes before and after show an offset that is wrong.
        ends = 5 + np.cumsum([len(d) for d in data])
        begins = ends - [len(d) for d in data]
        return self.path(text).read(b"\x07" * 5 + b"".join(data) + b"\x07" * 9, begins, ends)

    def value(self, text, message):
        return reading(steps_of(self.root, text, "/t"))(message)


def joints(kind, names, position, velocity=()):
    return kind.make(
        "base", list(names), np.array(position, float), np.array(velocity, dtype=float)
    )


@pytest.mark.long
@pytest.mark.parametrize("little", [True, False])
def test_a_thousand_orders_never_give_a_wrong_element(little):
    rng = np.random.default_rng(5)
    truth = dict(zip(JOINTS, rng.standard_normal((7, 1000)), strict=True))
    orders = [list(rng.permutation(JOINTS)[: rng.integers(1, 8)]) for _ in range(1000)]

    def of(order, k):
        return [truth[name][k] for name in order]

    made = {
        "Joints": lambda kind, o, k: joints(kind, o, np.zeros(len(o)), of(o, k)),
        "Command": lambda kind, o, k: kind.make(o, np.array(of(o, k)), ["left"], 1.0),
        "Late": lambda kind, o, k: kind.make(np.array(of(o, k)), o),
        "States": lambda kind, o, k: kind.make(
            [kind.make(JOINTS.index(n), n, truth[n][k], 3, kind="State") for n in o]
        ),
        "Trajectory": lambda kind, o, k: kind.make(
            o, kind.make(np.array(of(o, k)), kind="Point"), ["left"]
        ),
    }
    paths = {
        "Joints": "velocity[{}]", "Command": "values[dof_names={}]", "Late": "values[{}]",
        "States": "dof_states[name={}].feedback", "Trajectory": "feedback.positions[{}]",
    }  # fmt: skip
    for name, make in made.items():
        kind = Kind(name)
        messages = [make(kind, order, k) for k, order in enumerate(orders)]
        for joint in JOINTS:
            path = paths[name].format(f"joint_names={joint}" if name == "Late" else joint)
            if joint == "7" and name in ("Joints", "Trajectory"):
                # Digits alone are a place.
                path = path.replace("[7]", f"[{'name' if name == 'Joints' else 'joint_names'}=7]")
            there = [joint in order for order in orders]
            values, good = kind.read(path, messages, little)
            assert good.tolist() == there
            np.testing.assert_array_equal(values[good], truth[joint][there])
            read = reading(steps_of(kind.root, path, "/t"))
            for k, message in enumerate(messages):
                if there[k]:
                    assert read(message) == truth[joint][k]
                else:
                    with pytest.raises(FieldError, match="has no"):
                        read(message)


def test_elements_within_elements_by_two_lists():
    kind, rng = Kind("Dynamic"), np.random.default_rng(2)
    messages, expected = [], []
    for k in range(200):
        names = list(rng.permutation(["left", "right", "arm"]))
        faces = [list(rng.permutation(["position", "velocity", "effort"])) for _ in names]
        values = {name: rng.standard_normal(3) for name in names}
        messages.append(
            kind.make(
                names,
                [
                    kind.make(f, values[n][: len(f)], kind="Values")
                    for n, f in zip(names, faces, strict=True)
                ],
            )
        )
        own = faces[names.index("right")]
        expected.append(values["right"][own.index("velocity")])
        assert kind.value("interface_values[right].values[velocity]", messages[-1]) == expected[k]
    values, good = kind.read("interface_values[right].values[velocity]", messages)
    assert good.all()
    np.testing.assert_array_equal(values, expected)


def test_an_element_by_a_whole_number_of_it_and_by_its_name_alone():
    kind = Kind("States")
    messages = [
        kind.make([kind.make(i, f"j{i}", 10.0 * i + k, 0, kind="State") for i in order])
        for k, order in enumerate([(3, 1, -2), (1, -2, 3)])
    ]
    for path in ("dof_states[id=-2].feedback", "dof_states[j-2].feedback"):
        values, good = kind.read(path, messages)
        assert good.all() and values.tolist() == [-20.0, -19.0]
        assert [kind.value(path, m) for m in messages] == [-20.0, -19.0]


@pytest.mark.parametrize(
    ("path", "names", "position", "sentence"),
    [
        ("position[lft]", ["left", "right"], [1, 2],
         r"the list name has no 'lft'; it has left, right; write position\[left\]"),
        ("position[left]", ["left", "arm", "left"], [1, 2, 3], r"has 'left' 2 times, so that it"),
        ("position[left]", ["left", "right"], [], "has length 2, but the array 0"),
        ("position[left]", [], [1], r"has no 'left'; it has no names"),
        ("position[1]", ["left", "right"], [1, 2],
         r"position\[1\]: this message names its elements; write position\[right\]"),
        ("position[1]", ["left", "7"], [1, 2], r"write position\[name=7\]"),
        ("position[2]", ["left"], [1, 2], "the array has length 2"),
    ],
)  # fmt: skip
def test_what_is_not_clear_is_refused_with_the_right_spelling(path, names, position, sentence):
    kind = Kind("Joints")
    message = joints(kind, names, position)
    with pytest.raises(FieldError, match=sentence):
        kind.value(path, message)
    with pytest.raises(FieldError, match=sentence):
        raise FieldError(kind.path(path).why(kind.store.serialize_cdr(message, kind.name)))
    if "2 times" in sentence or path == "position[1]":
        # One such message among others is enough.
        with pytest.raises(FieldError, match=r"write|2 times"):
            kind.read(path, [joints(kind, [], [4, 5]), message])
    else:
        assert not kind.read(path, [message])[1].any()


def test_places_are_taken_where_nothing_names_the_elements():
    kind = Kind("Joints")
    messages = [joints(kind, [], [1, 2]), joints(kind, ["left"], [3, 4])]
    values, good = kind.read("position[1]", messages)
    assert good.all() and values.tolist() == [2.0, 4.0]
    assert [kind.value("position[1]", m) for m in messages] == [2.0, 4.0]


@pytest.mark.parametrize(
    ("name", "path", "sentence"),
    [
        ("Two", "values[left]", r"write \[name=left\] or \[joint_names=left\]"),
        ("Joints", "velocity[names=left]", "no names 'names' for"),
        ("Joints", "velocity[left", "is not the name of a field"),
        ("Joints", "velocity[]", "is not the name of a field"),
        ("Joints", "effort[left]", r"it has position\[NAME\], velocity\[NAME\]"),
        ("States", "dof_states[left]", r"is not a number; .* dof_states\[name=left\].id"),
        ("Dynamic", "interface_values[left].values[other=x]", "no names 'other'"),
    ],
)
def test_paths_that_a_type_does_not_have(name, path, sentence):
    with pytest.raises(FieldError, match=sentence):
        Kind(name).path(path)


def test_numbers_are_listed_as_they_are_to_be_written():
    assert some_numbers(Kind("States").root) == (
        "dof_states[name=NAME].id, dof_states[name=NAME].feedback, dof_states[name=NAME].last"
    )
    assert some_numbers(Kind("Dynamic").root) == "interface_values[NAME].values[NAME]"


def bag_of_joints(path, orders):
    """Write a bag of /joint_states in which `left` is 10 k + 1, in these orders of the joints."""
    kind = Kind("Joints")
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        text = DEFINITIONS[kind.name].encode()
        schema = writer.register_schema(kind.name, "ros2msg", text)
        topic = writer.register_channel("/joint_states", "cdr", schema)
        for k, order in enumerate(orders):
            value = {"left": 10.0 * k + 1.0, "right": -5.0}
            message = joints(kind, order, [value.get(name, 0.0) for name in order])
            data = bytes(kind.store.serialize_cdr(message, kind.name))
            writer.add_message(topic, 10**18 + k, data, 10**18 + k, k)
        writer.finish()
    return path


def signal_of(path, name):
    with McapFile(path) as file:
        return Topics(path, [file]).signals([name])[name]


def test_a_bag_of_joints_is_read_by_name(tmp_path):
    orders = [["left", "right"], ["right", "left"], ["gripper"], ["arm", "left", "right"]]
    path = bag_of_joints(tmp_path / "bag.mcap", orders)
    found = signal_of(path, "/joint_states:position[left]")
    assert found.values.tolist() == [1.0, 11.0, 31.0]
    (note,) = found.notes
    assert "1 of 4 messages" in note and "has no 'left'; it has gripper" in note


@pytest.mark.parametrize(
    ("field", "sentence"),
    [
        ("position[lft]", r"none of the 3 messages of /joint_states:position\[lft\] has it: .*"
         r"it has left, right; write position\[left\]"),
        ("position[1]", r"/joint_states: position\[1\]: .*; write position\[right\]"),
        ("position[twice]", r"/joint_states: .* has 'twice' 2 times"),
    ],
)  # fmt: skip
def test_a_bag_whose_names_are_not_clear_is_refused(tmp_path, field, sentence):
    orders = [["left", "right"], ["left", "right"], ["twice", "twice"]]
    path = bag_of_joints(tmp_path / "bag.mcap", orders)
    with pytest.raises(SelectionError, match=sentence):
        signal_of(path, f"/joint_states:{field}")


def test_a_message_that_claims_millions_of_names_is_given_up_soon():
    kind = Kind("Joints")
    message = joints(kind, ["left"], [0.0])
    data = bytearray(kind.store.serialize_cdr(message, kind.name))
    # The number of names follows "base" and its zero, aligned.
    assert data[16:20] == b"\x01\0\0\0"
    data[16:20] = (2**31).to_bytes(4, "little")
    content = bytes(data) + bytes(1_000_000)
    ends = np.array([len(content)])
    with pytest.raises(BagError, match="too far into a message"):
        kind.path("position[left]").read(content, np.array([0]), ends)


def test_names_beside_texts_of_unknown_length_are_refused_in_words():
    text = "float64[] values\nstring[] name\nwstring remark\n"
    root = message_type(Channel(1, "/t", "x_msgs/msg/Wide", "cdr", "ros2msg", text.encode()))
    # Two values, two names that are the same; the remark cannot be decoded.
    values = (2).to_bytes(4, "little") + bytes(4) + np.array([1.0, 2.0]).tobytes()
    name = (2).to_bytes(4, "little") + b"a\0\0\0"
    data = b"\0\1\0\0" + values + (2).to_bytes(4, "little") + name * 2 + bytes(8)
    path = Path(root, steps_of(root, "values[a]", "/t"))
    with pytest.raises(FieldError, match=r"values\[a\]: the names are not clear"):
        path.read(data, np.array([0]), np.array([len(data)]))
