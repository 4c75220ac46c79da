# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A relay on the set-point of a controller that commands its joint itself, as in ros2_control."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from fopdt_plant import FopdtPlant
from loop_rig import RELIABLE, Rig
from ros_domain import free_domain
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from relay_autotune_msgs.msg import RelayExperiment

PERIOD, REST = 0.0025, 1.0
KC, TI = 0.3, 0.1


class Controller:
    """A PI controller of the joint `left`, which tells its state in any order of joints.

    Its time is the number of its cycles: a busy machine makes the loop slow, and not another one.
    While the relay answers, each cycle waits for the answer to the one before.

    :param rig: the rig of its node.
    """

    def __init__(self, rig: Rig) -> None:
        self.plant = FopdtPlant(2.0, 0.05, 0.025)
        self.integral = self.command = 0.0
        self.joints, self.mixed = ["left", "right", "arm"], Random(1)
        self.count, self.answered, self.waits_until = 0, 0, 0.0
        self.heard: list[JointState] = []
        self.states = rig.node.create_publisher(JointState, "measurement", 100)
        rig.node.create_subscription(JointState, "setpoint", self.heard.append, RELIABLE)
        rig.node.create_timer(PERIOD, self.step)

    def step(self) -> None:
        if len(self.heard) == self.answered and time.monotonic() < self.waits_until:
            return
        if len(self.heard) > self.answered:
            self.waits_until = time.monotonic() + 0.5
        self.answered = len(self.heard)
        self.count += 1
        now = PERIOD * self.count
        # The command so far has been held until now.
        y = REST + self.plant.advance(now, self.command) + 1e-3 * ((self.count * 7) % 5 - 2)
        wanted = REST
        if self.heard:
            newest = self.heard[-1]
            wanted = newest.velocity[list(newest.name).index("left")]
        self.integral += KC / TI * (wanted - y) * PERIOD
        self.command = KC * (wanted - y) + self.integral
        order = self.mixed.sample(self.joints, len(self.joints))
        state = JointState(
            name=order,
            velocity=[y if name == "left" else 9.0 for name in order],
            effort=[self.command if name == "left" else 7.0 for name in order],
        )
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        self.states.publish(state)


def apart(record: RelayExperiment, late: int) -> float:
    """Return how far the process, with the recorded commands, is from the measurements at most.

    :param late: by how many cycles the commands are put off.
    """
    plant = FopdtPlant(2.0, 0.05, 0.025)
    held = [0.0] * (1 + late) + list(record.command) if late >= 0 else list(record.command)
    found = [REST + plant.advance(PERIOD * k, u) for k, u in enumerate(held[: len(record.time)])]
    return float(np.abs(np.array(record.measurement) - found).max())


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with free_domain() as domain:
        rig = Rig(domain, tmp_path)
        try:
            yield rig
        finally:
            rig.close()


def test_a_joint_is_tuned_while_its_controller_stays_active(rig: Rig) -> None:
    controller = Controller(rig)
    experiments = rig.listen("relay_experiment", RelayExperiment)
    rig.relay(
        measurement_type="sensor_msgs/msg/JointState",
        measurement_field="velocity[left]",
        controller_command_field="effort[left]",
        relay_on="setpoint",
        setpoint=REST,
        amplitude=0.3,
        settle_time=0.5,
        measurement_timeout=5.0,
        controller_timeout=5.0,
        sample_period=PERIOD,
        command_type="sensor_msgs/msg/JointState",
        command_field="velocity[left]",
        command_message="'{name: [arm, left], velocity: [0.25, 0.0]}'",
    )
    rig.tune()
    ended = rig.until(lambda: experiments, "the record")[0]
    assert ended.outcome == RelayExperiment.COMPLETED, ended.reason
    # The levels are the set-point's, the record is of the process and its commands.
    levels = [round(m.velocity[1], 9) for m in controller.heard]
    assert set(levels) == {0.79, 1.0, 1.39}
    assert levels[-1] == REST
    assert {(*m.name, m.velocity[0]) for m in controller.heard} == {("arm", "left", 0.25)}
    assert apart(ended, late=0) < 0.004
    # Commands that are one cycle late, or early, do not fit.
    assert min(apart(ended, late=1), apart(ended, late=-1)) > 0.008
    # A state without the joint ends a tune with the set-point back.
    rig.tune()
    count = len(controller.heard)
    rig.until(lambda: len(controller.heard) > count + 100, "set-points")
    controller.joints = ["right", "arm"]
    rig.until(lambda: len(experiments) == 2, "the end")
    assert "cannot be read: velocity[left]: the list name has no 'left'" in experiments[1].reason
    assert experiments[1].outcome == RelayExperiment.ABORTED
    rig.until(lambda: controller.heard[-1].velocity[1] == REST, "the set-point")
    controller.joints = ["right", "left"]
    controller.command = 0.0


def test_a_controller_outlives_a_measurement_without_its_joint(rig: Rig) -> None:
    commands = rig.listen("controller_command", Float64, RELIABLE)
    node = rig.start(
        "controller_node",
        measurement_type="sensor_msgs/msg/JointState",
        measurement_field="velocity[left]",
        initial_command=0.25,
    )
    states = rig.node.create_publisher(JointState, "measurement", 100)

    def after(joint: str, condition: Callable[[], Any]) -> Any:
        states.publish(JointState(name=[joint], velocity=[1.0]))
        return condition()

    why = "the measurement cannot be read: velocity[left]"
    rig.until(lambda: after("left", lambda: commands), "a command")
    rig.until(lambda: after("right", lambda: why in node.log or not node.running), "the reason")
    count = len(commands)
    rig.until(lambda: after("left", lambda: len(commands) > count + 50), "commands", 20.0)
    assert {message.data for message in commands} == {0.25}
