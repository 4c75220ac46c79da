# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The steady half cycle of a model, against the simulated experiment and the worked cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from relay_runs import simulate_relay
from sampled_relay import exact_limit_cycle
from worked_cases import cases

from relay_autotune.errors import ModelError
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.limit_cycle.shape import normalised_growth
from relay_autotune.identification.methods.lags import equal
from relay_autotune.process.simulation import HalfCycle
from relay_autotune.process.structures import INTEGRATOR_INVERSE, UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings

MODELS = {
    "fopdt": TransferFunction.fopdt(2.0, 3.0, 1.0),
    "reverse": TransferFunction.lag_n(-1.0, 1.0, 3, 1.0),
    "equal lags": TransferFunction.lag_n(1.0, 1.0, 8, 0.1),
    "oscillator": TransferFunction.oscillator(1.0, 2.0, 0.4, 0.5),
    "integrator": INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
    "unstable": UNSTABLE_FOPDT.build((1.0, 1.0, 0.3)),
}


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("hysteresis", [0.0, 0.1])
def test_it_is_the_limit_cycle_of_the_experiment(model, hysteresis):
    relay = RelaySettings(0.0, 0.0, 2.0, 0.0, hysteresis, reverse_acting=model.gain < 0.0)
    if model.structure == "unstable_fopdt":
        relay = RelaySettings(0.0, 0.0, 2.0, 0.0, hysteresis)
    cycle = exact_limit_cycle(model, relay)
    half = HalfCycle(model, 0.5 * cycle.period, 2.0)
    at_switch, at_peak = half(np.array([0.0, cycle.time_to_peak_max]))
    assert at_switch == pytest.approx(hysteresis, abs=1e-9)
    assert at_peak == pytest.approx(cycle.peak_max, rel=1e-9)


def test_the_next_half_mirrors_it():
    half = HalfCycle(MODELS["equal lags"], 6.0)
    time = np.linspace(0.01, 5.99, 50)
    assert half(time + 6.0) == pytest.approx(-half(time), abs=1e-12)
    assert half(time - 6.0) == pytest.approx(-half(time), abs=1e-12)
    step = 1e-6
    rate = (half(time + step) - half(time - step)) / (2.0 * step)
    assert half.slope(time) == pytest.approx(rate, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "inputs", "exact", "tol"), cases("thy.eq42.limitcycle", "luyben.relay")
)
def test_multiplier(name, inputs, exact, tol):
    p = inputs
    model = (
        INTEGRATOR_INVERSE.build((p["Kp"], p["tau1"], p["tau2"], p["D"]))
        if "Kp" in p
        else TransferFunction.lag_n(p["K"], p["tau"], p["n"], p["D"])
    )
    assert HalfCycle(model, 0.5 * exact["P"]).multiplier() == pytest.approx(
        exact["mult_half"], rel=tol
    )


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.eq25.grid"))
def test_growth_of_two_equal_lags(name, inputs, exact, tol):
    for case in exact:
        model = TransferFunction.lag_n(1.0, 1.0, 2, case["eps"])
        cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0))
        half = HalfCycle(model, 0.5 * cycle.period)
        assert normalised_growth(half.multiplier()) == pytest.approx(case["tauG_P"], rel=tol)
        assert cycle.period == pytest.approx(case["P_over_tau"], rel=tol)
        assert cycle.peak_max == pytest.approx(case["a"], rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.eq28"))
def test_growth_of_equal_lags_without_dead_time(name, inputs, exact, tol):
    for case in exact:
        _, tau = equal(case["n"], SymmetricCycle(1.0, 1.0, 1.0, 0.0, 0.0))
        half = HalfCycle(TransferFunction.lag_n(1.0, tau, case["n"], 0.0), 0.5)
        assert normalised_growth(half.multiplier()) == pytest.approx(case["tauG_P"], rel=tol)


def test_a_deviation_shrinks_by_the_multiplier():
    model = TransferFunction.lag_n(1.0, 1.0, 3, 0.2)
    relay = RelaySettings(0.0, 0.0, 1.0, 0.0, 0.02)
    steady = exact_limit_cycle(model, relay)
    peaks = [c.peak_max - steady.peak_max for c in simulate_relay(model, relay, cycles=8).cycles]
    per_half = HalfCycle(model, 0.5 * steady.period).multiplier()
    assert math.sqrt(peaks[6] / peaks[5]) == pytest.approx(per_half, rel=1e-2)


def test_one_lag_is_steady_at_once():
    assert HalfCycle(MODELS["fopdt"], 2.0).multiplier() == 0.0


def test_too_short_a_half_period_is_refused():
    with pytest.raises(ModelError, match="dead time"):
        HalfCycle(MODELS["fopdt"], 1.0)
