"""Figures of an experiment: what was measured, what the model says, what the gains will do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from relay_autotune.record import FloatArray, Record, RelaySettings
from relay_autotune.tuning.closed_loop import simulate_closed_loop

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from relay_autotune.autotune import Analysis
    from relay_autotune.identification import Identification
    from relay_autotune.models import TransferFunction
    from relay_autotune.tuning import Gains

# Okabe and Ito's colours, which people of any colour vision can tell apart.
_BLACK, _ORANGE, _BLUE, _GREEN, _PURPLE = "#222222", "#E69F00", "#0072B2", "#009E73", "#CC79A7"
_GREY = "#8a8a8a"


def draw(analysis: Analysis, path: Path, *, title: str) -> None:
    """Draw an experiment, the fit over it and the closed loop that its gains will make.

    :param analysis: with a model; the closed loop is drawn where there are gains.
    :param path: the picture; its ending says the format (.png, .svg, .pdf).
    :param title: what it is about.
    """
    # Imported here, since loading matplotlib takes longer than a whole replay.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    model, gains = analysis.model, analysis.best_gains
    figure = Figure(figsize=(11.0, 11.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, weight="bold")
    grid = figure.add_gridspec(4, 2, height_ratios=(3.0, 1.3, 1.3, 2.6))
    whole = figure.add_subplot(grid[0, :])
    command = figure.add_subplot(grid[1, :], sharex=whole)
    residual = figure.add_subplot(grid[2, :], sharex=whole)
    _experiment(whole, analysis.record, model)
    _command(command, analysis.record)
    _residual(residual, analysis.record, model)
    residual.set_xlabel("time [s]")
    whole.tick_params(labelbottom=False)
    command.tick_params(labelbottom=False)
    loop_y, loop_u = figure.add_subplot(grid[3, 0]), figure.add_subplot(grid[3, 1])
    if model is not None and gains is not None:
        _closed_loop(loop_y, loop_u, model.model, gains)
    else:
        for axes in (loop_y, loop_u):
            axes.set_axis_off()
        loop_y.text(0.0, 0.5, analysis.reason or "no gains", wrap=True, transform=loop_y.transAxes)
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
    figure.savefig(path, dpi=110)


def _experiment(axes: Axes, record: Record, model: Identification | None) -> None:
    settings = record.settings
    if settings is not None:
        band = (settings.setpoint - settings.hysteresis, settings.setpoint + settings.hysteresis)
        axes.axhspan(*band, color=_GREY, alpha=0.25, lw=0, label="hysteresis band")
        axes.axhline(settings.setpoint, color=_GREY, lw=0.9, ls="--", label="set-point")
    axes.plot(record.time, record.measurement, ".", ms=2.5, color=_BLACK, label="measurement")
    if model is not None and model.fitted.size == len(record):
        axes.plot(record.time, model.fitted, color=_ORANGE, lw=1.4, label="model")
    if settings is not None:
        at = _switches(record, settings)
        values = np.interp(at, record.time, record.measurement)
        axes.plot(at, values, "o", ms=5, mfc="none", color=_BLUE, label="switch")
    axes.set_ylabel("measurement [y]")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, fontsize=9, frameon=False)


def _switches(record: Record, settings: RelaySettings) -> FloatArray:
    """Return the times at which the relay changed from one level to the other."""
    relay = (record.command == settings.high) | (record.command == settings.low)
    changed = np.flatnonzero((np.diff(record.command) != 0.0) & relay[1:]) + 1
    return np.asarray(record.time[changed])


def _command(axes: Axes, record: Record) -> None:
    u = record.input()
    inside = (u.times > record.time[0]) & (u.times < record.time[-1])
    time = np.concatenate((record.time[:1], u.times[inside], record.time[-1:]))
    axes.step(time, u(time), where="post", color=_BLUE, lw=1.3)
    axes.set_ylabel("command [u]")
    axes.margins(y=0.15)


def _residual(axes: Axes, record: Record, model: Identification | None) -> None:
    if model is None or model.fitted.size != len(record):
        axes.set_ylabel("residual [y]")
        return
    error = record.measurement - model.fitted
    noise = model.fit.noise_std
    if np.isfinite(noise) and noise > 0.0:
        axes.axhspan(-2.0 * noise, 2.0 * noise, color=_GREEN, alpha=0.18, lw=0)
        axes.text(
            0.995, 0.93, "band: ±2 noise std, measured before the test", color=_GREEN, fontsize=9,
            ha="right", va="top", transform=axes.transAxes,
        )  # fmt: skip
    axes.plot(record.time, error, ".", ms=2.5, color=_BLACK)
    axes.axhline(0.0, color=_GREY, lw=0.8)
    axes.set_ylabel("residual [y]")


def _closed_loop(y_axes: Axes, u_axes: Axes, model: TransferFunction, gains: Gains) -> None:
    scale = max(model.dead_time, 0.05 * gains.ti, 1e-9)
    half = 12.0 * scale + 3.0 * gains.ti
    # A load that would move the measurement by as much as the set-point step does.
    load = -0.5 / abs(model.gain) if model.is_stable else -0.2 * abs(gains.kc)
    run = simulate_closed_loop(
        gains,
        model,
        period=scale / 25.0,
        duration=2.0 * half,
        setpoint=1.0,
        load=load,
        load_time=half,
    )
    y_axes.axhline(1.0, color=_GREY, lw=0.9, ls="--", label="set-point")
    y_axes.axvline(half, color=_GREY, lw=0.8, ls=":")
    y_axes.plot(run.time, run.measurement, color=_ORANGE, lw=1.6, label="measurement")
    y_axes.annotate(
        "load step", (half, 0.03), (4, 0), textcoords="offset points", fontsize=9, color=_GREY
    )
    y_axes.set(ylabel="deviation [y]", xlabel="time [s]")
    y_axes.set_title(
        f"Closed loop, predicted: kc {gains.kc:.4g} u/y, ti {gains.ti:.4g} s", fontsize=10,
        loc="left",
    )  # fmt: skip
    y_axes.legend(loc="lower right", fontsize=9)
    u_axes.step(run.time, run.command, where="post", color=_BLUE, lw=1.4)
    u_axes.axvline(half, color=_GREY, lw=0.8, ls=":")
    u_axes.set(ylabel="deviation of the command [u]", xlabel="time [s]")
    u_axes.set_title(
        f"Ms {gains.ms:.2f} (95 %: {gains.ms_95:.2f}), {gains.rule}", fontsize=10, loc="left"
    )
