# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Figures of the samples: the experiment, the fit over it, the limit cycle in the phase plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.result import Identification
from relay_autotune.record.record import Record, RelaySettings
from relay_autotune.report.case import Case
from relay_autotune.report.style import (
    BLUE,
    GREEN,
    GRID,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    PURPLE,
    VERMILLION,
    finish,
    in_steps,
    legend,
    thinned,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_FEW = 400
_NUMBERED = 15
_ROUNDING = 1e-6
_WINDOW = 12


@dataclass(frozen=True)
class Switches:
    """What the relay did with its command.

    :param kicks: instants at which it left the baseline for one of its levels [s].
    :param switches: instants at which it went from one level to the other [s].
    :param released: instants at which it went back to the baseline [s].
    """

    kicks: FloatArray
    switches: FloatArray
    released: FloatArray


def switches_of(record: Record, settings: RelaySettings) -> Switches:
    """Return the kicks, switches and releases of a relay from its commands.

    :param record: the experiment.
    :param settings: of its relay.
    """
    tolerance = 1e-9 * settings.amplitude
    high = np.abs(record.command - settings.high) <= tolerance
    low = np.abs(record.command - settings.low) <= tolerance
    level = high.astype(int) - low.astype(int)
    before, after, time = level[:-1], level[1:], record.time[1:]
    return Switches(
        kicks=time[(before == 0) & (after != 0)],
        switches=time[before * after == -1],
        released=time[(before != 0) & (after == 0)],
    )


def draw_experiment(case: Case, figure: Figure | SubFigure, *, narrow: bool) -> None:
    """Draw measurement and command of a whole experiment.

    :param case: with a record.
    :param figure: empty, to be drawn into.
    :param narrow: True if it is for a narrow screen.
    """
    assert case.record is not None
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1.0))
    record, settings = case.record, case.settings
    if settings is not None:
        if settings.hysteresis > 0.0:
            above.axhspan(*_band(settings), color=GREEN, alpha=0.16, lw=0, label="hysteresis band")
        above.axhline(settings.setpoint, color=GREEN, lw=1.0, ls=(0, (5, 3)), label="set-point")
    _shade_cycles(above, case)
    _samples(above, record)
    if settings is not None:
        _mark(above, record, switches_of(record, settings))
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
    finish(figure)


def _band(settings: RelaySettings) -> tuple[float, float]:
    return settings.setpoint - settings.hysteresis, settings.setpoint + settings.hysteresis


def _samples(axes: Axes, record: Record) -> None:
    time, values = thinned(record.time, record.measurement)
    marker = "." if len(record) <= _FEW else ""
    axes.plot(time, values, color=INK, lw=0.8, marker=marker, ms=3.5, label="measurement")


def _shade_cycles(axes: Axes, case: Case) -> None:
    averaged = case.limit_cycle.cycles if case.limit_cycle is not None else ()
    named = False
    for cycle in case.cycles:
        end = cycle.start + cycle.period
        if cycle.disturbed:
            axes.axvspan(
                cycle.start, end, facecolor="none", edgecolor=PURPLE, hatch="///", lw=0.0,
                alpha=0.6, label=None if named else "disturbed cycle",
            )  # fmt: skip
            named = True
        if len(case.cycles) <= _NUMBERED:
            axes.axvline(cycle.start, color=GRID, lw=1.2, zorder=0.5)
            axes.axvline(end, color=GRID, lw=1.2, zorder=0.5)
            axes.annotate(
                f"{cycle.index + 1}", (cycle.start + 0.5 * cycle.period, 0.0), (0, 4),
                xycoords=("data", "axes fraction"), textcoords="offset points", ha="center",
                fontsize=9, color=MUTED, weight="bold" if cycle.index in averaged else "normal",
            )  # fmt: skip


def _mark(axes: Axes, record: Record, at: Switches) -> None:
    for times, marker, colour, label in (
        (at.kicks, "D", ORANGE, "kick"),
        (at.switches, "o", BLUE, "switch"),
        (at.released, "s", PURPLE, "back to the baseline"),
    ):
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
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.3))
    record, model = case.record, case.model.found
    _samples(above, record)
    above.plot(
        *thinned(record.time, model.fitted), color=VERMILLION, lw=1.7, ls=(0, (4, 1.2)),
        label="model",
    )  # fmt: skip
    above.set_ylabel("measurement [y]")
    _residual(below, record, model)
    below.set_xlabel("time [s]")
    above.margins(x=0.01)
    legend(figure, columns=2 if narrow else 7)
    finish(figure)


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
    least = _ROUNDING * float(np.ptp(record.measurement))
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
    axes = figure.subplots()
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
    if case.model is not None and case.model.found.fitted.size == len(record):
        time, fitted, slope = rate_of(record, case.model.found.fitted, cycle.period)
        last = (time >= end - cycle.period) & (time <= end)
        axes.plot(
            fitted[last], slope[last], color=VERMILLION, lw=1.7, ls=(0, (4, 1.5)), label="model"
        )
    axes.set(xlabel="measurement [y]", ylabel="rate of the measurement [y/s]")
    axes.margins(0.06)
    legend(figure, columns=2 if narrow else 3)
    finish(figure)


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
