# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Minima and roots of functions of one number, from a grid that shows where they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from relay_autotune.arrays import FloatArray

_MOST_STEPS = 200
# Relative accuracy of a root: two steps between neighbouring numbers.
EXACT = 2.0 * float(np.finfo(float).eps)


def minimum_near(
    function: Callable[[float], float], grid: FloatArray, i: int, tolerance: float
) -> tuple[float, float]:
    """Return where a function is least between the neighbours of a point, and its value there.

    :param function: with one minimum there.
    :param grid: increasing, shape (n,).
    :param i: index of the point, of which an end has a neighbour on one side only.
    :param tolerance: of the place.
    """
    # A controller runs without scipy.optimize.
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
    # A controller runs without scipy.optimize.
    from scipy.optimize import brentq

    at_low, at_high = function(low), function(high)
    if at_low * at_high >= 0.0:
        return low if abs(at_low) <= abs(at_high) else high
    accuracy = {"xtol": tolerance, "rtol": 2.0 * EXACT, "maxiter": _MOST_STEPS}
    return float(brentq(function, low, high, **accuracy, disp=False))


def roots(
    function: Callable[[FloatArray], FloatArray],
    low: FloatArray,
    high: FloatArray,
    tolerance: float = EXACT,
) -> FloatArray:
    """Return a root in each of many cells, all at once.

    The method of Chandrupatla (1997, Advances in Engineering Software 28, 145): a parabola through
    three points in the direction of the values, or half of the cell where that may miss.

    :param function: from one number in each cell to its values, shape (n,) both.
    :param low: ends of the cells, shape (n,).
    :param high: their other ends, at which the function has the other sign, shape (n,).
    :param tolerance: of a root near zero; of others it is that of the numbers.
    """
    here, far, at_here, at_far = low, high, function(low), function(high)
    share = np.full(low.shape, 0.5)
    for _ in range(_MOST_STEPS):
        place = here + share * (far - here)
        value = function(place)
        same = np.sign(value) == np.sign(at_here)
        last, at_last = np.where(same, here, far), np.where(same, at_here, at_far)
        far, at_far = np.where(same, far, here), np.where(same, at_far, at_here)
        here, at_here = place, value
        nearer = np.abs(at_here) < np.abs(at_far)
        best, least = np.where(nearer, here, far), np.where(nearer, at_here, at_far)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = (EXACT * np.abs(best) + tolerance) / np.abs(far - here)
            if bool(np.all((step > 0.5) | (least == 0.0) | (far == here))):
                break
            xi, phi = (here - far) / (last - far), (at_here - at_far) / (at_last - at_far)
            ratio = (last - here) / (far - here)
            share = at_here / (at_far - at_here) * at_last / (at_far - at_last)
            share += ratio * at_here / (at_last - at_here) * at_far / (at_last - at_far)
        inside = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
        share = np.clip(np.where(inside, share, 0.5), step, 1.0 - step)
    return best
