# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Services and actions: their goals, what they tell, how they end."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.node import Node

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.exchange.messages import fill_reason
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.phases import State
from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.reasons import Reason
from relay_autotune.text import LOGGED_EVERY, PROGRESS_EVERY
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import TransferFunction
from relay_autotune_msgs.srv import StartTune

_NUMBER = re.compile(r"[\d.]+")


class Narrator:
    """Tell a sentence at once when it is asked for, and each second as long as there is one.

    The first sentence of a tune, and that of each new state, come at once by `now`. The log has
    each that differs in more than its numbers, and else one every ``LOGGED_EVERY`` seconds.

    :param node: the node, whose log and timer are used.
    :param words: returns the present sentence; empty: there is nothing to tell any more.
    :param tell: called with each sentence.
    """

    def __init__(self, node: Any, words: Callable[[], str], tell: Callable[[str], None]) -> None:
        self._node = node
        self._words = words
        self._tell = tell
        self._logged, self._logged_at = "", -math.inf
        self._timer = node.create_timer(PROGRESS_EVERY, self.now, clock=STEADY, autostart=False)

    def now(self) -> None:
        """Tell the present sentence, and the next one a second later."""
        if not (words := self._words()):
            self._timer.cancel()
            self._logged = ""
            return
        self._timer.reset()
        kind, now = _NUMBER.sub("", words), time.monotonic()
        if kind != self._logged or now - self._logged_at >= LOGGED_EVERY:
            self._logged, self._logged_at = kind, now
            self._node.get_logger().info(words)
        self._tell(words)


def serve_goals(
    node: ServedNode,
    kind: Any,
    name: str,
    begin: Callable[[Any], None],
    cancel: Callable[[Any], None],
    **options: Any,
) -> ActionServer:
    """Serve an action, of which no callback waits for the end of a goal.

    A goal is always accepted, because a rejection carries no reason. A goal that cannot begin ends
    at once as aborted, with the reason in its result.

    :param node: the node.
    :param kind: class of the action.
    :param name: of the action.
    :param begin: called with the handle of each accepted goal, which it keeps or concludes.
    :param cancel: called with the handle of a goal that its client cancels.
    :param options: of the `ActionServer`.
    """

    def on_cancel(goal: Any) -> CancelResponse:
        node.executor.create_task(cancel, goal)
        return CancelResponse.ACCEPT

    return ActionServer(
        node,
        kind,
        name,
        # Needed by the constructor alone: each goal has its own.
        lambda _: kind.Result(),
        handle_accepted_callback=begin,
        cancel_callback=on_cancel,
        **options,
    )


def serve(node: Node, kind: Any, name: str, work: Callable[[Any], Any], **options: Any) -> None:
    """Serve a service whose answer is whether it succeeded, and a sentence, such as a Trigger.

    :param node: the node.
    :param kind: class of the service.
    :param name: its name.
    :param work: takes a request; returns the sentence, or a coroutine of it, or raises
        RelayAutotuneError with the reason to refuse.
    :param options: of `Node.create_service`.
    """

    async def answer(request: Any, response: Any) -> Any:
        try:
            said = work(request)
            response.message = said if isinstance(said, str) else await said
            response.success = True
        except RelayAutotuneError as error:
            response.message = str(error)
        return response

    node.create_service(kind, name, answer, **options)


def conclude(goal: Any, result: Any, *, succeeded: bool) -> None:
    """End an accepted goal: cancelled if the client asked for that, else succeeded or aborted.

    :param goal: its handle.
    :param result: the result for its client.
    :param succeeded: False: it is aborted.
    """

    def finish(handle: Any) -> Any:
        if handle.is_cancel_requested:
            handle.canceled()
        elif succeeded:
            handle.succeed()
        else:
            handle.abort()
        return result

    goal.execute(finish)


def refused(reason: Reason) -> StartTune.Response:
    """Return the answer to a start that is not possible.

    :param reason: why not.
    """
    answer = StartTune.Response(reason=str(reason))
    fill_reason(answer.why, reason)
    return answer


class TuneGoal:
    """A goal of the action ~/tune whose tune has begun, until it is answered.

    :param handle: of the goal.
    """

    def __init__(self, handle: Any) -> None:
        self._handle, self._result = handle, Tune.Result()
        # The newest model, and the same until it is published.
        self._model: Any = None
        self._news = TransferFunction()

    def is_of(self, handle: Any) -> bool:
        """Return whether a handle is that of this goal."""
        return bool(handle.goal_id == self._handle.goal_id)

    def tell(self, experiment: RelayExperiment, status: str) -> None:
        """Publish feedback.

        :param experiment: what it sees.
        :param status: what it waits for and what it sees, a sentence.
        """
        model = self._model
        # The probe is a second kick.
        state = State.KICK if experiment.state is State.PROBE else experiment.state
        feedback = Tune.Feedback(
            state=getattr(Tune.Feedback, f"STATE_{state.name}"),
            cycle=experiment.cycle_count,
            progress=experiment.progress,
            elapsed=experiment.elapsed,
            remaining=experiment.remaining,
            period=math.nan,
            amplitude=math.nan,
            ultimate_gain=model.ultimate_gain if model else math.nan,
            ultimate_gain_std=model.ultimate_gain_std if model else math.nan,
            transfer_function=self._news,
            status=status,
        )
        if experiment.cycle_count:
            last = experiment.cycles[-1]
            feedback.period = last.period
            feedback.amplitude = last.amplitude
        self._handle.publish_feedback(feedback)
        # Each model is published once, since it is long.
        self._news = TransferFunction()

    def note(self, name: str, message: Any) -> None:
        """Keep a model or gains for the result.

        :param name: unresolved name of its topic.
        :param message: the message.
        """
        if name == "transfer_function":
            self._news = self._model = message
            if message.final:
                self._result.transfer_function = message
        elif message.final:
            self._result.gains = message

    def end(self, summary: Any, bag: str, missing: str) -> None:
        """Answer it.

        :param summary: the experiment's message, without arrays.
        :param bag: folder of the recording; empty: no recording.
        :param missing: a sentence on samples or results that are missing; empty: none are.
        """
        result = self._result
        result.experiment = summary
        result.bag = bag
        result.outcome = summary.outcome
        result.why = summary.why
        result.reason = "; ".join(filter(None, (summary.reason, missing)))
        given = bool(result.gains.experiment_id)
        judged = result.gains if given else result.transfer_function
        result.verdict = judged.verdict if given else Tune.Result.VERDICT_NONE
        result.verdict_reason = judged.verdict_reason or ("" if given else result.reason)
        result.verdict_why = judged.verdict_why
        if not (judged.verdict_reason or given):
            result.verdict_why = result.why
        conclude(self._handle, result, succeeded=summary.outcome == Tune.Result.COMPLETED)
