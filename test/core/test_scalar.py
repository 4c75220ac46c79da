# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Roots of functions of one number, beside those of scipy."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from relay_autotune.scalar import root, roots

FUNCTIONS = {
    "a parabola": (lambda x: x * x - 2.0, 0.0, 2.0),
    "an exponential over many decades": (lambda x: math.exp(x) - 1e-8, -700.0, 50.0),
    "a flat root": (lambda x: (x - 1.0) ** 3, 0.0, 1.7),
    "a jump": (lambda x: -1.0 if x < math.pi else 1.0, 0.0, 10.0),
    "a step far off the middle": (lambda x: math.atan(x - 3e5), -1e9, 1e9),
    "an infinite end": (lambda x: 1.0 / x - 1e-9 if x else math.inf, 0.0, 1e12),
    "a small root": (lambda x: x - 1e-15, -1.0, 1.0),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_root_is_that_of_scipy(name: str) -> None:
    function, low, high = FUNCTIONS[name]
    there = brentq(function, low, high, xtol=1e-300, rtol=1e-15, maxiter=1000)
    accuracy = 1e-5 if name == "a flat root" else 2e-15
    assert root(function, low, high) == pytest.approx(there, rel=accuracy)


@pytest.mark.parametrize(("low", "high", "nearer"), [(0.0, 3.0, 0.0), (-4.0, -1.0, -1.0)])
def test_without_a_change_of_sign_the_nearer_end_is_returned(
    low: float, high: float, nearer: float
) -> None:
    assert root(lambda x: x + 0.1 * math.copysign(1.0, low + high), low, high) == nearer


@given(st.lists(st.floats(-30.0, 30.0), min_size=1, max_size=8), st.floats(0.1, 9.0))
def test_roots_of_many_cells_are_found_at_once(places: list[float], power: float) -> None:
    at = np.array(places)

    def function(x: np.ndarray) -> np.ndarray:
        return np.sinh(power * (x - at) / 10.0)

    found = roots(function, np.full(at.shape, -31.0), np.full(at.shape, 37.0))
    assert found == pytest.approx(at, rel=1e-14, abs=1e-14)


def test_roots_take_few_steps() -> None:
    steps: list[float] = []

    def counted(function: Callable[[float], float]) -> Callable[[np.ndarray], np.ndarray]:
        def count(x: np.ndarray) -> np.ndarray:
            steps.append(float(x[0]))
            return np.array([function(float(x[0]))])

        return count

    for function, low, high in FUNCTIONS.values():
        roots(counted(function), np.array([low]), np.array([high]), 1e-300)
    # Halving alone takes 60 for each, and more for a small root.
    assert len(steps) < 40 * len(FUNCTIONS)
