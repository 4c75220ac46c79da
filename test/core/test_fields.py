# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Every field of every result comes back from a document and from a message."""

import json
import math
import string
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_origin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relay_autotune.errors import RelayAutotuneError, TuningError
from relay_autotune.exchange.fields import of_document, of_message, to_document, to_message
from relay_autotune.exchange.messages import gains_from_message, identification_from_message
from relay_autotune.exchange.models import judgement_fields, judgement_of_fields
from relay_autotune.experiment.early_end import FitProgress
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.limit_cycle.fourier import FrequencyPoint
from relay_autotune.identification.result import (
    Combination,
    FitReport,
    Identification,
    Rival,
    Validation,
)
from relay_autotune.loop.gains import Gains, Performance
from relay_autotune.process.factors import Quadratic
from relay_autotune.process.structures import TABLE, Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import ResultField, result_fields
from relay_autotune.record.cycles import LimitCycle
from relay_autotune.record.record import Cycle, RelaySettings
from relay_autotune.verdict import Finding, Judgement, Result
from tools.attribute_docs import attribute_docs

ROOT = Path(__file__).resolve().parents[2]
RESULTS = (
    *(Identification, FitReport, Validation, FrequencyPoint, Combination, Rival),
    *(Gains, Performance, Finding, RelaySettings, LimitCycle, Cycle, FitProgress),
)
# As long as the record, what is told by other fields of the document, and another model.
UNTOLD = {
    *(
        (Identification, name)
        for name in (
            "fitted",
            "effects",
            "middle",
            "ends",
            "play",
            "friction",
            "began_away",
            "moved_before",
            "loaded",
            "to_explain",
            "parts",
            "opposed",
            "rate",
            "plain",
        )
    ),
    (LimitCycle, "period_std"),
}
POSITIVE = st.floats(1e-3, 1e3)
# What is unprintable comes back visible.
TEXTS = st.text(max_size=5).filter(str.isprintable)
WORDS = st.text(string.ascii_lowercase, min_size=1, max_size=5)


def numbers(each: ResultField) -> st.SearchStrategy[float]:
    low, high = max(each.lower, -1e6), min(each.upper, 1e6)
    inside = st.floats(low, high, allow_nan=False)
    extra = [math.inf] if math.isinf(each.null) else []
    extra += [math.nan] if each.nan and math.isnan(each.null) else []
    return inside | st.sampled_from(extra) if extra else inside


@st.composite
def estimates(draw: Any) -> Estimate:
    structure: Structure = draw(st.sampled_from(list(TABLE.values())))
    if structure.any_order:
        structure = structure.of_order(draw(st.integers(1, 6)))
    elif structure.either:
        structure = structure.form(draw(st.booleans()))
    values = [draw(POSITIVE) for _ in structure.parameters]
    lags = [i for i, p in enumerate(structure.parameters) if p.name.startswith("time_constant_")]
    for i, value in zip(lags, sorted((values[i] for i in lags), reverse=True), strict=True):
        values[i] = value
    if any(
        isinstance(f, Quadratic) and f.parameters[1].name == "damping" for f in structure.factors
    ):
        values[structure.names.index("damping")] = draw(st.floats(0.05, 0.95))
    root = np.array([[draw(st.floats(-1.0, 1.0)) for _ in values] for _ in values])
    covariance = root @ root.T
    if draw(st.booleans()):
        # Not estimated, but for what is known of each value alone.
        covariance = np.where(np.eye(len(values)) > 0.0, covariance, math.nan)
        covariance = covariance if draw(st.booleans()) else covariance * math.nan
    return Estimate(structure, np.array(values), covariance)


@st.composite
def results(draw: Any, kind: Any) -> Any:
    if kind is Estimate:
        return draw(estimates())
    if kind is TransferFunction:
        return draw(estimates()).model
    if kind is Rival:
        # Documents have the model of a rival alone.
        alone = Estimate.of_model(draw(estimates()).model)
        return Rival(alone, draw(st.floats(0.0, 1.0)))
    if kind is FitProgress:
        return FitProgress(
            draw(POSITIVE), draw(POSITIVE), 1.5, 1.2, draw(st.floats(1.5, math.inf))
        )
    found: dict[str, Any] = {}
    for each in (f for f in result_fields(kind) if not f.derived):
        inner = [a for a in get_args(each.kind) if a not in (type(None), ...)]
        if get_origin(each.kind) is np.ndarray:
            size = found["estimate"].values.size
            held: Any = np.array([draw(st.floats(-1e3, 1e3)) for _ in range(size)])
        elif get_origin(each.kind) is tuple and inner == [str]:
            held = tuple(draw(st.lists(TEXTS, max_size=3)))
        elif get_origin(each.kind) is tuple and inner == [int]:
            held = tuple(range(draw(st.integers(0, 9))))
        elif get_origin(each.kind) is tuple:
            held = tuple(draw(st.lists(results(inner[0]), max_size=3)))
        elif inner:
            held = draw(st.none() | results(inner[0]))
            # A comparison without a number stands for no comparison.
            held = None if repr(held) == repr(Validation()) else held
        elif each.kind is float:
            held = draw(numbers(each))
        elif each.kind is str:
            held = draw(WORDS if each.word else TEXTS)
        elif each.kind is complex:
            held = complex(draw(POSITIVE), -draw(POSITIVE))
        elif each.kind is bool:
            held = draw(st.booleans())
        elif each.kind is int:
            held = draw(st.integers(0, 100))
        elif each.kind is Result:
            held = draw(st.sampled_from(Result))
        else:
            held = draw(results(each.kind))
        found[each.name] = held
    if kind is Gains:
        found["kc"] = found["kc"] or 1.0
    return kind(**found)


def assert_same(back: Any, value: Any, close: bool = False) -> None:
    assert type(back) is type(value)
    if isinstance(value, Estimate):
        assert back.structure.name == value.structure.name
        assert back.structure.names == value.structure.names
        tolerance = 1e-6 if close else 0.0
        assert np.allclose(back.values, value.values, rtol=tolerance, atol=0.0)
        assert np.array_equal(back.covariance, value.covariance, equal_nan=True) or (
            # Where only part of it is known, documents have the standard deviations.
            np.array_equal(back.std, value.std, equal_nan=True)
            and not np.all(np.isfinite(value.covariance))
        )
        if not close:
            assert back.model == value.model
    elif isinstance(value, np.ndarray):
        assert np.array_equal(back, value, equal_nan=True)
    elif isinstance(value, tuple):
        assert len(back) == len(value)
        for one, other in zip(back, value, strict=True):
            assert_same(one, other, close)
    elif hasattr(value, "__dataclass_fields__"):
        for each in result_fields(type(value)):
            assert_same(getattr(back, each.name), getattr(value, each.name), close)
    else:
        assert back == value or (value != value and back != back)


@pytest.mark.parametrize("kind", RESULTS)
def test_every_field_of_a_result_is_declared(kind):
    declared = {each.name for each in result_fields(kind)}
    assert {f.name for f in fields(kind) if (kind, f.name) not in UNTOLD} <= declared
    said = {name for base in kind.__mro__[:-1] for name in attribute_docs(base)}
    # A property has a docstring of its own.
    assert {each.name for each in result_fields(kind) if not each.derived} <= said


@pytest.mark.long
@pytest.mark.parametrize("kind", [k for k in RESULTS if k not in (LimitCycle, Cycle, FitProgress)])
@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_a_result_comes_back_from_its_document(kind, data):
    value = data.draw(results(kind))
    document = json.loads(json.dumps(to_document(value), allow_nan=False))
    back = of_document(kind, document)
    assert_same(back, value)
    assert to_document(back) == to_document(value)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_a_limit_cycle_comes_back_with_the_number_of_its_cycles(data):
    value = data.draw(results(LimitCycle))
    document = json.loads(json.dumps(to_document(value)))
    assert_same(of_document(LimitCycle, document, cycles=value.cycles), value)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(value=results(Identification))
def test_an_identification_comes_back_from_its_message(value):
    message = SimpleNamespace()
    to_message(message, value)
    back = identification_from_message(message)
    for each in (f for f in result_fields(Identification) if f.message is not None):
        assert_same(getattr(back, each.name), getattr(value, each.name), close=True)


@settings(max_examples=25, deadline=None)
@given(value=results(Gains))
def test_gains_come_back_from_their_message(value):
    message = SimpleNamespace()
    to_message(message, value)
    back = gains_from_message(message)
    for each in (f for f in result_fields(Gains) if f.message is not None):
        assert_same(getattr(back, each.name), getattr(value, each.name))


@pytest.mark.parametrize("kind", [RelaySettings, FitProgress])
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_what_the_relay_did_and_found_comes_back_from_its_message(kind, data):
    value, message = data.draw(results(kind)), SimpleNamespace()
    to_message(message, value)
    assert_same(of_message(kind, message, RelayAutotuneError, "of the relay"), value)


@settings(max_examples=25, deadline=None)
@given(
    findings=st.lists(results(Finding), max_size=4),
    refused=st.none() | st.text(min_size=1, max_size=5),
    judged=st.booleans(),
)
def test_a_judgement_comes_back(findings, refused, judged):
    value = Judgement(tuple(findings), refused or "") if judged else Judgement(judged=False)
    document = json.loads(json.dumps(judgement_fields(value)))
    back = judgement_of_fields(document)
    assert (back.verdict, back.reason) == (value.verdict, value.reason)
    assert_same(back.findings, value.findings)


def value_of(kind):
    numbers = {f.name: 1.0 for f in result_fields(kind) if f.kind is float and not f.derived}
    if kind is Gains:
        return Gains(**numbers, rule="robust", reason="")
    if kind is Identification:
        estimate = Estimate.of(TABLE["fopdt"], np.ones(3))
        return Identification("waveform", estimate, np.ones(3), np.ones(3))
    return kind(**numbers) if kind is RelaySettings else kind(**numbers, index=0)


# What the nodes write beside results: whose they are, and the samples.
ENVELOPE = {"header", "experiment_id", "final", "verdict", "verdict_reason", "verdict_why"}
SAMPLES = {"settings", "lead_in", "time", "measurement", "command"}


@pytest.mark.parametrize(
    ("name", "parts", "beside"),
    [
        ("TransferFunction", (FitProgress(), value_of(Identification)), ENVELOPE),
        ("PidGains", (value_of(Gains),), ENVELOPE),
        ("RelaySettings", (value_of(RelaySettings),), set()),
        ("RelayCycle", (value_of(Cycle),), ENVELOPE | SAMPLES),
    ],
)
def test_a_message_has_the_fields_that_results_declare_and_no_others(name, parts, beside):
    text = (ROOT / f"relay_autotune_msgs/msg/{name}.msg").read_text()
    lines = [line.partition("#")[0].split() for line in text.splitlines()]
    told = {line[1] for line in lines if len(line) == 2}
    message = SimpleNamespace()
    for part in parts:
        to_message(message, part)
    assert set(vars(message)) <= told
    assert told - set(vars(message)) <= beside


@pytest.mark.parametrize("each", [f for f in result_fields(Gains) if f.derived])
def test_a_number_that_follows_from_others_may_not_contradict_them(each):
    gains = value_of(Gains)
    message = SimpleNamespace()
    to_message(message, gains)
    setattr(message, each.name, 2.0 * getattr(gains, each.name))
    with pytest.raises(TuningError, match=f"{each.name} of the gains is"):
        gains_from_message(message)
