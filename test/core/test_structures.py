# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Every structure of the waveform fit: responses, derivatives, recovery, choice."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from relay_runs import simulate_relay

from relay_autotune.identification.known import Known
from relay_autotune.identification.waveform.candidates import support
from relay_autotune.identification.waveform.method import identify_waveform
from relay_autotune.identification.waveform.rational import (
    Inputs,
    columns_of,
    free_motion,
    responses,
)
from relay_autotune.identification.waveform.starts import is_unobservable
from relay_autotune.process.factors import Denominator, Lag, Quadratic
from relay_autotune.process.response import response
from relay_autotune.process.structures import (
    FOPDT,
    INTEGRATOR_INVERSE,
    INTEGRATOR_LAG,
    IPDT,
    LAG_COMPLEX,
    LAG_N_ZERO,
    THREE_LAGS,
    TWO_EQUAL_ONE,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

TIME = np.linspace(0.0, 60.0, 400)
INPUT = PiecewiseConstant(
    np.array([1.0, 9.0, 22.0, 31.0, 44.0]), np.array([1.0, -1.0, 1.0, -1.0, 1.0]), 0.0
)

DENOMINATORS = {
    "lag": (Denominator((Lag(),)), (0,), [1.6, 2.03]),
    "eight lags": (Denominator((Lag(8),)), (0, 1), [0.1, 2.03]),
    "overdamped": (Denominator((Quadratic(),)), (0, 1), [0.3, 0.5, 2.03]),
    "nearly critical": (Denominator((Quadratic(),)), (0, 1), [0.3, 0.001, 2.03]),
    "underdamped": (Denominator((Quadratic(),)), (0, 1), [0.3, -1.0, 2.03]),
    "two equal and one": (Denominator((Lag(2), Lag())), (0,), [0.5, 1.5, 2.03]),
    "third order": (Denominator((Quadratic(), Lag())), (0,), [0.5, 0.2, 1.5, 2.03]),
    "integrator": (Denominator((), 1), (0,), [2.03]),
    "integrator and lag": (Denominator((Lag(),), 1), (0, 1), [0.7, 2.03]),
    "unstable": (Denominator((Lag(unstable=True),)), (0,), [1.1, 0.53]),
    "unstable and lag": (Denominator((Lag(unstable=True), Lag())), (0,), [1.1, 0.2, 0.53]),
}


@pytest.mark.parametrize("name", DENOMINATORS)
def test_derivatives_are_the_limits_of_differences(name):
    denominator, powers, point = DENOMINATORS[name]
    theta = np.array(point)
    ((_, derivatives),) = responses(denominator, powers, theta, TIME, Inputs((INPUT,)))
    _, free_derivatives = free_motion(denominator, theta, TIME)
    for i in range(theta.size):
        h = np.zeros(theta.size)
        h[i] = 1e-6
        up, down = (
            responses(denominator, powers, theta + s * h, TIME, Inputs((INPUT,)))[0][0]
            for s in (1, -1)
        )
        error = np.abs((up - down) / 2e-6 - derivatives[i])
        # Samples beside a change, which crosses them as the dead time moves, are left out.
        assert np.quantile(error, 0.97) < 1e-5 * (1.0 + np.abs(derivatives[i]).max())
        up, down = (free_motion(denominator, theta + s * h, TIME)[0] for s in (1, -1))
        if up.size:
            error = np.abs((up - down) / 2e-6 - free_derivatives[i])
            assert error.max() < 1e-5 * (1.0 + np.abs(free_derivatives[i]).max())


@pytest.mark.parametrize("name", DENOMINATORS)
def test_without_slopes_the_responses_are_the_same(name):
    denominator, powers, point = DENOMINATORS[name]
    theta = np.array(point)
    ((found, _),) = responses(denominator, powers, theta, TIME, Inputs((INPUT,)))
    ((alone, none),) = responses(denominator, powers, theta, TIME, Inputs((INPUT,)), slopes=False)
    np.testing.assert_allclose(alone, found, atol=1e-9 * np.abs(found).max())
    assert none.shape == (0, *found.shape)
    (found, _), (alone, none) = (free_motion(denominator, theta, TIME, slopes=s) for s in (1, 0))
    np.testing.assert_array_equal(alone, found)
    assert none.shape == (0, *found.shape)


@pytest.mark.parametrize(
    "name", [n for n in DENOMINATORS if "unstable" not in n and "integrator" not in n]
)
def test_what_a_step_leaves_to_come_is_a_free_motion(name):
    denominator, _, point = DENOMINATORS[name]
    theta = np.array([*point[:-1], 0.0])
    model = TransferFunction(1.0, (), denominator.constants(theta[:-1]), 0, 0.0)
    to_come = 1.0 - response(model, TIME, PiecewiseConstant(TIME[:1], np.ones(1), 0.0))
    columns, _ = free_motion(denominator, theta, TIME)
    assert columns.shape[0] == denominator.order
    left = to_come - np.linalg.lstsq(columns.T, to_come, rcond=None)[0] @ columns
    assert np.abs(left).max() < 1e-9


@pytest.mark.parametrize("name", [n for n in DENOMINATORS if "unstable" not in n])
def test_responses_are_those_of_the_transfer_function(name):
    denominator, powers, point = DENOMINATORS[name]
    theta = np.array(point)
    ((found, _),) = responses(denominator, powers, theta, TIME, Inputs((INPUT,)))
    constants = denominator.constants(theta[:-1])
    model = TransferFunction(1.0, (), constants, denominator.integrators, theta[-1])
    np.testing.assert_allclose(found[0], response(model, TIME, INPUT), atol=1e-9)


@pytest.mark.parametrize("name", ["eight lags", "underdamped", "third order", "integrator"])
def test_responses_to_a_long_staircase_are_those_of_the_transfer_function(name):
    denominator, powers, point = DENOMINATORS[name]
    rng = np.random.default_rng(6)
    u = PiecewiseConstant(np.sort(rng.uniform(0.0, 55.0, 700)), rng.normal(size=700), 0.0)
    theta = np.array(point)
    # Slow, and so fast that every change finds the last one settled.
    for faster in (0.0, 3.0):
        theta[: denominator.parameters] -= faster
        ((found, _),) = responses(denominator, powers, theta, TIME, Inputs((u,)))
        constants = denominator.constants(theta[:-1])
        model = TransferFunction(1.0, (), constants, denominator.integrators, theta[-1])
        np.testing.assert_allclose(found[0], response(model, TIME, u), atol=1e-9)


def test_the_closed_form_of_a_lag_is_the_general_one():
    theta = np.array((1.6, 2.03))
    (quick_one,) = columns_of(FOPDT, theta, TIME, Inputs((INPUT,)))
    (general_one,) = responses(FOPDT.denominator, FOPDT.powers, theta, TIME, Inputs((INPUT,)))
    for quick, general in zip(quick_one, general_one, strict=True):
        np.testing.assert_allclose(quick, general, atol=1e-12)


PROCESSES = {
    "fopdt": TransferFunction.fopdt(1.65, 20.0, 10.0),
    "lag_n": TransferFunction.lag_n(1.0, 1.0, 3, 10.0),
    "lag_n, order 8": TransferFunction.lag_n(1.0, 6.0, 8, 0.6),
    "lag_n_zero": LAG_N_ZERO.of_order(3).build((1.0, 2.0, -1.0, 1.0)),
    "sopdt": TransferFunction.sopdt(1.0, (5.0, 1.0), 1.0),
    "sopdt, underdamped": TransferFunction.oscillator(1.0, 1.0, 0.4, 0.5),
    "two_equal_one": TWO_EQUAL_ONE.build((1.0, 10.0, 3.0, 2.0)),
    "three_lags": THREE_LAGS.build((1.0, 10.0, 3.0, 1.0, 2.0)),
    "lag_complex": LAG_COMPLEX.build((1.0, 2.0, 1.0, 0.4, 1.0)),
    "ipdt": IPDT.build((0.5, 1.0)),
    "integrator_lag": INTEGRATOR_LAG.build((0.5, 2.0, 1.0)),
    "integrator_inverse": INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
    "unstable_fopdt": UNSTABLE_FOPDT.build((1.0, 1.0, 0.3)),
    "unstable_sopdt": UNSTABLE_SOPDT.build((1.0, 2.0, 0.2, 0.2)),
}
# The others differ from one of these in the number of lags, or by a zero.
BY_DAY = {"sopdt", "three_lags", "unstable_fopdt"}
ONE_OF_EACH_KIND = [
    pytest.param(name, marks=[] if name in BY_DAY else [pytest.mark.nightly]) for name in PROCESSES
]
# In noise the choice is harder, and takes longer.
IN_NOISE = [("sopdt, underdamped", 0)]
IN_NOISE += [(n, s) for n in PROCESSES for s in (0, 1) if (n, s) not in IN_NOISE]


def _record(
    model: TransferFunction, noise: float = 0.0, seed: int = 0, samples: int = 1000
) -> Record:
    relay = RelaySettings(0.0, 0.0, 1.0)
    run = simulate_relay(model, relay, cycles=5, time=samples)
    signal = float(np.mean(np.abs(run.measurement)))
    std = noise * signal * math.sqrt(math.pi / 2.0)
    return run.record(noise_std=std, rng=np.random.default_rng(seed))


@pytest.mark.long
@pytest.mark.parametrize("name", ONE_OF_EACH_KIND)
def test_without_noise_the_true_structure_is_found_exactly(name):
    model = PROCESSES[name]
    found = identify_waveform(_record(model, samples=500))
    assert found.structure == model.structure
    assert found.model.order == model.order
    assert found.model.gain == pytest.approx(model.gain, rel=1e-7)
    assert found.model.dead_time == pytest.approx(model.dead_time, rel=1e-7, abs=1e-7)
    for a, b in zip(
        sorted(found.model.time_constants, key=lambda c: (c.real, c.imag)),
        sorted(model.time_constants, key=lambda c: (c.real, c.imag)),
        strict=True,
    ):
        assert abs(a - b) < 1e-6 * abs(b)
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=1e-8)


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "seed"), IN_NOISE)
def test_in_noise_the_choice_gives_the_ultimate_point(name, seed):
    model = PROCESSES[name]
    truth = ultimate_point(model)
    found = identify_waveform(_record(model, 0.1, seed))
    assert found.ultimate_gain == pytest.approx(truth.gain, rel=0.02)
    assert found.ultimate_frequency == pytest.approx(truth.frequency, rel=0.01)
    assert abs(found.ultimate_gain - truth.gain) < 4.5 * found.ultimate_gain_std


@pytest.mark.nightly
@pytest.mark.parametrize("name", PROCESSES)
def test_the_true_structure_given_its_errors_are_those_stated(name):
    model = PROCESSES[name]
    known = Known(structure=model.structure, order=model.order if "lag_n" in name else 0)
    truth = identify_waveform(_record(model), known)
    for seed in (2, 3):
        found = identify_waveform(_record(model, 0.02, seed), known)
        assert found.parameters == truth.parameters
        assert np.all(np.isfinite(found.std))
        pulls = (found.values - truth.values) / found.std
        assert np.abs(pulls).max() < 5.0


@pytest.mark.long
def test_a_structure_that_is_not_in_the_data_can_be_forced():
    found = identify_waveform(_record(PROCESSES["lag_n"], 0.02), Known(structure="fopdt"))
    assert found.structure == "fopdt"
    assert any("is correlated" in w for w in found.warnings)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(3))
def test_no_rival_rings_faster_than_the_samples_show(seed):
    """In noise, a resonance between two samples fits as well as none, and has any height."""
    period, noise = 0.005, 0.01
    time = np.arange(327) * period
    u = PiecewiseConstant(np.array((0.6, 0.95, 1.25)), np.array((0.65, -0.35, 0.65)), 0.0)
    model = TransferFunction.fopdt(2.0, 0.2, 0.1)
    y = response(model, time, u) + noise * np.random.default_rng(seed).standard_normal(time.size)
    command = u(time)
    found = identify_waveform(Record(time, y, command))
    for candidate in (found.model, *(rival.model for rival in found.rivals)):
        for constant in candidate.time_constants:
            assert constant.imag == 0.0 or 2.0 * np.pi * abs(constant) >= 4.0 * period
    assert found.ultimate_gain_std < 0.03 * found.ultimate_gain


@pytest.mark.parametrize(
    ("model", "unseen"),
    [
        (TransferFunction.fopdt(1.0, 0.3, 0.0), False),
        (TransferFunction(1.0, (), (), 0, 0.3), False),
        (TransferFunction.fopdt(1.0, 0.03, 0.01), True),
        (TransferFunction(1.0, (20.0,), (5.0, 5.0)), False),
        (TransferFunction(1.0, (), (0.02j, -0.02j)), True),
        (TransferFunction(1.0, (), (), integrators=1), False),
    ],
)
def test_a_fit_that_lives_between_the_samples_is_none(model, unseen):
    assert is_unobservable(model, interval=0.1, length=100.0) is unseen


@pytest.mark.nightly
def test_a_drift_beside_a_slow_pole_and_zero_is_no_process():
    """One cycle of 2 e^(-0.1 s)/(0.2 s + 1), recorded on a machine that stepped the plant late.

    With a drift, a pole of 1863 s and a zero of -299 s fitted the 1.8 s best, with a gain against
    the direction of the relay.
    """
    data = Path(__file__).parents[1] / "support" / "data" / "drifting_kiln.csv"
    time, y, u = np.loadtxt(data, delimiter=",", skiprows=1).T
    relay = RelaySettings(0.00028823, 0.0, 0.5, 0.15, 0.0326236659)
    found = identify_waveform(Record(time, y, u, settings=relay, noise_std=0.0108745555))
    assert found.model.process_sign == 1
    slowest = max(abs(c) for c in (*found.model.time_constants, *found.model.zeros))
    assert slowest < 2.0 * time[-1]
    assert found.ultimate_gain == pytest.approx(1.9034, rel=0.05)


def test_a_response_that_turns_only_after_the_record_is_unobservable():
    # From 400 s on a higher command is said to lower the measurement, which first rises.
    model = TransferFunction(
        -0.01, dead_time=5.0, zeros=(-300.0,), time_constants=(100.0,), integrators=1
    )
    assert is_unobservable(model, 1.0, 390.0)
    assert not is_unobservable(model, 1.0, 420.0)
    # A command that never stays so long on one side does not show it either.
    assert is_unobservable(model, 1.0, 4000.0, pushed=390.0)
    assert not is_unobservable(model, 1.0, 4000.0, pushed=420.0)
    inverse = TransferFunction(2.0, dead_time=1.0, zeros=(-3.0,), time_constants=(10.0, 4.0))
    assert not is_unobservable(inverse, 0.1, 100.0)


def test_the_support_of_candidates_that_are_not_in_order():
    found = support([SimpleNamespace(akaike=c) for c in (-36500.0, -38748.0, -38746.0)])
    assert found[0] == pytest.approx(0.0, abs=1e-300)
    assert found[1] == pytest.approx(1.0 / (1.0 + math.exp(-1.0)))
