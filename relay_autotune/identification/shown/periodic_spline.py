# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Least squares with periodic cubic splines that may have a kink."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor
from scipy.linalg.lapack import dpotrs
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array

from relay_autotune.arrays import FloatArray

_RIDGE = 1e-13
_TOLERANCE = 1e-7
# Ridge where places are compared: functions that differ by less than its root count as one.
_ALIKE = 1e-10


@dataclass(frozen=True)
class Kinks:
    """The functions of a kink at some places, which are the same however many knots there are.

    :param places: phases, shape (m,).
    :param columns: square roots of the weights times the functions, shape (n, m, kinks).
    :param gram: products of those of one place, shape (m, kinks, kinks).
    """

    places: FloatArray
    columns: FloatArray
    gram: FloatArray

    @classmethod
    def at(cls, basis: Basis, places: FloatArray, x: FloatArray, weight: FloatArray) -> Kinks:
        """Return the functions at some places.

        :param basis: the functions.
        :param places: phases, shape (m,).
        :param x: phases of the points, shape (n,).
        :param weight: number of samples that each point stands for, shape (n,).
        """
        columns = np.stack([basis.edges(x, p, 0) for p in places], axis=1)
        columns = columns * np.sqrt(weight)[:, None, None]
        by_place = columns.transpose(1, 2, 0)
        return cls(places, columns, by_place @ by_place.transpose(0, 2, 1))


class Spline:
    """A fit to points, without a kink or with one anywhere.

    The kink's few functions are projected off those of the spline, so that each place costs
    little more than they do.

    :param basis: the functions.
    :param knots: number of the spline's knots.
    :param x: phases, shape (n,).
    :param y: shape (n,).
    :param weight: number of samples that each point stands for, shape (n,).
    """

    def __init__(
        self, basis: Basis, knots: int, x: FloatArray, y: FloatArray, weight: FloatArray
    ) -> None:
        self._basis, self._knots, self._x = basis, knots, x
        self._root = np.sqrt(weight)[:, None]
        columns = basis.spline(x, knots, 0)
        if basis.mirrored:
            columns = np.column_stack((columns, np.ones(x.size)))
        # Only four or five of the functions are not zero at a point.
        self._columns = csr_array(columns * self._root)
        self._transposed = csr_array(self._columns.T)
        gram = (self._transposed @ self._columns).toarray()
        # Knots without samples leave functions without data.
        gram[np.diag_indices_from(gram)] += _RIDGE * float(np.trace(gram))
        self._factor = cho_factor(gram)
        target = self._root[:, 0] * y
        self._smooth = self._along(target)
        self._left = target - self._columns @ self._smooth

    def _along(self, columns: FloatArray) -> FloatArray:
        # cho_solve would take longer to check the right side than to solve.
        found, _ = dpotrs(self._factor[0], self._transposed @ columns, self._factor[1])
        return np.asarray(found)

    def fitted(self, edge: float) -> tuple[FloatArray, float]:
        """Return the coefficients and the sum of squared residuals.

        :param edge: phase of the kink; NaN: none.
        :return: coefficients of the spline, of the kink's functions, and the offset.
        """
        if math.isnan(edge):
            return self._smooth, float(self._left @ self._left)
        cost, part, along = self._kinked(edge)
        rest = self._smooth - along @ part
        return np.concatenate((rest[: self._knots], part, rest[self._knots :])), cost

    def _kinked(self, edge: float) -> tuple[float, FloatArray, FloatArray]:
        columns = self._basis.edges(self._x, edge, 0) * self._root
        along = self._along(columns)
        columns = columns - self._columns @ along
        part = np.linalg.lstsq(columns, self._left, rcond=1e-10)[0]
        rest = self._left - columns @ part
        return float(rest @ rest), np.asarray(part), along

    def searched(self, kinks: Kinks) -> float:
        """Return the place at which a kink leaves the least sum of squares.

        With E the functions of a place, S those of the spline and r its residual, E reduces the
        sum of squares by ``r'E (E'E - E'S (S'S)^-1 S'E)^-1 E'r``. This is less exact than
        :meth:`fitted`, but good enough for the choice.

        :param kinks: the functions of each place, weighted as the points are.
        """
        places, functions = kinks.places.size, self._basis.kinks
        flat = kinks.columns.reshape(self._x.size, -1)
        across = self._transposed @ flat
        found, _ = dpotrs(self._factor[0], across, self._factor[1])
        shape = (-1, places, functions)
        own = np.einsum("kpi,kpj->pij", across.reshape(shape), found.reshape(shape))
        gram = kinks.gram - own
        size = np.sqrt(np.maximum(np.einsum("pii->pi", gram), 1e-300))
        gram = gram / (size[:, :, None] * size[:, None, :]) + _ALIKE * np.eye(functions)
        along = (self._left @ flat).reshape(places, functions) / size
        taken = np.einsum("pi,pi->p", along, np.linalg.solve(gram, along[:, :, None])[:, :, 0])
        return float(kinks.places[np.argmax(taken)])

    def refined(self, near: float, places: FloatArray) -> float:
        """Return the best place of a kink between the two places about one.

        :param near: phase.
        :param places: increasing phases, shape (m,).
        """
        i = int(np.argmin(np.abs(places - near)))
        bounds = (float(places[max(i - 1, 0)]), float(places[min(i + 1, places.size - 1)]))
        found = minimize_scalar(
            lambda p: self._kinked(p)[0],
            bounds=bounds,
            method="bounded",
            options={"xatol": _TOLERANCE},
        )
        return float(found.x)


@dataclass(frozen=True)
class Basis:
    """Functions that repeat with period 1, or mirrored: that change their sign after 1.

    :param mirrored: True: each half is the other one upside down.
    :param high: phase of the switch to low.
    """

    mirrored: bool
    high: float

    @property
    def kinks(self) -> int:
        """Number of functions with a kink."""
        return 2 if self.mirrored else 4

    def spline(self, phase: FloatArray, knots: int, derivative: int) -> FloatArray:
        """Return the cubic B-splines on even knots, or their rates, shape (n, knots)."""
        turn = np.floor(phase)
        place = (phase - turn) * knots
        cell = np.minimum(np.floor(place).astype(np.int64), knots - 1)
        s = place - cell
        pieces = (
            (
                (1.0 - s) ** 3 / 6.0,
                (3.0 * s**3 - 6.0 * s**2 + 4.0) / 6.0,
                (-3.0 * s**3 + 3.0 * s**2 + 3.0 * s + 1.0) / 6.0,
                s**3 / 6.0,
            )
            if derivative == 0
            else (
                -0.5 * (1.0 - s) ** 2 * knots,
                (1.5 * s**2 - 2.0 * s) * knots,
                (-1.5 * s**2 + s + 0.5) * knots,
                0.5 * s**2 * knots,
            )
        )
        columns = np.zeros((phase.size, knots))
        rows = np.arange(phase.size)
        for k, piece in enumerate(pieces):
            wrapped = cell + k >= knots
            sign = np.where(wrapped != (turn % 2.0 == 1.0), -1.0, 1.0) if self.mirrored else 1.0
            columns[rows, (cell + k) % knots] += sign * piece
        return columns

    def edges(self, phase: FloatArray, edge: float, derivative: int) -> FloatArray:
        """Return functions whose first or second derivative jumps, shape (n, kinks).

        Repeating: Bernoulli's polynomials of second and third degree, at ``edge`` and at
        ``high + edge``. Mirrored: a triangular wave and one of parabolas, at ``edge``.
        """
        columns = []
        for place in (edge,) if self.mirrored else (edge, self.high + edge):
            turn = np.floor(phase - place)
            s = phase - place - turn
            if self.mirrored:
                sign = np.where(turn % 2.0 == 0.0, 1.0, -1.0)
                pair = (
                    (1.0 - 2.0 * s, s * (1.0 - s))
                    if derivative == 0
                    else (np.full(s.size, -2.0), 1.0 - 2.0 * s)
                )
                columns += [sign * pair[0], sign * pair[1]]
            elif derivative == 0:
                columns += [s * (1.0 - s), s * (1.0 - s) * (1.0 - 2.0 * s)]
            else:
                columns += [1.0 - 2.0 * s, 1.0 - 6.0 * s + 6.0 * s**2]
        return np.stack(columns, axis=1)
