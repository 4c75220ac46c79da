"""Figures of the controller: what each rule's gains do, and how sure the model is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.models import TransferFunction
from relay_autotune.report.case import Case, Estimate
from relay_autotune.report.style import (
    BLUE,
    GREEN,
    INK,
    LINES,
    MUTED,
    VERMILLION,
    finish,
    in_steps,
    legend,
)
from relay_autotune.tuning import Gains
from relay_autotune.tuning.closed_loop import ClosedLoop, simulate_closed_loop

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_SAMPLES = 500
# A parameter whose interval is wider than this is not determined.
_DETERMINED = 0.2
_WIDEST = 1.0


def draw_closed_loop(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw a step of the set-point and one of the load, with each rule's gains.

    :param case: with a model and gains.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.best_gains is not None
    assert case.model is not None
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1.0))
    half = _half(case.best_gains, case.model.model)
    others = distinct_gains(case)[1:]
    for gains, (colour, dashes) in zip(others, _tints(len(others)), strict=True):
        run = _run(gains, case.model.model, half)
        if run is None:
            continue
        above.plot(run.time, run.measurement, color=colour, lw=1.2, ls=(0, dashes))
        below.plot(*in_steps(run.time, run.command), color=colour, lw=1.0, ls=(0, dashes))
        above.plot([], [], color=colour, lw=1.4, ls=(0, dashes), label=gains.rule)
    best = _run(case.best_gains, case.model.model, half)
    if best is not None:
        name = f"{case.best_gains.rule} (recommended)"
        above.plot(best.time, best.measurement, color=VERMILLION, lw=2.2, label=name)
        below.plot(*in_steps(best.time, best.command), color=VERMILLION, lw=1.8)
    above.axhline(1.0, color=MUTED, lw=0.9, ls=(0, (5, 3)))
    for axes in (above, below):
        axes.axvline(half, color=MUTED, lw=0.9, ls=(0, (1, 2)))
        axes.margins(x=0.01)
    for at, text in ((0.0, "set-point step"), (half, "load step")):
        above.annotate(
            text, (at, 1.0), (4, 0), xycoords=("data", "axes fraction"),
            textcoords="offset points", va="top", fontsize=9, color=MUTED,
        )  # fmt: skip
    above.set_ylabel("measurement,\ndeviation [y]")
    below.set(ylabel="command,\ndeviation [u]", xlabel="time [s]")
    legend(figure, columns=2 if narrow else 6)
    finish(figure)


def distinct_gains(case: Case) -> tuple[Gains, ...]:
    """Return the recommended gains and those of the other rules that differ from them.

    Of rules that give the same gains, as an automatic choice does with the one it chose, the
    first stands for all.

    :param case: with gains.
    """
    assert case.best_gains is not None
    found: dict[tuple[float, ...], Gains] = {}
    for gains in (case.best_gains, *case.gains):
        key = tuple(float(f"{v:.6g}") for v in (gains.kc, gains.ti, gains.td, gains.tf, gains.b))
        found.setdefault(key, gains)
    return tuple(found.values())


def _tints(count: int) -> list[tuple[str, tuple[float, ...]]]:
    return [LINES[k % len(LINES)] for k in range(count)]


def _half(gains: Gains, model: TransferFunction) -> float:
    """Return how long a step is followed [s]: until it has died away, with some room."""
    slowest = max((abs(t) for t in model.time_constants), default=0.0)
    reset = gains.ti / abs(gains.kc * model.gain) if model.is_stable and gains.ti else gains.ti
    return 2.5 * (2.0 * model.dead_time + max(slowest, gains.ti) + reset)


def load_size(case: Case) -> float:
    """Return the size of the load step that is drawn [u].

    :param case: with a model and gains.
    """
    assert case.best_gains is not None
    assert case.model is not None
    model = case.model.model
    # Against the direction of the set-point step, about as much as half of it needs.
    return -0.5 / abs(model.gain) if model.is_stable else -0.2 * abs(case.best_gains.kc)


def _run(gains: Gains, model: TransferFunction, half: float) -> ClosedLoop | None:
    load = -0.5 / abs(model.gain) if model.is_stable else -0.2 * abs(gains.kc)
    fine = min(half / _SAMPLES, max(gains.tf, model.dead_time) / 5.0 or math.inf)
    try:
        return simulate_closed_loop(
            gains, model, period=max(fine, half / 4000.0), duration=2.0 * half,
            setpoint=1.0, load=load, load_time=half,
        )  # fmt: skip
    except RelayAutotuneError:
        # Gains that cannot be run at any sampling period are in the table all the same.
        return None


def draw_uncertainty(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw how far each quantity of the model may lie from its estimate.

    :param case: with a model whose uncertainty is known.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    rows = _with_intervals(case)
    axes = figure.subplots()
    axes.axvspan(-100 * _DETERMINED, 100 * _DETERMINED, color=GREEN, alpha=0.12, lw=0)
    axes.axvline(0.0, color=MUTED, lw=0.9)
    ends = [100.0 * _clipped(r) for e in rows for r in _relative(e)]
    reach = max(2.0, 1.25 * max(map(abs, ends)))
    for k, estimate in enumerate(reversed(rows)):
        low, high = (100.0 * _clipped(r) for r in _relative(estimate))
        colour = BLUE if estimate.determined else VERMILLION
        axes.plot([low, high], [k, k], color=colour, lw=2.4, solid_capstyle="butt")
        axes.plot([low, high], [k, k], "|", color=colour, ms=11, mew=2.0)
        axes.plot([0.0], [k], "o" if estimate.determined else "X", color=colour, ms=6)
        if math.isfinite(estimate.truth):
            off = 100.0 * (estimate.truth / estimate.value - 1.0)
            axes.plot([off], [k], "*", color=INK, ms=9)
    axes.set_yticks(range(len(rows)), [e.title for e in reversed(rows)])
    axes.set(xlabel=f"distance{'' if narrow else ' from the estimate'} [%]", xlim=(-reach, reach))
    axes.set_ylim(-0.6, len(rows) - 0.4)
    finish(figure)
    axes.grid(visible=False, axis="y")


def uncertainty_height(case: Case) -> float:
    """Return the height that the figure of the uncertainty needs [in].

    :param case: with a model.
    """
    return 0.95 + 0.42 * len(_with_intervals(case))


def _with_intervals(case: Case) -> list[Estimate]:
    assert case.model is not None
    return [e for e in (*case.model.estimates, *case.model.ultimate) if _has_interval(e)]


def _has_interval(estimate: Estimate) -> bool:
    return estimate.value != 0.0 and math.isfinite(estimate.low) and math.isfinite(estimate.high)


def _relative(estimate: Estimate) -> tuple[float, float]:
    ends = sorted(end / estimate.value - 1.0 for end in (estimate.low, estimate.high))
    return ends[0], ends[1]


def _clipped(value: float) -> float:
    return float(np.clip(value, -_WIDEST, _WIDEST))
