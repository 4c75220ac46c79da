# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Stability of a closed loop and its margins: gain, phase, delay, peaks of the sensitivities.

The number of poles in the right half plane comes from the argument principle, and so does that of
the poles of a sampled loop outside the unit circle.

The characteristic equation is ``1 + sum L_k(s) = 0``, each L_k rational with a dead time of its
own. Where they have n poles at s = 0, all is multiplied by ``(a s/(1 + a s))^n``; the function H
that this leaves has no pole on the imaginary axis, and the same limit for s -> infinity. Its
zeros in the right half plane are those of the closed loop, and

    zeros = poles - (turning of H from w = 0 to infinity)/pi.

The phase of H is followed over a grid that shows corners, resonances and the turns of each dead
time. A cell in which it turns by more than a radian, or a dead time does, is divided, unless the
L_k are so small at both ends that H is nearer to its limit than zero is, whatever their phases:
there it turns around nothing. A loop of moderate Ms is that near before its dead time turns often,
since one that turns at a magnitude near 1 passes -1. So few cells are divided of every usable
loop, and a loop that needs far more counts as one with infinitely many zeros: it is undecided,
and nobody wants it. A loop of neutral type, whose L_k with dead time do not vanish at infinity, is
stable only if their magnitudes there have a sum below that of the rest (Bellman and Cooke 1963).
"""

from __future__ import annotations

import math
import operator
from collections import Counter
from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import ComplexArray, FloatArray, IntArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Margins
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.scalar import roots

# A loop whose phase has to be followed in more cells at once is undecided.
MOST_PIECES = 20_000
# Part of the distance of the limit of H from zero, within which H turns around nothing.
_SURE = 0.9
# H begins where it is this near to its limit for w -> 0, relative to that.
_AT_REST = 0.1
# Tangent of a phase step that is small enough to be unambiguous.
_CLEAR = math.tan(1.0)


def closed_loop_unstable_poles(terms: Sequence[TransferFunction]) -> float:
    """Return the number of zeros of ``1 + sum L_k(s)`` in the right half plane.

    :param terms: the L_k. Poles that several terms share count once.
    :return: a whole number; infinite for infinitely many zeros, one on the axis, or too many turns
        to be counted.
    :raises TuningError: if a term has poles on the imaginary axis other than at s = 0.
    """
    if any(t.real == 0.0 for term in terms for t in term.time_constants):
        raise TuningError("a process with undamped poles other than at s = 0 is not supported")
    limits = [at_infinity(t) for t in terms]
    at_once = sum(g for g, t in zip(limits, terms, strict=True) if t.dead_time == 0.0)
    later = sum(abs(g) for g, t in zip(limits, terms, strict=True) if t.dead_time > 0.0)
    if not later < abs(1.0 + at_once):
        return math.inf
    # Those that several terms share count once.
    unstable = [Counter(t for t in term.time_constants if t.real < 0.0) for term in terms]
    poles = reduce(operator.or_, unstable).total()
    limit, n = 1.0 + at_once, max(0, *(t.integrators for t in terms))
    near = later + _SURE * (abs(limit) - later)
    grid = frequencies(*terms)
    a = 1.0 / math.sqrt(grid[0] * grid[-1])

    def bounded(w: FloatArray) -> ComplexArray:
        s = 1j * w
        return np.asarray((1.0 + sum(t(s) for t in terms)) * (a * s / (1.0 + a * s)) ** float(n))

    def is_near(w: FloatArray) -> NDArray[np.bool_]:
        rests = (
            np.abs(t(1j * w) - (0.0 if t.dead_time else g))
            for g, t in zip(limits, terms, strict=True)
        )
        return np.asarray(sum(rests) < near)

    begin = a**n * sum(t.gain for t in terms if t.integrators == n) + (n == 0)
    low, high = grid[:1], grid[-1:]
    while abs(bounded(low)[0] - begin) > _AT_REST * abs(begin):
        low = 0.1 * low
        if low[0] < _LOWEST:
            return math.inf
    while not is_near(high)[0]:
        high = 2.0 * high
        if high[0] > 1.0 / _LOWEST:
            return math.inf
    grid = frequencies(*terms, times=(1.0 / low[0], 1.0 / high[0]))
    dead_time = max(t.dead_time for t in terms)
    turns = _followed(bounded, grid, dead_time, is_near)
    turns += float(
        np.angle(bounded(grid[:1])[0] / begin) - np.angle(bounded(grid[-1:])[0] / limit)
    )
    return math.inf if math.isnan(turns) else poles - round(turns / math.pi)


def winding(
    values: ComplexArray,
    w: FloatArray,
    poles: IntArray,
    integrators: IntArray,
    limits: FloatArray,
    period: float = 0.0,
) -> FloatArray:
    """Return the same count for many loops from values on a grid; NaN if it is not certain.

    This is much faster than :func:`closed_loop_unstable_poles`. The loops must stay away from
    zero and the grid must be fine, as for an ensemble of similar models.

    :param values: ``1 + L``, shape (n, m).
    :param w: rad/s, shape (n,), increasing, from a frequency below all dynamics but integrators to
        one at which the loops have vanished.
    :param poles: number of poles of each L in the right half plane, shape (m,).
    :param integrators: number of integrators of each L, shape (m,).
    :param limits: limit of each L for s -> infinity, 0 with a dead time; of sampled loops L at
        half the sampling frequency, shape (m,).
    :param period: of the samples [s]; 0: the loops are continuous.
    :return: shape (m,).
    """
    if period > 0.0:
        risen = np.append(1.0 - np.exp(-1j * w * period), 2.0)
    else:
        s = 1j * w / math.sqrt(w[1] * w[-1])
        risen = np.append(s / (1.0 + s), 1.0)
    bounded = np.concatenate((values, 1.0 + limits[None]))
    for n in np.unique(integrators):
        of = integrators == n
        bounded[:, of] *= (risen**n)[:, None]
    steps = bounded[1:] * bounded[:-1].conj()
    clear = np.all(np.abs(steps.imag) < _CLEAR * steps.real, axis=0)
    # With such short steps, each turn is one crossing of the negative real axis from above.
    above, left = bounded.imag >= 0.0, bounded.real < 0.0
    falls = np.sum(left[1:] & above[:-1] & ~above[1:], axis=0)
    rises = np.sum(left[1:] & ~above[:-1] & above[1:], axis=0)
    begins, ends = (np.arctan2(v.imag + 0.0, v.real) for v in (bounded[0], bounded[-1]))
    turns = np.rint((ends - begins) / math.pi + 2.0 * (falls - rises))
    return np.where(clear, poles - turns, math.nan)


def sampled_unstable_poles(
    loop: Loop, grid: FloatArray, period: float, poles: int, integrators: int
) -> float:
    """Return the number of closed-loop poles outside the unit circle.

    The phase of 1 + L is followed along the circle; cells in which it turns too far are divided.

    :param loop: L as a function of s, with ``z = exp(s h)``.
    :param grid: frequencies up to half that of the samples [rad/s], shape (n,).
    :param period: h [s].
    :param poles: number of poles of L outside the circle.
    :param integrators: number of integrators of L.
    :return: infinite: not certain, or one on the circle.
    """

    def bounded(w: FloatArray) -> ComplexArray:
        rise = 1.0 - np.exp(-1j * w * period)
        return np.asarray((1.0 + loop(1j * w)) * rise ** float(integrators))

    turns = _followed(bounded, grid)
    return math.inf if math.isnan(turns) else poles - round(turns / math.pi)


def _followed(
    function: Callable[[FloatArray], ComplexArray],
    grid: FloatArray,
    dead_time: float = 0.0,
    is_near: Callable[[FloatArray], NDArray[np.bool_]] | None = None,
) -> float:
    """Return by how much the phase of a function grows over a grid [rad]; NaN: it is not clear.

    :param function: of the frequency.
    :param grid: rad/s, increasing, shape (n,); cells in which the phase turns too far are divided.
    :param dead_time: the longest in the function [s].
    :param is_near: whether the function is so near to its limit, with whatever phase of its
        parts, that it turns around nothing; None: never.
    """
    values = function(grid)
    low, high, begins, ends = grid[:-1], grid[1:], values[:-1], values[1:]
    total = 0.0
    for _ in range(_MOST_DIVISIONS):
        with np.errstate(divide="ignore", invalid="ignore"):
            turns = np.angle(ends / begins)
        clear = (np.abs(turns) < _FOLLOWED) & (dead_time * (high - low) < _FOLLOWED)
        if is_near is not None and not clear.all():
            clear[~clear] = is_near(low[~clear]) & is_near(high[~clear])
        total += float(turns[clear].sum())
        low, high, begins, ends = low[~clear], high[~clear], begins[~clear], ends[~clear]
        if not low.size:
            return total
        if low.size > MOST_PIECES:
            break
        middle = 0.5 * (low + high)
        between = function(middle)
        low, high = np.concatenate((low, middle)), np.concatenate((middle, high))
        begins, ends = np.concatenate((begins, between)), np.concatenate((between, ends))
    return math.nan


def at_infinity(term: TransferFunction) -> float:
    """Return the limit for s -> infinity; with a dead time that of the magnitude."""
    excess = len(term.zeros) - len(term.time_constants) - term.integrators
    if excess < 0:
        return 0.0
    if excess > 0:
        return math.inf
    return float((term.gain * np.prod(term.zeros) / np.prod(term.time_constants)).real)


Loop = Callable[[ComplexArray], ComplexArray]

# Number of local maxima to refine, since the largest on the grid need not be the largest.
_PEAKS = 4
_ZOOMS, _ZOOM_POINTS = 9, 9
# Accuracy of the logarithm of a frequency.
_EXACT = 1e-13
# Below this nothing is known of how a loop begins [rad/s], nor above its inverse of how it ends.
_LOWEST = 1e-280
# Largest step of the phase that can be followed, and largest number of divisions of a cell.
_FOLLOWED, _MOST_DIVISIONS = 1.0, 40


def peaks(loop: Loop, grid: FloatArray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return Ms and Mt, the largest magnitudes of ``1/(1 + L)`` and ``L/(1 + L)``.

    :param loop: L as a function of s.
    :param grid: frequencies that show the peaks roughly [rad/s], increasing.
    :return: each with its frequency.
    """
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


def margins(
    loop: Loop, grid: FloatArray, ends: Sequence[float], *, integrates: bool
) -> tuple[Margins, float]:
    """Return the margins of a stable loop, and the frequency at which its sensitivity is largest.

    :param loop: L as a function of s.
    :param grid: frequencies fine enough to show every crossing [rad/s], increasing.
    :param ends: L where it is real by itself: at rest, unless it integrates, and at half the
        sampling frequency.
    :param integrates: whether L(0) is infinite.
    """
    values, log_grid = loop(1j * grid), np.log(grid)

    def log_ends(cells: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        return log_grid[cells], log_grid[cells + 1]

    cells = _changes(values.imag)
    cells = cells[(values.real[cells] < 0.0) | (values.real[cells + 1] < 0.0)]
    crossings = np.exp(roots(lambda x: loop(1j * np.exp(x)).imag, *log_ends(cells), _EXACT))
    real = np.append(loop(1j * crossings).real if crossings.size else np.empty(0), ends)
    gains = -1.0 / real[real < 0.0]
    size = np.log(np.abs(values))
    cells = _changes(size)
    crossovers = np.exp(
        roots(lambda x: np.log(np.abs(loop(1j * np.exp(x)))), *log_ends(cells), _EXACT)
    )
    lead = np.angle(-loop(1j * crossovers)) if crossovers.size else np.empty(0)
    delays = np.mod(lead, 2.0 * math.pi) / crossovers
    (ms, at), (mt, _) = peaks(loop, grid)
    found = Margins(
        # ms tends to 1 for w -> infinity; mt tends to 1 for w -> 0 with integral action.
        ms=max(ms, 1.0),
        mt=max(mt, 1.0) if integrates else mt,
        gain_margin=float(gains[gains > 1.0].min(initial=math.inf)),
        gain_margin_low=float(gains[gains < 1.0].max(initial=0.0)),
        phase_margin=float(np.abs(lead).min(initial=math.pi)),
        delay_margin=float(delays.min(initial=math.inf)),
    )
    return found, at
