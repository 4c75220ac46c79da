# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Magnitude and phase of a transfer function, over any number of decades."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.transfer_function import TransferFunction

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
