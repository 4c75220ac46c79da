# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Figures of model and controller: frequency responses, their uncertainty, what the gains do."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.control.controller import simulate_closed_loop
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.result import Identification
from relay_autotune.loop.gains import Controller, Gains
from relay_autotune.loop.laws import LAWS
from relay_autotune.loop.sampled import ClosedLoop
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import NORMAL_95
from relay_autotune.report.case import Case, EstimatedQuantity, in_loop, ultimate_of
from relay_autotune.report.style import (
    BLUE,
    GREEN,
    GRID,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    SKY,
    VERMILLION,
    in_steps,
    legend,
    panels,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.path import Path


# 95 % of a normal distribution in the plane lie within this number of standard deviations.
_ELLIPSE = math.sqrt(-2.0 * math.log(0.05))
_CORNERS = 24
_TURNS = -2.5


def draw_nyquist(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw the loop of the recommended gains about the point -1.

    :param case: with a model and gains.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    from matplotlib.patches import PathPatch

    gains = case.best_gains
    assert gains is not None
    assert case.model is not None
    axes = panels(figure, 1, 1)
    loop = gains.loop(in_loop(case, case.model.model))
    w = loop_frequencies(loop)
    turn = np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 181))
    near_point = -1.0 + turn / gains.ms
    axes.plot(
        near_point.real, near_point.imag, color=VERMILLION, lw=1.5, ls=(0, (5, 2)),
        label=f"Ms = {gains.ms:.2f}",
    )  # fmt: skip
    axes.plot(turn.real, turn.imag, color=MUTED, lw=0.9, ls=(0, (1, 2)), label="unit circle")
    if case.models_around:
        grid = w[:: max(1, w.size // 140)]
        around = [gains.loop(in_loop(case, m)) for m in case.models_around]
        values = np.array([each(1j * grid) for each in around])
        near = np.all(np.abs(values) < 6.0, axis=0)
        area = swept_area(values[:, near])
        axes.add_patch(PathPatch(area, fc=SKY, ec="none", alpha=0.45, label="95 % band"))
    values = loop(1j * w)
    axes.plot(values.real, values.imag, color=BLUE, lw=1.8, label="loop")
    if case.points:
        measured = np.array([p.frequency for p in case.points])
        controller = gains(1j * measured) * np.exp(-1j * measured * case.added_delay)
        at = controller * np.array([p.value for p in case.points])
        axes.plot(at.real, at.imag, "D", ms=5, mfc=PAPER, mec=INK, mew=1.3, label="measured")
    _margins(axes, gains, values)
    axes.plot([-1.0], [0.0], "+", ms=11, mew=2.0, color=INK)
    axes.annotate("-1", (-1.0, 0.0), (-4, 5), textcoords="offset points", ha="right", color=INK)
    axes.set(xlim=(-2.3, 1.3), ylim=(-2.3, 1.3), aspect="equal")
    axes.set(xlabel="real part", ylabel="imaginary part")
    legend(figure, columns=2 if narrow else 3)


def _margins(axes: Axes, gains: Gains, loop: ComplexArray) -> None:
    """Mark where the loop crosses the real axis and the unit circle.

    :param axes: of the Nyquist figure.
    :param gains: with their margins.
    :param loop: its values, shape (f,); they decide on which side of the axis the phase margin is.
    """
    if math.isfinite(gains.gain_margin) and gains.gain_margin > 0.0:
        axes.plot(
            [-1.0 / gains.gain_margin], [0.0], "s", ms=6.5, color=GREEN, zorder=3,
            label=f"gain margin {gains.gain_margin:.2f}",
        )  # fmt: skip
    if math.isfinite(gains.phase_margin) and gains.phase_margin < math.pi:
        lead = np.exp(1j * gains.phase_margin * np.array((1.0, -1.0)))
        at = min(-lead, key=lambda z: float(np.min(np.abs(loop - z))))
        axes.plot([0.0, at.real], [0.0, at.imag], color=ORANGE, lw=1.2, zorder=2)
        axes.plot(
            [at.real], [at.imag], "^", ms=7.5, color=ORANGE, zorder=3,
            label=f"phase margin {math.degrees(gains.phase_margin):.0f}°",
        )  # fmt: skip


def loop_frequencies(loop: TransferFunction) -> FloatArray:
    """Return frequencies from where a loop is large to where it is small [rad/s], shape (f,).

    A dead time turns the loop about the origin without end; a few turns are shown.

    :param loop: controller times process.
    """
    grid = frequencies(loop)
    size = np.abs(loop(1j * grid))
    shown = (size < 20.0) & (size > 0.01) & (loop.phase(grid) > _TURNS * 2.0 * math.pi)
    return np.asarray(grid[shown])


def swept_area(values: ComplexArray) -> Path:
    """Return the area of :func:`swept_parts` as one path.

    :param values: of each model at each frequency, shape (m, f).
    """
    from matplotlib.path import Path

    parts = swept_parts(values)
    return Path.make_compound_path(*[Path(np.vstack((p, p[:1])), closed=True) for p in parts])


def swept_parts(values: ComplexArray) -> list[FloatArray]:
    """Return polygons that cover the area which the 95 % ellipses of a curve's points sweep.

    The points of the models at one frequency are taken as normally distributed in the plane, so
    that 95 % of them lie within ``(z - m)' C^-1 (z - m) = -2 ln 0.05``; between two frequencies
    the area is the convex hull of their ellipses.

    :param values: of each model at each frequency, shape (m, f).
    :return: convex polygons, each of shape (n, 2): real and imaginary part of its corners.
    """
    angles = np.linspace(0.0, 2.0 * math.pi, _CORNERS, endpoint=False)
    turn = np.column_stack((np.cos(angles), np.sin(angles)))
    points = np.stack((values.real, values.imag), axis=-1)
    middle = points.mean(axis=0)
    off = points - middle
    spread = np.einsum("mfi,mfj->fij", off, off) / (len(values) - 1)
    # The point of an ellipse that lies farthest in a direction u is m + k C u/sqrt(u' C u).
    far = np.einsum("fij,cj->fci", spread, turn)
    reach = np.sqrt(np.maximum(np.einsum("fci,ci->fc", far, turn), np.finfo(float).tiny))
    rings = middle[:, None] + _ELLIPSE * far / reach[..., None]
    farther = np.einsum("fci,ci->fc", np.diff(rings, axis=0), turn) > 0.0
    return list(np.where(farther[..., None], rings[1:], rings[:-1]))


def draw_bode(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw magnitude and phase of the process, with the points measured from the cycles.

    :param case: with a model.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    from matplotlib.ticker import MultipleLocator, NullFormatter

    assert case.model is not None
    above, below = panels(figure, 2, 1, sharex=True)
    model = case.model.model
    w = _bode_frequencies(case)
    if case.models_around:
        _band(above, w, np.array([np.abs(m(1j * w)) for m in case.models_around]))
        _band(below, w, np.degrees([m.phase(w) for m in case.models_around]))
    phase = np.degrees(model.phase(w))
    above.loglog(w, np.abs(model(1j * w)), color=BLUE, lw=1.8, label="model")
    below.semilogx(w, phase, color=BLUE, lw=1.8)
    points = [p for p in case.points if w[0] <= p.frequency <= w[-1]]
    if points:
        at = np.array([p.frequency for p in points])
        value = np.array([p.value for p in points]) * model.process_sign
        lag = np.degrees(np.angle(value))
        # Take the branch of the angle that is nearest to the model's phase.
        lag += 360.0 * np.round((np.interp(at, w, phase) - lag) / 360.0)
        style = {"fmt": "D", "ms": 6, "mfc": PAPER, "mec": INK, "mew": 1.4, "ecolor": INK}
        std = np.nan_to_num([p.std for p in points])
        # To first order, magnitude and angle have the deviation of the real and imaginary part.
        above.errorbar(at, np.abs(value), yerr=NORMAL_95 * std, label="measured, 95 %", **style)
        below.errorbar(at, lag, yerr=np.degrees(NORMAL_95 * std / np.abs(value)), **style)
    if case.ultimate:
        gain, frequency = case.ultimate
        above.plot(
            [frequency.value], [1.0 / abs(gain.value)], "*", ms=12, color=VERMILLION,
            label="ultimate point, 1/K_u at w_u",
        )  # fmt: skip
        below.plot([frequency.value], [-180.0], "*", ms=12, color=VERMILLION)
    below.axhline(-180.0, color=MUTED, lw=0.9, ls=(0, (5, 3)))
    above.set_ylabel("magnitude [y/u]")
    below.set(ylabel="phase [degrees]", xlabel="frequency [rad/s]")
    floor = -540.0
    lowest = max(float(np.min(phase)), floor)
    below.set_ylim(lowest - 20.0, float(np.max(phase)) + 20.0)
    below.yaxis.set_major_locator(MultipleLocator(90.0))
    for axis in (above.xaxis, above.yaxis, below.xaxis):
        axis.set_minor_formatter(NullFormatter())
    legend(figure, columns=1 if narrow else 4)


def _band(axes: Axes, w: FloatArray, values: FloatArray) -> None:
    low, high = np.quantile(values, (0.025, 0.975), axis=0)
    axes.fill_between(w, low, high, color=SKY, alpha=0.45, lw=0, label="95 % band")


def _bode_frequencies(case: Case) -> FloatArray:
    """Return frequencies around those that the experiment excited, or the model's corner."""
    assert case.model is not None
    if case.ultimate:
        middle = case.ultimate[1].value
    elif case.limit_cycle is not None:
        middle = 2.0 * math.pi / case.limit_cycle.period
    else:
        constants = [abs(c) for c in case.model.model.time_constants] or [1.0]
        middle = 1.0 / max(constants)
    return np.geomspace(0.02 * middle, 8.0 * middle, 400)


# A parameter whose interval is wider than this is not determined.
_DETERMINED = 0.2
_WIDEST = 1.0


def _apart(name: str, estimate: EstimatedQuantity, centre: float) -> EstimatedQuantity:
    """Return how far a quantity lies from a value [%], at most 100 either way.

    :param name: at its row of the figure.
    :param estimate: the quantity.
    :param centre: the value.
    """

    def distance(value: float) -> float:
        return 100.0 * float(np.clip(value / centre - 1.0, -_WIDEST, _WIDEST))

    low = high = math.nan
    if math.isfinite(estimate.low) and math.isfinite(estimate.high):
        low, high = sorted((distance(estimate.low), distance(estimate.high)))
    value, truth = distance(estimate.value), distance(estimate.truth)
    return EstimatedQuantity(name, value, low, high, "%", estimate.determined, truth)


def draw_uncertainty(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw how far each quantity may lie from its estimate, and how far the methods agree.

    :param case: with a model whose uncertainty is known.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    groups = _groups(case)
    if narrow:
        sizes = [len(rows) + 2 for _, rows in groups]
        parts = panels(figure, len(groups), 1, height_ratios=sizes, squeeze=False)
    else:
        parts = panels(figure, 1, len(groups), squeeze=False)
    for axes, (title, rows) in zip(parts.flat, groups, strict=True):
        _panel(axes, rows)
        axes.set_title(title, loc="left", fontsize=9.5, color=INK)
        axes.set_xlabel("distance from the estimate [%]")
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)


def uncertainty_height(case: Case) -> tuple[float, float]:
    """Return the height that the figure of the uncertainty needs, broad and narrow [in].

    :param case: with a model.
    """
    sizes = [len(rows) for _, rows in _groups(case)]
    return 0.95 + 0.3 * max(sizes), sum(0.9 + 0.27 * size for size in sizes)


def _groups(case: Case) -> list[tuple[str, list[EstimatedQuantity]]]:
    """Return the panels: the parameters, and K_u and w_u by each method."""
    assert case.model is not None
    own = [_apart(e.title, e, e.value) for e in case.parameters if e.value != 0.0]
    found = [("parameters of the model", own)] if own else []
    for k, title in enumerate(("ultimate gain K_u by method", "ultimate frequency w_u by method")):
        if case.ultimate:
            centre = case.ultimate[k].value
            each = [(m.method, ultimate_of(m, case.truth)) for m in _each_method(case)]
            found.append((title, [_apart(n, both[k], centre) for n, both in each if both]))
    return found


def _each_method(case: Case) -> list[Identification]:
    """Return one model of each method, the selected one first."""
    assert case.model is not None
    found = {case.model.method: case.model}
    for model in case.models:
        found.setdefault(model.method, model)
    return list(found.values())


def _panel(axes: Axes, rows: Sequence[EstimatedQuantity]) -> None:
    reach = 2.0
    axes.axvspan(-100.0 * _DETERMINED, 100.0 * _DETERMINED, color=GREEN, alpha=0.12, lw=0)
    axes.axvline(0.0, color=MUTED, lw=0.9)
    for k, row in enumerate(reversed(rows)):
        colour = BLUE if row.determined else VERMILLION
        axes.axhline(k, color=GRID, lw=0.7, zorder=0.5)
        if math.isfinite(row.low):
            axes.plot([row.low, row.high], [k, k], color=colour, lw=2.2, solid_capstyle="butt")
            axes.plot([row.low, row.high], [k, k], "|", color=colour, ms=8, mew=1.8)
            reach = max(reach, 1.2 * abs(row.low), 1.2 * abs(row.high))
        axes.plot([row.value], [k], "o" if row.determined else "X", color=colour, ms=5)
        if math.isfinite(row.truth):
            axes.plot([row.truth], [k], "*", color=INK, ms=9)
        reach = max(reach, 1.2 * abs(row.value))
    axes.set(xlim=(-reach, reach), ylim=(-0.6, len(rows) - 0.4))
    axes.set_yticks(range(len(rows)), [row.name for row in reversed(rows)])


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
    above, below = panels(figure, 2, 1, sharex=True, height_ratios=(1.7, 1.0))
    model = in_loop(case, case.model.model)
    half = step_duration(case.best_gains, model)
    run = simulated(case.best_gains, model, half)
    for other in case.models_around[:: max(1, len(case.models_around) // _SHOWN)]:
        around = simulated(case.best_gains, in_loop(case, other), half)
        if around is not None:
            above.plot(
                around.time, around.measurement, color=SKY, lw=1.0, alpha=0.8,
                label="models within the uncertainty",
            )  # fmt: skip
    before = None
    if case.present is not None and case.present_does is not None:
        before = simulated(case.present, model, half)
    if before is not None:
        dashed: Any = {"color": MUTED, "lw": 1.5, "ls": (0, (4, 2))}
        above.plot(before.time, before.measurement, label="the gains before", **dashed)
        below.plot(*in_steps(before.time, before.command), **dashed)
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
    if case.models_around or before is not None:
        legend(figure, columns=2)


def draw_rules(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw the measurement after both steps for each rule, each beside the recommended one.

    :param case: with a model and the gains of several rules.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.best_gains is not None
    assert case.model is not None
    model = in_loop(case, case.model.model)
    half = step_duration(case.best_gains, model)
    best = simulated(case.best_gains, model, half)
    others = distinct_gains(case)[1:]
    columns = _columns(len(others), narrow=narrow)
    rows = -(-len(others) // columns)
    grid = panels(figure, rows, columns, sharex=True, sharey=True, squeeze=False)
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


def step_duration(gains: Controller, model: TransferFunction) -> float:
    """Return how long a step is shown [s]: until it has settled, with some margin.

    :param gains: of the loop.
    :param model: the process, with all dead time of the loop.
    """
    slowest = max((abs(t) for t in model.time_constants), default=0.0)
    reset = gains.ti / abs(gains.kc * model.gain) if model.is_stable and gains.ti else gains.ti
    return 2.5 * (2.0 * model.dead_time + max(slowest, gains.ti) + reset)


def shown_load(gains: Controller, model: TransferFunction) -> float:
    """Return the step of the load that is shown after one of the set-point [u].

    It is about half of the command that the step of the set-point needs, in the other direction.

    :param gains: of the loop.
    :param model: the process, with all dead time of the loop.
    """
    return -0.5 / abs(model.gain) if model.is_stable else -0.2 * abs(gains.kc)


@functools.lru_cache(maxsize=64)
def simulated(gains: Controller, model: TransferFunction, half: float) -> ClosedLoop | None:
    """Return a step of the set-point and then one of the load; None: the gains cannot run.

    :param gains: with the law that they are for, if one was named.
    :param model: the process, with the dead time that the loop adds to it.
    :param half: time of the step of the load, and until the end after it [s].
    """
    load = shown_load(gains, model)
    law, period = None, 0.0
    if isinstance(gains, Gains):
        law, period = LAWS.get(gains.law), gains.law_period
    if law is not None and 2.0 * half < _MOST_SAMPLES * period:
        held = replace(model, dead_time=max(model.dead_time - law.lag(period), 0.0))
        return simulate_closed_loop(
            law.at(gains, period), held, period=period, duration=2.0 * half,
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
