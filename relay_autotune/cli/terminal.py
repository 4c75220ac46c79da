# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What commands share on a terminal: lines as wide as it is, progress, questions."""

from __future__ import annotations

import argparse
import math
import os
import re
import select
import signal
import sys
import termios
import textwrap
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from relay_autotune.errors import LoopError, RelayAutotuneError, SelectionError, system_says
from relay_autotune.text import LOGGED_EVERY, PROGRESS_EVERY, duration, in_units, visible

if TYPE_CHECKING:
    from relay_autotune.control.step_choice import StepRange

_Value = TypeVar("_Value")
# Longer lines are hard to read, also where the terminal is wider.
WIDEST = 99
NARROWEST = 40

_INDENT = "  "
LABEL_WIDTH = 16
# Quantities on one line stand this far apart.
_GAP = "   "


UNITS: dict[str, str] = {}
"""What y and u stand for in this process, as far as its loop is known."""


@contextmanager
def with_units(units: Mapping[str, str]) -> Iterator[None]:
    """Tell of another loop in the block.

    :param units: of its measurement, by "y", and of its command, by "u", as far as known.
    """
    before = dict(UNITS)
    UNITS.clear()
    UNITS.update(units)
    try:
        yield
    finally:
        UNITS.clear()
        UNITS.update(before)


def width() -> int:
    """Return the columns that text may fill: those of the terminal, or of COLUMNS if it is set."""
    given = os.environ.get("COLUMNS", "")
    columns = int(given) if given.isdecimal() else 0
    # In a pipe, as to `less`, the terminal is where messages and keys are.
    for stream in (sys.__stdout__, sys.__stderr__, sys.__stdin__):
        if columns > 0:
            break
        try:
            columns = os.get_terminal_size(stream.fileno()).columns if stream else 0
        except (OSError, ValueError):
            continue
    return min(max(columns or WIDEST, NARROWEST), WIDEST)


def broken(text: str, columns: int) -> list[str]:
    """Return text as lines; a word that is longer than a line, as a path may be, stays whole.

    :param text: its parts are three blanks apart, and stay whole where they fit.
    :param columns: that a line may have.
    :return: at least one line.
    """
    text = in_units(text, UNITS)
    if len(text) <= columns:
        return [text]
    lines: list[str] = []
    for part in re.split(rf"(?<=\S){_GAP} *(?=\S)", text):
        if lines and len(lines[-1]) + len(_GAP) + len(part) <= columns:
            lines[-1] += _GAP + part
        else:
            lines += textwrap.wrap(part, columns, break_long_words=False, break_on_hyphens=False)
    return lines or [""]


class Help(argparse.RawDescriptionHelpFormatter):
    """The help of a command: paragraphs as wide as the terminal, examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        """Return text with its paragraphs filled; lines that begin with a blank stay."""
        done: list[str] = []
        words: list[str] = []
        for line in [*text.splitlines(), ""]:
            if line[:1].strip():
                words += line.split()
                continue
            if words:
                done += broken(" ".join(words), width)
                words = []
            done.append(line)
        return textwrap.indent("\n".join(done).strip("\n"), indent)


def labelled(
    label: str, text: str, columns: int, *, indent: int = len(_INDENT) + LABEL_WIDTH + 1
) -> list[str]:
    """Return text beside its label, as lines.

    :param label: stands on the first line.
    :param text: see :func:`broken`.
    :param columns: that a line may have.
    :param indent: column at which the text begins.
    """
    # A label that fills its column still has a space after it.
    head = f"{_INDENT}{label} "
    parts = broken(text, max(columns - indent, NARROWEST // 2))
    return [f"{head if i == 0 else '':<{indent}}{part}".rstrip() for i, part in enumerate(parts)]


def tell(label: str, text: str) -> None:
    """Print text beside its label, on lines as wide as the terminal.

    :param label: stands on the first line.
    :param text: see :func:`broken`.
    """
    print("\n".join(labelled(label, text, width())), flush=True)


def in_columns(rows: Sequence[Sequence[str]], columns: int) -> list[str]:
    """Return a table: the first cell of each row to the left, the others to the right.

    :param rows: of the same number of cells.
    :param columns: that a line may have; where they do not suffice, the columns stand closer.
    """
    rows = [[in_units(cell, UNITS) for cell in row] for row in rows]
    needed = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    gap = 2 if sum(needed) + 2 * len(needed) <= columns else 1
    first, *others = needed
    widths = [gap + n for n in others]
    return [
        "".join((_INDENT, row[0].ljust(first), *map(str.rjust, row[1:], widths))).rstrip()
        for row in rows
    ]


def require_new(path: str) -> None:
    """Refuse a file that `write` could not write, before any work is done.

    :param path: the file.
    :raises SelectionError: if it exists already, or its folder is not there or not writable.
    """
    if Path(path).exists():
        raise SelectionError(f"{path} exists already, not overwriting it")
    folder = Path(path).parent
    if not os.access(folder, os.W_OK):
        raise SelectionError(f"{path} cannot be written: there is no writable folder {folder}")


def write(text: str, path: str | None) -> None:
    """Write a file, or to standard output.

    :param text: what it holds.
    :param path: the file; None: standard output.
    :raises SelectionError: if it exists already, or cannot be written.
    """
    if path is None:
        print(text, end="", flush=True)
        return
    try:
        with Path(path).open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise SelectionError(f"{path} exists already, not overwriting it") from error
    except OSError as error:
        raise SelectionError(f"{path} cannot be written: {system_says(error)}") from error


# Time after which a terminal first says what is being done [s]: several short works in a row
# must not be silent together.
_SOON = 0.3


class StatusLine:
    """What is done or waited for, on standard error: in place on a terminal, else line by line.

    In a log only what begins, up to the first comma, and a line each ten seconds are shown.
    """

    def __init__(self) -> None:
        self.in_place = sys.stderr.isatty()
        self._shown = False
        self._last, self._at = "", -math.inf

    def __call__(self, status: str) -> None:
        """Show a sentence."""
        status, now = in_units(visible(status), UNITS), time.monotonic()
        begun = status.partition(",")[0]
        if not self.in_place and begun == self._last and now - self._at < LOGGED_EVERY:
            return
        self._last, self._at = begun, now
        text = f"\r\x1b[K{status[: width() - 1]}" if self.in_place else f"{status}\n"
        # The work goes on even if this cannot be written.
        with suppress(OSError):
            sys.stderr.write(text)
            sys.stderr.flush()
        self._shown = True

    def clear(self) -> None:
        """Remove the line of a terminal, so that something else can be written."""
        if self._shown and self.in_place:
            with suppress(OSError):
                sys.stderr.write("\r\x1b[K")
                sys.stderr.flush()
            self._shown = False


class Working:
    """Say each second on standard error what is being done, until the block ends.

    Without a terminal it is said each ten seconds. Where it is known how long the work takes, it
    is said at once, there only if that is longer.

    :param what: what is being done.
    :param expected: how long it takes about [s]; NaN: not known.
    :param patient: True: without a terminal it is not said before ten seconds.
    :param quiet: True: nothing is said.
    """

    def __init__(
        self,
        what: str,
        expected: float = math.nan,
        *,
        patient: bool = False,
        quiet: bool = False,
    ) -> None:
        self._what, self._expected, self._patient = what, expected, patient
        self._quiet, self._stage = quiet, ""

    def __enter__(self) -> Self:
        self._over, self._line = threading.Event(), StatusLine()
        self._thread = threading.Thread(target=self._tell, name="progress", daemon=True)
        if not self._quiet:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if not self._quiet:
            self._thread.join()

    def at(self, stage: str) -> None:
        """Note what the work is at; any thread may call it.

        :param stage: such as ``comparing structures``.
        """
        self._stage = f": {stage}"

    def share(self, done: int, total: int) -> None:
        """Note how much is done of how much."""
        self.at(f"{100.0 * min(done / max(total, 1), 1.0):.0f} %")

    def clear(self) -> None:
        """Remove the line, so that something else can be written."""
        self._line.clear()

    def _tell(self) -> None:
        began, line, expected = time.monotonic(), self._line, self._expected
        known = math.isfinite(expected)
        about = f" of about {max(expected, 1.0):.0f} s" if known else ""
        wait = _SOON if line.in_place else PROGRESS_EVERY
        if (self._patient or (known and expected < LOGGED_EVERY)) and not line.in_place:
            wait = LOGGED_EVERY
        while not self._over.wait(wait):
            wait = PROGRESS_EVERY if line.in_place else LOGGED_EVERY
            ran = time.monotonic() - began
            if known and ran > expected:
                about = f", about {max(expected, 1.0):.0f} s were expected"
            line(f"{self._what}, {duration(ran)}{about}{self._stage}")
        line.clear()


# A number as people type it, with a unit that is not read; a k for thousand is no unit.
_UNIT = r"\s*(?!to\b|and\b|k\b|e\b)[^\W\d_][\w/^*]*|\s*[%°][a-z]*"
_NUMBER = rf"([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)(?:{_UNIT})?"
# What stands between two; a single point belongs to a number, and so does a dash before which
# there is a blank alone.
_BETWEEN = r"\s*(?:\.{2,}|[,;]|\bto\b|\band\b|-(?=\s)|(?<!\s)-|\s)\s*"
_ONE = re.compile(_NUMBER, re.IGNORECASE)
_TWO = re.compile(_NUMBER + _BETWEEN + _NUMBER, re.IGNORECASE)
# Dashes of other keyboards.
_DASHES = str.maketrans(dict.fromkeys("\N{MINUS SIGN}\N{EN DASH}", "-"))


def asked_for_file(what: str, names: Collection[str]) -> str:
    """Ask for a file to write; return its name, or one of some programs, empty for none.

    :param what: what would be written.
    :param names: programs that may be named in its place.
    """

    def read(answer: str) -> str:
        if answer.lower() in ("", "n", "no", "none"):
            return ""
        program = answer.lower().replace("-", "_").replace(" ", "_")
        if program in names:
            return program
        file = Path(answer).expanduser()
        # A word with neither folder nor ending is a program that was mistyped.
        if file.suffix or os.sep in answer:
            return str(file)
        raise SelectionError(
            f"{answer} is neither a program nor the name of a file: expected a file with its "
            f"ending, such as gains.yaml, Enter for none, or one of {', '.join(names)}"
        )

    _forget_typed()
    return _answer(f"{what}: file name, or another program [none]: ", read)


# What goes back to the question before.
BACK = "<"
_YES_OR_NO = {"": False, "n": False, "no": False, "y": True, "yes": True}


class GoBack(Exception):  # noqa: N818  it is no error
    """Somebody wishes to change the last answer."""


def agrees(question: str, *, yes: bool, back: bool = False) -> bool:
    """Ask a question, unless ``--yes`` has answered it.

    :param question: with its question mark.
    :param yes: whether the flag was given.
    :param back: whether there is a question before.
    :raises LoopError: if nobody can be asked.
    :raises GoBack: if that is to be asked again.
    """
    if yes:
        return True

    def read(answer: str) -> bool:
        if answer.lower() in _YES_OR_NO:
            return _YES_OR_NO[answer.lower()]
        raise SelectionError("expected y or n")

    _require_somebody("--yes")
    _forget_typed()
    return _answer(f"\n{question} [y/N] ", read, back=back)


def end_with_terminal() -> None:
    """Send this process SIGHUP once its terminal is closed, which the system does not always do.

    So for a command in the background of a shell that was killed.
    """
    terminal = next(filter(os.isatty, (2, 1, 0)), None)
    if terminal is None:
        return
    own = os.dup(terminal)

    def watch() -> None:
        closed = select.poll()
        closed.register(own, 0)
        closed.poll()
        os.kill(os.getpid(), signal.SIGHUP)

    threading.Thread(target=watch, name="terminal", daemon=True).start()


def keep_output() -> None:
    """Have what libraries print go to standard error: standard output is for results.

    Fast DDS prints there that it could not open a port, as after a node of another user, and a
    JSON document behind that is none. On a terminal both are the same.
    """
    # Else it is that of another program, or of a test.
    output = sys.__stdout__
    if output is not None and output is sys.stdout and not output.isatty():
        output.flush()
        own = os.dup(1)
        os.dup2(2, 1)
        # By lines, as on a terminal: else the result comes after an error that followed it.
        sys.stdout = os.fdopen(own, "w", 1, encoding=output.encoding, errors=output.errors)


class Signals:
    """The signals that end a work in order: they are only noted.

    An exception could be lost in an import or in a callback of rclpy.
    """

    def __init__(self) -> None:
        self.came: list[int] = []
        """Those that have come."""
        self._before: dict[int, Any] = {}

    def note(self, *numbers: int) -> None:
        """Only note these signals from now on."""
        for number in numbers:
            before = signal.signal(number, lambda n, _: self.came.append(n))
            self._before.setdefault(number, before)

    def obey(self) -> None:
        """Let them do from now on what they did before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def raise_if_came(self) -> None:
        """Raise what the first signal that has come stands for."""
        if self.came:
            first = self.came[0]
            raise KeyboardInterrupt if first == signal.SIGINT else SystemExit(128 + first)


@contextmanager
def noted(tell: Callable[[str], None]) -> Iterator[tuple[StatusLine, Callable[[], bool]]]:
    """Only note signals in the block, and obey them after it.

    :param tell: called with the error with which the block ends after a signal.
    :return: a line for the status, which ends with the block; what tells whether a signal came.
    """
    signals, shown = Signals(), StatusLine()
    signals.note(signal.SIGINT, signal.SIGTERM)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        # An ignored one stays ignored, for nohup.
        signals.note(signal.SIGHUP)
    try:
        yield shown, lambda: bool(signals.came)
    except RelayAutotuneError as error:
        if not signals.came:
            raise
        shown.clear()
        tell(str(error))
    finally:
        shown.clear()
        signals.obey()
        signals.raise_if_came()


def agreed_step(question: str, step: float, allowed: StepRange) -> float:
    """Ask whether to make a step; return its height, 0 for none.

    :param question: with its question mark.
    :param step: the height that yes takes [y].
    :param allowed: the heights that may be typed in its place.
    :raises LoopError: if nobody can be asked.
    """

    def read(answer: str) -> float:
        if answer.lower() in _YES_OR_NO:
            return step if _YES_OR_NO[answer.lower()] else 0.0
        other = number_of(answer)
        if other is None or not allowed.allows(other):
            raise SelectionError(f"expected y, n, or the height of the step, {allowed.words}")
        return other

    _require_somebody("--yes")
    print("\n" + "\n".join(broken(question, width())))
    _forget_typed()
    return _answer(f"[y/N, or another step, such as {0.5 * step:.2g}] ", read)


def asked(
    what: str,
    flag: str,
    known: str,
    example: str,
    read: Callable[[str], _Value],
    *,
    back: bool = False,
) -> _Value:
    """Ask for a value until it can be read and can be.

    :param what: what is asked for, with its unit.
    :param flag: the flag that would have given it, with those of the questions that follow.
    :param known: the value that Enter takes; empty: none.
    :param example: what may be typed.
    :param read: as of `_answer`.
    :param back: whether there is a question before.
    :raises GoBack: if that is to be asked again.
    """
    _require_somebody(flag)
    shown = f"{in_units(what, UNITS)}, such as {example}" + f" [{known}]" * bool(known) + ": "
    return _answer(shown, lambda text: read(text or known), back=back)


def _answer(shown: str, read: Callable[[str], _Value], *, back: bool = False) -> _Value:
    """Return what an answer means; one that is refused is asked for again.

    :param shown: the prompt.
    :param read: returns the meaning of a text, or raises a SelectionError with what is expected.
    :param back: whether there is a question before.
    :raises GoBack: if that is to be asked again.
    """
    while True:
        text = _input(shown)
        if back and text == BACK:
            raise GoBack
        try:
            return read(text)
        except SelectionError as error:
            print("\n".join(broken(str(error), width())), file=sys.stderr)


def _require_somebody(flag: str) -> None:
    if not sys.stdin.isatty():
        raise LoopError(f"answers come from a terminal alone, and here is none: give {flag}")


def _forget_typed() -> None:
    """Forget what was typed at a terminal before a question, which nobody had read then."""
    with suppress(termios.error, OSError, ValueError):
        termios.tcflush(sys.stdin, termios.TCIFLUSH)


def _input(shown: str) -> str:
    try:
        _await_line(shown)
        return input().strip()
    except EOFError:
        raise LoopError("the input has ended: nothing was changed") from None


def _await_line(shown: str) -> None:
    """Show a prompt and wait for a line; a signal is never missed.

    One that comes between the last look of the interpreter and a plain read would be noted, and
    heeded after the line.

    :param shown: the prompt.
    """
    sys.stderr.write(shown)
    sys.stderr.flush()
    if not sys.stdin.isatty():
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    before = signal.set_wakeup_fd(writer)
    try:
        # Python runs the handler as soon as this returns.
        while sys.stdin not in select.select([sys.stdin, reader], [], [])[0]:
            os.read(reader, 64)
    finally:
        signal.set_wakeup_fd(before)
        os.close(reader)
        os.close(writer)


def number_of(text: str) -> float | None:
    """Return a finite number, such as 2.5 or 35 %, or None if a text is something else."""
    found = _ONE.fullmatch(text.strip().translate(_DASHES))
    value = float(found[1]) if found else math.nan
    return value if math.isfinite(value) else None


def pair_of(text: str) -> list[float] | None:
    """Return two finite numbers in order, such as 0 5, 0-5, 0 to 5 % or 0..5; None: other text."""
    found = _TWO.fullmatch(text.strip(" ()[]").translate(_DASHES))
    low, high = map(float, found.groups()) if found else (math.nan, math.nan)
    return [low, high] if -math.inf < low < high < math.inf else None
