"""How the goal of an action ends."""

from __future__ import annotations

from typing import Any


def conclude(goal: Any, result: Any, *, succeeded: bool) -> None:
    """End an accepted goal: cancelled where that was asked for, else succeeded or aborted.

    :param goal: its handle.
    :param result: what its client gets.
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
