# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models 1 to 5 of Chang, Shen and Yu 1992, and the exact oscillation of their lags.

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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError, ModelError
from relay_autotune.identification.known import Known
from relay_autotune.process.structures import (
    FOPDT,
    LAG_N,
    SOPDT,
    TWO_EQUAL_ONE,
    Structure,
    equal_lags,
)

_CLOSE = 0.25
_TAYLOR = 15
_GRID = 64


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


def peak(time_constants: Sequence[float], period: float, harmonics: int | None = None) -> float:
    """Return the amplitude y/(K h): the maximum over t of eq 19 of Chang et al.

    The sum of eq 19 starts at n = 0 (printed: n = 1), and the root in its denominators covers
    all factors.

    :param time_constants: as for :func:`level`; with ``harmonics`` any real ones [s].
    :param period: P [s].
    :param harmonics: terms of the sum; 1: the describing function (eq 20); None: all of them.
    """
    if harmonics is None:
        part = peak_part(time_constants, period)
        if part == 0.0 and len(time_constants) > 1:
            return 1.0
        return abs(level(time_constants, period, part))
    if harmonics == 1:
        return fundamental(time_constants, period)
    # One maximum in each half period, though ripples of the cut sum may lie on it.
    angle = np.linspace(0.0, math.pi, _GRID * harmonics, endpoint=False)
    y = _harmonic_sum(time_constants, period, harmonics, angle)
    top = float(angle[np.argmax(np.abs(y))])
    fine = top + np.linspace(-1.0, 1.0, 201) * math.pi / (_GRID * harmonics)
    a = np.abs(_harmonic_sum(time_constants, period, harmonics, fine))
    i = min(max(int(np.argmax(a)), 1), 199)
    # The vertex of the parabola through the three highest points.
    bend = a[i - 1] - 2.0 * a[i] + a[i + 1]
    return float(a[i] - (a[i + 1] - a[i - 1]) ** 2 / (8.0 * bend)) if bend < 0.0 else float(a[i])


def fundamental(time_constants: Sequence[float], period: float) -> float:
    """Return the amplitude of the first harmonic, 4/pi |G(j w)|/K (eq 20).

    :param time_constants: any real ones [s].
    :param period: P [s].
    """
    w = 2.0 * math.pi / period
    return 4.0 / math.pi / math.prod(math.hypot(1.0, w * tau) for tau in time_constants)


def _harmonic_sum(
    time_constants: Sequence[float], period: float, harmonics: int, angle: FloatArray
) -> FloatArray:
    w = 2.0 * math.pi / period
    y = np.zeros_like(angle)
    for n in range(harmonics):
        k = 2 * n + 1
        size = k * math.prod(math.hypot(1.0, k * w * tau) for tau in time_constants)
        lag = sum(math.atan(k * w * tau) for tau in time_constants)
        y += np.sin(k * angle - lag) / size
    return 4.0 / math.pi * y


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


MODEL_1, MODEL_4, MODEL_5 = FOPDT, SOPDT, TWO_EQUAL_ONE

# Their names in messages.
_TEXTS = {FOPDT: "one lag", SOPDT: "two lags", TWO_EQUAL_ONE: "two equal lags and one"}


def model_text(model: Structure) -> str:
    """Return the name of a model, with the paper's number where it has one."""
    numbers = {MODEL_1: 1, MODEL_4: 4, MODEL_5: 5}
    number = numbers.get(model, model.order if model.order in (2, 3) else 0)
    text = _TEXTS.get(model, f"{model.order} equal lags")
    return f"model {number} ({text})" if number else text


def require_equal_lags(model: Structure) -> None:
    """Refuse a model whose gain is not known, but for equal lags.

    :raises IdentificationError: if the model has two time constants.
    """
    if not model.equal_lags:
        raise IdentificationError(
            f"{model_text(model)} needs the gain of the process: its two time constants take "
            "both the period and the amplitude; give the gain, or use the method li"
        )


def lags_of(model: Structure, constants: tuple[float, ...]) -> tuple[float, ...]:
    """Return the time constants of all lags [s].

    :param model: one of the models.
    :param constants: tau, or tau1 and tau2 [s].
    """
    given = dict(zip(model.parameters[1:-1], constants, strict=True))
    return tuple(
        given[p] for f in model.factors for p in f.parameters for _ in range(f.multiplicity)
    )


@dataclass(frozen=True)
class Solution:
    """A model's numbers.

    :param gain: K > 0 [y/u].
    :param constants: tau, or tau1 and tau2 [s].
    :param others: the constants of other solutions [s].
    """

    gain: float
    constants: tuple[float, ...]
    others: tuple[tuple[float, ...], ...] = ()

    def values(self, sign: int, dead_time: float) -> FloatArray:
        """Return the values of the model's parameters.

        :param sign: of the gain.
        :param dead_time: of the process [s].
        """
        return np.array((sign * self.gain, *self.constants, dead_time))

    def __str__(self) -> str:
        return constants_text(self.constants)


def constants_text(constants: tuple[float, ...]) -> str:
    """Return time constants as text."""
    if len(constants) == 1:
        return f"tau = {constants[0]:.4g} s"
    return ", ".join(f"tau{i} = {c:.4g} s" for i, c in enumerate(constants, 1))


def model_asked_for(method: str, known: Known) -> Structure | None:
    """Return the model that is known, or None where the choice is the method's.

    :param method: its name, for the message.
    :param known: a known structure, a known order.
    :raises IdentificationError: if the method has no such model.
    """
    models = {model.name: model for model in (MODEL_1, MODEL_4, MODEL_5)}
    if known.structure in models:
        model = models[known.structure]
        if known.order not in (0, model.order):
            raise IdentificationError(
                f"the structure {known.structure} has {model.order} lags, but the order given is "
                f"{known.order}: leave one of the two out"
            )
        return model
    if known.structure not in ("", LAG_N.name):
        raise IdentificationError(
            f"{method} has no structure {known.structure!r}; it has fopdt, lag_n, sopdt and "
            "two_equal_one"
        )
    if known.order:
        return equal_lags(known.order)
    if known.structure:
        raise IdentificationError(
            "the structure lag_n needs its order, the number of equal lags: give it"
        )
    return None
