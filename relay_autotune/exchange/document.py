# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The result of a recording as one JSON document, as `replay --json` prints it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.exchange import models  # noqa: F401  (it says how models are written)
from relay_autotune.exchange.fields import json_number, of_document, to_document
from relay_autotune.identification.limit_cycle.shape import shape_of_record
from relay_autotune.record.cycles import limit_cycle, settings_of
from relay_autotune.record.record import Outcome, Record
from relay_autotune.verdict import NOT_JUDGED, Finding, Judgement, Verdict, verdict_named

if TYPE_CHECKING:
    from relay_autotune.result import Analysis

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
        "samples": len(record),
        "lost_samples": record.lost_samples,
        "relay": None if settings is None else to_document(settings),
        "limit_cycle": _limit_cycle(analysis),
        "models": [to_document(model) for model in analysis.models],
        "selected": analysis.selected,
        "gains": [to_document(gains) for gains in analysis.gains],
        "recommended": analysis.recommended,
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
