# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The end of an action's goal."""

from __future__ import annotations

from typing import Any


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
