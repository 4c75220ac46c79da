# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Frequencies that show processes and loops."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.process.transfer_function import TransferFunction

# Below this magnitude a loop has no influence.
_RELEVANT = 0.05
_PER_DECADE = 50
# Distance of a sampled loop's grid from half the sampling frequency, relative to it.
_BEFORE_END = 1e-9
_MOST_TURNS = 800.0 * math.pi


def frequencies(
    *terms: TransferFunction,
    times: Iterable[float] = (),
    period: float = 0.0,
    loop: Callable[[ComplexArray], ComplexArray] | None = None,
) -> FloatArray:
    """Return a grid with little change of the loops' magnitude and phase between points.

    Loops of one process have most of their grids in common, whatever their gains.

    :param terms: the loop, or the terms of its characteristic equation.
    :param times: further times at which it changes, such as those of its controller [s].
    :param period: of the samples: the grid ends before half their frequency [s]; 0: it ends above
        all corners.
    :param loop: what is followed, where that is more than the terms.
    :return: rad/s, increasing.
    """
    constants = [c for t in terms for c in (*t.zeros, *t.time_constants)]
    dead_times = sorted({t.dead_time for t in terms if t.dead_time > 0.0})
    corners = [1.0 / abs(c) for c in (*constants, *dead_times, *times) if c != 0.0] or [1.0]
    top = math.pi / period if period > 0.0 else 1e2 * max(corners)
    low = math.floor(math.log10(1e-3 * min(top, *corners)))
    high = math.ceil(math.log10(top))
    grid = 10.0 ** (np.arange(low * _PER_DECADE, high * _PER_DECADE + 1) / _PER_DECADE)
    grid = grid[grid <= top]
    parts = [grid]
    if period > 0.0:
        parts.append(top * (1.0 - np.geomspace(1e-6, 0.5, 80)))
    if dead_times:
        values = np.array([loop(1j * grid)] if loop else [t(1j * grid) for t in terms])
        relevant = grid[np.abs(values).max(axis=0) > _RELEVANT]
        last = relevant[-1] if relevant.size else grid[0]
    for d in dead_times:
        # First turns of the dead time finely, later ones more coarsely.
        parts.append(np.arange(0.05, min(12.0 * math.pi, top * d), 0.05) / d)
        parts.append(np.arange(12.0 * math.pi, min(last * d, _MOST_TURNS), 0.2) / d)
    for c in constants:
        if c.imag > 0.0:
            centre, width = 1.0 / abs(c), abs(c.real) / abs(c)
            around = centre * (1.0 + width * np.linspace(-8.0, 8.0, 65))
            parts.append(around[around > 0.0])
    found = np.unique(np.concatenate(parts))
    if period == 0.0:
        return found
    return np.append(found[found < top * (1.0 - 1e-7)], top * (1.0 - _BEFORE_END))
