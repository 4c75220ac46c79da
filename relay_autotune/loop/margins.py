# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Margins of a loop: peaks of the sensitivities, margins of gain, phase and delay."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.loop.gains import Margins
from relay_autotune.process.transfer_function import TransferFunction

Loop = Callable[[ComplexArray], ComplexArray]

# Number of local maxima to refine, since the largest on the grid need not be the largest.
_PEAKS = 4
_ZOOMS, _ZOOM_POINTS = 9, 9
# Number of rounds; each round divides a cell into this many parts.
_ROUNDS, _PARTS = 13, 16
# Below this magnitude the loop has no influence, whatever its phase.
_FELT = 0.05
_MOST_TURNS = 800.0 * math.pi


@dataclass(frozen=True, kw_only=True)
class LoopMargins(Margins):
    """Margins, and where the sensitivity is largest.

    :param ms_frequency: frequency of that maximum [rad/s].
    """

    ms_frequency: float


def frequencies(*terms: TransferFunction) -> FloatArray:
    """Return a grid with little change of the loops' magnitude and phase between points.

    :param terms: the loop, or the terms of its characteristic equation.
    :return: rad/s, increasing.
    """
    constants = [c for t in terms for c in (*t.zeros, *t.time_constants)]
    dead_times = sorted({t.dead_time for t in terms if t.dead_time > 0.0})
    corners = [1.0 / abs(c) for c in constants] + [1.0 / d for d in dead_times] or [1.0]
    low, high = min(corners) * 1e-3, max(corners) * 1e2
    grid = np.geomspace(low, high, 50 * max(int(math.log10(high / low)), 1))
    parts = [grid]
    if dead_times:
        felt = np.max([np.abs(t(1j * grid)) for t in terms], axis=0) > _FELT
        last = float(grid[felt][-1]) if felt.any() else low
    for d in dead_times:
        # First turns of the dead time finely, later ones more coarsely.
        parts.append(np.arange(0.05, 12.0 * math.pi, 0.05) / d)
        parts.append(np.arange(12.0 * math.pi, min(last * d, _MOST_TURNS), 0.2) / d)
    for c in constants:
        if c.imag > 0.0:
            centre, width = 1.0 / abs(c), abs(c.real) / abs(c)
            parts.append(np.abs(centre * (1.0 + width * np.linspace(-8.0, 8.0, 65))) + low)
    return np.unique(np.concatenate(parts))


def sensitivity_peaks(loop: Loop, grid: FloatArray) -> tuple[float, float]:
    """Return (Ms, Mt), the largest magnitudes of ``1/(1 + L)`` and ``L/(1 + L)``.

    :param loop: L as a function of s.
    :param grid: frequencies that show the peaks roughly [rad/s], increasing.
    """
    (ms, _), (mt, _) = peaks(loop, grid)
    return ms, mt


def peaks(loop: Loop, grid: FloatArray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the largest magnitudes of both sensitivities, each with its frequency."""
    values = loop(1j * grid)
    sensitivity = 1.0 / np.abs(1.0 + values)
    log_grid = np.log(grid)

    sizes = (sensitivity, sensitivity * np.abs(values))
    best = [float(size.max()) for size in sizes]
    where = [float(grid[np.argmax(size)]) for size in sizes]
    # Refine both at the same time: the rows hold the peaks of 1/(1 + L), then those of L/(1 + L).
    tops = [_tops(size) for size in sizes]
    at, first = np.concatenate(tops), tops[0].size
    low, high = log_grid[np.maximum(at - 1, 0)], log_grid[np.minimum(at + 1, grid.size - 1)]
    rows = np.arange(at.size)
    for _ in range(_ZOOMS):
        x = np.linspace(low, high, _ZOOM_POINTS, axis=1)
        near = loop(1j * np.exp(x).ravel()).reshape(x.shape)
        numerator = near.copy()
        numerator[:first] = 1.0
        size = np.abs(numerator / (1.0 + near))
        k = np.argmax(size, axis=1)
        for which, part in enumerate((slice(first), slice(first, None))):
            row = part.indices(at.size)[0] + int(np.argmax(size[part].max(axis=1)))
            if size[row, k[row]] > best[which]:
                best[which], where[which] = float(size[row, k[row]]), math.exp(x[row, k[row]])
        low = x[rows, np.maximum(k - 1, 0)]
        high = x[rows, np.minimum(k + 1, _ZOOM_POINTS - 1)]
    return (best[0], where[0]), (best[1], where[1])


def _tops(values: FloatArray) -> NDArray[np.intp]:
    """Return the indices of the largest local maxima and of the largest value."""
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    return np.append(inner[np.argsort(-values[inner])[:_PEAKS]], np.argmax(values))


def _changes(values: FloatArray) -> NDArray[np.intp]:
    """Return the cells in which the sign changes; zero counts as positive."""
    return np.flatnonzero((values[:-1] >= 0.0) != (values[1:] >= 0.0))


def _roots(
    function: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return a root in each cell with a change of sign, by dividing all cells at once."""
    low, high = np.log(low), np.log(high)
    if not low.size:
        return low
    above, rows = np.sign(function(np.exp(low))), np.arange(low.size)
    for _ in range(_ROUNDS):
        ends = np.linspace(low, high, _PARTS + 1, axis=1)
        signs = np.sign(function(np.exp(ends[:, 1:-1]).ravel())).reshape(low.size, -1)
        changed = np.column_stack((signs != above[:, None], np.ones(low.size, dtype=bool)))
        first = np.argmax(changed, axis=1)
        low, high = ends[rows, first], ends[rows, first + 1]
    return np.asarray(np.exp(0.5 * (low + high)))


def margins(loop: Loop, grid: FloatArray, at_rest: float | None = None) -> LoopMargins:
    """Return the margins of a stable loop.

    :param loop: L as a function of s.
    :param grid: frequencies fine enough to show every crossing [rad/s], increasing.
    :param at_rest: L(0), if it is finite; None: it is not finite.
    """
    values = loop(1j * grid)
    cells = _changes(values.imag)
    cells = cells[(values.real[cells] < 0.0) | (values.real[cells + 1] < 0.0)]
    crossings = _roots(lambda w: loop(1j * w).imag, grid[cells], grid[cells + 1])
    real = loop(1j * crossings).real if crossings.size else np.empty(0)
    gains = -1.0 / real[real < 0.0]
    if at_rest is not None and at_rest < 0.0:
        gains = np.append(gains, -1.0 / at_rest)
    size = np.log(np.abs(values))
    cells = _changes(size)
    crossovers = _roots(lambda w: np.log(np.abs(loop(1j * w))), grid[cells], grid[cells + 1])
    lead = np.angle(-loop(1j * crossovers)) if crossovers.size else np.empty(0)
    delays = np.mod(lead, 2.0 * math.pi) / crossovers
    (ms, at), (mt, _) = peaks(loop, grid)
    return LoopMargins(
        # ms tends to 1 for w -> infinity; mt tends to 1 for w -> 0 with integral action.
        ms=max(ms, 1.0),
        ms_frequency=at,
        mt=max(mt, 1.0) if at_rest is None else mt,
        gain_margin=float(gains[gains > 1.0].min(initial=math.inf)),
        gain_margin_low=float(gains[gains < 1.0].max(initial=0.0)),
        phase_margin=float(np.abs(lead).min(initial=math.pi)),
        delay_margin=float(delays.min(initial=math.inf)),
    )
