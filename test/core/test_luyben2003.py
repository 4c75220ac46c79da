# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Luyben's step test: the worked cases, the closed form, and records from end to end."""

from __future__ import annotations

import numpy as np
import pytest
from forward import step_features, step_response
from hypothesis import given
from hypothesis import strategies as st
from relay_runs import simulate_relay
from scipy.optimize import fsolve
from worked_cases import cases

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.methods.luyben import (
    from_step,
    identify_step_numbers,
)
from relay_autotune.process.response import response
from relay_autotune.process.structures import INTEGRATOR_INVERSE
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

EXAMPLE = (0.547, 0.418, 1.06, 0.1)


def numbers(case):
    return case["t1"], case["t2"], case["ymin"], case["du"]


@pytest.mark.parametrize(
    ("name", "inputs", "exact", "tol"), cases("luyben.ident.eqs4-6", "luyben.ident.t2minusD")
)
def test_equations_4_to_6(name, inputs, exact, tol):
    found = from_step(*numbers(inputs))
    assert found == pytest.approx([exact[k] for k in ("Kp", "tau1", "tau2")], rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("luyben.ident.program"))
def test_the_papers_example_follows_from_a_divisor_too_many(name, inputs, exact, tol):
    t1, t2, lowest, step = numbers(inputs)

    def printed(x):
        gain, tau1, tau2 = x
        both = tau1 + tau2
        return (
            lowest - step * gain * (t1 - both + both * np.exp(-t1 / tau2)),
            1.0 - both / tau2 * np.exp(-t1 / tau2),
            t2 - both + both * np.exp(-t2 / tau2) / tau2,
        )

    wrong = fsolve(printed, (0.5, 0.4, 1.0), xtol=1e-12)
    assert wrong == pytest.approx([exact[k] for k in ("Kp", "tau1", "tau2")], rel=tol)
    assert from_step(t1, t2, lowest, step)[0] != pytest.approx(wrong[0], rel=0.5)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("luyben.forward"))
def test_forward_and_back(name, inputs, exact, tol):
    process = tuple(inputs[k] for k in ("Kp", "tau1", "tau2"))
    found = step_features(*process, inputs["du"])
    assert found == pytest.approx([exact[k] for k in ("t1", "t2", "ymin")], rel=tol)
    assert from_step(*found, inputs["du"]) == pytest.approx(process, rel=tol)


@given(
    gain=st.floats(0.01, 100.0),
    reverse=st.booleans(),
    tau1=st.floats(0.01, 100.0),
    tau2=st.floats(0.01, 10.0),
    step=st.floats(0.1, 10.0),
)
def test_any_process_comes_back(gain, reverse, tau1, tau2, step):
    signed = -gain if reverse else gain
    t1, t2, extremum = step_features(signed, tau1, tau2, step)
    assert np.sign(extremum) == -np.sign(signed)
    assert 2.0 * t1 < t2
    y = step_response(np.array([t1 * 0.999, t1, t1 * 1.001, t2]), signed, tau1, tau2, step)
    assert abs(y[1]) >= max(abs(y[0]), abs(y[2])) * (1.0 - 1e-12)
    assert y[1] == pytest.approx(extremum, rel=1e-6)
    assert y[3] == pytest.approx(0.0, abs=1e-6 * abs(extremum))
    # Little inverse response hardly moves the ratio of the times.
    tolerance = max(1e-9, 1e-13 * (tau2 / tau1) ** 2)
    assert from_step(t1, t2, extremum, step) == pytest.approx((signed, tau1, tau2), rel=tolerance)


def test_it_is_the_response_of_the_transfer_function():
    gain, tau1, tau2, dead_time = EXAMPLE
    time = np.linspace(0.0, 5.0, 101)
    u = PiecewiseConstant(np.array([0.0]), np.array([10.0]), 0.0)
    model = INTEGRATOR_INVERSE.build((gain, tau1, tau2, dead_time))
    late = np.maximum(time - dead_time, 0.0)
    expected = step_response(late, gain, tau1, tau2, 10.0)
    assert response(model, time, u) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("t1", "t2", "extremum", "step", "words"),
    [
        (0.35, 0.7, -0.36, 10.0, "more than twice"),
        (0.0, 0.7, -0.36, 10.0, "more than twice"),
        (0.35, 0.85, 0.0, 10.0, "not zero"),
        (0.35, 0.85, -0.36, 0.0, "not zero"),
        (1e-12, 1.0, -0.36, 10.0, "vanish"),
    ],
)
def test_numbers_of_no_such_process_are_refused(t1, t2, extremum, step, words):
    with pytest.raises(IdentificationError, match=words):
        from_step(t1, t2, extremum, step)


def test_numbers_by_hand_make_a_model():
    found = identify_step_numbers(*step_features(*EXAMPLE[:3], 10.0), 10.0, 0.1)
    assert found.values == pytest.approx(EXAMPLE, rel=1e-9)
    assert found.ultimate_gain == pytest.approx(cases("luyben.ultimate")[0][2]["Ku"], rel=1e-9)
    assert found.model.structure == "integrator_inverse"


def step_record(process, step=2.0, end=4.0, samples=401, noise=0.0, seed=0, begin=1.0):
    """Return a step from 40 about 50, with noise in parts of the extremum."""
    model = INTEGRATOR_INVERSE.build(process)
    time = np.linspace(0.0, end, samples)
    u = PiecewiseConstant(np.array([begin]), np.array([40.0 + step]), 40.0)
    y = 50.0 + response(model, time, u)
    std = noise * abs(step_features(*process[:3], step)[2])
    y = y + std * np.random.default_rng(seed).standard_normal(samples)
    return Record(time, y, u(time), held_input=u)


PROCESSES = [
    (EXAMPLE, 4.0),
    ((-0.547, 0.418, 1.06, 0.1), 4.0),
    ((1.0, 1.6, 1.0, 0.2), 6.0),
    ((1.0, 8.0, 1.0, 2.0), 16.0),
    ((1.0, 0.8, 1.0, 0.0), 5.0),
]


@pytest.mark.long
@pytest.mark.parametrize(("process", "end"), PROCESSES)
@pytest.mark.parametrize("step", [2.0, -2.0])
def test_a_record_without_noise(process, end, step):
    found = identify(step_record(process, step, end), "luyben_step")
    assert found.values == pytest.approx(process, rel=2e-4, abs=1e-6)
    assert found.warnings == ()
    assert found.fit.fit > 0.999


@pytest.mark.nightly
def test_records_with_noise():
    inside = []
    for process, end in PROCESSES[:4]:
        found = [
            identify(step_record(process, 2.0, end, 801, 0.02, seed), "luyben_step")
            for seed in range(12)
        ]
        errors = np.array([f.values / np.array(process) - 1.0 for f in found])
        assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < (0.2, 0.03, 0.2, 0.03))
        inside += [(f.ci95_low <= process) & (process <= f.ci95_high) for f in found]
    assert np.mean(inside) > 0.8


def test_a_known_dead_time_is_used():
    record = step_record(EXAMPLE, noise=0.02)
    found = identify(record, "luyben_step", Known(dead_time=0.1))
    assert found.values[3] == 0.1
    assert found.std[3] == 0.0


@pytest.mark.long
def test_many_samples_take_no_longer():
    record = step_record(EXAMPLE, samples=200_001, noise=0.05)
    found = identify(record, "luyben_step")
    assert found.values == pytest.approx(EXAMPLE, rel=0.05)


def test_what_is_no_such_step_test_is_refused():
    time = np.linspace(0.0, 20.0, 401)
    lag = TransferFunction.fopdt(1.0, 2.0, 0.5)
    u = PiecewiseConstant(np.array([2.0]), np.array([1.0]), 0.0)
    with pytest.raises(IdentificationError, match="no inverse response"):
        identify(Record(time, response(lag, time, u), u(time), held_input=u), "luyben_step")
    with pytest.raises(IdentificationError, match="never changes"):
        identify(Record(time, np.sin(time), np.ones(401)), "luyben_step")
    with pytest.raises(IdentificationError, match="no structure 'fopdt'"):
        identify(step_record(EXAMPLE), "luyben_step", Known(structure="fopdt"))
    with pytest.raises(IdentificationError, match="record longer"):
        identify(step_record(EXAMPLE, end=1.6), "luyben_step")
    noise_only = Record(time, np.random.default_rng(1).standard_normal(401), u(time), held_input=u)
    with pytest.raises(IdentificationError):
        identify(noise_only, "luyben_step")


def test_a_relay_test_is_refused():
    model = TransferFunction.fopdt(1.0, 2.0, 1.0)
    relay = RelaySettings(0.0, 0.0, 1.0, 0.0, 0.1)
    run = simulate_relay(model, relay, cycles=3, time=np.linspace(0.0, 15.0, 601))
    with pytest.raises(IdentificationError):
        identify(run.record(), "luyben_step")


def test_another_structure_is_remarked():
    # inverse response without an integrator: it settles
    model = TransferFunction.sopdt(1.0, (1.0, 1.0), 0.2, -1.0)
    time = np.linspace(0.0, 12.0, 601)
    u = PiecewiseConstant(np.array([1.0]), np.array([1.0]), 0.0)
    found = identify(Record(time, response(model, time, u), u(time), held_input=u), "luyben_step")
    assert "another structure" in found.warnings[0]
