# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A tune as pages see it while it runs: samples as they come, its state in words, what is wished.

One thread reports what happens, another serves the pages. It is all kept, so that a page that is
opened late or loaded again shows all. Without any page nothing waits and nothing changes.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from relay_autotune.errors import TuningError
from relay_autotune.exchange.fields import json_number
from relay_autotune.quantities import check, quantity
from relay_autotune.report.style import in_steps
from relay_autotune.web.shape import DesignRequest
from relay_autotune.web.wire import curve

# Samples of each signal that are kept for a page that is opened late.
_KEPT = 50_000
START, ABORT = "start", "abort"
APPLY, VERIFY, REVERT, PROVE = "apply", "verify", "revert", "prove"
WISHES = (START, ABORT, APPLY, VERIFY, REVERT, PROVE)


@dataclass(frozen=True)
class PageCommand:
    """What a page wishes.

    :raises TuningError: if a value is out of its range.
    """

    what: str = quantity("", choices=WISHES).means("What is to be done.")
    of: int = quantity(0, lower=0).means("Number of the model whose gains are meant.")
    asked: DesignRequest | None = None
    """What these gains were asked for by; None: no gains are meant."""
    step: float = quantity(0.0, "y").means(
        "Of the set-point, that proves gains; 0: the usual one."
    )
    doubtful: bool = False
    """Whether gains whose verdict is not trusted are accepted."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of the loop by name, with which a tune is to run: a number, or the two ends of a range."""
    dry: int = quantity(0, lower=0).means("Number of the question what it would do; 0: do it.")

    def __post_init__(self) -> None:
        check(self, TuningError)
        # JSON has 3 for a step of 3.0, and a parameter takes no whole number for it.
        object.__setattr__(self, "step", float(self.step))
        for name, value in self.settings.items():
            for number in value if isinstance(value, list) else [value]:
                if not (isinstance(number, int | float) and math.isfinite(number)):
                    raise TuningError(f"{name} is {value!r}, expected finite numbers")


@dataclass(frozen=True)
class PagePlan:
    """What a wish would do, as said before anything moves.

    :param number: of the question.
    :param refusal: why it cannot be done; empty: it can.
    :param refused: name of the answer that is refused; empty: none in particular.
    :param lines: what will be done and what was checked: mark, name and what was found.
    :param form: what is asked for: name, question, unit, value and what is seen now.
    """

    number: int = 0
    refusal: str = ""
    refused: str = ""
    lines: tuple[tuple[str, ...], ...] = ()
    form: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class Snapshot:
    """What is known of the tune besides its samples.

    :param node: name of the loop.
    :param phase: "idle", "checking", "tuning", "analysing", "applying", "verifying" or "lost".
    :param state: what the experiment does, a word.
    :param status: what it waits for and what it sees, a sentence.
    :param tone: "", "good", "warn" or "bad".
    :param progress: 0 to 1.
    :param elapsed: since the start [s].
    :param remaining: expected until the end [s]; NaN: not estimated.
    :param cycles: a line for each whole cycle, with the estimates after it.
    :param process: the newest model, as text.
    :param setpoint: about which the relay switches [y]; NaN: not known yet.
    :param hysteresis: half the width of its band [y].
    :param limits: lowest and highest measurement that a tune may see [y]; empty: not known.
    :param levels: the two commands of the relay [u]; empty: not known yet.
    :param window: when the last tune began, and its end [s of the samples]; 0: it runs.
    :param result: lines of the last result.
    :param began: time of the day at which the last tune began.
    :param tuned: number of the model that it has given; -1: none.
    :param controller: full name of the controller_node; empty: there is none.
    :param present: its gains, in words.
    :param proves: whether a controller_node of the command can prove gains.
    :param plan: what was asked for last would do.
    :param proof: of the last verification: names and texts.
    """

    node: str
    phase: str = "idle"
    state: str = ""
    status: str = ""
    tone: str = ""
    progress: float = 0.0
    elapsed: float = 0.0
    remaining: float = math.nan
    cycles: tuple[str, ...] = ()
    process: str = ""
    setpoint: float = math.nan
    hysteresis: float = math.nan
    limits: tuple[float, ...] = ()
    levels: tuple[float, ...] = ()
    window: tuple[float, ...] = ()
    result: tuple[str, ...] = ()
    began: str = ""
    tuned: int = -1
    controller: str = ""
    present: str = ""
    proves: bool = False
    plan: PagePlan = PagePlan()
    proof: tuple[tuple[str, str], ...] = ()


@dataclass
class _Signal:
    """The samples of one signal."""

    kept: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    new: list[tuple[float, float]] = field(default_factory=list)


class Live:
    """What pages see of the tunes of one loop, and what they wish.

    :param node: name of the loop.
    """

    def __init__(self, node: str) -> None:
        self._lock = threading.Lock()
        self._snapshot = Snapshot(node)
        self._sent: Snapshot | None = None
        self._signals = {"measurement": _Signal(), "command": _Signal()}
        self._begun = time.monotonic()
        self._wishes: deque[PageCommand] = deque()
        self._taken: PageCommand | None = None
        self._shown: dict[str, Any] = {}
        self._shown_anew: set[str] = set()
        self.abort = threading.Event()
        """Whether a page wishes that the tune, or the verification, ends."""

    @property
    def snapshot(self) -> Snapshot:
        """What is known now."""
        return self._snapshot

    def tell(self, **changed: Any) -> None:
        """Change what is known.

        :param changed: fields of `Snapshot`.
        """
        with self._lock:
            self._snapshot = replace(self._snapshot, **changed)

    def rest(self, status: str, *, good: bool, **changed: Any) -> None:
        """Tell that nothing is done any more, and how the last thing went.

        :param status: a sentence.
        :param good: whether it went well.
        :param changed: other fields of `Snapshot`.
        """
        self._taken = None
        self.tell(phase="idle", status=status, tone="good" if good else "bad", **changed)

    def end_window(self) -> None:
        """Tell that what the figures show has ended now, if it had not before."""
        if self._snapshot.window[1:] == (0.0,):
            self.tell(window=(self._snapshot.window[0], self.now))

    def show(self, name: str, document: Any) -> None:
        """Show curves that change seldom.

        :param name: of the figure.
        :param document: what it shows, as JSON has it.
        """
        with self._lock:
            self._shown[name] = document
            self._shown_anew.add(name)

    @property
    def now(self) -> float:
        """The time of a sample that comes now [s]."""
        return round(time.monotonic() - self._begun, 4)

    def sample(self, signal: str, value: float) -> None:
        """Take a sample of now.

        :param signal: "measurement" or "command".
        :param value: y or u.
        """
        if not math.isfinite(value):
            return
        at = (self.now, value)
        with self._lock:
            self._signals[signal].kept.append(at)
            self._signals[signal].new.append(at)

    def wish(self, wish: PageCommand) -> str:
        """Take a wish of a page, and return why it is refused; empty: it is not.

        :param wish: during a tune or a verification only its end can be wished; else it waits for
            its turn. Of what is agreed to one thing is taken, so that none can be forgotten.
        """
        if wish.what == ABORT:
            self.abort.set()
            return ""
        with self._lock:
            agreed = any(each and not each.dry for each in (self._taken, *self._wishes))
            waits = self._snapshot.phase in ("idle", "checking", "applying")
            if waits and (wish.dry or not agreed):
                self._wishes.append(wish)
            elif not wish.dry:
                return "not done: another wish came first; see what it does, then ask again"
        return ""

    def next_wish(self) -> PageCommand | None:
        """Return the next wish, once the one before is done; None: there is none."""
        with self._lock:
            self._taken = self._wishes.popleft() if self._wishes else None
            # It was meant for what was done before.
            self.abort.clear()
            return self._taken

    def forget_questions(self) -> None:
        """Drop what was only asked, and is asked again by its page, or not any more."""
        with self._lock:
            self._wishes = deque(wish for wish in self._wishes if not wish.dry)

    def everything(self) -> dict[str, Any]:
        """Return what a page shows that has just been opened."""
        with self._lock:
            snapshot = _document(self._snapshot)
            shown = dict(self._shown)
            kept = {
                name: np.array(signal.kept).reshape(-1, 2).T
                for name, signal in self._signals.items()
            }
        at, measurement = kept["measurement"]
        held, command = kept["command"]
        if command.size > 1:
            held, command = in_steps(held, command)
        found = {"measurement": curve(at, measurement), "command": curve(held, command)}
        return {"live": snapshot, "samples": found, "shown": shown, "all": True}

    def news(self) -> dict[str, Any] | None:
        """Return what pages do not have yet; None: nothing."""
        with self._lock:
            news: dict[str, Any] = {}
            if self._sent != self._snapshot:
                news["live"] = _document(self._snapshot)
                self._sent = self._snapshot
            if self._shown_anew:
                news["shown"] = {name: self._shown[name] for name in self._shown_anew}
                self._shown_anew.clear()
            samples = {}
            for name, signal in self._signals.items():
                if signal.new:
                    samples[name] = [list(part) for part in zip(*signal.new, strict=True)]
                    signal.new.clear()
        if samples:
            news["samples"] = samples
        return news or None


def _document(snapshot: Snapshot) -> dict[str, Any]:
    """Return what is known as JSON has it: None stands for a number that is not known."""
    return {
        name: json_number(value) if isinstance(value, float) else value
        for name, value in asdict(snapshot).items()
    }
