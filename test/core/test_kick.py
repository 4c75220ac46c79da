# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Seeing a response, and which way it goes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_autotune.experiment.settling import (
    DirectionWatch,
    ResponseDetector,
    RestState,
    Settling,
    rest_state,
)
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant


def at_rest(noise_std=0.0, mean=0.0):
    return RestState(mean, 0.0, noise_std, 1.0, 100, 0.0)


def test_without_noise_one_sample_is_a_response():
    detector = ResponseDetector(at_rest(mean=2.0), 0.0)
    assert not detector.add(0.1, 2.0)
    assert detector.add(0.2, 2.0 - 1e-9)
    assert (detector.last_inside, detector.first_outside, detector.side) == (0.1, 0.2, -1)


def test_with_noise_three_samples_on_one_side_are():
    detector = ResponseDetector(at_rest(noise_std=1.0), 0.0)
    values = [0.0, 3.5, 3.5, 0.0, 4.0, -4.0, 4.0, 3.1, 3.2]
    seen = [detector.add(float(k), y) for k, y in enumerate(values)]
    assert seen == [False] * 8 + [True]
    assert (detector.last_inside, detector.first_outside, detector.side) == (5.0, 6.0, 1)


def test_white_noise_is_no_response():
    detector = ResponseDetector(at_rest(noise_std=1.0), 0.0)
    noise = np.random.default_rng(3).standard_normal(200_000)
    assert not any(detector.add(float(k), y) for k, y in enumerate(noise))


def watched(model, period, noise_std=0.0, seed=0):
    """Run kick, pulse and watch as an experiment does; return sign and intervals used."""
    time = np.arange(100_000) * period
    step = response(model, time, PiecewiseConstant(np.array([0.0]), np.array([1.0]), 0.0))
    noise = noise_std * np.random.default_rng(seed).standard_normal(time.size)
    rest = at_rest(noise_std)
    detector = ResponseDetector(rest, 0.0)
    k = 1
    while not detector.add(float(time[k]), float(step[k] + noise[k])):
        k += 1
    interval = max(detector.first_outside, 2.0 * period)
    end = time[k] + interval
    pulse = PiecewiseConstant(np.array([0.0, end]), np.array([1.0, 0.0]), 0.0)
    y = response(model, time, pulse) + noise
    watch = DirectionWatch(interval, float(time[k]), rest, detector.side)
    first = k
    while not watch.add(float(time[k]), float(y[k])):
        k += 1
    return watch.sign, (time[k] - time[first]) / interval


@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize("noise_std", [0.0, 0.01])
@pytest.mark.parametrize("ratio", [0.05, 0.2, 0.5, 1.0, 3.0])
def test_a_first_order_process_shows_its_sign_soon(gain, noise_std, ratio):
    model = TransferFunction.fopdt(gain, 1.0, ratio)
    sign, intervals = watched(model, ratio / 50, noise_std * min(1.0, ratio))
    assert sign == gain
    assert intervals < 15


@pytest.mark.long
@pytest.mark.parametrize("zero", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("dead_time", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("integrators", [0, 1])
def test_inverse_response_is_seen_through(zero, dead_time, integrators):
    for gain in (1.0, -1.0):
        model = TransferFunction(gain, (-zero,), (1.0, 1.0), integrators, dead_time)
        assert watched(model, dead_time / 20)[0] == gain


def test_steadiness_of_noise_of_a_drift_and_of_a_constant():
    time = np.arange(400) * 0.1
    noise = np.random.default_rng(2).standard_normal(400)
    still = rest_state(time, 5.0 + 0.3 * noise, 400)
    assert still.is_steady
    assert still.noise_std == pytest.approx(0.3, rel=0.1)
    assert still.mean == pytest.approx(5.0, abs=0.05)
    drifting = rest_state(time, 0.3 * noise + 0.1 * time, 400)
    assert not drifting.is_steady
    assert drifting.slope == pytest.approx(0.1, rel=0.1)
    assert drifting.noise_std == pytest.approx(0.3, rel=0.1)
    constant = rest_state(time, np.full(400, 0.1), 400)
    assert constant.is_steady
    assert (constant.mean, constant.noise_std, constant.slope) == (0.1, 0.0, 0.0)
    assert not rest_state(np.zeros(30), noise[:30], 30).is_steady
    assert not rest_state(time, 2.0 * time, 400).is_steady


def test_the_looks_cost_little_in_the_long_run():
    settling = Settling()
    looked = []
    for n in range(1, 10_000):
        if settling.is_due(n):
            settling.look(np.arange(float(n)), np.arange(float(n)))
            looked.append(n)
    assert looked[0] == 20
    assert sum(looked) < 6 * looked[-1]
    assert math.isclose(looked[-1] / looked[-2], 1.25, rel_tol=0.01)
