# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Results in Python: an analysis as it is shown, models as systems of python-control."""

from __future__ import annotations

import html
import importlib
import math
from typing import TYPE_CHECKING, Any

from relay_autotune.errors import MissingPackageError, ModelError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import NORMAL_95
from relay_autotune.text import digits, plus_minus, process_mathml, process_text

if TYPE_CHECKING:
    from relay_autotune.analysis import Analysis
    from relay_autotune.identification.result import Identification
    from relay_autotune.loop.gains import Controller, Gains


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


PADE_ORDER = 5


def to_control(system: TransferFunction | Controller, *, pade_order: int = PADE_ORDER) -> Any:
    """Return a model, or a controller from error to command, as `control.TransferFunction`.

    >>> from relay_autotune import Controller, TransferFunction, to_control
    >>> loop = to_control(TransferFunction.fopdt(1.65, 20.0, 10.0))
    >>> loop = loop * to_control(Controller(kc=0.6, ti=20.0))
    >>> loop.ninputs, loop.noutputs
    (1, 1)

    A rational function cannot hold a dead time D: it becomes a Pade approximation, all-pass, whose
    phase is that of the dead time up to about ``w = n/D`` rad/s for the order n (within 0.03 rad
    for n = 2, 0.003 rad for n = 5). A controller's set-point weight has no place in it.

    :param system: a process, or a controller such as the gains of a rule.
    :param pade_order: n >= 1, the number of poles that the dead time adds.
    :raises ModelError: if the order is less than 1.
    :raises MissingPackageError: if python-control is not installed.
    """
    if pade_order < 1:
        raise ModelError(f"pade_order must be at least 1, found {pade_order}")
    try:
        control = importlib.import_module("control")
    except ImportError as error:
        raise MissingPackageError(
            f"python-control is needed for to_control and cannot be loaded ({error}); "
            "install it with `pip install control`"
        ) from error
    model = system if isinstance(system, TransferFunction) else system.transfer_function()
    rational = control.TransferFunction(list(model.numerator), list(model.denominator))
    if model.dead_time == 0.0:
        return rational
    return rational * control.TransferFunction(*control.pade(model.dead_time, pade_order))
