# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Minima and roots of functions of one number, from a grid that shows where they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from relay_autotune.arrays import FloatArray

_MOST_STEPS = 100


def minimum_near(
    function: Callable[[float], float], grid: FloatArray, i: int, tolerance: float
) -> tuple[float, float]:
    """Return where a function is least between the neighbours of a point, and its value there.

    :param function: with one minimum there.
    :param grid: increasing, shape (n,).
    :param i: index of the point, of which an end has a neighbour on one side only.
    :param tolerance: of the place.
    """
    # A controller runs without scipy.
    from scipy.optimize import minimize_scalar

    bounds = float(grid[max(i - 1, 0)]), float(grid[min(i + 1, grid.size - 1)])
    options = {"xatol": tolerance}
    found = minimize_scalar(function, bounds=bounds, method="bounded", options=options)
    return float(found.x), float(found.fun)


def root(
    function: Callable[[float], float], low: float, high: float, tolerance: float = 1e-300
) -> float:
    """Return where a function passes zero; the nearer end where rounding puts that outside.

    :param function: with a change of sign between both ends, but for rounding.
    :param low: one end.
    :param high: the other.
    :param tolerance: of a root near zero, where the relative one of the numbers would not do.
    """
    from scipy.optimize import brentq

    at_low, at_high = function(low), function(high)
    if at_low * at_high >= 0.0:
        return low if abs(at_low) <= abs(at_high) else high
    return float(brentq(function, low, high, xtol=tolerance, rtol=1e-15, maxiter=1000))


def roots(
    function: Callable[[FloatArray], FloatArray],
    low: FloatArray,
    high: FloatArray,
    accuracy: float = 2e-16,
) -> FloatArray:
    """Return a root in each of many cells, all at once.

    The Illinois method: a secant between two values of different sign, where an end that stays
    counts half (Dowell and Jarratt 1971, BIT 11, 168).

    :param function: from one number in each cell to its values, shape (n,) both.
    :param low: lower ends of the cells, shape (n,).
    :param high: upper ends, at which the function has the other sign, shape (n,).
    :param accuracy: of the roots, relative where they are above 1.
    """
    if not low.size:
        return low
    at_low, at_high = function(low), function(high)
    place, moved = low, np.full(low.shape, 2)
    for _ in range(_MOST_STEPS):
        before = place
        with np.errstate(divide="ignore", invalid="ignore"):
            place = (low * at_high - high * at_low) / (at_high - at_low)
        # Rounding may place the root at an end, or a little beyond.
        place = np.clip(np.where(np.isfinite(place), place, low), low, high)
        if bool(np.all(np.abs(place - before) <= accuracy * np.maximum(np.abs(place), 1.0))):
            break
        value = function(place)
        below = np.sign(value) == np.sign(at_low)
        again = np.where(below == moved, 0.5, 1.0)
        at_low, at_high = (
            np.where(below, value, again * at_low),
            np.where(below, again * at_high, value),
        )
        moved = below
        low, high = np.where(below, place, low), np.where(below, high, place)
    return place
