# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The minimum of a function of one number, from a grid that shows where it is."""

from __future__ import annotations

from collections.abc import Callable

from scipy.optimize import minimize_scalar

from relay_autotune.arrays import FloatArray


def minimum_near(
    function: Callable[[float], float], grid: FloatArray, i: int, tolerance: float
) -> tuple[float, float]:
    """Return where a function is least between the neighbours of a point, and its value there.

    :param function: with one minimum there.
    :param grid: increasing, shape (n,).
    :param i: index of the point, of which an end has a neighbour on one side only.
    :param tolerance: of the place.
    """
    bounds = float(grid[max(i - 1, 0)]), float(grid[min(i + 1, grid.size - 1)])
    options = {"xatol": tolerance}
    found = minimize_scalar(function, bounds=bounds, method="bounded", options=options)
    return float(found.x), float(found.fun)
