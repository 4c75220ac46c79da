# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""tune_loop --web: tunes are started, watched and ended on a page, as often as one likes.

The page also shows the gains of the running controller, and puts new ones in force.
"""

from __future__ import annotations

import argparse
import math
import shlex
import signal
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

from relay_autotune.analysis import options_from
from relay_autotune.cli.arguments import DONE, NOTHING_FOUND, say, worst
from relay_autotune.cli.gains_page import GainsPage
from relay_autotune.cli.loops import Loop
from relay_autotune.cli.own_nodes import PROGRAM
from relay_autotune.cli.report import flags_of
from relay_autotune.cli.settings import NAMES
from relay_autotune.cli.terminal import UNITS
from relay_autotune.cli.tune_view import STATES, Paint, Shown, check_parts, cycle_line
from relay_autotune.cli.tuned import Tuned
from relay_autotune.errors import LoopError, RelayAutotuneError, SelectionError
from relay_autotune.exchange.messages import (
    identification_from_message,
    reason_from_message,
    record_from_cycles,
)
from relay_autotune.experiment.early_end import ULTIMATE_GAIN
from relay_autotune.process.transfer_function import process_text
from relay_autotune.report.case import Case, EstimatedQuantity, case_of, ultimate_of
from relay_autotune.result import Analysis
from relay_autotune.web.address import Address
from relay_autotune.web.live import (
    START,
    Live,
    PageCommand,
    PagePlan,
)
from relay_autotune.web.server import Page, in_background
from relay_autotune.web.shape import DesignRequest, PageModel
from relay_autotune.web.wire import of_running

# How long messages are handled before wishes are looked at [s].
_TICK = 0.05
# What the page shows of each feedback as it is.
_SHOWN = ("status", "progress", "elapsed", "remaining")
_TONES = {"completed": "good", "aborted": "bad", "failed": "bad"}


def serve(loops: Sequence[Loop], options: argparse.Namespace, interrupted: list[int]) -> int:
    """Serve the page of one or more loops, and do what is wished there, until a signal comes.

    :param loops: that it shows.
    :param options: as the command line gives them.
    :param interrupted: signals that have come.
    :return: the worst exit status that the last tune of a loop deserves.
    :raises LoopError: if a relay_node is lost during a tune; the other loops go on until the end.
    """
    address = options.web_address or Address()
    page = Page((), address, [Live(loop.title) for loop in loops])
    page.units = UNITS
    shown = [_LoopOnPage(loop, page, n, interrupted) for n, loop in enumerate(loops)]
    with in_background(page) as url:
        say(
            PROGRAM,
            f"the page is at {url} until Ctrl-C; nothing is commanded before a tune is started "
            "there",
        )
        with ThreadPoolExecutor(len(shown)) as pool:
            running = [pool.submit(each.run) for each in shown]
            # Only the main thread hears signals, and only between its own steps.
            while not all(each.done() for each in running):
                time.sleep(_TICK)
        return worst(*(each.result() for each in running))


class _LoopOnPage(GainsPage):
    """One loop of a page; its tunes are shown there, and in the terminal as without a page.

    :param loop: the loop.
    :param page: that shows it.
    :param number: of the loop on the page.
    :param interrupted: signals that have come.
    """

    def __init__(self, loop: Loop, page: Page, number: int, interrupted: list[int]) -> None:
        live = page.lives[number]
        super().__init__(
            loop, live, page, number, lambda: live.abort.is_set() or bool(interrupted)
        )
        # Lines of several loops must not be written over each other.
        self._terminal = Shown(sys.stderr, live=len(page.lives) == 1 and sys.stderr.isatty())
        # The context in which commands are shown as they come.
        self._commands_shown: Callable[[], AbstractContextManager[None]] = nullcontext
        self._interrupted = interrupted
        # About the running tune: messages of the cycles, K_u after each, signals or a wish to end
        # it, and what is done at its first feedback.
        self._cycles: list[Any] = []
        self._ultimate: dict[int, EstimatedQuantity] = {}
        self._ends: list[int] = []
        self._at_first: Callable[[], object] | None = None

    def run(self) -> int:
        """Do what is wished on the page, until a signal comes.

        :return: the exit status that the last tune deserves.
        :raises LoopError: if relay_node is lost during a tune.
        """
        status = DONE
        self.live.tell(status="nothing is commanded before a tune is started here")
        try:
            self._show_signals()
            while not self._interrupted:
                self.loop.client.rest(_TICK)
                wish = self.live.next_wish()
                if wish is None:
                    self.look_now_and_then()
                elif wish.dry:
                    self._show_plan(wish)
                elif wish.what == START:
                    tuned = self._tune(wish)
                    status = status if tuned is None else tuned
                else:
                    with self._commands_shown():
                        self.do(wish)
        except LoopError as error:
            self.live.tell(phase="lost", tone="bad", status=str(error))
            raise
        finally:
            self.close()
        return status

    def _show_signals(self) -> None:
        live = self.live
        try:
            self.loop.client.watch_measurement(self._hear)
            self._commands_shown = self.loop.client.command_watch(
                lambda value: live.sample("command", value), self._take_cycle
            )
        except RelayAutotuneError as error:
            live.tell(status=str(error), tone="warn")

    def _hear(self, value: float) -> None:
        self.live.sample("measurement", value)
        self.loop.answers.measured = value

    def _take_cycle(self, cycle: Any) -> None:
        settings = cycle.settings
        middle, half = settings.baseline + settings.bias, settings.amplitude
        self.live.tell(
            setpoint=settings.setpoint,
            hysteresis=settings.hysteresis,
            levels=(middle - half, middle + half),
        )
        self._cycles.append(cycle)

    def _show_plan(self, wish: PageCommand) -> None:
        """Say what a wish would do, or why it cannot be done; nothing moves."""
        self.live.tell(phase="checking")
        plan = self._check(wish) if wish.what == START else self.plan(wish)
        self.live.forget_questions()
        self.live.tell(phase="idle", plan=replace(plan, number=wish.dry))

    def _check(self, wish: PageCommand) -> PagePlan:
        """Ask whether a tune could start, and how."""
        loop, refusal, refused, lines = self.loop, "", "", list[str]()
        try:
            self._take(wish)
            lines = loop.plan()
            result = loop.check()
            lines += loop.checklist(result)
            if not loop.client.succeeded:
                refusal = f"refused: {result.reason}"
                named = (
                    reason_from_message(why).parameter
                    for check, why in zip(result.checks, result.refusals, strict=False)
                    if check.startswith("NO")
                )
                refused = next((NAMES[each] for each in named if each in NAMES), "")
        except RelayAutotuneError as error:
            refusal, refused = str(error), getattr(error, "setting", "")
        loop.look()
        form = loop.answers.form(loop.form, needed=loop.has_own_nodes)
        return PagePlan(0, refusal, refused, tuple(map(check_parts, lines)), tuple(form))

    def _take(self, wish: PageCommand) -> None:
        """Take the settings with which a tune is to run.

        :raises RelayAutotuneError: if they cannot be.
        """
        if wish.settings:
            self.loop.set(dict(wish.settings))
        if lacking := self.loop.lacking():
            missing = "; ".join(lacking)
            raise SelectionError(f"fill in the plan first (Start a tune): {missing}")
        self.loop.before_tune()
        self.live.tell(limits=tuple(self.loop.options.within or ()))

    def _tune(self, wish: PageCommand) -> int | None:
        """Tune until the result is there; return its exit status, None: it was not asked for."""
        client, live = self.loop.client, self.live
        before = live.snapshot
        try:
            self._take(wish)
        except RelayAutotuneError as error:
            live.rest(str(error), good=False)
            return None
        live.forget_questions()
        self._cycles.clear()
        self._ultimate, self._ends = {}, []
        live.show("model", None)
        live.tell(
            phase="tuning", state="", status="asking for the tune", tone="", progress=0.0,
            elapsed=0.0, cycles=(), process="", result=(), tuned=-1,
            began=time.strftime("%H:%M"), setpoint=math.nan, levels=(),
            window=(live.now, 0.0),
        )  # fmt: skip
        with ExitStack() as stack:
            # Only once it has begun: see TuneClient.command_watch.
            self._at_first = lambda: stack.enter_context(self._commands_shown())
            self.loop.tune(self, self._ends, tick=_TICK)
            self._terminal.clear()
        live.end_window()
        tune = Tuned(self.loop)
        result = tune.result
        for refused in sorted(client.refused):
            say(PROGRAM, refused)
        if not tune.is_started:
            # What the page shows is still that of the tune before.
            live.tell(**vars(before))
            live.rest(f"refused: {result.reason}", good=False)
            return NOTHING_FOUND
        lines = tune.lines(Paint())
        print("\n".join(lines), flush=True)
        live.tell(
            phase="analysing",
            status="the model is computed once more, to shape the gains",
            result=tuple(lines),
        )
        if result.transfer_function.experiment_id:
            # A short tune ends before any model came.
            cycles = len(live.snapshot.cycles)
            live.tell(process=self._show(result.transfer_function, cycles))
            self._add_subject(tune)
        if tune.has_gains:
            self.loop.after_tune()
        self.look_after_tune(tune)
        if tune.left:
            # What the plant does now matters more than the tune.
            live.tell(window=())
        ended = "; ".join(filter(None, (f"no gains: {result.reason}", tune.left)))
        live.rest("the tune is complete" if tune.is_complete else ended, good=tune.is_complete)
        return tune.status()

    # The progress of a tune: a `Face`.

    def take(self, feedback: Any) -> None:
        """Show a feedback."""
        if self._at_first is not None:
            self._at_first()
            self._at_first = None
        snapshot, state = self.live.snapshot, STATES[feedback.state]
        if state in _TONES:
            self.live.end_window()
        changed: dict[str, Any] = {
            "state": state,
            "tone": _TONES.get(state, ""),
            **{name: getattr(feedback, name) for name in _SHOWN},
        }
        if feedback.cycle > len(snapshot.cycles):
            line = cycle_line(f"cycle {feedback.cycle}", feedback)
            changed["cycles"] = (*snapshot.cycles, line)
        if feedback.transfer_function.experiment_id:
            changed["process"] = self._show(feedback.transfer_function, feedback.cycle)
        self.live.tell(**changed)
        self._terminal.take(feedback)

    def _show(self, message: Any, cycle: int) -> str:
        """Show a model, and return it as text.

        :param message: the `TransferFunction`.
        :param cycle: number of whole cycles.
        """
        found = identification_from_message(message)
        cycles, ultimate = list(self._cycles), self._ultimate

        def show() -> None:
            """Show the model over the data so far, and how its intervals narrow."""
            for each in ultimate_of(found):
                if each.name == ULTIMATE_GAIN:
                    ultimate[cycle] = each
            record = None
            # Without the first cycle it is not known where the process was at rest.
            if {0, *(c.index for c in cycles)} == set(range(len(cycles))):
                record = record_from_cycles(cycles)
            self.live.show("model", of_running(found, record, list(ultimate.items())))

        # By another thread: this one has to hear relay_node, and who ends the tune.
        self.page.worker.ask(show)
        return process_text(found.model)

    def tick(self) -> None:
        """Heed what was wished or signalled."""
        # SIGHUP, as a wish that is repeated does not leave the tune alone.
        self._ends[:] = self._interrupted or [signal.SIGHUP] * self.live.abort.is_set()
        self._terminal.tick()

    def say(self, text: str) -> None:
        """Write a line that stays."""
        self.live.tell(status=text, tone="warn")
        self._terminal.say(text)

    # The result of a tune.

    def _add_subject(self, tune: Tuned) -> None:
        """Show the model of the tune, and let its gains be shaped; other rules come later."""
        try:
            # Asked for here: the thread that computes handles no messages.
            _, values = tune.record, tune.values
            work = self.page.slow.ask(partial(tune.analysed, alone=True))
            found = self.loop.client.computed(work, lambda: bool(self._interrupted))
        except RelayAutotuneError as error:
            say(PROGRAM, f"the gains cannot be shaped: {error}")
            return
        bag = tune.result.bag
        options = found.shaping.task.options if found.shaping else options_from(values)
        first = DesignRequest.of(values["rule"], options)

        def command(asked: DesignRequest) -> str:
            if not bag:
                return ""
            changed = asked.changed_from(first)
            wanted = {name: math.nan if v is None else v for name, v in changed.items()}
            return f"replay {shlex.quote(bag)} {flags_of({**values, **wanted})}".rstrip()

        def shown(found: Analysis) -> Case:
            return replace(case_of(found, bag or self.loop.title), command=command(first))

        subject = PageModel(
            shown(found),
            found.shaping,
            first,
            command,
            self.number,
            self.loop.target,
            self.live.snapshot.began,
        )
        self.live.tell(tuned=self.page.add(subject))

        def completed() -> None:
            every = shown(tune.analysed())
            known = subject.case
            subject.case = replace(every, present=known.present, proof=known.proof)
            self.page.changed()

        # The recommended gains may be used meanwhile.
        self.page.slow.ask(completed).add_done_callback(self._say_what_lacks)

    def _say_what_lacks(self, work: Future[None]) -> None:
        ends = work.cancelled() or bool(self._interrupted)
        if not ends and (error := work.exception()) is not None:
            say(PROGRAM, f"the page shows one method and one rule alone: {error}")
