# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The process that `tune` designs for: from flags, or from a JSON document."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from relay_autotune.errors import ModelError, SelectionError
from relay_autotune.process.structures import (
    GENERAL,
    STRUCTURES,
    TABLE,
    recognised,
    structure_named,
)
from relay_autotune.process.transfer_function import TransferFunction

_FLAGS = (
    *("gain", "time_constants", "zeros", "dead_time", "integrators", "order", "structure"),
    *("natural_frequency", "damping", "numerator", "denominator"),
)


def model_of(options: argparse.Namespace) -> TransferFunction:
    """Return the process that the command line gives.

    :param options: with ``document`` and the flags of the model, None where not given.
    :raises SelectionError: if they give no model, two, or an invalid one.
    """
    given = {name: getattr(options, name) for name in _FLAGS if getattr(options, name) is not None}
    if options.document is not None and given:
        raise SelectionError(
            f"the model is given twice, by {options.document} and by "
            f"{', '.join('--' + name.replace('_', '-') for name in given)}: give one of them"
        )
    if options.document is None and not given:
        raise SelectionError(
            "no model: give --gain, --time-constants and --dead-time, or a JSON document; "
            "tune --help has examples"
        )
    if options.document is not None:
        given = _from_document(options.document, options.experiment)
    try:
        model = _built(given)
        return recognised(model) if model.structure == GENERAL else model
    except ModelError as error:
        raise SelectionError(f"this is not a model: {error}") from error


def _built(given: dict[str, Any]) -> TransferFunction:
    """Return the transfer function of a model's fields.

    A document has all of them, and its gain is that of the time-constant form. Flags, and
    objects that people write, have some, and their gain is that of the structure's formula.
    """
    dead_time = _number("dead_time", given.get("dead_time", 0.0))
    numerator, denominator = given.get("numerator"), given.get("denominator")
    structure = given.get("structure") or ""
    if structure and structure not in STRUCTURES:
        raise SelectionError(f"unknown structure {structure!r}; known: {', '.join(TABLE)}")
    zeros, lags = (_constants(name, given.get(name)) for name in ("zeros", "time_constants"))
    if denominator is not None and "time_constants" in given and "gain" in given:
        below = _coefficients("denominator", denominator)
        integrators = len(below) - 1 - len(lags)
        gain = _number("gain", given["gain"])
        return TransferFunction(gain, zeros, lags, integrators, dead_time, structure or GENERAL)
    if numerator is not None or denominator is not None:
        if numerator is None or denominator is None:
            raise SelectionError("numerator and denominator belong together: give both")
        return TransferFunction.from_polynomials(
            _coefficients("numerator", numerator),
            _coefficients("denominator", denominator),
            dead_time,
        )
    if "gain" not in given:
        raise SelectionError("the model lacks its gain: give --gain")
    gain = _number("gain", given["gain"])
    for lag in lags:
        if lag.real <= 0.0 and lag.imag == 0.0:
            raise SelectionError(
                f"a time constant must be > 0 s, found {lag.real:g} s; an unstable process has "
                "--structure unstable_fopdt and a positive one"
            )
    if structure and structure != GENERAL:
        return structure_named(structure).of_fields(
            gain=gain,
            time_constants=_real("time_constants", lags),
            zeros=_real("zeros", zeros),
            dead_time=dead_time,
            order=int(given.get("order") or 0),
            natural_frequency=_number("natural_frequency", given.get("natural_frequency", 0.0)),
            damping=_number("damping", given.get("damping", 0.0)),
        )
    return _unnamed(given, gain, zeros, lags, dead_time)


def _unnamed(
    given: dict[str, Any],
    gain: float,
    zeros: tuple[complex, ...],
    lags: tuple[complex, ...],
    dead_time: float,
) -> TransferFunction:
    order, integrators = int(given.get("order") or 0), int(given.get("integrators") or 0)
    if order and len(lags) == 1:
        lags = lags * order
    elif order and order != len(lags):
        raise SelectionError(
            f"--order {order} is the number of equal lags and goes with one time constant, found "
            f"{len(lags)}"
        )
    if "natural_frequency" in given or "damping" in given:
        pair = TransferFunction.oscillator(
            1.0,
            _number("natural_frequency", given.get("natural_frequency", 0.0)),
            _number("damping", given.get("damping", 0.0)),
            0.0,
        )
        lags = (*lags, *pair.time_constants)
    if not lags and not integrators:
        raise SelectionError("the model has no dynamics: give --time-constants or --integrators")
    return TransferFunction(gain, zeros, lags, integrators, dead_time)


def _from_document(name: str, experiment: int | None) -> dict[str, Any]:
    """Return the fields of the model in a JSON document."""
    try:
        text = sys.stdin.read() if name == "-" else Path(name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is not text"
        raise SelectionError(f"{name} cannot be read: {why}") from error
    try:
        found = json.loads(text, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        raise SelectionError(
            f"{name} is not a JSON document ({error.msg} in line {error.lineno}); if it is a "
            "replay of several bags, give one of its lines"
        ) from error
    if not isinstance(found, dict):
        raise SelectionError(f"{name} holds a JSON {type(found).__name__}, expected an object")
    if "experiments" in found:
        return _selected(name, found, experiment)
    if isinstance(found.get("model"), dict):
        found = found["model"]
    if not {"gain", "denominator"} & found.keys():
        raise SelectionError(
            f"{name} holds no model: expected a document of replay --json or identify --json, or "
            "an object with gain, time_constants and dead_time, or with numerator and denominator"
        )
    return found


def _no_constant(text: str) -> float:
    raise SelectionError(f"every number of a model must be finite, found {text}")


def _selected(name: str, document: dict[str, Any], which: int | None) -> dict[str, Any]:
    experiments = document["experiments"]
    if which is not None and not 1 <= which <= len(experiments):
        raise SelectionError(
            f"{name} has {len(experiments)} experiments, found --experiment {which}"
        )
    tried = experiments if which is None else [experiments[which - 1]]
    with_model = [e for e in tried if isinstance(e, dict) and e.get("selected") is not None]
    if not with_model:
        raise SelectionError(f"{name} has no experiment with a model")
    if len(with_model) > 1:
        raise SelectionError(
            f"{name} has {len(with_model)} experiments with a model: choose one by --experiment"
        )
    model: dict[str, Any] = with_model[0]["models"][with_model[0]["selected"]]
    return model


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SelectionError(f"{name} must be a number, found {value!r}")
    return float(value)


def _constants(name: str, values: Any) -> tuple[complex, ...]:
    if values is None:
        return ()
    found = []
    for value in values if isinstance(values, list | tuple) else [values]:
        if isinstance(value, list) and len(value) == 2:
            found.append(complex(_number(name, value[0]), _number(name, value[1])))
        else:
            found.append(complex(_number(name, value)))
    return tuple(found)


def _real(name: str, values: tuple[complex, ...]) -> tuple[float, ...]:
    if any(value.imag for value in values):
        raise SelectionError(
            f"{name} of a structure are real; a complex pair has natural_frequency and damping"
        )
    return tuple(value.real for value in values)


def _coefficients(name: str, values: Any) -> list[float]:
    if not isinstance(values, list | tuple):
        raise SelectionError(f"{name} must be a list of coefficients, found {values!r}")
    return [_number(name, value) for value in values]
