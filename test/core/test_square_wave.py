# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The steady oscillation of lags against distributions, Fourier series and simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from forward import peak_of_harmonics
from sampled_relay import exact_limit_cycle
from scipy.special import gammaincc

from relay_autotune.identification.methods.lags import fundamental, level, peak, peak_part
from relay_autotune.process.structures import TWO_EQUAL_ONE
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings


@pytest.mark.parametrize("order", [1, 2, 3, 6])
@pytest.mark.parametrize(("x", "m"), [(0.3, 0.7), (3.0, 0.2), (12.0, 0.95)])
def test_the_general_equation_is_a_sum_over_steps(order, x, m):
    # Each step of the square wave has been answered by the distribution of a sum of n lags.
    partial = np.cumsum([(-1) ** j * gammaincc(order, (m + j) * x) for j in range(2000)])
    expected = 1.0 - (partial[-1] + partial[-2])
    assert level((2.0 / x,) * order, 4.0, m) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("close", [1.0 + 1e-9, 1.05, 1.3])
def test_lags_that_are_nearly_equal(close):
    period, m = 7.0, 0.4
    for lags in ((2.0, 2.0 * close), (2.0, 2.0, 2.0 * close), (2.0, 2.0, 2.0 / close)):
        model = TransferFunction(1.0, (), lags)
        f = [1.0 - 2.0 * math.exp(-m * 3.5 / t) / (1.0 + math.exp(-3.5 / t)) for t in lags]
        if close > 1.1 and len(lags) == 2:
            by_parts = (lags[0] * f[0] - lags[1] * f[1]) / (lags[0] - lags[1])
            assert level(lags, period, m) == pytest.approx(by_parts, rel=1e-13)
        # The Fourier series knows nothing of the closed form.
        k = 2 * np.arange(4000) + 1
        w = 2.0 * math.pi / period * k
        terms = model(1j * w) * np.exp(1j * w * m * 0.5 * period) / k
        assert level(lags, period, m) == pytest.approx(
            4.0 / math.pi * float(np.sum(terms.imag)), abs=1e-9
        )


@pytest.mark.long
@pytest.mark.parametrize("lags", [(3.0,), (3.0,) * 2, (3.0,) * 8, (3.0, 1.0), (1.0, 1.0, 5.0)])
@pytest.mark.parametrize("period", [4.0, 20.0])
def test_amplitude_with_more_and_more_harmonics(lags, period):
    exact = peak(lags, period)
    assert peak_of_harmonics(lags, period, 1) == pytest.approx(fundamental(lags, period))
    errors = [abs(peak_of_harmonics(lags, period, n) / exact - 1.0) for n in (1, 3, 30, 300)]
    assert errors[3] < errors[1]
    assert errors[3] < (1e-3 if len(lags) == 1 else 1e-6)


@pytest.mark.parametrize(
    "model",
    [
        TransferFunction.fopdt(1.0, 3.0, 1.0),
        TransferFunction.lag_n(1.0, 3.0, 4, 1.0),
        TransferFunction.sopdt(1.0, (3.0, 0.01), 1.0),
        TWO_EQUAL_ONE.build((1.0, 3.0, 40.0, 1.0)),
    ],
    ids=str,
)
def test_when_the_peak_comes(model):
    cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0, 0.0, 0.01))
    lags = tuple(t.real for t in model.time_constants)
    after = peak_part(lags, cycle.period) * 0.5 * cycle.period
    assert model.dead_time + after == pytest.approx(cycle.time_to_peak_max, rel=1e-8)


def test_a_square_wave_that_has_died_away():
    assert peak((1.0, 1.0), 1e4) == 1.0
    assert peak((1.0,), 1e4) == 1.0
    assert level((1.0, 1.0), 1e4, 0.5) == 1.0
