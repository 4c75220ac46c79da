# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The figure of a model's uncertainty, and of how well the methods agree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relay_autotune.report.case import Case, EstimatedQuantity, ModelCase
from relay_autotune.report.style import BLUE, GREEN, GRID, INK, MUTED, VERMILLION, finish

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

# A parameter whose interval is wider than this is not determined.
_DETERMINED = 0.2
_WIDEST = 1.0


@dataclass(frozen=True)
class _Row:
    """A quantity in the figure.

    :param name: at its row.
    :param estimate: the quantity.
    :param centre: the value from which its distance counts.
    """

    name: str
    estimate: EstimatedQuantity
    centre: float

    def ends(self) -> tuple[float, float] | None:
        """Return the ends of the interval as distances [%]; None: not estimated."""
        low, high = self.estimate.low, self.estimate.high
        if not (math.isfinite(low) and math.isfinite(high)):
            return None
        first, last = sorted((self.distance(low), self.distance(high)))
        return first, last

    def distance(self, value: float) -> float:
        """Return how far a value is from the centre [%], at most 100 either way."""
        return 100.0 * float(np.clip(value / self.centre - 1.0, -_WIDEST, _WIDEST))


def draw_uncertainty(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw how far each quantity may lie from its estimate, and how far the methods agree.

    :param case: with a model whose uncertainty is known.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    groups = _groups(case)
    if narrow:
        sizes = [len(rows) + 2 for _, rows in groups]
        panels = figure.subplots(len(groups), 1, height_ratios=sizes, squeeze=False)
    else:
        panels = figure.subplots(1, len(groups), squeeze=False)
    for axes, (title, rows) in zip(panels.flat, groups, strict=True):
        _panel(axes, rows)
        axes.set_title(title, loc="left", fontsize=9.5, color=INK)
        axes.set_xlabel("distance from the estimate [%]")
    finish(figure)
    for axes in figure.axes:
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)


def uncertainty_height(case: Case) -> tuple[float, float]:
    """Return the height that the figure of the uncertainty needs, broad and narrow [in].

    :param case: with a model.
    """
    sizes = [len(rows) for _, rows in _groups(case)]
    return 0.95 + 0.3 * max(sizes), sum(0.9 + 0.27 * size for size in sizes)


def _groups(case: Case) -> list[tuple[str, list[_Row]]]:
    """Return the panels: the parameters, and K_u and w_u by each method."""
    assert case.model is not None
    own = [_Row(e.title, e, e.value) for e in case.model.estimates if e.value != 0.0]
    found = [("parameters of the model", own)] if own else []
    for k, title in enumerate(("ultimate gain K_u by method", "ultimate frequency w_u by method")):
        if case.model.ultimate:
            centre = case.model.ultimate[k].value
            models = [m for m in _each_method(case) if m.ultimate]
            found.append((title, [_Row(m.method, m.ultimate[k], centre) for m in models]))
    return found


def _each_method(case: Case) -> list[ModelCase]:
    """Return one model of each method, the selected one first."""
    assert case.model is not None
    found = {case.model.method: case.model}
    for model in case.models:
        found.setdefault(model.method, model)
    return list(found.values())


def _panel(axes: Axes, rows: Sequence[_Row]) -> None:
    reach = 2.0
    axes.axvspan(-100.0 * _DETERMINED, 100.0 * _DETERMINED, color=GREEN, alpha=0.12, lw=0)
    axes.axvline(0.0, color=MUTED, lw=0.9)
    for k, row in enumerate(reversed(rows)):
        estimate, at = row.estimate, row.distance(row.estimate.value)
        colour = BLUE if estimate.determined else VERMILLION
        axes.axhline(k, color=GRID, lw=0.7, zorder=0.5)
        ends = row.ends()
        if ends is not None:
            axes.plot(ends, [k, k], color=colour, lw=2.2, solid_capstyle="butt")
            axes.plot(ends, [k, k], "|", color=colour, ms=8, mew=1.8)
            reach = max(reach, 1.2 * abs(ends[0]), 1.2 * abs(ends[1]))
        axes.plot([at], [k], "o" if estimate.determined else "X", color=colour, ms=5)
        if math.isfinite(estimate.truth):
            axes.plot([row.distance(estimate.truth)], [k], "*", color=INK, ms=9)
        reach = max(reach, 1.2 * abs(at))
    axes.set(xlim=(-reach, reach), ylim=(-0.6, len(rows) - 0.4))
    axes.set_yticks(range(len(rows)), [row.name for row in reversed(rows)])
