# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Another node's gains, when that node hangs, or when controller_node ends during a change."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from typing import Any

import pytest
from loop_rig import Rig
from rclpy.action import ActionClient
from remote_loop import VERDICT, Loop
from std_msgs.msg import Float64

from relay_autotune.exchange.messages import fill_gains
from relay_autotune.process.transfer_function import TransferFunction as Process
from relay_autotune.tuning import design
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, TransferFunction

BEFORE = [0.3, 1.0, 0.0]


def target_of(loop: Loop) -> Any:
    (found,) = [p for p in loop.rig.processes if p.name == "pid_controller"]
    return found


def offer(loop: Loop, name: str, **gains: float) -> None:
    loop.gains.publish(PidGains(final=True, verdict=VERDICT, b=1.0, experiment_id=name, **gains))
    loop.rig.until(lambda: f"gains of {name}" in loop.controller.log, "the gains")


def test_a_node_that_hangs_keeps_nobody_waiting_and_gets_its_gains_back(rig: Rig) -> None:
    loop = Loop(rig)
    offer(loop, "one", kc=0.5, ti=0.3)
    assert loop.trigger("apply").success
    assert loop.values() == pytest.approx([0.5, 0.5 / 0.3, 0.0])
    assert loop.trigger("before").message.startswith(f"kc {BEFORE[0]:g}, ti ")
    assert loop.trigger("revert").success
    assert loop.values() == BEFORE
    offer(loop, "two", kc=0.7, ti=0.3)
    target_of(loop).signal(signal.SIGSTOP)
    refused = loop.trigger("apply")
    assert not refused.success
    assert "did not answer within 2 s" in refused.message
    # The node answers all the same.
    assert loop.trigger("discard").success
    target_of(loop).signal(signal.SIGCONT)
    rig.until(lambda: loop.values() == BEFORE, "the gains of before")
    target_of(loop).signal(signal.SIGKILL)
    target_of(loop).wait()
    offer(loop, "three", kc=0.7, ti=0.3)
    refused = loop.trigger("apply")
    assert not refused.success


def test_gains_are_looked_at_before_they_are_sent(rig: Rig) -> None:
    loop = Loop(rig)
    for name, numbers in {
        "parallel": {"kc": 0.5, "ti": 0.3, "p": math.nan, "i": math.inf, "d": -1e300},
        "nan": {"kc": math.nan, "ti": 1.0},
        "large": {"kc": -1e300, "ti": 1.0},
        "inf": {"kc": 1.0, "ti": math.inf},
        "slow": {"kc": 1.0, "ti": 1e200},
    }.items():
        loop.gains.publish(PidGains(final=True, b=1.0, experiment_id=name, **numbers))
        rig.until(lambda name=name: f"gains of {name} refused" in loop.controller.log, name)
    offer(loop, "good", kc=0.5, ti=0.3)
    assert loop.values() == BEFORE
    assert loop.trigger("apply").success
    assert loop.values() == pytest.approx([0.5, 0.5 / 0.3, 0.0])
    assert loop.trigger("revert").success
    assert loop.values() == BEFORE


def at_setpoint(rig: Rig) -> Loop:
    """Return a loop that goes to the set-point 5."""
    loop = Loop(rig)
    setpoint = rig.node.create_publisher(Float64, "setpoint", 10)
    rig.until(lambda: setpoint.get_subscription_count() == 3, "both controllers")
    setpoint.publish(Float64(data=5.0))
    return loop


def publish_model(loop: Loop) -> None:
    model = TransferFunction(final=True, verdict=VERDICT, dead_time=0.1)
    model.numerator, model.denominator = [2.0], [0.3, 1.0]
    loop.models.publish(model)


def in_a_step(loop: Loop, then: Callable[[], None]) -> None:
    """Verify, and call a function during the step of the set-point."""
    rig = loop.rig
    client = ActionClient(rig.node, Verify, "controller_node/verify")
    rig.until(client.server_is_ready, "the action")

    def stepping() -> bool:
        before = len(loop.setpoints)
        sent = client.send_goal_async(Verify.Goal(setpoint_step=0.5))
        rig.until(sent.done, "the goal")
        answer = sent.result().get_result_async()
        rig.until(lambda: len(loop.setpoints) > before or answer.done(), "the step")
        if len(loop.setpoints) == before:
            assert "not at rest" in answer.result().result.reason
        return len(loop.setpoints) > before

    rig.until(stepping, "a loop at rest")
    then()
    client.destroy()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_the_end_of_the_process_in_a_verification_brings_the_gains_back(
    rig: Rig, number: int
) -> None:
    loop = at_setpoint(rig)
    publish_model(loop)
    offer(loop, "tried", kc=0.5, ti=0.3125)
    assert loop.trigger("apply").success
    assert loop.values() == [0.5, 1.6, 0.0]
    rig.run_for(0.5)
    in_a_step(loop, lambda: loop.controller.signal(number))
    ended = loop.controller.wait()
    if number == signal.SIGINT:
        assert ended == 0
        rig.until(lambda: [m.data for m in loop.setpoints[-2:]] == [5.5, 5.0], "the set-point")
    else:
        assert loop.values() == [0.5, 1.6, 0.0]
        loop.start()
        rig.until(lambda: loop.values() == BEFORE, "the gains of before")
        rig.until(lambda: "gains of tried wait" in loop.controller.log, "the latched gains")
    assert loop.values() == BEFORE


@pytest.mark.long
@pytest.mark.parametrize("ended", ["apply_gains", "controller_node"])
def test_a_proof_by_command_that_is_cut_short_leaves_the_gains_of_before(
    rig: Rig, ended: str
) -> None:
    loop = at_setpoint(rig)
    process = Process.fopdt(2.0, 0.3, 0.1)
    publish_model(loop)
    message = PidGains()
    fill_gains(message, design(DesignTask(model=process, options=DesignOptions()), "imc"))
    message.final, message.verdict = True, VERDICT
    loop.gains.publish(message)
    rig.until(lambda: "wait: kc" in loop.controller.log, "the gains")
    command = rig.start_command("apply_gains", "--yes", "--step", "0.5")
    rig.until(lambda: any(m.data == 5.5 for m in loop.setpoints), "the step")
    assert loop.values()[0] == pytest.approx(message.kc)
    if ended == "apply_gains":
        command.signal(signal.SIGINT)
        assert command.wait() == 130
        rig.until(lambda: loop.setpoints[-1].data == 5.0, "the set-point")
    else:
        loop.controller.signal(signal.SIGKILL)
        assert command.wait() == 1
    assert loop.values() == BEFORE
    last = command.log.strip().splitlines()[-1]
    assert "/pid_controller has gains.heater" in last, command.log


def test_a_loop_that_falls_silent_in_a_verification_gets_its_gains_back(rig: Rig) -> None:
    """As where a controller of ros2_control is deactivated: its parameters are still there."""
    loop = at_setpoint(rig)
    loop.apply(0.5, 1.6, 2.0)
    rig.run_for(0.5)
    (plant,) = [p for p in rig.processes if p.name == "plant_node"]
    in_a_step(loop, lambda: plant.signal(signal.SIGSTOP))
    rig.until(lambda: loop.values() == BEFORE, "the gains of before")
    rig.until(lambda: loop.setpoints[-1].data == 5.0, "the set-point")
    # They wait to be tried again.
    rig.until(lambda: loop.trigger("apply").success, "the gains that wait")
    plant.signal(signal.SIGCONT)
