# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What goes to the browser: words and numbers as the report has them, and curves as short lists.

The page shows every text as text, so nothing is escaped here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.result import Identification
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import process_text
from relay_autotune.record.record import Record
from relay_autotune.report.case import Case, EstimatedQuantity, parameters_of, ultimate_of
from relay_autotune.report.findings import (
    UNITS,
    checks_of,
    compared,
    facts_of,
    remarks_of,
    verdict_of,
    warnings_of,
)
from relay_autotune.report.style import in_steps, thinned
from relay_autotune.result import Shaping
from relay_autotune.text import digits, percent, visible
from relay_autotune.tuning.task import DesignOptions
from relay_autotune.web.shape import CALM, FAST, STEP, DesignRequest, DesignResult, PageModel

# Samples at which the model of a running tune is computed.
_MOST_SIMULATED = 2000
# Significant digits of a curve relative to its largest value: finer than a pixel.
_DIGITS = 4
# The numbers of the ISA form, with their meanings.
_ISA = {
    "kc": "proportional gain",
    "ti": "integral time",
    "td": "derivative time",
    "tf": "filter of the measurement",
    "b": "weight of the set-point",
}
# The parts of both steps that are drawn.
_CURVES = ("time", "measurement", "command", "low", "high")


def to_text(document: dict[str, Any]) -> str:
    """Return a document as JSON without any number that JSON does not know.

    :param document: of plain values.
    """
    return json.dumps(document, allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def short(values: FloatArray) -> list[float | None]:
    """Return numbers with few digits; None stands for one that is not finite.

    :param values: shape (n,).
    """
    finite = np.isfinite(values)
    largest = float(np.abs(values[finite]).max(initial=0.0))
    decimals = _DIGITS - math.floor(math.log10(largest)) if largest > 0.0 else 0
    rounded = np.round(np.where(finite, values, 0.0), decimals).tolist()
    return [v if f else None for v, f in zip(rounded, finite.tolist(), strict=True)]


def curve(time: ArrayLike, values: ArrayLike) -> list[list[float | None]]:
    """Return a signal for a figure: times and values, with few points and digits.

    :param time: s, shape (n,).
    :param values: shape (n,).
    """
    return [short(part) for part in thinned(np.asarray(time, float), np.asarray(values, float))]


def of_subject(subject: PageModel) -> dict[str, Any]:
    """Return what a page shows of a model whatever the gains are.

    :param subject: the model.
    """
    case = subject.case
    model = case.model
    return {
        "name": visible(case.source),
        "loop": subject.loop,
        "when": subject.when,
        "facts": [visible(fact) for fact in facts_of(case, with_id=True)] if case.samples else [],
        "verdict": _verdict(case),
        "checks": _checks(case),
        "reason": visible(case.reason),
        "process": "" if model is None else process_text(model.model),
        "structure": "" if model is None else model.structure,
        "estimates": [_estimate(e) for e in (*case.parameters, *case.ultimate)],
        "record": _record(case),
        "rules": [{"rule": g.rule, "ms": short(np.array([g.ms, g.iae_load]))} for g in case.gains],
        "present": of_present(subject),
        "may_shape": subject.shaping is not None,
        "first": vars(subject.first),
        "slider": [CALM, FAST, STEP],
        "amplitude": _noisy_amplitude(subject.shaping),
    }


def of_running(
    model: Identification, record: Record | None, gains: Sequence[tuple[int, EstimatedQuantity]]
) -> dict[str, Any]:
    """Return what a page shows of the newest model while a tune runs.

    The model is drawn from rest, `y = y_0 + G u`, with the y_0 that fits best.

    :param model: the model.
    :param record: the samples so far, from rest on; None: they are not known.
    :param gains: K_u of each model so far, with the number of whole cycles.
    """
    found: dict[str, Any] = {
        "estimates": [_estimate(e) for e in (*parameters_of(model), *ultimate_of(model))],
        "gains": {
            "cycle": [cycle for cycle, _ in gains],
            **{
                name: short(np.array([getattr(e, name) for _, e in gains]))
                for name in ("value", "low", "high")
            },
        },
        "data": None,
    }
    if record is not None:
        few = slice(None, None, math.ceil(len(record) / _MOST_SIMULATED))
        time = record.time[few]
        moved = response(model.model, time, record.input())
        rest = float(np.mean(record.measurement[few] - moved))
        found["data"] = [curve(record.time, record.measurement), curve(time, rest + moved)]
    return found


def _noisy_amplitude(shaping: Shaping | None) -> float:
    """Return what the noise in the command is a part of [u]; 0: none is known to be limited."""
    options = DesignOptions() if shaping is None else shaping.task.options
    return options.amplitude if options.noise_std > 0.0 and options.amplitude > 0.0 else 0.0


def of_present(subject: PageModel) -> dict[str, Any]:
    """Return the present gains, and what they do on the model.

    :param subject: the model.
    :return: rows of names and values, and the responses to both steps, if there are any.
    """
    case, before = subject.case, subject.before()
    if case.present is None or case.model is None:
        return {"rows": [], "steps": None}
    rows = compared(case.present, case.present_does, case.best_gains)
    steps = None
    if before is not None:
        steps = [short(each) for each in (before.time, before.measurement, before.command)]
    shown = [[f"{r.name} [{r.unit}]" if r.unit else r.name, r.present] for r in rows]
    return {"rows": shown, "steps": steps}


def of_shaped(subject: PageModel, shaped: DesignResult) -> dict[str, Any]:
    """Return gains and what they do.

    :param subject: the model.
    :param shaped: the gains.
    """
    case, gains, steps = subject.case_with(shaped), shaped.gains, shaped.steps
    notes = [visible(text) for text in warnings_of(case)]
    if shaped.unstable:
        count = len(subject.shaping.task.models) if subject.shaping is not None else 0
        notes.append(f"On {shaped.unstable} of {count} models around, the loop is unstable.")
    return {
        "asked": vars(shaped.asked),
        "rule": gains.rule,
        "reason": visible(gains.reason),
        "verdict": _verdict(case),
        "checks": _checks(case),
        "doubtful": visible(shaped.judgement.reason),
        "warnings": notes,
        "remarks": [visible(text) for text in remarks_of(case)],
        "isa": [[n, digits(getattr(gains, n)), UNITS[n], what] for n, what in _ISA.items()],
        "parallel": [[n, digits(getattr(gains, n)), UNITS[n]] for n in ("p", "i", "d")],
        "effects": _effects(shaped),
        "beside": [row.new for row in compared(None, None, gains)],
        "at": short(np.array([gains.ms, gains.iae_load])),
        "b": gains.b,
        "ms": gains.ms,
        "steps": {
            **{name: short(getattr(steps, name)) for name in _CURVES},
            "load": digits(steps.load, 3),
            "load_time": steps.load_time,
        },
        "nyquist": {
            "re": short(shaped.loop.real),
            "im": short(shaped.loop.imag),
            "band": [short(part.ravel()) for part in shaped.band],
        },
        "command": visible(case.command),
    }


def of_trade_off(subject: PageModel, asked: DesignRequest) -> list[list[Any]]:
    """Return Ms and IAE of the controllers that are known so far, each with its kind.

    :param subject: the model.
    :param asked: for the same law, rate and noise.
    """
    return [
        ["pid" if gains.td > 0.0 else "pi", *short(np.array([gains.ms, gains.iae_load]))]
        for gains in subject.trade_off(asked)
    ]


def _effects(shaped: DesignResult) -> list[list[str]]:
    gains = shaped.gains
    rows = [
        ["Ms of the model", digits(gains.ms, 3), "below 1.4 careful, above 2 risky"],
        ["Ms of 95 %", digits(gains.ms_95, 3), "of the models around stay below"],
        ["Mt", digits(gains.mt, 3), ""],
        ["gain margin", digits(gains.gain_margin, 3), "factor by which the gain may grow"],
        ["phase margin", f"{digits(math.degrees(gains.phase_margin), 3)}°", ""],
        ["delay margin", f"{digits(gains.delay_margin, 3)} s", "dead time that may be added"],
        ["IAE, load", f"{digits(gains.iae_load, 3)} y s/u", "after a unit step of the load"],
        ["overshoot", f"{percent(gains.overshoot)} %", "after a step of the set-point"],
        ["settles in", f"{digits(gains.settling_time, 3)} s", "to within 2 %"],
    ]
    if gains.bare is not None:
        alone = f"{percent(gains.bare.overshoot)} %"
        rows.insert(-1, ["", alone, "where the controller has neither tf nor b"])
    noise = gains.noise_gain * shaped.options.noise_std
    if math.isfinite(noise):
        rows.append(["noise", f"{digits(noise, 2)} u", "standard deviation in the command"])
    return rows


def _verdict(case: Case) -> dict[str, str]:
    chip = verdict_of(case)
    return {"text": chip.text, "tone": chip.tone, "why": visible(case.judgement.reason)}


def _checks(case: Case) -> list[list[str]]:
    return [list(map(visible, check)) for check in checks_of(case)]


def _estimate(estimate: EstimatedQuantity) -> list[str]:
    interval = "not estimated"
    if math.isfinite(estimate.low):
        interval = f"{digits(estimate.low)} to {digits(estimate.high)}"
    if not estimate.determined:
        interval += ", not determined"
    return [estimate.title, digits(estimate.value), estimate.unit, interval]


def _record(case: Case) -> dict[str, Any] | None:
    record = case.record
    if record is None:
        return None
    held, command = in_steps(record.time, record.command)
    found = {
        "measurement": curve(record.time, record.measurement),
        "command": curve(held, command),
        "model": None,
    }
    model = case.model
    if model is not None and model.fitted.size == len(record):
        found["model"] = curve(record.time, model.fitted)
    return found
