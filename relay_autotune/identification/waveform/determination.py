# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a record determines: intervals, combinations, and the test that would tell the rest.

Intervals come from the profile likelihood where the sum of squares is not a parabola.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.estimate import Uncertain, jacobian, relative_steps
from relay_autotune.identification.result import (
    DETERMINED,
    Identification,
    determined_combinations,
    is_determined,
)
from relay_autotune.identification.waveform.fit_covariance import (
    Fit,
    Noise,
    estimate_of,
)
from relay_autotune.identification.waveform.separable import NEGLIGIBLE, Problem, Trial, refine
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record

# Largest factor of the amplitude that is advised.
_MOST_TIMES = 5.0
_FEW_SAMPLES = 3.0
_LITTLE_BIAS = 0.1
# Least rest before the first change, as a share of the time between changes.
_SHORT_REST = 0.5
_SLOW = ("gain", "time_constant", "time_constant_1")


@dataclass(frozen=True)
class _Tests:
    """Properties of the records.

    :param biased: one of them has a mean command off the baseline.
    :param rested: one of them begins with samples at rest.
    :param interval: typical time between samples [s].
    :param relay: all were relay tests.
    """

    biased: bool
    rested: bool
    interval: float
    relay: bool


def advice(found: Identification, records: Sequence[Record]) -> tuple[str, ...]:
    """Return what would determine the parameters that are not determined.

    :param found: the identification.
    :param records: what it was identified from.
    """
    missing = set(found.undetermined)
    if not missing:
        return ()
    tests = _tests_of(records)
    said = []
    if missing & set(_SLOW) and not found.model.integrators:
        said += _for_slow(found, tests)
    small = missing - set(_SLOW)
    if found.model.integrators or len(found.model.time_constants) == 1:
        small |= missing & {"time_constant"} if found.model.integrators else set()
    if small:
        said += _for_fast(found, sorted(small), tests)
    said += _for_noise(found, missing)
    return tuple(said)


def _tests_of(records: Sequence[Record]) -> _Tests:
    biased, rested = False, False
    for record in records:
        u = record.input()
        settings = record.settings
        if settings is not None and abs(settings.bias) > _LITTLE_BIAS * settings.amplitude:
            biased = True
        changes = u.times
        if changes.size:
            gap = float(np.median(np.diff(changes))) if changes.size > 1 else record.duration
            rested |= float(changes[0] - record.time[0]) >= _SHORT_REST * gap
    intervals = [record.mean_interval for record in records]
    relay = all(record.settings is not None for record in records)
    return _Tests(biased, rested, max(intervals), relay)


def _for_slow(found: Identification, tests: _Tests) -> list[str]:
    """Return tests for a static gain and a slow lag: the measurement has to stop rising."""
    said = []
    slowest = max((abs(t) for t in found.model.time_constants), default=0.0)
    if tests.relay and not tests.biased:
        said.append(
            "a relay with a bias would determine the gain, since its mean command differs from "
            "that at rest: set bias_ratio to 0.3"
        )
    if not tests.rested:
        said.append(
            "samples at rest before the first change of the command would determine the gain, "
            "since they fix the measurement's zero"
        )
    if slowest > 0.0:
        said.append(
            f"a step of the command held for about {3.0 * slowest:.2g} s, three times the slowest "
            "lag, would determine gain and time constant"
        )
    return said


def _for_fast(found: Identification, names: Sequence[str], tests: _Tests) -> list[str]:
    """Return tests that tell dead time, small lags and zeros apart: by high frequencies."""
    said = []
    text = ", ".join(name.replace("_", " ") for name in names)
    fast = found.model.dead_time
    if fast < _FEW_SAMPLES * tests.interval:
        said.append(
            f"faster sampling would help with the {text}: the dead time is {fast:.2g} s, the time "
            f"between samples {tests.interval:.2g} s"
        )
    else:
        said.append(
            f"a second, slower test with a dead time added to the relay (extra_delay of about "
            f"{fast:.2g} s), fitted together with this one, would tell the {text} apart"
        )
    return said


def _for_noise(found: Identification, missing: set[str]) -> list[str]:
    """Return how much larger or longer the same test would have to be."""
    # An interval is as wide as the noise over the amplitude, and narrows with the cycles.
    widest = 0.0
    for name, value, low, high in zip(
        found.parameters, found.values, found.ci95_low, found.ci95_high, strict=True
    ):
        if name in missing:
            half = 0.5 * (high - low)
            times = half / (DETERMINED * abs(value)) if value else math.inf
            widest = max(widest, times)
    if not 1.0 < widest <= _MOST_TIMES:
        return []
    return [
        f"an amplitude {widest:.1f} times as large, or {math.ceil(widest**2)} times as many "
        "cycles, would narrow every interval enough"
    ]


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
            problem, state, parameter, _Search(centre, side, std, quantile, least, unit, farthest)
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


_MOST_FOR_PROFILES = 4096
# Largest standard deviation of a logarithm with which a search begins, and farthest end of an
# interval, in logarithms or in standard deviations.
_WIDE = 2.0
_FARTHEST = 8.0


def with_what_is_determined(
    found: Identification, records: Sequence[Record], fit: Fit, quantile: float
) -> Identification:
    """Replace linear intervals where they do not hold, and add the determined combinations.

    :param found: the identification with its linear intervals.
    :param records: what it was identified from.
    :param fit: the fit.
    :param quantile: half width of an interval in standard deviations.
    """
    found = _profiled(found, fit, quantile)
    if not found.undetermined:
        return found
    point = tuple(
        Uncertain(value, std, value - NORMAL_95 * std, value + NORMAL_95 * std)
        for value, std in (
            (found.ultimate_gain, found.ultimate_gain_std),
            (found.ultimate_frequency, found.ultimate_frequency_std),
        )
    )
    combinations = determined_combinations(found.estimate, (point[0], point[1]))
    found = replace(found, combinations=combinations)
    return replace(found, advice=advice(found, records))


def _profiled(found: Identification, fit: Fit, quantile: float) -> Identification:
    """Give parameters that are not determined the intervals of their profile likelihood."""
    if fit.loss != "squares" or fit.state.cost <= fit.state.residual.size * NEGLIGIBLE**2:
        return found
    wide = {i for i, name in enumerate(found.parameters) if name in found.undetermined}
    parameters = found.estimate.structure.parameters
    wide |= {i for i, p in enumerate(parameters) if found.ci95_low[i] == p.least}
    if not wide:
        return found
    few = fit.problem.thinned(_MOST_FOR_PROFILES)
    whole = few.time.size == fit.problem.time.size
    state = fit.state if whole else refine(few, fit.state.theta)
    # With fewer samples the curve is less steep, by the ratio of their numbers.
    fewer = few.time.size / fit.problem.time.size
    low, high = found.ci95_low.copy(), found.ci95_high.copy()
    white = estimate_of(fit.problem, fit.state, fit, Noise(), bounded=True)
    assert white is not None
    for i in sorted(wide):
        parameter, value = parameters[i], float(found.values[i])
        std = float(found.std[i])
        if not (math.isfinite(std) and std > 0.0):
            continue
        inflation = fewer * found.covariance[i, i] / max(white.covariance[i, i], 1e-300)
        ends = profile_ends(
            few,
            state,
            _Parameter(few, state, fit.scale, i, parameter.logarithmic),
            min(std / abs(value), _WIDE) if parameter.logarithmic else std,
            quantile,
            farthest=_FARTHEST if parameter.logarithmic else _FARTHEST * std,
            least=parameter.least,
            inflation=inflation,
        )
        if parameter.logarithmic:
            near, far = (_limit(e) if math.isinf(e) else math.exp(min(e, 700.0)) for e in ends)
            ends = (near, far) if value > 0.0 else (-far, -near)
        if fit.problem.colour is not None and math.isinf(ends[1]) and parameter.least == 0.0:
            # In a colour a long dead time is no candidate: the profile broke off where the fit
            # failed, as between two samples.
            ends = (ends[0], math.nan)
        # An end that could not be found stays the linear one.
        low[i] = low[i] if math.isnan(ends[0]) else min(ends[0], value)
        high[i] = high[i] if math.isnan(ends[1]) else max(ends[1], value)
    undetermined = tuple(
        name
        for i, name in enumerate(found.parameters)
        if (name in found.undetermined if i not in wide else True)
        and not is_determined(float(found.values[i]), float(low[i]), float(high[i]))
    )
    return replace(found, ci95_low=low, ci95_high=high, undetermined=undetermined)


def _limit(logarithm: float) -> float:
    """Return the exponential of an infinite logarithm."""
    return math.inf if logarithm > 0.0 else 0.0


class _Parameter:
    """One of the structure's parameters as a function of theta and the linear coefficients."""

    def __init__(
        self, problem: Problem, state: Trial, scale: float, number: int, logarithmic: bool
    ) -> None:
        self._structure, self._like, self._scale = problem.structure, state.theta, scale
        self._number, self._logarithmic = number, logarithmic

    def __call__(self, theta: FloatArray, coefficients: FloatArray) -> float:
        read = self._structure.read(theta, self._scale * coefficients, like=self._like)
        if read is None:
            return math.nan
        value = float(read[1][self._number])
        if not self._logarithmic:
            return value
        return math.log(abs(value)) if value != 0.0 else math.nan
