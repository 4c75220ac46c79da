# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A model by its parameters and their covariance, and what follows from both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.process.structures import GivenModel, Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import NORMAL_95

_DIFFERENCE = 1e-6


def student_95(degrees: int) -> float:
    """Return half the width of a 95 % interval by Student's distribution, in standard deviations.

    :param degrees: of freedom; below 1 counts as 1.
    """
    return float(stdtrit(max(degrees, 1), 0.975))


def jacobian(
    function: Callable[[FloatArray], ArrayLike],
    at: FloatArray,
    up: FloatArray,
    down: FloatArray | None = None,
) -> NDArray[Any]:
    """Return ``df/dx_i = (f(x + up_i e_i) - f(x - down_i e_i))/(up_i + down_i)``.

    :param function: f, from shape (p,) to any shape s.
    :param at: x, shape (p,).
    :param up: steps ahead, shape (p,).
    :param down: steps back, shape (p,), 0 for a difference to one side; default: as far as ahead.
    :return: shape (*s, p).
    """
    back = up if down is None else down
    here = None if np.all(back) else np.asarray(function(at))
    columns = []
    for i, (ahead, behind) in enumerate(zip(up, back, strict=True)):
        ends = []
        for step in (ahead, -behind):
            moved = at.copy()
            moved[i] += step
            ends.append(here if step == 0.0 and here is not None else np.asarray(function(moved)))
        columns.append((ends[0] - ends[1]) / (ahead + behind))
    return np.stack(columns, axis=-1)


def relative_steps(at: FloatArray, logarithms: NDArray[np.bool_]) -> FloatArray:
    """Return steps of a millionth of each number, for a function that is known to rounding.

    :param at: the point, shape (p,).
    :param logarithms: which numbers are logarithms, shape (p,): one near zero stands for a
        quantity near 1, not for a small one, and gets a millionth.
    """
    steps = _DIFFERENCE * np.where(at == 0.0, 1.0, np.abs(at))
    return np.where(logarithms, np.maximum(steps, _DIFFERENCE), steps)


def exact_steps(
    at: FloatArray, size: FloatArray, least: ArrayLike = -math.inf
) -> tuple[FloatArray, FloatArray]:
    """Return steps ahead and back that are exact in the numbers of the computer.

    :param at: the point, shape (p,).
    :param size: of the steps, shape (p,).
    :param least: lower bound of the point after a step back, shape (p,).
    """
    return (at + size) - at, at - np.maximum(at - size, least)


# Steps in standard deviations: the first at which there is a value.
_SHARES = (1.0, 0.1, 0.01, 1e-3)


def carried(
    function: Callable[[FloatArray], FloatArray], at: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the covariance of a function of uncertain numbers, by one step along each axis.

    The steps are one standard deviation along the principal axes of the covariance, to both sides
    where the function has a value there, and less where it has one on none. For the solution x of
    equations f(x, z) = 0 in the numbers z this is the implicit function theorem,
    dx = -(df/dx)^-1 (df/dz) dz.

    :param function: from numbers, shape (n,), to values, shape (p,); where it raises an
        ``IdentificationError`` it has none.
    :param at: the numbers, shape (n,).
    :param covariance: of the numbers, shape (n, n).
    :return: shape (p, p); NaN where the function has a value on no side of an axis.
    """
    here = function(at)
    if not np.all(np.isfinite(covariance)):
        return np.full((here.size, here.size), math.nan)
    scale = np.sqrt(np.diag(covariance))
    used = scale > 0.0
    alone = scale[used]
    size, axes = np.linalg.eigh(covariance[np.ix_(used, used)] / np.outer(alone, alone))
    steps = np.zeros((size.size, at.size))
    steps[:, used] = (axes * np.sqrt(np.maximum(size, 0.0))).T * alone

    def change(step: FloatArray) -> FloatArray:
        for share in _SHARES:
            ends = []
            for side in (share, -share):
                try:
                    ends.append(function(at + side * step))
                except IdentificationError:
                    continue
            if len(ends) == 2:
                return (ends[0] - ends[1]) / (2.0 * share)
            if ends:
                return (ends[0] - here) / share
        return np.full(here.size, math.nan)

    root = np.array([change(step) for step in steps]).reshape(-1, here.size)
    return np.asarray(root.T @ root)


# Largest change of a logarithm in a model that is drawn.
_FARTHEST_DRAWN = 20.0


@dataclass(frozen=True, eq=False)
class Estimate:
    """The parameters of a model and their covariance.

    :param structure: of the model.
    :param values: of its parameters, in their order, shape (p,).
    :param covariance: of the values, shape (p, p); NaN: not estimated.
    :param root: B of the covariance B B', shape (p, k), which keeps twice the digits where
        parameters can hardly be distinguished; None: not known.
    """

    structure: Structure
    values: FloatArray
    covariance: FloatArray
    root: FloatArray | None = None

    @classmethod
    def of(
        cls, structure: Structure, values: FloatArray, covariance: FloatArray | None = None
    ) -> Estimate:
        """Return values with their covariance, or without.

        :param structure: of the model.
        :param values: of its parameters, shape (p,).
        :param covariance: shape (p, p); None: not estimated.
        """
        if covariance is None:
            covariance = np.full((values.size, values.size), math.nan)
        return cls(structure, values, covariance)

    @classmethod
    def of_model(cls, model: TransferFunction) -> Estimate:
        """Return a model of which only the transfer function is known."""
        return cls.of(GivenModel.of(model), np.empty(0))

    @classmethod
    def of_root(cls, structure: Structure, values: FloatArray, root: FloatArray) -> Estimate:
        """Return values with the covariance B B'.

        :param structure: of the model.
        :param values: of its parameters, shape (p,).
        :param root: B, shape (p, k); where B B' overflows, the covariance is NaN.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            covariance = root @ root.T
        if not np.all(np.isfinite(covariance)):
            covariance = np.full_like(covariance, math.nan)
        return cls(structure, values, np.asarray(covariance), root)

    @cached_property
    def model(self) -> TransferFunction:
        """The transfer function of the values."""
        return self.structure.build(self.values)

    @property
    def known(self) -> bool:
        """True if a covariance was estimated, and models can be made of other values."""
        given = isinstance(self.structure, GivenModel) or not self.values.size
        return not given and bool(np.all(np.isfinite(self.covariance)))

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the values, shape (p,); NaN: not estimated."""
        # Rounding may leave a variance below zero, of which no deviation is known.
        variance = np.diag(self.covariance)
        return np.sqrt(np.where(variance >= 0.0, variance, math.nan))

    def intervals(self, quantile: float = NORMAL_95) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the 95 % intervals of the values, each of shape (p,).

        A value that cannot change sign, as a gain or a time constant, has the interval of its
        logarithm; any other has a linear one, cut at the parameter's least value.

        :param quantile: half width in standard deviations.
        """
        values, reach = self.values, quantile * self.std
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ratio = np.exp(np.minimum(reach / np.abs(values), 700.0))
            ends = values / ratio, values * ratio
        logarithmic, least = self.structure.logarithmic, self.structure.least
        low = np.where(logarithmic, np.minimum(*ends), values - reach)
        high = np.where(logarithmic, np.maximum(*ends), values + reach)
        cut = ~logarithmic & np.isfinite(low)
        return np.where(cut, np.maximum(low, least), low), high

    def ultimate_std(self, gain: float, frequency: float) -> tuple[float, float]:
        """Return the standard deviations of K_u and w_u to first order.

        At a fixed frequency a parameter p changes log G by d, and the ultimate point moves by

            dw = -d(arg G)/dp / (d(arg G)/dw),   d(log K_u) = -d(log|G|)/dp - d(log|G|)/dw dw.

        :param gain: K_u of the model [u/y].
        :param frequency: its w_u [rad/s].
        """
        structure, values = self.structure, self.values

        def log_response(x: FloatArray, w: float) -> complex:
            # At the ultimate point -K_u G is 1, so that its logarithm has no branch nearby.
            return complex(np.log(-gain * structure.build(x)(1j * w)))

        step = 1e-6
        by_frequency = (
            log_response(values, frequency * (1.0 + step))
            - log_response(values, frequency * (1.0 - step))
        ) / (2.0 * step * frequency)
        # The step of a dead time or a zero near 0 is relative to the period.
        radian = 1.0 / frequency
        size = np.maximum(np.abs(values), np.where(structure.logarithmic, 0.0, radian))
        size = step * np.where(size == 0.0, radian, size)
        steps = exact_steps(values, size, structure.least)

        def size_and_phase(x: FloatArray) -> tuple[float, float]:
            found = log_response(x, frequency)
            return found.real, found.imag

        size_changes, phase_changes = jacobian(size_and_phase, values, *steps)
        frequency_changes = -phase_changes / by_frequency.imag
        gain_changes = -gain * (size_changes + by_frequency.real * frequency_changes)

        def deviation(gradient: FloatArray) -> float:
            # Of a model that is hardly known it is infinite.
            with np.errstate(over="ignore"):
                return math.sqrt(max(float(gradient @ self.covariance @ gradient), 0.0))

        return deviation(gain_changes), deviation(frequency_changes)

    def draws(self, count: int, rng: np.random.Generator) -> Iterator[TransferFunction]:
        """Draw models from the uncertainty.

        Correlations are kept, which matters: a gain and a time constant that are each uncertain
        often have a ratio that is not.

        :param count: models to draw.
        :param rng: the source.
        """
        structure, values = self.structure, self.values
        # Some parameters have a normal distribution of their logarithm.
        size = np.where(structure.logarithmic, values, 1.0)
        changes = rng.multivariate_normal(
            np.zeros(values.size),
            self.covariance / np.outer(size, size),
            count,
            # Undetermined parameters have variances so large that their rounding is not small.
            check_valid="ignore",
            method="eigh",
        )
        for change in changes:
            factors = np.exp(np.clip(change, -_FARTHEST_DRAWN, _FARTHEST_DRAWN))
            shifted = np.maximum(values + change, structure.least)
            yield structure.build(np.where(structure.logarithmic, values * factors, shifted))
