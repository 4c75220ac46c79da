# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The report in one picture: experiment, fit, Nyquist and predicted closed loop."""

from __future__ import annotations

from pathlib import Path

from relay_autotune.escape import visible
from relay_autotune.report.case import Case
from relay_autotune.report.figures import PLATES
from relay_autotune.report.style import INK, MUTED, WIDE, new_figure, save

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
