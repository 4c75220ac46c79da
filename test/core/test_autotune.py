# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The one path from a record to gains: never an exception, gains only where they are due."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from analysed import analysed_once, identified_once
from hypothesis import given, settings
from hypothesis import strategies as st
from sampled_relay import simulate_sampled_relay

from relay_autotune.analysis import Task, analyse, analyse_jointly, model_so_far
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.judgement.disturbance import last_cycles
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Outcome, Record, RelaySettings
from relay_autotune.result import Analysis
from relay_autotune.tuning import RULES


def _record(seed: int = 0, noise: float = 0.02) -> Record:
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    relay = RelaySettings(5.0, 40.0, 1.0, 0.3, 0.1)
    draws = noise * np.random.default_rng(seed).standard_normal(900)
    return simulate_sampled_relay(model, relay, period=0.2, noise=draws)


@cache
def _told(method: str, rule: str) -> tuple[Analysis, list[str]]:
    told: list[str] = []
    with patch("relay_autotune.analysis.identify", identified_once):
        return analyse(_record(), method=method, rule=rule, tell=told.append), told


def _analysed(method: str = "waveform", rule: str = "robust") -> Analysis:
    return _told(method, rule)[0]


@pytest.mark.long
def test_a_completed_experiment_yields_models_and_gains():
    found, told = _told("waveform", "robust")
    stages = "comparing structures", "comparing methods", "judging the model"
    assert told == [*stages, "designing the gains"]
    assert found.reason == ""
    assert found.model.method == "waveform"
    assert [m.method for m in found.models] == ["waveform", "wang_biased", "fourier"]
    assert found.best_gains.rule == "robust"
    for_fopdt = {"thyagarajan", "tyreus_luyben", "itae", "imc", "simc", "amigo"}
    assert for_fopdt <= {g.rule for g in found.gains} <= set(RULES)
    assert not {"luyben2003", "unstable"} & {g.rule for g in found.gains}
    assert len(found.cycles) >= 3


@pytest.mark.nightly
def test_the_chosen_method_and_rule_come_first():
    found = _analysed("wang_biased", "imc")
    assert found.model.method == "wang_biased"
    assert found.best_gains.rule == "imc"


@pytest.mark.long
@pytest.mark.parametrize("outcome", [Outcome.ABORTED, Outcome.FAILED])
def test_an_experiment_that_did_not_complete_yields_no_gains(outcome):
    ended = replace(_record(), outcome=outcome, reason="the operator said stop")
    found = analysed_once(ended, known=Known(structure="fopdt"))
    assert found.model is not None
    assert found.gains == ()
    assert found.best_gains is None
    assert "the operator said stop" in found.reason


@pytest.mark.long
def test_while_it_runs_there_is_a_model_and_no_gains():
    found = model_so_far(_record(), Task(known=Known(structure="fopdt")))
    assert found.model is not None
    assert len(found.models) == 1
    assert found.gains == ()


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "rule"),
    [pytest.param("waveform", "robust", marks=pytest.mark.nightly), ("wang_biased", "imc")],
)
def test_alone_they_are_what_they_are_beside_others(method, rule):
    beside = _analysed(method, rule)
    alone = analyse(_record(), method=method, rule=rule, alone=True)
    assert [m.method for m in alone.models] == [method]
    # Equal records give equal numbers.
    assert alone.model.values.tolist() == beside.model.values.tolist()
    assert alone.model.covariance.tolist() == beside.model.covariance.tolist()
    assert alone.judgement == beside.judgement
    assert alone.model.fit.residual_rms == beside.model.fit.residual_rms
    assert alone.gains == (beside.best_gains,)
    assert alone.added_delay == beside.added_delay


def test_data_that_tell_nothing_are_a_reason():
    record = _record()
    constant = replace(record, measurement=np.full(len(record), 5.0))
    found = analyse(constant)
    assert found.model is None
    assert found.gains == ()
    assert "constant" in found.reason


@pytest.mark.nightly
def test_a_rule_that_does_not_apply_says_so():
    found = analyse(_record(), rule="itae")
    assert found.best_gains.rule == "itae"
    short = simulate_sampled_relay(
        TransferFunction.fopdt(1.0, 10.0, 0.3),
        RelaySettings(0.0, 0.0, 1.0, 0.2, 0.0),
        period=0.01,
        noise=np.zeros(900),
    )
    refused = analyse(short, rule="itae")
    assert refused.model is not None
    assert refused.gains == ()
    assert "ITAE" in refused.reason


def test_unknown_names_are_refused_at_once():
    with pytest.raises(RelayAutotuneError, match="unknown method"):
        analyse(_record(), method="magic")
    with pytest.raises(RelayAutotuneError, match="unknown rule"):
        analyse(_record(), rule="magic")


@pytest.mark.long
@pytest.mark.parametrize("kind", ["noise", "two level", "constant", "ramp", "huge", "walk"])
@settings(deadline=None, max_examples=3)
@given(
    seed=st.integers(0, 1000),
    samples=st.integers(1, 60),
    outcome=st.sampled_from(list(Outcome)),
)
def test_no_record_raises(kind, seed, samples, outcome):
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0, 10.0, samples))
    y = {
        "noise": rng.standard_normal(samples),
        "walk": 1e-6 * np.cumsum(rng.standard_normal(samples)),
        "ramp": time * 3.0,
        "constant": np.full(samples, 2.0),
        "two level": np.sign(rng.standard_normal(samples)),
        "huge": 1e150 * rng.standard_normal(samples),
    }[kind]
    command = np.sign(np.sin(3.0 * time))
    found = analyse(Record(time, y, command, outcome=outcome))
    assert found.reason or found.gains
    if found.model is not None:
        named = dict(zip(found.model.parameters, found.model.values, strict=True))
        assert all(map(math.isfinite, named.values()))
        assert named.pop("dead_time") >= 0.0
        assert all(v > 0.0 for n, v in named.items() if n.startswith("time_constant"))
    if outcome in (Outcome.ABORTED, Outcome.FAILED):
        assert found.gains == ()


def _beginning(record: Record, samples: int) -> Record:
    return replace(
        record,
        time=record.time[:samples],
        measurement=record.measurement[:samples],
        command=record.command[:samples],
        receive_time=record.receive_time[:samples],
        command_time=record.command_time[:samples],
        cycle_start=tuple(s for s in record.cycle_start if s < samples),
    )


@pytest.mark.nightly
def test_a_running_test_forgets_a_disturbance_of_its_beginning():
    """While the model contradicts the record there is no interval to end the test on."""
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    relay = RelaySettings(5.0, 40.0, 1.0, 0.3, 0.1)
    draws = 0.02 * np.random.default_rng(0).standard_normal(1200)
    draws[150:200] += 1.0
    whole = simulate_sampled_relay(model, relay, period=0.2, noise=draws)
    record = replace(whole, noise_std=0.02)
    for disturbed in (record, replace(record, noise_std=np.nan)):
        found = model_so_far(_beginning(disturbed, 300)).model
        assert found is not None
        assert np.isnan(found.ultimate_gain_std)
    calm = replace(_record(noise=0.2), noise_std=np.nan)
    found = model_so_far(_beginning(calm, 300)).model
    assert found is not None
    assert found.ultimate_gain_std > 0.0
    found = model_so_far(record).model
    assert found is not None
    assert found.ultimate_gain == pytest.approx(2.3069, rel=0.01)
    assert found.ultimate_gain_std < 0.01 * found.ultimate_gain


@pytest.mark.long
def test_the_end_of_a_disturbed_record_remembers_what_drove_the_process_before():
    """A slow process still answers the commands of the cycles that are left out."""
    slow = TransferFunction.sopdt(1.0, (60.0, 3.0), 3.0)
    draws = 0.02 * np.random.default_rng(2).standard_normal(1500)
    draws[150:220] += 0.5
    relay = RelaySettings(0.0, 0.0, 1.0, 0.3, 0.1)
    whole = replace(simulate_sampled_relay(slow, relay, period=0.2, noise=draws), noise_std=0.02)
    end = last_cycles(whole)
    assert end is not None
    origin = whole.time[len(whole) - len(end)]
    earlier = end.time - 50.0
    np.testing.assert_array_equal(end.input()(earlier), whole.input()(earlier + origin))
    found = identify(end, known=Known(structure="sopdt"))
    assert found.ultimate_gain == pytest.approx(ultimate_point(slow).gain, rel=0.2)


def test_times_that_no_clock_gives_are_refused_as_a_wrong_unit():
    record = _record()
    wrong = Record(
        time=1e-10 * record.time, measurement=record.measurement, command=record.command
    )
    assert analyse(wrong).best_gains is None
    assert "check the unit of the time" in analyse(wrong).reason
    assert "check the unit of the time" in analyse_jointly([wrong, wrong]).reason
