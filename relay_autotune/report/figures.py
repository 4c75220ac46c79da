# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The figures of a report: what each shows, when it can be drawn, how it is to be read.

Those of the samples are drawn here: the experiment, the fit over it, and the limit cycle in the
phase plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.result import Identification
from relay_autotune.record.record import Record, RelaySettings
from relay_autotune.report.case import Case
from relay_autotune.report.frequency import (
    distinct_gains,
    draw_bode,
    draw_closed_loop,
    draw_nyquist,
    draw_rules,
    draw_uncertainty,
    rules_height,
    uncertainty_height,
)
from relay_autotune.report.style import (
    BLUE,
    GREEN,
    GRID,
    INK,
    MUTED,
    NARROW,
    ORANGE,
    PAPER,
    PURPLE,
    SQUARE,
    VERMILLION,
    WIDE,
    in_steps,
    legend,
    new_figure,
    panels,
    put_units,
    save,
    thinned,
)
from relay_autotune.text import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


_FEW = 400
_NUMBERED = 15
_ROUNDING = 1e-6
_WINDOW = 12


def switches_of(
    record: Record, settings: RelaySettings
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return when a relay left its baseline, switched, and went back, by its commands [s].

    :param record: the experiment.
    :param settings: of its relay.
    """
    tolerance = 1e-9 * settings.amplitude
    high = np.abs(record.command - settings.high) <= tolerance
    low = np.abs(record.command - settings.low) <= tolerance
    level = high.astype(int) - low.astype(int)
    before, after, time = level[:-1], level[1:], record.time[1:]
    return (
        time[(before == 0) & (after != 0)],
        time[before * after == -1],
        time[(before != 0) & (after == 0)],
    )


def draw_experiment(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw measurement and command of a whole experiment.

    :param case: with a record.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.record is not None
    above, below = panels(figure, 2, 1, sharex=True, height_ratios=(2.6, 1.0))
    record, settings = case.record, case.settings
    if settings is not None:
        if settings.hysteresis > 0.0:
            above.axhspan(*_band(settings), color=GREEN, alpha=0.16, lw=0, label="hysteresis band")
        above.axhline(settings.setpoint, color=GREEN, lw=1.0, ls=(0, (5, 3)), label="set-point")
    _shade_cycles(above, case)
    _samples(above, record)
    if settings is not None:
        _mark(above, record, settings)
    above.set_ylabel("measurement [y]")
    u = record.input()
    inside = (u.times > record.time[0]) & (u.times < record.time[-1])
    times = np.concatenate((record.time[:1], u.times[inside], record.time[-1:]))
    below.plot(*in_steps(times, u(times)), color=BLUE, lw=1.3)
    if settings is not None:
        below.axhline(settings.baseline, color=MUTED, lw=1.0, ls=(0, (1, 2)), label="baseline")
    below.set(ylabel="command [u]", xlabel="time [s]")
    below.margins(y=0.18)
    above.margins(x=0.01)
    legend(figure, columns=2 if narrow else 7)


def _band(settings: RelaySettings) -> tuple[float, float]:
    return settings.setpoint - settings.hysteresis, settings.setpoint + settings.hysteresis


def _samples(axes: Axes, record: Record) -> None:
    time, values = thinned(record.time, record.measurement)
    marker = "." if len(record) <= _FEW else ""
    axes.plot(time, values, color=INK, lw=0.8, marker=marker, ms=3.5, label="measurement")


def _shade_cycles(axes: Axes, case: Case) -> None:
    averaged = case.limit_cycle.cycles if case.limit_cycle is not None else ()
    for cycle in case.cycles:
        end = cycle.start + cycle.period
        if cycle.disturbed:
            axes.axvspan(
                cycle.start, end, facecolor="none", edgecolor=PURPLE, hatch="///", lw=0.0,
                alpha=0.6, label="disturbed cycle",
            )  # fmt: skip
        if len(case.cycles) <= _NUMBERED:
            axes.axvline(cycle.start, color=GRID, lw=1.2, zorder=0.5)
            axes.axvline(end, color=GRID, lw=1.2, zorder=0.5)
            axes.annotate(
                f"{cycle.index + 1}", (cycle.start + 0.5 * cycle.period, 0.0), (0, 4),
                xycoords=("data", "axes fraction"), textcoords="offset points", ha="center",
                fontsize=9, color=MUTED, weight="bold" if cycle.index in averaged else "normal",
            )  # fmt: skip


_MARKS = (("D", ORANGE, "kick"), ("o", BLUE, "switch"), ("s", PURPLE, "back to the baseline"))


def _mark(axes: Axes, record: Record, settings: RelaySettings) -> None:
    found = zip(switches_of(record, settings), _MARKS, strict=True)
    for times, (marker, colour, label) in found:
        if times.size:
            values = np.interp(times, record.time, record.measurement)
            axes.plot(
                times, values, marker, ms=6, mfc=PAPER, mec=colour, mew=1.6, ls="", label=label
            )


def draw_fit(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw the model over the measurement, and the residual with the band of the noise.

    :param case: with a record and a model that was fitted to its samples.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.record is not None
    assert case.model is not None
    above, below = panels(figure, 2, 1, sharex=True, height_ratios=(2.2, 1.3))
    record, model = case.record, case.model
    _samples(above, record)
    above.plot(
        *thinned(record.time, model.fitted), color=VERMILLION, lw=1.7, ls=(0, (4, 1.2)),
        label="model",
    )  # fmt: skip
    above.set_ylabel("measurement [y]")
    used = record.measurement[np.isfinite(model.fitted)]
    if 0 < used.size < len(record):
        # A sensor that dropped out would make a line of all others.
        beside = above.margins()[1] * float(np.ptp(used))
        above.set_ylim(float(used.min()) - beside, float(used.max()) + beside)
    _residual(below, record, model)
    below.set_xlabel("time [s]")
    above.margins(x=0.01)
    legend(figure, columns=2 if narrow else 7)


def _residual(axes: Axes, record: Record, model: Identification) -> None:
    noise = model.fit.noise_std
    if np.isfinite(noise) and noise > 0.0:
        axes.axhspan(
            -2.0 * noise, 2.0 * noise, color=GREEN, alpha=0.18, lw=0,
            label="±2 std of the noise at rest",
        )  # fmt: skip
    time, error = thinned(record.time, record.measurement - model.fitted)
    marker = "." if len(record) <= _FEW else ""
    axes.plot(time, error, color=INK, lw=0.6, marker=marker, ms=3.0)
    axes.axhline(0.0, color=MUTED, lw=0.8)
    axes.set_ylabel("residual [y]")
    # A residual that is only rounding is shown as a flat line.
    least = _ROUNDING * float(np.ptp(record.measurement[np.isfinite(model.fitted)]))
    if np.nanmax(np.abs(error)) < least:
        axes.set_ylim(-least, least)


def draw_phase_plane(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw the measurement's rate over the measurement, from rest into the limit cycle.

    :param case: with a record that holds whole cycles.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.record is not None
    assert case.limit_cycle is not None
    axes = panels(figure, 1, 1)
    record, cycle, settings = case.record, case.limit_cycle, case.settings
    time, y, rate = rate_of(record, record.measurement, cycle.period)
    steady = [c for c in case.cycles if c.index in cycle.cycles]
    start, end = steady[0].start, steady[-1].start + steady[-1].period
    inside = (time >= start) & (time <= end)
    if settings is not None and settings.hysteresis > 0.0:
        axes.axvspan(*_band(settings), color=GREEN, alpha=0.16, lw=0, label="hysteresis band")
    axes.plot(y[time <= start], rate[time <= start], color=MUTED, lw=0.9, label="on the way")
    label = f"limit cycle, {len(steady)} cycle{'s' if len(steady) > 1 else ''}"
    axes.plot(y[inside], rate[inside], color=BLUE, lw=1.3, label=label)
    if case.model is not None and case.model.fitted.size == len(record):
        time, fitted, slope = rate_of(record, case.model.fitted, cycle.period)
        last = (time >= end - cycle.period) & (time <= end)
        axes.plot(
            fitted[last], slope[last], color=VERMILLION, lw=1.7, ls=(0, (4, 1.5)), label="model"
        )
    axes.set(xlabel="measurement [y]", ylabel="rate of the measurement [y/s]")
    axes.margins(0.06)
    legend(figure, columns=2 if narrow else 3)


def rate_of(
    record: Record, values: FloatArray, period: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times, values and their derivative by parabolas over a twelfth of the period.

    This keeps the shape of the cycle and averages the noise (Savitzky and Golay 1964).

    :param record: whose instants the values have.
    :param values: shape (n,).
    :param period: of the limit cycle [s].
    :return: s, shape (m,) on a regular grid; values and their rates there, shape (m,).
    """
    # Imported here, since it takes long.
    from scipy.signal import savgol_filter

    known = np.isfinite(values)
    t, v = record.time[known], values[known]
    step = max(record.mean_interval, period / 400.0)
    grid = np.arange(t[0], t[-1], step)
    even = np.interp(grid, t, v)
    count = 2 * round(0.5 * period / _WINDOW / step) + 1
    count = min(max(count, 5), 2 * ((grid.size - 1) // 2) - 1)
    smooth = savgol_filter(even, count, 2)
    rate = savgol_filter(even, count, 2, deriv=1, delta=step)
    # At the ends of the record there are too few neighbours to fit a parabola to.
    whole = slice(count // 2, grid.size - count // 2)
    return grid[whole], np.asarray(smooth)[whole], np.asarray(rate)[whole]


# Least number of samples of a phase plane.
_FEWEST = 20


class Draw(Protocol):
    """Draws a case into an empty figure."""

    def __call__(self, case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
        """Draw."""


@dataclass(frozen=True)
class Plate:
    """A figure of the report.

    :param key: its name in files and in the page's links.
    :param title: what it shows.
    :param draw: draws it into an empty figure.
    :param needs: what it takes, the first things first.
    :param reading: how it is to be read, what is good and what is bad.
    :param wide: True if it fills the page, False if two stand side by side.
    :param without_relay: how it is to be read where no relay acted; empty: the same way.
    :param height: of a case's figure on a broad page and on a narrow one [in].
    """

    key: str
    title: str
    draw: Draw
    needs: tuple[Need, ...]
    reading: str
    height: Callable[[Case], tuple[float, float]]
    wide: bool = True
    without_relay: str = ""

    def missing(self, case: Case) -> str:
        """Return why a case has no such figure; empty: it has one.

        :param case: the experiment.
        """
        return next((why for need in self.needs if (why := need(case))), "")

    def reading_of(self, case: Case) -> str:
        """Return how a case's figure is to be read.

        :param case: the experiment.
        """
        return self.reading if case.settings is not None else self.without_relay or self.reading

    def figure(self, case: Case, *, narrow: bool = False) -> Figure:
        """Return the figure of a case.

        :param case: one for which nothing is missing.
        :param narrow: True if it is for a narrow screen.
        """
        broad, slim = self.height(case)
        width = NARROW if narrow else WIDE if self.wide else SQUARE
        figure = new_figure(width, slim if narrow else broad)
        self.draw(case, figure, narrow=narrow)
        put_units(figure, case.units)
        return figure


# Returns what a case lacks, whose needs before that are there; empty: nothing.
Need = Callable[[Case], str]


def _fit(case: Case) -> str:
    assert case.model is not None
    assert case.record is not None
    if case.model.fitted.size == len(case.record):
        return ""
    return f"the method {case.model.method} does not fit the samples themselves"


def _cycles(case: Case) -> str:
    if not case.cycles or case.limit_cycle is None:
        return "the record has no whole cycle"
    assert case.record is not None
    return "" if len(case.record) >= _FEWEST else "the record has too few samples"


def _intervals(case: Case) -> str:
    assert case.model is not None
    if any(np.isfinite(e.low) for e in (*case.parameters, *case.ultimate)):
        return ""
    return f"the method {case.model.method} gives no uncertainty"


def _one_of(thing: str, why: str) -> Need:
    return lambda case: "" if getattr(case, thing) is not None else why


_SAMPLES = _one_of(
    "record", "it needs the samples, which a result without its recording does not have"
)
_MODEL = _one_of("model", "nothing was identified")
_GAINS = _one_of("best_gains", "there are no gains")


def _other_rules(case: Case) -> str:
    return "" if len(distinct_gains(case)) > 1 else "no other rule gives other gains"


PLATES = (
    Plate(
        "experiment",
        "The experiment",
        draw_experiment,
        (_SAMPLES,),
        "The relay swings the command between two levels; the measurement answers with a limit "
        "cycle. Good: the numbered cycles look alike, and the swing is several times the "
        "hysteresis band. Bad: peaks that wander, a swing lost in noise, cycles marked as "
        "disturbed.",
        lambda _: (4.9, 5.6),
        without_relay="Measurement and command as they were recorded. Good: the process was at "
        "rest before the first step, and each step moves it far beyond its noise.",
    ),
    Plate(
        "fit",
        "Model over the data",
        draw_fit,
        (_SAMPLES, _MODEL, _fit),
        "Above: the model over the measurement. Below: the residual. Good: the residual is as "
        "wide as the band and has no pattern. Bad: it repeats with each cycle (the structure is "
        "too simple), or it drifts or jumps (a load came: end the record before it with --end).",
        lambda _: (4.9, 5.6),
    ),
    Plate(
        "phase_plane",
        "Limit cycle in the phase plane",
        draw_phase_plane,
        (_SAMPLES, _cycles),
        "The rate of the measurement over the measurement itself. Good: the last cycles lie on "
        "one closed curve, and the model's curve on them. Bad: curves that do not close or do "
        "not coincide; corners that the model cuts.",
        lambda _: (5.0, 4.3),
        wide=False,
    ),
    Plate(
        "nyquist",
        "Nyquist",
        draw_nyquist,
        (_MODEL, _GAINS),
        "The loop of recommended controller and process. Its distance from the point -1 is the "
        "robustness: the dashed circle touches it, and its radius is 1/Ms. The square and the "
        "triangle are where gain and phase margin are read. Good: the band stays away from the "
        "circle's centre. Bad: it comes within half a unit of -1.",
        lambda _: (5.3, 4.6),
        wide=False,
    ),
    Plate(
        "bode",
        "Bode",
        draw_bode,
        (_MODEL,),
        "The process alone. The diamonds come from Fourier integrals over whole cycles and need "
        "no model. Good: they lie on the curve. Bad: they leave the band, above all near the "
        "ultimate point.",
        lambda _: (5.2, 6.2),
    ),
    Plate(
        "closed_loop",
        "Closed loop, predicted",
        draw_closed_loop,
        (_MODEL, _GAINS),
        "A step of the set-point, then one of the load at the process input, on the identified "
        "model and on some of those within its uncertainty; dashed: with the gains before, where "
        "they are known. Good: one small overshoot and a quick return, on all of them. Bad: "
        "ringing, or a load error that lasts long.",
        lambda _: (4.6, 5.0),
    ),
    Plate(
        "rules",
        "The other rules",
        draw_rules,
        (_MODEL, _GAINS, _other_rules),
        "The same two steps with the gains of each other rule (solid), beside the recommended "
        "ones (dashed). IAE is the integral of the absolute error after a unit step of the load.",
        rules_height,
    ),
    Plate(
        "uncertainty",
        "How sure the model is",
        draw_uncertainty,
        (_MODEL, _intervals),
        "95 % intervals as distance from the estimate; within the shaded 20 % a quantity counts "
        "as determined. K_u and w_u decide the gains, and often have narrower intervals than the "
        "parameters. Good: the methods agree on them. Bad: a method that suits the test is far "
        "off. A star is the true value, if the process was simulated.",
        uncertainty_height,
    ),
)


# Rows of the picture, and the height of each [in].
_ROWS = ((("experiment",), 4.2), (("fit",), 3.8), (("nyquist", "closed_loop"), 4.8))


def draw_picture(case: Case, path: Path, *, title: str) -> None:
    """Draw experiment, fit, Nyquist and closed loop into one picture.

    If a figure is missing, the reason stands in its place.

    :param case: the experiment.
    :param path: the picture; its ending says the format (.png, .svg, .pdf).
    :param title: title of the picture.
    """
    plates = {plate.key: plate for plate in PLATES}
    figure = new_figure(WIDE, sum(height for _, height in _ROWS) + 0.4)
    figure.suptitle(_plain(title), x=0.01, ha="left", fontsize=13, weight="bold", color=INK)
    heights = [height for _, height in _ROWS]
    rows = figure.subfigures(len(_ROWS), 1, squeeze=False, height_ratios=heights)[:, 0]
    for row, (keys, _) in zip(rows, _ROWS, strict=True):
        row.set_facecolor("none")
        ratios = (1.0, 1.25)[: len(keys)]
        parts = row.subfigures(1, len(keys), squeeze=False, width_ratios=ratios)[0]
        for part, key in zip(parts, keys, strict=True):
            part.set_facecolor("none")
            missing = plates[key].missing(case)
            if missing:
                text = _plain(f"{plates[key].title}: {missing}")
                part.text(0.02, 0.5, text, color=MUTED, fontsize=10, wrap=True)
            else:
                plates[key].draw(case, part, narrow=len(keys) > 1)
    put_units(figure, case.units)
    save(figure, str(path))


def _plain(text: str) -> str:
    # matplotlib takes text between two dollar signs for a formula.
    return visible(text).replace("$", r"\$")
