# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Derivatives by differences, and how far to step for them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from relay_autotune.arrays import FloatArray

_SHARE = 1e-6


def jacobian(
    function: Callable[[FloatArray], ArrayLike],
    at: FloatArray,
    up: FloatArray,
    down: FloatArray | None = None,
) -> NDArray[Any]:
    """Return ``df/dx_i = (f(x + up_i e_i) - f(x - down_i e_i))/(up_i + down_i)``.

    :param function: f, from shape (p,) to any shape s.
    :param at: x, shape (p,).
    :param up: steps ahead, shape (p,).
    :param down: steps back, shape (p,), 0 for a difference to one side; default: as far as ahead.
    :return: shape (*s, p).
    """
    back = up if down is None else down
    here = None if np.all(back) else np.asarray(function(at))
    columns = []
    for i, (ahead, behind) in enumerate(zip(up, back, strict=True)):
        ends = []
        for step in (ahead, -behind):
            moved = at.copy()
            moved[i] += step
            ends.append(here if step == 0.0 and here is not None else np.asarray(function(moved)))
        columns.append((ends[0] - ends[1]) / (ahead + behind))
    return np.stack(columns, axis=-1)


def relative_steps(at: FloatArray, logarithms: NDArray[np.bool_]) -> FloatArray:
    """Return steps of a millionth of each number, for a function that is known to rounding.

    :param at: the point, shape (p,).
    :param logarithms: which numbers are logarithms, shape (p,): one near zero stands for a
        quantity near 1, not for a small one, and gets a millionth.
    """
    steps = _SHARE * np.where(at == 0.0, 1.0, np.abs(at))
    return np.where(logarithms, np.maximum(steps, _SHARE), steps)


def exact_steps(
    at: FloatArray, size: FloatArray, least: ArrayLike = -math.inf
) -> tuple[FloatArray, FloatArray]:
    """Return steps ahead and back that are exact in the numbers of the computer.

    :param at: the point, shape (p,).
    :param size: of the steps, shape (p,).
    :param least: lower bound of the point after a step back, shape (p,).
    """
    return (at + size) - at, at - np.maximum(at - size, least)
