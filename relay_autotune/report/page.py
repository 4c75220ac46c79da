# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The report as one self-contained HTML page."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

import relay_autotune
from relay_autotune.process.transfer_function import process_mathml, process_text
from relay_autotune.report.case import Case, ultimate_of
from relay_autotune.report.figures import PLATES, Plate
from relay_autotune.report.findings import (
    Chip,
    beside_present,
    change_of,
    checks_of,
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


@dataclass(frozen=True)
class _Drawn:
    """A figure in the page.

    :param anchor: id of its place.
    :param title: what it shows.
    :param reading: how it is to be read.
    :param wide: True if it fills the page.
    :param alone: True if nothing stands beside it.
    :param broad: the SVG for broad screens and paper.
    :param slim: the SVG for narrow screens; empty: the same.
    """

    anchor: str
    title: str
    reading: str
    wide: bool
    alone: bool
    broad: Markup
    slim: Markup


@dataclass(frozen=True)
class _Section:
    """The section of the page about one experiment."""

    case: Case
    name: str
    verdict: Chip
    facts: tuple[str, ...]
    plates: tuple[_Drawn, ...]
    left_out: tuple[str, ...]


def page(cases: Sequence[Case], *, title: str = "") -> str:
    """Return the report of some experiments as an HTML page.

    The same cases give the same bytes. All text from a recording is escaped.

    :param cases: at least one.
    :param title: of the page; default: the first case's source.
    """
    environment = _environment()
    sections = [_section(case, k, len(cases) > 1) for k, case in enumerate(cases, start=1)]
    return environment.get_template("report.html").render(
        title=visible(title or cases[0].source),
        sections=sections,
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
    # What the page says of a case, each by the function that finds the words.
    said = (
        *(steps_of, beside_present, change_of, warnings_of, checks_of, numbers_of),
        *(remarks_of, doubts_of, repeats_of, ultimate_of),
    )
    environment.globals |= {function.__name__: function for function in said}
    return environment


def _colours() -> dict[str, Markup]:
    return {"light": Markup(_variables(0)), "night": Markup(f"{_variables(1)} {_NIGHT}")}


def _variables(column: int) -> str:
    return " ".join(f"--{name}: {both[column]};" for name, both in COLOURS.items())


def _section(case: Case, number: int, many: bool) -> _Section:
    present = [plate for plate in PLATES if not plate.missing(case)]
    alone = sum(not plate.wide for plate in present) == 1
    known = not case.experiment_id or case.experiment_id in case.source
    name = case.source if known else f"{case.source}, {case.experiment_id}"
    return _Section(
        case=case,
        name=name,
        verdict=verdict_of(case),
        facts=facts_of(case, with_id=not many and not known),
        plates=tuple(_drawn(p, case, f"e{number}", alone=alone) for p in present),
        left_out=tuple(f"{p.title}: {why}" for p in PLATES if (why := p.missing(case))),
    )


def _drawn(plate: Plate, case: Case, prefix: str, *, alone: bool) -> _Drawn:
    anchor = f"{prefix}-{plate.key}"
    reading = plate.reading_of(case)

    def svg(*, narrow: bool) -> Markup:
        label = html.escape(f"{plate.title}. {reading}")
        ids = f"{anchor}-{'narrow' if narrow else 'broad'}"
        return Markup(inline(plate.figure(case, narrow=narrow), ids, label))

    only = alone and not plate.wide
    return _Drawn(
        anchor, plate.title, reading, plate.wide, only, svg(narrow=False), svg(narrow=True)
    )
