# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Lines as wide as the terminal: text is broken between its parts or its words, never in one."""

from __future__ import annotations

import argparse
import os
import re
import sys
import textwrap
from collections.abc import Sequence

# Longer lines are hard to read, also where the terminal is wider.
WIDEST = 99
NARROWEST = 40

_INDENT = "  "
_LABEL = 16
# Quantities on one line stand this far apart.
_GAP = "   "


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
    if len(text) <= columns:
        return [text]
    lines: list[str] = []
    for part in re.split(rf"(?<=\S){_GAP} *(?=\S)", text):
        if lines and len(lines[-1]) + len(_GAP) + len(part) <= columns:
            lines[-1] += _GAP + part
        else:
            lines += textwrap.wrap(part, columns, break_long_words=False, break_on_hyphens=False)
    return lines or [""]


def paragraphs(text: str, columns: int) -> str:
    """Return text with its paragraphs filled; lines that begin with a blank stay as they are.

    :param text: lines, as in a docstring.
    :param columns: that a line may have.
    """
    done: list[str] = []
    words: list[str] = []
    for line in [*text.splitlines(), ""]:
        if line[:1].strip():
            words += line.split()
            continue
        if words:
            done += broken(" ".join(words), columns)
            words = []
        done.append(line)
    return "\n".join(done).strip("\n")


class Help(argparse.RawDescriptionHelpFormatter):
    """The help of a command: paragraphs as wide as the terminal, examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(indent + line for line in paragraphs(text, width).splitlines())


def labelled(
    label: str, text: str, columns: int, *, indent: int = len(_INDENT) + _LABEL + 1
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


def in_columns(rows: Sequence[Sequence[str]], columns: int) -> list[str]:
    """Return a table: the first cell of each row to the left, the others to the right.

    :param rows: of the same number of cells.
    :param columns: that a line may have; where they do not suffice, the columns stand closer.
    """
    needed = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    gap = 2 if sum(needed) + 2 * len(needed) <= columns else 1
    first, *others = needed
    return [
        f"{_INDENT}{row[0]:<{first}}".rstrip()
        if not any(row[1:])
        else _INDENT
        + f"{row[0]:<{first}}"
        + "".join(f"{cell:>{gap + n}}" for cell, n in zip(row[1:], others, strict=True)).rstrip()
        for row in rows
    ]
