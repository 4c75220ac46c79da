# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The result of an analysis: models, gains and a verdict, and how they are shown in Python.

A judged model keeps all that is needed to design other gains for it.
"""

from __future__ import annotations

import html
import math
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.experiment.early_end import FitProgress
from relay_autotune.identification.judgement.evidence import Evidence, Loop
from relay_autotune.identification.judgement.table import LOOP_CHECKS
from relay_autotune.identification.result import Identification
from relay_autotune.loop.gains import Gains
from relay_autotune.process.transfer_function import process_mathml, process_text
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.cycles import cycles_of
from relay_autotune.record.record import Cycle, Record
from relay_autotune.text import digits, in_units, plus_minus
from relay_autotune.tuning.ensemble import ms_on_each
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune.verdict import NOT_JUDGED, Finding, Judgement, Verdict, judge


@dataclass(frozen=True, eq=False)
class Shaping:
    """A model for which gains may be designed, and how these are judged.

    :param task: the process, the models around it, and what was asked of the first gains.
    :param evidence: the experiment and its model; None: the model was not identified.
    :param findings: of the checks of the model.
    """

    task: DesignTask
    evidence: Evidence | None = None
    findings: tuple[Finding, ...] = ()

    def asking(self, options: DesignOptions) -> Shaping:
        """Return the same with other options; those given decide how gains are judged, too.

        :param options: what is asked of the gains.
        """
        task, others = replace(self.task, options=options), self.task.options
        loops = [(each.law, each.sample_period, each.loop_delay) for each in (options, others)]
        if loops[0] == loops[1]:
            # The models around are those of the same loop, and so are their responses.
            task.__dict__.update(around=self.task.around)
        return replace(self, task=task)

    def judgement(self, gains: Gains) -> Judgement:
        """Return the judgement of an experiment with some gains.

        :param gains: designed for the task, with any set-point weight.
        """
        if self.evidence is None:
            return NOT_JUDGED
        law, around = self.task.law(gains), self.task.around
        loop = Loop(
            controller=gains,
            ms_around=np.empty(0) if around is None else ms_on_each(law, around),
            asked=max(self.task.options.ms, gains.ms),
            pace_asked=not math.isnan(self.task.options.closed_loop_time),
        )
        found = judge(LOOP_CHECKS, replace(self.evidence, loop=loop))
        if slow := self.task.too_slow:
            # No other recording would help.
            found = tuple(replace(f, remedy=f.remedy and slow) for f in found)
        return Judgement((*self.findings, *found))


@dataclass(frozen=True, repr=False, eq=False)
class Analysis:
    """Result of the analysis of one record.

    >>> from relay_autotune import analyse, read_records
    >>> found = analyse(read_records("bags/heater.csv")[0])
    >>> found                                                       # doctest: +ELLIPSIS
    <Analysis of <Record: 450 samples over 898 s, recorded elsewhere>
      process   0.6204 e^(-15.89 s) / (1 + 110.2 s)   (fopdt, waveform)
    ...
      verdict   trusted
    ...
    >>> found.verdict.name, found.best_gains.rule, len(found.gains) > 5
    ('TRUSTED', 'robust', True)

    :param record: the record.
    :param models: the models of all methods that apply, the chosen method's first.
    :param gains: the gains of all rules that apply to the first model, the chosen rule's first.
    :param reason: why there is no model or no gains; empty if there are both.
    :param added_delay: dead time beside the process's own with which the gains were judged [s]:
        half a sampling period of the controller, and what else its loop adds.
    :param judgement: findings of the checks, and the verdict.
    :param predicted: for a running experiment, Ms with the gains of its model, and the ends of its
        95 % interval; empty: not asked for, or no gains.
    :param shaping: all that is needed to design other gains; None: no gains are allowed.
    """

    record: Record
    models: tuple[Identification, ...] = ()
    gains: tuple[Gains, ...] = ()
    reason: str = ""
    added_delay: float = 0.0
    judgement: Judgement = NOT_JUDGED
    predicted: tuple[float, ...] = ()
    shaping: Shaping | None = None

    @property
    def cycles(self) -> tuple[Cycle, ...]:
        """The whole cycles of the record."""
        return cycles_of(self.record)

    @property
    def model(self) -> Identification | None:
        """The selected identification; None: nothing was identified."""
        return self.models[0] if self.models else None

    @property
    def best_gains(self) -> Gains | None:
        """The recommended gains; None: there are no gains."""
        return self.gains[0] if self.gains else None

    @property
    def verdict(self) -> Verdict:
        """Whether the gains may be used."""
        return self.judgement.verdict

    @property
    def finding(self) -> FitProgress:
        """Result of the fit and its prediction for a running experiment."""
        if (model := self.model) is None:
            return FitProgress()
        return FitProgress(model.ultimate_gain, model.ultimate_gain_std, *self.predicted)

    def __repr__(self) -> str:
        """Return model, verdict and gains on ten lines at most; the fields have the rest."""
        return _text(self)

    def _repr_html_(self) -> str:
        """Return model and gains as a table, as notebooks show it."""
        return _html(self)


def _text(analysis: Analysis) -> str:
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
    lines = [f"  {label:<9} {in_units(text, analysis.record.units)}" for label, text in rows]
    return "\n".join([f"<Analysis of {analysis.record!r}", *lines]) + ">"


def _html(analysis: Analysis) -> str:
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
        f'<td style="text-align: left">{in_units(value, analysis.record.units)}</td></tr>'
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
