# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Services and actions: their goals, what they tell, how they end; the action ~/tune."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.node import Node

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.exchange.messages import fill_reason
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.phases import State
from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.reasons import Code, Reason
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


@dataclass
class _Tune:
    """A goal that is not answered yet.

    :param goal: its handle.
    """

    goal: Any
    result: Tune.Result = field(default_factory=Tune.Result)
    newest: TransferFunction = field(default_factory=TransferFunction)
    """Model that is not published yet."""
    model: Any = None
    """The newest model, which is kept beyond the feedback that tells it."""


class TuneAction:
    """Serve the action. A tune may begin while the one before waits for its gains.

    :param node: the node.
    :param ready: done once a tune may be asked for.
    :param start: takes an amplitude [u] and whether it is a dry run; starts or checks a tune, and
        says what became of it.
    :param cancel: called with the id of an experiment when its client cancels it.
    """

    def __init__(
        self,
        node: ServedNode,
        ready: Awaitable[None],
        start: Callable[[float, bool], StartTune.Response],
        cancel: Callable[[str], None],
    ) -> None:
        self._node, self._ready, self._start, self._cancel = node, ready, start, cancel
        self._tunes: dict[str, _Tune] = {}
        self._server = serve_goals(
            node, Tune, "~/tune", self._accept, self._on_cancel,
            status_pub_qos_profile=quality.STATUS,
        )  # fmt: skip

    def _on_cancel(self, goal: Any) -> None:
        for experiment_id, tune in [*self._tunes.items()]:
            if goal.goal_id == tune.goal.goal_id:
                self._cancel(experiment_id)

    def _accept(self, goal: Any) -> None:
        self._node.executor.create_task(self._begin, goal)

    async def _begin(self, goal: Any) -> None:
        request = goal.request
        await self._ready
        if goal.is_cancel_requested:
            started = refused(Code.CANCELLED())
        else:
            started = self._start(request.amplitude, request.dry_run)
        if started.experiment_id:
            self._tunes[started.experiment_id] = _Tune(goal)
            return
        result = Tune.Result(
            reason=started.reason,
            why=started.why,
            checks=started.checks,
            refusals=started.refusals,
        )
        conclude(goal, result, succeeded=started.accepted)

    def tell(self, experiment_id: str, experiment: RelayExperiment, status: str) -> None:
        """Publish feedback, if the experiment has a goal.

        :param experiment_id: its id.
        :param experiment: what it sees.
        :param status: what it waits for and what it sees, a sentence.
        """
        tune = self._tunes.get(experiment_id)
        if tune is None:
            return
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
            ultimate_gain=tune.model.ultimate_gain if tune.model else math.nan,
            ultimate_gain_std=tune.model.ultimate_gain_std if tune.model else math.nan,
            transfer_function=tune.newest,
            status=status,
        )
        if experiment.cycle_count:
            last = experiment.cycles[-1]
            feedback.period = last.period
            feedback.amplitude = last.amplitude
        tune.goal.publish_feedback(feedback)
        # Each model is published once, since it is long.
        tune.newest = TransferFunction()

    def note(self, name: str, message: Any) -> None:
        """Keep a model or gains for the result.

        :param name: unresolved name of its topic.
        :param message: the message.
        """
        tune = self._tunes.get(message.experiment_id)
        if tune is None:
            return
        if name == "transfer_function":
            tune.newest = tune.model = message
            if message.final:
                tune.result.transfer_function = message
        elif message.final:
            tune.result.gains = message

    def end(self, experiment_id: str, summary: Any, bag: str, missing: str) -> None:
        """Answer the goal of an experiment; do nothing if it has no goal.

        :param experiment_id: the id of the experiment.
        :param summary: its message, without arrays.
        :param bag: folder of the recording; empty: no recording.
        :param missing: a sentence on samples or results that are missing; empty: none are.
        """
        tune = self._tunes.pop(experiment_id, None)
        if tune is None:
            return
        result = tune.result
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
        conclude(tune.goal, result, succeeded=summary.outcome == Tune.Result.COMPLETED)
