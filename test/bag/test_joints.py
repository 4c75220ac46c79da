# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A joint's measurement and command, found in a robot's recording by its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robot_bags import Robot, write_robot

from relay_autotune.bag.pairing import plausible_pairs
from relay_autotune.bag.signals import Selection, Signal
from relay_autotune.errors import SelectionError
from relay_autotune.recordings import Recording, read_experiments

JOINTS = ["left_wheel", "right_wheel", "arm"]
STATES, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
CONTROLLER = "control_msgs/msg/MultiDOFStateStamped"
TRAJECTORY = "control_msgs/msg/JointTrajectoryControllerState"
DYNAMIC, COMMAND = "control_msgs/msg/DynamicJointState", "control_msgs/msg/MultiDOFCommand"


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(JOINTS, ["right_wheel"])


@pytest.fixture(scope="module")
def both() -> Robot:
    return Robot(JOINTS, ["left_wheel", "right_wheel"])


def same(found: Recording, robot: Robot, joint: str) -> None:
    (record,) = found.experiments
    truth = robot.records[joint]
    count = len(record)
    shift = len(truth) - count
    np.testing.assert_array_equal(record.measurement, truth.measurement[shift:])
    np.testing.assert_array_equal(record.command, truth.command[shift:])


def read(path: Path, joint: str, **wanted: object) -> Recording:
    return read_experiments(path, Selection(joint=joint, start=0.0, **wanted))  # type: ignore[arg-type]


def test_the_state_of_a_controller_has_both(tmp_path: Path, both: Robot) -> None:
    path = write_robot(
        tmp_path / "bag.mcap", both.samples, joint_states=(STATES, both.joint_state),
        pid__controller_state=(CONTROLLER, both.controller_state),
        commands=(ARRAY, both.commands),
    )  # fmt: skip
    for joint in ("left_wheel", "right_wheel"):
        found = read(path, joint)
        same(found, both, joint)
        state = f"/pid/controller_state:dof_states[name={joint}]"
        names = f"--measurement '{state}.feedback' --command '{state}.output'"
        assert f"using {names}: both name {joint}" in found.notes[0]


@pytest.mark.parametrize("kind", ["joint_states", "dynamic"])
def test_states_and_commands_of_a_group(tmp_path: Path, robot: Robot, kind: str) -> None:
    states = {
        "joint_states": (STATES, robot.joint_state),
        "dynamic": (DYNAMIC, robot.dynamic_state),
    }
    topics = {kind: states[kind], "group__commands": (ARRAY, robot.commands)}
    path = write_robot(tmp_path / "bag.mcap", robot.samples, **topics)  # type: ignore[arg-type]
    found = read(path, "right_wheel")
    same(found, robot, "right_wheel")
    assert "--command '/group/commands:data[1]': " in found.notes[0]
    assert "moves most, and data[1] alone changes" in found.notes[0]
    # Another joint rests: it is not taken for what the command moves.
    with pytest.raises(
        SelectionError, match=r"but .*\[right_wheel\].* moves more .* --joint-order"
    ):
        read(path, "left_wheel")


def test_commands_that_name_their_joints(tmp_path: Path, both: Robot) -> None:
    path = write_robot(
        tmp_path / "bag.mcap", both.samples, joint_states=(STATES, both.joint_state),
        group__commands=(COMMAND, both.named_commands),
    )  # fmt: skip
    for joint in ("left_wheel", "right_wheel"):
        found = read(path, joint)
        same(found, both, joint)
        assert f"--command '/group/commands:values[{joint}]': both name {joint}" in found.notes[0]


def test_the_state_of_a_trajectory_controller(tmp_path: Path, both: Robot) -> None:
    path = write_robot(
        tmp_path / "bag.mcap", both.samples, arm__controller_state=(TRAJECTORY, both.trajectory),
        joint_states=(STATES, both.joint_state),
    )  # fmt: skip
    for joint in ("left_wheel", "right_wheel"):
        found = read(path, joint)
        same(found, both, joint)
        assert f"/arm/controller_state:feedback.velocities[{joint}]" in found.notes[0]
        assert f"/arm/controller_state:output.effort[{joint}]" in found.notes[0]
    # Without a joint there is no pair, and the refusal says what to type.
    with pytest.raises(SelectionError, match="or name a joint with --joint"):
        read_experiments(path)


def test_several_commands_need_the_order_of_the_joints(tmp_path: Path, both: Robot) -> None:
    path = write_robot(
        tmp_path / "bag.mcap", both.samples, joint_states=(STATES, both.joint_state),
        group__commands=(ARRAY, both.commands),
    )  # fmt: skip
    with pytest.raises(
        SelectionError, match=r"several commands change; (.|\n)*data\[1\]'\n  --joint-order JOINT"
    ):
        read(path, "left_wheel")
    for joint in ("left_wheel", "right_wheel"):
        same(read(path, joint, joint_order=tuple(JOINTS)), both, joint)
        place = JOINTS.index(joint)
        same(read(path, joint, command=f"/group/commands:data[{place}]"), both, joint)
    with pytest.raises(SelectionError, match="no command is there that changes"):
        read(path, "left_wheel", joint_order=("left_wheel", "right_wheel"))


def test_the_field_may_be_said_for_all_joints(tmp_path: Path, both: Robot) -> None:
    def moving(k: int) -> object:
        state = both.joint_state(k)
        state.position = 0.5 * state.velocity
        return state

    path = write_robot(
        tmp_path / "bag.mcap", both.samples, joint_states=(STATES, moving),
        group__commands=(COMMAND, both.named_commands),
    )  # fmt: skip
    with pytest.raises(
        SelectionError, match=r"several measurements change.*\n.*position\n.*:velocity$"
    ):
        read(path, "left_wheel")
    for joint in ("left_wheel", "right_wheel"):
        same(read(path, joint, measurement="/joint_states:velocity"), both, joint)


@pytest.mark.parametrize(
    ("joint", "sentence"),
    [
        ("left_whel", r"no joint 'left_whel'; /joint_states name .*; write --joint left_wheel"),
        ("arm", r"no measurement is there that changes|moves more than"),
    ],
)
def test_joints_that_are_not_there(
    tmp_path: Path, robot: Robot, joint: str, sentence: str
) -> None:
    path = write_robot(
        tmp_path / "bag.mcap", robot.samples, joint_states=(STATES, robot.joint_state),
        group__commands=(ARRAY, robot.commands),
    )  # fmt: skip
    with pytest.raises(SelectionError, match=sentence):
        read(path, joint)


def test_a_bag_without_joints(tmp_path: Path, robot: Robot) -> None:
    path = write_robot(tmp_path / "bag.mcap", 20, commands=(ARRAY, robot.commands))
    with pytest.raises(SelectionError, match="has no topic whose messages name joints"):
        read(path, "arm")


def test_a_named_command_is_paired_although_its_name_is_that_of_a_measurement():
    time_ns = np.arange(400) * 10**8
    wave = np.sin(np.arange(400) / 20.0)
    steps = np.where(np.arange(400) // 100 % 2, 1.0, 0.0)
    speed, current, pwm = (
        Signal(f"/wheel/{name}", time_ns, values)
        for name, values in (("speed", wave), ("current", 1.5 + wave**2), ("pwm", steps))
    )
    ((*names, _),) = plausible_pairs((speed, current, pwm), command="/wheel/speed")
    assert names == ["/wheel/current", "/wheel/speed"]
    ((*names, _),) = plausible_pairs((speed, current, pwm), measurement="/wheel/speed")
    assert names == ["/wheel/speed", "/wheel/pwm"]
