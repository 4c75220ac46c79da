# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The gain at which a closed loop has a given resonance, exactly.

The closed-loop log modulus ``L_c = 20 log |k L/(1 + k L)|`` equals the logarithm of M > 1 where
k L(j w) lies on Hall's circle of M. At one frequency that is a quadratic equation for k,

    (M^2 - 1) |L|^2 k^2 + 2 M^2 Re(L) k + M^2 = 0,

so that every frequency at which it has real roots forbids the gains between them. The gains
forbidden by neighbouring frequencies join to intervals; the one that holds the ultimate gain ends
below at the largest gain of a loop of that resonance. A loop with two integrators has a second
interval that begins at zero, whose upper end is the lower solution: Luyben (2003) takes the
upper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point

_POINTS = 800
_BELOW, _ABOVE = 1e-5, 30.0


@dataclass(frozen=True)
class ResonantGain:
    """The gains at which a loop has a given resonance.

    :param upper: the largest of them below the ultimate gain.
    :param lower: the one at which slow oscillation ends; 0: there is none.
    """

    upper: float
    lower: float


@dataclass(frozen=True)
class _Forbidden:
    low: float
    high: float


def resonant_gain(loop: TransferFunction, decibels: float) -> ResonantGain:
    """Return the factors on a loop that give its closed loop a resonance.

    :param loop: controller of gain 1 times process, with the sign that makes its feedback
        negative.
    :param decibels: largest closed-loop log modulus, > 0 [dB].
    :raises TuningError: if the loop is stable at every gain or at none, or if no gain has so
        small a resonance.
    """
    limit = ultimate_point(loop)
    if limit is None:
        raise TuningError(
            f"no gain gives this loop a resonance of {decibels:g} dB: it has no ultimate gain, "
            "so that its resonance either has no bound or stays small at every gain"
        )
    square = 10.0 ** (decibels / 10.0)
    w = _grid(loop, limit.frequency)
    low, high = _roots(loop, w, square)
    intervals = _intervals(loop, w, low, high, square)
    # Sorted from above, so that one pass joins all that overlap with the ultimate gain.
    joined = _Forbidden(limit.gain, limit.gain)
    for each in sorted(intervals, key=lambda i: -i.high):
        if each.low <= joined.high and each.high >= joined.low * (1.0 - 1e-12):
            joined = _Forbidden(min(joined.low, each.low), max(joined.high, each.high))
    if joined.low <= 0.0:
        raise TuningError(
            f"no gain gives this loop a resonance as small as {decibels:g} dB: its integral time "
            "is too short, or its derivative time unsuitable"
        )
    below = [i.high for i in intervals if i.high < joined.low]
    return ResonantGain(joined.low, max(below, default=0.0))


def _grid(loop: TransferFunction, limit: float) -> FloatArray:
    corners = [1.0 / abs(c) for c in (*loop.zeros, *loop.time_constants)]
    lowest = min([limit, *corners]) * _BELOW
    parts = [np.geomspace(lowest, _ABOVE * limit, _POINTS)]
    if loop.dead_time > 0.0:
        count = min(int(_ABOVE * limit * loop.dead_time / 0.05) + 2, 50_000)
        parts.append(np.linspace(lowest, _ABOVE * limit, count))
    return np.unique(np.concatenate(parts))


def _roots(loop: TransferFunction, w: FloatArray, square: float) -> tuple[FloatArray, FloatArray]:
    """Return the gains between which each frequency forbids all; NaN: it forbids none."""
    value = loop(1j * w)
    size, real = np.abs(value) ** 2, value.real
    under = square * square * real * real - square * (square - 1.0) * size
    with np.errstate(invalid="ignore"):
        root = np.where((real < 0.0) & (under >= 0.0), np.sqrt(under), math.nan)
    # The product of the roots is M^2/((M^2 - 1)|L|^2); the sum of equals would lose digits.
    high = (-square * real + root) / ((square - 1.0) * size)
    low = square / ((square - 1.0) * size * high)
    return low, high


def _intervals(
    loop: TransferFunction, w: FloatArray, low: FloatArray, high: FloatArray, square: float
) -> list[_Forbidden]:
    inside = np.flatnonzero(~np.isnan(low))
    found = []
    for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1):
        if run.size == 0:
            continue
        first, last = max(int(run[0]) - 1, 0), min(int(run[-1]) + 1, w.size - 1)
        i, j = run[int(np.argmin(low[run]))], run[int(np.argmax(high[run]))]
        lowest = _refined(loop, w, int(i), square, 0, first, last)
        highest = _refined(loop, w, int(j), square, 1, first, last)
        # At the lowest frequency of a double integrator the interval goes on down to zero.
        found.append(_Forbidden(0.0 if i == 0 else min(lowest, low[i]), max(highest, high[j])))
    return found


def _refined(
    loop: TransferFunction, w: FloatArray, i: int, square: float, which: int, first: int, last: int
) -> float:
    sign = 1.0 if which == 0 else -1.0
    at = float(_roots(loop, w[i : i + 1], square)[which][0])
    beyond = 1e3 * at if which == 0 else 0.0

    def objective(log_w: float) -> float:
        value = float(_roots(loop, np.array([math.exp(log_w)]), square)[which][0])
        return beyond if math.isnan(value) else sign * value

    bounds = (math.log(w[max(i - 1, first)]), math.log(w[min(i + 1, last)]))
    found = minimize_scalar(objective, bounds=bounds, method="bounded", options={"xatol": 1e-12})
    return sign * float(found.fun)
