r"""Exact time response of a rational transfer function to constant inputs.

The process is a chain of first-order lags (complex constants for oscillating pairs), with the
held input as one more state in front, so that everything between two changes of the input is
the free motion of a linear system. The chain's matrix is lower bidiagonal with known
eigenvalues. Eigenvalues close to one another are kept together in a cluster; between clusters
the chain is decoupled by Sylvester equations, and within a cluster of centre c

    exp(A t) = exp(c t) sum_p (A - c I)^p t^p / p!,

a sum that ends for equal eigenvalues and converges quickly for close ones. So neither equal,
nearly equal nor widely spread time constants cost accuracy, and no step size enters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_sylvester

from relay_autotune.errors import ModelError
from relay_autotune.models import TransferFunction

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_CLOSE = 0.3
_EPSILON = 1e-17
_MOST_TERMS = 120
_UNDERFLOW = 745.0


@dataclass(frozen=True)
class _Cluster:
    """One group of eigenvalues: its centre, its place in the chain, its motion and its output.

    ``motion[p]`` is (A - c)^p / (p! scale^p) and ``output[p]`` the row C times that.
    """

    centre: complex
    scale: float
    place: slice
    motion: ComplexArray
    output: ComplexArray


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


class Modes:
    """A transfer function, without its dead time, in decoupled coordinates.

    The coordinates z describe state and held input together; they change by
    :attr:`input_direction` times the step where the input steps.

    :param model: the process.
    :param horizon: longest stretch of constant input that will be asked for [s].
    :raises ModelError: if the process passes its input on at once and has no poles.
    """

    def __init__(self, model: TransferFunction, horizon: float = math.inf) -> None:
        if model.integrators < 0:
            raise ModelError("the response of a process with a zero at s = 0 is not supported")
        poles = [-1.0 / t for t in model.time_constants] + [0j] * model.integrators
        groups = _group([0j, *poles], horizon)
        # The input comes first in the chain, then the poles of its own cluster.
        groups.sort(key=lambda g: 0j not in g)
        groups[0].sort(key=abs)
        chain = [e for group in groups for e in group]
        n = len(chain)
        factors = [(1.0, 0j) if e == 0j else (-1.0 / e, 1.0 + 0j) for e in chain[1:]]

        a = np.diag(np.array(chain, dtype=np.complex128))
        for i, e in enumerate(chain[1:], start=1):
            a[i, i - 1] = 1.0 if e == 0j else -e
        c = self._output_row(model, factors)

        self.size = n
        self._clusters: list[_Cluster] = []
        places, first = [], 0
        for group in groups:
            places.append(slice(first, first + len(group)))
            first += len(group)
        v = np.eye(n, dtype=np.complex128)
        for j, place in enumerate(places):
            for below in places[j + 1 :]:
                coupling = a[below, : below.start] @ v[: below.start, place]
                v[below, place] = solve_sylvester(a[below, below], -a[place, place], -coupling)
        for group, place in zip(groups, places, strict=True):
            centre = complex(sum(group) / len(group))
            if all(e == group[0] for e in group):
                centre = group[0]
            scale = abs(centre) or 1.0
            offset = a[place, place] - centre * np.eye(len(group))
            power = np.eye(len(group), dtype=np.complex128)
            motion = [power]
            for p in range(1, _terms(group, centre, horizon)):
                power = power @ offset / (p * scale)
                motion.append(power)
            stack = np.array(motion)
            row = c @ v[:, place]
            self._clusters.append(_Cluster(centre, scale, place, stack, row @ stack))
        inverse = np.linalg.solve(v, np.eye(n)[:, 0])
        self.input_direction: ComplexArray = np.ascontiguousarray(inverse)

    @staticmethod
    def _output_row(
        model: TransferFunction, factors: list[tuple[complex, complex]]
    ) -> ComplexArray:
        """Weights of the chain's states that make the numerator.

        State i is the input over the product of the first i factors, so dividing the numerator
        by the last factor leaves that state's weight as remainder, and so on down the chain.
        """
        numerator = np.ones(1, dtype=np.complex128) * model.gain
        for z in model.zeros:
            numerator = np.convolve(numerator, np.array([z, 1.0]))
        row = np.zeros(len(factors) + 1, dtype=np.complex128)
        for i in range(len(factors), 0, -1):
            quotient, remainder = np.polydiv(numerator, np.array(factors[i - 1]))
            row[i] = remainder[-1]
            shorter = quotient if numerator.size > 1 else np.zeros(1)
            numerator = np.atleast_1d(shorter).astype(np.complex128)
        row[0] = numerator[-1]
        return row

    def rest(self) -> ComplexArray:
        """Coordinates of the process at rest with zero input."""
        return np.zeros(self.size, dtype=np.complex128)

    def move(self, z: ComplexArray, time: float) -> ComplexArray:
        """Return the coordinates ``time`` [s] later, with the input held.

        :param z: coordinates, shape (size,).
        """
        moved = np.empty_like(z)
        for cluster in self._clusters:
            x = time * cluster.scale
            terms = cluster.motion.shape[0]
            part = z[cluster.place]
            if x > _UNDERFLOW and cluster.centre.real * time < -_UNDERFLOW:
                moved[cluster.place] = 0.0
                continue
            total = cluster.motion[terms - 1] @ part
            for p in range(terms - 2, -1, -1):
                total = total * x + cluster.motion[p] @ part
            moved[cluster.place] = total * np.exp(cluster.centre * time)
        return moved

    def weights(self, z: ComplexArray) -> list[ComplexArray]:
        """Return, for each cluster, the coefficients of the output's polynomial.

        :param z: coordinates, shape (..., size).
        """
        return [z[..., c.place] @ c.output.T for c in self._clusters]

    def output(self, weights: list[ComplexArray], time: FloatArray) -> FloatArray:
        """Return the output ``time`` after the coordinates that gave ``weights``.

        :param weights: from :meth:`weights`, each of shape (terms,) or (n, terms).
        :param time: s, shape (n,).
        """
        y = np.zeros(time.shape)
        for cluster, w in zip(self._clusters, weights, strict=True):
            x = time * cluster.scale
            if cluster.centre.real < 0.0:
                # Beyond this the exponential is zero; a large power must not make it nan.
                x = np.minimum(x, _UNDERFLOW * cluster.scale / -cluster.centre.real)
            total = w[..., -1]
            for p in range(w.shape[-1] - 2, -1, -1):
                total = total * x + w[..., p]
            if cluster.centre == 0j:
                y += np.broadcast_to(total.real, time.shape)
            else:
                y += (total * np.exp(cluster.centre * time)).real
        return y

    def slope_weights(self, weights: list[ComplexArray]) -> list[ComplexArray]:
        """Return the weights of the output's time derivative.

        :param weights: from :meth:`weights`.
        """
        slopes = []
        for cluster, w in zip(self._clusters, weights, strict=True):
            derivative = cluster.centre * w
            powers = np.arange(1, w.shape[-1]) * cluster.scale
            derivative[..., :-1] += w[..., 1:] * powers
            slopes.append(derivative)
        return slopes
