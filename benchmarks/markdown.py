# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Tables in Markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


def table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table with aligned columns.

    :param headings: one for each column.
    :param rows: of as many cells each.
    """
    cells = [[str(cell) for cell in row] for row in (headings, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(headings))]

    def line(row: Sequence[str]) -> str:
        return "| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |"

    rule = "|" + "|".join("-" * (w + 2) for w in widths) + "|"
    return "\n".join([line(cells[0]), rule, *map(line, cells[1:])])


@dataclass(frozen=True)
class Figure:
    """A figure of a table, and the bound that the next column sets for it.

    :param value: as it stands.
    :param target: the bound.
    :param is_least: whether the figure is to be at least that, not at most.
    :param comparable: the figure, or, where the row has it, the multiple of a reference workload
        that was timed in turns with it: that one does not turn on the machine and its other work.
    """

    value: float
    target: float
    is_least: bool
    comparable: float

    @property
    def is_met(self) -> bool:
        """Whether it is within its bound."""
        return self.value >= self.target if self.is_least else self.value <= self.target

    def loss(self, earlier: Figure) -> float:
        """Return how many times worse it is than an earlier one; 1 where both are nothing."""
        if not self.is_least and self.value <= _FAR_BELOW * self.target:
            return 1.0
        worse, better = self.comparable, earlier.comparable
        if self.is_least:
            worse, better = better, worse
        return worse / better if better else math.inf


_MULTIPLE = "x reference"
_CELL = re.compile(r"(?P<sign>[<>]=)? ?(?P<number>\d[\d,]*(\.\d+)?(e[-+]\d+)?)")
# A figure below this share of its bound may vary freely: rounding, or no lost sample.
_FAR_BELOW = 0.01


def _is_target(cell: str) -> bool:
    return cell.startswith("target")


def naming(text: str) -> int:
    """Return how many columns at the beginning tell all rows that have a target apart.

    :param text: with tables as `table` makes them.
    """
    columns = 1
    while len(figures(text, columns)) < len(figures(text, columns + 1)):
        columns += 1
    return columns


def figures(text: str, naming: int) -> dict[tuple[str, ...], Figure]:
    """Return the figures of all tables in a text that have a target.

    It stands in the next column, in the heading, or in a row below.

    :param text: with tables as `table` makes them.
    :param naming: number of columns at the beginning that name a row.
    :return: the figures by the cells that name them, and the heading.
    """
    found: dict[tuple[str, ...], Figure] = {}
    headings: list[str] = []
    above: list[str] = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) != len(headings):
            headings = cells
        # A target stands in the next column, in the heading, or in a row of its own below.
        aimed = [(cells, k, t) for k, t in enumerate(cells[1:]) if _is_target(headings[k + 1])]
        aimed += [(cells, k, h.partition("(target")[2]) for k, h in enumerate(headings)]
        if cells and _is_target(cells[0]):
            aimed = [(above, k, target) for k, target in enumerate(cells)]
        for row, k, target in aimed:
            figure, bound = _CELL.match(row[k]), _CELL.match(target.strip())
            if figure and bound and bound["sign"]:
                multiple = _CELL.match(dict(zip(headings, row, strict=True)).get(_MULTIPLE, ""))
                stated, wanted, comparable = (
                    float(m["number"].replace(",", ""))
                    for m in (figure, bound, multiple or figure)
                )
                name = (*row[:naming], headings[k])
                found[name] = Figure(stated, wanted, bound["sign"] == ">=", comparable)
        above = cells
    return found


def three(value: float) -> str:
    """Return a number with three digits, without an exponent where two zeros are enough."""
    if value == 0.0 or not abs(value) < float("inf"):
        return f"{value:g}"
    if 1e-3 <= abs(value) < 1e6:
        digits = max(0, 2 - int(f"{value:.2e}".split("e")[1]))
        return f"{value:.{digits}f}"
    return f"{value:.2e}"
