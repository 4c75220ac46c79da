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
# Weight of what is believed without any number.
_FAINT = 1e-9


@dataclass(frozen=True)
class Fit:
    """Weighted least squares over measured numbers, in logarithms of all but the dead time.

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
    def _range(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Both ends of the search, and its scale, shape (m,) each."""
        linear = ~self.structure.logarithmic[self.free]
        longest = np.where(self.free == 0, _LARGEST, np.log(_LONGEST * self.unit))
        low, high = np.where(linear, 0.0, -_LARGEST), np.where(linear, self.most, longest)
        return low, high, np.where(linear, self.unit, 1.0)

    def values(self, x: FloatArray) -> FloatArray:
        """Return the values at a point of the search, or at the end next to it, shape (p,)."""
        found, (low, high, _) = self.given.copy(), self._range
        logarithmic, x = self.structure.logarithmic[self.free], np.clip(x, low, high)
        found[self.free] = np.where(logarithmic, np.exp(np.where(logarithmic, x, 0.0)), x)
        found[0] = self.sign * abs(found[0])
        return found

    def searched(self, values: FloatArray) -> FloatArray:
        """Return the point of the search for some values, shape (m,)."""
        at = np.abs(values[self.free])
        logarithms = np.log(np.maximum(at, _SMALLEST))
        return np.where(self.structure.logarithmic[self.free], logarithms, at)

    def _errors(self, x: FloatArray) -> FloatArray:
        # A search that strays meets models without a value: they get a huge error.
        with np.errstate(over="ignore", invalid="ignore"):
            found = self.residual(self.values(x))
        return np.where(np.isfinite(found), found, _NO_VALUE)

    def _cost(self, x: FloatArray) -> float:
        return float(np.sum(self._errors(x) ** 2))

    def best(self, starts: Sequence[FloatArray]) -> tuple[float, FloatArray]:
        """Return the least sum of squares and where it is, from the best of some values.

        :param starts: at least one, shape (p,) each.
        """
        # Imported here, because it loads slowly, and few records need it.
        from scipy.optimize import least_squares

        low, high, scale = self._range
        points = sorted((self.searched(s) for s in starts), key=self._cost)
        found = self._cost(points[0]), points[0]
        options = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12, "max_nfev": _MOST_STEPS}
        for start in points[:_STARTS] if self.free.size else ():
            x = least_squares(
                *(self._errors, np.clip(start, low, high)),
                bounds=(low, high),
                x_scale=scale,
                **options,
            ).x
            found = min(found, (self._cost(x), x), key=lambda each: each[0])
            if found[0] < _EXACT:
                break
        return found

    def steps(self, x: FloatArray, faint: float = 0.0) -> FloatArray:
        """Return how the minimum moves with each measured number, by one standard deviation.

        ``(J'J)^-1 J'`` with the derivatives J of the errors, which is the implicit function
        theorem; a value at an end of its range stays there.

        :param x: where the sum of squares is least, shape (m,).
        :param faint: weight of a belief in where each value is, as m numbers more: a value
            without effect on the others is uncertain by its inverse.
        :return: shape (n + m, m).
        """
        low, high, scale = self._range
        linear = ~self.structure.logarithmic[self.free]
        # The largest dead time is a limit of the search, not of what the numbers allow.
        above = np.where(linear, np.inf, high - x)
        inside = np.minimum(x - low, above) > _AT_END * scale
        size = np.minimum(_DIFFERENCE * scale, np.where(linear, 0.5 * x, np.inf))
        slopes = jacobian(self._errors, x, np.where(inside, size, scale)) * scale * inside
        slopes = np.concatenate((slopes, np.diag(faint * inside)))
        return np.asarray(np.linalg.pinv(slopes).T * scale)

    def covariance(self, x: FloatArray) -> FloatArray:
        """Return the covariance of the values for numbers with the deviations given, shape (p, p).

        :param x: where the sum of squares is least, shape (m,).
        """
        found, free = np.zeros((self.given.size,) * 2), self.free
        size = np.where(self.structure.logarithmic, self.values(x), 1.0)[free]
        steps = self.steps(x, _FAINT) * size
        found[np.ix_(free, free)] = steps.T @ steps
        return found


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
    return found


def solved(
    method: str,
    structure: Structure,
    equations: Callable[[FloatArray], Sequence[float]],
    reading: Reading,
    *,
    sign: int = 1,
    late: float = 0.0,
    remarks: Sequence[str] = (),
) -> Identification:
    """Solve the equations of a method for what was read, and carry its scatter through them.

    :param method: its name in the registry.
    :param structure: of the model.
    :param equations: from the numbers read to the values of the parameters, for a relay that
        turns the process upwards, with the dead time that the relay added.
    :param reading: the numbers.
    :param sign: of the gain.
    :param late: dead time that the relay added [s].
    :param remarks: sentences for the user; empty ones are left out.
    :raises IdentificationError: if the equations have no solution.
    """

    def values(numbers: FloatArray) -> FloatArray:
        found = np.array(equations(numbers))
        found[0] *= sign
        found[-1] = max(found[-1] - late, 0.0)
        return found

    estimate = Estimate(structure, values(reading.values), reading.carried(values))
    return identified(method, estimate, reading.quantile, warnings=tuple(r for r in remarks if r))


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
