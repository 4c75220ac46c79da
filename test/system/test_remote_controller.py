# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The gains of another node's controller: set through parameters, verified by its set-point."""

from __future__ import annotations

import pytest
from action_msgs.msg import GoalStatus
from loop_rig import Rig
from remote_loop import Loop, ReportingLoop
from std_msgs.msg import Float64


def test_the_gains_of_another_node_are_proved_or_taken_back(rig: Rig) -> None:
    loop = Loop(rig)
    loop.apply(0.5, 1.6, 2.0)
    assert loop.values() == [0.5, 1.6, 0.0]
    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_ABORTED
    assert "the set-point of /pid_controller is not known" in result.reason
    setpoint = rig.node.create_publisher(Float64, "setpoint", 10)
    rig.until(lambda: setpoint.get_subscription_count() == 3, "both controllers")
    setpoint.publish(Float64(data=5.0))
    rig.run_for(0.3)
    status, result = loop.verify(setpoint_step=0.5, load_step=0.1)
    assert status == GoalStatus.STATUS_ABORTED
    assert "no load step can be added" in result.reason

    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert result.verdict == result.PASSED, result.reason
    (step,) = result.steps
    # Its samples are on the topic.
    assert not (step.time or step.measurement or step.command or step.predicted)
    assert step.gain_ratio == pytest.approx(1.0, abs=0.2)
    loop.until_setpoints(5.0, 5.5, 5.0)
    assert loop.values() == [0.5, 1.6, 0.0]

    # A foreign set-point ends a verification and stays; the gains get no verdict.
    rig.run_for(2.0)
    other = [m.data for m in loop.setpoints]
    status, result = loop.verify(lambda: setpoint.publish(Float64(data=4.8)), setpoint_step=0.5)
    assert result.verdict == result.NONE
    assert "another node set the set-point to 4.8" in result.reason
    rig.run_for(2.0)
    loop.until_setpoints(*other, 5.5, 4.8)
    assert loop.values() == [0.5, 1.6, 0.0]

    # Gains for a process with a third of the true gain.
    loop.apply(0.8, 2.6, 0.6)
    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert result.verdict == result.FAILED
    assert "/pid_controller has gains.heater.d 0, gains.heater.i 1.6" in result.reason
    assert loop.values() == [0.5, 1.6, 0.0]
    loop.until_setpoints(*other, 5.5, 4.8, 5.3, 4.8)


def test_the_gains_of_a_joint_are_proved_by_the_state_of_its_controller(rig: Rig) -> None:
    loop = ReportingLoop(rig)
    loop.apply(0.5, 1.6, 2.0)
    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert result.verdict == result.PASSED, result.reason
    (step,) = result.steps
    assert step.gain_ratio == pytest.approx(1.0, abs=0.2)
    # Gains for a process with a third of the true gain.
    loop.apply(0.8, 2.6, 0.6)
    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert result.verdict == result.FAILED
    assert loop.values() == [0.5, 1.6, 0.0]
    loop.until_setpoints(5.5, 5.0, 5.5, 5.0)
    # The other joint of the message stays where it was.
    assert {(*m.name, m.velocity[0]) for m in loop.setpoints} == {("arm", "left", 0.25)}
