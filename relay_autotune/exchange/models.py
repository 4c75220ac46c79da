# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models in documents, in messages and in python-control; a recording's whole document."""

from __future__ import annotations

import array
import importlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from relay_autotune.errors import MissingPackageError, ModelError, RelayAutotuneError
from relay_autotune.exchange.fields import (
    SPECIAL,
    Special,
    WrongFieldError,
    float64_array,
    json_number,
    json_numbers,
    named,
    number,
    of_document,
    require_length,
    to_document,
    word,
)
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.limit_cycle.shape import shape_of_record
from relay_autotune.identification.result import Rival
from relay_autotune.loop.gains import Controller
from relay_autotune.process.structures import GENERAL, structure_of
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.cycles import limit_cycle, settings_of
from relay_autotune.record.record import Outcome, Record
from relay_autotune.verdict import NOT_JUDGED, Finding, Judgement, Verdict, verdict_named

if TYPE_CHECKING:
    from relay_autotune.result import Analysis


# Largest number of coefficients: no structure has more, and finding the roots would take long.
_MOST_COEFFICIENTS = 50
# Largest relative difference, by rounding, of the polynomials from those of the parameters.
_SAME = 1e-6
# Fields of a model in the tables of many bags.
COLUMNS = ("structure", "gain", "zeros", "time_constants", "dead_time")


def model_fields(model: TransferFunction) -> dict[str, Any]:
    """Return a transfer function as it appears in documents."""
    return {
        "structure": model.structure,
        "gain": json_number(model.gain),
        "zeros": json_numbers(model.zeros),
        "time_constants": json_numbers(model.time_constants),
        "dead_time": json_number(model.dead_time),
        "numerator": json_numbers(model.numerator),
        "denominator": json_numbers(model.denominator),
    }


def model_of_fields(m: dict[str, Any]) -> TransferFunction:
    """Return the transfer function that :func:`model_fields` tells.

    :raises ModelError: if it is not a transfer function.
    """
    zeros, constants = (tuple(map(_complex, m[n])) for n in ("zeros", "time_constants"))
    # The polynomials count the integrators; their roots would come back rounded.
    integrators = len(m["denominator"]) - len(constants) - len(m["numerator"]) + len(zeros)
    structure = str(m.get("structure", GENERAL))
    return TransferFunction(
        number(m["gain"]), zeros, constants, integrators, number(m["dead_time"]), structure
    )


def _complex(value: Any) -> complex:
    return complex(*map(float, value)) if isinstance(value, list) else complex(float(value))


def _estimate_fields(estimate: Estimate) -> dict[str, Any]:
    names, finite = estimate.structure.names, bool(np.all(np.isfinite(estimate.covariance)))
    return {
        **model_fields(estimate.model),
        "values": named(names, estimate.values),
        "std": named(names, estimate.std),
        # By rows; null where any of it was not estimated.
        "covariance": [json_numbers(row) for row in estimate.covariance] if finite else None,
    }


def _estimate_of_fields(m: dict[str, Any]) -> Estimate:
    model, names = model_of_fields(m), tuple(map(word, m["values"]))
    if m["covariance"] is None:
        covariance = np.full((len(names), len(names)), math.nan)
        np.fill_diagonal(covariance, [number(m["std"][n]) ** 2 for n in names])
    else:
        covariance = np.array(m["covariance"], dtype=float).reshape(len(names), len(names))
    values = np.array([number(v) for v in m["values"].values()])
    return Estimate(structure_of(model, names), values, covariance)


def _estimate_to_message(message: Any, estimate: Estimate) -> None:
    model = estimate.model
    message.structure = model.structure
    message.gain = float(model.gain)
    message.zeros = _real(model.zeros)
    message.time_constants = _real(model.time_constants)
    message.numerator = float64_array(model.numerator)
    message.denominator = float64_array(model.denominator)
    message.dead_time = float(model.dead_time)
    message.order = int(model.order)
    message.parameters = list(estimate.structure.names)
    message.std = float64_array(estimate.std)
    message.covariance = float64_array(estimate.covariance)


def _real(values: Sequence[complex]) -> array.array[float]:
    # The fields hold real numbers; a complex pair is given by numerator and denominator alone.
    if any(complex(value).imag != 0.0 for value in values):
        return array.array("d")
    return array.array("d", (complex(value).real for value in values))


def model_of_message(message: Any) -> TransferFunction:
    """Return the transfer function that a `TransferFunction` message tells by its polynomials.

    :raises ModelError: if it is not a transfer function, or too large.
    """
    if max(len(message.numerator), len(message.denominator)) > _MOST_COEFFICIENTS:
        raise ModelError(
            f"the model has {len(message.numerator)} and {len(message.denominator)} "
            f"coefficients, expected {_MOST_COEFFICIENTS} at most"
        )
    return TransferFunction.from_polynomials(
        tuple(float(c) for c in message.numerator),
        tuple(float(c) for c in message.denominator),
        dead_time=float(message.dead_time),
        structure=str(message.structure) or GENERAL,
    )


def _estimate_of_message(message: Any) -> Estimate:
    model, names = model_of_message(message), tuple(map(str, message.parameters))
    std = np.asarray(message.std, dtype=np.float64)
    covariance = np.asarray(message.covariance, dtype=np.float64)
    require_length("std", std.size, len(names), "parameters")
    require_length("covariance", covariance.size, len(names) ** 2, "parameters")
    if bool(np.any(std < 0.0)):
        raise WrongFieldError("std", "has a negative number, expected >= 0 or NaN")
    covariance = covariance.reshape(len(names), len(names))
    if len(message.time_constants) + model.integrators == model.order:
        # Roots of the polynomials are rounded.
        zeros = tuple(map(complex, message.zeros)) or model.zeros
        constants = tuple(map(complex, message.time_constants))
        exact = TransferFunction(
            float(message.gain), zeros, constants, model.integrators, model.dead_time,
            model.structure,
        )  # fmt: skip
    else:
        exact = model
    structure = structure_of(exact, names)
    values = structure.values_of(exact)
    found_model = structure.build(values)
    for name in ("numerator", "denominator"):
        given, follows = list(getattr(message, name)), list(getattr(found_model, name))
        if len(given) != len(follows) or not np.allclose(given, follows, rtol=_SAME, atol=0.0):
            raise WrongFieldError(
                name,
                f"is {given}, but its gain and time constants make it {follows}: they contradict "
                "each other",
            )
    return Estimate(structure, values, covariance)


SPECIAL |= {
    Estimate: Special(
        _estimate_fields, _estimate_of_fields, _estimate_to_message, _estimate_of_message
    ),
    Rival: Special(
        lambda rival: {"support": json_number(rival.support), **model_fields(rival.model)},
        lambda r: Rival(Estimate.of_model(model_of_fields(r)), number(r["support"])),
    ),
    TransferFunction: Special(model_fields, model_of_fields),
}


def to_control(system: TransferFunction | Controller, *, pade_order: int = 5) -> Any:
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


_SHAPE = ("sharpness", "plateau", "growth", "rise", "rise_half")


def document(
    bag: str, analyses: Sequence[Analysis] = (), *, error: str | None = None
) -> dict[str, Any]:
    """Return the document of one recording.

    :param bag: the recording, as it was given.
    :param analyses: of its experiments.
    :param error: why the recording could not be read.
    """
    found: dict[str, Any] = {"bag": bag, "experiments": [_experiment(a) for a in analyses]}
    if error is not None:
        found["error"] = error
    return found


def to_json(value: dict[str, Any]) -> str:
    """Return a document on one line; every number has the digits that give it back exactly."""
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def _experiment(analysis: Analysis) -> dict[str, Any]:
    record, settings = analysis.record, settings_of(analysis.record)
    return {
        "start": json_number(record.start),
        "duration": json_number(record.duration),
        "outcome": record.outcome.name.lower(),
        "reason": _reason(analysis),
        "experiment_id": record.experiment_id,
        "units": dict(record.units),
        "samples": len(record),
        "lost_samples": record.lost_samples,
        "relay": None if settings is None else to_document(settings),
        "limit_cycle": _limit_cycle(analysis),
        "models": [to_document(model) for model in analysis.models],
        "selected": 0 if analysis.models else None,
        "gains": [to_document(gains) for gains in analysis.gains],
        "recommended": 0 if analysis.gains else None,
        "added_delay": json_number(analysis.added_delay),
        **judgement_fields(analysis.judgement),
    }


def judgement_fields(judgement: Judgement) -> dict[str, Any]:
    """Return the verdict on an experiment with the table of its checks."""
    return {
        "verdict": judgement.verdict.name.lower(),
        "verdict_reason": judgement.reason,
        "checks": [to_document(found) for found in judgement.findings],
    }


def judgement_of_fields(e: dict[str, Any]) -> Judgement:
    """Return the judgement in a document's experiment; without a verdict it was not judged."""
    verdict = verdict_named(str(e.get("verdict", "unknown")))
    if verdict is Verdict.UNKNOWN:
        return NOT_JUDGED
    found = Judgement(tuple(of_document(Finding, f) for f in e["checks"]))
    said = str(e["verdict_reason"])
    refused = verdict is Verdict.NONE and said != found.reason
    return replace(found, refused=said) if refused else found


def _reason(analysis: Analysis) -> str:
    """Return why the experiment ended as it did; if it ended well, why it has no result."""
    record = analysis.record
    if record.outcome in (Outcome.ABORTED, Outcome.FAILED):
        return record.reason or analysis.reason
    return analysis.reason or record.reason


def _limit_cycle(analysis: Analysis) -> dict[str, Any] | None:
    if not analysis.cycles:
        return None
    cycle = limit_cycle(analysis.cycles)
    return {**to_document(cycle), "cycles": len(cycle.cycles), **_shape(analysis.record)}


def _shape(record: Record) -> dict[str, Any]:
    """Return category and shape factors; null where the record does not show them."""
    try:
        shape = shape_of_record(record)
    except RelayAutotuneError:
        return dict.fromkeys(("category", *_SHAPE))
    return {
        "category": shape.category,
        **{name: json_number(getattr(shape, name)) for name in _SHAPE},
    }
