# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The report as one self-contained HTML page."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

import relay_autotune
from relay_autotune.loop.analysis import difference
from relay_autotune.process.transfer_function import process_mathml, process_text
from relay_autotune.report.case import Case, ultimate_of
from relay_autotune.report.figures import PLATES, Plate
from relay_autotune.report.findings import (
    checks_of,
    compared,
    doubts_of,
    facts_of,
    numbers_of,
    remarks_of,
    repeats_of,
    steps_of,
    verdict_of,
    warnings_of,
)
from relay_autotune.report.style import COLOURS, inline
from relay_autotune.text import digits, in_units, percent, plus_minus, visible

# Colours of the page in dark mode; those of the figures come from COLOURS.
_NIGHT = (
    "--page: #101318; --card: #171b21; --line: #2c343d; --text: #e8ebee; --soft: #9fabb7; "
    "--accent: #6db8ea; --accent-soft: #1b2f3d; --good: #5fd6ae; --good-soft: #15322a; "
    "--warn: #f0b45a; --warn-soft: #3a2a12; --bad: #ff9b85; --bad-soft: #3d1e18; "
    "--shadow: none; color-scheme: dark;"
)


def page(cases: Sequence[Case], *, title: str = "") -> str:
    """Return the report of some experiments as an HTML page.

    The same cases give the same bytes. All text from a recording is escaped.

    :param cases: at least one.
    :param title: of the page; default: the first case's source.
    """
    template = _environment().get_template("report.html")
    return template.render(
        title=visible(title or cases[0].source),
        cases=cases,
        version=relay_autotune.__version__,
        **_colours(),
    )


def style_sheet() -> str:
    """Return the report's style sheet, for pages that look like it."""
    return _environment().get_template("report.css").render(**_colours())


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("relay_autotune.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "digits": digits,
        "degrees": math.degrees,
        "signed": lambda value: f"{value:+.2f}",
        "percent": percent,
        "known": math.isfinite,
        "plus_minus": plus_minus,
        "process_text": process_text,
        "in_units": lambda text, units: Markup(in_units(text, units)),
        "mathml": lambda model: Markup(process_mathml(model)),
    }
    # What the page shows of a case, each by the function that finds it.
    shown = (
        *(name_of, verdict_of, facts_of, steps_of, compared, difference, warnings_of),
        *(checks_of, numbers_of, remarks_of, doubts_of, repeats_of, ultimate_of),
        *(plates_of, drawn),
    )
    environment.globals |= {function.__name__: function for function in shown}
    return environment


def _colours() -> dict[str, Markup]:
    return {"light": Markup(_variables(0)), "night": Markup(f"{_variables(1)} {_NIGHT}")}


def _variables(column: int) -> str:
    return " ".join(f"--{name}: {both[column]};" for name, both in COLOURS.items())


# Parts of the page that its template asks for.


def name_of(case: Case) -> str:
    """Return the heading of an experiment, with its id where its source does not hold that."""
    known = not case.experiment_id or case.experiment_id in case.source
    return case.source if known else f"{case.source}, {case.experiment_id}"


def plates_of(case: Case) -> tuple[list[Plate], list[str]]:
    """Return the figures of a case, and why it has no others."""
    missing = [(plate, plate.missing(case)) for plate in PLATES]
    left_out = [f"{plate.title}: {why}" for plate, why in missing if why]
    return [plate for plate, why in missing if not why], left_out


def drawn(plate: Plate, case: Case, prefix: str, *, narrow: bool = False) -> Markup:
    """Return a figure as SVG.

    :param plate: one for which the case has all.
    :param case: the experiment.
    :param prefix: of the ids in it.
    :param narrow: True if it is for a narrow screen.
    """
    label = html.escape(f"{plate.title}. {plate.reading_of(case)}")
    return Markup(inline(plate.figure(case, narrow=narrow), prefix, label))
