# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The look of figures, and how a figure becomes a file or a part of a page.

The colours are those of Okabe and Ito, which people of any colour vision can distinguish; lines
differ in dashes as well. In a page each colour is a CSS variable, so that dark mode needs no
second figure.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.text import in_units

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure, SubFigure

# Name of the CSS variable, colour on white, colour on black. All colours differ, since each colour
# in a figure is replaced by its variable.
COLOURS = {
    "ink": ("#20262d", "#e7eaee"),
    "muted": ("#68727d", "#9aa5b1"),
    "grid": ("#dfe3e8", "#333b45"),
    "paper": ("#fefefe", "#171b21"),
    "blue": ("#0072b2", "#4fa8e0"),
    "vermillion": ("#d55e00", "#ff8a45"),
    "green": ("#009e73", "#2fc99b"),
    "orange": ("#e69f00", "#f2b632"),
    "purple": ("#cc79a7", "#e59cc3"),
    "sky": ("#56b4e9", "#93d4f7"),
}
INK, MUTED, GRID, PAPER, BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY = (
    light for light, _ in COLOURS.values()
)
_VARIABLES = {light: f"var(--{name})" for name, (light, _) in COLOURS.items()}

WIDE, NARROW, SQUARE = 11.2, 4.5, 5.4
_DPI = 110
_RC = {
    "svg.fonttype": "none",
    "svg.hashsalt": "relay_autotune",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif"
_BUCKETS = 700


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure.

    :param width: in.
    :param height: in.
    """
    # Imported here, since loading matplotlib takes longer than a whole replay.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="none")
    FigureCanvasAgg(figure)
    return figure


def panels(figure: Figure | SubFigure, rows: int, columns: int, **how: Any) -> Any:
    """Return the axes of an empty figure, each with the common look.

    :param figure: the figure.
    :param rows: of axes.
    :param columns: of axes.
    :param how: as for `subplots` of matplotlib.
    :return: shape (rows, columns), without an axis of length one unless ``squeeze`` is False.
    """
    made = figure.subplots(rows, columns, **how)
    for axes in figure.axes:
        axes.set_facecolor("none")
        axes.spines[["top", "right"]].set_visible(False)
        for spine in axes.spines.values():
            spine.set_color(MUTED)
            spine.set_linewidth(0.8)
        axes.grid(color=GRID, linewidth=0.7)
        axes.set_axisbelow(True)
        axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=9, length=3)
        axes.tick_params(which="minor", length=0)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_color(INK)
            label.set_fontsize(9.5)
    return made


def put_units(figure: Figure, units: Mapping[str, str]) -> None:
    """Put the units of a loop into the labels of a figure.

    :param figure: with all that is to be drawn.
    :param units: of the measurement, by "y", and of the command, by "u", as far as known.
    """
    if units:
        for text in figure.findobj(lambda each: hasattr(each, "set_text")):
            text.set_text(in_units(text.get_text(), units))  # type: ignore[attr-defined]


def legend(figure: Figure | SubFigure, *, columns: int) -> None:
    """Put one legend above all axes of a figure, where it hides nothing.

    :param figure: whose axes have labelled artists; those of one label are one entry.
    :param columns: entries a row.
    """
    handles: list[Artist] = []
    labels: list[str] = []
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if label not in labels:
                handles.append(handle)
                labels.append(label)
    if handles:
        figure.legend(
            handles, labels, loc="outside upper left", ncols=columns, fontsize=9, labelcolor=INK,
            frameon=False, borderaxespad=0.0, handlelength=2.2, columnspacing=1.4,
        )  # fmt: skip


def thinned(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a signal with fewer points that looks the same: the extremes of each stretch.

    :param time: s, shape (n,).
    :param values: shape (n,); NaN: no value.
    """
    n = time.size
    if n <= 4 * _BUCKETS:
        return time, values
    edges = np.linspace(0, n, _BUCKETS + 1).astype(int)
    kept = {0, n - 1}
    for first, last in pairwise(edges):
        part = values[first:last]
        if np.all(np.isnan(part)):
            kept.add(int(first))
            continue
        kept |= {int(first + np.nanargmin(part)), int(first + np.nanargmax(part))}
    index = np.array(sorted(kept))
    return time[index], values[index]


def in_steps(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a held signal.

    :param times: instants from which the values hold [s], shape (n,); the last one ends it.
    :param values: shape (n,).
    """
    changed = np.append(np.flatnonzero(np.diff(values) != 0.0) + 1, len(values) - 1)
    t = np.concatenate((times[:1], np.repeat(times[changed], 2)))
    v = np.concatenate((values[:1], np.column_stack((values[changed - 1], values[changed])).flat))
    return t, v


def save(figure: Figure, path: str) -> None:
    """Write a figure to a file, the same bytes for the same figure.

    :param figure: the figure.
    :param path: the file, which ends with .png, .svg or .pdf.
    """
    import matplotlib

    kind = path.rpartition(".")[2].lower()
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with matplotlib.rc_context(_RC):
        figure.savefig(path, dpi=_DPI, facecolor="white", metadata=dates.get(kind), format=kind)


def inline(figure: Figure, prefix: str, label: str) -> str:
    """Return a figure as an SVG element that may stand in a page beside others.

    :param figure: the figure.
    :param prefix: put before its ids, different for each figure of the page.
    :param label: what it shows, in words, escaped for an attribute.
    """
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context(_RC):
        figure.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    head, _, body = text.partition(">")
    box = re.search(r'viewBox="([^"]+)"', head)
    if box is None:
        raise ValueError("matplotlib wrote an SVG without a viewBox")
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r"<style[^>]*>.*?</style>", "", body, flags=re.DOTALL)
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    # Text between the tags is kept unchanged.
    body = re.sub(r"<[^>]*>", lambda tag: _adapted(tag[0], prefix), body)
    body = re.sub(r"\n\s*", "\n", body)
    return (
        f'<svg role="img" aria-label="{label}" viewBox="{box[1]}" '
        f'style="font-family: {_FONT}">{body}'
    )


def _adapted(tag: str, prefix: str) -> str:
    """Return a tag with ids of its own, rounded numbers, and variables for fonts and colours."""
    tag = re.sub(r'\bid="', f'id="{prefix}-', tag)
    tag = re.sub(r"url\(#", f"url(#{prefix}-", tag)
    tag = re.sub(r'(?:xlink:)?href="#', f'href="#{prefix}-', tag)
    tag = re.sub(r"-?\d+\.\d{3,}", _shorter, tag)
    tag = re.sub(r"font-family: [^;\"]*", "font-family: inherit", tag)
    tag = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", tag)
    return re.sub("|".join(_VARIABLES), lambda colour: _VARIABLES[colour[0]], tag)


def _shorter(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")
