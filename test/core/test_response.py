# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exact responses against matrix exponentials of the companion form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from scipy.linalg import expm

from relay_autotune.errors import RecordError
from relay_autotune.identification.waveform.rational import Inputs, columns_of
from relay_autotune.process.response import response
from relay_autotune.process.structures import (
    FOPDT,
    INTEGRATOR_INVERSE,
    LAG_COMPLEX,
    UNSTABLE_FOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant
from relay_autotune.record.record import PiecewiseConstant

INPUT = PiecewiseConstant(np.array([0.0, 3.3, 7.7, 20.0]), np.array([1.0, -1.0, 0.5, -0.3]), 0.0)
# None of the times falls on a change of the input, where a biproper process jumps.
TIME = np.linspace(-1.0, 40.0, 83) + 0.01234


def _step_response(model: TransferFunction, t: float) -> float:
    if t <= 0.0:
        return 0.0
    a, b, c, d = signal.tf2ss(model.numerator, model.denominator)
    n = a.shape[0]
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n:] = a, b
    return float((c @ expm(block * t)[:n, n])[0] + d[0, 0])


def _by_superposition(model, time, u):
    steps = np.diff(u.values, prepend=u.initial)
    return np.array(
        [
            sum(
                step * _step_response(model, t - at - model.dead_time)
                for step, at in zip(steps, u.times, strict=True)
            )
            for t in time
        ]
    )


MODELS = {
    "fopdt": TransferFunction.fopdt(1.65, 20.0, 10.0),
    "eight equal lags": TransferFunction.lag_n(1.0, 6.0, 8, 0.6),
    # The mean of its poles and the step's is all rounding.
    "lag and growth alike": TransferFunction(1.0, (), (32.0, -32.0 * (1.0 + 1e-15)), 0, 0.5),
    "nearly equal lags": TransferFunction(1.0, (), (1.0, 1.0001, 1.1), 0, 0.5),
    "lags nearly apart": TransferFunction(1.0, (), (1.0, 1.0, 1.11, 1.11, 1.23, 1.23), 0, 0.5),
    "a pair near a lag": TransferFunction(1.0, (), (2.0, 2.0 + 0.15j, 2.0 - 0.15j), 0, 0.5),
    "two pairs near each other": TransferFunction(
        1.0, (), (1 + 1j, 1 - 1j, 1.05 + 1.02j, 1.05 - 1.02j), 1, 0.5
    ),
    "lags in a ladder": TransferFunction(1.0, (0.3,), (1.0, 1.3, 1.7, 2.2), 0, 0.5),
    "far apart": TransferFunction.sopdt(37.3, (7200.0, 2.0), 1.0),
    "underdamped": TransferFunction.oscillator(1.0, 2.0, 0.05, 0.123456789),
    "lag and pair": LAG_COMPLEX.build((1.0, 2.0, 1.9, 0.2, 0.5)),
    "inverse response": INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
    "double integrator": TransferFunction(0.2, (2.0,), (1.0,), 2, 0.3),
    "unstable": UNSTABLE_FOPDT.build((1.0, 5.0, 0.3)),
    "unstable pair": TransferFunction(1.0, (), (-2 + 1j, -2 - 1j), 0, 0.1),
    "biproper": TransferFunction(2.0, (0.5,), (3.0,), 0, 1.0),
}


@pytest.mark.long
@pytest.mark.parametrize("name", MODELS)
def test_response_equals_the_matrix_exponential(name):
    model = MODELS[name]
    truth = _by_superposition(model, TIME, INPUT)
    np.testing.assert_allclose(
        response(model, TIME, INPUT), truth, rtol=0, atol=1e-10 * np.abs(truth).max()
    )


def test_twenty_equal_lags_settle_exactly():
    # The companion form is too ill-conditioned to be the truth here: the Erlang law is it.
    from scipy.special import gammainc

    model = TransferFunction.lag_n(1.0, 1.0, 20, 0.001)
    time = np.linspace(0.0, 60.0, 61)
    step = PiecewiseConstant(np.array([0.0]), np.array([1.0]), 0.0)
    truth = gammainc(20, np.maximum(time - 0.001, 0.0))
    np.testing.assert_allclose(response(model, time, step), truth, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", [n for n in MODELS if n != "biproper"])
def test_a_plant_stepped_from_outside_gives_the_same(name):
    model = MODELS[name]
    plant = Plant(model, initial_command=INPUT.initial)
    sample = 0.1
    time = np.arange(400) * sample
    # The command changes at samples only.
    times = np.round(INPUT.times / sample) * sample
    u = PiecewiseConstant(times, INPUT.values, INPUT.initial)
    stepped, command = [], u.initial
    for t in time:
        stepped.append(plant.advance(float(t), command))
        command = float(u(np.array([t + 1e-9]))[0])
    exact = response(model, time, u)
    np.testing.assert_allclose(stepped, exact, rtol=0, atol=1e-9 * np.abs(exact).max())


def test_order_and_shape_of_the_times_do_not_matter():
    model = MODELS["fopdt"]
    shuffled = np.random.default_rng(1).permutation(TIME)
    np.testing.assert_allclose(
        response(model, shuffled.reshape(1, -1), INPUT)[0],
        [response(model, np.array([t]), INPUT)[0] for t in shuffled],
        rtol=0,
        atol=1e-15,
    )


@given(
    scale=st.floats(1e-3, 1e3),
    dead_time=st.floats(0.0, 5.0),
    order=st.integers(1, 8),
)
def test_time_scales_and_superposition(scale, dead_time, order):
    model = TransferFunction.lag_n(1.0, 1.0, order, dead_time)
    slower = TransferFunction.lag_n(1.0, scale, order, dead_time * scale)
    stretched = PiecewiseConstant(INPUT.times * scale, INPUT.values, 0.0)
    one = response(model, TIME, INPUT)
    np.testing.assert_allclose(response(slower, TIME * scale, stretched), one, atol=1e-9)
    doubled = PiecewiseConstant(INPUT.times, 2.0 * INPUT.values, 0.0)
    np.testing.assert_allclose(response(model, TIME, doubled), 2.0 * one, atol=1e-12)


def test_a_held_signal_is_checked_and_compressed():
    with pytest.raises(RecordError):
        PiecewiseConstant(np.array([1.0, 1.0]), np.array([0.0, 1.0]), 0.0)
    with pytest.raises(RecordError):
        PiecewiseConstant(np.array([1.0]), np.array([0.0, 1.0]), 0.0)
    u = PiecewiseConstant.from_samples(
        np.array([0.0, 1.0, 2.0, 2.0, 3.0]), np.array([5.0, 5.0, 6.0, 7.0, 7.0])
    )
    np.testing.assert_array_equal(u.times, [2.0])
    np.testing.assert_array_equal(u.values, [7.0])
    assert u.initial == 5.0
    np.testing.assert_array_equal(u(np.array([-1.0, 1.9, 2.0, 9.0])), [5.0, 5.0, 7.0, 7.0])


def test_a_lag_under_a_busy_input_is_the_same_whatever_way_it_is_followed():
    rng = np.random.default_rng(5)
    changes = np.cumsum(rng.uniform(0.05, 1.0, 400))
    u = PiecewiseConstant(changes, rng.normal(0.0, 1.0, 400), 0.3)
    time = np.linspace(0.0, 220.0, 500)
    for tau, dead_time in ((0.2, 0.4), (40.0, 1.3)):
        theta = np.array([np.log(tau), dead_time])
        ((columns, derivatives),) = columns_of(FOPDT, theta, time, Inputs((u,)))
        expected = response(TransferFunction.fopdt(1.0, tau, dead_time), time, u)
        np.testing.assert_allclose(columns[0], expected, atol=1e-10)
        step = 1e-6
        ((slower, _),) = columns_of(FOPDT, theta + np.array([step, 0.0]), time, Inputs((u,)))
        np.testing.assert_allclose(derivatives[0, 0], (slower[0] - columns[0]) / step, atol=1e-4)
