# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exact motion of a process under a held input, and its exact transfer function in z.

With the step of a held input as one more pole at s = 0, an output is Y(s) = N(s)/prod (s - p).
Poles that are close to one another are kept together in a cluster e_1, ..., e_n; F is N over the
product of all other poles. By Leibniz' rule for divided differences the cluster's share is

    y(t) = sum_k F[e_1, ..., e_k] x_k(t),   x_k(t) = exp(. t)[e_k, ..., e_n],

the partial fractions of equal poles being the case of equal e. The states x_k form a chain,
x_k' = e_k x_k + x_(k+1), which each step of the input kicks at its end, so that everything between
two changes of the input is the free motion of a small triangular matrix A. With the centre c,

    exp(A t) = exp(c t) sum_p (A - c I)^p t^p / p!,

a sum that ends for equal poles and converges quickly for close ones. So neither equal, nearly
equal nor widely spread time constants cost accuracy, and no step size enters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dtbtrs, ztbtrs

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Input, PiecewiseConstant

# Real where poles are real, complex for the upper one of a pair.
Coordinates = NDArray[Any]

# Largest distance of the poles of a cluster over their size: beyond, partial fractions lose at
# most four digits, for up to three poles of each.
_CLOSE = 0.2
_EPSILON = 1e-17
_MOST_TERMS = 120
_UNDERFLOW = 745.0
_OVERFLOW = 300.0


@dataclass(frozen=True)
class _Cluster:
    """Poles close to one another, and what the outputs take of their states.

    :param nodes: the poles, real ones as real numbers.
    :param centre: their mean.
    :param share: 2 for the upper poles of conjugate pairs, of which the outputs take twice the
        real part; else 1.
    :param terms: ``(A - c)^p / (p! scale^p)``, shape (terms, n, n); None: the poles are equal.
    :param scale: unit of the terms [1/s].
    :param rows: of the outputs, shape (outputs, n).
    """

    nodes: tuple[Any, ...]
    centre: Any
    share: float
    terms: Coordinates | None
    scale: float
    rows: Coordinates

    @property
    def growing(self) -> bool:
        """True if they lie in the right half plane."""
        return bool(self.centre.real > 0.0)

    @property
    def shares(self) -> FloatArray:
        """What the outputs take of each state, of a complex one of both parts, (outputs, ...)."""
        if self.rows.dtype.kind != "c":
            return self.rows
        # Re(r x) = Re r Re x - Im r Im x
        return (self.share * self.rows.conj()).view(np.float64)

    def motions(self, times: FloatArray) -> list[list[Coordinates]]:
        """Return exp(A t): what state k, then m, has of the state m before.

        :param times: s, of either sign, shape (n,).
        :return: for each k and m >= k an array of shape (n,); what lies before m = k is not used.
        """
        size, centre = len(self.nodes), self.centre
        rate = centre.real
        if rate and (self.terms is not None or rate > 0.0):
            # Beyond these times the exponential is practically zero or infinite, and its product
            # with a large power would be nan.
            times = np.clip(times, *sorted((-_UNDERFLOW / rate, _OVERFLOW / rate)))
        decay = np.exp(centre * times) if centre != 0.0 else np.ones(times.size)
        if self.terms is None:
            powers = [decay]
            for j in range(1, size):
                powers.append(powers[-1] * times / j)
            return [[powers[m - k] for m in range(size)] for k in range(size)]
        x = (times * self.scale) ** np.arange(self.terms.shape[0])[:, None]
        flat = self.terms.reshape(self.terms.shape[0], -1)
        return list((flat.T @ x * decay).reshape(size, size, -1))

    def states(self, gaps: FloatArray, steps: FloatArray, *, backward: bool) -> Coordinates:
        """Return the states just after each change of the inputs, shape (n, ..., m)."""
        if not (backward and self.growing):
            return self._followed(gaps, steps)
        # Backward in time, each step is undone before the earlier one is reached.
        before = self._followed(-gaps[::-1], -steps[..., ::-1])[..., ::-1]
        before[-1] += steps
        return before

    def _followed(self, gaps: FloatArray, kicks: FloatArray) -> Coordinates:
        moved = self.motions(gaps)
        last = len(self.nodes) - 1
        # The drives first, then what follows from them.
        states = np.zeros((last + 1, *kicks.shape), dtype=self.rows.dtype)
        states[last] = kicks
        for k in range(last, -1, -1):
            for m in range(k + 1, last + 1):
                states[k, ..., 1:] += moved[k][m] * states[m, ..., :-1]
            states[k] = recursion(moved[k][k], states[k])
        return states

    def matrix(self, time: float) -> Coordinates:
        """Return exp(A t) for one time."""
        moved = self.motions(np.array([time]))
        return np.triu([[entry[0] for entry in row] for row in moved])


def recursion(decay: Coordinates, drive: Coordinates) -> Coordinates:
    """Return ``x_k = decay_(k-1) x_(k-1) + drive_k``, a triangular system of two bands.

    :param decay: of magnitude at most 1, shape (m - 1,).
    :param drive: shape (..., m), of several such systems.
    """
    # Each column of the bands holds a diagonal element, which is one and is not read, and what the
    # next x takes of this one.
    bands = np.empty((drive.shape[-1], 2), dtype=decay.dtype).T
    bands[1, :-1] = -decay
    solve = ztbtrs if decay.dtype.kind == "c" else dtbtrs
    found: Coordinates = solve(bands, drive.reshape(-1, drive.shape[-1]).T, uplo="L", diag="U")[0]
    return found.T.reshape(drive.shape)


def _groups(poles: list[complex], horizon: float) -> list[list[complex]]:
    """Return poles of the upper half plane in groups; with a real one near, also their mirrors."""
    groups: list[list[complex]] = []
    for value in sorted(poles, key=lambda e: (abs(e), e.real, e.imag)):
        if value.imag < 0.0:
            continue
        for group in groups:
            centre = sum(group) / len(group)
            near = _CLOSE * min(abs(value.real), abs(centre.real))
            if abs(value - centre) <= max(near, 2.0 / horizon):
                group.append(value)
                break
        else:
            groups.append([value])
    for group in groups:
        pairs = [e for e in group if e.imag]
        flat = (2.0 * e.imag <= max(_CLOSE * abs(e.real), 2.0 / horizon) for e in pairs)
        if pairs and (len(pairs) < len(group) or any(flat)):
            group += [e.conjugate() for e in pairs]
    return groups


def _term_count(nodes: Sequence[complex], centre: complex, horizon: float) -> int:
    """Return the number of terms after which the cluster's sum is exact to rounding."""
    size = len(nodes)
    radius = max(abs(e - centre) for e in nodes)
    decay = radius / abs(centre.real) if centre.real < 0.0 else math.inf
    reach = min(radius * horizon, 64.0)
    for extra in range(1, _MOST_TERMS - size):
        by_decay = decay**extra if decay < 1.0 else math.inf
        by_reach = math.exp(extra * math.log(reach) - math.lgamma(extra + 1)) if reach else 0.0
        if min(by_decay, by_reach) < _EPSILON:
            return size + extra
    return _MOST_TERMS


def _terms(nodes: Sequence[complex], centre: complex, scale: float, count: int) -> Coordinates:
    offset = (np.diag(nodes) - centre * np.eye(len(nodes)) + np.eye(len(nodes), k=1)) / scale
    powers = [np.eye(len(nodes), dtype=offset.dtype)]
    for p in range(1, count):
        powers.append(powers[-1] @ offset / p)
    return np.array(powers)


def _of_inverse(nodes: Sequence[complex], others: Sequence[complex]) -> list[complex]:
    """Return the divided differences ``(1/prod (s - q))[e_1, ..., e_k]``."""
    found = [1.0 + 0j] + [0j] * (len(nodes) - 1)
    for q in others:
        carried = 0j
        for k, e in enumerate(nodes):
            carried = (found[k] - carried) / (e - q)
            found[k] = carried
    return found


def _of_ratios(
    nodes: Sequence[complex], others: Sequence[complex], degree: int
) -> list[list[complex]]:
    """Return ``(s^i/prod (s - q))[e_1, ..., e_k]`` for i < degree, one row for each."""
    row = _of_inverse(nodes, others)
    rows = [row]
    for _ in range(1, degree):
        row = [e * a + b for e, a, b in zip(nodes, row, [0j, *row[:-1]], strict=True)]
        rows.append(row)
    return rows


class Modes:
    """Transfer functions of one denominator, without dead time, by the states of its poles.

    The states describe process and held input together. They belong to clusters, each with an
    array of its own: shape (n,), or (n, ..., m) of many at once.

    :param constants: time constants T of the poles, ``prod(1 + T s)``, pairs complete [s].
    :param integrators: further poles at s = 0.
    :param numerators: of each output, coefficients of powers of s, lowest first, shape (p, d).
    :param horizon: longest time of constant input that will be evaluated [s].
    :raises ModelError: if a numerator is of higher degree than the denominator.
    """

    def __init__(
        self,
        constants: Sequence[complex],
        integrators: int,
        numerators: Coordinates,
        horizon: float = math.inf,
    ) -> None:
        poles = [0j, *[-1.0 / complex(t) for t in constants], *[0j] * integrators]
        if numerators.shape[1] > len(poles) and bool(np.any(numerators[:, len(poles) :])):
            raise ModelError("a process has at least as many poles as zeros")
        lead = math.prod((complex(t) for t in constants), start=1.0 + 0j)
        groups = _groups(poles, horizon)
        upper = [_is_upper(group) for group in groups]
        every: list[complex] = []
        for group, paired in zip(groups, upper, strict=True):
            every += [e for pole in group for e in (pole, pole.conjugate())] if paired else group
        ratios = []
        for group in groups:
            others = list(every)
            for e in group:
                others.remove(e)
            ratios.append(_of_ratios(group, others, numerators.shape[1]))
        every_row = numerators @ (np.concatenate(ratios, axis=1) / lead)
        self._clusters: list[_Cluster] = []
        first = 0
        for group, paired in zip(groups, upper, strict=True):
            nodes: tuple[Any, ...] = tuple(group)
            rows: Coordinates = every_row[:, first : first + len(group)]
            first += len(group)
            terms, scale = None, 1.0
            if not any(e.imag for e in group):
                nodes, rows = tuple(e.real for e in group), rows.real
            centre = nodes[0]
            if group.count(group[0]) < len(group):
                centre = sum(nodes) / len(nodes)
                scale = max(abs(centre), *(abs(e - centre) for e in nodes))
                terms = _terms(nodes, centre, scale, _term_count(nodes, centre, horizon))
            share = 2.0 if paired else 1.0
            self._clusters.append(_Cluster(nodes, centre, share, terms, scale, rows))
        self._shares = np.concatenate([c.shares for c in self._clusters], axis=1)

    @classmethod
    def of(cls, model: TransferFunction, horizon: float = math.inf) -> Modes:
        """Return the modes of one transfer function.

        :param model: the process.
        :param horizon: longest time of constant input that will be evaluated [s].
        :raises ModelError: if it has a zero at s = 0.
        """
        if model.integrators < 0:
            raise ModelError("the response of a process with a zero at s = 0 is not supported")
        numerator = np.array(model.numerator[::-1])[None, :]
        return cls(model.time_constants, model.integrators, numerator, horizon)

    @property
    def rates(self) -> Modes:
        """The same states with the rates of the outputs as outputs."""
        found = copy(self)
        found._clusters = [
            replace(c, rows=c.rows @ (np.diag(c.nodes) + np.eye(len(c.nodes), k=1)))
            for c in self._clusters
        ]
        found._shares = np.concatenate([c.shares for c in found._clusters], axis=1)
        return found

    def rest(self) -> list[Coordinates]:
        """Return the states of the process at rest with zero input."""
        return [np.zeros(len(c.nodes), dtype=c.rows.dtype) for c in self._clusters]

    def stepped(self, states: Sequence[Coordinates], step: float) -> list[Coordinates]:
        """Return the states just after a step of the input.

        :param states: just before it.
        :param step: its height [u].
        """
        return [np.append(own[:-1], own[-1] + step) for own in states]

    def moved(self, states: Sequence[Coordinates], time: float) -> list[Coordinates]:
        """Return the states some time later, with the input held.

        :param states: now.
        :param time: s, of either sign.
        """
        parts = zip(self._clusters, states, strict=True)
        return [np.asarray(cluster.matrix(time) @ own) for cluster, own in parts]

    def mirrored(self, states: Sequence[Coordinates], time: float) -> list[Coordinates]:
        """Return the states that are, with what becomes of them in a time, the given ones.

        :param states: their sum.
        :param time: s.
        """
        parts = zip(self._clusters, states, strict=True)
        return [np.linalg.solve(c.matrix(time) + np.eye(own.size), own) for c, own in parts]

    def size_of(self, states: Sequence[Coordinates]) -> float:
        """Return the sum of the magnitudes of which the first output is the sum."""
        parts = zip(self._clusters, states, strict=True)
        return sum(c.share * float(np.abs(c.rows[0]) @ np.abs(own)) for c, own in parts)

    def states(
        self, changes: FloatArray, steps: FloatArray, *, backward: bool = False
    ) -> list[Coordinates]:
        """Return the states just after each change of the inputs, from rest before the first.

        :param changes: instants of the changes of the delayed inputs [s], shape (m,).
        :param steps: height of each change, of one or several inputs, shape (..., m).
        :param backward: True: growing states are followed backward, from zero just after the last
            change, so that they stay bounded; their true motion differs by a multiple of their
            own free motion.
        :return: of each cluster, shapes (n, ..., m).
        """
        gaps = np.diff(changes)
        return [c.states(gaps, steps, backward=backward) for c in self._clusters]

    def outputs(
        self,
        states: Sequence[Coordinates],
        time: FloatArray,
        segment: NDArray[np.int64] | None = None,
    ) -> FloatArray:
        """Return the outputs some time after given states.

        :param states: of each cluster, shapes (n, ..., m), or (n,) of one only.
        :param time: since these states [s], shape (k,).
        :param segment: which of the states, shape (k,); None: there is one only.
        :return: shape (p, ..., k).
        """
        motions: list[FloatArray] = []
        for cluster, own in zip(self._clusters, states, strict=True):
            moved = cluster.motions(time)
            at = own if segment is None else own.take(segment, axis=-1)
            for k in range(len(at)):
                now = moved[k][k] * at[k]
                for m in range(k + 1, len(at)):
                    now = now + moved[k][m] * at[m]
                motions += [now.real, now.imag] if now.dtype.kind == "c" else [now]
        found = self._shares @ np.concatenate(motions).reshape(len(motions), -1)
        return found.reshape(found.shape[0], *motions[0].shape)


def _is_upper(group: list[complex]) -> bool:
    """Return whether a group holds one of each conjugate pair."""
    return all(e.imag > 0.0 for e in group)


def response(model: TransferFunction, time: ArrayLike, u: Input) -> FloatArray:
    """Return the output's deviation from rest, exact for any real dead time.

    The process rests at ``u.initial`` before the first change of the input (an integrating
    process: in balance). Nothing is discretised: between the delayed changes the response is
    evaluated in closed form at the given times.

    :param model: the process.
    :param time: times of the output [s], any shape and order.
    :param u: the input.
    :return: deviation of y, shape of ``time``.
    """
    t = np.asarray(time, dtype=np.float64)
    flat = t.ravel()
    if not isinstance(u, PiecewiseConstant):
        # A ramp is a step that is integrated once more.
        model = replace(model, integrators=model.integrators + 1)
    changes = u.times + model.dead_time
    if changes.size == 0 or flat.size == 0:
        return np.zeros(t.shape)
    end = max(float(flat.max()), float(changes[-1]))
    modes = Modes.of(model, horizon=max(end - float(changes[0]), np.finfo(float).tiny))
    states = modes.states(changes, u.steps)
    segment = np.searchsorted(changes, flat, side="right") - 1
    after = segment >= 0
    y = np.zeros(flat.shape)
    index = segment[after]
    y[after] = modes.outputs(states, flat[after] - changes[index], index)[0]
    return y.reshape(t.shape)
