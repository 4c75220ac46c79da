# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""An analysis as an interpreter or a notebook shows it."""

from __future__ import annotations

import html
import math
from typing import TYPE_CHECKING

from relay_autotune.quantities import NORMAL_95
from relay_autotune.text import digits, plus_minus, process_mathml, process_text

if TYPE_CHECKING:
    from relay_autotune.analysis import Analysis
    from relay_autotune.identification.result import Identification
    from relay_autotune.loop.gains import Gains


def analysis_text(analysis: Analysis) -> str:
    """Return model, verdict and gains on ten lines at most.

    :param analysis: of a record.
    """
    rows: list[tuple[str, str]] = []
    found = analysis.model
    if found is not None:
        name = f"{found.structure}, {found.method}"
        rows += [("process", f"{process_text(found.model)}   ({name})"), *_accuracy(found)]
        if found.warnings:
            rows.append(("warnings", f"{len(found.warnings)}, in .model.warnings"))
    if analysis.judgement.judged:
        rows.append(("verdict", analysis.verdict.name.lower()))
    if analysis.best_gains is not None:
        rows += [row for row in _gains_rows(analysis.best_gains) if row[0] != "parallel form"]
    if analysis.reason:
        rows.append(("reason", analysis.reason))
    lines = [f"  {label:<9} {text}" for label, text in rows]
    return "\n".join([f"<Analysis of {analysis.record!r}", *lines]) + ">"


def analysis_html(analysis: Analysis) -> str:
    """Return model and gains as a table.

    :param analysis: of a record; what a record says, such as a reason, is escaped.
    """
    rows = []
    found = analysis.model
    if found is not None:
        name = html.escape(f"{found.structure}, {found.method}")
        rows += [("process", f"{process_mathml(found.model)} {name}"), *_accuracy(found)]
        rows += [("warning", html.escape(text)) for text in found.warnings]
    if analysis.best_gains is not None:
        rows += _gains_rows(analysis.best_gains)
    if analysis.reason:
        rows.append(("reason", html.escape(analysis.reason)))
    cells = "".join(
        f'<tr><th style="text-align: left">{name}</th>'
        f'<td style="text-align: left">{value}</td></tr>'
        for name, value in rows
    )
    return f"<table>{cells}</table>"


def _accuracy(found: Identification) -> list[tuple[str, str]]:
    """Return K_u and w_u with half the widths of their 95 % intervals."""
    rows = []
    for title, value, std, unit in (
        ("K_u", found.ultimate_gain, found.ultimate_gain_std, "u/y"),
        ("w_u", found.ultimate_frequency, found.ultimate_frequency_std, "rad/s"),
    ):
        if math.isfinite(value):
            interval = plus_minus(value, NORMAL_95 * std)
            rows.append((title, f"{digits(value)} {unit} {interval}".rstrip()))
    return rows


def _gains_rows(gains: Gains) -> list[tuple[str, str]]:
    return [
        ("rule", html.escape(gains.rule)),
        (
            "ISA form",
            f"kc {digits(gains.kc)} u/y, ti {digits(gains.ti)} s, td {digits(gains.td)} s, "
            f"tf {digits(gains.tf)} s, b {digits(gains.b)}",
        ),
        (
            "parallel form",
            f"p {digits(gains.p)} u/y, i {digits(gains.i)} u/(y s), d {digits(gains.d)} u s/y",
        ),
        ("Ms", f"{digits(gains.ms, 3)}, for 95 % of the models below {digits(gains.ms_95, 3)}"),
    ]
