# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The content of a report about one experiment, from samples or from a document.

The documents that `replay --json` prints hold no samples.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from relay_autotune.bag.source import open_regular
from relay_autotune.errors import BagError, RelayAutotuneError
from relay_autotune.exchange.fields import number, of_document
from relay_autotune.exchange.models import judgement_of_fields, model_of_fields
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.limit_cycle.fourier import FrequencyPoint
from relay_autotune.identification.result import Identification
from relay_autotune.loop.analysis import performance_beside
from relay_autotune.loop.gains import Controller, Gains, Performance
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.cycles import LimitCycle, cycles_of, limit_cycle, settings_of
from relay_autotune.record.record import Cycle, Outcome, Record, RelaySettings
from relay_autotune.result import Analysis
from relay_autotune.text import is_unit, visible
from relay_autotune.tuning.ensemble import ensemble
from relay_autotune.verdict import NOT_JUDGED, Judgement

_T = TypeVar("_T")


@dataclass(frozen=True)
class EstimatedQuantity:
    """A quantity with its 95 % interval.

    :param name: of the quantity, as in the code.
    :param value: in ``unit``.
    :param low: lower end of the interval; NaN: not estimated.
    :param high: upper end.
    :param unit: "" for a pure number.
    :param determined: False if the data do not determine it.
    :param truth: the true value, if the process was simulated; NaN: not known.
    """

    name: str
    value: float
    low: float
    high: float
    unit: str
    determined: bool = True
    truth: float = math.nan

    @property
    def title(self) -> str:
        """The name with blanks for underscores."""
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class Case:
    """One experiment with its models and gains.

    :param source: the recording or document that it comes from.
    :param experiment_id: the id of its messages; may be empty.
    :param start: time of the first sample [s since the epoch]; 0: unknown.
    :param duration: s.
    :param outcome: how it ended.
    :param reason: why it ended so, or why there is no model or no gains.
    :param models: what each method found.
    :param model: the selected one of them; None: nothing was identified.
    :param gains: what each rule gives.
    :param best_gains: the recommended ones of them; None: there are none.
    :param limit_cycle: averages over its cycles; None: no whole cycle.
    :param samples: number of samples; 0: not known.
    :param lost_samples: number of samples that were sent and not received.
    :param record: the samples; None: not known.
    :param settings: of the relay; None: no relay, or not known.
    :param models_around: models within the uncertainty of the selected one.
    :param added_delay: dead time that the controller's loop adds to the process [s].
    :param judgement: what the checks found, and the verdict.
    :param present: the gains that are in the controller now; None: not known.
    :param proof: what a step has shown of gains: names and texts; empty: none was made.
    :param units: of the measurement, by "y", and of the command, by "u", as far as known.
    :param command: the command line that made the report; empty: not known.
    :param truth: the true process, if it was simulated.
    """

    source: str
    experiment_id: str = ""
    start: float = 0.0
    duration: float = 0.0
    outcome: Outcome = Outcome.UNKNOWN
    reason: str = ""
    models: tuple[Identification, ...] = ()
    model: Identification | None = None
    gains: tuple[Gains, ...] = ()
    best_gains: Gains | None = None
    limit_cycle: LimitCycle | None = None
    samples: int = 0
    lost_samples: int = 0
    record: Record | None = None
    settings: RelaySettings | None = None
    models_around: tuple[TransferFunction, ...] = ()
    added_delay: float = 0.0
    judgement: Judgement = NOT_JUDGED
    present: Controller | None = None
    proof: tuple[tuple[str, str], ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    command: str = ""
    truth: TransferFunction | None = None

    @property
    def cycles(self) -> tuple[Cycle, ...]:
        """The whole cycles; empty where there are no samples."""
        return () if self.record is None else cycles_of(self.record)

    @property
    def points(self) -> tuple[FrequencyPoint, ...]:
        """Points of the frequency response, by Fourier integrals over the cycles."""
        return next((m.points for m in self.models if m.points), ())

    @property
    def parameters(self) -> tuple[EstimatedQuantity, ...]:
        """The parameters of the selected model."""
        return () if self.model is None else parameters_of(self.model, self.truth)

    @property
    def ultimate(self) -> tuple[EstimatedQuantity, ...]:
        """K_u and w_u of the selected model, empty where it has none."""
        return () if self.model is None else ultimate_of(self.model, self.truth)

    @cached_property
    def present_does(self) -> Performance | None:
        """What the present gains do on the model; None: one is not known, or an unstable loop."""
        if self.model is None or self.present is None:
            return None
        return performance_beside(
            self.present, self.best_gains, self.model.model, self.added_delay
        )


def in_loop(case: Case, model: TransferFunction) -> TransferFunction:
    """Return a process with the dead time that the controller's loop adds to it.

    :param case: the experiment.
    :param model: the process.
    """
    return replace(model, dead_time=model.dead_time + case.added_delay)


def case_of(analysis: Analysis, source: str, *, truth: TransferFunction | None = None) -> Case:
    """Return the case of an analysed record.

    :param analysis: of the record.
    :param source: name of the recording.
    :param truth: the true process, if it was simulated.
    """
    record, shaping = analysis.record, analysis.shaping
    # Those of the design, if there was one.
    models = around(analysis.model) if shaping is None else shaping.task.models
    return Case(
        source=source,
        experiment_id=record.experiment_id,
        start=record.start,
        duration=record.duration,
        outcome=record.outcome,
        reason=analysis.reason or record.reason,
        models=analysis.models,
        truth=truth,
        model=analysis.model,
        gains=analysis.gains,
        best_gains=analysis.best_gains,
        limit_cycle=limit_cycle(analysis.cycles) if analysis.cycles else None,
        samples=len(record),
        lost_samples=record.lost_samples,
        record=record,
        settings=settings_of(record),
        models_around=models,
        added_delay=analysis.added_delay,
        judgement=analysis.judgement,
        units=record.units,
    )


def around(model: Identification | None) -> tuple[TransferFunction, ...]:
    """Return models within the uncertainty of the selected one; empty: it is not known.

    :param model: the selected model; None: there is none.
    """
    # The same seed as in the analysis, so that the band shows the models that it judged.
    return () if model is None else ensemble(model, rng=np.random.default_rng(0))


def parameters_of(
    found: Identification, truth: TransferFunction | None = None
) -> tuple[EstimatedQuantity, ...]:
    """Return the parameters of a model with their intervals.

    :param found: the result of one method.
    :param truth: the true process, if it was simulated.
    """
    low, high = found.ci95_low, found.ci95_high
    structure = found.estimate.structure
    return tuple(
        EstimatedQuantity(
            p.name, float(value), float(low[i]), float(high[i]), structure.unit(p),
            p.name not in found.undetermined, true_value(p.name, found.model, truth),
        )
        for i, (p, value) in enumerate(zip(structure.parameters, found.values, strict=True))
    )  # fmt: skip


def given_model(model: TransferFunction) -> Identification:
    """Return a model of which nothing was measured.

    :param model: the transfer function.
    """
    nothing = np.empty(0)
    return Identification("given", Estimate.of_model(model), nothing, nothing)


def true_value(parameter: str, model: TransferFunction, truth: TransferFunction | None) -> float:
    """Return the true value of a parameter; NaN: not known, or not comparable.

    :param parameter: its name.
    :param model: the identified transfer function.
    :param truth: the process, of the same kind as the model.
    """
    if truth is None or _kind(truth) != _kind(model):
        return math.nan
    # An unstable process has K and tau > 0 as parameters, and both negated in the model.
    sign = -1.0 if model.structure.startswith("unstable") else 1.0
    if parameter == "time_constant" and len(set(truth.time_constants)) == 1:
        return sign * truth.time_constants[0].real
    return {"gain": sign * truth.gain, "dead_time": truth.dead_time}.get(parameter, math.nan)


def _kind(model: TransferFunction) -> tuple[int, int, int, bool]:
    """Return what two models of one structure have in common; a document's truth has no name."""
    return len(model.time_constants), len(model.zeros), model.integrators, model.grows


def ultimate_of(
    found: Identification, truth: TransferFunction | None = None
) -> tuple[EstimatedQuantity, ...]:
    """Return K_u and w_u with their intervals; nothing where the model has none.

    :param found: the result of one method.
    :param truth: the true process, if it was simulated.
    """
    if not math.isfinite(found.ultimate_gain):
        return ()
    true = ultimate_point(truth) if truth is not None else None
    gain, frequency = (math.nan, math.nan) if true is None else (true.gain, true.frequency)
    rows = []
    for name, unit, t in (("gain", "u/y", gain), ("frequency", "rad/s", frequency)):
        value, std = (getattr(found, f"ultimate_{name}{end}") for end in ("", "_std"))
        low, high = value - NORMAL_95 * std, value + NORMAL_95 * std
        rows.append(EstimatedQuantity(f"ultimate_{name}", value, low, high, unit, truth=t))
    return tuple(rows)


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
            return (unreadable(str(document["bag"]), str(document["error"])),)
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


def unreadable(source: str, error: str) -> Case:
    """Return the case of a recording that gave nothing.

    :param source: its name.
    :param error: why, a sentence.
    """
    return Case(source, reason=f"The recording was not read: {error}")


def _case(e: dict[str, Any], source: str, truth: TransferFunction | None) -> Case:
    cycle = e["limit_cycle"]
    models = tuple(of_document(Identification, m) for m in e["models"])
    gains = tuple(of_document(Gains, g) for g in e["gains"])
    model = _chosen(e["selected"], models)
    return Case(
        source=source,
        experiment_id=str(e["experiment_id"]),
        start=number(e["start"]),
        duration=number(e["duration"]),
        outcome=Outcome[str(e["outcome"]).upper()],
        reason=str(e["reason"]),
        models=models,
        truth=truth,
        model=model,
        gains=gains,
        best_gains=_chosen(e["recommended"], gains),
        limit_cycle=None if cycle is None else _limit_cycle(cycle),
        samples=int(e["samples"]),
        lost_samples=int(e["lost_samples"]),
        settings=None if e["relay"] is None else of_document(RelaySettings, e["relay"]),
        models_around=around(model),
        added_delay=number(e.get("added_delay", 0.0)),
        judgement=judgement_of_fields(e),
        units={n: str(u) for n, u in e.get("units", {}).items() if is_unit(str(u))},
    )


def _chosen(index: Any, things: Sequence[_T]) -> _T | None:
    if index is None:
        return None
    if not 0 <= int(index) < len(things):
        raise ValueError(f"index {index} of {len(things)}")
    return things[int(index)]


def _limit_cycle(c: dict[str, Any]) -> LimitCycle:
    # Documents have the number of cycles alone.
    if not 0 <= int(c["cycles"]) <= _MOST_CYCLES:
        raise ValueError(f"{c['cycles']} cycles")
    return of_document(LimitCycle, c, cycles=tuple(range(int(c["cycles"]))))
