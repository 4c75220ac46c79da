# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""An action that runs: one goal at a time, what it tells each second, and its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse

from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.text import TOLD_EVERY


class Narrator:
    """Log a sentence at once when it is asked for, and each second as long as there is one.

    The first sentence of a tune, and that of each new state, come at once by `now`.

    :param node: the node, whose log and timer are used.
    :param words: returns the present sentence; empty: there is nothing to tell any more.
    :param tell: called with each sentence.
    """

    def __init__(self, node: Any, words: Callable[[], str], tell: Callable[[str], None]) -> None:
        self._node = node
        self._words = words
        self._tell = tell
        self._timer = node.create_timer(TOLD_EVERY, self.now, clock=STEADY, autostart=False)

    def now(self) -> None:
        """Tell the present sentence, and the next one a second later."""
        if not (words := self._words()):
            self._timer.cancel()
            return
        self._timer.reset()
        self._node.get_logger().info(words)
        self._tell(words)


class OneGoal:
    """Serve an action of which one goal runs at a time; no callback waits for its end.

    A goal is always accepted, because a rejection carries no reason. A goal that cannot begin ends
    at once as aborted, with the reason in its result.

    :param node: the node.
    :param kind: class of the action.
    :param name: of the action.
    :param begin: called with each accepted goal; sets `running`, or concludes it.
    :param cancel: called when a client cancels the running goal.
    :param options: of the `ActionServer`.
    """

    def __init__(
        self,
        node: ServedNode,
        kind: Any,
        name: str,
        begin: Callable[[Any], None],
        cancel: Callable[[], None],
        **options: Any,
    ) -> None:
        self._node = node
        self._cancel = cancel
        self.running: Any = None
        """Handle of the goal that runs; None: none does."""
        # Its callback for execution is needed by the constructor alone: each goal has its own.
        self._server = ActionServer(
            node,
            kind,
            name,
            lambda _: kind.Result(),
            handle_accepted_callback=begin,
            cancel_callback=self._on_cancel,
            **options,
        )

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self.running is not None and goal.goal_id == self.running.goal_id:
            self._node.executor.create_task(self._cancel)
        return CancelResponse.ACCEPT


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
