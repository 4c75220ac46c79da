# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exact motion of a process under a held input, and its exact transfer function in z.

The process is a chain of first-order lags (complex constants for oscillating pairs), with the
held input as one more state in front, so that everything between two changes of the input is
the free motion of a linear system. The chain's matrix is lower bidiagonal with known
eigenvalues. Eigenvalues close to one another are kept together in a cluster; between clusters
the chain is decoupled by Sylvester equations, and within a cluster of centre c

    exp(A t) = exp(c t) sum_p (A - c I)^p t^p / p!,

a sum that ends for equal eigenvalues and converges quickly for close ones. So neither equal,
nearly equal nor widely spread time constants cost accuracy, and no step size enters.

A command is given at each sample and held until the next one. With the step response s, a dead
time D and the period h,

    G(z) = (1 - z^-1) sum_{m >= 1, m h >= D} s(m h - D) z^-m,

where the sum has a closed form, since s is the free motion of a linear system.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant

# Real if every time constant is real, which is four times as fast; else complex.
Coordinates = NDArray[Any]

_CLOSE = 0.3
_EPSILON = 1e-17
_MOST_TERMS = 120
_UNDERFLOW = 745.0
_OVERFLOW = 300.0
_ONE = np.ones(1)


@dataclass(frozen=True)
class _Cluster:
    """One group of eigenvalues: centre, place in the chain, motion and output.

    ``motion[p]`` is (A - c)^p / (p! scale^p) and ``output[p]`` the rows C times that.
    """

    centre: complex
    scale: float
    place: slice
    motion: Coordinates
    output: Coordinates


def _group(eigenvalues: list[complex], horizon: float) -> list[list[complex]]:
    groups: list[list[complex]] = []
    for value in sorted(eigenvalues, key=lambda e: (abs(e), e.real, e.imag)):
        for group in groups:
            centre = sum(group) / len(group)
            near = _CLOSE * min(abs(value.real), abs(centre.real))
            if abs(value - centre) <= max(near, 2.0 / horizon):
                group.append(value)
                break
        else:
            groups.append([value])
    return groups


def _terms(group: list[complex], centre: complex, horizon: float) -> int:
    """Return the number of terms after which the cluster's sum is exact to rounding."""
    size = len(group)
    radius = max(abs(e - centre) for e in group)
    if radius == 0.0:
        return size
    decay = radius / abs(centre.real) if centre.real < 0.0 else math.inf
    reach = min(radius * horizon, 64.0)
    for extra in range(1, _MOST_TERMS - size):
        by_decay = decay**extra if decay < 1.0 else math.inf
        by_reach = math.exp(extra * math.log(reach) - math.lgamma(extra + 1)) if reach else 0.0
        if min(by_decay, by_reach) < _EPSILON:
            return size + extra
    return _MOST_TERMS


def _divide(rows: Coordinates, top: complex, constant: complex) -> tuple[Coordinates, Coordinates]:
    """Divide polynomials, lowest power first in shape (p, n), by ``top s + constant``.

    :return: quotients, shape (p, n - 1), and remainders, shape (p,).
    """
    quotient = np.zeros_like(rows[:, 1:])
    carried = np.zeros_like(rows[:, 0])
    for power in range(rows.shape[1] - 1, 0, -1):
        carried = (rows[:, power] - constant * carried) / top
        quotient[:, power - 1] = carried
    return quotient, rows[:, 0] - constant * carried


def _sylvester(a: Coordinates, b: Coordinates, right: Coordinates) -> Coordinates:
    """Solve ``a x - x b = right`` for small blocks."""
    rows, columns = right.shape
    # The same operator as with np.kron, but many times as fast.
    operator = np.zeros((rows, columns, rows, columns), dtype=right.dtype)
    for k in range(columns):
        operator[:, k, :, k] = a
    for k in range(rows):
        operator[k, :, k, :] -= b.T
    size = rows * columns
    solved = np.linalg.solve(operator.reshape(size, size), right.ravel())
    return np.asarray(solved.reshape(rows, columns))


class Modes:
    """Transfer functions of one denominator, without dead time, in decoupled coordinates.

    The coordinates z describe state and held input together; they change by
    :attr:`input_direction` times the step where the input steps.

    :param constants: time constants T of the poles, ``prod(1 + T s)`` [s].
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
        groups = _group([0j, *(-1.0 / t for t in constants), *[0j] * integrators], horizon)
        # The input comes first in the chain, then the poles of its own cluster.
        groups.sort(key=lambda g: 0j not in g)
        groups[0].sort(key=abs)
        chain = [e for group in groups for e in group]
        self._dtype: Any = np.float64 if all(e.imag == 0.0 for e in chain) else np.complex128
        values = self._cast(np.array(chain))
        couplings = np.where(values == 0.0, 1.0, -values)[1:]
        a = np.diag(values) + np.diag(couplings, -1)
        c = self._output_rows(values[1:], self._cast(np.asarray(numerators)))

        self.size = len(chain)
        places, first = [], 0
        for group in groups:
            places.append(slice(first, first + len(group)))
            first += len(group)
        v = np.eye(self.size, dtype=self._dtype)
        for j, place in enumerate(places):
            for below in places[j + 1 :]:
                coupling = a[below, : below.start] @ v[: below.start, place]
                v[below, place] = _sylvester(a[below, below], a[place, place], -coupling)
        self._clusters: list[_Cluster] = []
        for group, place in zip(groups, places, strict=True):
            centre = group[0] if all(e == group[0] for e in group) else sum(group) / len(group)
            scale = abs(centre) or 1.0
            offset = a[place, place] - self._cast(np.asarray(centre)) * np.eye(len(group))
            power = np.eye(len(group), dtype=self._dtype)
            motion = [power]
            for p in range(1, _terms(group, centre, horizon)):
                power = power @ offset / (p * scale)
                motion.append(power)
            stack = np.array(motion)
            rows = c @ v[:, place]
            self._clusters.append(_Cluster(complex(centre), scale, place, stack, rows @ stack))
        self.input_direction = np.linalg.solve(v, np.eye(self.size)[:, 0])

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

    def _cast(self, array: Coordinates) -> Coordinates:
        return np.ascontiguousarray(array.real if self._dtype is np.float64 else array)

    def _output_rows(self, eigenvalues: Coordinates, numerators: Coordinates) -> Coordinates:
        """Return the weights of the chain's states for each numerator.

        State i is the input over the product of the first i factors, so dividing the numerator
        by the last factor leaves that state's weight as remainder, and so on down the chain.
        """
        row = np.zeros((numerators.shape[0], eigenvalues.size + 1), dtype=self._dtype)
        rest = numerators.astype(self._dtype)
        for i in range(eigenvalues.size, 0, -1):
            e = eigenvalues[i - 1]
            top, constant = (1.0, 0.0) if e == 0.0 else (-1.0 / e, 1.0)
            rest, row[:, i] = _divide(rest, top, constant)
            if rest.shape[1] == 0:
                return row
        if rest.shape[1] > 1 and bool(np.any(rest[:, 1:])):
            raise ModelError("a process has at least as many poles as zeros")
        row[:, 0] = rest[:, 0]
        return row

    def rest(self) -> Coordinates:
        """Return the coordinates of the process at rest with zero input."""
        return np.zeros(self.size, dtype=self._dtype)

    @property
    def growing(self) -> NDArray[np.bool_]:
        """Which coordinates belong to poles in the right half plane, shape (size,)."""
        found = np.zeros(self.size, dtype=bool)
        for cluster in self._clusters:
            found[cluster.place] = cluster.centre.real > 0.0
        return found

    def propagators(self, times: FloatArray) -> Coordinates:
        """Return the matrices that move the coordinates on by each time.

        :param times: s, of either sign, shape (m,).
        :return: block diagonal, shape (m, size, size).
        """
        moved = np.zeros((times.size, self.size, self.size), dtype=self._dtype)
        for cluster in self._clusters:
            factors, x = self._factors(cluster, times)
            total = np.broadcast_to(cluster.motion[-1], (times.size, *cluster.motion[-1].shape))
            for matrix in cluster.motion[-2::-1]:
                total = total * x[:, None, None] + matrix
            moved[:, cluster.place, cluster.place] = total * factors[:, None, None]
        return moved

    def _factors(self, cluster: _Cluster, times: FloatArray) -> tuple[Coordinates, FloatArray]:
        """Return exp(centre t), and t in units of the cluster."""
        x = times * cluster.scale
        if cluster.centre == 0j:
            return _ONE, x
        centre = cluster.centre / cluster.scale
        if centre.real != 0.0:
            # Limit t: beyond these times the exponential is practically zero or infinite, and the
            # product with a large power would be nan.
            low, high = sorted((-_UNDERFLOW / centre.real, _OVERFLOW / centre.real))
            x = np.minimum(np.maximum(x, low), high)
        return np.exp((centre.real if self._dtype is np.float64 else centre) * x), x

    def move(self, z: Coordinates, time: float) -> Coordinates:
        """Return the coordinates ``time`` [s] later, with the input held.

        :param z: coordinates, shape (size,).
        """
        return np.asarray(self.propagators(np.array([time]))[0] @ z)

    def step_transform(
        self, z: NDArray[np.complexfloating[Any, Any]], first: float, period: float
    ) -> NDArray[np.complexfloating[Any, Any]]:
        """Return the z-transform of the first output after a unit step of the input.

        ``sum_n s(first + n period) z^-n``, s being the step response.

        :param z: outside the unit circle or on it, no pole of the sum, shape (n,).
        :param first: time of the first sample after the step [s].
        :param period: of the samples [s].
        """
        begin, move = self.propagators(np.array([first, period]))
        row = np.concatenate([cluster.output[0, 0] for cluster in self._clusters])
        matrices = np.eye(self.size) - move / z[:, None, None]
        start = np.broadcast_to(begin @ self.input_direction, (z.size, self.size))
        # A product of matrices would wake the threads of BLAS.
        moved = np.linalg.solve(matrices, start[..., None])[..., 0]
        return np.asarray(np.einsum("ns,s->n", moved, row))

    def weights(self, z: Coordinates) -> list[Coordinates]:
        """Return, for each cluster, the coefficients of the outputs' polynomials.

        :param z: coordinates, shape (..., size).
        :return: shapes (..., terms, p).
        """
        return [
            np.einsum("tps,...s->...tp", cluster.output, z[..., cluster.place])
            for cluster in self._clusters
        ]

    def outputs(self, weights: list[Coordinates], time: FloatArray) -> FloatArray:
        """Return the outputs ``time`` after the coordinates that gave ``weights``.

        :param weights: from :meth:`weights`, each of shape (terms, p) or (n, terms, p).
        :param time: s, shape (n,).
        :return: shape (n, p).
        """
        y = np.zeros((time.size, weights[0].shape[-1]))
        for cluster, w in zip(self._clusters, weights, strict=True):
            factors, x = self._factors(cluster, time)
            total = w[..., -1, :]
            for p in range(w.shape[-2] - 2, -1, -1):
                total = total * x[:, None] + w[..., p, :]
            y += (total * factors[:, None]).real
        return y

    def slope_weights(self, weights: list[Coordinates]) -> list[Coordinates]:
        """Return the weights of the outputs' time derivatives.

        :param weights: from :meth:`weights`.
        """
        slopes = []
        for cluster, w in zip(self._clusters, weights, strict=True):
            derivative = self._cast(np.asarray(cluster.centre)) * w
            powers = np.arange(1, w.shape[-2]) * cluster.scale
            derivative[..., :-1, :] += w[..., 1:, :] * powers[:, None]
            slopes.append(derivative)
        return slopes


def response(model: TransferFunction, time: ArrayLike, u: PiecewiseConstant) -> FloatArray:
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
    changes = u.times + model.dead_time
    if changes.size == 0 or flat.size == 0:
        return np.zeros(t.shape)
    end = max(float(flat.max()), float(changes[-1]))
    modes = Modes.of(model, horizon=max(end - float(changes[0]), np.finfo(float).tiny))
    steps = np.diff(u.values, prepend=u.initial)
    z = coordinates_at_changes(modes, changes, steps)
    segment = np.searchsorted(changes, flat, side="right") - 1
    after = segment >= 0
    y = np.zeros(flat.shape)
    index = segment[after]
    weights = [w[index] for w in modes.weights(z)]
    y[after] = modes.outputs(weights, flat[after] - changes[index])[:, 0]
    return y.reshape(t.shape)


def coordinates_at_changes(
    modes: Modes, changes: FloatArray, steps: FloatArray, *, backward: bool = False
) -> Coordinates:
    """Return the coordinates just after each change of the input, from rest before the first.

    :param modes: the process.
    :param changes: instants of the changes of the delayed input [s], shape (m,).
    :param steps: height of each change, shape (m,).
    :param backward: True: the growing modes are followed backward, from zero just after the last
        change, so that they stay bounded; their true motion differs by a multiple of their own
        free motion.
    :return: shape (m, modes.size).
    """
    forward = modes.propagators(np.diff(changes))
    growing = modes.growing
    backward = backward and bool(np.any(growing))
    if backward:
        # The growing modes are followed backward below.
        forward[:, growing, :] = 0.0
    kicks = steps[:, None] * modes.input_direction
    z = np.empty((changes.size, modes.size), dtype=np.result_type(forward, kicks))
    z[0] = kicks[0]
    for k in range(1, changes.size):
        z[k] = forward[k - 1] @ z[k - 1] + kicks[k]
    if backward:
        back = modes.propagators(-np.diff(changes))
        z[-1, growing] = 0.0
        for k in range(changes.size - 1, 0, -1):
            z[k - 1, growing] = (back[k - 1] @ (z[k] - kicks[k]))[growing]
    return z


# A dead time of a whole number of periods is recognised in spite of this relative rounding.
_ROUNDING = 1e-9


class HeldProcess:
    """A process whose input is held between samples, as a function of z.

    :param model: the process, with the dead time of the loop, but none for the hold.
    :param period: of the samples [s].
    :param delay: further samples until a command takes effect.
    """

    def __init__(self, model: TransferFunction, period: float, delay: int = 0) -> None:
        self.model = model
        self.period = period
        wait = max(math.ceil(model.dead_time / period * (1.0 - _ROUNDING)), 1)
        self._first = max(wait * period - model.dead_time, 0.0)
        self._wait = wait + delay
        self._modes = Modes.of(model)

    def __call__(self, z: ComplexArray) -> ComplexArray:
        """Return y/u at each z, shape (n,).

        :param z: on the unit circle or outside, no pole of the process, not 1 if it integrates.
        """
        moved = self._modes.step_transform(z, self._first, self.period)
        return np.asarray((1.0 - 1.0 / z) * z ** float(-self._wait) * moved)

    @property
    def unstable_poles(self) -> int:
        """Number of its poles outside the unit circle."""
        return sum(1 for t in self.model.time_constants if t.real < 0.0)
