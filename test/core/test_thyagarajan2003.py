# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Thyagarajan and Yu's equations against the worked cases, exact limit cycles, and each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from forward import first_half, unstable_limit_cycle
from hypothesis import given
from hypothesis import strategies as st
from sampled_relay import exact_limit_cycle
from worked_cases import cases

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.limit_cycle.shape import shape_of_half_cycle
from relay_autotune.identification.methods.lags import EXACT, FIRST, Wave, equal
from relay_autotune.identification.methods.thyagarajan import (
    dead_time_ratio,
    order_from_curvature,
)
from relay_autotune.identification.methods.wang import (
    first_order,
    flat_fopdt,
    fopdt,
    rise_time_constant,
)
from relay_autotune.process.simulation import HalfCycle
from relay_autotune.process.structures import UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings


def equal_lags(
    order, period, amplitude, relay, level=0.0, *, wave: Wave = EXACT, ratio=0.0, dead_time=0.0
):
    """Return (K, tau, D) of equal lags."""
    cycle = SymmetricCycle(period, amplitude, relay, level, dead_time)
    gain, tau = equal(order, cycle, wave=wave, ratio=ratio)
    return gain, tau, dead_time + ratio * tau


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.T2"))
def test_the_equivalent_models_of_table_2(name, inputs, exact, tol):
    p = inputs
    if name.endswith("SOPSDT"):
        found = equal_lags(2, p["P"], p["a"], 1.0, wave=FIRST, ratio=p["eps"])
        assert found == pytest.approx(exact["true_pi"], rel=tol)
        return
    if name.endswith("HO"):
        found = equal_lags(p["n"], p["P"], p["a"], 1.0, wave=FIRST)
        assert found[:2] == pytest.approx(exact[:2], rel=tol)
        return
    numbers = (p["P"], p["a"], p["t_peak"], p["h"])
    if exact["unstable"] is None:
        assert fopdt(*numbers) == pytest.approx(exact["1a"], rel=tol)
        with pytest.raises(IdentificationError, match="eq 16"):
            fopdt(*numbers, unstable=True)
    else:
        assert fopdt(*numbers, unstable=True) == pytest.approx(exact["unstable"], rel=tol)
        with pytest.raises(IdentificationError, match="eq 10"):
            fopdt(*numbers)
    # An ideal relay switches where y passes zero.
    found = flat_fopdt(p["P"], p["a"], p["t_peak"], p["t_half"], p["h"])
    assert found == pytest.approx(exact["1b"], rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.eq43"))
def test_eq_43(name, inputs, exact, tol):
    found = equal_lags(2, inputs["P"], inputs["a"], 1.0, wave=FIRST, ratio=inputs["eps"])
    assert found == pytest.approx(exact["true_pi"], rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.eq44"))
def test_eq_44(name, inputs, exact, tol):
    cycle = cases("thy.eq43")[0][1]
    found = equal_lags(2, cycle["P"], cycle["a"], 1.0, wave=FIRST, ratio=inputs["eps"])
    assert found == pytest.approx(exact["true_pi"], rel=tol)


@pytest.mark.parametrize(
    ("name", "inputs", "exact", "tol"), cases("thy.eq25.example", "thy.eq25.grid")
)
def test_eq_25(name, inputs, exact, tol):
    pairs = (
        [(inputs["tauG_P_exact"], exact)]
        if "tauG_P_exact" in inputs
        else [(case["tauG_P"], case["eq25"]) for case in exact]
    )
    for growth, ratio in pairs:
        assert dead_time_ratio(growth) == pytest.approx(ratio, rel=tol)


def test_eq_28_covers_the_range_that_the_paper_states():
    assert order_from_curvature(1.0388) == pytest.approx(3.0, rel=1e-3)
    assert order_from_curvature(0.6581) == pytest.approx(10.0, rel=1e-3)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.eq14-17"))
def test_the_unstable_process(name, inputs, exact, tol):
    p = inputs
    found = unstable_limit_cycle(p["K"], p["tau"], p["D"], p["h"])
    assert found == pytest.approx((exact["P"], exact["a"]), rel=tol)
    back = fopdt(exact["P"], exact["a"], p["D"], p["h"], unstable=True)
    assert back == pytest.approx((p["K"], p["tau"], p["D"]), rel=1e-7)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("thy.T6", "thy.T7"))
def test_without_noise_the_process_of_tables_6_and_7_comes_back(name, inputs, exact, tol):
    found = fopdt(exact["P"], exact["a"], inputs["D"], 1.0)
    # At D/tau = 10 the amplitude has all but reached K h, and says little of tau.
    assert found == pytest.approx((inputs["K"], inputs["tau"], inputs["D"]), rel=1e-9)


RELAYS = [RelaySettings(0.0, 0.0, 2.0, 0.0, share) for share in (0.0, 0.02, 0.3)]


def reading(model, relay):
    cycle = exact_limit_cycle(model, relay)
    return shape_of_half_cycle(HalfCycle(model, 0.5 * cycle.period, relay.amplitude))


@pytest.mark.parametrize("relay", RELAYS)
@pytest.mark.parametrize("dead_time", [0.3, 1.0, 4.0])
def test_a_fopdt_process_with_hysteresis(relay, dead_time):
    model = TransferFunction.fopdt(1.5, 1.0, dead_time)
    s = reading(model, relay)
    found = fopdt(s.period, s.amplitude, s.time_to_peak, 2.0, relay.hysteresis)
    assert found == pytest.approx((1.5, 1.0, dead_time), rel=1e-9)
    flat = flat_fopdt(s.period, s.amplitude, s.rise, s.rise_half, 2.0, relay.hysteresis)
    assert flat == pytest.approx((1.5, 1.0, dead_time), rel=1e-9)


def test_a_half_cycle_of_a_thousand_time_constants_is_nearly_all_dead_time():
    """exp(2 q) is beyond all numbers there."""
    for q in (500.0, 1e6):
        gain, tau, dead_time = first_order(q, 4.0, 2.0, 2.0, 0.1)
        assert (gain, tau) == (1.0, 1.0 / q)
        assert dead_time == pytest.approx(2.0, abs=tau)


@pytest.mark.parametrize("relay", RELAYS)
@pytest.mark.parametrize("dead_time", [0.1, 0.3])
def test_an_unstable_fopdt_process_with_hysteresis(relay, dead_time):
    s = reading(UNSTABLE_FOPDT.build((1.5, 1.0, dead_time)), relay)
    numbers = (s.period, s.amplitude, s.time_to_peak, 2.0, relay.hysteresis)
    found = fopdt(*numbers, unstable=True)
    assert found == pytest.approx((1.5, 1.0, dead_time), rel=1e-8)
    forward = unstable_limit_cycle(1.5, 1.0, dead_time, 2.0, relay.hysteresis)
    assert forward == pytest.approx((s.period, s.amplitude), rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("relay", RELAYS)
@pytest.mark.parametrize("ratio", [pytest.param(0.001, marks=pytest.mark.nightly), 0.01, 0.1])
def test_two_equal_lags_with_hysteresis(relay, ratio):
    s = reading(TransferFunction.lag_n(1.5, 3.0, 2, 3.0 * ratio), relay)
    found = equal_lags(2, s.period, s.amplitude, 2.0, relay.hysteresis, ratio=ratio)
    assert found == pytest.approx((1.5, 3.0, 3.0 * ratio), rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("relay", RELAYS[1:])
@pytest.mark.parametrize("order", [3, 5, 10, pytest.param(20, marks=pytest.mark.nightly)])
def test_higher_orders_with_hysteresis(relay, order):
    s = reading(TransferFunction.lag_n(1.5, 3.0, order, 0.0), relay)
    found = equal_lags(order, s.period, s.amplitude, 2.0, relay.hysteresis)
    assert found == pytest.approx((1.5, 3.0, 0.0), rel=1e-9)
    # and with a dead time that is known
    s = reading(TransferFunction.lag_n(1.5, 3.0, order, 1.0), relay)
    known = equal_lags(order, s.period, s.amplitude, 2.0, relay.hysteresis, dead_time=1.0)
    assert known == pytest.approx((1.5, 3.0, 1.0), rel=1e-9)


@pytest.mark.parametrize("relay", RELAYS)
@pytest.mark.parametrize(("tau", "dead_time"), [(1.0, 0.3), (1.0, 4.0), (-1.0, 0.3)])
def test_eqs_8_9_14_15(relay, tau, dead_time):
    model = (
        TransferFunction.fopdt(1.5, tau, dead_time)
        if tau > 0.0
        else UNSTABLE_FOPDT.build((1.5, -tau, dead_time))
    )
    half = HalfCycle(model, 0.5 * exact_limit_cycle(model, relay).period, relay.amplitude)
    time = np.linspace(0.0, half.half_period, 101, endpoint=False)
    gain = 1.5 if tau > 0.0 else -1.5
    found = first_half(time, gain, tau, dead_time, relay.amplitude, relay.hysteresis)
    assert found == pytest.approx(half(time), abs=1e-9)


@given(
    gain=st.floats(0.01, 100.0),
    tau=st.floats(0.01, 100.0),
    ratio=st.floats(0.02, 8.0),
    share=st.floats(0.0, 0.9),
)
def test_a_stable_fopdt_process_comes_back(gain, tau, ratio, share):
    # in closed form, with a hysteresis of a share of the amplitude that an ideal relay has
    level = share * gain * -math.expm1(-ratio)
    dead_time, decay = ratio * tau, math.exp(-ratio)
    amplitude = gain * -math.expm1(-ratio) + level * decay
    left = (gain - level) * decay
    period = 2.0 * tau * math.log((gain + amplitude) / left)
    found = fopdt(period, amplitude, dead_time, 1.0, level)
    assert found == pytest.approx((gain, tau, dead_time), rel=1e-6)


def test_eq_20_has_one_root_beside_the_trivial_one():
    assert rise_time_constant(3.0, -math.log1p(0.5 * math.expm1(-3.0))) == pytest.approx(1.0)
    with pytest.raises(IdentificationError, match="eq 20"):
        rise_time_constant(1.0, 0.5)


def test_numbers_of_no_process_are_refused_with_the_reason():
    with pytest.raises(IdentificationError, match="half period"):
        fopdt(10.0, 1.0, 6.0, 1.0)
    with pytest.raises(IdentificationError, match="exceed"):
        fopdt(10.0, 1.0, 4.0, 1.0, 1.5)
    with pytest.raises(IdentificationError, match="not above the hysteresis"):
        equal_lags(5, 10.0, 1.0, 1.0, 1.5)
    with pytest.raises(IdentificationError, match="at least 3"):
        equal_lags(2, 10.0, 1.0, 1.0)
    with pytest.raises(IdentificationError, match="very end"):
        fopdt(10.0, 1.0, 5.0 * (1.0 - 1e-16), 1.0)
