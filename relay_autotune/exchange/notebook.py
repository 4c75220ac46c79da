# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a notebook shows of an analysis that stands at the end of a cell."""

from __future__ import annotations

import html
import math
from typing import TYPE_CHECKING

from relay_autotune.confidence import NORMAL_95
from relay_autotune.text import digits, process_mathml

if TYPE_CHECKING:
    from relay_autotune.analysis import Analysis
    from relay_autotune.identification import Identification
    from relay_autotune.loop.gains import Gains


def analysis_html(analysis: Analysis) -> str:
    """Return model and gains as a table.

    :param analysis: of a record; what a record says, such as a reason, is escaped.
    """
    rows = []
    if analysis.model is not None:
        rows += _model_rows(analysis.model)
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


def _model_rows(found: Identification) -> list[tuple[str, str]]:
    name = html.escape(f"{found.structure}, {found.method}")
    rows = [("process", f"{process_mathml(found.model)} {name}")]
    for title, value, std, unit in (
        ("K_u", found.ultimate_gain, found.ultimate_gain_std, "u/y"),
        ("w_u", found.ultimate_frequency, found.ultimate_frequency_std, "rad/s"),
    ):
        if math.isfinite(value):
            interval = f" ± {digits(NORMAL_95 * std, 2)}" if math.isfinite(std) else ""
            rows.append((title, f"{digits(value)}{interval} {unit}"))
    rows += [("warning", html.escape(text)) for text in found.warnings]
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
