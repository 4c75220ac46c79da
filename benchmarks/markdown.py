# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


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


def three(value: float) -> str:
    """Return a number with three digits, without an exponent where two zeros are enough."""
    if value == 0.0 or not abs(value) < float("inf"):
        return f"{value:g}"
    if 1e-3 <= abs(value) < 1e6:
        digits = max(0, 2 - int(f"{value:.2e}".split("e")[1]))
        return f"{value:.{digits}f}"
    return f"{value:.2e}"
