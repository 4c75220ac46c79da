# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Event-driven relay experiments against closed forms and worked limit cycles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from forward import fopdt_limit_cycle
from hypothesis import given, settings
from hypothesis import strategies as st
from relay_runs import simulate_relay
from sampled_relay import exact_limit_cycle, simulate_sampled_relay
from worked_cases import cases

from relay_autotune.errors import ModelError
from relay_autotune.process import simulation
from relay_autotune.process.response import response
from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    LAG_COMPLEX,
    TWO_EQUAL_ONE,
    UNSTABLE_FOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings

IDEAL = RelaySettings(setpoint=0.0, baseline=0.0, amplitude=1.0)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("wang.T1"))
def test_biased_relay(name, inputs, exact, tol):
    relay = RelaySettings(0.0, 0.0, inputs["mu"], inputs["mu0"], inputs["eps"])
    model = TransferFunction.fopdt(inputs["K"], inputs["T"], inputs["L"])
    cycle = exact_limit_cycle(model, relay)
    assert cycle.period_high == pytest.approx(exact["Tu1"], rel=tol)
    assert cycle.period_low == pytest.approx(exact["Tu2"], rel=tol)
    assert cycle.peak_max == pytest.approx(exact["Au"], rel=tol)
    assert cycle.peak_min == pytest.approx(exact["Ad"], rel=tol)
    assert cycle.time_to_peak_max == pytest.approx(inputs["L"], rel=tol)
    assert cycle.mean_measurement == pytest.approx(inputs["K"] * cycle.mean_command, rel=1e-9)


@pytest.mark.long
@settings(deadline=None, max_examples=40)
@given(
    gain=st.floats(0.2, 5.0),
    tau=st.floats(0.2, 20.0),
    ratio=st.floats(0.05, 8.0),
    bias=st.floats(-0.5, 0.5),
    hysteresis=st.floats(0.0, 0.3),
)
def test_closed_forms_of_wang(gain, tau, ratio, bias, hysteresis):
    epsilon = hysteresis * gain * (1.0 - abs(bias))
    truth = fopdt_limit_cycle(gain, tau, ratio * tau, 1.0, bias, epsilon)
    model = TransferFunction.fopdt(gain, tau, ratio * tau)
    cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0, bias, epsilon))
    assert cycle.period_high == pytest.approx(truth.high, rel=1e-9)
    assert cycle.period_low == pytest.approx(truth.low, rel=1e-9)
    assert cycle.peak_max == pytest.approx(truth.up, rel=1e-9)
    assert cycle.peak_min == pytest.approx(truth.down, rel=1e-9)


@pytest.mark.parametrize("ratio", [0.01, 0.1, 1.0, 10.0])
def test_closed_forms_of_thyagarajan_for_a_stable_process(ratio):
    # Eqs 8 to 12: period, amplitude and time to the peak.
    cycle = exact_limit_cycle(TransferFunction.fopdt(2.0, 3.0, 3.0 * ratio), IDEAL)
    assert cycle.period == pytest.approx(6.0 * math.log(2.0 * math.exp(ratio) - 1.0), rel=1e-9)
    assert cycle.peak_max == pytest.approx(2.0 * -math.expm1(-ratio), rel=1e-9)
    assert cycle.time_to_peak_max == pytest.approx(3.0 * ratio, rel=1e-9)


@pytest.mark.parametrize("ratio", [0.05, 0.3, 0.6])
def test_closed_forms_of_thyagarajan_for_an_unstable_process(ratio):
    # Eqs 13 to 17, eq 17 as a quotient; the limit cycle exists for D/tau < ln 2.
    cycle = exact_limit_cycle(UNSTABLE_FOPDT.build((2.0, 3.0, 3.0 * ratio)), IDEAL)
    half = 3.0 * math.log(1.0 / (2.0 * math.exp(-ratio) - 1.0))
    assert cycle.period == pytest.approx(2.0 * half, rel=1e-9)
    assert cycle.peak_max == pytest.approx(2.0 * math.expm1(ratio), rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "inputs", "exact", "tol"),
    cases("thy.T1", "thy.eq42", "thy.eq14-17", "luyben.relay", "chang.eq11", "chang.eq12"),
)
def test_worked_limit_cycles(name, inputs, exact, tol):
    p = inputs
    if name.startswith("luyben"):
        model = INTEGRATOR_INVERSE.build((p["Kp"], p["tau1"], p["tau2"], p["D"]))
    elif name == "thy.eq14-17":
        model = UNSTABLE_FOPDT.build((p["K"], p["tau"], p["D"]))
    elif name.startswith("chang.eq11"):
        model = TransferFunction.sopdt(1.0, (p["tau1"], p["tau2"]), p["D"])
    elif name.startswith("chang.eq12"):
        model = TWO_EQUAL_ONE.build((1.0, p["tau1"], p["tau2"], p["D"]))
    else:
        model = TransferFunction.lag_n(p["K"], p["tau"], p["n"], p["D"])
    cycle = exact_limit_cycle(model, IDEAL)
    period = exact["P"] if "P" in exact else exact["Pu"]
    assert cycle.period == pytest.approx(period, rel=tol)
    if "a" in exact:
        assert cycle.peak_max == pytest.approx(exact["a"], rel=tol)


def test_a_reverse_acting_relay_mirrors_the_direct_one():
    relay = RelaySettings(0.0, 0.0, 1.0, 0.3, 0.1)
    mirrored = RelaySettings(0.0, 0.0, 1.0, -0.3, 0.1, reverse_acting=True)
    direct = exact_limit_cycle(TransferFunction.fopdt(1.0, 2.0, 1.0), relay)
    reverse = exact_limit_cycle(TransferFunction.fopdt(-1.0, 2.0, 1.0), mirrored)
    assert reverse.period_low == pytest.approx(direct.period_high, rel=1e-12)
    assert reverse.period_high == pytest.approx(direct.period_low, rel=1e-12)
    assert reverse.peak_max == pytest.approx(direct.peak_max, rel=1e-12)
    assert reverse.time_to_peak_max == pytest.approx(direct.time_to_peak_max, rel=1e-9)


def test_samples_equal_the_response_to_the_recorded_command():
    relay = RelaySettings(50.0, 30.0, 5.0, 1.0, 0.2)
    model = TransferFunction.lag_n(1.5, 4.0, 3, 1.7)
    run = simulate_relay(model, relay, cycles=3, time=np.linspace(0.0, 80.0, 500))
    exact = 50.0 + response(model, run.time, run.command)
    np.testing.assert_allclose(run.measurement, exact, atol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("cycles", [1, 2, 5])
def test_as_many_whole_cycles_are_run_as_asked_for(cycles, reverse):
    model = LAG_COMPLEX.build((-1.0 if reverse else 1.0, 2.0, 1.0, 0.4, 1.0))
    relay = RelaySettings(0.0, 0.0, 1.0, 0.1, 0.05, reverse_acting=reverse)
    run = simulate_relay(model, relay, cycles=cycles)
    assert [c.index for c in run.cycles] == list(range(cycles))


def test_set_point_and_kick_move_the_first_switch():
    model = TransferFunction.fopdt(1.0, 10.0, 1.0)
    off = RelaySettings(0.2, 0.0, 1.0, 0.0, 0.05)
    run = simulate_relay(model, off, cycles=1, operating_point=0.0)
    first = run.command.times[1]
    assert first == pytest.approx(1.0 - 10.0 * math.log(1.0 - 0.25), rel=1e-9)
    kicked = simulate_relay(model, IDEAL, cycles=1, kick=0.4)
    assert kicked.command.times[1] == pytest.approx(1.0 - 10.0 * math.log(0.6), rel=1e-9)


def test_an_extra_delay_of_the_relay_is_dead_time():
    relay = RelaySettings(0.0, 0.0, 1.0, 0.2, 0.1, extra_delay=0.7)
    plain = RelaySettings(0.0, 0.0, 1.0, 0.2, 0.1)
    with_delay = exact_limit_cycle(TransferFunction.fopdt(1.0, 2.0, 1.0), relay)
    longer = exact_limit_cycle(TransferFunction.fopdt(1.0, 2.0, 1.7), plain)
    assert with_delay.period == pytest.approx(longer.period, rel=1e-12)


def test_no_limit_cycle_is_said(monkeypatch):
    with pytest.raises(ModelError, match="never reaches"):
        simulate_relay(
            TransferFunction.fopdt(1.0, 1.0, 1.0),
            RelaySettings(2.0, 0.0, 1.0),
            cycles=1,
            operating_point=0.0,
        )
    monkeypatch.setattr(simulation, "_MOST_SWITCHES", 50)
    with pytest.raises(ModelError, match="50 switches"):
        simulate_relay(TransferFunction.fopdt(1.0, 1.0, 1e-6), IDEAL, cycles=10_000)


def test_without_dead_time_and_hysteresis_a_kick_is_needed():
    model = TransferFunction.lag_n(1.0, 1.0, 3, 0.0)
    with pytest.raises(ModelError, match="kick"):
        simulate_relay(model, IDEAL, cycles=1)
    run = simulate_relay(model, IDEAL, cycles=40, kick=0.01)
    assert run.cycles[-1].period == pytest.approx(run.cycles[-2].period, rel=1e-9)


@pytest.mark.long
def test_a_sampled_relay_tends_to_the_ideal_one():
    model = TransferFunction.fopdt(1.0, 2.0, 1.0)
    relay = RelaySettings(0.0, 0.0, 1.0, 0.3, 0.1)
    ideal = exact_limit_cycle(model, relay)
    record = simulate_sampled_relay(model, relay, period=1e-3, noise=np.zeros(20_000))
    starts = record.time[list(record.cycle_start)]
    assert np.diff(starts)[-1] == pytest.approx(ideal.period, abs=3e-3)
    assert record.measurement[5000:].max() == pytest.approx(ideal.peak_max, abs=2e-3)


def test_a_relay_blind_to_the_noise_switches_as_without_it():
    model = TransferFunction.fopdt(1.0, 2.0, 1.0)
    relay = RelaySettings(0.0, 0.0, 1.0, 0.0, 0.2)
    noise = 0.1 * np.random.default_rng(3).standard_normal(2000)
    quiet = simulate_sampled_relay(model, relay, period=0.02, noise=np.zeros(2000))
    blind = simulate_sampled_relay(model, relay, period=0.02, noise=noise, relay_sees_noise=False)
    seeing = simulate_sampled_relay(model, relay, period=0.02, noise=noise)
    np.testing.assert_array_equal(blind.command, quiet.command)
    np.testing.assert_allclose(blind.measurement - quiet.measurement, noise, atol=1e-15)
    assert np.any(seeing.command != quiet.command)


def test_a_change_of_sign_that_was_rounding_is_no_error():
    model = LAG_COMPLEX.build((1.0, 1.0, 1.0 / 0.9, 0.7, 0.0))
    biased = RelaySettings(0.0, 0.0, 1.0, 0.3)
    with pytest.raises(ModelError, match="kick"):
        simulate_relay(model, biased, cycles=6)
    assert simulate_relay(model, biased, cycles=6, kick=0.01).cycles
