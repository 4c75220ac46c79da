# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Cases from the JSON documents that `replay --json` prints, which hold no samples."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from relay_autotune.bag.source import open_regular
from relay_autotune.errors import BagError, RelayAutotuneError
from relay_autotune.escape import visible
from relay_autotune.exchange.document import judgement_of_fields
from relay_autotune.exchange.fields import number, of_document
from relay_autotune.exchange.models import model_of_fields
from relay_autotune.identification.result import Identification
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.cycles import LimitCycle
from relay_autotune.record.record import Outcome, RelaySettings
from relay_autotune.report.case import Case, around, measured_points, model_case
from relay_autotune.tuning import Gains

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
        raise BagError(f"{path} is not JSON: it is not in UTF-8") from None
    documents = _parsed(text, str(path))
    return tuple(case for document in documents for case in cases_of_document(document, str(path)))


def _parsed(text: str, name: str) -> list[Any]:
    if not text.strip():
        raise BagError(f"{name} is not JSON: it is empty; expected what `replay --json` prints")
    try:
        try:
            return [json.loads(text)]
        except ValueError:
            return [json.loads(line) for line in text.splitlines() if line.strip()]
    except (ValueError, RecursionError) as error:
        raise BagError(
            f"{name} is not JSON: {error}; expected what `replay --json` prints"
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
        truth = model_of_fields(document["truth"]) if "truth" in document else None
        return tuple(_case(e, str(document["bag"]), truth) for e in document["experiments"])
    except (RelayAutotuneError, LookupError, TypeError, ValueError, AttributeError,
            ArithmeticError, RecursionError, MemoryError) as error:  # fmt: skip
        what = f"no field {error}" if isinstance(error, KeyError) else visible(str(error))
        raise BagError(
            f"{name} is not a result of an experiment ({what}); expected what `replay --json` "
            "prints"
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
    models = tuple(of_document(Identification, m) for m in e["models"])
    gains = tuple(of_document(Gains, g) for g in e["gains"])
    selected = _index(e["selected"], models)
    return Case(
        source=source,
        experiment_id=str(e["experiment_id"]),
        start=number(e["start"]),
        duration=number(e["duration"]),
        outcome=Outcome[str(e["outcome"]).upper()],
        reason=str(e["reason"]),
        models=tuple(model_case(m, truth) for m in models),
        selected=selected,
        gains=gains,
        recommended=_index(e["recommended"], gains),
        limit_cycle=None if cycle is None else _limit_cycle(cycle),
        samples=int(e["samples"]),
        lost_samples=int(e["lost_samples"]),
        settings=None if e["relay"] is None else of_document(RelaySettings, e["relay"]),
        models_around=around(None if selected is None else models[selected]),
        added_delay=number(e.get("added_delay", 0.0)),
        points=measured_points(models),
        judgement=judgement_of_fields(e),
    )


def _index(value: Any, things: Sequence[object]) -> int | None:
    if value is not None and not 0 <= int(value) < len(things):
        raise ValueError(f"index {value} of {len(things)}")
    return None if value is None else int(value)


def _limit_cycle(c: dict[str, Any]) -> LimitCycle:
    # Documents have the number of cycles alone.
    if not 0 <= int(c["cycles"]) <= _MOST_CYCLES:
        raise ValueError(f"{c['cycles']} cycles")
    found: LimitCycle = of_document(LimitCycle, c, cycles=tuple(range(int(c["cycles"]))))
    return found
