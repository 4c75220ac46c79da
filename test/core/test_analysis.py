# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Stability, margins and responses against python-control, scipy and closed forms."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import signal
from scipy.integrate import trapezoid

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop, analyse_loop, is_stable
from relay_autotune.loop.gains import Controller, InternalModelLaw
from relay_autotune.loop.laws import LAWS, OWN_LAW
from relay_autotune.loop.stability import closed_loop_unstable_poles, winding
from relay_autotune.process.model_set import ModelSet
from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    IPDT,
    LAG_COMPLEX,
    LAG_N_ZERO,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.tuning.ensemble import ms_on_each


def _rational(control, controller: Controller, model: TransferFunction):
    """Return controller and process of python-control, which knows no dead time."""
    bottom = np.array([0.5 * controller.tf**2, controller.tf, 1.0])
    c = control.tf(
        controller.kc * np.array([controller.td * controller.ti, controller.ti, 1.0]),
        np.append(controller.ti * bottom, 0.0),
    )
    return c, control.tf(model.numerator, model.denominator)


@pytest.fixture(name="control")
def _control():
    return pytest.importorskip("control")


RATIONAL = [
    (Controller(2.0, 3.0, 0.6, 0.06), TransferFunction.lag_n(1.0, 1.0, 3, 0.0)),
    (Controller(0.4, 6.0, 2.0, 0.2), LAG_N_ZERO.of_order(3).build((1.0, 2.0, -1.0, 0.0))),
    (Controller(0.5, 9.0, 1.0, 0.1), INTEGRATOR_INVERSE.build((0.5, 0.4, 1.0, 0.0))),
    (Controller(0.6, 1.0, 1.0, 0.1), LAG_COMPLEX.build((1.0, 0.5, 1.0, 0.2, 0.0))),
    (Controller(6.0, 4.0, 0.3, 0.03), UNSTABLE_SOPDT.build((1.0, 2.0, 0.2, 0.0))),
]


@pytest.mark.long
@pytest.mark.parametrize(("controller", "model"), RATIONAL)
def test_margins_agree_with_python_control(control, controller, model):
    c, g = _rational(control, controller, model)
    found = analyse_loop(controller, model)
    w = np.geomspace(1e-3, 1e3, 400_001)
    loop = (c * g)(1j * w)
    assert found.ms == pytest.approx(np.max(1.0 / np.abs(1.0 + loop)), rel=1e-6)
    assert found.mt == pytest.approx(max(np.max(np.abs(loop / (1.0 + loop))), 1.0), rel=1e-6)
    gains = control.stability_margins(c * g, returnall=True)[0]
    above, below = gains[gains > 1.0], gains[gains < 1.0]
    assert found.gain_margin == pytest.approx(above.min() if above.size else math.inf, rel=1e-6)
    assert found.gain_margin_low == pytest.approx(below.max() if below.size else 0.0, rel=1e-6)
    phases = control.stability_margins(c * g, returnall=True)[1]
    assert found.phase_margin == pytest.approx(math.radians(np.abs(phases).min()), rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("controller", "model"), RATIONAL)
def test_responses_agree_with_scipy(control, controller, model):
    weighted = Controller(controller.kc, controller.ti, controller.td, controller.tf, 0.4)
    c, g = _rational(control, weighted, model)
    f = control.tf([weighted.kc * 0.4 * weighted.ti, weighted.kc], [weighted.ti, 0.0])
    for response, measurement, command in zip(
        Loop(weighted, model).step_responses(120.0, 1 << 14),
        (g * f / (1 + c * g), g / (1 + c * g)),
        (f / (1 + c * g), -c * g / (1 + c * g)),
        strict=True,
    ):
        for values, of in ((response.measurement, measurement), (response.command, command)):
            of = control.minreal(of, 1e-6, verbose=False)
            system = signal.lti(of.num[0][0], of.den[0][0])
            _, expected = signal.step(system, T=response.time)
            # The command jumps at t = 0 with the set-point.
            assert np.abs(values - expected)[3:].max() < 2e-3 * np.abs(expected).max()


def test_figures_of_the_set_point_response_are_those_of_scipy(control):
    controller, model = RATIONAL[0]
    found = analyse_loop(controller, model)
    c, g = _rational(control, controller, model)
    f = control.tf([controller.kc * controller.ti, controller.kc], [controller.ti, 0.0])
    of = control.minreal(g * f / (1 + c * g), 1e-6, verbose=False)
    time = np.linspace(0.0, 60.0, 60_001)
    _, y = signal.step(signal.lti(of.num[0][0], of.den[0][0]), T=time)
    assert found.overshoot == pytest.approx(y.max() - 1.0, abs=1e-4)
    assert found.settling_time == pytest.approx(
        time[np.flatnonzero(np.abs(y - 1.0) > 0.02)[-1]], abs=0.02
    )
    assert found.iae_setpoint == pytest.approx(trapezoid(np.abs(y - 1.0), time), rel=1e-3)


def test_margins_of_an_integrating_loop_with_dead_time():
    # k exp(-D s)/s: closed forms, with and without integral action too slow to matter.
    for ti, error in ((0.0, 1e-9), (1e4, 1e-3)):
        found = analyse_loop(Controller(0.5, ti), IPDT.build((1.0, 1.0)))
        assert found.gain_margin == pytest.approx(math.pi, rel=error)
        assert found.phase_margin == pytest.approx(math.pi / 2 - 0.5, rel=error)
        assert found.delay_margin == pytest.approx((math.pi / 2 - 0.5) / 0.5, rel=error)
        assert math.isinf(found.iae_load) is (ti == 0.0)


def test_an_unstable_process_needs_a_least_gain():
    # (s - 1) + k: stable for k > 1, whatever else.
    model = UNSTABLE_FOPDT.build((1.0, 1.0, 0.0))
    found = analyse_loop(Controller(4.0, 0.0), model)
    assert found.gain_margin_low == pytest.approx(0.25, rel=1e-9)
    assert math.isinf(found.gain_margin)
    assert not is_stable(Controller(0.99, 0.0), model)


def test_a_model_inside_takes_the_dead_time_out_of_the_loop():
    # Thyagarajan and Yu's eq 50 on the true process: y = exp(-D s)/(lambda s + 1) r.
    law = InternalModelLaw(
        TransferFunction(0.5, (3.0,), (2.0,)), TransferFunction(1.0, (), (2.0,), 0, 7.0)
    )
    model = TransferFunction.fopdt(2.0, 3.0, 7.0)
    found = analyse_loop(law, model)
    assert found.overshoot == pytest.approx(0.0, abs=1e-4)
    assert found.settling_time == pytest.approx(7.0 + 2.0 * math.log(50.0), rel=1e-3)
    # After a load 1/ki = K (lambda + D), and the error has one sign.
    assert found.iae_load == pytest.approx(2.0 * 9.0, rel=1e-3)
    w = np.geomspace(1e-3, 1e2, 200_001)
    inside = np.exp(-7j * w) / (2j * w + 1.0)
    assert found.ms == pytest.approx(np.abs(1.0 - inside).max(), rel=1e-6)


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(
    zeros=st.lists(st.floats(-3.0, 3.0).filter(lambda z: abs(z) > 0.1), max_size=1),
    constants=st.lists(
        st.floats(-5.0, 5.0).filter(lambda t: abs(t) > 0.1), min_size=2, max_size=4
    ),
    integrators=st.integers(0, 2),
    gain=st.floats(0.05, 20.0) | st.floats(-20.0, -0.05),
    damping=st.floats(0.01, 0.5),
)
def test_unstable_poles_without_dead_time_are_roots_of_a_polynomial(
    zeros, constants, integrators, gain, damping
):
    pair = complex(damping, math.sqrt(1.0 - damping**2))
    loop = TransferFunction(gain, tuple(zeros), (*constants, pair, pair.conjugate()), integrators)
    roots = np.roots(np.polyadd(loop.numerator, loop.denominator))
    assume(np.abs(roots.real).min() > 1e-3)
    assert closed_loop_unstable_poles([loop]) == int(np.sum(roots.real > 0.0))


@settings(deadline=None, max_examples=30)
@given(
    order=st.integers(1, 8),
    tau=st.floats(0.01, 100.0),
    share=st.floats(0.05, 3.0).filter(lambda x: abs(x - 1.0) > 1e-6),
)
def test_the_ultimate_gain_ends_stability(order, tau, share):
    model = TransferFunction.lag_n(1.0, tau, order, 1.0)
    law = Controller(share * ultimate_point(model).gain, 0.0)
    assert is_stable(law, model) is (share < 1.0)


def test_a_loop_of_neutral_type_is_stable_only_below_a_gain_of_one():
    # PD with no filter on a lag: kc td K/tau is the loop's gain at infinity.
    model = TransferFunction.fopdt(1.0, 2.0, 0.1)
    assert is_stable(Controller(1.0, 10.0, 1.9), model)
    assert not is_stable(Controller(1.0, 10.0, 2.1), model)
    assert math.isinf(closed_loop_unstable_poles(Controller(1.0, 10.0, 2.1).characteristic(model)))


def test_a_resonance_of_hardly_any_width_is_not_missed():
    zeta = 1e-6
    pair = complex(zeta, math.sqrt(1.0 - zeta**2)) / 3.0
    for gain, stable in ((1.5e-6, True), (2.5e-6, False)):
        # Its peak is 1/(2 zeta) times the gain, at a phase of -90 degrees and those of the delay.
        loop = TransferFunction(gain, (), (pair, pair.conjugate()), 0, 0.5 * math.pi / 3.0)
        assert (closed_loop_unstable_poles([loop]) == 0) is stable


def test_turns_of_a_dead_time_are_counted_as_long_as_they_matter():
    # The loop turns 2e5 times before its lag damps it, nearer to the origin than -1 is.
    swift = TransferFunction.fopdt(0.8, 1e-6, 1.0)
    assert closed_loop_unstable_poles([swift]) == 0.0
    # This one turns around -1 until its magnitude is 1, at w = sqrt(8)/tau.
    strong = TransferFunction.fopdt(3.0, 1e-4, 1.0)
    pairs = math.sqrt(8.0) / 1e-4 / (2.0 * math.pi)
    assert closed_loop_unstable_poles([strong]) == pytest.approx(2.0 * pairs, abs=2.0)
    # Far more turns are too many to count them.
    stronger = TransferFunction.fopdt(3.0, 1e-6, 1.0)
    assert math.isinf(closed_loop_unstable_poles([stronger]))


def test_the_grid_counts_as_the_argument_principle_does_or_not_at_all():
    rng = np.random.default_rng(2)
    models = [
        TransferFunction.fopdt(g, 1.0, d)
        for g, d in zip(rng.uniform(0.5, 3.0, 40), rng.uniform(0.1, 1.0, 40), strict=True)
    ]
    controller = Controller(1.2, 0.9, 0.2, 0.02)
    ms = ms_on_each(controller, ModelSet(models))
    exact = [is_stable(controller, m) for m in models]
    assert 0 < sum(exact) < 40
    assert [math.isfinite(p) for p in ms] == exact
    loop, coarse = controller.loop(models[0]), np.append(1e-9, np.geomspace(1e-3, 1e3, 9))
    none, one = np.zeros(1), np.ones(1, dtype=int)
    count = winding(1.0 + loop(1j * coarse)[:, None], coarse, 0 * one, one, none)
    assert np.isnan(count).all()


def test_an_unstable_loop_is_refused_and_says_which():
    with pytest.raises(TuningError, match="unstable loop"):
        analyse_loop(Controller(-1.0, 1.0), TransferFunction.fopdt(1.0, 1.0, 1.0))


def test_the_error_of_a_loop_that_runs_far_faster_than_it_answers_is_the_continuous_one():
    """Near z = 1 few digits are left of 1 - 1/z."""
    model, gains = TransferFunction.fopdt(2.0, 1e4, 3e3), Controller(0.8, 9e3)
    continuous = analyse_loop(gains, model).iae_setpoint
    for period in (1.0, 1e-3, 1e-6):
        found = analyse_loop(LAWS[OWN_LAW].at(gains, period), model).iae_setpoint
        assert found == pytest.approx(continuous, rel=1e-3)


def test_a_sample_far_longer_than_what_is_looked_at_gives_the_first_response_alone():
    models = (TransferFunction.fopdt(2.0, 10.0, 3.0), TransferFunction.fopdt(2.0, 12.0, 3.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ModelSet(models, 1e8)(np.array([0.5 + 1.0j, 1e-12]))
    assert np.abs(found[0]) == pytest.approx(0.0, abs=1e-30)
    assert found[1] == pytest.approx(2.0, rel=1e-3)
