# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The steps of a tune that are the same on a terminal, at a joint and on a page: check it, run it.

What a face shows of it is its own. :mod:`after_tune` has what follows.
"""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING, Any, Protocol

from relay_autotune.errors import LoopError
from relay_autotune.reasons import Code

if TYPE_CHECKING:
    from relay_autotune.cli.loops import Loop, WhyOver

# Time between two looks at a tune, and two updates of a terminal [s].
TICK = 0.25


class Face(Protocol):
    """Where a tune is shown."""

    def take(self, feedback: Any) -> None:
        """Show a `Tune.Feedback`."""

    def tick(self) -> None:
        """Show that time passes."""

    def say(self, text: str) -> None:
        """Write a line that stays."""


def checked(loop: Loop, deadline: float) -> Any:
    """Ask whether a tune could start; return the answer, a `Tune.Result`.

    :param loop: the loop.
    :param deadline: until when its nodes may not know yet what they need.
    """
    client, options = loop.client, loop.options
    # Right after its start a node of the command does not know all of these yet.
    awaited = {Code.REST_UNKNOWN, *[Code.NO_IDENTIFIER] * (not options.record_only)}
    while True:
        found = client.check(options.amplitude)
        lacking = loop.has_own_nodes and any(why.code in awaited for why in found.refusals)
        if not (client.not_ready_yet or lacking) or time.monotonic() > deadline:
            return found
        time.sleep(TICK)


def run(
    loop: Loop, face: Face, interrupted: list[int], deadline: float = 0.0, tick: float = TICK
) -> None:
    """Ask for a tune, and show it until its result is there; cancel it when asked to.

    :param loop: the loop.
    :param face: where it is shown.
    :param interrupted: signals that have come.
    :param deadline: until when its nodes may not be ready; 0: they are asked once.
    :param tick: interval of the looks [s].
    """
    client = loop.client
    with loop.opened() as why_over:
        while True:
            client.ask(loop.options.amplitude, dry_run=False)
            _follow(loop, face, interrupted, why_over, tick)
            if interrupted or not client.not_ready_yet or time.monotonic() > deadline:
                return
            time.sleep(TICK)


def _follow(
    loop: Loop, face: Face, interrupted: list[int], why_over: WhyOver, tick: float
) -> None:
    client, cancelled, state = loop.client, False, 0
    while not client.done():
        client.spin(tick)
        for feedback in client.news():
            face.take(feedback)
            state = feedback.state
        face.tick()
        over = why_over(state)
        if (interrupted or over) and not cancelled:
            cancelled = True
            client.cancel()
            if over:
                face.say(over)
            face.say("cancelling: the safe command goes out, then the recording is closed")
        elif any(number != signal.SIGHUP for number in interrupted[1:]):
            # SIGHUP does not count: a shell that ends with its terminal sends it once more.
            raise LoopError(
                f"stopped waiting; {client.name} still sends the safe command, and its log says "
                f"how the tune ended"
            )
