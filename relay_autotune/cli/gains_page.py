# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains of a page in the loop's controller_node: put in force, proved and taken back."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from relay_autotune.cli.apply_gains import FOUND_WITHIN, verified
from relay_autotune.cli.loops import Loop
from relay_autotune.cli.tuned import CONTROLLER, Proof, Tuned, gains_words
from relay_autotune.errors import LoopError, RelayAutotuneError, TuningError
from relay_autotune.exchange.messages import (
    fill_gains,
    gains_from_message,
    how_ended,
    why_doubtful,
)
from relay_autotune.loop.gains import Controller
from relay_autotune.nodes.gains_client import GainsClient, StepsHere
from relay_autotune.verdict import Verdict
from relay_autotune.web.live import (
    APPLY,
    PROVE,
    REVERT,
    VERIFY,
    Live,
    PageCommand,
    PagePlan,
)
from relay_autotune.web.server import Page
from relay_autotune.web.shape import PageModel
from relay_autotune.web.wire import curve
from relay_autotune_msgs.msg import PidGains

# Interval at which the gains in force are read while nothing else happens [s].
_LOOK_EVERY = 3.0


@dataclass
class GainsPage:
    """Gains of the page in the loop's controller_node.

    :param loop: the loop.
    :param live: what pages see.
    :param page: with the models whose gains are shaped.
    :param number: of the loop on the page.
    :param leave: returns True when a verification is to end.
    """

    loop: Loop
    live: Live
    page: Page
    number: int
    leave: Callable[[], bool]
    _controller: GainsClient | None = None
    _looked: float = -math.inf
    # The last tune with gains, and which steps may prove some gains: computed once.
    _tuned: Tuned | None = None
    _known: tuple[Controller | None, Proof | StepsHere] | None = None

    def close(self) -> None:
        """Leave the controller."""
        if self._controller is not None:
            self._controller.close()
            self._controller = None

    def look_now_and_then(self) -> None:
        """Read the gains in force, at an interval."""
        if time.monotonic() - self._looked > _LOOK_EVERY:
            self.look()

    def look(self) -> None:
        """Read the gains in force, and show them beside the new ones."""
        # A controller_node of the command lives for its proof alone.
        found = [] if self.loop.proves else self.loop.client.controllers()
        if self._controller is None or self._controller.name not in found:
            self.close()
            if found:
                self._controller = GainsClient("", found[0], beside=self.loop.client)
        self._looked = time.monotonic()
        if (controller := self._controller) is None:
            self.live.tell(controller="", present="")
            return
        try:
            present = controller.in_force()
        except RelayAutotuneError:
            # It may be about to end: the next look tells.
            return
        self.live.tell(controller=controller.name, present=gains_words(present))
        for subject in self.page.subjects:
            if subject.loop == self.number and subject.case.present != present:
                subject.case = replace(subject.case, present=present)
                self.page.changed()

    def look_after_tune(self, tune: Tuned) -> None:
        """Read the gains in force; those of the tune may be proven.

        :param tune: that has ended.
        """
        self._known = None
        self.look()
        if self.loop.proves and tune.has_gains:
            self._tuned = tune
            self.live.tell(proves=True, proof=())

    # What a wish would do.

    def plan(self, wish: PageCommand) -> PagePlan:
        """Return what a wish would do, or why it cannot be done.

        :param wish: to apply, prove, verify or revert.
        """
        step, refusal, lines = wish.step, "", list[tuple[str, ...]]()
        makes_step = wish.what in (PROVE, VERIFY)
        try:
            message = self._message(wish)
            lines += self._about_gains(wish, message)
            if makes_step:
                steps = self._steps(message)
                step = step or steps.step
                lines += [("", *line) for line in steps.plan(step)]
                lines.append(("", "steps", steps.allowed.words))
        except RelayAutotuneError as error:
            refusal = str(error)
        asked = {"name": "step", "question": "step of the set-point", "unit": "y", "ends": 1,
                 "values": [step or None], "now": "", "needed": True}  # fmt: skip
        refused = "step" * bool(step and refusal)
        return PagePlan(0, refusal, refused, tuple(lines), (asked,) * makes_step)

    def _about_gains(self, wish: PageCommand, message: Any) -> Iterator[tuple[str, ...]]:
        """Yield the lines of a plan that say which gains are there, and which come."""
        after = ""
        if not self.loop.proves:
            controller = self._found()
            yield "", "now", f"{self.live.snapshot.controller} has {self.live.snapshot.present}"
            after = "; at once, without a bump of the command"
            if message is not None:
                controller.require_new(message)
        if message is not None:
            yield "", "new gains", f"{gains_words(gains_from_message(message))}{after}"
            if doubt := why_doubtful(message):
                yield "note", "doubtful", doubt
        if wish.what == REVERT:
            yield "", "new gains", f"those before: {self._found().ask('before')}{after}"
        elif wish.what == APPLY:
            yield "", "step", "none: they are not verified"

    def _steps(self, message: Any) -> Proof | StepsHere:
        """Return which steps may prove gains.

        :param message: the `PidGains`; None: those in force.
        """
        if self.loop.proves and self._tuned is None:
            raise TuningError("there are no gains of a tune that could be proven here")
        gains = self._found().in_force() if message is None else gains_from_message(message)
        if self._known is None or self._known[0] != gains:
            steps = Proof(self._tuned, message) if self._tuned else self._found().steps(gains)
            self._known = gains, steps
        return self._known[1]

    def _found(self) -> GainsClient:
        """Return the client of the running controller_node."""
        if self._controller is None:
            raise LoopError("no controller_node is in this namespace")
        self._controller.find(FOUND_WITHIN)
        return self._controller

    # What is done.

    def do(self, wish: PageCommand) -> None:
        """Do what was wished with the gains in force.

        :param wish: to apply, prove, verify or revert.
        """
        live = self.live
        try:
            self._do(wish)
        except RelayAutotuneError as error:
            live.rest(str(error), good=False)
        live.end_window()
        # Limits and gains may be others at the next wish.
        self._known = None
        self.look()

    def _do(self, wish: PageCommand) -> None:
        live = self.live
        if wish.what == REVERT:
            live.tell(phase="applying", tone="", status="bringing back the gains before")
            live.rest(self._found().ask("revert"), good=True, proof=())
            return
        message = self._message(wish)
        if wish.what != APPLY:
            self._try(wish, message)
            return
        live.tell(phase="applying", tone="", status="putting the gains in force")
        controller = self._found()
        with controller.allowing(accept_doubtful=wish.doubtful):
            sentence = controller.put_in_force(message)
        live.rest(f"{sentence}; they are not verified", good=True, proof=())

    def _try(self, wish: PageCommand, message: Any) -> None:
        """Make a step that proves gains, and tell how it has ended.

        :param message: the `PidGains`; None: those in force.
        """
        live, steps, what, left = self.live, self._steps(message), "verification", ""
        step = wish.step or steps.step
        steps.allowed.require(step)
        if isinstance(steps, Proof):
            what, left = "proof", f"; the command stands at {self.loop.options.at:.6g} u"
            self._begin_step(f"starting {CONTROLLER}")
            result, entries, shown = steps.made(step, wish.doubtful, self._say, self.leave)
            if result.steps:
                subject = self.page.subjects[wish.of]
                subject.case = replace(subject.case, proof=entries)
        else:
            controller = self._found()
            with controller.allowing(accept_doubtful=wish.doubtful):
                self._begin_step("")
                # The page has a button that takes them back.
                result, entries = verified(
                    controller, step, self._say, self.leave, message, stays=False
                )
                shown = controller.steps_of(result)
        if shown:
            # In place of the proof before; one that was cut short has no steps.
            live.show("proof", [_document(each) for each in shown])
        live.rest(
            f"{what} {how_ended(result)}{left}",
            good=result.verdict == result.PASSED,
            # The proof before stays where this one was cut short.
            proof=entries if result.steps else live.snapshot.proof,
        )

    def _say(self, text: str) -> None:
        self.live.tell(status=text)

    def _begin_step(self, status: str) -> None:
        """Show from now on the samples of a step in place of those of the tune."""
        live = self.live
        live.tell(
            phase="verifying", tone="warn", status=status, window=(live.now, 0.0),
            setpoint=math.nan, levels=(),
        )  # fmt: skip

    def _message(self, wish: PageCommand) -> Any:
        """Return the gains that the page shows as a message; None: those in force are meant."""
        if wish.what in (VERIFY, REVERT):
            return None
        if wish.asked is None or not 0 <= wish.of < len(self.page.subjects):
            raise TuningError("there are no such gains")
        subject: PageModel = self.page.subjects[wish.of]
        if subject.loop != self.number:
            raise TuningError(f"the gains are for another loop than {self.live.snapshot.node}")
        work = self.page.worker.ask(partial(subject.shaped, wish.asked))
        shaped = self.loop.client.computed(work, self.leave)
        gains, judgement = shaped.gains, shaped.judgement
        if judgement.verdict is not Verdict.TRUSTED and not wish.doubtful:
            raise TuningError(f"the gains are doubtful, and were not accepted: {judgement.reason}")
        message = PidGains()
        fill_gains(message, gains, experiment_id=subject.case.experiment_id, judgement=judgement)
        return message


def _document(step: Any) -> dict[str, Any]:
    """Return a step of a verification for the page: what was measured over what was predicted."""
    setpoint = step.kind == step.SETPOINT
    what = "set-point" if setpoint else "load"
    return {
        "name": f"step of the {what} by {step.step:+g} {'y' if setpoint else 'u'}",
        "measurement": curve(step.time, step.measurement),
        "predicted": curve(step.time, step.predicted),
    }
