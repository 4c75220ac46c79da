# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What every method that solves equations has in common: its refusals, covariance and remarks.

A method reads some numbers of a relay test, and its equations turn them into the parameters of a
structure. From there on all are alike.

The model nearest to more measured numbers than it has parameters, each with its deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, jacobian
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.fold import Reading
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import LAG_N, Structure, equal_lags
from relay_autotune.process.ultimate import ultimate_point

_NO_VALUE = 1e12
# Limits of the logarithms of gains and of time constants, the latter in times of the unit: the
# longest lag is an integrator.
_LARGEST, _SMALLEST = 300.0, 1e-300
_LONGEST = 1e4
_STARTS = 4
_MOST_STEPS = 200
_EXACT = 1e-20
# Step of derivatives, and distance that counts as at an end: in logarithms, or in units of time.
_DIFFERENCE = 1e-4
_AT_END = 1e-6


@dataclass(frozen=True)
class Fit:
    """Weighted least squares over measured numbers.

    :param structure: of the model.
    :param given: its values; NaN: to be fitted, shape (p,).
    :param sign: of the gain, +1 or -1.
    :param residual: from values to the model's error in each number over its
        deviation, shape (n,).
    :param unit: a time that the numbers show [s].
    :param most: largest dead time [s].
    """

    structure: Structure
    given: FloatArray
    sign: int
    residual: Callable[[FloatArray], FloatArray]
    unit: float
    most: float = np.inf

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """Indices of the values that are fitted."""
        return np.flatnonzero(np.isnan(self.given))

    @cached_property
    def _linear(self) -> NDArray[np.bool_]:
        """Which of the fitted values are a dead time; the others are fitted as logarithms."""
        return np.asarray(~self.structure.logarithmic[self.free])

    @cached_property
    def _scale(self) -> FloatArray:
        return np.where(self._linear, self.unit, 1.0)

    @cached_property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """Both ends of the search, shape (m,) each."""
        longest = np.where(self.free == 0, _LARGEST, np.log(_LONGEST * self.unit))
        low = np.where(self._linear, 0.0, -_LARGEST)
        return low, np.where(self._linear, self.most, longest)

    def values(self, x: FloatArray) -> FloatArray:
        """Return the values at a point of the search, shape (p,)."""
        found = self.given.copy()
        found[self.free] = np.where(self._linear, x, np.exp(np.where(self._linear, 0.0, x)))
        if self.free.size and self.free[0] == 0:
            found[0] *= self.sign
        return found

    def searched(self, values: FloatArray) -> FloatArray:
        """Return the point of the search for some values, shape (m,)."""
        at = np.abs(values[self.free])
        return np.where(self._linear, at, np.log(np.maximum(at, _SMALLEST)))

    def _errors(self, x: FloatArray) -> FloatArray:
        # A search that strays meets models without a value: they get a huge error.
        with np.errstate(over="ignore", invalid="ignore"):
            found = self.residual(self.values(x))
        return np.where(np.isfinite(found), found, _NO_VALUE)

    def refined(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Return the least sum of squares and where it is, from a start."""
        if x.size == 0:
            return float(np.sum(self._errors(x) ** 2)), x
        low, high = self.ends
        solved = least_squares(
            self._errors,
            np.clip(x, low, high),
            bounds=(low, high),
            x_scale=self._scale,
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
            max_nfev=_MOST_STEPS,
        )
        return 2.0 * float(solved.cost), solved.x

    def best(self, starts: Sequence[FloatArray]) -> tuple[float, FloatArray]:
        """Return the least sum of squares and where it is, from the best of some values.

        :param starts: at least one, shape (p,) each.
        """
        points = sorted(
            (self.searched(s) for s in starts), key=lambda x: float(np.sum(self._errors(x) ** 2))
        )
        found = self.refined(points[0])
        for x in points[1:_STARTS]:
            if found[0] < _EXACT:
                break
            found = min(found, self.refined(x), key=lambda each: each[0])
        return found

    def covariance(self, x: FloatArray) -> FloatArray:
        """Return the covariance of the values for numbers with the deviations told, shape (p, p).

        :param x: where the sum of squares is least, shape (m,).
        """
        slope = np.where(self._linear, 1.0, self.values(x)[self.free])
        found = np.zeros((self.given.size, self.given.size))
        steps = self.steps(x) * slope
        found[np.ix_(self.free, self.free)] = steps.T @ steps
        return found

    def steps(self, x: FloatArray) -> FloatArray:
        """Return how the minimum moves with each measured number, by one standard deviation.

        ``(J'J)^-1 J'`` with the derivatives J of the errors; a value at an end of its range stays
        there.

        :param x: where the sum of squares is least, shape (m,).
        :return: shape (n, m).
        """
        low, high = self.ends
        # The largest dead time is a limit of the search, not of what the numbers allow.
        above = np.where(self._linear, np.inf, high - x)
        inside = np.flatnonzero(np.minimum(x - low, above) > _AT_END * self._scale)
        size = np.minimum(_DIFFERENCE * self._scale, np.where(self._linear, 0.5 * x, np.inf))

        def errors(part: FloatArray) -> FloatArray:
            at = x.copy()
            at[inside] = part
            return self._errors(at)

        steps = np.zeros((self._errors(x).size, x.size))
        if inside.size:
            scale = self._scale[inside]
            steps[:, inside] = np.linalg.pinv(jacobian(errors, x[inside], size[inside]) * scale).T
            steps[:, inside] *= scale
        return steps


# Relative difference of two solutions that is worth a remark.
_TOO_LITTLE_DIFFERENCE = 1e-3


def structure_asked_for(
    method: str, known: Known, structures: Sequence[Structure]
) -> Structure | None:
    """Return the structure that is known, or None where the choice is the method's.

    :param method: its name, for the message.
    :param known: a known structure, a known order.
    :param structures: those of the method; equal lags stand for any number of them.
    :raises IdentificationError: if it is none of these, or needs an order, or has another one.
    """
    name, order = known.structure, known.order
    if not name:
        return equal_lags(order) if order and LAG_N in structures else None
    found = {each.name: each for each in structures}.get(name)
    if found is None:
        raise IdentificationError(
            f"{method} has no structure {name!r}; it has {', '.join(s.name for s in structures)}"
        )
    if found.any_order:
        if not order:
            raise IdentificationError(
                f"the structure {name} needs its order, the number of equal lags: give it"
            )
        return equal_lags(order)
    if order not in (0, found.order):
        raise IdentificationError(
            f"the structure {name} has {found.order} lags, but the order given is {order}: leave "
            "one of the two out"
        )
    return found


def solved(
    method: str,
    structure: Structure,
    equations: Callable[[FloatArray], Sequence[float]],
    reading: Reading,
    *,
    sign: int = 1,
    extra_delay: float = 0.0,
    remarks: Sequence[str] = (),
) -> Identification:
    """Solve the equations of a method for what was read, and carry its scatter through them.

    :param method: its name in the registry.
    :param structure: of the model.
    :param equations: from the numbers read to the values of the parameters, for a relay that
        turns the process upwards, with the dead time that the relay added.
    :param reading: the numbers.
    :param sign: of the gain.
    :param extra_delay: dead time that the relay added [s].
    :param remarks: sentences for the user; empty ones are left out.
    :raises IdentificationError: if the equations have no solution.
    """

    def values(numbers: FloatArray) -> FloatArray:
        found = np.array(equations(numbers))
        found[0] *= sign
        found[-1] = max(found[-1] - extra_delay, 0.0)
        return found

    estimate = Estimate(structure, values(reading.values), reading.carried(values))
    warnings = tuple(r for r in remarks if r)
    return identified(method, estimate, reading.quantile, warnings=warnings)


def literally(
    how: str,
    structure: Structure,
    solve: Callable[[], Sequence[float]],
    found: Sequence[float] | FloatArray,
) -> list[str]:
    """Return what the equations of a paper give as they stand, if that is something else.

    :param how: which equations, and what they leave out.
    :param structure: of the model.
    :param solve: returns the values by these equations.
    :param found: the values by the exact ones, shape (p,).
    """
    try:
        literal = np.array(solve())
    except IdentificationError:
        return [f"as in the paper, {how} would have no solution"]
    if np.allclose(literal, found, rtol=_TOO_LITTLE_DIFFERENCE, atol=0.0):
        return []
    numbers = ", ".join(
        f"{name.replace('_', ' ')} {value:.4g}"
        for name, value in zip(structure.names, literal, strict=True)
    )
    point = ultimate_point(structure.build(literal))
    ultimate = f", K_u {point.gain:.4g}" if point else ""
    return [f"as in the paper, {how} would give {numbers}{ultimate}"]
