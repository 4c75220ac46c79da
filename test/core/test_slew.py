# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Actuators and servos that follow no change of the command faster than at some rate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from relay_autotune.analysis import analyse
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record

COMMAND = PiecewiseConstant(np.array([1.0, 2.0, 2.5, 6.0]), np.array([3.0, -1.0, 2.0, 1.9]), 0.5)


def test_a_slewed_command_follows_at_the_rate():
    time = np.arange(0.0, 10.0, 1e-3)
    level, followed = COMMAND.initial, []
    for target in COMMAND(time):
        followed.append(level)
        level += float(np.clip(target - level, -2e-3, 2e-3))
    ramps = COMMAND.slewed(2.0)
    slopes = np.append(0.0, ramps.slopes)[np.searchsorted(ramps.times, time, side="right")]
    exact = ramps.initial + 1e-3 * np.cumsum(np.append(0.0, slopes[:-1]))
    np.testing.assert_allclose(exact, followed, atol=6e-3)


def test_the_response_to_ramps_is_exact():
    time = np.arange(0.0, 10.0, 1e-3)
    ramps = COMMAND.slewed(2.0)
    slopes = np.append(0.0, ramps.slopes)[np.searchsorted(ramps.times, time, side="right")]
    moved = 1e-3 * np.cumsum(np.append(0.0, slopes[:-1]))
    _, exact, _ = lsim(([2.0], [0.3, 1.0]), moved, time)
    found = response(TransferFunction.fopdt(2.0, 0.3, 0.0), time, ramps)
    np.testing.assert_allclose(found, exact, atol=6e-3)


@pytest.mark.long
@pytest.mark.parametrize("moves", [[0.0, 1.0], [0.0, 1.0, -0.4, 0.5]])
def test_gains_of_a_servo_are_for_moves_below_its_speed(moves):
    """They were for the slow answer to large moves, and made the loop unstable."""
    k, speed, step, rng = 15.0, 60.0, 0.01, np.random.default_rng(3)
    time = step * np.arange(1200)
    command = 40.0 * rng.choice(moves, 30)[(time / 0.4).astype(int)]
    angle, y = command[0], []
    for i in range(time.size):
        for _ in range(10):
            away = command[max(i - 3, 0)] - angle
            angle += 0.1 * step * float(np.clip(k * away, -speed, speed))
        y.append(angle)
    found = analyse(Record(time, np.array(y) + 0.1 * rng.standard_normal(time.size), command))
    assert found.model.rate == pytest.approx(speed, rel=0.05)
    assert any("no change of the command is followed faster" in w for w in found.model.warnings)
    small = TransferFunction.fopdt(1.0, 1.0 / k, 0.035)
    assert analyse_loop(found.best_gains, small).ms < 1.75


@pytest.mark.long
def test_a_linear_process_has_no_rate():
    step, rng = 0.1, np.random.default_rng(1)
    time = step * np.arange(1500)
    command = rng.choice([0.0, 1.0], 40)[(time / 4.0).astype(int)]
    process = TransferFunction(2.0, (), (1.0, 0.9, 0.8), 0, 0.3)
    y = response(process, time, PiecewiseConstant.from_samples(time, command))
    found = analyse(Record(time, y + 0.02 * rng.standard_normal(time.size), command))
    assert found.model.rate == np.inf
