r"""Fit of a model to every sample of a record, by separable least squares.

The model is

    y(t_i) = sum_k c_k r_k(t_i; theta) + offset [+ drift t_i] [+ free initial state] + noise,

with r_k the exact responses to the recorded command, the dead time any real number. Which
structure, and whether drift and initial state belong to it, is decided by the Bayesian
information criterion.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.checks import disagreeing_point, unequal_gains
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.lags import FOPDT
from relay_autotune.identification.residuals import covariance_meat, ljung_box
from relay_autotune.identification.result import (
    FitReport,
    Identification,
    Rival,
    with_uncertainty,
)
from relay_autotune.identification.selection import (
    Candidate,
    Selection,
    after_the_unknown,
    choose,
    support,
)
from relay_autotune.identification.separable import (
    Problem,
    State,
    evaluate,
    information_criterion,
    refine,
)
from relay_autotune.models import STRUCTURES
from relay_autotune.record import PiecewiseConstant, Record

FloatArray = NDArray[np.float64]

_NEGLIGIBLE = 1e-10
_UNEXPLAINED = 1.5
_WHITE = 1e-3
_LEAST_SAMPLES = 12
_MOST_FOR_CHOICE = 16_384
_WORTH_TELLING = 1e-3
_OUTLIER = 6.0
_MOST_OUTLIERS = 0.02
_OPEN = 0.01


def identify_waveform(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a model from all samples of a record.

    :param record: any record whose command moves; baseline samples before the test help.
    :param known: its structure is fitted; by default the simplest that explains the data.
    :raises IdentificationError: if the record holds too little, or no response to the command.
    """
    if known.structure and known.structure not in STRUCTURES[:-1]:
        raise IdentificationError(
            f"the waveform fit has no structure {known.structure!r}; it has "
            f"{', '.join(STRUCTURES[:-1])}"
        )
    u = record.input()
    time, y = record.time, record.measurement
    _require_content(time, y, u)
    # In units of its own range, so that no unit of measurement is too large or too small.
    scale = max(float(np.ptp(y)), float(np.abs(y).max()) * 1e-6)
    problem = Problem(time, (y - y[0]) / scale, u, FOPDT)
    sign = 0 if record.settings is None else -1 if record.settings.reverse_acting else 1
    fitted, state, candidates = _fit(problem, known, sign)
    outlying = _outliers(fitted, state, problem.time.size)
    if np.any(outlying):
        # They would pull both the choice and the fit.
        fitted, state, candidates = _fit(problem.part(~outlying), known, sign)
    _require_response(fitted, state)
    found = _report(record, fitted, state, scale, candidates)
    if not np.any(outlying):
        return found
    told = (
        f"{int(np.sum(outlying))} of the samples lie more than {_OUTLIER:g} standard deviations "
        "off every model and were left out: check the sensor for spikes"
    )
    return replace(found, warnings=(*found.warnings, told))


def _fit(problem: Problem, known: Known, sign: int) -> tuple[Problem, State, list[Candidate]]:
    # What is decided on some thousand samples would not be decided otherwise on a million.
    few = problem.part(slice(None, None, 1 + problem.time.size // _MOST_FOR_CHOICE))
    chosen, candidates = _choose(few, known, sign)
    problem = replace(chosen.problem, time=problem.time, y=problem.y)
    problem = after_the_unknown(problem, chosen.state)
    return problem, refine(problem, chosen.state.theta), candidates


def _outliers(problem: Problem, state: State, samples: int) -> NDArray[np.bool_]:
    """Return which samples no noise of the residual's own width explains, shape (samples,).

    :param problem: what was fitted: the last ones of the samples.
    :param state: the fit.
    :param samples: how many there were.
    """
    found = np.zeros(samples, dtype=bool)
    error = np.abs(state.residual - np.median(state.residual))
    # For normal noise the standard deviation is 1.4826 times the median of the absolute error.
    width = 1.4826 * float(np.median(error))
    far = error > max(_OUTLIER * width, _NEGLIGIBLE)
    # Many of them, or several in a row, are no spikes but something that the model lacks.
    alone = far & ~np.roll(far, 1) & ~np.roll(far, -1)
    if width > _NEGLIGIBLE and np.sum(far) == np.sum(alone) <= _MOST_OUTLIERS * samples:
        found[samples - problem.time.size :] = far
    return found


def _choose(problem: Problem, known: Known, sign: int) -> tuple[Candidate, list[Candidate]]:
    selection = Selection(problem, problem.time.size * _NEGLIGIBLE**2, sign)
    if not known.structure:
        candidates = selection.all()
        if not candidates:
            raise IdentificationError(
                "no structure explains the record with a gain in the direction of the relay: "
                "check that command and measurement belong to one loop"
            )
        return selection.with_nuisances(choose(candidates)), candidates
    found = selection.fit(known.structure, known.order)
    if found is None:
        raise IdentificationError(
            f"no {known.structure} model explains the record; leave the structure open to have "
            "it chosen"
        )
    found = selection.with_nuisances(found)
    return found, [found]


def _require_content(time: FloatArray, y: FloatArray, u: PiecewiseConstant) -> None:
    if y.size < _LEAST_SAMPLES:
        raise IdentificationError(
            f"the record holds {y.size} samples; a fit needs at least {_LEAST_SAMPLES}: "
            "record longer"
        )
    if not np.ptp(time) > 0.0:
        raise IdentificationError("all samples of the record have the same time")
    if not bool(np.any((u.times >= time[0]) & (u.times < time[-1]))):
        raise IdentificationError(
            "the command never changes within the record: nothing excites the process, "
            "so that no model can be told; record a relay test or a step"
        )
    if np.ptp(y) == 0.0:
        raise IdentificationError(
            f"the measurement is constant at {y[0]:g} although the command changes: check the "
            "sensor, the actuator and that both topics belong to one loop"
        )


def _require_response(problem: Problem, state: State) -> None:
    n, floor = problem.y.size, problem.y.size * _NEGLIGIBLE**2
    nuisance = state.columns[len(problem.structure.powers) :]
    constant = problem.y - problem.y.mean()
    left = constant - np.linalg.lstsq(nuisance.T, constant, rcond=None)[0] @ nuisance
    without = information_criterion(float(left @ left), n, nuisance.shape[0], floor)
    if not information_criterion(state.cost, n, state.parameters, floor) < without:
        raise IdentificationError(
            "the measurement shows no response to the command beyond its noise: raise the "
            "amplitude, or check that both topics belong to one loop"
        )


def _covariance(state: State, coloured: bool) -> FloatArray:
    """Return the covariance of all linear coefficients and theta, in this order."""
    n = state.residual.size
    jacobian = np.concatenate((state.columns, state.derivative))
    size = np.sqrt(np.einsum("pn,pn->p", jacobian, jacobian))
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv((jacobian @ jacobian.T) / np.outer(size, size), rcond=1e-15)
    inverse = inverse / np.outer(size, size)
    degrees = max(n - state.parameters, 1)
    if coloured:
        meat = covariance_meat(jacobian * state.residual, state.residual) * (n / degrees)
        covariance = inverse @ meat @ inverse
    else:
        covariance = inverse * (state.cost / degrees)
    return np.asarray(covariance)


def _report(
    record: Record, problem: Problem, state: State, scale: float, candidates: list[Candidate]
) -> Identification:
    n, structure = state.residual.size, problem.structure
    rms = scale * math.sqrt(state.cost / n)
    exact = state.cost <= n * _NEGLIGIBLE**2
    whiteness = math.nan if exact else ljung_box(state.residual)
    coloured = not math.isnan(whiteness) and whiteness < _WHITE
    reading = structure.read(state.theta, scale * state.coefficients)
    if reading is None:
        raise IdentificationError(
            f"the fit of a {structure.name} model left its structure; name another structure"
        )
    covariance = _covariance(state, coloured)
    # From linear coefficients and theta to the parameters of the field, to first order.
    gradient = _gradient(problem, state, scale)
    spread = scale * math.sqrt(float(np.mean((problem.y - problem.y.mean()) ** 2)))
    fitted = np.full(len(record), math.nan)
    used = np.searchsorted(record.time, problem.time)
    fitted[used] = record.measurement[used] - scale * state.residual
    fit = FitReport(
        residual_rms=rms,
        noise_std=record.noise_std,
        fit=1.0 - rms / spread if spread > 0.0 else math.nan,
        whiteness_p=whiteness,
        prediction=scale * _prediction(record, problem, state),
    )
    found = with_uncertainty(
        "waveform",
        reading.build,
        reading.parameters,
        reading.values,
        gradient @ covariance @ gradient.T,
        quantile=float(stdtrit(max(n - state.parameters, 1), 0.975)),
        fit=fit,
        warnings=_warnings(record, fit, coloured, scale, problem),
        fitted=fitted,
    )
    gain_std = found.ultimate_gain_std / abs(found.ultimate_gain)
    notes = (
        unequal_gains(record, found.model),
        disagreeing_point(record, found.model, gain_std),
    )
    found = replace(found, warnings=(*found.warnings, *(n for n in notes if n)))
    rivals = _rivals(candidates, problem, scale)
    stable = [r for r in rivals if r.model.is_stable and r.support > _OPEN]
    if found.model.integrators and stable:
        best = stable[0]
        told = (
            "whether the process integrates is not in the data: a stable "
            f"{best.model.structure} with gain {best.model.gain:.3g} has {100 * best.support:.0f} "
            "% of the support; a biased relay or a longer step would tell; K_u and w_u are "
            "determined all the same"
        )
        found = replace(found, warnings=(*found.warnings, told))
    return replace(found, rivals=rivals)


def _gradient(problem: Problem, state: State, scale: float) -> FloatArray:
    """Return d(parameters of the field)/d(linear coefficients, theta), shape (p, k + m)."""
    structure, k = problem.structure, state.coefficients.size
    point = np.concatenate((state.coefficients, state.theta))
    columns = []
    for i, value in enumerate(point):
        h = 1e-6 * (abs(value) or 1.0)
        # A logarithm near zero is a time near one second, not a small one.
        h = max(h, 1e-6) if k <= i < point.size - 1 else h
        ends = []
        for side in (h, -h):
            moved = point.copy()
            moved[i] += side
            reading = structure.read(moved[k:], scale * moved[:k], like=state.theta)
            assert reading is not None
            ends.append(reading.values)
        columns.append((ends[0] - ends[1]) / (2.0 * h))
    return np.stack(columns, axis=1)


def _rivals(candidates: list[Candidate], problem: Problem, scale: float) -> tuple[Rival, ...]:
    weights = support(candidates)
    chosen = problem.structure
    rivals = []
    for candidate, weight in zip(candidates, weights, strict=True):
        same = (candidate.structure.name, candidate.structure.order) == (chosen.name, chosen.order)
        if same or weight < _WORTH_TELLING:
            continue
        reading = candidate.structure.read(
            candidate.state.theta, scale * candidate.state.coefficients
        )
        if reading is not None:
            rivals.append(Rival(reading.build(reading.values), weight))
    return tuple(rivals)


def _prediction(record: Record, problem: Problem, state: State) -> float:
    """Return the error over the last cycle of the model that the samples before it give."""
    if len(record.cycle_start) < 3:
        return math.nan
    split = record.time[record.cycle_start[-2]]
    end = record.time[record.cycle_start[-1]]
    before = problem.part(problem.time < split)
    last = problem.part((problem.time >= split) & (problem.time < end))
    if before.y.size < 4 * state.parameters or last.y.size == 0:
        return math.nan
    if before.relaxation or before.drift or before.structure.unstable:
        # These are counted from the ends of the samples given.
        return math.nan
    earlier = refine(before, state.theta)
    error = last.y - earlier.coefficients @ evaluate(last, earlier.theta).columns
    return math.sqrt(float(np.mean(error**2)))


def _warnings(
    record: Record, fit: FitReport, coloured: bool, scale: float, problem: Problem
) -> tuple[str, ...]:
    found = []
    if coloured:
        found.append(
            f"the residual is not white (p = {fit.whiteness_p:.2g}): something is not in the "
            "model, such as a second input, another structure or a disturbance; the intervals "
            "are widened for it, but do not cover a wrong structure"
        )
    measured = fit.noise_std
    least = max(_UNEXPLAINED * measured, 1e-6 * scale) if math.isfinite(measured) else math.inf
    if fit.residual_rms > least:
        found.append(
            f"the residual ({fit.residual_rms:.3g} rms) is larger than the noise measured before "
            f"the test ({measured:.3g}): the model leaves part of the response unexplained"
        )
    if problem.drift:
        found.append("the measurement drifts beside the response; the drift was estimated")
    if record.lost_samples:
        found.append(f"{record.lost_samples} samples were lost on the way")
    return tuple(found)
