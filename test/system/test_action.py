# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The action ~/tune: feedback for each cycle, a result with model and gains, cancel, refusals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from action_msgs.msg import GoalStatus
from loop_rig import RELIABLE, Rig
from rclpy.action import ActionClient
from std_msgs.msg import Float64

from relay_autotune.recordings import read_experiments
from relay_autotune_msgs.action import Tune

LOOP = {
    "mode": "lockstep",
    "lockstep_speed": 15.0,
    "sample_period": 0.1,
    "structure": "fopdt",
    "gain": 2.0,
    "time_constants": [2.0],
    "dead_time": 1.0,
    "operating_point": [5.0, 1.0],
}


class Goal:
    """A client of the action, with the messages it receives."""

    def __init__(self, rig: Rig, **request: Any) -> None:
        self.rig = rig
        self.feedback: list[Any] = []
        self.client = ActionClient(rig.node, Tune, "relay_node/tune")
        rig.until(self.client.server_is_ready, "the action")
        sent = self.client.send_goal_async(
            Tune.Goal(**request), feedback_callback=lambda m: self.feedback.append(m.feedback)
        )
        rig.until(sent.done, "the goal")
        self.handle = sent.result()
        assert self.handle.accepted
        self.answer = self.handle.get_result_async()

    def result(self) -> tuple[int, Any]:
        self.rig.until(self.answer.done, "the result")
        self.client.destroy()
        return self.answer.result().status, self.answer.result().result


def wait_for_the_graph(rig: Rig) -> None:
    rig.until(lambda: rig.ask_for_tune(dry_run=True).accepted, "a loop that is ready")


def test_an_action_gives_feedback_model_gains_and_bag(rig: Rig) -> None:
    rig.plant(**LOOP, noise_std=0.005, seed=3)
    relay = rig.relay(amplitude=0.5, baseline=1.0, sample_period=0.1)
    rig.identifier()
    wait_for_the_graph(rig)
    dry = Goal(rig, dry_run=True)
    status, result = dry.result()
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert "relay between 0.65 and 1.65" in result.reason
    assert result.outcome == Tune.Result.UNKNOWN
    goal = Goal(rig)
    # A second goal is refused with the reason, and does not disturb the first.
    status, refused = Goal(rig).result()
    assert status == GoalStatus.STATUS_ABORTED
    assert "is running" in refused.reason
    status, result = goal.result()
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert result.outcome == Tune.Result.COMPLETED
    assert result.transfer_function.final
    assert math.isclose(result.transfer_function.gain, 2.0, rel_tol=0.05)
    assert result.gains.kc > 0.0
    ids = {m.experiment_id for m in (result.experiment, result.transfer_function, result.gains)}
    assert ids == {Path(result.bag).name}
    assert not result.experiment.time
    (record,) = read_experiments(result.bag).experiments
    assert record.experiment_id in ids
    counts = [f.cycle for f in goal.feedback]
    assert counts == sorted(counts)
    assert set(range(1, len(record.cycle_start))) <= set(counts)
    told = " | ".join(f.status for f in goal.feedback)
    assert "is to rise to " in told
    for words in ("stepped to 1.1625 u, ", "computing the model, "):
        assert words in told
        assert words in relay.log
    models = [f.transfer_function.experiment_id for f in goal.feedback]
    assert models.count("") > len(models) // 2
    last = goal.feedback[-1]
    assert last.state == Tune.Feedback.STATE_COMPLETED
    assert last.remaining == 0.0
    assert last.period > 2.0
    assert all(0.0 <= f.progress <= 1.0 for f in goal.feedback)


def test_a_cancelled_goal_leaves_the_safe_command_and_no_gains(rig: Rig) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    rig.plant(sample_period=0.02, structure="fopdt", time_constants=[20.0], dead_time=2.0)
    rig.relay(amplitude=0.5, baseline=1.0, settle_time=0.4)
    wait_for_the_graph(rig)
    goal = Goal(rig)
    rig.until(lambda: any(m.data != 1.0 for m in commands), "a step")
    cancelled = goal.handle.cancel_goal_async()
    rig.until(cancelled.done, "the answer to the cancel")
    status, result = goal.result()
    assert status == GoalStatus.STATUS_CANCELED
    assert result.outcome == Tune.Result.ABORTED
    assert "cancelled" in result.reason
    assert not result.gains.experiment_id
    rig.until(lambda: commands[-1].data == 1.0, "the safe command")


def test_a_goal_that_waits_for_its_gains_ends_beside_the_next_one(rig: Rig) -> None:
    rig.plant(**LOOP, seed=3)
    rig.relay(amplitude=0.5, baseline=1.0, sample_period=0.1, model_timeout=300.0)
    wait_for_the_graph(rig)
    # No identifier_node answers.
    first = Goal(rig)
    rig.until(
        lambda: any(f.state == Tune.Feedback.STATE_COMPLETED for f in first.feedback), "its end"
    )
    second = Goal(rig)
    rig.until(lambda: bool(second.feedback), "the second tune")
    first.handle.cancel_goal_async()
    status, result = first.result()
    assert status == GoalStatus.STATUS_CANCELED
    assert result.outcome == Tune.Result.COMPLETED
    assert "cancelled" in result.reason
    second.handle.cancel_goal_async()
    status, other = second.result()
    assert status == GoalStatus.STATUS_CANCELED
    assert other.experiment.experiment_id != result.experiment.experiment_id
