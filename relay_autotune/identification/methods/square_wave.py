# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The oscillation of lags under a square wave, exactly and by its first harmonic.

Static gain and height of the square wave are 1, so that y here is y/(K h). With T half a period,
x = T/tau and m the part of a half period since the square wave went up, the output of one lag is

    f(m, x) = 1 - 2 exp(-m x)/(1 + exp(-x)).

That of lags x_1 ... x_n in a row is the value at 0 of the polynomial through the points
(x_i, f(m, x_i)). Newton's form of it equals the partial fractions (Chang, Shen and Yu 1992,
appendix), but stays accurate where lags are equal or nearly so. For n equal lags it is

    F_n = sum over k < n of (-x)^k/k! d^k f/dx^k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

from relay_autotune.errors import ModelError

_CLOSE = 0.25
_TAYLOR = 15


def level(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return y/(K h) at a part m of the half period in which the square wave is up.

    :param time_constants: equal ones, two, or three of which the first two are equal [s].
    :param period: P [s].
    :param part: m, from 0 to 1.
    :raises ModelError: if the time constants are of another pattern.
    """
    x = _ratios(time_constants, period)
    value, factor = 0.0, 1.0
    for ratio, difference in zip(x, _differences(part, x), strict=True):
        value += factor * difference
        factor *= -ratio
    return value


def slope_sign(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return a number with the sign of dy/dt at a part m of the upper half period.

    :param time_constants: as for :func:`level` [s].
    :param period: P [s].
    :param part: m, from 0 to 1.
    """
    x = _ratios(time_constants, period)
    if len(x) == 1:
        return 1.0
    # The rate is the highest difference times the product of -x.
    return (-1.0) ** len(x) * _differences(part, x)[-1]


def peak_part(time_constants: Sequence[float], period: float) -> float:
    """Return when the measurement peaks: the part of a half period after the command arrived.

    A square wave through real lags has one maximum in each period and one minimum half a period
    later, so that there is one of the two. In the limit cycle of a relay it is a minimum.

    :param time_constants: as for :func:`level` [s].
    :param period: P [s].
    """
    x = _ratios(time_constants, period)
    # Beyond this the effect of the half period before is below rounding.
    if len(x) == 1 or min(x) > 50.0 + 5.0 * len(x):
        return 0.0
    # The amplitude there is flat, so that this accuracy gives it to the last digit.
    return float(
        brentq(lambda m: slope_sign(time_constants, period, m), 0.0, 1.0, xtol=1e-12, rtol=1e-9)
    )


def peak(time_constants: Sequence[float], period: float) -> float:
    """Return the amplitude y/(K h): the maximum over t of eq 19 of Chang et al.

    The sum of eq 19 starts at n = 0 (printed: n = 1), and the root in its denominators covers
    all factors.

    :param time_constants: as for :func:`level` [s].
    :param period: P [s].
    """
    part = peak_part(time_constants, period)
    if part == 0.0 and len(time_constants) > 1:
        return 1.0
    return abs(level(time_constants, period, part))


def fundamental(time_constants: Sequence[float], period: float) -> float:
    """Return the amplitude of the first harmonic, 4/pi |G(j w)|/K (eq 20).

    :param time_constants: any real ones [s].
    :param period: P [s].
    """
    w = 2.0 * math.pi / period
    return 4.0 / math.pi / math.prod(math.hypot(1.0, w * tau) for tau in time_constants)


def _angle(time_constants: Sequence[float], period: float, part: float) -> float:
    w = 2.0 * math.pi / period
    return math.pi * part - sum(math.atan(w * tau) for tau in time_constants)


def first_level(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return the first harmonic of :func:`level`; with its amplitude, the describing function.

    :param time_constants: any real ones [s].
    :param period: P [s].
    :param part: m, from 0 to 1.
    """
    # Beyond a quarter turn it is past its least value; the relay switches before it rises again.
    angle = max(_angle(time_constants, period, part), -0.5 * math.pi)
    return fundamental(time_constants, period) * math.sin(angle)


def first_slope_sign(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return a number with the sign of the rate of :func:`first_level`, as its parameters."""
    return math.cos(_angle(time_constants, period, part))


def _ratios(time_constants: Sequence[float], period: float) -> tuple[float, ...]:
    half = 0.5 * period
    return tuple(half / tau for tau in time_constants)


def _differences(m: float, x: tuple[float, ...]) -> list[float]:
    """Divided differences f[x1], f[x1, x2], ..."""
    if all(ratio == x[0] for ratio in x):
        return _taylor(m, x[0], len(x))
    if len(x) == 2:
        return [_taylor(m, x[0], 1)[0], _secant(m, x[0], x[1])]
    if len(x) != 3 or x[0] != x[1]:
        raise ModelError(
            f"found {len(x)} lags; expected equal ones, two, or three of which the first two are "
            "equal"
        )
    step = x[2] - x[0]
    if abs(step) < _CLOSE:
        c = _taylor(m, x[0], _TAYLOR)
        third = sum(c[k] * step ** (k - 2) for k in range(2, _TAYLOR))
    else:
        c = _taylor(m, x[0], 2)
        third = (_secant(m, x[0], x[2]) - c[1]) / step
    return [c[0], c[1], third]


def _taylor(m: float, x: float, count: int) -> list[float]:
    """First coefficients of f(m, x + d) in powers of d, from the quotient of two series."""
    e = math.exp(-x)
    # In a form without cancellation where x is small.
    found = [(math.expm1(-x) - 2.0 * math.expm1(-m * x)) / (1.0 + e)]
    if count == 1:
        return found
    above, below = math.exp(-m * x), [1.0 + e]
    quotient = [above / below[0]]
    for k in range(1, count):
        above *= -m / k
        e /= -k
        below.append(e)
        rest = above - sum(below[j] * quotient[k - j] for j in range(1, k + 1))
        quotient.append(rest / below[0])
        found.append(-2.0 * quotient[-1])
    return found


def _secant(m: float, x1: float, x2: float) -> float:
    """Divided difference (f(x2) - f(x1))/(x2 - x1), without cancellation."""
    x1, x2 = min(x1, x2), max(x1, x2)
    d = x2 - x1
    rise = math.expm1(-m * d) - math.exp(-x1 - m * d) * math.expm1(-(1.0 - m) * d)
    scale = math.exp(-m * x1) / ((1.0 + math.exp(-x1)) * (1.0 + math.exp(-x2)))
    return -2.0 * scale * rise / d


@dataclass(frozen=True)
class Wave:
    """What of the square wave enters the equations of a limit cycle.

    :param level: from lags, period and part of the half period to y/(K h).
    :param slope_sign: from the same to a number with the sign of its rate.
    :param peak: from lags and period to a/(K h).
    :param largest: the limit of that where the lags vanish.
    """

    level: Callable[[Sequence[float], float, float], float]
    slope_sign: Callable[[Sequence[float], float, float], float]
    peak: Callable[[Sequence[float], float], float]
    largest: float


# All harmonics; the period by all of them and the amplitude by the first (eqs 8 to 12 and 21 to 25
# of Chang et al. as they stand); the first alone, which is the describing function.
EXACT = Wave(level, slope_sign, peak, 1.0)
MIXED = Wave(level, slope_sign, fundamental, 4.0 / math.pi)
FIRST = Wave(first_level, first_slope_sign, fundamental, 4.0 / math.pi)
