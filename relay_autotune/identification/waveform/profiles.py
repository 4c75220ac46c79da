# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Profile-likelihood intervals, for parameters whose sum of squares is not a parabola."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.differences import jacobian, relative_steps
from relay_autotune.identification.waveform.separable import Problem, Trial

# A parameter as a function of theta and the linear coefficients.
Parameter = Callable[[FloatArray, FloatArray], float]

# Largest numbers of steps outward, and of trials of each fit.
_MOST_STEPS = 20
_MOST_TRIALS = 12
# Number of failed fits in a row after which the profile cannot be followed.
_MOST_LOST = 5
# Least rise at the end of a search that did not settle, as a share of the quantile.
_FAR_ENOUGH = 0.5
_CLOSE = 0.05
_SETTLED = 1e-2
_FAR = 8.0
# Largest logarithm of a gain: products with a larger one overflow.
_LARGEST = 300.0
_FURTHER = 4.0
_WEAK = 1e-11
_NARROW = 0.3
# Least share of the way to the outer point for which interpolation is trusted.
_SMALL = 0.2


def profile_ends(
    problem: Problem,
    state: Trial,
    parameter: Parameter,
    std: float,
    quantile: float,
    *,
    least: float = -math.inf,
    farthest: float = math.inf,
    inflation: float = 1.0,
) -> tuple[float, float]:
    """Return both ends of the interval of one parameter by its profile likelihood.

    The sum of squares S(p), minimised over all else with the parameter held at p, rises from
    its minimum S to

        S(p) = S (1 + inflation q^2/(n - m))

    at the ends (Venzon and Moolgavkar 1988); the root of the rise is nearly straight, so that a
    few fits find each end.

    :param problem: the problem.
    :param state: its best fit.
    :param parameter: of theta and the linear coefficients.
    :param std: its standard deviation to first order.
    :param quantile: q.
    :param least: a lower bound of the parameter.
    :param farthest: largest distance of an end from the estimate that is tried.
    :param inflation: ratio of the variance to that of white noise.
    :return: lower and upper end; infinite where the sum of squares never rises so far, NaN where
        it could not be followed.
    """
    unit = inflation * state.cost / max(state.residual.size - state.parameters, 1)
    centre = parameter(state.theta, state.coefficients)
    below, above = (
        _end(
            problem,
            state,
            parameter,
            _Search(centre, side, std, quantile, least, unit, farthest),
        )
        for side in (-1.0, 1.0)
    )
    return below, above


@dataclass(frozen=True)
class _Search:
    """Where an end is looked for: from the centre to one side."""

    centre: float
    side: float
    std: float
    quantile: float
    least: float
    unit: float
    farthest: float


def _end(problem: Problem, state: Trial, parameter: Parameter, search: _Search) -> float:
    place = (state.theta, state.coefficients)
    inside, outside = (0.0, 0.0), (math.inf, math.inf)
    reach = search.quantile * search.std
    lost = 0
    for _ in range(_MOST_STEPS):
        target = max(search.centre + search.side * reach, search.least)
        held = _hold(problem, *place, parameter, target)
        if held is None:
            lost += 1
            if lost == _MOST_LOST and inside[1] == 0.0:
                return math.nan
            outside = (math.inf, reach)
            reach = 0.5 * (inside[1] + reach)
            continue
        root = math.sqrt(max(held[2] - state.cost, 0.0) / search.unit)
        if abs(root - search.quantile) <= _CLOSE * search.quantile:
            return target
        if root > search.quantile:
            outside = (root, reach)
        else:
            if target == search.least:
                return target
            if reach >= search.farthest:
                return search.side * math.inf
            inside, place = (root, reach), held[:2]
        if math.isinf(outside[0]):
            if outside[1] - inside[1] <= _NARROW * inside[1]:
                # It has not risen enough up to where fits fail.
                return search.side * math.inf
            further = reach * min(search.quantile / max(root, 1e-3), _FURTHER)
            reach = further if math.isinf(outside[1]) else 0.5 * (inside[1] + outside[1])
            reach = min(reach, search.farthest)
        else:
            share = (search.quantile - inside[0]) / (outside[0] - inside[0])
            share = min(share, 0.9) if share > _SMALL else 0.5
            reach = inside[1] + share * (outside[1] - inside[1])
    # Where no fit could be held far enough from the estimate, its end is not known.
    far = inside[0] >= _FAR_ENOUGH * search.quantile
    return search.centre + search.side * reach if far else math.nan


def _hold(
    problem: Problem,
    theta: FloatArray,
    coefficients: FloatArray,
    parameter: Parameter,
    target: float,
) -> tuple[FloatArray, FloatArray, float] | None:
    """Minimise over all else with the parameter at its target, by Gauss-Newton steps.

    The gain moves as a logarithm, and a zero relative to it, so that a gain and a time constant
    move together where only their ratio is known.
    """
    k, own = coefficients.size, len(problem.structure.powers)
    point = np.concatenate((coefficients, theta))
    sign = math.copysign(1.0, coefficients[0])
    point[1:own] /= point[0]
    point[0] = math.log(abs(point[0]))

    def unpacked(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        c = x[:k].copy()
        c[0] = sign * math.exp(min(c[0], _LARGEST))
        c[1:own] *= c[0]
        return x[k:], c

    numbers = np.arange(point.size)
    logarithms = (numbers == 0) | ((k <= numbers) & (numbers < point.size - 1))
    cost = math.inf
    for _ in range(_MOST_TRIALS):
        theta, coefficients = unpacked(point)
        columns, derivatives = problem.columns(theta)
        by_theta = np.einsum("k,mkn->mn", coefficients[: derivatives.shape[1]], derivatives)
        y, columns, by_theta = (problem.seen(x) for x in (problem.y, columns, by_theta))
        residual = y - coefficients @ columns
        slopes = np.concatenate((columns, by_theta))
        slopes[0] = coefficients[:own] @ columns[:own]
        slopes[1:own] *= coefficients[0]
        miss = target - parameter(theta, coefficients)
        steps = relative_steps(point, logarithms)
        gradient = jacobian(lambda x: parameter(*unpacked(x)), point, steps)
        if not (math.isfinite(miss) and bool(np.all(np.isfinite(gradient)))):
            return None
        with np.errstate(over="ignore"):
            previous, cost = cost, float(residual @ residual)
        if not math.isfinite(cost):
            return None
        small = abs(miss) <= 1e-6 * (abs(target) or 1.0)
        if small and abs(previous - cost) <= _SETTLED * cost / residual.size:
            return theta, coefficients, cost
        step = _constrained(slopes, residual, gradient, miss)
        if step is None or float(np.abs(step[k:-1]).max(initial=0.0)) > _FAR:
            return None
        point = point + step
        point[-1] = max(point[-1], 0.0)
    return None


def _constrained(
    jacobian: FloatArray, residual: FloatArray, gradient: FloatArray, miss: float
) -> FloatArray | None:
    """Return the least-squares step on the plane where the parameter meets its target."""
    size = np.sqrt(np.einsum("pn,pn->p", jacobian, jacobian))
    size[size == 0.0] = 1.0
    with np.errstate(over="ignore"):
        scaled, slope = jacobian / size[:, None], gradient / size
        power = float(slope @ slope)
    if not 0.0 < power < math.inf:
        return None
    onto = slope * (miss / power)
    # The directions in which the parameter stays: all but the first of an orthonormal basis.
    along = np.linalg.qr(slope[:, None], mode="complete")[0][:, 1:]
    rest = residual - onto @ scaled
    solved = np.linalg.lstsq((along.T @ scaled).T, rest, rcond=_WEAK)[0]
    with np.errstate(over="ignore"):
        step = np.asarray((onto + along @ solved) / size)
    # Along a direction that the samples hardly show, the step may overflow.
    return step if np.all(np.isfinite(step)) else None
