"""The result of a recording as one JSON document, as `replay --json` prints it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.judgement.validation import DIFFERENCES
from relay_autotune.identification.shown.shape import shape_of_record
from relay_autotune.loop.gains import NUMBERS
from relay_autotune.record.cycles import limit_cycle
from relay_autotune.record.foreign import settings_of
from relay_autotune.record.record import Outcome, Record

if TYPE_CHECKING:
    from relay_autotune.analysis import Analysis
    from relay_autotune.identification import Identification
    from relay_autotune.process.transfer_function import TransferFunction
    from relay_autotune.tuning import Gains, Performance
    from relay_autotune.verdict import Finding, Judgement

_LIMIT_CYCLE = (
    *("period", "period_high", "period_low", "peak_max", "peak_min"),
    *("time_to_peak_max", "time_to_peak_min", "mean_measurement", "mean_command"),
)
_SHAPE = ("sharpness", "plateau", "growth", "rise", "rise_half")
_FIT = (
    *("residual_rms", "noise_std", "fit", "whiteness_p", "prediction"),
    *("noise_to_signal", "noise_to_signal_power"),
)


def document(
    bag: str, analyses: Sequence[Analysis] = (), *, error: str | None = None
) -> dict[str, Any]:
    """Return the document of one recording.

    :param bag: the recording, as it was given.
    :param analyses: what was made of its experiments.
    :param error: why the recording could not be read.
    """
    found: dict[str, Any] = {"bag": bag, "experiments": [_experiment(a) for a in analyses]}
    if error is not None:
        found["error"] = error
    return found


def to_json(value: dict[str, Any]) -> str:
    """Return a document on one line; every number has the digits that give it back exactly."""
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def model_fields(model: TransferFunction) -> dict[str, Any]:
    """Return a transfer function as it appears in documents."""
    return {
        "gain": _number(model.gain),
        "zeros": _numbers(model.zeros),
        "time_constants": _numbers(model.time_constants),
        "dead_time": _number(model.dead_time),
        "numerator": _numbers(model.numerator),
        "denominator": _numbers(model.denominator),
    }


def _experiment(analysis: Analysis) -> dict[str, Any]:
    record = analysis.record
    return {
        "start": _number(record.start),
        "duration": _number(record.duration),
        "outcome": record.outcome.name.lower(),
        "reason": _reason(analysis),
        "experiment_id": record.experiment_id,
        "samples": len(record),
        "lost_samples": record.lost_samples,
        "relay": _relay(record),
        "limit_cycle": _limit_cycle(analysis),
        "models": [identification_fields(model) for model in analysis.models],
        "selected": analysis.selected,
        "gains": [gains_fields(gains) for gains in analysis.gains],
        "recommended": analysis.recommended,
        "added_delay": _number(analysis.added_delay),
        **judgement_fields(analysis.judgement),
    }


def judgement_fields(judgement: Judgement) -> dict[str, Any]:
    """Return the verdict on an experiment with the table of its checks."""
    return {
        "verdict": judgement.verdict.name.lower(),
        "verdict_reason": judgement.reason,
        "checks": [_finding(found) for found in judgement.findings],
    }


def _finding(found: Finding) -> dict[str, Any]:
    return {
        "name": found.name,
        "title": found.title,
        "what": found.what,
        "value": _number(found.value),
        "unit": found.unit,
        "limit": _number(found.limit),
        "result": found.result.name.lower(),
        "sentence": found.sentence,
        "remedy": found.remedy,
    }


def _relay(record: Record) -> dict[str, Any] | None:
    settings = settings_of(record)
    if settings is None:
        return None
    return {name: _number(value) for name, value in vars(settings).items()}


def _reason(analysis: Analysis) -> str:
    """Return why the experiment ended as it did; if it ended well, why nothing came of it."""
    record = analysis.record
    if record.outcome in (Outcome.ABORTED, Outcome.FAILED):
        return record.reason or analysis.reason
    return analysis.reason or record.reason


def _limit_cycle(analysis: Analysis) -> dict[str, Any] | None:
    if not analysis.cycles:
        return None
    cycle = limit_cycle(analysis.cycles)
    return {
        **{name: _number(getattr(cycle, name)) for name in _LIMIT_CYCLE},
        "cycles": len(cycle.cycles),
        "converged": cycle.converged,
        **_shape(analysis.record),
    }


def _shape(record: Record) -> dict[str, Any]:
    """Return category and shape factors; null where the record does not show them."""
    try:
        shape = shape_of_record(record)
    except RelayAutotuneError:
        return dict.fromkeys(("category", *_SHAPE))
    return {
        "category": shape.category,
        **{name: _number(getattr(shape, name)) for name in _SHAPE},
    }


def identification_fields(identification: Identification) -> dict[str, Any]:
    """Return an identified model with its accuracy as it appears in documents."""
    names = identification.parameters
    intervals = zip(identification.ci95_low, identification.ci95_high, strict=True)
    return {
        "method": identification.method,
        "structure": identification.structure,
        **model_fields(identification.model),
        "values": _named(names, identification.values),
        "std": _named(names, identification.std),
        "covariance": _covariance(identification),
        "ci95": {n: _numbers(ends) for n, ends in zip(names, intervals, strict=True)},
        "fit": {name: _number(getattr(identification.fit, name)) for name in _FIT},
        "validation": _validation(identification),
        "integrated_error": _number(identification.integrated_error),
        "points": [
            {
                "frequency": _number(p.frequency),
                "real": _number(p.value.real),
                "imaginary": _number(p.value.imag),
                "std": _number(p.std),
            }
            for p in identification.points
        ],
        "ultimate_gain": _number(identification.ultimate_gain),
        "ultimate_gain_std": _number(identification.ultimate_gain_std),
        "ultimate_frequency": _number(identification.ultimate_frequency),
        "ultimate_frequency_std": _number(identification.ultimate_frequency_std),
        "warnings": list(identification.warnings),
        "undetermined": list(identification.undetermined),
        "combinations": [
            {
                "name": c.name,
                "unit": c.unit,
                "value": _number(c.value),
                "std": _number(c.std),
                "ci95": _numbers((c.ci95_low, c.ci95_high)),
            }
            for c in identification.combinations
        ],
        "advice": list(identification.advice),
        "support": _number(identification.support),
        "rivals": [
            {
                "structure": r.model.structure,
                "support": _number(r.support),
                **model_fields(r.model),
            }
            for r in identification.rivals
        ],
    }


def _covariance(identification: Identification) -> list[Any] | None:
    """Return the covariance by rows; null where any of it was not estimated."""
    if not bool(np.all(np.isfinite(identification.covariance))):
        return None
    return [_numbers(row) for row in identification.covariance]


def _validation(identification: Identification) -> dict[str, Any] | None:
    validation = identification.validation
    if validation is None:
        return None
    return {
        **{name: _number(getattr(validation, name)) for name in DIFFERENCES},
        "reason": validation.reason,
    }


def gains_fields(gains: Gains) -> dict[str, Any]:
    """Return gains with what they do on the model as they appear in documents."""
    return {
        "rule": gains.rule,
        "form": gains.form,
        **{name: _number(getattr(gains, name)) for name in NUMBERS},
        "reason": gains.reason,
        "warnings": list(gains.warnings),
    }


def number_fields(performance: Performance) -> dict[str, Any]:
    """Return what a controller does on a model as it appears in documents."""
    return {name: _number(value) for name, value in vars(performance).items()}


def _named(names: Sequence[str], values: Iterable[float]) -> dict[str, Any]:
    return {name: _number(value) for name, value in zip(names, values, strict=True)}


def _numbers(values: Iterable[complex]) -> list[Any]:
    return [_number(value) for value in values]


def _number(value: Any) -> Any:
    """Return what JSON has for a number: null for none, [re, im] for a complex one."""
    if isinstance(value, bool | int):
        return value
    number = complex(value)
    if number.imag != 0.0:
        return [_number(number.real), _number(number.imag)]
    return number.real if math.isfinite(number.real) else None
