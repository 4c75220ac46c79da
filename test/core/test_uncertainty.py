# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Intervals of any function of a model, profiles, combinations, advice, robust losses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from relay_autotune.errors import IdentificationError, ParameterError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import identified
from relay_autotune.identification.waveform.determination import profile_ends
from relay_autotune.identification.waveform.fit_covariance import quantisation_step
from relay_autotune.identification.waveform.separable import evaluate, problem_of, refine
from relay_autotune.process.response import response
from relay_autotune.process.simulation import simulate_relay
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

GIVEN = Known(structure="fopdt")


def _record(
    process: tuple[float, float, float], noise: float, seed: int = 0, bias: float = 0.0
) -> Record:
    model, relay = TransferFunction.fopdt(*process), RelaySettings(0.0, 0.0, 1.0, bias)
    end = simulate_relay(model, relay, cycles=5).command.times[-1]
    run = simulate_relay(model, relay, cycles=5, time=np.linspace(0.0, end, 600))
    std = noise * float(np.mean(np.abs(run.measurement))) * math.sqrt(math.pi / 2.0)
    return run.record(noise_std=std, rng=np.random.default_rng(seed))


def _fopdt(covariance: np.ndarray):
    return identified("test", Estimate.of(FOPDT, np.array((2.0, 10.0, 3.0)), covariance))


def test_the_interval_of_a_parameter_is_its_own():
    found = _fopdt(np.diag((0.1, 0.8, 0.2)) ** 2)
    gain = found.estimate.uncertain(lambda m: m.gain)
    assert gain.std == pytest.approx(0.1, rel=1e-4)
    assert (gain.low, gain.high) == pytest.approx(
        (found.ci95_low[0], found.ci95_high[0]), rel=1e-4
    )
    delay = found.estimate.uncertain(lambda m: m.dead_time)
    assert (delay.low, delay.high) == pytest.approx((3.0 - 0.392, 3.0 + 0.392), rel=1e-4)


def test_the_interval_of_the_ultimate_gain_is_that_of_its_stated_deviation():
    found = _fopdt(np.diag((0.05, 0.3, 0.05)) ** 2)
    gain = found.estimate.uncertain(lambda m: identify_point(m))
    assert gain.value == pytest.approx(found.ultimate_gain)
    assert gain.std == pytest.approx(found.ultimate_gain_std, rel=1e-3)


def identify_point(model: TransferFunction) -> float:
    from relay_autotune.process.ultimate import ultimate_point

    point = ultimate_point(model)
    return math.nan if point is None else point.gain


def test_correlated_parameters_have_a_certain_ratio():
    # K and tau known to 30 % each, their ratio to 1 %.
    spread = np.array([[0.09, 0.08995, 0.0], [0.08995, 0.09, 0.0], [0.0, 0.0, 0.0]])
    size = np.array((2.0, 10.0, 1.0))
    found = _fopdt(spread * np.outer(size, size))
    ratio = found.estimate.uncertain(lambda m: m.gain / m.time_constants[0].real)
    assert ratio.std / ratio.value == pytest.approx(0.01, rel=1e-3)
    assert (ratio.low, ratio.high) == pytest.approx(
        (0.2 * math.exp(-0.0196), 0.2 * math.exp(0.0196)), rel=1e-4
    )


def test_what_has_no_covariance_has_no_interval():
    found = _fopdt(np.full((3, 3), math.nan))
    answer = found.estimate.uncertain(lambda m: m.gain)
    assert answer.value == 2.0
    assert math.isnan(answer.std)
    assert math.isnan(answer.low)


@pytest.mark.long
def test_a_profile_ends_where_the_sum_of_squares_has_risen_by_the_quantile():
    rng = np.random.default_rng(3)
    u = PiecewiseConstant(np.array([1.0, 9.0, 16.0]), np.array([1.0, -1.0, 1.0]), 0.0)
    time = np.linspace(0.0, 24.0, 240)
    y = response(TransferFunction.fopdt(1.0, 30.0, 2.0), time, u)
    problem = problem_of([(time, y + 0.02 * rng.standard_normal(time.size), u)], FOPDT)
    state = refine(problem, np.array((math.log(30.0), 2.0)))
    low, high = profile_ends(problem, state, lambda t, _: float(t[0]), 0.3, 1.96)
    degrees = time.size - state.parameters
    for end in (low, high):
        # By brute force: the best dead time beside each time constant.
        costs = [
            evaluate(problem, np.array((end, d))).cost
            for d in state.theta[1] + np.linspace(-0.6, 0.6, 1201)
        ]
        rise = math.sqrt((min(costs) / state.cost - 1.0) * degrees)
        assert rise == pytest.approx(1.96, rel=0.03)
    assert high - state.theta[0] > 1.05 * (state.theta[0] - low)


def test_a_gain_without_upper_end_is_said_to_have_none():
    found = identify(_record((1.0, 1.0, 0.02), 0.2, 3), "waveform", GIVEN)
    assert "gain" in found.undetermined
    assert found.ci95_low[0] < 1.0 < found.ci95_high[0]
    # The logarithm is not normal: the profile reaches further up than down.
    assert found.ci95_high[0] / found.values[0] > 1.2 * found.values[0] / found.ci95_low[0]


def test_combinations_are_told_where_parameters_are_not_determined():
    found = identify(_record((1.0, 1.0, 0.02), 0.1, 3), "waveform", GIVEN)
    named = {c.name: c for c in found.combinations}
    slope = named["gain/time_constant"]
    assert slope.ci95_low < 1.0 < slope.ci95_high
    assert slope.determined
    assert slope.ci95_high / slope.ci95_low < 1.1
    assert {"ultimate_gain", "ultimate_frequency"} <= set(named)
    assert any("bias" in a for a in found.advice)
    assert any("at rest" in a for a in found.advice)


def test_a_determined_model_needs_no_combinations():
    found = identify(_record((1.65, 20.0, 10.0), 0.05), "waveform", GIVEN)
    assert found.undetermined == ()
    assert found.combinations == ()
    assert found.advice == ()


@pytest.mark.long
def test_rivals_carry_what_an_ensemble_draws_from_and_widen_the_ultimate_point():
    model = TransferFunction.lag_n(1.0, 6.0, 8, 0.6)
    relay = RelaySettings(0.0, 0.0, 1.0)
    end = simulate_relay(model, relay, cycles=4).command.times[-1]
    run = simulate_relay(model, relay, cycles=4, time=np.linspace(0.0, end, 500))
    std = 0.1 * float(np.mean(np.abs(run.measurement)))
    record = run.record(noise_std=std, rng=np.random.default_rng(1))
    found = identify(record)
    counted = [r.estimate for r in found.rivals if r.estimate.known]
    assert counted
    assert 0.0 < found.support < 1.0
    assert found.support + sum(r.support for r in found.rivals) <= 1.0 + 1e-9
    for rival in counted:
        assert rival.covariance.shape == (rival.values.size,) * 2
        assert rival.structure.build(rival.values) == rival.model
        assert np.array_equal(rival.covariance, rival.root @ rival.root.T)
    known = Known(structure=found.structure, order=found.model.order)
    alone = identify(record, "waveform", known)
    assert alone.support == 1.0
    # The rivals differ in K_u, if little.
    assert found.ultimate_gain_std > alone.ultimate_gain_std


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_a_robust_loss_withstands_outliers_that_squares_do_not(loss):
    truth = np.array((1.65, 20.0, 10.0))
    clean = _record(tuple(truth), 0.05)
    rng = np.random.default_rng(5)
    many = rng.random(len(clean)) < 0.08
    spoiled = clean.measurement + np.where(many, rng.standard_normal(len(clean)) + 1.0, 0.0)
    record = replace(clean, measurement=spoiled)
    squares = identify(record, "waveform", GIVEN)
    robust = identify(record, "waveform", replace(GIVEN, loss=loss))
    assert np.all(robust.std < 0.5 * squares.std)
    assert np.all(np.abs(robust.values - truth) < 3.5 * robust.std)
    assert any(loss in w for w in robust.warnings)


@pytest.mark.long
def test_a_robust_loss_loses_five_percent_on_normal_noise():
    record = _record((1.65, 20.0, 10.0), 0.1)
    plain = identify(record, "waveform", GIVEN)
    for loss in ("huber", "tukey"):
        robust = identify(record, "waveform", replace(GIVEN, loss=loss))
        assert robust.std == pytest.approx(plain.std / math.sqrt(0.95), rel=0.06)
    with pytest.raises(ParameterError, match=r"loss is .*expected one of"):
        Known(loss="cubes")


def test_the_step_of_a_sensor_is_found():
    rng = np.random.default_rng(2)
    y = np.sin(np.linspace(0.0, 30.0, 900))
    assert quantisation_step(np.round(y / 0.1) * 0.1) == pytest.approx(0.1)
    assert quantisation_step(1e5 + np.round(y / 0.25) * 0.25) == pytest.approx(0.25)
    assert quantisation_step(y) == 0.0
    assert quantisation_step(y + 0.1 * rng.standard_normal(900)) == 0.0
    assert quantisation_step(np.full(900, 3.0)) == 0.0


def test_steps_of_the_sensor_larger_than_its_noise_are_told_and_widen_the_intervals():
    truth = np.array((1.65, 20.0, 10.0))
    record = _record(tuple(truth), 0.0)
    coarse = replace(record, measurement=np.round(record.measurement / 0.1) * 0.1)
    found = identify(coarse, "waveform", GIVEN)
    assert any("steps of 0.1" in w for w in found.warnings)
    assert np.all(np.abs(found.values - truth) < 3.0 * found.std)
    # With noise above the step rounding is as good as noise, and nothing is said.
    noisy = _record(tuple(truth), 0.3)
    dithered = replace(noisy, measurement=np.round(noisy.measurement / 0.1) * 0.1)
    found = identify(dithered, "waveform", GIVEN)
    assert not any("steps of" in w for w in found.warnings)


@pytest.mark.long
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))]
)
def test_a_limit_cycle_that_no_structure_explains_gives_a_warning_or_a_reason(seed):
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 100.0, 400)
    command = np.where(np.mod(time, 20.0) < 10.0, 1.0, -1.0)
    phases = rng.uniform(0.0, 2.0 * np.pi, 7)
    shape = sum(np.sin(k * np.pi * time / 10.0 + p) / k for k, p in enumerate(phases, start=1))
    record = Record(time, shape + 0.01 * rng.standard_normal(400), command, noise_std=0.01)
    try:
        found = identify(record)
    except IdentificationError as reason:
        assert str(reason)
        return
    assert np.all(np.isfinite(found.values))
    assert any("not white" in w or "larger than the noise" in w for w in found.warnings)
