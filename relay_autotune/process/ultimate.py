# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Stability by the exact magnitude and phase: ultimate point, and poles of a closed loop."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.scalar import roots


def _size(model: TransferFunction, place: FloatArray) -> FloatArray:
    """Return the logarithm of the magnitude, which does not overflow.

    :param place: log frequencies, shape (n,).
    """
    w = 1j * np.exp(place)
    total = math.log(abs(model.gain)) - model.integrators * place
    with np.errstate(divide="ignore"):
        for power, constants in ((1.0, model.zeros), (-1.0, model.time_constants)):
            for c in constants:
                total = total + power * np.log(np.abs(1.0 + w * c))
    return np.asarray(total)


def _turns(
    model: TransferFunction, place: FloatArray, whole: FloatArray | float = 0.0
) -> FloatArray:
    """Return the phase in turns, counted from -180 degrees, minus ``whole``.

    :param place: log frequencies, shape (n,).
    :param whole: turns to subtract, shape (n,).
    """
    return np.asarray(model.phase(np.exp(place)) / (2.0 * math.pi) + 0.5 - whole)


# Step of the dead time's angle [rad], and how often a maximum is looked at closer.
_TURN, _ZOOMS = 0.3, 6


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
class Crossing:
    """Closed-loop poles cross the imaginary axis as the gain grows.

    :param gain: at which they do, its size.
    :param frequency: rad/s.
    :param roots_to_the_right: how many move to the right; negative: to the left.
    """

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
    found = first_stable(model, _crossings(model))
    end = None if found is None else found[1]
    if end is None or end.frequency == 0.0:
        return None
    return UltimatePoint(model.process_sign * end.gain, end.frequency)


def first_stable(
    model: TransferFunction, crossings: Iterable[Crossing], lead: float = 0.0
) -> tuple[float, Crossing | None] | None:
    """Return the first range of gains that stabilises a process in a loop; None: none does.

    :param model: the process.
    :param crossings: of the imaginary axis at frequencies above zero.
    :param lead: what the controller adds to the phase near zero frequency [s].
    :return: the least gain, and the crossing that ends the range; None: it does not end.
    """
    every = [*crossings]
    if model.integrators == 0 and model.gain * model.process_sign < 0.0:
        # Near s = 0 the root is eps/(K G'(0)), and G(0) is negative.
        side = -1 if _lead(model) + lead > 0.0 else 1
        every.append(Crossing(1.0 / abs(model.gain), 0.0, side))
    on_the_right = unstable_at_small_gain(model)
    low = 0.0 if on_the_right == 0 else math.nan
    for crossing in sorted(every, key=lambda c: c.gain):
        on_the_right += crossing.roots_to_the_right
        if math.isnan(low) and on_the_right == 0:
            low = crossing.gain
        elif not math.isnan(low) and on_the_right > 0:
            return low, crossing
    return None if math.isnan(low) else (low, None)


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
    start = math.pi if model.gain * model.process_sign > 0.0 else 0.0
    for k in range(m):
        cosine = math.cos((start + 2.0 * math.pi * k) / m)
        unstable += cosine > 1e-9 or (abs(cosine) <= 1e-9 and not _lead(model) > 0.0)
    return unstable


def _lead(model: TransferFunction) -> float:
    """Return what lags, zeros and dead time add to the phase near zero frequency [s]."""
    added = sum(model.zeros) - sum(model.time_constants) - model.dead_time
    return complex(added).real


def _crossings(model: TransferFunction) -> list[Crossing]:
    """Crossings up to the first, and later ones of at least its magnitude."""
    # Dense enough for everything but the turns of the dead time.
    rational, times = replace(model, dead_time=0.0), (model.dead_time,)
    logarithms = np.log(frequencies(rational, times=times))
    low, high = float(logarithms[0]), float(logarithms[-1])
    if model.dead_time:
        # The rational part turns the phase by at most a quarter for each root. So at this angle
        # the dead time has certainly passed -180 degrees.
        high = math.log((0.5 * _roots(model) + 4.0) * math.pi / model.dead_time)
    first = _scan(model, _grid(model, logarithms, low, high))
    found = [*first]
    if not first or not model.dead_time:
        return found
    last = math.log(first[-1].frequency)
    least = -math.log(min(c.gain for c in first))
    for low, high in _summits(model, logarithms, last + 1e-9, least):
        found += _scan(model, _grid(model, logarithms, low, high))
    return found


def _summits(
    model: TransferFunction, logarithms: FloatArray, low: float, least: float
) -> list[tuple[float, float]]:
    """Return the ranges of log frequency where later turns of the dead time matter.

    They matter only where the magnitude is larger again. About each of its maxima there are then
    turns that bring more pairs of poles to the right than ever go back, each at a smaller gain
    than the turns further off.

    :param low: log frequency from which on turns are looked for.
    :param least: log of the largest magnitude before.
    """
    place = np.append(low, logarithms[logarithms > low])
    size = _size(model, place)
    # Where rounding hides how it goes on there is no maximum.
    moves = np.append(True, np.diff(size) != 0.0)
    place, size = place[moves], np.concatenate(([math.inf], size[moves], [-math.inf]))
    highest = (size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:])
    # Between two points of the grid it may be a little larger than at either.
    highest &= size[1:-1] > least - 1e-3
    found: list[tuple[float, float]] = []
    for k in np.flatnonzero(highest).tolist():
        near = place[max(k - 1, 0) : k + 2]
        for _ in range(_ZOOMS):
            near = np.linspace(near[0], near[-1], 33)
            k = int(np.argmax(_size(model, near)))
            at, near = float(near[k]), near[max(k - 1, 0) : k + 2]
        angle = math.exp(at) * model.dead_time
        away = (_roots(model) + 4) * 2.0 * math.pi / _TURN * _step(angle)
        begin = math.log((angle - away) / model.dead_time) if angle > away else low
        end = math.log((angle + away) / model.dead_time)
        begin = max(begin, low)
        if found and begin <= found[-1][1]:
            begin, _ = found.pop()
        found.append((begin, end))
    return found


def _roots(model: TransferFunction) -> int:
    """Return the number of poles and zeros."""
    return len(model.zeros) + len(model.time_constants) + abs(model.integrators)


def _grid(model: TransferFunction, logarithms: FloatArray, low: float, high: float) -> FloatArray:
    parts = [np.array([low, high]), logarithms[(logarithms > low) & (logarithms < high)]]
    if model.dead_time:
        # In angles of the dead time, which are independent of the unit of time.
        begin, end = (math.exp(edge) * model.dead_time for edge in (low, high))
        angles = np.linspace(begin, end, int((end - begin) / _step(end) + 2.0))
        parts.append(np.log(angles[1:-1] / model.dead_time))
    return np.unique(np.concatenate(parts))


def _step(angle: float) -> float:
    """Return how far apart angles of the dead time are looked at [rad].

    Far out the turns are closer than rounding; the magnitude is the same at all of them.
    """
    return max(_TURN, 1e-12 * angle)


def _scan(model: TransferFunction, grid: FloatArray) -> list[Crossing]:
    """Return the crossings between the points of a grid of log frequencies."""
    level = np.floor(_turns(model, grid))
    cells = np.flatnonzero(np.diff(level) != 0.0)
    if cells.size == 0:
        return []
    # A falling phase crosses its present level, a rising one the next level.
    target = np.maximum(level[cells], level[cells + 1])
    falls = level[cells + 1] < level[cells]
    place = roots(lambda at: _turns(model, at, target), grid[cells], grid[cells + 1])
    with np.errstate(over="ignore"):
        frequency, gain = np.exp(place), np.exp(-_size(model, place))
    usable = np.isfinite(frequency) & np.isfinite(gain) & (frequency > 0.0) & (gain > 0.0)
    return [
        Crossing(float(g), float(w), 2 if fall else -2)
        for g, w, fall, good in zip(gain, frequency, falls, usable, strict=True)
        if good
    ]
