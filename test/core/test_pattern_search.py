# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The pattern search on costs whose least is known."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.tuning.search import pattern_search


@pytest.mark.parametrize("tilt", [0.3, 1.0, 2.0])
def test_it_follows_a_ridge_down_to_its_end(tilt):
    end = np.array([0.31, -0.17])

    def costs(points, below):
        x, y = (points[:, :2] - end).T
        # Two planes that meet in a line down which it goes twenty times more slowly.
        across, along = y - tilt * x, np.abs(x + tilt * y)
        return 1.0 + np.abs(across) + 0.05 * along

    begin = np.array([-0.4, 0.5, 0.0])
    point, cost = pattern_search(
        costs, begin, float(costs(begin[None], 9.0)[0]), 2, (0.1, 1e-4), 16
    )
    assert cost < 1.001
    assert point == pytest.approx([*end, 0.0], abs=0.02)


def test_on_a_line_it_finds_the_least_to_the_last_step():
    def costs(points, below):
        return 2.0 + (points[:, 0] - 0.437) ** 2

    point, cost = pattern_search(costs, np.zeros(2), 2.2, 1, (0.12, 1e-3), 16)
    assert point == pytest.approx([0.437, 0.0], abs=2e-3)
    assert cost == pytest.approx(2.0, abs=1e-5)


def test_the_last_coordinate_stays_at_zero_or_below():
    def costs(points, below):
        return 3.0 + np.sum((points - np.array([0.1, -0.2, 0.5])) ** 2, axis=1)

    point, _ = pattern_search(costs, np.zeros(3), 3.3, 3, (0.12, 1e-3), 16)
    assert point == pytest.approx([0.1, -0.2, 0.0], abs=5e-3)
