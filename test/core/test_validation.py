# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The relay experiment run again on models, and the error measure of eqs 29 and 30."""

from __future__ import annotations

import math

import numpy as np
import pytest
from relay_runs import simulate_relay
from sampled_relay import simulate_sampled_relay
from worked_cases import cases

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.judgement.assessment import (
    integrated_error,
    validate,
    validate_fold,
)
from relay_autotune.identification.limit_cycle.fold import fold
from relay_autotune.identification.limit_cycle.fourier import SteadyState
from relay_autotune.process.structures import INTEGRATOR_INVERSE, UNSTABLE_FOPDT, structure_named
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record, RelaySettings

FOPDT = TransferFunction.fopdt(1.65, 20.0, 10.0)


def record_of(model, relay, cycles=6, samples=1200, noise_std=0.0):
    run = simulate_relay(model, relay, cycles=cycles, time=samples)
    return run.record(noise_std=noise_std, rng=np.random.default_rng(4))


@pytest.mark.long
@pytest.mark.parametrize(
    ("model", "relay"),
    [
        (FOPDT, RelaySettings(5.0, 40.0, 1.0, 0.0, 0.1)),
        (FOPDT, RelaySettings(5.0, 40.0, 1.0, 0.3, 0.1)),
        (TransferFunction.fopdt(-1.0, 1.0, 1.0), RelaySettings(5, 4, 1, 0.2, 0.1, 0, 0, True)),
        (TransferFunction.lag_n(1.0, 6.0, 8, 0.6), RelaySettings(5.0, 40.0, 1.0, 0.0, 0.05)),
        (UNSTABLE_FOPDT.build((1.0, 1.0, 0.3)), RelaySettings(5.0, 40.0, 1.0, 0, 0.03)),
        (
            INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
            RelaySettings(5.0, 40.0, 1.0, 0.0, 0.05),
        ),
    ],
)
def test_the_true_model_reproduces_its_record(model, relay):
    found = validate(model, record_of(model, relay))
    assert found.reason == ""
    assert found.worst < 0.02
    assert found.shape < 5e-3


def test_a_relay_that_switches_below_the_rest():
    """The model's run began at the rest, from which no rise reached the first level."""
    relay = RelaySettings(5.0, 40.0, 1.0, 0.0, 0.1)
    run = simulate_relay(FOPDT, relay, cycles=6, operating_point=5.5, kick=0.9, time=1200)
    rest = SteadyState(5.5, 0.01, measured=True)
    assert validate_fold(FOPDT, fold(run.record()), rest).worst < 0.02


def test_a_thermostat_of_unknown_rest():
    """Where nothing was recorded at rest, the set-point may lie far from it."""
    relay = RelaySettings(26.0, 2.5, 2.5, 0.0, 0.5)
    model = TransferFunction.fopdt(2.0, 10.0, 3.0)
    run = simulate_relay(
        model, relay, cycles=8, operating_point=25.0, time=np.linspace(20.0, 110.0, 1200)
    )
    whole = run.record(noise_std=0.0)
    record = Record(whole.time, whole.measurement, whole.command)
    assert abs(asymmetry_of(record)) > 0.05
    assert validate(model, record).worst < 0.02


def asymmetry_of(record: Record) -> float:
    """Return how unequal the halves are, relative to the period."""
    seen = fold(record)
    return (seen.period_high - seen.period_low) / seen.period


def test_a_true_model_is_not_blamed_for_the_noise():
    relay = RelaySettings(5.0, 40.0, 1.0, 0.0, 0.1)
    clean = validate(FOPDT, record_of(FOPDT, relay))
    noisy = validate(FOPDT, record_of(FOPDT, relay, noise_std=0.05))
    assert clean.worst < 1e-4
    assert noisy.worst < 0.03


def test_a_sampled_relay_in_noise():
    model = TransferFunction.fopdt(1.0, 2.0, 1.0)
    noise = 0.03 * np.random.default_rng(5).standard_normal(4000)
    record = simulate_sampled_relay(
        model, RelaySettings(3.0, 1.0, 1.0, 0.0, 0.1), period=0.01, noise=noise
    )
    assert validate(model, record).worst < 0.05


@pytest.mark.parametrize(
    "wrong",
    [
        TransferFunction.fopdt(1.65, 20.0, 12.0),
        TransferFunction.fopdt(2.0, 20.0, 10.0),
        TransferFunction.lag_n(0.8, 5.0, 5, 0.0),
        TransferFunction.lag_n(1.65, 10.0, 2, 5.0),
    ],
)
def test_a_wrong_model_does_not(wrong):
    assert validate(wrong, record_of(FOPDT, RelaySettings(5.0, 40.0, 1.0, 0.0, 0.1))).worst > 0.08


def test_models_of_one_period_and_amplitude_differ_in_shape_only():
    from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
    from relay_autotune.identification.methods.lags import equal

    relay = RelaySettings(0.0, 0.0, 1.0, 0.0, 0.1)
    run = simulate_relay(FOPDT, relay, cycles=6)
    cycle = run.cycles[-1]
    gain, tau = equal(5, SymmetricCycle(cycle.period, cycle.peak_max, 1.0, 0.1, 0.0))
    found = validate(TransferFunction.lag_n(gain, tau, 5, 0.0), record_of(FOPDT, relay))
    assert abs(found.period) < 1e-4
    assert abs(found.peak_max) < 1e-3
    assert found.shape == found.worst > 0.1


def test_a_model_without_a_limit_cycle_says_so():
    record = record_of(FOPDT, RelaySettings(5.0, 40.0, 1.0, 0.0, 0.1))
    weak = validate(TransferFunction.fopdt(0.05, 20.0, 10.0), record)
    assert "never reaches" in weak.reason
    assert weak.worst == math.inf
    turned = validate(TransferFunction.fopdt(-1.65, 20.0, 10.0), record)
    assert "direction" in turned.reason
    assert math.isnan(turned.shape)


def test_a_record_without_cycles_is_refused():
    time = np.linspace(0.0, 10.0, 100)
    step = Record(time, np.minimum(time, 5.0), np.where(time > 1.0, 1.0, 0.0))
    with pytest.raises(IdentificationError, match="whole cycle"):
        validate(FOPDT, step)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.T3"))
def test_eqs_29_and_30(name, inputs, exact, tol):
    gain, tau, order, dead_time = inputs["process"]
    process = TransferFunction.lag_n(gain, tau, order, dead_time)
    first, second, third = (inputs["models"][n] for n in ("FOPDT", "SOPSDT", "HO"))
    structure = structure_named("fopdt" if first["tau"] > 0.0 else "unstable_fopdt")
    models = (
        structure.build((first["K"], abs(first["tau"]), first["D"])),
        TransferFunction.lag_n(second["K"], second["tau"], 2, second["D"]),
        TransferFunction.lag_n(third["K"], third["tau"], 5, 0.0),
    )
    frequency = 2.0 * math.pi / inputs["Pu"]
    for kind in ("relative", "absolute"):
        found = [
            integrated_error(m, process, frequency, relative=kind == "relative") for m in models
        ]
        assert found == pytest.approx(exact[kind], rel=tol)
    # Table 2 has the least absolute error in the category that the paper reports.
    category = {"1": 0, "2": 0, "3": 0, "4": 1, "5": 2, "6": 2}[name[-1]]
    assert np.argmin(found) == category
