# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Least cost by a pattern search whose directions change from step to step.

The cost need not be smooth. Where two of its pieces meet in a ridge, few directions lead down
along it; so the directions change at each step.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from relay_autotune.arrays import FloatArray

_SHRINK, _GROW = 0.5, 1.5
_ON_A_LINE = np.array([-1.0, -0.5, -0.25, -0.125, 0.125, 0.25, 0.5, 1.0])
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# A smaller improvement does not count.
_GAINED = 1.0 - 1e-7


def pattern_search(
    costs: Callable[[FloatArray, float], FloatArray],
    point: FloatArray,
    cost: float,
    size: int,
    steps: tuple[float, float],
    directions: int,
) -> tuple[FloatArray, float]:
    """Return the point of least cost near another, and its cost.

    :param costs: returns the costs, shape (k,), of points, shape (k, n); a cost above its second
        argument need not be exact.
    :param point: where to begin, shape (n,); its last coordinate stays at 0 or below.
    :param cost: cost at that point, positive.
    :param size: number of coordinates to move, the first ones.
    :param steps: the first step and the last.
    :param directions: number of directions tried at once.
    """
    rng = np.random.default_rng(0)
    (step, least), last, turns = steps, np.zeros((0, point.size)), 0
    while step > least:
        moves = np.zeros((_ON_A_LINE.size if size == 1 else directions, point.size))
        moves[:, :size] = _moves(size, directions, turns, rng)
        tried = point + step * np.concatenate((moves, last))
        tried[:, -1] = np.minimum(tried[:, -1], 0.0)
        found = costs(tried, cost)
        best = int(np.argmin(found))
        if found[best] < cost * _GAINED:
            # Along a ridge the last successful direction is often good again.
            last = (tried[best] - point)[None] / step
            step *= _GROW * float(np.linalg.norm(last))
            point, cost = tried[best], float(found[best])
        else:
            step *= _SHRINK * float(np.linalg.norm(moves, axis=1).min())
        turns += 1
    return point, cost


def _moves(size: int, directions: int, turns: int, rng: np.random.Generator) -> FloatArray:
    """Return the moves to try, of length at most 1, shape (k, size)."""
    if size == 1:
        return _ON_A_LINE[:, None]
    if size == 2:
        # Turned by the golden section of the angle between two, the directions never repeat.
        angles = (np.arange(directions) + _GOLDEN * turns) * (2.0 * math.pi / directions)
        return np.column_stack((np.cos(angles), np.sin(angles)))
    found = rng.standard_normal((directions, size))
    return np.asarray(found / np.linalg.norm(found, axis=1)[:, None])
