# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A baseline that is said to be the present command, and is not."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.signal import lfilter

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import State
from relay_autotune.experiment.settling import RestWatch, rest_state, slow_movement
from relay_autotune.process.structures import structure_named
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.record.record import Outcome

# A pressure that falls when the valve opens further: 6 bar at 1200, 9.2 bar at 1040.
PROCESS = structure_named("fopdt").of_fields(gain=-0.02, time_constants=[8.0], dead_time=2.0)
PERIOD = 0.1
PARAMETERS = ExperimentParameters(amplitude=40.0, measurement_min=3.0, measurement_max=9.0)


def tuned(
    baseline: float, seed: int, samples: int, *, watched: bool = True, **acting: float
) -> tuple[RelayExperiment, float]:
    """Return an experiment up to its first kick or its end, and the largest measurement."""
    plant = VirtualProcess(
        PROCESS, rest_measurement=6.0, rest_command=1200.0,
        disturbances=Disturbances(**acting), seed=seed,
    )  # fmt: skip
    before = [plant.measure(k * PERIOD) for k in range(samples)]
    tune = RelayExperiment(PARAMETERS, baseline, before=before if watched else None)
    highest = -np.inf
    for k in range(samples, samples + 6000):
        y = plant.measure(k * PERIOD)
        highest = max(highest, y)
        plant.command(tune.step(k * PERIOD, y), k * PERIOD)
        if tune.state is not State.SETTLING:
            break
    return tune, highest


@pytest.mark.parametrize("acting", [{}, {"quantisation": 0.02}, {"noise_std": 0.02}])
@pytest.mark.parametrize("baseline", [1040.0, 1100.0])
def test_a_wrong_baseline_ends_the_tune_before_the_process_is_far_away(acting, baseline):
    for seed in range(20 if acting else 1):
        tune, highest = tuned(baseline, seed, 50, **acting)
        assert tune.outcome is Outcome.FAILED
        assert re.match(r"the measurement rested at (6|6\.0\d+|5\.9\d+) y", tune.reason)
        assert f"{baseline:g} u is not the present command" in tune.reason
        # It would go to 9.2 or 8.
        assert highest < 6.6
        assert tune.settings is None


def test_without_the_word_that_it_is_the_present_command_a_baseline_may_lead_elsewhere():
    tune, _ = tuned(1100.0, 1, 50, watched=False, noise_std=0.02)
    assert tune.state is State.KICK
    assert tune.facts.rest.mean == pytest.approx(8.0, abs=0.2)


@pytest.mark.long
@pytest.mark.parametrize(
    "acting",
    [
        {},
        {"quantisation": 0.02},
        {"noise_std": 0.02},
        {"noise_std": 0.02, "drift": 0.003},
        {"noise_std": 0.02, "quantisation": 0.05, "drift": -0.003},
        {"quantisation": 0.02, "drift": 0.002},
    ],
)
@pytest.mark.parametrize("samples", [0, 25, 100])
def test_the_right_baseline_starts_the_relay_in_spite_of_noise_and_drift(acting, samples):
    for seed in range(20 if "noise_std" in acting else 1):
        tune, _ = tuned(1200.0, seed, samples, **acting)
        assert tune.outcome is not Outcome.FAILED, (seed, tune.reason)


def test_a_small_error_that_may_be_a_drift_is_told():
    for seed in range(6):
        tune, _ = tuned(1190.0, seed, 22, noise_std=0.01)
        tune.abort("enough")
        assert "the measurement rested at" in tune.reason, (seed, tune.reason)
        assert "present command" in tune.reason
        tune, _ = tuned(1200.0, seed, 22, noise_std=0.01)
        tune.abort("enough")
        assert "rested" not in tune.reason


def test_slow_noise_and_the_rest_of_a_transient_are_no_departure():
    for seed in range(40):
        draw = np.random.default_rng(seed)
        noise, slow = draw.standard_normal(1000), np.zeros(1000)
        for k in range(1, 1000):
            slow[k] = 0.9 * slow[k - 1] + 0.1 * noise[k]
        for y in (6.0 + slow, 6.0 + np.exp(-np.arange(1000) / 100.0) + 0.01 * noise):
            watch = RestWatch(y[:100])
            assert not any(watch.leaves(value) for value in y[100:]), seed


def test_what_moved_before_the_rest_does_not_hide_that_it_leaves():
    noise = 0.02 * np.random.default_rng(3).standard_normal(300)
    moved = np.where(np.arange(200) < 80, 100.0, 6.0) + noise[:200]
    watch = RestWatch(moved)
    told = [watch.leaves(6.0 + 0.01 * k + noise[200 + k]) for k in range(60)]
    assert told[-1] and watch.rested_at == pytest.approx(6.0, abs=0.01)


@pytest.mark.parametrize("period", [40.0, 60.0, 1e9])
def test_a_loop_that_still_swings_back_is_not_at_rest(period):
    """The line through a transient is level where it returns, and scatters a lot."""
    samples = np.arange(50.0)
    noise = np.random.default_rng(3).standard_normal((300, 50))
    swing = 8.0 * np.exp(-samples / 20.0) * np.cos(2.0 * np.pi * samples / period)
    moved, allowed = np.transpose([slow_movement(0.15 * n + swing) for n in noise])
    assert np.all(moved > 3.0 * allowed)
    # The noise is seen behind it.
    assert np.median(allowed) == pytest.approx(4.0 * 0.15, rel=0.2)


@pytest.mark.parametrize("samples", [10, 13, 50])
def test_white_noise_is_at_rest_wherever_it_is(samples):
    noise = np.random.default_rng(4).standard_normal((500, samples))
    at_rest = [np.less_equal(*slow_movement(20.0 + 3.0 * n)) for n in noise]
    assert np.mean(at_rest) > 0.99
    assert slow_movement(np.full(samples, 0.1))[0] == pytest.approx(0.0, abs=1e-15)


def test_slow_noise_is_told_by_its_scatter_about_a_line():
    """By white noise alone a loop with slow noise would never be at rest."""
    white = np.random.default_rng(5).standard_normal((400, 150))
    slow = lfilter([1.0], [1.0, -0.9], white)[:, 100:]
    samples = np.arange(50.0)
    moved, allowed = np.transpose([slow_movement(y) for y in slow])
    assert np.mean(moved > allowed) > 0.9
    scatter = np.array([rest_state(samples, y, 50).noise_std for y in slow])
    assert np.mean(moved < 4.0 * scatter) > 0.8


def test_a_limit_names_the_command_that_was_wrong_or_the_amplitude_that_was_too_large():
    def end(baseline: float) -> str:
        plant = VirtualProcess(PROCESS, rest_measurement=6.0, rest_command=1200.0)
        limits = ExperimentParameters(amplitude=40.0, measurement_min=5.8, measurement_max=6.2)
        tune = RelayExperiment(limits, baseline, before=[6.0] * 50)
        k = 0
        while not tune.finished:
            plant.command(tune.step(k * PERIOD, plant.measure(k * PERIOD)), k * PERIOD)
            k += 1
        assert tune.outcome is Outcome.ABORTED
        return tune.reason

    assert "give a smaller amplitude than 40 u, or wider limits" in end(1200.0)
    assert "only 0 u was commanded: that is not the present command" in end(0.0)
