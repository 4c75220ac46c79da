# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Stability by the exact magnitude and phase: ultimate point, and poles of a closed loop."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.scalar import roots

_LARGE = 300.0
_WIDTHS = np.linspace(-8.0, 8.0, 65)


@dataclass(frozen=True)
class _Factor:
    """One factor ``1 + j w T``, or the two of a complex pair.

    :param log_time: log of |T|.
    :param damping: damping of a pair; for a real T its sign.
    :param pair: whether it is a pair.
    :param power: +1: a zero, -1: a pole.
    """

    log_time: float
    damping: float
    pair: bool
    power: int


@dataclass(frozen=True)
class Polar:
    """A transfer function as the logarithm of its magnitude and its phase, over log frequency.

    Neither overflows. The phase is kept as whole quarter turns and a small rest: two lags with a
    dead time 1e-40 times as long then have a phase margin of 1e-20, and not of zero.

    :param log_gain: log of |K|.
    :param integrators: poles at s = 0.
    :param half_turn: whether the phase starts at -180 degrees at w = 0, with the controller's
        sign.
    :param factors: all other poles and zeros.
    :param log_delay: log of the dead time; -infinity: no dead time.
    """

    log_gain: float
    integrators: int
    half_turn: bool
    factors: tuple[_Factor, ...]
    log_delay: float

    @classmethod
    def of(cls, model: TransferFunction) -> Polar:
        """Return the polar form of a transfer function."""
        factors = []
        for power, constants in ((1, model.zeros), (-1, model.time_constants)):
            for c in constants:
                if c.imag == 0.0:
                    sign = math.copysign(1.0, c.real)
                    factors.append(_Factor(math.log(abs(c.real)), sign, False, power))
                elif c.imag > 0.0:
                    size = math.hypot(c.real, c.imag)
                    factors.append(_Factor(math.log(size), c.real / size, True, power))
        return cls(
            math.log(abs(model.gain)),
            model.integrators,
            model.gain * model.process_sign < 0.0,
            tuple(factors),
            math.log(model.dead_time) if model.dead_time > 0.0 else -math.inf,
        )

    @property
    def delayed(self) -> bool:
        """Whether there is a dead time."""
        return self.log_delay > -math.inf

    @property
    def roots(self) -> int:
        """Number of poles and zeros."""
        return abs(self.integrators) + sum(2 if f.pair else 1 for f in self.factors)

    def corners(self) -> list[float]:
        """Return logarithms of the corner frequencies, the lowest first; [0] without corners."""
        found = [-f.log_time for f in self.factors]
        if self.delayed:
            found.append(-self.log_delay)
        return sorted(found) or [0.0]

    def resonances(self) -> FloatArray:
        """Return logarithms of frequencies around each resonance, within its width."""
        found = [np.empty(0)]
        for f in self.factors:
            if f.pair:
                near = 1.0 + _WIDTHS * f.damping
                found.append(np.log(near[near > 0.0]) - f.log_time)
        return np.concatenate(found)

    def size(self, place: FloatArray) -> FloatArray:
        """Return the logarithm of the magnitude.

        :param place: log frequencies, shape (n,).
        """
        total = self.log_gain - self.integrators * place
        for f in self.factors:
            x = place + f.log_time
            if f.pair:
                near = np.exp(np.minimum(x, 0.25 * _LARGE))
                with np.errstate(divide="ignore"):
                    inside = np.log(np.hypot(1.0 - near * near, 2.0 * f.damping * near))
                part = np.where(x < 0.25 * _LARGE, inside, 2.0 * x)
            else:
                part = 0.5 * np.logaddexp(0.0, 2.0 * x)
            total = total + f.power * part
        return np.asarray(total)

    def _parts(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the phase as quarter turns and a rest [rad]."""
        quarters = np.full(place.shape, -float(self.integrators) - 2.0 * self.half_turn)
        rest = np.zeros(place.shape)
        for f in self.factors:
            log_x = place + f.log_time
            small = np.exp(-np.abs(log_x))
            high = log_x > 0.0
            if f.pair:
                side = -1.0 if f.damping < 0.0 else 1.0
                angle = np.arctan2(2.0 * abs(f.damping) * small, 1.0 - small * small)
                turns = 2.0
            else:
                side, angle, turns = f.damping, np.arctan(small), 1.0
            quarters += f.power * side * turns * high
            rest += f.power * side * np.where(high, -angle, angle)
        if self.delayed:
            rest -= np.exp(np.minimum(place + self.log_delay, _LARGE))
        return quarters, rest

    def turns(self, place: FloatArray, whole: FloatArray | float = 0.0) -> FloatArray:
        """Return the phase in turns, counted from -180 degrees, minus ``whole``.

        :param place: log frequencies, shape (n,).
        :param whole: turns to subtract, shape (n,).
        """
        quarters, rest = self._parts(place)
        return np.asarray((quarters + 2.0 - 4.0 * whole) / 4.0 + rest / (2.0 * math.pi))

    def lead(self, place: float) -> float:
        """Return the phase relative to w = 0, at a frequency below all corners [rad].

        :param place: log frequency below all corners.
        """
        return float(self._parts(np.array([place]))[1][0])


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
        slope = (
            sum(z.real for z in model.zeros)
            - sum(t.real for t in model.time_constants)
            - model.dead_time
        )
        # Near s = 0 the root is eps/(K G'(0)), and G(0) is negative.
        every.append(Crossing(1.0 / abs(model.gain), 0.0, -1 if slope + lead > 0.0 else 1))
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
    polar = Polar.of(model)
    start = math.pi if model.gain * model.process_sign > 0.0 else 0.0
    lead = polar.lead(polar.corners()[0] - 14.0) > 0.0
    for k in range(m):
        cosine = math.cos((start + 2.0 * math.pi * k) / m)
        unstable += cosine > 1e-9 or (abs(cosine) <= 1e-9 and not lead)
    return unstable


def _crossings(model: TransferFunction) -> list[Crossing]:
    """Crossings up to the first, and later ones of at least its magnitude."""
    polar = Polar.of(model)
    logarithms = _logarithmic(polar)
    first = _scan(polar, _grid(polar, logarithms, *_first_range(polar, logarithms)))
    found = [*first]
    if not first or not polar.delayed:
        return found
    last = math.log(first[-1].frequency)
    least = -math.log(min(c.gain for c in first))
    for low, high in _summits(polar, logarithms, last + 1e-9, least):
        found += _scan(polar, _grid(polar, logarithms, low, high))
    return found


def _summits(
    polar: Polar, logarithms: FloatArray, low: float, least: float
) -> list[tuple[float, float]]:
    """Return the ranges of log frequency where later turns of the dead time matter.

    They matter only where the magnitude is larger again. About each of its maxima there are then
    turns that bring more pairs of poles to the right than ever go back, each at a smaller gain
    than the turns further off.

    :param low: log frequency from which on turns are looked for.
    :param least: log of the largest magnitude before.
    """
    place = np.append(low, logarithms[logarithms > low])
    size = np.concatenate(([math.inf], polar.size(place), [-math.inf]))
    highest = (size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:])
    # Between two points of the grid it may be a little larger than at either.
    highest &= size[1:-1] > least - 1e-3
    found: list[tuple[float, float]] = []
    for k in np.flatnonzero(highest).tolist():
        near = place[max(k - 1, 0) : k + 2]
        for _ in range(_ZOOMS):
            near = np.linspace(near[0], near[-1], 33)
            k = int(np.argmax(polar.size(near)))
            at, near = float(near[k]), near[max(k - 1, 0) : k + 2]
        angle = math.exp(min(at + polar.log_delay, 700.0))
        away = (polar.roots + 4) * 2.0 * math.pi / _TURN * _step(angle)
        begin = max(math.log(max(angle - away, 1e-300)) - polar.log_delay, low)
        end = math.log(angle + away) - polar.log_delay
        if found and begin <= found[-1][1]:
            begin, _ = found.pop()
        found.append((begin, end))
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
        angles = np.linspace(begin, end, int((end - begin) / _step(end) + 2.0))
        parts.append(np.log(angles[1:-1]) - polar.log_delay)
    return np.unique(np.concatenate(parts))


def _step(angle: float) -> float:
    """Return how far apart angles of the dead time are looked at [rad].

    Far out the turns are closer than rounding; the magnitude is the same at all of them.
    """
    return max(_TURN, 1e-12 * angle)


def _scan(polar: Polar, grid: FloatArray) -> list[Crossing]:
    """Return the crossings between the points of a grid of log frequencies."""
    level = np.floor(polar.turns(grid))
    cells = np.flatnonzero(np.diff(level) != 0.0)
    if cells.size == 0:
        return []
    # A falling phase crosses its present level, a rising one the next level.
    target = np.maximum(level[cells], level[cells + 1])
    falls = level[cells + 1] < level[cells]
    place = roots(lambda at: polar.turns(at, target), grid[cells], grid[cells + 1])
    with np.errstate(over="ignore"):
        frequency, gain = np.exp(place), np.exp(-polar.size(place))
    usable = np.isfinite(frequency) & np.isfinite(gain) & (frequency > 0.0) & (gain > 0.0)
    return [
        Crossing(float(g), float(w), 2 if fall else -2)
        for g, w, fall, good in zip(gain, frequency, falls, usable, strict=True)
        if good
    ]
