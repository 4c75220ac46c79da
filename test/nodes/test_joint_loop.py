# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a robot's description and a manager's list tell of a joint."""

from __future__ import annotations

import pytest

from relay_autotune.errors import LoopError
from relay_autotune.nodes.controller_manager import ManagedController, forwarding, in_the_way
from relay_autotune.nodes.joint_loop import limits_in

DESCRIPTION = """<?xml version="1.0"?>
<robot name="arm">
  <joint name="arm_1" type="revolute">
    <limit lower="-1.5" upper="2" effort="30" velocity="3"/>
  </joint>
  <joint name="wheel" type="continuous"><limit effort="5" velocity="8"/></joint>
  <joint name="free" type="continuous"/>
  <ros2_control name="arm" type="system"><joint name="arm_1">
    <command_interface name="effort"><param name="min">-10</param><param name="max">40</param>
    </command_interface></joint></ros2_control>
</robot>"""


@pytest.mark.parametrize(
    ("joint", "interface", "limits"),
    [
        ("arm_1", "position", (-1.5, 2.0)),
        ("arm_1", "velocity", (-3.0, 3.0)),
        ("arm_1", "effort", (-10.0, 30.0)),
        ("wheel", "effort", (-5.0, 5.0)),
        ("wheel", "position", None),
        ("free", "velocity", None),
        ("unknown", "velocity", None),
    ],
)
def test_the_narrower_of_joint_and_hardware_limits(joint, interface, limits) -> None:
    assert limits_in(DESCRIPTION, joint, interface) == limits


def test_a_description_that_is_none_tells_no_limits() -> None:
    assert limits_in("", "arm_1", "effort") is None
    assert limits_in("<robot><joint", "arm_1", "effort") is None


def controller(name: str, kind: str, *needs: str, active: bool = True) -> ManagedController:
    state = "active" if active else "inactive"
    return ManagedController(name, kind, state, 100.0, needs, needs if active else (), False)


FORWARD = "forward_command_controller/ForwardCommandController"
LOADED = (
    controller("base", "diff_drive_controller/DiffDriveController", "pid/left/velocity"),
    controller("pid", "pid_controller/PidController", "left/effort", "right/effort"),
    controller("arm", "pid_controller/PidController", "arm/effort"),
    controller("all", FORWARD, "left/effort", "right/effort", "arm/effort", active=False),
    controller("one", FORWARD, "left/effort", active=False),
    controller("other", "pid_controller/PidController", "left/effort", active=False),
)


def test_a_chain_is_in_the_way_as_a_whole_and_nothing_else() -> None:
    assert set(in_the_way(LOADED, ["left/effort"])) == {"base", "pid"}
    assert set(in_the_way(LOADED, ["arm/effort"])) == {"arm"}
    assert in_the_way(LOADED, ["gripper/effort"]) == ()


def test_the_forwarding_controller_with_the_fewest_joints_or_the_one_that_is_named() -> None:
    assert forwarding(LOADED, "left/effort", "").name == "one"
    assert forwarding(LOADED, "left/effort", "all").name == "all"
    with pytest.raises(LoopError, match=r"interface_name: effort.*spawner"):
        forwarding(LOADED, "gripper/effort", "")
    with pytest.raises(LoopError, match="type --forward with one of all, one"):
        forwarding(LOADED, "left/effort", "wrong")
