# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The action ~/tune: an experiment with feedback, cancel and a result."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.node import Node

from relay_autotune.experiment.experiment import RelayExperiment, State
from relay_autotune.nodes import quality
from relay_autotune.nodes.narrator import conclude
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import TransferFunction

_STATES = {
    State.SETTLING: Tune.Feedback.STATE_SETTLING,
    State.KICK: Tune.Feedback.STATE_KICK,
    State.PROBE: Tune.Feedback.STATE_KICK,
    State.RELAY: Tune.Feedback.STATE_RELAY,
    State.COMPLETED: Tune.Feedback.STATE_COMPLETED,
    State.ABORTED: Tune.Feedback.STATE_ABORTED,
    State.FAILED: Tune.Feedback.STATE_FAILED,
}


@dataclass(frozen=True)
class Started:
    """The answer to a request for a tune.

    :param accepted: True if the tune runs, or in a dry run could start.
    :param reason: the plan, or the reason for the refusal.
    :param experiment_id: id of the experiment; empty if none was started.
    :param checks: of a dry run, a line for each check.
    """

    accepted: bool
    reason: str
    experiment_id: str = ""
    checks: tuple[str, ...] = ()


class TuneAction:
    """Serve the action; no callback waits, because the experiment advances with the samples.

    A goal is always accepted, because a rejection carries no reason. A goal that cannot start ends
    at once as aborted, with the reason in its result.

    :param node: the node.
    :param start: takes an amplitude [u] and whether it is a dry run; starts or checks a tune.
    :param cancel: called when a client cancels the running tune.
    """

    def __init__(
        self,
        node: Node,
        start: Callable[[float, bool], Started],
        cancel: Callable[[], None],
    ) -> None:
        self._node = node
        self._start = start
        self._cancel = cancel
        self._goal: Any = None
        self._id = ""
        self._result = Tune.Result()
        self._newest = TransferFunction()
        self._ultimate_gain = self._ultimate_gain_std = math.nan
        self._server = ActionServer(
            node,
            Tune,
            "~/tune",
            self._set_state,
            handle_accepted_callback=self._accept,
            cancel_callback=self._on_cancel,
            status_pub_qos_profile=quality.STATUS,
        )

    def _accept(self, goal: Any) -> None:
        request = goal.request
        started = self._start(request.amplitude, request.dry_run)
        if started.experiment_id:
            self._goal, self._id = goal, started.experiment_id
            self._result = Tune.Result()
            self._newest = TransferFunction()
            self._ultimate_gain = self._ultimate_gain_std = math.nan
            return
        result = Tune.Result(reason=started.reason, checks=started.checks)
        conclude(goal, result, succeeded=started.accepted)

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self._goal is not None and goal.goal_id == self._goal.goal_id:
            self._node.executor.create_task(self._cancel)
        return CancelResponse.ACCEPT

    def tell(self, experiment: RelayExperiment, status: str) -> None:
        """Publish feedback, if a goal is active.

        :param experiment: the running experiment.
        :param status: what it waits for and what it sees, a sentence.
        """
        if self._goal is None:
            return
        feedback = Tune.Feedback(
            state=_STATES[experiment.state],
            cycle=experiment.cycle_count,
            progress=experiment.progress,
            elapsed=experiment.elapsed,
            remaining=experiment.remaining,
            period=math.nan,
            amplitude=math.nan,
            ultimate_gain=self._ultimate_gain,
            ultimate_gain_std=self._ultimate_gain_std,
            transfer_function=self._newest,
            status=status,
        )
        if experiment.cycle_count:
            last = experiment.cycles[-1]
            feedback.period = last.period
            feedback.amplitude = 0.5 * (last.peak_max - last.peak_min)
        self._goal.publish_feedback(feedback)
        # Each model is told once, since it is long.
        self._newest = TransferFunction()

    def note(self, name: str, message: Any) -> None:
        """Keep a model or gains for the result.

        :param name: unresolved name of its topic.
        :param message: the message.
        """
        if self._goal is None or message.experiment_id != self._id:
            return
        if name == "transfer_function":
            self._newest = message
            self._ultimate_gain = message.ultimate_gain
            self._ultimate_gain_std = message.ultimate_gain_std
            if message.final:
                self._result.transfer_function = message
        elif message.final:
            self._result.gains = message

    def end(self, experiment_id: str, summary: Any, bag: str, missing: str) -> None:
        """Answer the goal of an experiment; do nothing if it has no goal.

        :param experiment_id: the id of the experiment.
        :param summary: its message, without arrays.
        :param bag: folder of the recording; empty: no recording.
        :param missing: a sentence on samples or results that are missing; empty: none are.
        """
        goal = self._goal
        if goal is None or experiment_id != self._id:
            return
        result = self._result
        result.experiment = summary
        result.bag = bag
        result.outcome = summary.outcome
        result.reason = "; ".join(filter(None, (summary.reason, missing)))
        given = bool(result.gains.experiment_id)
        told = result.gains if given else result.transfer_function
        result.verdict = told.verdict if given else Tune.Result.VERDICT_NONE
        result.verdict_reason = told.verdict_reason or ("" if given else result.reason)
        self._goal = None
        conclude(goal, result, succeeded=summary.outcome == Tune.Result.COMPLETED)

    def _set_state(self, goal: Any) -> Any:
        # Only the constructor needs this callback; each goal has its own.
        goal.abort()
        return Tune.Result()
