# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""tune_loop on a joint under a stand-in for ros2_control: from two names to verified gains."""

from __future__ import annotations

import os
import re
import shlex
import signal
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Duration
from loop_rig import RELIABLE, Rig
from robot_rig import Robot
from sensor_msgs.msg import JointState
from served import OpenPage
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint


@pytest.fixture
def robot(rig: Rig) -> Robot:
    return Robot(rig)


@pytest.mark.nightly
def test_a_wheel_gets_verified_gains_while_its_controller_stays_active(rig: Rig) -> None:
    # With the new gains it is a set-point weight of about 2, which a prediction without it fails.
    robot = Robot(
        rig,
        **{
            "gains.left_wheel.antiwindup_strategy": "conditional_integration",
            "gains.left_wheel.feedforward_gain": 0.6,
            "enable_feedforward": "true",
        },
    )
    before, file = robot.gains(), rig.folder / "gains.txt"
    done = robot.tune("--export", str(file))
    assert done.wait(240.0) == 0, done.log
    assert "0.6 times the reference is added" in done.log
    assert "verdict          passed" in done.log
    assert "Designed for control_toolbox_conditional_integration every 0.01 s" in file.read_text()
    after = robot.gains()
    assert after != before and after[0] > 0.5
    assert robot.history() == ["wheel_controller"]


@pytest.mark.nightly
def test_a_joint_is_tuned_on_a_page_which_verifies_gains_between_two_tunes(rig: Rig) -> None:
    robot = Robot(rig)
    before = robot.gains()
    command = robot.tune("--web")
    found = rig.until(lambda: re.search(r"the page is at (\S+)", command.log), "the address", 60.0)
    page = OpenPage(found[1])

    def accepts() -> bool:
        return not page.plan(rig.until)["refusal"]

    rig.until(lambda: page.snapshot, "what is known")
    rig.until(accepts, "a check that accepts", 60.0)
    plan = page.snapshot["plan"]
    assert [row["name"] for row in plan["form"]] == ["within", "amplitude"]
    told = {name: found for _, name, found in plan["lines"]}
    assert told["moves"].startswith("the reference of left_wheel about")
    page.do("start")
    rig.until(lambda: page.snapshot["status"] == "the tune is complete", "the tune", 240.0)
    assert robot.gains() == before
    rig.until(lambda: page.snapshot["controller"].endswith("/controller_node"), "it", 60.0)
    gains = {"of": 0, "asked": page.subjects[0]["first"], "accept_doubtful": True}
    plan = page.plan(rig.until, "prove", **gains)
    assert not plan["refusal"]
    (step,) = plan["form"][0]["values"]
    page.do("prove", step=step, **gains)
    rig.until(lambda: "verification" in page.snapshot["status"], "the verification", 120.0)
    assert page.snapshot["status"].startswith("verification passed"), page.snapshot["status"]
    assert robot.gains() != before
    # It makes way for the next tune.
    rig.until(accepts, "a second check that accepts", 60.0)
    command.signal(signal.SIGINT)
    assert command.wait(60.0) in (0, 3), command.log
    assert robot.history() == ["wheel_controller"]


@pytest.mark.nightly
def test_an_opened_joint_gets_verified_gains_and_its_controller_back(robot: Robot) -> None:
    before = robot.gains()
    done = robot.tune("--open")
    assert done.wait(240.0) == 0, done.log
    assert "verdict          passed" in done.log
    assert robot.gains() != before
    assert robot.history() == ["wheel_controller", "forward_left", "wheel_controller"]


def test_a_joint_under_a_trajectory_controller_is_tuned_opened_alone(rig: Rig) -> None:
    arm = Robot(rig, "trajectory")
    refused, shown = arm.tune(), arm.tune("--open", "--dry-run")
    assert refused.wait() == 1
    assert "its references are trajectories, which a relay cannot move; give --open" in refused.log
    assert shown.wait(60.0) == 0, shown.log
    said = " ".join(shown.log.split())
    # forward_one has fewer joints, but would leave the other one limp.
    assert "arm_controller off and forward_arm on, in one strict request" in said
    assert "moves the effort of arm_2 itself, about" in said
    assert "gains.arm_2.p/i/d at once, read back, not verified by a step" in said
    assert "control_toolbox_legacy_velocity, every 10 ms" in said
    assert arm.history() == ["arm_controller"]


@pytest.mark.nightly
def test_a_joint_under_a_trajectory_controller_gets_gains_and_its_controller_back(
    rig: Rig,
) -> None:
    arm = Robot(rig, "trajectory")
    before, file = arm.gains(), rig.folder / "gains.txt"
    told = rig.listen("/forward_arm/commands", Float64MultiArray, RELIABLE)
    done = arm.tune("--open", "--export", str(file))
    assert done.wait(240.0) == 0, done.log
    after = arm.gains()
    assert after != before and after[2] > 0.0
    assert arm.history() == ["arm_controller", "forward_arm", "arm_controller"]
    assert abs(told[0].data[0]) < 0.05
    said = " ".join(done.log.split())
    assert "p {:.6g}, i {:.6g}, d {:.6g}; before: p 6, i 0, d 0".format(*after) in said
    assert "not verified its references are trajectories: give it a short trajectory" in said
    assert "--once /arm_controller/joint_trajectory trajectory_msgs/msg/JointTrajectory" in said
    assert "Designed for control_toolbox_legacy_velocity every 0.01 s" in file.read_text()
    # A twentieth of -1.3 to 0.7, towards the middle, and the other joint stays.
    line = next(line for line in done.log.splitlines() if "ros2 topic pub" in line)
    went = follows(rig, line)
    assert went == pytest.approx({"arm_1": 0.0, "arm_2": 0.1}, abs=0.01)


def follows(rig: Rig, line: str) -> dict[str, float]:
    """Do what `ros2 topic pub` does with a trajectory; return how far each joint went with it.

    :param line: what is typed.
    """
    *words, topic, kind, text = shlex.split(line)
    assert words == ["ros2", "topic", "pub", "--once"]
    assert kind == "trajectory_msgs/msg/JointTrajectory"
    given = yaml.safe_load(text)
    names, ((goal, after),) = given["joint_names"], [p.values() for p in given["points"]]
    point = JointTrajectoryPoint(positions=goal, time_from_start=Duration(**after))
    states = rig.listen("/joint_states", JointState, RELIABLE)

    def now() -> np.ndarray:
        """Return the mean positions of a while, in the order of the trajectory."""
        states.clear()
        rig.until(lambda: len(states) > 30, "the states")
        told = [dict(zip(state.name, state.position, strict=True)) for state in states]
        return np.mean([[each[name] for name in names] for each in told], axis=0)

    before = now()
    mouth = rig.node.create_publisher(JointTrajectory, topic, RELIABLE)
    rig.until(mouth.get_subscription_count, "the controller")
    mouth.publish(JointTrajectory(joint_names=names, points=[point]))
    rig.until(lambda: np.abs(now() - goal).max() < 0.01, "the end of the trajectory")
    return dict(zip(names, goal - before, strict=True))


@pytest.mark.nightly
def test_a_chain_is_opened_as_a_whole_and_closed_again_when_the_tune_is_cancelled(
    rig: Rig,
) -> None:
    robot = Robot(rig, "chain")
    refused = robot.tune()
    assert refused.wait() == 1
    said = " ".join(refused.log.split())
    assert "its references come from base_controller, which has to be inactive" in said
    assert "-c /controller_manager --deactivate base_controller;" in said
    tune = robot.tune("--open")
    rig.until(lambda: "stepped to" in tune.log, "the kick", 120.0)
    tune.signal(signal.SIGINT)
    assert tune.wait(60.0) != 0
    whole = "base_controller wheel_controller"
    rig.until(lambda: robot.history() == [whole, "forward_left", whole], "the chain")
    assert "wheel_controller, base_controller off and forward_left on" in tune.log


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("kind", "above", "forward", "had"),
    [
        ("chain", "base_controller", "forward_left", "p 0.3, i 0.6, d 0"),
        ("followed", "path_controller", "forward_arm", "p 6, i 0, d 0"),
    ],
)
def test_gains_of_a_chained_controller_are_set_without_a_step(
    rig: Rig, kind: str, above: str, forward: str, had: str
) -> None:
    robot = Robot(rig, kind)
    done = robot.tune("--open")
    assert done.wait(240.0) == 0, done.log
    said = " ".join(done.log.split())
    assert f"references come from {above}: move it by {above}, and see" in said
    after = robot.gains()
    tracking = r", tracking_time_constant [\d.]+"
    gains = re.escape("p {:.6g}, i {:.6g}, d {:.6g}".format(*after))
    assert re.search(f"read back: {gains}{tracking}; before: {had}{tracking}", said)
    whole = " ".join(sorted((above, robot.controller)))
    assert robot.history() == [whole, forward, whole]
    if kind == "followed":
        # The chain works again, with the new gains.
        message = "{joint_names: [arm_2, arm_1], points: [{positions: [-0.1, 0.4], "
        message += "time_from_start: {sec: 1}}]}"
        line = f"ros2 topic pub --once /{above}/joint_trajectory "
        went = follows(rig, f"{line} trajectory_msgs/msg/JointTrajectory '{message}'")
        assert went == pytest.approx({"arm_1": -0.1, "arm_2": 0.2}, abs=0.02)


PLAN = (
    "wheel_controller off and forward_left on, in one strict request; back after it",
    "right_wheel keeps its last command, with no controller meanwhile",
    "switch_controllers --strict -c /controller_manager --activate wheel_controller",
)


@pytest.mark.nightly
def test_a_dry_run_switches_nothing_and_says_what_would_move(robot: Robot) -> None:
    done = robot.tune("--open", "--dry-run")
    assert done.wait(60.0) == 0, done.log
    assert not [line for line in PLAN if line not in " ".join(done.log.split())]
    assert robot.history() == ["wheel_controller"]


@pytest.mark.skipif(find_spec("controller_manager_msgs") is not None, reason="it is installed")
def test_without_the_messages_of_ros2_control_one_line_says_what_to_install(rig: Rig) -> None:
    done = rig.start_command("tune_loop", "--controller", "any", "--joint", "joint")
    assert done.wait() == 1
    told = " ".join(done.log.split())
    assert "sudo apt install ros-jazzy-controller-manager-msgs" in told
    assert "Traceback" not in told


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--joint", "wheel"), "no joint wheel: expected one of left_wheel, right_wheel"),
        (("--controller", "pid"), "has no controller pid: found wheel_controller"),
        (("--controller", "forward_left"), "is a forward_command_controller"),
        (("--controller-manager", "cm"), "of those that list_controllers: /controller_manager"),
        (("--open", "--forward", "other"), "type --forward with one of forward_left"),
    ],
)
def test_what_cannot_be_found_gets_one_line(
    robot: Robot, words: tuple[str, ...], told: str
) -> None:
    done = robot.tune(*words, "--wait", "5")
    assert done.wait() == 1
    assert told in " ".join(done.log.split())
    assert robot.history() == ["wheel_controller"]


def children_of(pid: int, name: str) -> int:
    """Return the process of a node that a process has started."""
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        if name in Path(f"/proc/{child}/cmdline").read_text():
            return int(child)
    raise AssertionError(f"{name} does not run")


@pytest.mark.nightly
@pytest.mark.parametrize(
    "what",
    ["Ctrl-C", "SIGTERM", "SIGHUP", "relay killed", "forwarding dies", "refused"],
)
def test_whatever_ends_an_opened_tune_the_former_controller_is_active_again(
    robot: Robot, what: str
) -> None:
    if what == "refused":
        robot.order("refuse")
    tune = robot.tune("--open")
    if what != "refused":
        robot.rig.until(lambda: "stepped to" in tune.log, "the kick", 120.0)
        assert robot.history()[-1] == "forward_left"
    if what == "relay killed":
        os.kill(children_of(tune.pid, "relay_node"), signal.SIGKILL)
    elif what == "forwarding dies":
        robot.order("die forward_left")
    elif what != "refused":
        tune.signal(signal.SIGINT if what == "Ctrl-C" else getattr(signal, what))
    assert tune.wait(60.0) != 0
    robot.rig.until(lambda: robot.history()[-1] == "wheel_controller", "the controller")
    said = {
        "relay killed": "relay_node was ended by signal 9 (Killed)",
        "forwarding dies": "forward_left is inactive",
        "refused": "refuses to switch controllers: the hardware does not allow that",
    }.get(what, "cancelling")
    assert said in tune.log
    assert not [line for line in PLAN if line not in " ".join(tune.log.split())]
    assert "passed" not in tune.log


@pytest.mark.nightly
def test_a_controller_that_dies_during_its_tune_is_told_and_left_as_it_is(robot: Robot) -> None:
    tune = robot.tune()
    robot.rig.until(lambda: "stepped to" in tune.log, "the step", 120.0)
    robot.order("die wheel_controller")
    assert tune.wait(60.0) == 1
    assert "wheel_controller is inactive: it was deactivated" in tune.log
    robot.rig.until(lambda: robot.history() == ["wheel_controller", ""], "the end of it")


@pytest.mark.nightly
def test_a_link_of_an_arm_is_tuned_within_the_limits_of_its_description(rig: Rig) -> None:
    arm = Robot(rig, "arm")
    before = arm.gains()
    done = arm.tune()
    assert done.wait(240.0) == 0, done.log
    assert "-1.3 to 0.7 (robot_description)" in done.log
    assert "verdict          passed" in done.log
    assert arm.gains() != before
    assert arm.history() == ["arm_controller"]


@pytest.mark.nightly
def test_the_other_link_of_an_opened_arm_keeps_its_command(rig: Rig) -> None:
    arm = Robot(rig, "arm")
    told = rig.listen("/forward_arm/commands", Float64MultiArray, RELIABLE)
    tune = arm.tune("--open")
    rig.until(lambda: "cycle 1" in tune.log, "a cycle", 120.0)
    tune.signal(signal.SIGINT)
    assert tune.wait(60.0) != 0
    rig.until(lambda: arm.history()[-1] == "arm_controller", "the controller")
    assert "holds         arm_1/effort" in tune.log
    # The first is arm_2, as the forwarding controller has its joints.
    ours, others = (np.array([m.data[k] for m in told]) for k in (0, 1))
    assert np.ptp(ours) > 0.2
    assert np.ptp(others) == 0.0
    assert abs(others[0]) < 0.05
    assert np.abs(ours).max() <= 4.0
