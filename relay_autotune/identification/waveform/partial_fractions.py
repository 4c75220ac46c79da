# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Responses by partial fractions, where the poles are equal or well apart.

With the step of a held input as a pole at s = 0, an output is

    Y(s) = sum_p sum_j A_(p,j)/(s - p)^(j+1),    y(t) = sum_p sum_j A_(p,j) S_(p,j)(t),
    S_(p,j)(t) = sum_k step_k (t - t_k)^j/j! exp(p (t - t_k)),

which needs no matrix and is several times as fast as
:class:`relay_autotune.process.modes.Modes`. The terms of close poles cancel: such poles are left
to the modes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs, ztbtrs

from relay_autotune.arrays import FloatArray

# Real for a real pole, complex for the upper one of a pair.
Numbers = NDArray[Any]

# Largest loss of accuracy by the differences of close poles: four digits.
_MOST_CANCELLATION = math.log(1e4)
# Longest time constant in horizons: a longer one cancels with the held input.
_LONGEST = 10.0
# Taylor coefficients of powers of s: binomial coefficients, and the power that is left.
_MOST = 24
_POWERS = np.maximum(np.subtract.outer(np.arange(_MOST), np.arange(_MOST)), 0)
_BINOMIALS = np.array([[float(math.comb(i, j)) for j in range(_MOST)] for i in range(_MOST)])
# Largest exponent of a growing mode.
_OVERFLOW = 300.0


@dataclass(frozen=True)
class Pole:
    """One pole of an output to a held input.

    :param value: p [rad/s]; of a conjugate pair the one with the positive imaginary part.
    :param multiplicity: how often it occurs.
    :param numerators: A of each output, shape (multiplicity, outputs).
    """

    value: complex
    multiplicity: int
    numerators: Numbers

    @property
    def number(self) -> Any:
        """The pole, real where it can be."""
        return self.value if self.value.imag else self.value.real

    def states(self, changes: FloatArray, steps: FloatArray, *, backward: bool) -> Numbers:
        """Return S_(p,j) just after each change, shape (multiplicity, m).

        :param changes: when the input steps [s], shape (m,).
        :param steps: by how much, shape (m,).
        :param backward: True: a growing pole is followed from zero after the last change.
        """
        p, terms = self.number, self.multiplicity
        if not (backward and self.value.real > 0.0):
            return _recursions(p, changes, steps, terms, 1.0)
        # Backward in time, each step is undone before the earlier one is reached.
        before = _recursions(-p, -changes[::-1], -steps[::-1], terms, -1.0)[:, ::-1]
        before[0] += steps
        return before


def partial_fractions(
    constants: Sequence[complex], integrators: int, numerators: FloatArray, horizon: float
) -> list[Pole] | None:
    """Return the poles of outputs to a unit step; None where some are too close to each other.

    :param constants: time constants T of ``prod(1 + T s)``, equal ones repeated, pairs complete
        [s].
    :param integrators: further poles at s = 0.
    :param numerators: of each output, coefficients of powers of s, lowest first, of lower degree
        than the poles and the step have together, shape (outputs, d).
    :param horizon: longest time that will be asked for [s].
    """
    count: dict[complex, int] = {}
    lead = 1.0 + 0.0j
    for constant in constants:
        count[-1.0 / constant] = count.get(-1.0 / constant, 0) + 1
        lead *= constant
    if any(abs(p) * horizon * _LONGEST < 1.0 for p in count):
        return None
    if any(_cancellation(p, count) > _MOST_CANCELLATION for p in count):
        return None
    count[0j] = 1 + integrators
    found = []
    for p, multiplicity in count.items():
        if p.imag < 0.0:
            continue
        others = [(q, times) for q, times in count.items() if q != p]
        series = _series_of_others(p, others, multiplicity)
        # Row k of the product of two Taylor series; the highest power of 1/(s - p) comes first.
        last = range(multiplicity - 1, -1, -1)
        product = [[series[k - i] if i <= k else 0j for k in last] for i in range(multiplicity)]
        rows: Numbers = (_taylor(numerators, p, multiplicity) @ (np.array(product) / lead)).T
        found.append(Pole(p, multiplicity, rows if p.imag else np.ascontiguousarray(rows.real)))
    return found


def _cancellation(p: complex, count: dict[complex, int]) -> float:
    """Return the logarithm of how much the terms of a pole are larger than their sum."""
    total, nearest = 0.0, 0.0
    for q, times in count.items():
        if q != p:
            closeness = math.log(min(abs(p), abs(q)) / abs(p - q))
            if closeness > 0.0:
                total += times * closeness
                nearest = max(nearest, closeness)
    return total + (count[p] - 1) * nearest


def _series_of_others(p: complex, others: list[tuple[complex, int]], terms: int) -> list[complex]:
    """Return the Taylor series of ``prod (s - q)^-times`` about p."""
    series = [1.0 + 0.0j] + [0j] * (terms - 1)
    for q, times in others:
        inverse = 1.0 / (p - q)
        for _ in range(times):
            # Division by (p - q) + x, lowest power first.
            carried = 0j
            for k in range(terms):
                carried = (series[k] - carried) * inverse
                series[k] = carried
    return series


def _taylor(numerators: FloatArray, p: complex, terms: int) -> Numbers:
    """Return the first Taylor coefficients of polynomials about p, shape (outputs, terms)."""
    degree = numerators.shape[1]
    return np.asarray(numerators @ (_BINOMIALS[:degree, :terms] * p ** _POWERS[:degree, :terms]))


def follow(
    poles: Sequence[Pole],
    states: Sequence[Numbers],
    time: FloatArray,
    segment: NDArray[np.int64],
    changes: FloatArray,
) -> FloatArray:
    """Return the outputs at some samples, shape (outputs, n).

    :param poles: from :func:`partial_fractions`.
    :param states: from :meth:`Pole.states`, one for each.
    :param time: sample times [s], shape (n,).
    :param segment: index of the last change before each sample, shape (n,).
    :param changes: when the input steps [s], shape (m,).
    """
    since = time - changes[segment]
    motions: list[FloatArray] = []
    shares: list[FloatArray] = []
    for pole, state in zip(poles, states, strict=True):
        exponent = pole.number * since
        if pole.value.real > 0.0:
            # A state that decayed from beyond this bound is zero: exp() must not overflow.
            exponent = np.minimum(exponent, _OVERFLOW)
        decay = np.exp(exponent) if pole.value != 0j else 1.0
        at_change = [row.take(segment) for row in state]
        powers = [np.ones(since.size)]
        for j, here in enumerate(at_change):
            moved = here
            for i, earlier in enumerate(reversed(at_change[:j]), start=1):
                if i == len(powers):
                    powers.append(powers[-1] * since / i)
                moved = moved + earlier * powers[i]
            moved = moved * decay
            numerators = pole.numerators[j]
            if pole.value.imag:
                # A conjugate pair gives twice the real part of one pole's output.
                motions += [moved.real, moved.imag]
                shares += [2.0 * numerators.real, -2.0 * numerators.imag]
            else:
                motions.append(moved)
                shares.append(numerators)
    return np.stack(shares, axis=1) @ np.stack(motions)


def _recursions(
    p: Any, instants: FloatArray, steps: FloatArray, terms: int, direction: float
) -> Numbers:
    """Return S_(p,j) at instants that follow one another in a direction of time."""
    gaps = instants[1:] - instants[:-1]
    decay = np.exp(p * gaps)
    state = np.zeros((terms, instants.size), dtype=decay.dtype)
    state[0] = recursion(decay, steps)
    weights = [decay]
    for j in range(1, terms):
        weights.append(weights[-1] * gaps * (direction / j))
        drive = np.zeros(instants.size, dtype=decay.dtype)
        for i in range(j):
            drive[1:] += weights[j - i] * state[i, :-1]
        state[j] = recursion(decay, drive)
    return state


def recursion(decay: Numbers, drive: FloatArray | Numbers) -> Numbers:
    """Return ``x_k = decay_(k-1) x_(k-1) + drive_k``, a triangular system of two bands.

    :param decay: of magnitude at most 1, shape (m - 1,).
    :param drive: shape (m,).
    """
    # Each column of the bands holds a diagonal element, and what the next x takes of this one.
    bands = np.ones((drive.size, 2), dtype=decay.dtype).T
    bands[1, :-1] = -decay
    solve = ztbtrs if np.iscomplexobj(decay) else dtbtrs
    found: Numbers = solve(bands, drive[:, None], uplo="L", diag="U")[0][:, 0]
    return found
