# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The figures of a report: what each shows, when it can be drawn, how it is to be read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from relay_autotune.report.case import Case
from relay_autotune.report.experiment import draw_experiment, draw_fit, draw_phase_plane
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
from relay_autotune.report.style import INK, MUTED, NARROW, SQUARE, WIDE, new_figure, save
from relay_autotune.text import visible

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_NO_SAMPLES = "it needs the samples, which a result without its recording does not have"
_FEWEST = 20
_NO_MODEL = "nothing was identified"
_NO_GAINS = "there are no gains"


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
    :param missing: why a case has no such figure; empty: it has one.
    :param reading: how it is to be read, what is good and what is bad.
    :param wide: True if it fills the page, False if two stand side by side.
    :param without_relay: how it is to be read where no relay acted; empty: the same way.
    :param height: of a case's figure on a broad page and on a narrow one [in].
    """

    key: str
    title: str
    draw: Draw
    missing: Callable[[Case], str]
    reading: str
    height: Callable[[Case], tuple[float, float]]
    wide: bool = True
    without_relay: str = ""

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
        return figure


def _without_samples(case: Case) -> str:
    return "" if case.record is not None else _NO_SAMPLES


def _without_fit(case: Case) -> str:
    if case.record is None:
        return _NO_SAMPLES
    if case.model is None:
        return _NO_MODEL
    if case.model.found.fitted.size != len(case.record):
        return f"the method {case.model.found.method} does not fit the samples themselves"
    return ""


def _without_cycles(case: Case) -> str:
    if case.record is None:
        return _NO_SAMPLES
    if not case.cycles or case.limit_cycle is None:
        return "the record has no whole cycle"
    return "" if len(case.record) >= _FEWEST else "the record has too few samples"


def _without_gains(case: Case) -> str:
    if case.model is None:
        return _NO_MODEL
    return "" if case.best_gains is not None else _NO_GAINS


def _without_other_rules(case: Case) -> str:
    missing = _without_gains(case)
    if missing:
        return missing
    return "" if len(distinct_gains(case)) > 1 else "no other rule gives other gains"


def _without_model(case: Case) -> str:
    return "" if case.model is not None else _NO_MODEL


def _without_intervals(case: Case) -> str:
    if case.model is None:
        return _NO_MODEL
    known = any(np.isfinite(e.low) for e in (*case.model.estimates, *case.model.ultimate))
    return "" if known else f"the method {case.model.found.method} gives no uncertainty"


PLATES = (
    Plate(
        "experiment",
        "The experiment",
        draw_experiment,
        _without_samples,
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
        _without_fit,
        "Above: the model over the measurement. Below: the residual. Good: the residual is as "
        "wide as the band and has no pattern. Bad: it repeats with each cycle (the structure is "
        "too simple), or it drifts (a disturbance acted during the test).",
        lambda _: (4.9, 5.6),
    ),
    Plate(
        "phase_plane",
        "Limit cycle in the phase plane",
        draw_phase_plane,
        _without_cycles,
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
        _without_gains,
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
        _without_model,
        "The process alone. The diamonds come from Fourier integrals over whole cycles and need "
        "no model. Good: they lie on the curve. Bad: they leave the band, above all near the "
        "ultimate point.",
        lambda _: (5.2, 6.2),
    ),
    Plate(
        "closed_loop",
        "Closed loop, predicted",
        draw_closed_loop,
        _without_gains,
        "A step of the set-point, then one of the load at the process input, on the identified "
        "model and on some of those within its uncertainty. Good: one small overshoot and a quick "
        "return, on all of them. Bad: ringing, or a load error that lasts long.",
        lambda _: (4.6, 5.0),
    ),
    Plate(
        "rules",
        "The other rules",
        draw_rules,
        _without_other_rules,
        "The same two steps with the gains of each other rule (solid), beside the recommended "
        "ones (dashed). IAE is the integral of the absolute error after a unit step of the load.",
        rules_height,
    ),
    Plate(
        "uncertainty",
        "How sure the model is",
        draw_uncertainty,
        _without_intervals,
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
    save(figure, str(path))


def _plain(text: str) -> str:
    # matplotlib takes text between two dollar signs for a formula.
    return visible(text).replace("$", r"\$")
