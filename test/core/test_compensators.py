# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Compensators against their own equations, and on the exact process."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.process.structures import IPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.compensators import dead_time_compensator, high_order_compensator
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


def test_eq_54():
    found = high_order_compensator(task(LAGS))
    k, tau, slow = 1.5661, 10.6313, 0.45 * 10.6313
    assert found.closed_loop_time == pytest.approx(slow)
    bracket = slow**4 / 5.0 * S**4 + slow**3 * S**3 + 2.0 * slow**2 * S**2 + 2.0 * slow * S + 1.0
    law = (tau * S + 1.0) ** 5 / (5.0 * k * slow * S * bracket)
    np.testing.assert_allclose(found.law(S), law, rtol=1e-9)


@pytest.mark.parametrize("n", [2, 3, 4, 7, 12])
def test_eq_54_for_any_order(n):
    found = high_order_compensator(task(TransferFunction.lag_n(-2.0, 3.0, n, 0.0)))
    law = (3.0 * S + 1.0) ** n / (-2.0 * ((1.35 * S + 1.0) ** n - 1.0))
    np.testing.assert_allclose(found.law(S), law, rtol=1e-8)


def test_lambda_is_free():
    assert dead_time_compensator(task(FOPDT, closed_loop_time=20.0)).closed_loop_time == 20.0
    assert "as given" in high_order_compensator(task(LAGS, closed_loop_time=7.0)).reason


def test_a_perfect_model_leaves_the_response_of_the_filter():
    model = TransferFunction.fopdt(-1.0, 1.0, 10.0)
    found = dead_time_compensator(task(model))
    opened = found.law(S) * model(S)
    np.testing.assert_allclose(
        opened / (1.0 + opened), np.exp(-10.0 * S) / (2.0 * S + 1.0), rtol=1e-9
    )
    loop = analyse_loop(found.law, model)
    assert loop.mt == pytest.approx(1.0, abs=1e-6)
    # From 1 - e^{-D s}/(lambda s + 1): never above 2, and near it for a long dead time.
    assert 1.8 < loop.ms < 2.0
    assert loop.delay_margin == pytest.approx(1.5 * 2.0, rel=0.05)


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
