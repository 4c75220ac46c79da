# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Ultimate points and closed-loop stability against worked cases and Pade approximations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from worked_cases import PROCESSES, cases

from relay_autotune.loop.stability import closed_loop_unstable_poles
from relay_autotune.process.structures import IPDT, UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.T1"))
def test_equal_lags(name, inputs, exact, tol):
    model = TransferFunction.lag_n(inputs["K"], inputs["tau"], inputs["n"], inputs["D"])
    point = ultimate_point(model)
    assert point.gain == pytest.approx(exact["true_Ku"], rel=tol)
    assert point.period == pytest.approx(exact["true_Pu"], rel=tol)


def test_first_order_and_inverse_response():
    point = ultimate_point(PROCESSES["Chang 1.65e-10s/(20s+1)"])
    assert point.gain == pytest.approx(2.3072017362581048, rel=1e-12)
    assert point.frequency == pytest.approx(0.18365972031521258, rel=1e-12)
    point = ultimate_point(PROCESSES["Luyben int+inv"])
    assert point.gain == pytest.approx(3.5553946647732815, rel=1e-9)
    assert point.frequency == pytest.approx(1.2999974797731686, rel=1e-9)


@pytest.mark.parametrize("case", cases("chang.fig3")[0][2], ids=lambda c: f"D={c['D']}")
def test_any_dead_time(case):
    point = ultimate_point(TransferFunction.fopdt(1.65, 20.0, case["D"]))
    assert point.gain == pytest.approx(case["Ku_true"], rel=1e-9)
    assert point.frequency == pytest.approx(case["wu_true"], rel=1e-9)


def test_a_reverse_acting_process_has_a_negative_ultimate_gain():
    direct = ultimate_point(TransferFunction.fopdt(1.65, 20.0, 10.0))
    reverse = ultimate_point(TransferFunction.fopdt(-1.65, 20.0, 10.0))
    assert reverse.gain == -direct.gain
    assert reverse.frequency == direct.frequency


@pytest.mark.parametrize(
    "model",
    [
        TransferFunction.fopdt(1.0, 1.0, 0.0),
        TransferFunction.lag_n(1.0, 1.0, 2, 0.0),
        UNSTABLE_FOPDT.build((1.0, 1.0, 1.3)),
        TransferFunction(1.0, (), (1.0,), 2, 0.1),
    ],
    ids=["first order", "second order", "delay beyond tau", "double integrator"],
)
def test_a_process_without_ultimate_point_has_none(model):
    assert ultimate_point(model) is None


def test_an_unstable_process_has_the_upper_limit():
    model = UNSTABLE_FOPDT.build((1.0, 1.0, 0.3))
    point = ultimate_point(model)
    assert point.gain > 1.0
    assert abs(complex(point.gain * model(1j * point.frequency)) + 1.0) < 1e-12


def test_a_resonance_beyond_the_first_crossing_is_found():
    # The slow lag crosses first with a small gain, the resonance later with a large one.
    model = TransferFunction(1.0, (), (10.0, *_pair(3.0, 0.002)), 0, 2.0)
    point = ultimate_point(model)
    assert point.frequency == pytest.approx(3.0, rel=0.05)


def _pair(w0: float, zeta: float) -> tuple[complex, complex]:
    root = 1j * math.sqrt(1.0 - zeta**2)
    return (zeta + root) / w0, (zeta - root) / w0


@pytest.mark.long
@given(
    tau=st.floats(0.05, 50.0),
    order=st.integers(1, 6),
    dead_time=st.floats(0.01, 20.0),
    gain=st.floats(0.1, 10.0),
)
def test_at_the_ultimate_point_the_loop_is_minus_one_and_stability_ends(
    tau, order, dead_time, gain
):
    model = TransferFunction.lag_n(gain, tau, order, dead_time)
    point = ultimate_point(model)
    assert abs(complex(point.gain * model(1j * point.frequency)) + 1.0) < 1e-9
    for factor, stable in ((0.999, True), (1.001, False)):
        loop = TransferFunction.lag_n(gain * point.gain * factor, tau, order, dead_time)
        assert (closed_loop_unstable_poles([loop]) == 0) is stable


def _pade(dead_time: float, order: int) -> tuple[np.ndarray, np.ndarray]:
    c = np.ones(order + 1)
    for k in range(1, order + 1):
        c[k] = c[k - 1] * (order - k + 1) / (k * (2 * order - k + 1))
    powers = dead_time ** np.arange(order + 1)
    return (c * (-1.0) ** np.arange(order + 1) * powers)[::-1], (c * powers)[::-1]


def _away_from_zero(least: float, most: float) -> st.SearchStrategy[float]:
    return st.floats(least, most) | st.floats(-most, -least)


@pytest.mark.long
@given(
    zeros=st.lists(_away_from_zero(0.2, 3.0), max_size=1),
    constants=st.lists(_away_from_zero(0.2, 5.0), min_size=2, max_size=3),
    integrators=st.integers(0, 1),
    dead_time=st.just(0.0) | st.floats(1e-3, 1.0),
    gain=st.floats(0.05, 4.0),
)
def test_unstable_poles_are_counted_like_the_roots_of_a_pade_approximation(
    zeros, constants, integrators, dead_time, gain
):
    sign = TransferFunction(gain, tuple(zeros), tuple(constants), integrators).process_sign
    loop = TransferFunction(sign * gain, tuple(zeros), tuple(constants), integrators, dead_time)
    top, bottom = _pade(dead_time, 7)
    roots = np.roots(
        np.polyadd(np.polymul(loop.numerator, top), np.polymul(loop.denominator, bottom))
    )
    # Roots near the axis, or so fast that the approximation does not hold there, decide nothing.
    assume(np.abs(roots.real).min() > 0.02)
    fast = np.abs(roots) * dead_time > 6.0
    assume(not np.any(fast & (roots.real > -1.0)))
    assert closed_loop_unstable_poles([loop]) == int(np.sum(roots.real > 0.0))


@given(
    exponent=st.floats(-140.0, 140.0),
    ratio=st.floats(-12.0, 140.0),
    order=st.integers(1, 4),
    sign=st.sampled_from((-1.0, 1.0)),
)
def test_the_ultimate_point_holds_over_any_number_of_decades(exponent, ratio, order, sign):
    tau, dead_time = 10.0**exponent, 10.0 ** (exponent + ratio)
    point = ultimate_point(TransferFunction.lag_n(sign, tau, order, dead_time))
    x = point.frequency * tau
    # Equal lags and the dead time turn by pi; where the lags alone do it is what they lack of pi.
    if x > 1.0 and order == 2:
        assert point.frequency * dead_time == pytest.approx(2.0 * math.atan(1.0 / x), rel=1e-9)
    else:
        turned = order * math.atan(x) + point.frequency * dead_time
        assert turned == pytest.approx(math.pi, rel=1e-9)
    size = 0.5 * order * np.logaddexp(0.0, 2.0 * math.log(x)) if x > 0.0 else 0.0
    assert math.log(sign * point.gain) == pytest.approx(size, rel=1e-9, abs=1e-9)


@given(st.floats(-140.0, 140.0), st.floats(-12.0, -0.31))
def test_integrators_and_unstable_processes_hold_over_decades_too(exponent, ratio):
    scale = 10.0**exponent
    point = ultimate_point(IPDT.build((1.0, scale)))
    assert point.frequency * scale == pytest.approx(math.pi / 2.0, rel=1e-9)
    point = ultimate_point(UNSTABLE_FOPDT.build((1.0, scale, scale * 10.0**ratio)))
    x = point.frequency * scale
    assert math.atan(x) == pytest.approx(x * 10.0**ratio, rel=1e-9)
    assert point.gain == pytest.approx(math.hypot(1.0, x), rel=1e-9)


def test_an_underdamped_process_of_any_unit_of_time():
    reference = ultimate_point(TransferFunction.oscillator(1.0, 1.0, 0.05, 0.3))
    for unit in (1e-100, 1e-9, 1e9, 1e100):
        point = ultimate_point(TransferFunction.oscillator(1.0, 1.0 / unit, 0.05, 0.3 * unit))
        assert point.gain == pytest.approx(reference.gain, rel=1e-9)
        assert point.frequency * unit == pytest.approx(reference.frequency, rel=1e-9)


def test_a_dead_time_beyond_any_lag_is_no_slower():
    # Tens of thousands of later crossings lie at gains above that of the first.
    point = ultimate_point(TransferFunction.fopdt(2.0, 1e-9, 1.0))
    assert point.gain == pytest.approx(0.5, rel=1e-9)
    assert point.frequency == pytest.approx(math.pi, rel=1e-8)


@pytest.mark.parametrize("dead_time", [1.0, 1e3, 1e6, 1e12, 1e18])
def test_turns_of_a_dead_time_are_looked_at_where_the_process_passes_most(monkeypatch, dead_time):
    """A noise gave a model with a million turns before its maximum, and 100 such took 90 s."""
    lead, lag, points = 10.0, 0.1, 0
    evaluate = TransferFunction.phase

    def counted(self, frequency):
        nonlocal points
        points += np.size(frequency)
        return evaluate(self, frequency)

    monkeypatch.setattr(TransferFunction, "phase", counted)
    point = ultimate_point(
        TransferFunction(1.0, zeros=(lead,), time_constants=(lag, lag), dead_time=dead_time)
    )
    # |G|^2 = (1 + a x)/(1 + b x)^2 with x = w^2
    a, b = lead**2, lag**2
    x = (a - 2.0 * b) / (a * b)
    largest = math.sqrt(1.0 + a * x) / (1.0 + b * x)
    # The turns are 2 pi/D apart, and the nearest one passes hardly less.
    off = 0.5 * (math.pi / dead_time) ** 2 / x
    assert 1.0 - 1e-12 <= point.gain * largest <= 1.0 + 2.0 * off + 1e-12
    assert point.frequency == pytest.approx(math.sqrt(x), rel=1e-3, abs=2.0 * math.pi / dead_time)
    assert points < 100_000
