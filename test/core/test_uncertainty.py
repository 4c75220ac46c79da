# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Draws of the posterior, wide intervals, combinations, advice, robust losses."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from relay_runs import simulate_relay

from relay_autotune.errors import IdentificationError, ParameterError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import Part
from relay_autotune.identification.waveform.candidates import Candidate
from relay_autotune.identification.waveform.determination import _combinations, advice
from relay_autotune.identification.waveform.fit_covariance import Fit, quantisation_step
from relay_autotune.identification.waveform.posterior import (
    _allowed,
    _difference_of_parts,
    posterior,
)
from relay_autotune.identification.waveform.problem import problem_of
from relay_autotune.identification.waveform.separable import evaluate, refine
from relay_autotune.process.response import response
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

pytestmark = pytest.mark.long

GIVEN = Known(structure="fopdt")


def _record(
    process: tuple[float, float, float], noise: float, seed: int = 0, bias: float = 0.0
) -> Record:
    model, relay = TransferFunction.fopdt(*process), RelaySettings(0.0, 0.0, 1.0, bias)
    run = simulate_relay(model, relay, cycles=5, time=600)
    std = noise * float(np.mean(np.abs(run.measurement))) * math.sqrt(math.pi / 2.0)
    return run.record(noise_std=std, rng=np.random.default_rng(seed))


def test_draws_are_as_likely_as_the_samples_make_them():
    """One lag of which a short record shows hardly more than the slope, by brute force."""
    rng = np.random.default_rng(3)
    u = PiecewiseConstant(np.array([1.0, 9.0, 16.0]), np.array([1.0, -1.0, 1.0]), 0.0)
    time = np.linspace(0.0, 24.0, 240)
    y = response(TransferFunction.fopdt(1.0, 30.0, 2.0), time, u)
    y = y + 0.02 * rng.standard_normal(time.size)
    scale = float(np.ptp(y))
    problem = problem_of([(time, y / scale, u)], FOPDT)
    state = refine(problem, np.array((math.log(30.0), 2.0)))
    model = FOPDT.model_at(state.theta, state.coefficients)
    assert model is not None
    only = Candidate(problem, state, model, 0.0)
    allowed = posterior(Fit(problem, state, (only,), scale), [1.0], 1.0, 0.5)
    # Posterior of the time constant: gain and offset are linear, the dead time is searched.
    variance = state.cost / (time.size - state.parameters)
    logs = state.theta[0] + np.linspace(-1.2, 1.6, 57)
    costs = np.array(
        [
            min(evaluate(problem, np.array((at, d))).cost for d in np.linspace(1.5, 2.5, 101))
            for at in logs
        ]
    )
    weights = np.exp(-0.5 * (costs - state.cost) / variance - 0.5 * (logs - state.theta[0]) ** 2)
    # The prior of the gain, which here moves with the time constant.
    weights *= np.exp(-0.5 * (logs - state.theta[0]) ** 2)
    std = math.sqrt(float(np.sum(weights * (logs - state.theta[0]) ** 2) / np.sum(weights)))
    drawn = np.log(allowed.values[:, 1]) - state.theta[0]
    assert math.sqrt(float(np.mean(drawn**2))) == pytest.approx(std, rel=0.2)


def test_a_gain_that_a_short_record_leaves_open_has_a_wide_interval():
    found = identify(_record((1.0, 1.0, 0.02), 0.2, 3), "waveform", GIVEN)
    assert "gain" in found.undetermined
    assert found.ci95_low[0] < 1.0 < found.ci95_high[0]
    # The slope alone is known: any larger gain explains the record, but none much smaller.
    assert found.ci95_low[0] > 0.2
    assert found.ci95_high[0] > 3.0


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


def test_the_sums_of_lags_say_that_a_zero_is_taken_off():
    model = TransferFunction(1.0, zeros=(0.3,), time_constants=(2.0, 0.5), dead_time=0.1)
    told = {name: of(model) for name, _, of in _combinations(model)}
    assert told["dead_time + smaller lags - zero"] == pytest.approx(0.1 + 0.5 - 0.3)
    assert told["dead_time + sum of lags - zero"] == pytest.approx(0.1 + 2.5 - 0.3)


def _stepped(held: float, noise: float, process: TransferFunction) -> Record:
    """Record three steps by hand, each held for a while, from rest."""
    time = np.arange(0.0, 20.0 + 3.0 * held)
    at = 20.0 + held * np.arange(3)
    u = PiecewiseConstant(at, np.array([1.0, 0.0, 1.0]), 0.0)
    y = response(process, time, u) + np.random.default_rng(1).normal(0.0, noise, time.size)
    return Record(time=time, measurement=y, command=u(time), held_input=u)


def test_steps_are_advised_for_a_time_even_where_a_zero_takes_off_more_than_all_small_lags():
    """A time below zero was said."""
    process = TransferFunction(1.0, zeros=(9.0,), time_constants=(20.0, 2.0), dead_time=1.0)
    found = identify(_stepped(80.0, 0.15, process), "waveform", Known(structure="sopdt_zero"))
    uncertain = replace(found, ultimate_frequency_std=math.inf)
    (told,) = [a for a in advice(uncertain, [_stepped(80.0, 0.15, process)]) if "to and fro" in a]
    held = re.search(r"held for about (-?[0-9.]+) s", told)
    assert held is not None and float(held[1]) > process.dead_time


@pytest.mark.parametrize("held", [15.0, 80.0])
def test_advice_fits_a_test_by_steps(held):
    """Where there was no relay none is told, nor steps that last longer than those that were."""
    process = TransferFunction.fopdt(1.0, 20.0, 6.0)
    found = identify(_stepped(held, 0.15, process), "waveform", GIVEN)
    assert "dead_time" in found.undetermined
    told = " ".join(found.advice)
    assert not any(word in told for word in ("relay", "cycle", "extra_delay", "amplitude"))
    assert ("a step of the command held for about" in told) == (held == 15.0)
    assert re.search(r"steps \d\.\d times as large", told)


def test_the_interval_of_a_dead_time_is_not_negative():
    found = identify(
        _stepped(40.0, 0.2, TransferFunction.fopdt(1.0, 20.0, 0.5)), "waveform", GIVEN
    )
    low, high = found.ci95_low[-1], found.ci95_high[-1]
    assert found.parameters[-1] == "dead_time"
    assert 0.0 <= low <= found.values[-1] < high


def test_a_determined_model_needs_no_combinations():
    found = identify(_record((1.65, 20.0, 10.0), 0.05), "waveform", GIVEN)
    assert found.undetermined == ()
    assert found.combinations == ()
    assert found.advice == ()


@pytest.mark.nightly
def test_rivals_have_support():
    model = TransferFunction.lag_n(1.0, 6.0, 8, 0.6)
    relay = RelaySettings(0.0, 0.0, 1.0)
    run = simulate_relay(model, relay, cycles=4, time=500)
    std = 0.1 * float(np.mean(np.abs(run.measurement)))
    record = run.record(noise_std=std, rng=np.random.default_rng(1))
    found = identify(record)
    assert any(r.model.structure == "lag_n" for r in found.rivals)
    assert all(0.0 < each.support < 1.0 for each in (found, *found.rivals))
    assert found.support + sum(r.support for r in found.rivals) <= 1.0 + 1e-9


@pytest.mark.nightly
@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_a_robust_loss_withstands_outliers_that_squares_do_not(loss):
    truth = np.array((1.65, 20.0, 10.0))
    clean = _record(tuple(truth), 0.05)
    rng = np.random.default_rng(5)
    # More than are taken for spikes of the sensor and left out.
    many = rng.random(len(clean)) < 0.15
    spoiled = clean.measurement + np.where(many, rng.standard_normal(len(clean)) + 1.0, 0.0)
    record = replace(clean, measurement=spoiled)
    squares = identify(record, "waveform", GIVEN)
    robust = identify(record, "waveform", replace(GIVEN, loss=loss))
    assert np.all(robust.std < 0.5 * squares.std)
    assert np.all(np.abs(robust.values - truth) < 3.5 * robust.std)
    assert any(loss in w for w in robust.warnings)
    if loss == "tukey":
        # What it leaves out is not what the model leaves.
        assert robust.fit.residual_rms < 0.2 * squares.fit.residual_rms
        assert np.isnan(robust.fitted[many]).mean() > 0.6


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


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 1, 2])
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
    assert any("is correlated" in w or "larger than the noise" in w for w in found.warnings)


def test_a_part_with_one_model_says_nothing_of_the_scatter_between_parts():
    one = Part(0.0, 1.0, (TransferFunction.fopdt(2.0, 1.0, 0.5),))
    three = Part(1.0, 2.0, tuple(TransferFunction.fopdt(g, 1.0, 0.5) for g in (1.0, 1.1, 1.2)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _difference_of_parts((one, three), 1.0) == 0.0
    assert _difference_of_parts((three, three), 1.0) == pytest.approx(0.0)


@pytest.mark.parametrize(("end", "explained"), [(400, True), (200, False)])
def test_samples_that_no_response_explains_tell_nothing_of_a_process(end, explained):
    """A rest with a slow disturbance gave a motor the other direction."""
    rng, time = np.random.default_rng(1), 0.05 * np.arange(400)
    u = PiecewiseConstant(np.array([9.0, 12.0]), np.array([0.01, 1.0]), 0.0)
    y = response(TransferFunction.fopdt(2.0, 1.0, 0.3), time, u)
    y = y + 0.05 * np.cumsum(rng.standard_normal(time.size)) + 0.01 * rng.standard_normal(400)
    problem = problem_of([(time[:end], y[:end], u)], FOPDT)
    known = np.array([2.0]), np.array([0.0, 0.3])
    drawn = _allowed(problem, *known, 1.0, lambda left: float(left @ left) / end, 10, rng)
    assert drawn.explains is explained
