# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Figures of the controller: what the recommended gains do, and those of each other rule."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import TYPE_CHECKING

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.loop.laws import LAWS
from relay_autotune.loop.sampled import ClosedLoop, simulate_closed_loop
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.report.case import Case, in_loop
from relay_autotune.report.style import BLUE, INK, MUTED, SKY, VERMILLION, finish, in_steps, legend
from relay_autotune.tuning import Gains

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_SAMPLES = 500
# A law that takes more samples for the figure is shown as a continuous controller.
_MOST_SAMPLES = 8000
# Number of models within the uncertainty that are simulated.
_SHOWN = 10


def draw_closed_loop(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw a step of the set-point and one of the load, with the recommended gains.

    :param case: with a model and gains.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.best_gains is not None
    assert case.model is not None
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1.0))
    model = in_loop(case, case.model.found.model)
    half = step_duration(case.best_gains, model)
    run = simulated(case.best_gains, model, half)
    for other in case.models_around[:: max(1, len(case.models_around) // _SHOWN)]:
        around = simulated(case.best_gains, in_loop(case, other), half)
        if around is not None:
            above.plot(
                around.time, around.measurement, color=SKY, lw=1.0, alpha=0.8,
                label="models within the uncertainty",
            )  # fmt: skip
    if run is not None:
        above.plot(run.time, run.measurement, color=VERMILLION, lw=2.0, label="the model")
        below.plot(*in_steps(run.time, run.command), color=BLUE, lw=1.5)
    _steps(above, half)
    below.axvline(half, color=MUTED, lw=0.9, ls=(0, (1, 2)))
    for at, text in ((0.0, "set-point step"), (half, "load step")):
        above.annotate(
            text, (at, 1.0), (0, 3), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=9, color=MUTED,
        )  # fmt: skip
    above.margins(x=0.01)
    split = "\n" if narrow else " "
    above.set_ylabel(f"measurement,{split}deviation [y]")
    below.set(ylabel="command,\ndeviation [u]", xlabel="time [s]")
    # A loop that is unstable on an extreme model must not set the scale for all others.
    low, high = above.get_ylim()
    above.set_ylim(max(low, -1.0), min(high, 2.5))
    if case.models_around:
        legend(figure, columns=2)
    finish(figure)


def draw_rules(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw the measurement after both steps for each rule, each beside the recommended one.

    :param case: with a model and the gains of several rules.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.best_gains is not None
    assert case.model is not None
    model = in_loop(case, case.model.found.model)
    half = step_duration(case.best_gains, model)
    best = simulated(case.best_gains, model, half)
    others = distinct_gains(case)[1:]
    columns = _columns(len(others), narrow=narrow)
    rows = -(-len(others) // columns)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for k, axes in enumerate(grid.flat):
        if k >= len(others):
            axes.remove()
            continue
        run = simulated(others[k], model, half)
        if best is not None:
            axes.plot(best.time, best.measurement, color=VERMILLION, lw=1.1, ls=(0, (4, 1.5)))
        if run is not None:
            axes.plot(run.time, run.measurement, color=BLUE, lw=1.6)
        _steps(axes, half)
        axes.margins(x=0.02)
        axes.set_title(
            f"{others[k].rule}\nMs {others[k].ms:.2f}, IAE {others[k].iae_load:.3g} y s/u",
            loc="left", fontsize=8.5, color=INK,
        )  # fmt: skip
        if k + columns >= len(others):
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("time [s]")
        if k % columns == 0:
            axes.set_ylabel("deviation [y]")
    # A loop that rings strongly must not set the scale for all others.
    low, high = grid[0, 0].get_ylim()
    grid[0, 0].set_ylim(max(low, -1.0), min(high, 2.5))
    finish(figure)


def rules_height(case: Case) -> tuple[float, float]:
    """Return the height that the figure of the rules needs, broad and narrow [in].

    :param case: with the gains of several rules.
    """
    count = len(distinct_gains(case)) - 1
    broad, slim = (-(-count // _columns(count, narrow=narrow)) for narrow in (False, True))
    return 0.4 + 1.75 * broad, 0.4 + 1.6 * slim


def _columns(count: int, *, narrow: bool) -> int:
    if narrow:
        return min(count, 2)
    # Prefer few rows, and few empty places.
    return min((4, 5, 3), key=lambda c: 2 * -(-count // c) - count % -c) if count > 3 else count


def _steps(axes: Axes, half: float) -> None:
    axes.axhline(1.0, color=MUTED, lw=0.9, ls=(0, (5, 3)))
    axes.axvline(half, color=MUTED, lw=0.9, ls=(0, (1, 2)))


def distinct_gains(case: Case) -> tuple[Gains, ...]:
    """Return the recommended gains and those of the other rules that differ from them.

    If several rules give the same gains, as an automatic rule does with the one it chose, only the
    first is kept.

    :param case: with gains.
    """
    assert case.best_gains is not None
    found: dict[tuple[float, ...], Gains] = {}
    for gains in (case.best_gains, *case.gains):
        key = tuple(float(f"{v:.6g}") for v in (gains.kc, gains.ti, gains.td, gains.tf, gains.b))
        found.setdefault(key, gains)
    return tuple(found.values())


def step_duration(gains: Gains, model: TransferFunction) -> float:
    """Return how long a step is shown [s]: until it has settled, with some margin.

    :param gains: of the loop.
    :param model: the process, with all dead time of the loop.
    """
    slowest = max((abs(t) for t in model.time_constants), default=0.0)
    reset = gains.ti / abs(gains.kc * model.gain) if model.is_stable and gains.ti else gains.ti
    return 2.5 * (2.0 * model.dead_time + max(slowest, gains.ti) + reset)


def shown_load(gains: Gains, model: TransferFunction) -> float:
    """Return the step of the load that is shown after one of the set-point [u].

    It is about half of the command that the step of the set-point needs, in the other direction.

    :param gains: of the loop.
    :param model: the process, with all dead time of the loop.
    """
    return -0.5 / abs(model.gain) if model.is_stable else -0.2 * abs(gains.kc)


@functools.lru_cache(maxsize=64)
def simulated(gains: Gains, model: TransferFunction, half: float) -> ClosedLoop | None:
    """Return a step of the set-point and then one of the load; None: the gains cannot run.

    :param gains: with the law that they are for, if one was named.
    :param model: the process, with the dead time that the loop adds to it.
    :param half: time of the step of the load, and until the end after it [s].
    """
    load = shown_load(gains, model)
    law, period = LAWS.get(gains.law), gains.law_period
    if law is not None and 2.0 * half < _MOST_SAMPLES * period:
        held = replace(model, dead_time=max(model.dead_time - law.lag(period), 0.0))
        return simulate_closed_loop(
            law.at(gains, period).running(), held, period=period, duration=2.0 * half,
            setpoint=1.0, load=load, load_time=half,
        )  # fmt: skip
    fine = min(half / _SAMPLES, max(gains.tf, model.dead_time) / 5.0 or math.inf)
    try:
        return simulate_closed_loop(
            gains, model, period=max(fine, half / 4000.0), duration=2.0 * half,
            setpoint=1.0, load=load, load_time=half,
        )  # fmt: skip
    except RelayAutotuneError:
        # Gains that cannot run at any sampling period are still in the table.
        return None
