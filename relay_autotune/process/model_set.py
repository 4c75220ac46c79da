# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Frequency responses of many models at once, continuous or between hold and sampler.

A command is given at each sample and held until the next one. With the step response y, a dead
time D and the period h,

    G(z) = (1 - z^-1) sum_{m >= 1, m h >= D} y(m h - D) z^-m.

A model is a chain of lags and integrators with the held command in front, ``x' = A x`` with A
lower triangular. With ``E(t) = exp(A t) - 1``, the first sample after the step at t = f, and
``r = z - 1``, forward substitution gives the sum:

    x_0 = 1,    x_i = (r E_i0(f) + sum_{j < i} E_ij(h) x_j)/(r - E_ii(h)).

Every term is of the order of h, so that no digits are lost where the period is short; E is
doubled, ``E(2 t) = 2 E(t) + E(t)^2``, from a time so short that a few terms of its series do.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import ComplexArray, FloatArray, IntArray
from relay_autotune.errors import ModelError
from relay_autotune.process.transfer_function import TransferFunction

# A dead time of a whole number of periods is recognised in spite of this relative rounding.
_ROUNDING = 1e-9
# Largest exponent of z; nothing is left of what came a sample before.
_LONGEST_SAMPLE = 300.0
# Terms of the series of exp(x) - 1 for a norm of at most a half.
_TERMS = 14

_Matrices = NDArray[Any]


@dataclass(frozen=True)
class _Alike:
    """Models with the same numbers of zeros, lags and integrators.

    :param place: of each among all, shape (m,).
    :param gain: shape (m,).
    :param dead_time: s, shape (m,).
    :param zeros: shape (p, m).
    :param lags: shape (q, m).
    :param integrators: how many each has.
    """

    place: IntArray
    gain: FloatArray
    dead_time: FloatArray
    zeros: ComplexArray
    lags: ComplexArray
    integrators: int

    @classmethod
    def of(cls, place: list[int], models: list[TransferFunction]) -> _Alike:
        return cls(
            np.array(place),
            np.array([m.gain for m in models]),
            np.array([m.dead_time for m in models]),
            np.array([m.zeros for m in models], dtype=np.complex128).T,
            np.array([m.time_constants for m in models], dtype=np.complex128).T,
            models[0].integrators,
        )

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return the responses without a hold, shape (n, m)."""
        values = self.gain * _late(s, self.dead_time)
        s = s[:, None]
        if self.integrators:
            values *= s ** float(-self.integrators)
        for zero in self.zeros:
            values *= 1.0 + zero * s
        for lag in self.lags:
            values /= 1.0 + lag * s
        return np.asarray(values)

    def chain(self) -> tuple[_Matrices, _Matrices]:
        """Return A, shape (m, k, k), and the weights of the states in the output, (m, k)."""
        if len(self.zeros) > len(self.lags) + self.integrators or self.integrators < 0:
            raise ModelError("a process has at least as many poles as zeros, and none at s = 0")
        size, zeros = 1 + self.integrators + len(self.lags), list(self.zeros)
        a = np.zeros((self.gain.size, size, size), dtype=np.complex128)
        out = np.zeros((self.gain.size, size), dtype=np.complex128)
        out[:, 0] = 1.0
        sections = [*self.lags, *[None] * self.integrators]
        # A zero needs a section of its own; lags come first, since theirs are bounded.
        for i, lag in enumerate(sections, start=1):
            zero = (zeros.pop() if zeros else np.zeros(self.gain.size))[:, None]
            own = np.zeros(size)
            own[i] = 1.0
            if lag is None:
                a[:, i], out = out, zero * out + own
            else:
                share = zero / lag[:, None]
                a[:, i], out = (out - own) / lag[:, None], share * out + (1.0 - share) * own
        real = not (np.any(self.lags.imag) or np.any(self.zeros.imag))
        return (a.real.copy(), out.real.copy()) if real else (a, out)


def _late(s: ComplexArray, time: FloatArray) -> ComplexArray:
    """Return exp(-s time), shape (n, m); much faster so than by a complex exponential."""
    angle = s.imag[:, None] * time
    found = np.empty(angle.shape, dtype=np.complex128)
    found.real, found.imag = np.cos(angle), -np.sin(angle)
    if np.any(s.real):
        found *= np.exp(-s.real[:, None] * time)
    return found


def _moved(a: _Matrices, time: FloatArray) -> _Matrices:
    """Return exp(A t) - 1 of each matrix, shape (m, k, k)."""
    with np.errstate(over="ignore", invalid="ignore"):
        norm = float((np.abs(a).sum(axis=2).max(axis=1) * time).max(initial=0.0))
        halvings = max(int(np.ceil(np.log2(norm))) + 1, 0) if 0.0 < norm < np.inf else 0
        x = a * (time * 0.5**halvings)[:, None, None]
        term, found = x, x.copy()
        for k in range(2, _TERMS + 1):
            term = term @ x / k
            found += term
        for _ in range(halvings):
            found = found @ found + 2.0 * found
    return np.asarray(found)


class _Held:
    """Models that are alike, between hold and sampler."""

    def __init__(self, models: _Alike, period: float, delay: int) -> None:
        wait = np.maximum(np.ceil(models.dead_time / period * (1.0 - _ROUNDING)), 1.0)
        first = np.maximum(wait * period - models.dead_time, 0.0)
        a, self._out = models.chain()
        self._begin = _moved(a, first)[:, :, 0]
        self._move = _moved(a, np.full(first.shape, period))
        self._gain, self._wait, self._period = models.gain, (wait + delay) * period, period

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return the responses at ``z = exp(s h)``, shape (n, m)."""
        turn = s * self._period
        r = np.expm1(np.minimum(turn.real, _LONGEST_SAMPLE) + 1j * turn.imag)[:, None]
        move, states = self._move, [np.ones((1, 1))]
        total = self._out[:, 0] * states[0]
        for i in range(1, self._out.shape[1]):
            into = r * self._begin[:, i]
            for j in np.flatnonzero(move[:, i, :i].any(axis=0)):
                into = into + move[:, i, j] * states[j]
            states.append(into / (r - move[:, i, i]))
            total = total + self._out[:, i] * states[i]
        return np.asarray(self._gain * _late(s, self._wait) * total)


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """What processes show beside their models: a response to a step of the command for each.

    Each rises along a straight line from one lag to the next. Of what is slower than the record
    lasted it tells nothing: there the model stands alone, by a factor ``s/(s + lowest)``.

    :param lags: s, shape (b + 1,).
    :param rises: from one lag to the next [y/u], shape (m, b).
    :param lowest: frequency of which the record shows one radian [rad/s].
    """

    lags: FloatArray
    rises: FloatArray
    lowest: float

    def later(self, time: float) -> ModelErrors:
        """Return the same behind a dead time.

        :param time: s.
        """
        return replace(self, lags=self.lags + time)

    def of(self, k: int) -> ModelErrors:
        """Return that of one process.

        :param k: which.
        """
        return replace(self, rises=self.rises[[k]])

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return the frequency responses [y/u], shape (n, m).

        :param s: rad/s, not 0, shape (n,).
        """
        ramps = np.exp(-np.multiply.outer(s, self.lags)) / s[:, None]
        return self._between(ramps, s / (s + self.lowest))

    def held(self, s: ComplexArray, period: float, delay: int) -> ComplexArray:
        """Return those between hold and sampler at ``z = exp(s h)``, shape (n, m).

        A ramp that begins at a lag, with n the first sample from there on, rises by
        ``z^-n (n h - lag + h/(z - 1))`` from sample to sample.

        :param s: rad/s, not 0, shape (n,).
        :param period: h [s].
        :param delay: further samples until a command takes effect.
        """
        first = np.ceil(self.lags / period * (1.0 - _ROUNDING))
        turn = s * period
        after = first * period - self.lags + period / np.expm1(turn)[:, None]
        ramps = np.exp(-np.multiply.outer(turn, first + delay)) * after
        # A sampled s/(s + lowest): (1 - z^-1)/(1 - a z^-1).
        rise, fades = -np.expm1(-turn), -math.expm1(-self.lowest * period)
        return self._between(ramps, rise / (fades + (1.0 - fades) * rise))

    def _between(self, ramps: ComplexArray, shown: ComplexArray) -> ComplexArray:
        """Return the responses of ramps that end where the next ones begin, shape (n, m)."""
        bins = (ramps[:, :-1] - ramps[:, 1:]) / np.diff(self.lags)
        return np.asarray((bins @ self.rises.T) * shown[:, None])


class ModelSet:
    """Similar processes, such as those within an uncertainty, as a loop meets them.

    :param models: m of them, at least one, with the dead time of the loop, but none for a hold.
    :param period: of the samples, between which the command is held [s]; 0: continuous.
    :param delay: further samples until a command takes effect.
    :param errors: what each process shows beside its model; None: nothing.
    :ivar integrators: of each model, shape (m,).
    :ivar unstable_poles: how many each has in the right half plane, shape (m,).
    :raises ModelError: if a model that is held has more zeros than poles.
    """

    def __init__(
        self,
        models: Sequence[TransferFunction],
        period: float = 0.0,
        delay: int = 0,
        errors: ModelErrors | None = None,
    ) -> None:
        self.models, self.period, self.delay, self.errors = tuple(models), period, delay, errors
        self.integrators = np.array([m.integrators for m in self.models])
        self.unstable_poles = np.array(
            [sum(t.real < 0.0 for t in m.time_constants) for m in self.models]
        )
        alike = defaultdict(list)
        for k, m in enumerate(self.models):
            alike[len(m.zeros), len(m.time_constants), m.integrators].append(k)
        groups = [_Alike.of(of, [self.models[k] for k in of]) for of in alike.values()]
        self._groups = [
            (group.place, group if period == 0.0 else _Held(group, period, delay))
            for group in groups
        ]
        # Frequencies and responses in one, for several threads.
        self._known: tuple[FloatArray, ComplexArray] | None = None

    def __call__(self, s: ComplexArray) -> ComplexArray:
        """Return y/u of each process; of held ones at ``z = exp(s h)``.

        :param s: rad/s, no pole of a model and, with errors, not 0, shape (n,).
        :return: shape (n, m).
        """
        s = np.asarray(s, dtype=np.complex128)
        found = np.empty((s.size, len(self.models)), dtype=np.complex128)
        for place, group in self._groups:
            found[:, place] = group(s)
        if self.errors is None:
            return found
        if self.period == 0.0:
            return found + self.errors(s)
        return found + self.errors.held(s, self.period, self.delay)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.models)

    def sampled(self, period: float, delay: int = 0) -> ModelSet:
        """Return the same models at another period; see the class.

        :param period: s; 0: continuous.
        :param delay: further samples.
        """
        return ModelSet(self.models, period, delay, self.errors)

    def of(self, k: int) -> ModelSet:
        """Return one of them.

        :param k: which.
        """
        errors = None if self.errors is None else self.errors.of(k)
        return ModelSet(self.models[k : k + 1], self.period, self.delay, errors)

    def at(self, frequency: FloatArray) -> ComplexArray:
        """Return the response of each model at each frequency.

        The values at the frequencies of the first call are kept, since the grids for the loops
        of one process have most of their frequencies in common.

        :param frequency: rad/s, shape (n,), increasing.
        :return: y/u, shape (n, m).
        """
        if self._known is None:
            self._known = frequency, self(1j * frequency)
        known, responses = self._known
        place = np.minimum(np.searchsorted(known, frequency), known.size - 1)
        found = responses[place]
        new = known[place] != frequency
        if np.any(new):
            found[new] = self(1j * frequency[new])
        return found
