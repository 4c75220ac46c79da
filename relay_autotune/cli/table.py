# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The result of a recording as plain text for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from relay_autotune.cli.terminal import (
    LABEL_WIDTH,
    NARROWEST,
    UNITS,
    WIDEST,
    broken,
    in_columns,
    labelled,
    with_units,
)
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import series_form
from relay_autotune.process.transfer_function import process_text
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.cycles import limit_cycle
from relay_autotune.record.record import Outcome
from relay_autotune.text import (
    counted,
    date_text,
    digits,
    in_units,
    percent,
    plus_minus,
    span_text,
)
from relay_autotune.verdict import Judgement, Result, Verdict

if TYPE_CHECKING:
    from relay_autotune.identification.result import Identification, Validation
    from relay_autotune.loop.gains import Controller, Gains, Performance
    from relay_autotune.process.transfer_function import TransferFunction
    from relay_autotune.result import Analysis

# Chances below this are not distinguished.
_SURE = 1e-4
# Rivals beyond these are in the JSON document alone.
_RIVALS = 3

# What stands beside each other on a line: a label and a text, whose parts are three blanks apart.
_Entry = tuple[str, str]
_BLANK: _Entry = ("", "")


def table(
    bag: str,
    analyses: Sequence[Analysis],
    width: int = WIDEST,
    present: Controller | None = None,
    form: str = "isa",
) -> str:
    """Return what was made of each experiment of a recording.

    :param bag: the recording, as it was given.
    :param analyses: one for each experiment.
    :param width: columns that a line may have.
    :param present: the gains that the controller has now; None: not known.
    :param form: "series": gains are also given in that form.
    """
    blocks = [bag]
    for number, analysis in enumerate(analyses, start=1):
        which = f" {number} of {len(analyses)}" if len(analyses) > 1 else ""
        with with_units(analysis.record.units):
            blocks.append("\n".join(_laid_out(_experiment(analysis, which, form), width)))
            if compared := compared_lines(analysis, present, width):
                blocks.append("\n".join(compared))
    return "\n\n".join(blocks) + "\n"


def compared_lines(
    analysis: Analysis, present: Controller | None, width: int = WIDEST
) -> list[str]:
    """Return the present gains beside the new ones; empty: either are not there.

    :param analysis: of an experiment.
    :param present: the gains that the controller has now; None: not known.
    :param width: columns that a line may have.
    """
    model, gains = analysis.model, analysis.best_gains
    if present is None or model is None or gains is None:
        return []
    with with_units(analysis.record.units):
        return beside(present, gains, model.model, width, analysis.added_delay)


# Numbers of a table with one line for each experiment: names, units and widths.
_VERDICT = 8
_NUMBERS = (
    *(("K_u", "u/y", 7), ("w_u", "rad/s", 7), ("kc", "u/y", 7), ("ti", "s", 7), ("td", "s", 7)),
    *(("tf", "s", 7), ("b", "", 4), ("every", "s", 6), ("Ms", "", 4)),
)


def heading(name_width: int, units: Mapping[str, str]) -> str:
    """Return the two lines above :func:`rows`.

    :param name_width: columns of the name.
    :param units: of the measurement, by "y", and of the command, by "u", as far as they are known.
    """
    named = [(name, in_units(unit, units), unit, wide) for name, unit, wide in _NUMBERS]
    words = [actual if len(actual) <= wide else unit for _, actual, unit, wide in named]
    above = (("verdict", [name for name, *_ in named]), ("", words))
    return "\n".join(_lines("", word, cells, name_width, WIDEST)[0] for word, cells in above)


def rows(
    bag: str, analyses: Sequence[Analysis], error: str | None, name_width: int, width: int
) -> list[str]:
    """Return what was made of a recording, a line for each experiment.

    :param bag: the recording.
    :param analyses: one for each experiment.
    :param error: why there are none; None: there are.
    :param name_width: columns of the name.
    :param width: columns that a line may have; a reason goes on below.
    """
    lines = [] if error is None else _lines(bag, "-", [error], name_width, width)
    for number, analysis in enumerate(analyses, start=1):
        name = f"{bag} {number}/{len(analyses)}" if len(analyses) > 1 else bag
        model, gains = analysis.model, analysis.best_gains
        verdict = analysis.verdict.name.lower() if model is not None else "-"
        cells = [analysis.reason]
        if model is not None and gains is not None and analysis.shaping is not None:
            values = (model.ultimate_gain, model.ultimate_frequency, gains.kc, gains.ti, gains.td)
            every = f"{analysis.shaping.task.options.sample_period:g}"
            more = (digits(gains.tf), f"{gains.b:g}", every, digits(gains.ms, 3))
            cells = [*map(digits, values), *more]
        lines += _lines(name, verdict, cells, name_width, width)
    return lines


def _lines(
    name: str, verdict: str, cells: Sequence[str], name_width: int, width: int
) -> list[str]:
    """Return numbers on a line, or a sentence on as many as it takes; lines in it stay whole."""
    begin = f"{name:<{name_width}}  {verdict:<{_VERDICT}}"
    if len(cells) > 1:
        numbers = zip(cells, _NUMBERS, strict=True)
        return ["".join([begin, *(f" {cell:>{wide}}" for cell, (_, _, wide) in numbers)]).rstrip()]
    first, *copied = cells[0].split("\n")
    parts = broken(first, max(width - len(begin) - 2, NARROWEST))
    indent = " " * len(begin)
    return [f"{indent if k else begin}  {part}" for k, part in enumerate(parts)] + copied


def identification_lines(found: Identification, width: int = WIDEST) -> list[str]:
    """Return an identified model with its accuracy, as lines.

    :param found: the model.
    :param width: columns that a line may have.
    """
    return _laid_out(_identification(found), width)


def gains_lines(
    gains: Gains,
    verdict: Verdict = Verdict.UNKNOWN,
    width: int = WIDEST,
    form: str = "isa",
) -> list[str]:
    """Return a controller with what it does on the model, as lines.

    :param gains: the controller, or a message with the same fields.
    :param verdict: on the experiment that it comes from.
    :param width: columns that a line may have.
    :param form: "series": they are also given in that form.
    :raises TuningError: if they do not have it.
    """
    return _laid_out(_gains(gains, verdict, _series(gains) if form == "series" else ()), width)


def _series(gains: Gains) -> tuple[str, ...]:
    found = series_form(gains)
    return (f"{_three(found)}   alpha {digits(found.alpha, 3)}   b {gains.b:g}",)


def _three(of: Any) -> str:
    """Return the numbers that gains of the ISA and of the series form have."""
    return f"kc {digits(of.kc)} u/y   ti {digits(of.ti)} s   td {digits(of.td)} s"


def beside(
    present: Controller | None,
    gains: Gains,
    model: TransferFunction,
    width: int = WIDEST,
    added_delay: float = math.nan,
) -> list[str]:
    """Return the present gains and the new ones, with what each does on the model.

    :param present: the present gains; None: there are none.
    :param gains: the new ones.
    :param model: the process.
    :param width: columns that a line may have.
    :param added_delay: as of `performance_beside`.
    """
    # here, for they load scipy: a tune is shown with this module, and begins before that
    from relay_autotune.loop.analysis import difference, performance_beside
    from relay_autotune.report.findings import compared

    now = None if present is None else performance_beside(present, gains, model, added_delay)
    rows = [(r.name, r.present, r.new, r.unit) for r in compared(present, now, gains)]
    lines = in_columns([("", "present", "new", ""), *rows], width)
    if present is not None:
        lines += labelled("compared", difference(present, now, gains, model), width)
    return lines


def _laid_out(entries: Sequence[_Entry], width: int) -> list[str]:
    return [line for label, text in entries for line in labelled(label, text, width)]


def _experiment(analysis: Analysis, which: str, form: str) -> list[_Entry]:
    record = analysis.record
    name = f"  ({record.experiment_id})" if record.experiment_id else ""
    lines = [(f"experiment{which}", record.outcome.words + name)]
    # The reason for no gains begins with it.
    is_repeated = record.reason in analysis.reason
    if record.reason and not is_repeated and record.outcome != Outcome.COMPLETED:
        lines.append(("", record.reason))
    begun = f", from {date_text(record.start)}" if record.start else ""
    span = span_text(record.duration, len(record), record.lost_samples)
    lines.append(("recorded", span + begun))
    lines += _limit_cycle(analysis)
    if analysis.model is not None:
        lines += [_BLANK, *_identification(analysis.model)]
        lines += _others(analysis)
    if analysis.models and analysis.judgement.judged:
        lines += [_BLANK, *_verdict(analysis.judgement)]
    if analysis.best_gains is not None:
        series: tuple[str, ...] = ()
        if form == "series":
            try:
                series = _series(analysis.best_gains)
            except TuningError as error:
                series = (f"none: {error}",)
        lines += [_BLANK, *_gains(analysis.best_gains, analysis.verdict, series)]
        lines += _other_gains(analysis)
    if analysis.reason:
        lines += [_BLANK, ("gains" if analysis.models else "process", analysis.reason)]
    return lines


def _verdict(judgement: Judgement) -> list[_Entry]:
    worse = [f for f in judgement.findings if f.result is not Result.PASSED]
    if judgement.contradicted and not judgement.refused:
        # The worst finding is shown where the gains would be.
        worse = [f for f in worse if f is not judgement.worst]
    # What was refused was not for its checks.
    words = [judgement.verdict.name.lower(), *[judgement.passed] * (not judgement.refused)]
    if judgement.contradicted and not judgement.refused and judgement.worst is not None:
        words[-1] += f"; failed: {judgement.worst.title.lower()}"
    return [
        ("verdict", ", ".join(words)),
        *((f"  {found.title.lower()}", found.said) for found in worse),
    ]


def _limit_cycle(analysis: Analysis) -> list[_Entry]:
    if not analysis.cycles:
        return []
    cycle = limit_cycle(analysis.cycles)
    state = "converged" if cycle.converged else "not converged"
    return [
        (
            "limit cycle",
            f"period {digits(cycle.period)} s (high {digits(cycle.period_high)} s, "
            f"low {digits(cycle.period_low)} s), {counted(len(cycle.cycles), 'cycle')}, {state}",
        ),
        ("", f"measurement {digits(cycle.peak_min)} to {digits(cycle.peak_max)} y"),
    ]


def _identification(found: Identification) -> list[_Entry]:
    name = f"{found.structure}, {found.method}"
    numbers = []
    structure = found.estimate.structure
    intervals = zip(found.values, found.ci95_low, found.ci95_high, strict=True)
    for parameter, (value, low, high) in zip(structure.parameters, intervals, strict=True):
        label, unit = parameter.name, structure.unit(parameter)
        end = digits(high) if np.isfinite(high) else "any"
        interval = f"95 %: {digits(low)} to {end}" if np.isfinite(low) else ""
        doubt = "   not determined" if label in found.undetermined else ""
        numbers.append((label.replace("_", " "), digits(value), unit, interval + doubt))
    for label, value, std, unit in (
        ("ultimate gain", found.ultimate_gain, found.ultimate_gain_std, "u/y"),
        ("ultimate freq.", found.ultimate_frequency, found.ultimate_frequency_std, "rad/s"),
    ):
        if math.isfinite(value):
            numbers.append((label, digits(value), unit, plus_minus(value, NORMAL_95 * std)))
    lines = [("process", _process(found.model, name)), *_below_one_another(numbers)]
    lines += _known_all_the_same(found)
    lines.append(("fit", _fit(found)))
    if found.validation is not None:
        lines.append(("limit cycle", _validation(found.validation)))
    rivals = [
        _process(each.model, f"{each.model.structure}, {percent(each.support)} % of the support")
        for each in found.rivals[:_RIVALS]
    ]
    lines += _listed("rivals", rivals)
    if found.why_chosen:
        lines.append(("", found.why_chosen))
    return lines + [("warning", warning) for warning in found.warnings]


def _known_all_the_same(found: Identification) -> list[_Entry]:
    """Return what is determined although parameters are not, and what would help."""
    # K_u and w_u have lines of their own.
    shown = [c for c in found.combinations if not c.name.startswith("ultimate")]
    lines = []
    for c in shown:
        interval = f"95 %: {digits(c.ci95_low)} to {digits(c.ci95_high)}"
        known = f"{c.name.replace('_', ' ')} {digits(c.value)} {c.unit} ({interval})"
        lines.append(("determined", known))
    return lines + [("would help", sentence) for sentence in found.advice]


def _others(analysis: Analysis) -> list[_Entry]:
    """Return what the other methods found, a line for each."""
    texts, instead = [], ""
    chosen = None if analysis.model is None else analysis.model.validation
    if chosen is not None and not chosen.reason:
        instead = f" instead of {digits(100.0 * chosen.worst, 2)} %"
    for m in analysis.models[1:]:
        note = f"{m.structure}, {m.method}"
        if m.validation is not None and not m.validation.reason:
            note += f", limit cycle {digits(100.0 * m.validation.worst, 2)} % off{instead}"
        texts.append(_process(m.model, note))
    return _listed("also", texts)


def _fit(found: Identification) -> str:
    fit = found.fit
    parts = []
    if math.isfinite(fit.fit):
        parts.append(f"{100.0 * fit.fit:.2f} %")
    if math.isfinite(fit.residual_rms):
        parts.append(f"residual {digits(fit.residual_rms, 3)} y rms")
    if fit.noise_std == 0.0:
        parts.append("noise below the sensor's resolution")
    elif math.isfinite(fit.noise_std):
        parts.append(f"noise {digits(fit.noise_std, 3)} y")
    if math.isfinite(fit.prediction):
        parts.append(f"prediction {digits(fit.prediction, 3)} y rms")
    if math.isfinite(fit.whiteness_p):
        least = fit.whiteness_p < _SURE
        parts.append(f"whiteness p {'< 0.0001' if least else '= ' + digits(fit.whiteness_p, 2)}")
    if math.isfinite(fit.noise_to_signal):
        parts.append(f"noise {percent(fit.noise_to_signal)} % of the signal")
    return ", ".join(parts) or "not estimated"


def _validation(validation: Validation) -> str:
    if validation.reason:
        return f"none of the model: {validation.reason}"
    parts = [
        f"{name} {'+' * (value > 0.0)}{digits(100.0 * value, 2)} %"
        for name, value in (
            ("period", validation.period),
            ("peaks", validation.peak_max),
            ("and", validation.peak_min),
        )
    ]
    shape = f"shape {digits(100.0 * validation.shape, 2)} %"
    return f"of the model: {parts[0]}, {parts[1]} {parts[2]}, {shape} off the record's"


def _other_gains(analysis: Analysis) -> list[_Entry]:
    """Return what the other rules say, a line for each."""
    others = (f"{_three(g)}   Ms {digits(g.ms, 3)}   ({g.rule})" for g in analysis.gains[1:])
    return _listed("also", list(others))


def _gains(gains: Gains, verdict: Verdict, series: Sequence[str]) -> list[_Entry]:
    mark = "   DOUBTFUL: see the verdict" if verdict is Verdict.DOUBTFUL else ""
    lines = [
        ("gains", gains.rule + mark),
        (
            "  ISA form",
            _three(gains) + f"   tf {digits(gains.tf)} s" * bool(gains.tf) + f"   b {gains.b:g}",
        ),
        *(("  series form", text) for text in series),
        (
            "  parallel form",
            f"p {digits(gains.p)} u/y   i {digits(gains.i)} u/(y s)   d {digits(gains.d)} u s/y",
        ),
        (
            "  predicted",
            f"Ms {digits(gains.ms, 3)} (95 %: <= {digits(gains.ms_95, 3)})   "
            f"Mt {digits(gains.mt, 3)}   gain margin {digits(gains.gain_margin, 3)}   "
            f"phase margin {digits(math.degrees(gains.phase_margin), 3)} deg",
        ),
        (
            "",
            f"delay margin {digits(gains.delay_margin, 3)} s   "
            f"IAE of a unit load step {digits(gains.iae_load, 3)} y s/u",
        ),
    ]
    if math.isfinite(gains.overshoot):
        lines.append(("", f"set-point step: {_step(gains)}"))
    # Gains of a message come without it.
    bare: Performance | None = getattr(gains, "bare", None)
    if bare is not None:
        lines.append(("", f"without {gains.softeners}: {_step(bare)}   Ms {digits(bare.ms, 3)}"))
    if gains.reason:
        lines.append(("  because", gains.reason))
    return lines + [("  warning", warning) for warning in gains.warnings]


def _step(does: Performance) -> str:
    return (
        f"overshoot {percent(does.overshoot)} %   settled within 2 % after "
        f"{digits(does.settling_time, 3)} s"
    )


def _below_one_another(numbers: Sequence[tuple[str, str, str, str]]) -> list[_Entry]:
    """Return numbers, each with label, unit and interval, in columns; a label may be long."""
    rows = [(f"  {label}", n, in_units(unit, UNITS), more) for label, n, unit, more in numbers]
    over = [max(len(label) - LABEL_WIDTH, 0) for label, *_ in rows]
    wide = max([9, *(o + len(number) for o, (_, number, _, _) in zip(over, rows, strict=True))])
    units = max([6, *(len(unit) for _, _, unit, _ in rows)])
    return [
        (label, f"{number:>{wide - o}} {unit:<{units}} {more}".rstrip())
        for o, (label, number, unit, more) in zip(over, rows, strict=True)
    ]


def _process(model: TransferFunction, note: str) -> str:
    """Return a transfer function with a note, on one line where it fits."""
    return f"{process_text(model)}   ({note})"


def _listed(label: str, texts: Sequence[str]) -> list[_Entry]:
    """Return texts below one another, the first of them with the label."""
    return [(label if i == 0 else "", text) for i, text in enumerate(texts)]
