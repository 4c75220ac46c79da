# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Combinations that a record determines where it does not determine every parameter."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from relay_autotune.identification.estimate import Estimate, Uncertain
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.quantities import told

# Largest half interval of a determined value, relative to the value.
DETERMINED = 0.2


@dataclass(frozen=True)
class Combination:
    """A combination of parameters with its uncertainty; NaN: not estimated."""

    name: str = told("", "In terms of the parameters.", message="combinations")
    unit: str = told("", "Unit of the value.", message="combination_units")
    value: float = told("", "Its value.", nan=True)
    std: float = told("", "Its standard deviation.", math.nan, lower=0.0)
    ci95_low: float = told("", "Lower end of its 95 % interval.", math.nan, document="ci95")
    ci95_high: float = told("", "Upper end.", math.nan, document="ci95")

    @property
    def determined(self) -> bool:
        """True if half its interval is at most 20 % of the value."""
        return is_determined(self.value, self.ci95_low, self.ci95_high)


def is_determined(value: float, low: float, high: float) -> bool:
    """Return whether half an interval is at most 20 % of the value; False if it is not known."""
    return bool(0.5 * (high - low) <= DETERMINED * abs(value))


def determined_combinations(
    found: Estimate, point: tuple[Uncertain, Uncertain]
) -> tuple[Combination, ...]:
    """Return the determined combinations of a model that is not determined as a whole.

    :param found: the model with its covariance.
    :param point: K_u and w_u, whose uncertainty is known better than to first order.
    """
    asked: list[tuple[str, str, Uncertain]] = [
        (name, unit, found.uncertain(function)) for name, unit, function in _asked(found.model)
    ]
    if math.isfinite(point[0].value):
        asked += [
            ("ultimate_gain", "u/y", point[0]),
            ("ultimate_frequency", "rad/s", point[1]),
        ]
    combinations = (
        Combination(name, unit, e.value, e.std, e.low, e.high) for name, unit, e in asked
    )
    return tuple(c for c in combinations if c.determined)


def point_of(model: TransferFunction) -> tuple[float, float]:
    """Return K_u and w_u; NaN where there is none."""
    point = ultimate_point(model)
    return (math.nan, math.nan) if point is None else (point.gain, point.frequency)


def _asked(
    model: TransferFunction,
) -> list[tuple[str, str, Callable[[TransferFunction], float]]]:
    """Return names, units and functions of the combinations that may be determined."""
    lags = len(model.time_constants)
    found: list[tuple[str, str, Callable[[TransferFunction], float]]] = []
    per = " s" * (model.integrators + 1)
    if lags:
        # Its first slope: a short test of a slow process shows nothing else.
        found.append(("gain/time_constant", f"y/(u{per})", _slope))
    if lags > 1:
        found.append(("gain/product of lags", f"y/(u{' s' * (model.integrators + lags)})", _high))
    small = lags if model.integrators else lags - 1
    if small > 0 or model.zeros:
        found.append(("dead_time + smaller lags", "s", _apparent_dead_time))
    if lags and model.is_stable:
        found.append(("dead_time + sum of lags", "s", _residence))
    return found


def _slope(model: TransferFunction) -> float:
    return abs(model.gain) / max(abs(t) for t in model.time_constants)


def _high(model: TransferFunction) -> float:
    return abs(model.gain) / math.prod(abs(t) for t in model.time_constants)


def _apparent_dead_time(model: TransferFunction) -> float:
    lags = sorted((t.real for t in model.time_constants), key=abs)
    some = lags if model.integrators else lags[:-1]
    return model.dead_time + sum(some) - sum(z.real for z in model.zeros)


def _residence(model: TransferFunction) -> float:
    constants = sum(t.real for t in model.time_constants)
    return model.dead_time + constants - sum(z.real for z in model.zeros)
