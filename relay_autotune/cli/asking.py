# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Questions to the user of a terminal, and what a flag has answered already."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from typing import Any

from relay_autotune.cli.layout import broken, width
from relay_autotune.errors import LoopError

# What people type between two numbers; a single point belongs to a number.
_BETWEEN = re.compile(r"\.{2,}|[,;]|\b(?:to|and)\b")


def asked_for_file(what: str) -> str:
    """Ask for a file to write; return its name, empty for none.

    :param what: what would be written.
    """
    return _input(f"{what}, to which file? [none]: ") if sys.stdin.isatty() else ""


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


def agreed_step(
    question: str, step: float, low: float = -math.inf, high: float = math.inf
) -> float:
    """Ask whether to make a step; return its height, 0 for none.

    :param question: with its question mark.
    :param step: the height that yes takes [y].
    :param low: lowest height that may be typed in its place [y].
    :param high: highest one [y].
    :raises LoopError: if nobody can be asked.
    """
    _require_somebody("--yes")
    print("\n" + "\n".join(broken(question, width())))
    while True:
        answer = _input(f"[y/N, or another step, such as {0.5 * step:.2g}] ").lower()
        if answer in ("", "n", "no", "y", "yes"):
            return step if answer.startswith("y") else 0.0
        other = number_of(answer)
        if other and low <= other <= high:
            return other
        told = "other than 0"
        if math.isfinite(high - low):
            told = f"from {low:g} to {high:g} y, with whose overshoot it stays within the limits"
        print(f"expected y, n, or the height of the step, {told}", file=sys.stderr)


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
    """Return a finite number, or None if a text is something else."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def pair_of(text: str) -> list[float] | None:
    """Return two finite numbers in order, such as 0 5, 0 to 5, 0,5 or 0..5; None: other text."""
    numbers = [number_of(word) for word in _BETWEEN.sub(" ", text.strip(" ()[]")).split()]
    found = [number for number in numbers if number is not None]
    return found if len(found) == len(numbers) == 2 and found[0] < found[1] else None
