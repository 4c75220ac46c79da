"""Cases from the JSON documents that `replay --json` prints, which hold no samples."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.bag.source import open_regular
from relay_autotune.errors import BagError, RelayAutotuneError
from relay_autotune.escape import visible
from relay_autotune.identification import Estimate, FitReport, Identification
from relay_autotune.identification.combinations import Combination
from relay_autotune.identification.judgement.validation import DIFFERENCES, Validation
from relay_autotune.identification.result import Rival
from relay_autotune.identification.shown.fourier import FrequencyPoint
from relay_autotune.loop.gains import NUMBERS
from relay_autotune.process.structures import GENERAL, GivenModel, structure_of
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.cycles import LimitCycle
from relay_autotune.record.record import Outcome, RelaySettings
from relay_autotune.report.case import Case, around, measured_points, model_case
from relay_autotune.tuning import Gains
from relay_autotune.verdict import (
    NOT_JUDGED,
    Finding,
    Judgement,
    Result,
    Verdict,
    verdict_named,
)

FloatArray = NDArray[np.float64]

# Bytes of a file of results, and cycles of an experiment in it.
_LARGEST = 64 << 20
_MOST_CYCLES = 1_000_000


def read_documents(path: Path | str) -> tuple[Case, ...]:
    """Return the experiments of a file of documents, one on each line or a single one.

    :param path: a file that `replay --json` or the demo wrote.
    :raises BagError: if it cannot be read or is no such document.
    """
    with open_regular(Path(path)) as file:
        raw = file.read(_LARGEST + 1)
    if len(raw) > _LARGEST:
        raise BagError(f"{path} has more than {_LARGEST} bytes; expected a result of `replay`")
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        raise BagError(f"{path} is no JSON: it is not in UTF-8") from None
    documents = _parsed(text, str(path))
    return tuple(case for document in documents for case in cases_of_document(document, str(path)))


def _parsed(text: str, name: str) -> list[Any]:
    if not text.strip():
        raise BagError(f"{name} is no JSON: it is empty; expected what `replay --json` prints")
    try:
        try:
            return [json.loads(text)]
        except ValueError:
            return [json.loads(line) for line in text.splitlines() if line.strip()]
    except (ValueError, RecursionError) as error:
        raise BagError(
            f"{name} is no JSON: {error}; expected what `replay --json` prints"
        ) from error


def cases_of_document(document: Any, name: str) -> tuple[Case, ...]:
    """Return the experiments of one document.

    :param document: as `json` reads it.
    :param name: of its file, for messages.
    :raises BagError: if it is no such document.
    """
    try:
        document = _visible(document)
        if "error" in document:
            return (_unreadable(str(document["bag"]), str(document["error"])),)
        truth = _model(document["truth"]) if "truth" in document else None
        return tuple(_case(e, str(document["bag"]), truth) for e in document["experiments"])
    except (RelayAutotuneError, LookupError, TypeError, ValueError, AttributeError,
            ArithmeticError, RecursionError, MemoryError) as error:  # fmt: skip
        what = f"no field {error}" if isinstance(error, KeyError) else visible(str(error))
        raise BagError(
            f"{name} is no result of an experiment ({what}); expected what `replay --json` prints"
        ) from error


def _visible(value: Any) -> Any:
    """Return a value with the texts in it made visible."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, list):
        return [_visible(item) for item in value]
    if isinstance(value, dict):
        return {visible(name): _visible(item) for name, item in value.items()}
    return value


def _unreadable(source: str, error: str) -> Case:
    return Case(source, "", 0.0, 0.0, Outcome.UNKNOWN, f"The recording was not read: {error}")


def _case(e: dict[str, Any], source: str, truth: TransferFunction | None) -> Case:
    cycle = e["limit_cycle"]
    models = tuple(_identification(m) for m in e["models"])
    gains = tuple(_gains(g) for g in e["gains"])
    selected = _index(e["selected"], models)
    return Case(
        source=source,
        experiment_id=str(e["experiment_id"]),
        start=_number(e["start"]),
        duration=_number(e["duration"]),
        outcome=Outcome[str(e["outcome"]).upper()],
        reason=str(e["reason"]),
        models=tuple(model_case(m, truth) for m in models),
        selected=selected,
        gains=gains,
        recommended=_index(e["recommended"], gains),
        limit_cycle=None if cycle is None else _limit_cycle(cycle),
        samples=int(e["samples"]),
        lost_samples=int(e["lost_samples"]),
        settings=None if e["relay"] is None else _settings(e["relay"]),
        models_around=around(None if selected is None else models[selected]),
        added_delay=_number(e.get("added_delay", 0.0)),
        points=measured_points(models),
        judgement=_judgement(e),
    )


def _judgement(e: dict[str, Any]) -> Judgement:
    """Return what a document says of an experiment; one without a verdict was not judged."""
    verdict = verdict_named(str(e.get("verdict", "unknown")))
    if verdict is Verdict.UNKNOWN:
        return NOT_JUDGED
    found = Judgement(tuple(_finding(f) for f in e["checks"]))
    if verdict is Verdict.NONE and not found.contradicted:
        found = replace(found, refused=str(e["verdict_reason"]))
    return found


def _finding(f: dict[str, Any]) -> Finding:
    texts: dict[str, Any] = {
        n: str(f[n]) for n in ("name", "title", "what", "unit", "sentence", "remedy")
    }
    numbers: dict[str, Any] = {
        n: math.inf if f[n] is None else float(f[n]) for n in ("value", "limit")
    }
    return Finding(result=Result[str(f["result"]).upper()], **texts, **numbers)


def _index(value: Any, things: Sequence[object]) -> int | None:
    if value is not None and not 0 <= int(value) < len(things):
        raise ValueError(f"index {value} of {len(things)}")
    return None if value is None else int(value)


def _settings(relay: dict[str, Any]) -> RelaySettings:
    values = {name: _number(value) for name, value in relay.items()}
    return RelaySettings(**values | {"reverse_acting": bool(relay["reverse_acting"])})  # type: ignore[arg-type]


def _limit_cycle(c: dict[str, Any]) -> LimitCycle:
    numbers: dict[str, Any] = {
        field.name: _number(c[field.name])
        for field in fields(LimitCycle)
        if field.name not in ("std", "cycles", "converged")
    }
    if not 0 <= int(c["cycles"]) <= _MOST_CYCLES:
        raise ValueError(f"{c['cycles']} cycles")
    cycles = tuple(range(int(c["cycles"])))
    return LimitCycle(**numbers, cycles=cycles, converged=bool(c["converged"]))


def _identification(m: dict[str, Any]) -> Identification:
    model, names = _model(m), tuple(map(_name, m["values"]))
    structure = structure_of(model, names)
    covariance = None
    # Where a parameter is tied to another one, only the method knows how.
    if not isinstance(structure, GivenModel) and m["covariance"] is not None:
        covariance = np.array(m["covariance"], dtype=float).reshape(len(names), len(names))
    values = np.array([_number(v) for v in m["values"].values()])
    ends = np.array([[_number(end) for end in m["ci95"][n]] for n in names]).reshape(-1, 2)
    return Identification(
        method=_name(m["method"]),
        estimate=Estimate.of(structure, values, covariance),
        ci95_low=ends[:, 0],
        ci95_high=ends[:, 1],
        ultimate_gain=_number(m["ultimate_gain"]),
        ultimate_gain_std=_number(m["ultimate_gain_std"]),
        ultimate_frequency=_number(m["ultimate_frequency"]),
        ultimate_frequency_std=_number(m["ultimate_frequency_std"]),
        fit=FitReport(
            **{f.name: _number(m["fit"][f.name]) for f in fields(FitReport) if f.name in m["fit"]}
        ),
        warnings=tuple(map(str, m["warnings"])),
        undetermined=tuple(map(str, m["undetermined"])),
        rivals=tuple(_rival(r) for r in m["rivals"]),
        validation=_validation(m.get("validation")),
        points=tuple(_point(p) for p in m.get("points", ())),
        integrated_error=_number(m.get("integrated_error")),
        combinations=tuple(_combination(c) for c in m.get("combinations", ())),
        advice=tuple(map(str, m.get("advice", ()))),
    )


def _rival(r: dict[str, Any]) -> Rival:
    return Rival(Estimate.of_model(_model(r)), _number(r["support"]))


def _validation(v: dict[str, Any] | None) -> Validation | None:
    if v is None:
        return None
    numbers = {name: _number(v[name]) for name in DIFFERENCES}
    return Validation(reason=str(v["reason"]), **numbers)


def _combination(c: dict[str, Any]) -> Combination:
    low, high = (_number(end) for end in c["ci95"])
    value, std = _number(c["value"]), _number(c["std"])
    return Combination(str(c["name"]), str(c["unit"]), value, std, low, high)


def _model(m: dict[str, Any]) -> TransferFunction:
    found = TransferFunction.from_polynomials(
        [_number(c) for c in m["numerator"]],
        [_number(c) for c in m["denominator"]],
        _number(m["dead_time"]),
        str(m.get("structure", GENERAL)),
    )
    constants = tuple(_complex(c) for c in m["time_constants"])
    zeros = tuple(_complex(c) for c in m["zeros"])
    # Roots of the polynomials would come back rounded.
    return TransferFunction(
        _number(m["gain"]), zeros, constants, found.integrators, found.dead_time, found.structure
    )


def _gains(g: dict[str, Any]) -> Gains:
    known = {field.name for field in fields(Gains)}
    values: dict[str, Any] = {}
    for name in known & g.keys():
        value = g[name]
        # Where no gain or delay makes the loop unstable, the document has null.
        if value is None:
            value = math.inf if name.endswith("_margin") else math.nan
        if name in NUMBERS:
            values[name] = _number(value)
        else:
            values[name] = tuple(map(str, value)) if isinstance(value, list) else str(value)
    _name(values["rule"])
    return Gains(**values)


def _point(p: dict[str, Any]) -> FrequencyPoint:
    value = complex(_number(p["real"]), _number(p["imaginary"]))
    return FrequencyPoint(_number(p["frequency"]), value, _number(p["std"]))


def _name(value: Any) -> str:
    """Return the name of a method, a rule or a parameter, which stand in figures."""
    if not isinstance(value, str) or not value.isidentifier():
        raise ValueError(f"{value!r} is no name")
    return value


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _complex(value: Any) -> complex:
    return complex(*map(float, value)) if isinstance(value, list) else complex(float(value))
