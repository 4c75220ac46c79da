# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Questions to the user of a terminal, and what a flag has answered already."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.layout import broken, width
from relay_autotune.errors import LoopError

if TYPE_CHECKING:
    from relay_autotune.control.verification import StepRange

# A number as people type it: with a unit, which counts for nothing. A thousand is no unit.
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
    while True:
        answer = _input(f"{what}: file name, or another program [none]: ")
        if answer.lower() in ("n", "no", "none"):
            return ""
        if answer.lower() in names:
            return answer.lower()
        if answer.lower() not in ("y", "yes"):
            return str(Path(answer).expanduser()) if answer else ""
        told = "expected the name of a file, such as gains.yaml, or Enter for none"
        print(told, file=sys.stderr)


def agrees(question: str, *, yes: bool) -> bool:
    """Ask a question, unless ``--yes`` has answered it.

    :param question: with its question mark.
    :param yes: whether the flag was given.
    :raises LoopError: if nobody can be asked.
    """
    if yes:
        return True
    _require_somebody("--yes")
    return _input(f"\n{question} [y/N] ").lower() in ("y", "yes")


def agreed_step(question: str, step: float, allowed: StepRange) -> float:
    """Ask whether to make a step; return its height, 0 for none.

    :param question: with its question mark.
    :param step: the height that yes takes [y].
    :param allowed: the heights that may be typed in its place.
    :raises LoopError: if nobody can be asked.
    """
    _require_somebody("--yes")
    print("\n" + "\n".join(broken(question, width())))
    while True:
        answer = _input(f"[y/N, or another step, such as {0.5 * step:.2g}] ").lower()
        if answer in ("", "n", "no", "y", "yes"):
            return step if answer.startswith("y") else 0.0
        other = number_of(answer)
        if other is not None and allowed.allows(other):
            return other
        told = f"expected y, n, or the height of the step, {allowed.words}"
        print("\n".join(broken(told, width())), file=sys.stderr)


def asked(what: str, flag: str, known: str, example: str, read: Callable[[str], Any]) -> Any:
    """Ask for a value until it can be read.

    :param what: what is asked for, with its unit.
    :param flag: the flag that would have given it.
    :param known: the value that Enter takes; empty: none.
    :param example: what may be typed.
    :param read: returns the value of a text; None: it has none.
    """
    _require_somebody(flag)
    shown = f"{what}, such as {example}" + f" [{known}]: " * bool(known) + ": " * (not known)
    while (value := read(_input(shown) or known)) is None:
        found = "two numbers, the lower one first" if read is pair_of else "a number"
        print(f"expected {found}, such as {example}", file=sys.stderr)
    return value


def _require_somebody(flag: str) -> None:
    if not sys.stdin.isatty():
        raise LoopError(f"nobody can be asked here: give {flag}")


def _input(shown: str) -> str:
    try:
        return input(shown).strip()
    except EOFError:
        raise LoopError("the input has ended: nothing was changed") from None


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
