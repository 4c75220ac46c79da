# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What is said of every model: its residual, the relay test run again on it, its error."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from relay_runs import simulate_relay

from relay_autotune.cli.table import table
from relay_autotune.exchange.messages import fill_transfer_function
from relay_autotune.exchange.models import document, to_json
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.judgement.assessment import (
    assess,
    fit_of_model,
    integrated_error,
)
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import Validation
from relay_autotune.identification.waveform.residuals import noise_to_signal
from relay_autotune.process.response import response
from relay_autotune.process.structures import UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import result_fields
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings
from relay_autotune.result import Analysis
from relay_autotune.text import digits

MODEL = TransferFunction.fopdt(1.0, 2.0, 1.0)
RELAY = RelaySettings(3.0, 1.0, 1.0, 0.0, 0.1)
NOISE = 0.03


@pytest.fixture(scope="module")
def record() -> Record:
    run = simulate_relay(MODEL, RELAY, cycles=6, time=np.arange(0.0, 19.0, 0.02))
    return run.record(noise_std=NOISE, rng=np.random.default_rng(3))


@pytest.fixture(scope="module")
def models(record):
    found = [
        identify(record, name, Known(gain=1.0)) for name in ("wang_unbiased", "atv", "fourier")
    ]
    return assess(found, record)


@pytest.mark.long
def test_the_limit_cycle_of_each_model_is_compared(models):
    wang, atv, _ = models
    assert wang.validation.worst < 0.02
    # The describing function misses the amplitude of a FOPDT process by far.
    assert atv.validation.worst > 0.05
    assert math.isnan(wang.integrated_error)
    assert atv.integrated_error == integrated_error(atv.model, wang.model, wang.ultimate_frequency)


def test_each_model_has_a_fit_to_all_samples(models):
    wang, atv, _ = models
    assert wang.fit.residual_rms == pytest.approx(NOISE, rel=0.05)
    assert wang.fit.whiteness_p > 1e-3
    assert atv.fit.residual_rms > 1.5 * NOISE
    assert atv.fit.whiteness_p < 1e-6
    signal = simulate_relay(MODEL, RELAY, cycles=6, time=np.arange(0.0, 19.0, 0.02))
    away = signal.measurement - 3.0
    # The mean absolute value of Gaussian noise is sqrt(2/pi) of its standard deviation.
    ratio = NOISE * math.sqrt(2.0 / math.pi) / np.mean(np.abs(away))
    assert wang.fit.noise_to_signal == pytest.approx(ratio, rel=0.05)
    assert wang.fit.noise_to_signal_power == pytest.approx(NOISE**2 / np.mean(away**2), rel=0.1)


def test_both_ratios_by_hand():
    assert noise_to_signal(np.array([1.0, -1.0]), np.array([2.0, 4.0])) == (0.1, 1.0 / 3.0)
    assert np.all(np.isnan(noise_to_signal(np.ones(2), np.zeros(2))))


def test_an_unstable_model_follows_no_open_loop(record):
    fit = fit_of_model(UNSTABLE_FOPDT.build((1.0, 2.0, 0.3)), record, 3.0)
    assert math.isnan(fit.residual_rms)


def test_a_model_without_limit_cycle_says_so(record, models):
    wrong = replace(models[0], estimate=Estimate.of_model(TransferFunction.fopdt(-1.0, 2.0, 1.0)))
    against = assess((wrong,), record)[0]
    assert "against the direction" in against.validation.reason
    assert against.validation.worst == math.inf


def test_json_table_and_message_carry_all_of_it(record, models):
    analysis = Analysis(record, models=tuple(models))
    shown = json.loads(to_json(document("x", [analysis])))["experiments"][0]["models"]
    for model, fields in zip(models, shown, strict=True):
        for name in (f.name for f in result_fields(Validation)):
            assert fields["validation"][name] == getattr(model.validation, name)
        assert fields["fit"]["noise_to_signal_power"] == model.fit.noise_to_signal_power
        assert [p["frequency"] for p in fields["points"]] == [p.frequency for p in model.points]
    assert shown[0]["integrated_error"] is None
    assert shown[2]["points"][0]["imaginary"] == models[2].points[0].value.imag
    text = table("x", [analysis])
    assert "limit cycle" in text
    assert "% of the signal" in " ".join(text.split())
    worst = [digits(100.0 * model.validation.worst, 2) for model in models[:2]]
    assert f"limit cycle {worst[1]} % off instead of {worst[0]} %" in " ".join(text.split())
    header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0))
    message = SimpleNamespace(header=header, verdict_why=SimpleNamespace())
    fill_transfer_function(message, models[2])
    assert message.validation_shape == models[2].validation.shape
    assert list(message.point_std) == [p.std for p in models[2].points]
    assert message.prediction != message.prediction


def test_a_record_that_begins_with_its_first_step_is_reproduced():
    # The record has the command of before in no sample; the process was at rest there.
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    time = np.arange(0.0, 200.0, 0.5)
    true = PiecewiseConstant(np.array([0.0, 100.0]), np.array([33.0, 28.0]), initial=30.0)
    y = 50.0 + response(model, time, true) - 1.65 * 30.0
    record = Record(time, y, true(time))
    assert fit_of_model(model, record, 50.0).residual_rms < 1e-9
    other = TransferFunction.fopdt(1.65, 40.0, 10.0)
    assert fit_of_model(other, record, 50.0).residual_rms > 0.1
