# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The output of `tune` for people: one rule in full, or all rules side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from relay_autotune.cli.layout import in_columns, labelled
from relay_autotune.errors import TuningError
from relay_autotune.text import digits, process_text
from relay_autotune.tuning.forms import series_form

if TYPE_CHECKING:
    from relay_autotune.tuning import DesignTask, Gains, Performance
    from relay_autotune.tuning.compensators import Compensator

_HEADINGS = ("kc", "ti", "td", "Ms", "Mt", "GM", "PM", "IAE")
_NAMES = {"parallel": ("p", "i", "d"), "isa": _HEADINGS[:3], "series": _HEADINGS[:3]}
_UNITS = {
    "parallel": ("u/y", "u/(y s)", "u s/y"),
    "isa": ("u/y", "s", "s"),
    "series": ("u/y", "s", "s"),
}
_UNITS_JUDGED = ("", "", "", "deg", "y s/u")


def process_lines(task: DesignTask, width: int) -> list[str]:
    """Return the process that is tuned for, and the law, if one was named.

    :param task: what is designed.
    :param width: columns that a line may have.
    """
    model, options = task.model, task.options
    lines = labelled("process", f"{process_text(model)}   ({model.structure})", width)
    if options.law:
        lines += labelled("law", f"{options.law} every {options.sample_period:g} s", width)
    return [*lines, ""]


def further_forms(gains: Gains, form: str) -> list[tuple[str, str]]:
    """Return gains in the form asked for, in addition to the forms that are always shown.

    :param gains: the gains.
    :param form: "isa", "parallel" or "series".
    :return: name and numbers.
    :raises TuningError: if they have no series form.
    """
    if form != "series":
        return []
    series = series_form(gains)
    numbers = (
        f"kc {digits(series.kc)} u/y   ti {digits(series.ti)} s   "
        f"td {digits(series.td)} s   alpha {digits(series.alpha, 3)}"
    )
    return [("series form", numbers)]


def side_by_side(
    gains: Sequence[Gains],
    recommended: int | None,
    form: str,
    inside: Sequence[tuple[Compensator, Performance]],
    width: int,
) -> list[str]:
    """Return a line for every rule that applies, and one for each controller with a model inside.

    :param gains: of the rules that apply.
    :param recommended: index of the recommended gains; None: there are none.
    :param form: in which they are shown.
    :param inside: each compensator with what it does on the model.
    :param width: columns that a line may have.
    """
    rows: list[tuple[str, ...]] = []
    if gains:
        rows.append(("", *_NAMES[form], *_HEADINGS[3:]))
        for k, each in enumerate(gains):
            mark = "* " if k == recommended else "  "
            rows.append((mark + each.rule, *_in_form(each, form), *_judged(each)))
        rows.append(("", *_UNITS[form], *_UNITS_JUDGED))
    if inside:
        rows.append(("",) * 9)
        rows.append(("with a model inside", *("",) * 8))
        rows.append(("", "lambda", "DM", "", *_HEADINGS[3:]))
        for compensator, found in inside:
            numbers = digits(compensator.closed_loop_time), digits(found.delay_margin, 3), ""
            rows.append((f"  {compensator.name}", *numbers, *_judged(found)))
        rows.append(("", "s", "s", "", *_UNITS_JUDGED))
    return in_columns(rows, width)


def refusal_lines(refused: Mapping[str, str], width: int) -> list[str]:
    """Return why rules give no gains.

    :param refused: by name, why a rule gives none.
    :param width: columns that a line may have.
    """
    if not refused:
        return []
    indent = max(map(len, refused)) + 6
    told = [labelled(f"  {name}", why, width, indent=indent) for name, why in refused.items()]
    return ["", "  no gains by", *(line for lines in told for line in lines)]


def _judged(found: Gains | Performance) -> tuple[str, ...]:
    return (
        *(digits(x, 3) for x in (found.ms, found.mt, found.gain_margin)),
        digits(math.degrees(found.phase_margin), 3),
        digits(found.iae_load, 3),
    )


def _in_form(gains: Gains, form: str) -> tuple[str, ...]:
    if form == "parallel":
        found = gains.p, gains.i, gains.d
    elif form == "series":
        try:
            series = series_form(gains)
        except TuningError:
            return "no", "series", "form"
        found = series.kc, series.ti, series.td
    else:
        found = gains.kc, gains.ti, gains.td
    return tuple(digits(x) for x in found)
