# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Intervals of parameters that a fit does not determine, and combinations that it does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.combinations import determined_combinations, is_determined
from relay_autotune.identification.estimate import Uncertain
from relay_autotune.identification.judgement.advice import advice
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.fit_covariance import (
    NEGLIGIBLE,
    Fit,
    Noise,
    estimate_of,
)
from relay_autotune.identification.waveform.profiles import profile_ends
from relay_autotune.identification.waveform.separable import Problem, Trial, refine
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record

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
    white = estimate_of(fit.problem, fit.state, fit, Noise(False), bounded=True)
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
