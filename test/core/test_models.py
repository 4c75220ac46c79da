# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Transfer functions against their definition, and against scipy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from relay_autotune.errors import ModelError
from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    STRUCTURES,
    UNSTABLE_FOPDT,
    recognised,
    structure_named,
)
from relay_autotune.process.transfer_function import TransferFunction

W = np.logspace(-3, 3, 50)

EXAMPLES = {
    "fopdt": dict(gain=1.65, time_constants=[20.0], dead_time=10.0),
    "lag_n": dict(gain=-2.0, time_constants=[3.0], order=5, dead_time=1.0),
    "lag_n_zero": dict(gain=1.0, time_constants=[3.0], zeros=[-1.0], order=3, dead_time=1.0),
    "sopdt": dict(gain=1.0, time_constants=[3.0, 1.0], dead_time=0.5),
    "sopdt_zero": dict(gain=1.0, natural_frequency=2.0, damping=0.3, zeros=[0.4], dead_time=0.5),
    "two_equal_one": dict(gain=37.3, time_constants=[7200.0, 2.0], dead_time=1.0),
    "three_lags": dict(gain=1.0, time_constants=[5.0, 2.0, 1.0], dead_time=0.0),
    "lag_complex": dict(gain=1.0, time_constants=[1.0], natural_frequency=1.0, damping=0.5),
    "ipdt": dict(gain=0.5, dead_time=2.0),
    "integrator_lag": dict(gain=0.5, time_constants=[4.0], dead_time=2.0),
    "integrator_inverse": dict(gain=0.547, zeros=[-0.418], time_constants=[1.06], dead_time=0.1),
    "unstable_fopdt": dict(gain=1.0, time_constants=[1.0], dead_time=0.3),
    "unstable_sopdt": dict(gain=2.0, time_constants=[5.0, 1.0], dead_time=0.3),
}


def test_every_structure_has_an_example():
    assert set(EXAMPLES) | {"general"} == set(STRUCTURES)


@pytest.mark.parametrize("structure", EXAMPLES)
def test_response_equals_the_ratio_of_its_polynomials(structure):
    model = structure_named(structure).of_fields(**EXAMPLES[structure])
    assert model.structure == structure
    _, ratio = signal.freqs(model.numerator, model.denominator, W)
    np.testing.assert_allclose(model(1j * W), ratio * np.exp(-1j * W * model.dead_time), rtol=1e-9)


@pytest.mark.parametrize("structure", EXAMPLES)
def test_polynomials_give_the_same_function_back(structure):
    model = structure_named(structure).of_fields(**EXAMPLES[structure])
    again = TransferFunction.from_polynomials(model.numerator, model.denominator, model.dead_time)
    np.testing.assert_allclose(again(1j * W), model(1j * W), rtol=1e-9)


@pytest.mark.parametrize("structure", EXAMPLES)
def test_phase_is_continuous_and_agrees_with_the_angle(structure):
    model = structure_named(structure).of_fields(**EXAMPLES[structure])
    phase = model.phase(W)
    angle = np.angle(model.process_sign * model(1j * W))
    np.testing.assert_allclose(np.exp(1j * phase), np.exp(1j * angle), atol=1e-9)
    fine = np.linspace(W[0], 20.0 / (1.0 + model.dead_time), 20001)
    assert np.abs(np.diff(model.phase(fine))).max() < 0.5


@pytest.mark.parametrize("structure", EXAMPLES)
def test_a_model_is_recognised_by_its_poles_and_zeros(structure):
    model = structure_named(structure).of_fields(**EXAMPLES[structure])
    # Two of three lags may happen to be equal.
    wanted = "three_lags" if structure == "two_equal_one" else structure
    assert recognised(replace(model, structure="general")).structure == wanted


def test_a_model_of_no_structure_stays_general():
    for lags, zeros in (((1.0, -1.0, -2.0), ()), ((1.0, 2.0, 3.0, 4.0), ()), ((2.0,), (1.0,))):
        assert recognised(TransferFunction(1.0, zeros, lags)).structure == "general"


def test_the_controllers_sign_follows_the_process():
    assert TransferFunction.fopdt(1.0, 1.0, 1.0).process_sign == 1
    assert TransferFunction.fopdt(-1.0, 1.0, 1.0).process_sign == -1
    assert UNSTABLE_FOPDT.build((1.0, 1.0, 0.3)).process_sign == 1
    assert INTEGRATOR_INVERSE.build((0.5, 0.4, 1.0, 0.1)).process_sign == 1


def test_an_unstable_fopdt_is_k_over_tau_s_minus_one():
    model = UNSTABLE_FOPDT.build((2.0, 5.0, 0.3))
    s = 1j * W
    np.testing.assert_allclose(model(s), 2.0 * np.exp(-0.3 * s) / (5.0 * s - 1.0), rtol=1e-12)
    assert not model.is_stable


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (dict(gain=0.0), "gain"),
        (dict(gain=math.nan), "finite"),
        (dict(gain=1.0, dead_time=-1.0), "dead time"),
        (dict(gain=1.0, time_constants=(1.0 + 1.0j,)), "conjugate"),
        (dict(gain=1.0, zeros=(1.0,)), "poles"),
    ],
)
def test_what_cannot_be_is_refused(wrong, said):
    with pytest.raises(ModelError, match=said):
        TransferFunction(**wrong)


@pytest.mark.parametrize(
    ("structure", "wrong"),
    [
        ("fopdt", dict(gain=1.0)),
        ("fopdt", dict(gain=1.0, time_constants=[-1.0])),
        ("fopdt", dict(gain=1.0, time_constants=[math.nan])),
        ("lag_n", dict(gain=1.0, time_constants=[1.0])),
        ("sopdt", dict(gain=1.0)),
        ("ladder", dict(gain=1.0)),
    ],
)
def test_a_structure_with_wrong_parameters_is_refused(structure, wrong):
    with pytest.raises(ModelError):
        structure_named(structure).of_fields(**wrong)


def test_polynomials_without_content_are_refused():
    for bad in ([], [0.0], [math.nan], [math.inf, 1.0]):
        with pytest.raises(ModelError):
            TransferFunction.from_polynomials(bad, [1.0, 1.0])
        with pytest.raises(ModelError):
            TransferFunction.from_polynomials([1.0], bad)


COEFFICIENT = st.just(0.0) | st.floats(-5.0, -1e-6) | st.floats(1e-6, 5.0)


@given(
    numerator=st.lists(COEFFICIENT, min_size=1, max_size=3),
    denominator=st.lists(COEFFICIENT, min_size=1, max_size=4),
)
def test_any_pair_of_polynomials_is_kept_or_refused(numerator, denominator):
    try:
        model = TransferFunction.from_polynomials(numerator, denominator)
    except ModelError:
        return
    s = np.array([0.3 + 0.4j, 1.1j, 2.0 - 0.5j])
    size = np.polyval(np.abs(denominator), np.abs(s)) + np.polyval(np.abs(numerator), np.abs(s))
    error = model(s) * np.polyval(denominator, s) - np.polyval(numerator, s)
    assert np.all(np.abs(error) <= 1e-6 * size * (1.0 + np.abs(model(s))))
