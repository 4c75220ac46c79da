# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How the covariance of what was measured becomes that of what was solved for."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import carried
from relay_autotune.identification.methods.solved import Fit
from relay_autotune.process.structures import SOPDT

RNG = np.random.default_rng(3)
COVARIANCE = np.cov(RNG.standard_normal((4, 30))) * np.outer((1, 1e3, 1e-4, 0), (1, 1e3, 1e-4, 0))


def test_a_linear_function_has_the_covariance_of_its_matrix():
    matrix = RNG.standard_normal((3, 4))
    found = carried(lambda x: matrix @ x, np.ones(4), COVARIANCE)
    assert found == pytest.approx(matrix @ COVARIANCE @ matrix.T, rel=1e-9)


def test_an_implicit_solution_has_that_of_the_implicit_function_theorem():
    # x^3 + a x = b at x = 1, a = 1, b = 2: dx = (db - da)/4.
    def solve(z):
        return np.array([float(np.roots([1.0, 0.0, z[0], -z[1]])[-1].real)])

    small = 1e-8 * np.array(((2.0, 0.5), (0.5, 1.0)))
    found = carried(solve, np.array((1.0, 2.0)), small)
    assert found[0, 0] == pytest.approx(1e-8 * (2.0 - 1.0 + 1.0) / 16.0, rel=1e-3)


def test_at_an_end_one_side_is_enough_and_with_none_nothing_is_known():
    def root(x):
        if x[0] > 0.0:
            raise IdentificationError("beyond the end")
        return 3.0 * x

    assert carried(root, np.zeros(1), np.eye(1)) == pytest.approx(9.0)
    assert np.isnan(carried(lambda x: root(np.abs(x)), np.zeros(1), np.eye(1))).all()
    assert np.isnan(carried(root, np.zeros(1), np.full((1, 1), np.nan))).all()


def test_a_value_without_effect_is_uncertain_and_leaves_the_others_certain():
    # Two numbers, the gain and the first time constant, each known to 1 %.
    truth, given = np.array((2.0, 3.0, 1e-12, 0.5)), np.full(4, np.nan)
    given[3] = truth[3]
    fit = Fit(SOPDT, given, 1, lambda values: np.log(values[:2] / truth[:2]) / 0.01, 1.0)
    _, x = fit.best((truth,))
    covariance = fit.covariance(x)
    assert np.sqrt(np.diag(covariance)[:2]) == pytest.approx(0.01 * truth[:2], rel=1e-6)
    assert np.sqrt(covariance[2, 2]) > 1e3 * truth[2]
    assert np.all(covariance[3] == 0.0)
