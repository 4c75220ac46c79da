# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Compensators against their own equations, and as they run on the exact process."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.loop.sampled import simulate_closed_loop
from relay_autotune.process.structures import IPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.compensators import (
    SampledCompensator,
    dead_time_compensator,
    high_order_compensator,
)
from relay_autotune.tuning.task import DesignOptions, DesignTask

FOPDT = TransferFunction.fopdt(0.8724, 1.9574, 10.8567)
LAGS = TransferFunction.lag_n(1.5661, 10.6313, 5, 0.0)
S = 1j * np.geomspace(1e-3, 10.0, 40)


def task(model: TransferFunction, **asked: float) -> DesignTask:
    return DesignTask(model=model, options=DesignOptions(**asked))


def test_eq_50():
    found = dead_time_compensator(task(FOPDT))
    k, tau, d = 0.8724, 1.9574, 10.8567
    assert found.closed_loop_time == 2.0 * tau
    law = (tau * S + 1.0) / (k * (2.0 * tau * S + 1.0 - np.exp(-d * S)))
    np.testing.assert_allclose(found.law(S), law, rtol=1e-12)
    with pytest.raises(TuningError, match="no rational function"):
        found.transfer_function()


def test_eq_54():
    found = high_order_compensator(task(LAGS))
    k, tau, slow = 1.5661, 10.6313, 0.45 * 10.6313
    assert found.closed_loop_time == pytest.approx(slow)
    bracket = slow**4 / 5.0 * S**4 + slow**3 * S**3 + 2.0 * slow**2 * S**2 + 2.0 * slow * S + 1.0
    law = (tau * S + 1.0) ** 5 / (5.0 * k * slow * S * bracket)
    np.testing.assert_allclose(found.law(S), law, rtol=1e-9)
    np.testing.assert_allclose(found.transfer_function()(S), law, rtol=1e-9)


@pytest.mark.parametrize("n", [2, 3, 4, 7, 12])
def test_eq_54_for_any_order(n):
    found = high_order_compensator(task(TransferFunction.lag_n(-2.0, 3.0, n, 0.0)))
    law = (3.0 * S + 1.0) ** n / (-2.0 * ((1.35 * S + 1.0) ** n - 1.0))
    np.testing.assert_allclose(found.transfer_function()(S), law, rtol=1e-8)
    np.testing.assert_allclose(found.law(S), law, rtol=1e-8)


def test_lambda_is_free():
    assert dead_time_compensator(task(FOPDT, closed_loop_time=20.0)).closed_loop_time == 20.0
    assert "as given" in high_order_compensator(task(LAGS, closed_loop_time=7.0)).reason


def test_a_perfect_model_gives_the_response_of_the_filter():
    model = TransferFunction.fopdt(-1.0, 1.0, 10.0)
    found = dead_time_compensator(task(model))
    run = simulate_closed_loop(
        SampledCompensator(found, 0.05), model, period=0.05, duration=30.0, setpoint=1.0
    )
    after = np.maximum(run.time - 10.0, 0.0)
    np.testing.assert_allclose(run.measurement, 1.0 - np.exp(-after / 2.0), atol=1e-4)
    loop = analyse_loop(found.law, model)
    assert loop.mt == pytest.approx(1.0, abs=1e-6)
    # From 1 - e^{-D s}/(lambda s + 1): never above 2, and near it for a long dead time.
    assert 1.8 < loop.ms < 2.0
    assert loop.delay_margin == pytest.approx(1.5 * 2.0, rel=0.05)


def test_higher_order_as_it_runs():
    found = high_order_compensator(task(LAGS))
    period = 0.2
    run = simulate_closed_loop(
        SampledCompensator(found, period), LAGS, period=period, duration=120.0, setpoint=1.0
    )
    x = run.time / found.closed_loop_time
    filtered = 1.0 - np.exp(-x) * sum(x**k / math.factorial(k) for k in range(5))
    # The hold delays by half a period.
    assert abs(run.measurement - filtered).max() < 0.02
    assert run.measurement[-1] == pytest.approx(1.0, abs=1e-4)


def test_a_load_is_removed_and_limits_do_not_wind_up():
    found = dead_time_compensator(task(FOPDT))
    common = {"period": 0.1, "duration": 200.0, "load": 0.4, "load_time": 1.0}
    run = simulate_closed_loop(SampledCompensator(found, 0.1), FOPDT, **common)
    assert abs(run.measurement[-1]) < 1e-6
    assert run.command[-1] == pytest.approx(-0.4, abs=1e-6)
    # Limited for long, the command leaves its limit as soon as the model says so.
    limited = SampledCompensator(found, 0.1, low=-0.2, high=0.2)
    for _ in range(2000):
        stuck = limited.step(0.0, 0.3)
    assert stuck == -0.2
    for _ in range(150):
        free = limited.step(0.0, -0.3)
    assert free == 0.2


def test_the_operating_point_is_an_offset():
    first = SampledCompensator(dead_time_compensator(task(FOPDT)), 0.1, offset=40.0)
    assert first.step(5.0, 5.0) == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("make", "model", "message"),
    [
        (dead_time_compensator, IPDT.build((1.0, 1.0)), "stable FOPDT"),
        (high_order_compensator, FOPDT, "equal lags"),
        (high_order_compensator, TransferFunction.sopdt(1.0, (1.0, 2.0), 0.0), "equal lags"),
        (high_order_compensator, TransferFunction.oscillator(1.0, 1.0, 0.4, 0.0), "equal lags"),
    ],
)
def test_processes_that_they_are_not_for(make, model, message):
    with pytest.raises(TuningError, match=message):
        make(task(model))


@pytest.mark.parametrize("wrong", [{"period": 0.0}, {"period": 0.1, "low": 1.0, "high": 1.0}])
def test_periods_and_limits_that_cannot_be(wrong):
    with pytest.raises(TuningError):
        SampledCompensator(dead_time_compensator(task(FOPDT)), **wrong)
