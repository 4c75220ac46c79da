# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A load that comes in a record: early in a test, or while a controller works."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from virtual_tune import tuned

from relay_autotune.analysis import analyse, model_so_far
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.waveform.problem import nuisances_of, problem_of
from relay_autotune.process.structures import FOPDT, structure_named
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import PiecewiseConstant, Record

pytestmark = pytest.mark.long

FIRST_ORDER = structure_named("fopdt").of_fields(gain=1.65, time_constants=[20.0], dead_time=10.0)
SECOND_ORDER = structure_named("sopdt").of_fields(
    gain=1.0, time_constants=[20.0, 8.0], dead_time=4.0
)
PERIOD = 0.2


def run(model, *, load_time, load_size, noise_std, seed):
    acting = {"load_time": load_time, "load_size": load_size, "noise_std": noise_std}
    return tuned(model, ExperimentParameters(amplitude=1.0), period=PERIOD, seed=seed, **acting)


@pytest.mark.parametrize(
    ("model", "load_time", "load_size", "noise_std"),
    [
        # Without the load in the model, K_u was 13 % and 8 % off.
        pytest.param(FIRST_ORDER, 22.8, 0.4, 0.0, marks=pytest.mark.nightly),
        (SECOND_ORDER, 25.6, 0.2, 0.0114),
    ],
)
def test_a_load_in_the_first_two_cycles_is_estimated(model, load_time, load_size, noise_std):
    tune = run(model, load_time=load_time, load_size=load_size, noise_std=noise_std, seed=1003)
    assert tune.cycle_count == 3
    found = model_so_far(tune.record()).model
    assert found is not None
    truth = ultimate_point(model)
    error = found.ultimate_gain / truth.gain - 1.0
    assert abs(error) < 0.015
    if noise_std:
        assert abs(error) < 3.0 * found.ultimate_gain_std / truth.gain
    said = next(text for text in found.warnings if text.startswith("a load step of"))
    size, time = (float(said.split()[k]) for k in (4, 7))
    assert size == pytest.approx(load_size, rel=0.1)
    assert time == pytest.approx(load_time, abs=3.0)


@pytest.mark.nightly
def test_a_load_that_no_structure_explains_does_not_pass_for_no_response():
    # What the models leave is so correlated that the simplest was chosen, which leaves all of it.
    tune = run(SECOND_ORDER, load_time=70.17, load_size=-0.4, noise_std=0.0, seed=1000)
    found = model_so_far(tune.record()).model
    assert found is not None
    assert found.ultimate_gain == pytest.approx(ultimate_point(SECOND_ORDER).gain, rel=1e-3)


@pytest.mark.parametrize("noise_std", [0.0114, math.nan])
def test_no_load_is_found_where_noise_explains_what_is_left(noise_std):
    # The cycles of a running test do not tell how large the noise is.
    tune = run(SECOND_ORDER, load_time=0.0, load_size=0.0, noise_std=0.0114, seed=1003)
    record = replace(tune.record(), noise_std=noise_std)
    found = identify(record, "waveform", Known(structure="sopdt"))
    assert not any("load step" in text for text in found.warnings)


@pytest.mark.nightly
def test_what_is_not_known_of_the_load_widens_the_intervals():
    tune = run(SECOND_ORDER, load_time=25.6, load_size=0.2, noise_std=0.0114, seed=1003)
    known, record = Known(structure="sopdt"), tune.record()
    loaded = identify(record, "waveform", known)
    u = record.input()
    times = np.union1d(u.times, [25.6])
    driven = PiecewiseConstant(times, u(times) + 0.2 * (times >= 25.6), u.initial)
    as_if_known = identify(replace(record, held_input=driven), "waveform", known)
    assert loaded.ultimate_gain_std > as_if_known.ultimate_gain_std
    assert np.all(np.diag(loaded.covariance) > np.diag(as_if_known.covariance))


@pytest.mark.nightly
@pytest.mark.parametrize(("noise_std", "seed"), [(0.0114, 1003), (0.0001, 3)])
def test_all_draws_are_had_beside_a_load_and_a_zero_that_a_dead_time_cancels(noise_std, seed):
    acting = {"load_time": 25.6, "load_size": 0.2, "noise_std": noise_std, "seed": seed}
    record = run(SECOND_ORDER, **acting).record()
    found = identify(record, "waveform", Known(structure="sopdt_zero"))
    # By the slopes of the model alone 35 and 1 were had.
    assert len(found.draws) >= 90


def controlled(
    load,
    *,
    lags=(120.0, 25.0, 8.0),
    late=6.0,
    kc=1.0,
    times=(80.0, 200.0, 900.0),
    samples=800,
    noise_std=0.1,
    seed=2,
):
    """Record a step of the set-point, and later one of the load, under a PI controller.

    :param times: the controller's ti, and when the two steps come [s].
    """
    interval, parts = 2.0, 8
    ti, moved, loaded = times
    rng, step = np.random.default_rng(seed), interval / parts
    states, integral = [0.0] * len(lags), 0.0
    commands = [0.0] * (round(late / step) + 1)
    delayed = len(commands)
    y, u = np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        y[k] = states[-1] + rng.normal(0.0, noise_std)
        error = (20.0 if k * interval >= moved else 0.0) - y[k]
        integral += error * interval / ti
        u[k] = kc * (error + integral)
        for _ in range(parts):
            commands.append(float(u[k]))
            into = 3.0 * (commands[-delayed] + (load if k * interval >= loaded else 0.0))
            for i, lag in enumerate(lags):
                states[i] += step * (into - states[i]) / lag
                into = states[i]
    return Record(interval * np.arange(samples), y, u)


@pytest.mark.nightly
@pytest.mark.parametrize("load", [0.0, -5.0])
def test_a_load_under_a_controller_does_not_change_the_model(load):
    """It was taken for a slow disturbance, and the gain for two thirds of what it is."""
    found = identify(controlled(load), "waveform")
    assert found.loaded is (load != 0.0)
    assert found.model.gain == pytest.approx(3.0, rel=0.02)
    assert sum(t.real for t in found.model.time_constants) + found.model.dead_time == (
        pytest.approx(159.0, rel=0.05)
    )


def test_a_load_at_0_s_counts_as_one():
    """It was taken for none, and added without end."""
    time = np.arange(20.0)
    problem = problem_of([(time, 0.0 * time, PiecewiseConstant([5.0], [1.0], 0.0))], FOPDT)
    assert nuisances_of(problem, ("load",)) == (False,)
    assert nuisances_of(replace(problem, load=0.0), ("load",)) == (True,)


@pytest.mark.nightly
def test_a_load_is_found_beside_white_noise_that_looks_coloured_by_chance():
    """Of white residuals, too, some are given a colour: that is no slow disturbance."""
    record = controlled(
        -3.0, lags=(60.0, 20.0), late=8.0, kc=0.5, times=(60.0, 80.0, 220.0),
        samples=300, noise_std=0.3, seed=1,
    )  # fmt: skip
    found = identify(record, "waveform")
    assert found.loaded
    assert found.model.gain == pytest.approx(3.0, rel=0.05)


@pytest.mark.nightly
def test_gains_hold_where_a_load_after_the_only_move_was_a_part_of_the_response():
    """Two paths to one measurement; Ms was 26, and the gains were trusted."""
    early, delay = 0.5, 10.0

    def answer(t):
        first, second = (1.0 - np.exp(-np.maximum(t - d, 0.0) / 8.0) for d in (3.0, 3.0 + delay))
        return 10.0 * (early * first + (1.0 - early) * second)

    time = np.arange(0.0, 90.0, 0.3)
    y = answer(time - 9.0) + np.random.default_rng(1).normal(0.0, 0.1, time.size)
    u = np.where(time >= 9.0 - 1e-9, 60.0, 50.0)
    found = analyse(Record(time=time, measurement=y, command=u), alone=True)
    assert any("a part of the response" in text for text in found.model.warnings)
    gains, s = found.best_gains, 1j * np.geomspace(1e-3, 10.0, 20_000)
    paths = early + (1.0 - early) * np.exp(-delay * s)
    law = gains.kc * (1.0 + 1.0 / (gains.ti * s) + gains.td * s) / (1.0 + gains.tf * s)
    loop = law * paths * np.exp(-3.15 * s) / (1.0 + 8.0 * s)
    # Stable: the loop turns by no more than its own right angle about -1.
    turn = np.unwrap(np.angle(1.0 + loop))
    assert abs(turn[-1] - turn[0] - 0.5 * math.pi) < 0.1
    assert np.max(1.0 / np.abs(1.0 + loop)) < 1.6
