# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""`replay --joint`: a model and gains of each joint in a robot's recording."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from robot_bags import Robot, model_of, write_robot

from relay_autotune.cli import replay

JOINTS = ["left", "right", "arm"]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a bag in which the relay has moved two of three joints."""
    robot = Robot(JOINTS, JOINTS[:2], 300)
    return str(
        write_robot(
            tmp_path_factory.mktemp("robot") / "bag.mcap",
            robot.samples,
            joint_states=("sensor_msgs/msg/JointState", robot.joint_state),
            group__commands=("std_msgs/msg/Float64MultiArray", robot.commands),
        )
    )


@pytest.mark.nightly
def test_each_joint_of_a_bag_is_a_row_with_its_own_model(bag: str, tmp_path: Path) -> None:
    rows = tmp_path / "rows.csv"
    joints = [word for joint in JOINTS[:2] for word in ("--joint", joint)]
    status = replay.main([bag, *joints, "--joint-order", ",".join(JOINTS), "--output", str(rows)])
    assert status == 0
    with rows.open() as file:
        found = {row["bag"]: row for row in csv.DictReader(file)}
    assert list(found) == [f"{bag} left", f"{bag} right"]
    for place, row in enumerate(found.values()):
        assert float(row["gain"]) == pytest.approx(float(model_of(place).gain), rel=0.1)
        assert float(row["kc"]) > 0.0


@pytest.mark.long
def test_a_joint_of_a_bag_becomes_a_file_for_its_controller(
    bag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = [bag, "--joint", "right", "--joint-order", "left,right,arm"]
    assert replay.main([*asked, "--export", "pid_controller", "--accept-doubtful"]) == 0
    printed = capsys.readouterr()
    assert "right:" in printed.out
    assert "--command '/group/commands:data[1]'" in printed.err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--joint", "{bag}"], "is a recording; to take all experiments as tests of one process, "
         "write --jointly"),
        (["--joint", "lft"], "has no joint 'lft'; /joint_states name "),
        (["--joint-order", "left,right"], "--joint-order is for a joint"),
        (["--joint", "arm", "--joint-order", "left,right"], "does not have the joint arm"),
        (["--joint", "left", "--joint-order", "left,left"], "names a joint twice"),
    ],
)  # fmt: skip
def test_joints_that_cannot_be_end_with_status_2(
    bag: str, capsys: pytest.CaptureFixture[str], words: list[str], sentence: str
) -> None:
    assert replay.main([bag, *(word.format(bag=bag) for word in words)]) == 2
    assert sentence in capsys.readouterr().err
