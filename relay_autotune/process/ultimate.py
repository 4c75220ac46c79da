# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Stability by the exact phase: ultimate point, and poles of a closed loop."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.polar import Polar
from relay_autotune.process.transfer_function import TransferFunction

_MOST_STEPS = 100
_ACCURACY = 2e-16
_MOST_POINTS = 200_000


@dataclass(frozen=True)
class UltimatePoint:
    """The proportional gain at which the closed loop oscillates.

    :param gain: K_u, with the sign of the process, so that ``K_u G(j w_u) = -1`` [u/y].
    :param frequency: w_u [rad/s].
    """

    gain: float
    frequency: float

    @property
    def period(self) -> float:
        """P_u = 2 pi/w_u [s]."""
        return 2.0 * math.pi / self.frequency


@dataclass(frozen=True)
class _Crossing:
    gain: float
    frequency: float
    roots_to_the_right: int


def ultimate_point(model: TransferFunction) -> UltimatePoint | None:
    """Return the gain at which stability ends; None if it never ends, or no gain stabilises.

    >>> from relay_autotune import TransferFunction, ultimate_point
    >>> point = ultimate_point(TransferFunction.fopdt(1.65, 20.0, 10.0))
    >>> print(f"K_u {point.gain:.4g} u/y at w_u {point.frequency:.4g} rad/s")
    K_u 2.307 u/y at w_u 0.1837 rad/s

    All frequencies at which the phase is an odd multiple of -180 degrees follow from the
    continuous phase, so that neither a large dead time nor a resonance hides one. Raising the
    gain through such a point moves a pair of closed-loop poles to the right if the phase falls
    with frequency, and to the left if it rises. Counting from the poles at zero gain, the ultimate
    gain is the upper end of the first range without poles on the right. An unstable process also
    has a lower end, which is not returned.

    :param model: the process.
    """
    crossings = sorted(_crossings(model), key=lambda c: c.gain)
    on_the_right = unstable_at_small_gain(model)
    was_stable = on_the_right == 0
    for crossing in crossings:
        on_the_right += crossing.roots_to_the_right
        if was_stable and on_the_right > 0:
            if crossing.frequency == 0.0:
                return None
            return UltimatePoint(model.process_sign * crossing.gain, crossing.frequency)
        was_stable = was_stable or on_the_right == 0
    return None


def unstable_at_small_gain(model: TransferFunction) -> int:
    """Return the number of closed-loop poles in the right half plane as the gain leaves zero.

    :param model: the process.
    """
    unstable = sum(1 for t in model.time_constants if t.real < 0.0)
    m = model.integrators
    if m < 1:
        return unstable
    # The poles at s = 0 start along s^m = -K g. A pole that starts straight up moves to the left
    # only if the phase near zero frequency is above its limit.
    polar = Polar.of(model)
    start = math.pi if model.gain * model.process_sign > 0.0 else 0.0
    lead = polar.lead(polar.corners()[0] - 14.0) > 0.0
    for k in range(m):
        cosine = math.cos((start + 2.0 * math.pi * k) / m)
        unstable += cosine > 1e-9 or (abs(cosine) <= 1e-9 and not lead)
    return unstable


def _crossings(model: TransferFunction) -> list[_Crossing]:
    """Crossings up to the first, and later ones of at least its magnitude."""
    found = []
    if model.integrators == 0 and model.gain * model.process_sign < 0.0:
        slope = (
            sum(z.real for z in model.zeros)
            - sum(t.real for t in model.time_constants)
            - model.dead_time
        )
        # Near s = 0 the root is eps/(K G'(0)), and G(0) is negative.
        found.append(_Crossing(1.0 / abs(model.gain), 0.0, -1 if slope > 0.0 else 1))
    polar = Polar.of(model)
    logarithms = _logarithmic(polar)
    first = _scan(polar, _grid(polar, logarithms, *_first_range(polar, logarithms)))
    found += first
    if not first or not polar.delayed:
        return found
    # Later turns of the dead time matter only if the magnitude is larger again.
    least = -math.log(min(c.gain for c in first))
    last = math.log(first[-1].frequency)
    beyond = np.append(last, logarithms[logarithms > last])
    sizes = polar.size(beyond)
    if bool(np.all(np.diff(sizes) <= 0.0)):
        return found
    # Between two points of the grid it may be a little larger than at either.
    higher = beyond[1:][sizes[1:] > least - 1e-3]
    if higher.size:
        found += _scan(polar, _grid(polar, logarithms, last + 1e-9, float(higher[-1]) + 0.1))
    return found


def _logarithmic(polar: Polar) -> FloatArray:
    """Return logarithms of frequencies, dense enough for everything but the dead time."""
    corners = polar.corners()
    low, high = corners[0] - 9.2, corners[-1] + 9.2
    grid = np.linspace(low, high, int(17.4 * (high - low)))
    return np.unique(np.concatenate((grid, polar.resonances())))


def _first_range(polar: Polar, logarithms: FloatArray) -> tuple[float, float]:
    if not polar.delayed:
        return float(logarithms[0]), float(logarithms[-1])
    # The rational part turns the phase by at most a quarter for each root. So at this angle the
    # dead time has certainly passed -180 degrees.
    turns = polar.roots * math.pi / 2.0 + 4.0 * math.pi
    return float(logarithms[0]), math.log(turns) - polar.log_delay


def _grid(polar: Polar, logarithms: FloatArray, low: float, high: float) -> FloatArray:
    parts = [np.array([low, high]), logarithms[(logarithms > low) & (logarithms < high)]]
    if polar.delayed:
        # In angles of the dead time, which are independent of the unit of time.
        begin, end = (math.exp(min(edge + polar.log_delay, 700.0)) for edge in (low, high))
        count = int(min((end - begin) / 0.3 + 2.0, _MOST_POINTS))
        angles = np.linspace(begin, end, count)
        parts.append(np.log(angles[1:-1]) - polar.log_delay)
    return np.unique(np.concatenate(parts))


def _scan(polar: Polar, grid: FloatArray) -> list[_Crossing]:
    """Return the crossings between the points of a grid of log frequencies."""
    level = np.floor(polar.turns(grid))
    cells = np.flatnonzero(np.diff(level) != 0.0)
    if cells.size == 0:
        return []
    # A falling phase crosses its present level, a rising one the next level.
    target = np.maximum(level[cells], level[cells + 1])
    falls = level[cells + 1] < level[cells]
    place = _roots(polar, grid[cells], grid[cells + 1], target)
    with np.errstate(over="ignore"):
        frequency, gain = np.exp(place), np.exp(-polar.size(place))
    usable = np.isfinite(frequency) & np.isfinite(gain) & (frequency > 0.0) & (gain > 0.0)
    return [
        _Crossing(float(g), float(w), 2 if fall else -2)
        for g, w, fall, good in zip(gain, frequency, falls, usable, strict=True)
        if good
    ]


def _roots(polar: Polar, low: FloatArray, high: FloatArray, target: FloatArray) -> FloatArray:
    """Return where the phase has a number of turns, all at once by the Illinois method.

    :param low: log frequencies at one side of each root, shape (n,).
    :param high: at the other, shape (n,).
    :param target: turns, shape (n,).
    """
    at_low, at_high = polar.turns(low, target), polar.turns(high, target)
    place, moved = low, np.full(low.shape, 2)
    for _ in range(_MOST_STEPS):
        before = place
        with np.errstate(divide="ignore", invalid="ignore"):
            place = (low * at_high - high * at_low) / (at_high - at_low)
        # Rounding may place the root at an end, or a little beyond.
        place = np.clip(np.where(np.isfinite(place), place, low), low, high)
        if bool(np.all(np.abs(place - before) <= _ACCURACY * np.maximum(np.abs(place), 1.0))):
            break
        value = polar.turns(place, target)
        below = np.sign(value) == np.sign(at_low)
        # Illinois: halve the value at an end that stays twice, so that both ends converge.
        again = np.where(below == moved, 0.5, 1.0)
        at_low, at_high = (
            np.where(below, value, again * at_low),
            np.where(below, again * at_high, value),
        )
        moved = below
        low, high = np.where(below, place, low), np.where(below, high, place)
    return place
