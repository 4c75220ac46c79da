# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The sampled closed loop against the continuous one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from relay_autotune.control.controller import PidController, simulate_closed_loop
from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop, analyse_loop
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate
from relay_autotune.loop.laws import LAWS, OWN_LAW
from relay_autotune.loop.sampled import filter_matrices
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.candidates import filters_of

MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)
PI, PID = Controller(0.67, 21.1), Controller(0.7, 16.0, 3.7, 0.37, 0.6)


@pytest.mark.nightly
@pytest.mark.parametrize("gains", [PI, PID])
def test_the_responses_tend_to_the_continuous_ones(gains):
    setpoint, load = Loop(gains, MODEL).step_responses(400.0, 1 << 14)
    for continuous, step in ((setpoint, {"setpoint": 1.0}), (load, {"load": 1.0})):
        run = simulate_closed_loop(gains, MODEL, period=0.05, duration=200.0, **step)
        for name in ("measurement", "command"):
            expected = np.interp(run.time, continuous.time, getattr(continuous, name))
            found = getattr(run, name)
            # At the jump itself the transform of the first kick is cut off.
            error = np.abs(found - expected)[run.time > 0.5]
            assert error.max() < 1.5e-2 * np.abs(expected).max()
            assert np.median(error) < 2e-3 * np.abs(expected).max()


def test_the_loop_settles_at_the_set_point_against_a_load():
    run = simulate_closed_loop(
        PI, MODEL, period=0.5, duration=600.0, setpoint=2.0, load=0.3, load_time=250.0
    )
    assert run.measurement[-1] == pytest.approx(2.0, abs=1e-3)
    assert run.command[-1] == pytest.approx(2.0 / 1.65 - 0.3, abs=1e-3)
    before = run.measurement[run.time < 250.0]
    assert before[-1] == pytest.approx(2.0, abs=1e-2)


def test_within_its_limits_the_controller_does_not_wind_up():
    limits = {"low": -0.2, "high": 0.7}
    for gains in (PI, PID):
        run = simulate_closed_loop(
            gains, MODEL, period=0.5, duration=600.0, setpoint=1.0, **limits
        )
        assert run.command.max() <= 0.7
        assert run.command.min() >= -0.2
        # Wound up, the integral alone would carry the measurement half as far again.
        assert run.measurement.max() < 1.1
        assert run.measurement[-1] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("period", [0.25, 1.0])
def test_the_noise_in_the_command_is_what_was_predicted(period):
    noise = np.random.default_rng(1).standard_normal(3001)
    for gains in (PI, PID):
        run = simulate_closed_loop(
            gains, MODEL, period=period, duration=3000 * period, noise=noise
        )
        assert np.std(run.command[400:]) == pytest.approx(
            analyse_loop(LAWS[OWN_LAW].at(gains, period), MODEL).noise_gain, rel=0.06
        )


def test_without_a_filter_the_derivative_is_the_difference_quotient():
    law = PidController(Controller(2.0, 0.0, 0.5), 0.0)
    for t, y in ((-0.1, 0.0), (0.0, 1.0), (0.1, 1.3)):
        command = law.step(t, 0.0, y)
    assert command == pytest.approx(-2.0 * (1.3 + 0.5 * 3.0))


def test_the_filter_lags_by_its_time_constant_at_any_period():
    # On a ramp the filtered value is late by tf, and its slope is the ramp's.
    for period in (0.05, 0.5, 5.0):
        law = PidController(Controller(1.0, 0.0, 0.0, 2.0), 0.0)
        for k in range(int(60.0 / period)):
            command = law.step(k * period, 0.0, k * period)
        assert command == pytest.approx(-(k * period - 2.0), abs=1e-6)


@pytest.mark.parametrize("tf", [0.02, 0.3, 2.0, 50.0])
def test_the_filter_moves_as_the_matrix_exponential_has_it(tf):
    period, stiff = 0.4, 2.0 / tf**2
    # State, input, and the input's slope times the period.
    chain = np.zeros((4, 4))
    chain[0, 1] = 1.0
    chain[1, :3] = -stiff, -2.0 / tf, stiff
    chain[2, 3] = 1.0 / period
    moved = expm(chain * period)
    turn, past, present = filter_matrices(tf, period)
    assert turn == pytest.approx(moved[:2, :2], rel=1e-9, abs=1e-12)
    assert present == pytest.approx(moved[:2, 3], rel=1e-9)
    assert past + present == pytest.approx(moved[:2, 2], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("ratio", [300.0, 9000.0])
def test_a_slow_filter_leaves_the_noise_of_its_bandwidth(ratio):
    rate = LawRate(LAWS[OWN_LAW], 0.1)
    tf, td = np.full(2, ratio * rate.period), np.array([0.0, 1e3]) * ratio * rate.period
    # Integrals of |F(jw)|^2 and |w F(jw)|^2 with F = 1/(1 + tf s + (tf s)^2/2).
    exact = np.sqrt((0.5 + np.array([0.0, 1e6])) / ratio)
    # Between the entries of the table the noise is off by up to 1 %.
    assert filters_of(rate, td, exact, math.inf) == pytest.approx(tf, rel=0.024)


def test_a_period_or_limits_without_sense_are_refused():
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(TuningError, match="sampling period"):
            simulate_closed_loop(PI, MODEL, period=bad, duration=1.0)
    with pytest.raises(TuningError, match="no range"):
        simulate_closed_loop(PI, MODEL, period=1.0, duration=1.0, low=1.0, high=1.0)


@pytest.mark.long
def test_the_integrated_error_is_that_of_the_samples():
    run = simulate_closed_loop(PI, MODEL, period=0.1, duration=300.0, load=1.0)
    iae = float(np.sum(np.abs(run.measurement)) * 0.1)
    assert iae == pytest.approx(analyse_loop(PI, MODEL).iae_load, rel=5e-3)
