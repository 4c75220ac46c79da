"""Intervals for any function of an identified model."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from relay_autotune.confidence import NORMAL_95
from relay_autotune.errors import ModelError
from relay_autotune.process.transfer_function import TransferFunction

FloatArray = NDArray[np.float64]

# Logarithms may go so far from the estimate, and steps for derivatives are so long.
_FAR = 50.0
_STEPS = (1e-7, 1e-2)
_SHARE = 1e-3


class Uncertain(Protocol):
    """What has parameters with a covariance and makes a model of them."""

    @property
    def build(self) -> Callable[[FloatArray], TransferFunction]:
        """The transfer function for any values of the parameters."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""

    @property
    def values(self) -> FloatArray:
        """Their values, shape (p,)."""

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the values, shape (p, p)."""


@dataclass(frozen=True)
class Estimate:
    """A quantity with its uncertainty.

    :param value: the quantity.
    :param std: its standard deviation to first order; NaN: not estimated.
    :param low: lower end of its 95 % interval; NaN: not estimated.
    :param high: upper end; NaN: not estimated.
    """

    value: float
    std: float = math.nan
    low: float = math.nan
    high: float = math.nan


def is_logarithmic(parameter: str) -> bool:
    """Return whether a parameter cannot change sign, so that its logarithm has the interval.

    :param parameter: its name.
    """
    return parameter not in ("dead_time", "zero")


def estimate(
    found: Uncertain,
    function: Callable[[TransferFunction], float],
    quantile: float = NORMAL_95,
) -> Estimate:
    """Return a function of the model with its 95 % interval.

    With z the parameters, gains and time constants by their logarithms, S their covariance and g
    the gradient of the function f by z, the variance is g' S g, and the interval

        f(z - q S g/sqrt(g' S g))  to  f(z + q S g/sqrt(g' S g)),

    which is exact for any monotone function of a linear one: it is the usual one for a dead
    time, and that of the logarithm for a gain or a ratio.

    :param found: an identification, or one of its rivals.
    :param function: of the model, such as ``lambda m: abs(m(1j * 0.3))``; NaN: it has none.
    :param quantile: half width of the interval of a normal variable in standard deviations.
    """
    value = float(function(found.build(found.values)))
    covariance = found.covariance
    if not math.isfinite(value) or not bool(np.all(np.isfinite(covariance))):
        return Estimate(value)
    logarithmic = np.array([is_logarithmic(n) for n in found.parameters])
    size = np.where(logarithmic, found.values, 1.0)
    spread = covariance / np.outer(size, size)

    def at(change: FloatArray) -> float:
        limited = np.clip(change, -_FAR, _FAR)
        moved = np.where(logarithmic, found.values * np.exp(limited), found.values + change)
        for i, name in enumerate(found.parameters):
            if name == "dead_time":
                moved[i] = max(moved[i], 0.0)
        try:
            return float(function(found.build(moved)))
        except (ModelError, OverflowError):
            return math.nan

    gradient = np.zeros(found.values.size)
    for i, deviation in enumerate(np.sqrt(np.maximum(np.diag(spread), 0.0))):
        h = min(max(_SHARE * deviation, _STEPS[0]), _STEPS[1])
        if not logarithmic[i]:
            h = max(_SHARE * deviation, _STEPS[0] * (abs(found.values[i]) or 1.0))
        step = np.zeros(found.values.size)
        step[i] = h
        # At a dead time of zero there is one side only.
        below = h if found.parameters[i] != "dead_time" else min(h, float(found.values[i]))
        gradient[i] = (at(step) - at(-step * (below / h))) / (h + below)
    variance = float(gradient @ spread @ gradient)
    if not variance >= 0.0:
        return Estimate(value)
    std = math.sqrt(variance)
    if std == 0.0:
        return Estimate(value, 0.0, value, value)
    along = quantile * (spread @ gradient) / std
    ends = [at(-along), at(along)]
    if not all(math.isfinite(e) for e in ends):
        ends = [value - quantile * std, value + quantile * std]
    return Estimate(value, std, min(*ends, value), max(*ends, value))
