# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a running action tells: each second what it waits for and sees, and its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from relay_autotune.nodes.lifetime import STEADY
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
