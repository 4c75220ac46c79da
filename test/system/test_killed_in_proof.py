# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What passes the commands on is killed while gains are proven."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from typing import Any

import pytest
from loop_rig import LATCHED, RELIABLE, Rig
from rclpy.action import ActionClient
from std_msgs.msg import Float64

from relay_autotune.reasons import Code
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import TransferFunction


@pytest.mark.long
@pytest.mark.parametrize("lag", [0.1, 0.8])
def test_gains_do_not_fail_when_relay_node_is_killed(rig: Rig, lag: float) -> None:
    """The short step is over before the silence is too long; the plant goes on answering."""
    commands = rig.listen("command", Float64, RELIABLE)
    rig.plant(
        structure="fopdt", gain=2.0, time_constants=[lag], dead_time=0.4 * lag,
        sample_period=0.02, operating_point=[5.0, 1.0], noise_std=0.002, seed=5,
    )  # fmt: skip
    relay = rig.relay(amplitude=0.5)
    rig.start(
        "controller_node",
        kc=0.3, ti=lag, initial_command=1.0, initial_setpoint=5.0, verify_step_max=0.5,
    )  # fmt: skip
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    model = TransferFunction(final=True, verdict=TransferFunction.VERDICT_TRUSTED)
    model.numerator, model.denominator, model.dead_time = [2.0], [lag, 1.0], 0.4 * lag
    models.publish(model)
    rig.until(lambda: len(commands) > 100, "a closed loop")
    client = ActionClient(rig.node, Verify, "controller_node/verify")
    rig.until(client.server_is_ready, "the action")

    def proof(step: float = 0.5, during: Callable[[], object] | None = None) -> Any:
        told: list[Any] = []
        goal = Verify.Goal(setpoint_step=step, patience=60.0)
        sent = client.send_goal_async(goal, feedback_callback=told.append)
        rig.until(sent.done, "the goal")
        answer = sent.result().get_result_async()
        if during is not None:
            rig.until(lambda: told and told[-1].feedback.remaining > 0.0, "the step")
            during()
        rig.until(answer.done, "the result")
        return answer.result().result

    def kill() -> None:
        relay.signal(signal.SIGKILL)
        relay.wait()

    result = proof(during=kill)
    assert result.verdict == result.NONE, result.reason
    assert result.why.code == Code.INTERFERED
    assert "no command on /command for" in result.reason
    # Nor does the next one begin.
    again = proof()
    assert again.why.code == Code.INTERFERED, again.reason
    (journal,) = rig.records.glob("gains.*.json")
    assert json.loads(journal.read_text())["failed"] == []
    rig.relay(amplitude=0.5)
    before = len(commands)
    rig.until(lambda: len(commands) > before + 50, "a closed loop again")
    assert "verify_step_max allows 0.5" in proof(0.6).reason
    # Nor do they fail by another node that commands.
    result = proof(during=lambda: rig.node.create_publisher(Float64, "command", RELIABLE))
    assert result.why.code == Code.SECOND_PUBLISHER, result.reason
    assert "/command is also published by /onlooker" in result.reason
    client.destroy()
