# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The output of `tune` for people: one rule in full, or all rules side by side."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from relay_autotune.errors import TuningError
from relay_autotune.text import digits, process_text
from relay_autotune.tuning.forms import series_form

if TYPE_CHECKING:
    from relay_autotune.process.transfer_function import TransferFunction
    from relay_autotune.tuning import Gains, Performance
    from relay_autotune.tuning.compensators import Compensator

_WIDTH = 99
_INDENT = 22
_HEADINGS = ("kc", "ti", "td", "Ms", "Mt", "GM", "PM", "IAE")


def process_lines(model: TransferFunction) -> list[str]:
    """Return the process that is tuned for."""
    return [*_wrapped("process", f"{process_text(model)}   ({model.structure})"), ""]


def form_lines(gains: Gains, form: str) -> list[str]:
    """Return gains in the form asked for, in addition to the forms that are always shown.

    :param gains: the gains.
    :param form: "isa", "parallel" or "series".
    :raises TuningError: if they have no series form.
    """
    if form != "series":
        return []
    series = series_form(gains)
    return [
        f"    {'series form':<15}kc {digits(series.kc)} u/y   ti {digits(series.ti)} s   "
        f"td {digits(series.td)} s   alpha {digits(series.alpha, 3)}"
    ]


def side_by_side(gains: Sequence[Gains], recommended: int | None, form: str) -> list[str]:
    """Return a line for every rule that applies.

    :param gains: of the rules that apply.
    :param recommended: index of the recommended gains; None: there are none.
    :param form: in which they are shown.
    """
    headings = {"parallel": ("p", "i", "d"), "isa": _HEADINGS[:3], "series": _HEADINGS[:3]}[form]
    lines = []
    if gains:
        lines.append(_row("", (*headings, *_HEADINGS[3:])))
    for k, each in enumerate(gains):
        try:
            numbers = _in_form(each, form)
        except TuningError:
            numbers = ("no", "series", "form")
        mark = "* " if k == recommended else "  "
        judged = (
            *(digits(x, 3) for x in (each.ms, each.mt, each.gain_margin)),
            digits(math.degrees(each.phase_margin), 3),
            digits(each.iae_load, 3),
        )
        lines.append(_row(mark + each.rule, (*numbers, *judged)))
    if gains:
        units = {
            "parallel": ("u/y", "u/(y s)", "u s/y"),
            "isa": ("u/y", "s", "s"),
            "series": ("u/y", "s", "s"),
        }[form]
        lines.append(_row("", (*units, "", "", "", "deg", "y s/u")))
    return lines


def refusal_lines(refused: Mapping[str, str]) -> list[str]:
    """Return why rules give no gains.

    :param refused: by name, why a rule gives none.
    """
    lines = ["", "  no gains by"] if refused else []
    for name, why in refused.items():
        lines += _wrapped(f"  {name}", why, _INDENT + 4)
    return lines


def compensator_lines(
    inside: Sequence[tuple[Compensator, Performance]],
) -> list[str]:
    """Return the controllers with a model inside, a line for each.

    :param inside: each with what it does on the model.
    """
    if not inside:
        return []
    headings = ("lambda", "DM", "", *_HEADINGS[3:])
    lines = ["", "  with a model inside", _row("", headings)]
    for each, p in inside:
        cells = (
            digits(each.closed_loop_time),
            digits(p.delay_margin, 3),
            "",
            *(digits(x, 3) for x in (p.ms, p.mt, p.gain_margin)),
            digits(math.degrees(p.phase_margin), 3),
            digits(p.iae_load, 3),
        )
        lines.append(_row(f"  {each.name}", cells))
    return [*lines, _row("", ("s", "s", "", "", "", "", "deg", "y s/u"))]


def _in_form(gains: Gains, form: str) -> tuple[str, str, str]:
    if form == "parallel":
        found = gains.p, gains.i, gains.d
    elif form == "series":
        series = series_form(gains)
        found = series.kc, series.ti, series.td
    else:
        found = gains.kc, gains.ti, gains.td
    first, second, third = (digits(x) for x in found)
    return first, second, third


def _row(label: str, cells: Sequence[str]) -> str:
    return (f"  {label:<{_INDENT + 2}}" + "".join(f"{cell:>9}" for cell in cells)).rstrip()


def _wrapped(label: str, text: str, indent: int = 17) -> list[str]:
    parts = textwrap.wrap(text, _WIDTH - indent - 2) or [""]
    return [f"  {label if i == 0 else '':<{indent}}{part}" for i, part in enumerate(parts)]
