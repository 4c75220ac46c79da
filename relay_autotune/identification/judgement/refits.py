# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Other fits of a record, on whose models gains have to hold: of its halves, and plain ones.

A part of a record determines some combinations of the parameters and not others. So its models
are drawn from a posterior (Gauss-Newton steps, then Laplace's approximation). The prior is the
whole record's model, each time known to a factor of e; the data are the samples of the part. A
part that determines nothing gives models all around that of the whole, and contradicts nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.fit_covariance import (
    Fit,
    Noise,
    estimate_of,
)
from relay_autotune.identification.waveform.rational import theta_of, unit_steps
from relay_autotune.identification.waveform.residuals import worth
from relay_autotune.identification.waveform.separable import (
    NEGLIGIBLE,
    Problem,
    Trial,
    evaluate,
    information_criterion,
    left_beside,
    problem_of,
    refine,
)
from relay_autotune.identification.waveform.starts import (
    Starts,
    is_unseen,
    refine_best,
    start_fopdt,
)
from relay_autotune.process.structures import FOPDT, SOPDT, GivenModel, Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record

_TRIAL = 1e-6
_HALF_STEPS = 15
# Mean square of two standardised deviations that 99 % of equal halves do not exceed.
_BY_CHANCE = 4.6
# Largest standard deviation of its response's logarithm with which a half gives a model.
_TOLD = 0.5
_STEP = 1e-5
_FEWEST = 24


@dataclass(frozen=True)
class Halves:
    """Comparison of the two halves of a record.

    :param apart: mean square of the difference of their responses, relative to its covariance.
    :param models: of those halves that determine one.
    """

    apart: float
    models: tuple[TransferFunction, ...]

    @property
    def agree(self) -> bool:
        """True if they differ by no more than chance."""
        return self.apart <= _BY_CHANCE


def parted(problem: Problem, state: Trial) -> tuple[Problem, Problem] | None:
    """Split a record into halves of equal information on the model's parameters.

    :param problem: of one or several experiments.
    :param state: its fit.
    :return: None for several experiments, or for too few samples.
    """
    if len(problem.bounds) > 1:
        return None
    jacobian = np.concatenate((state.columns[: len(problem.structure.powers)], state.derivative))
    size = np.einsum("pn,pn->p", jacobian, jacobian)
    size[size == 0.0] = 1.0
    told = np.cumsum(np.sum(jacobian**2 / size[:, None], axis=0))
    middle = int(np.searchsorted(told, 0.5 * told[-1]))
    if min(middle, problem.time.size - middle) < max(_FEWEST, 4 * state.parameters):
        return None
    return problem.part(slice(None, middle)), problem.part(slice(middle, None))


def halves_of(fit: Fit, frequency: float) -> Halves | None:
    """Fit the chosen structure to either half of a record, and compare the responses.

    Both halves hold equal information on the model. With d the difference of the logarithms of
    their responses at one frequency, as real and imaginary part, and C its covariance, the mean
    square is ``d' C^-1 d/2``. It is 1 on average for one process under noise of this colour.

    :param fit: in colour, of one experiment.
    :param frequency: at which the responses are compared [rad/s].
    :return: None: it cannot be split, or a half gives no covariance.
    """
    parts = parted(fit.problem, fit.state)
    if parts is None:
        return None
    found: list[tuple[Estimate, complex, FloatArray]] = []
    evidence = 0.0
    for half in parts:
        own = refine(half, fit.state.theta, tolerance=_TRIAL, most=_HALF_STEPS)
        evidence += _evidence(half, own, fit.state)
        estimate = estimate_of(half, own, fit, Noise(False))
        if estimate is None or not estimate.known:
            return None
        found.append((estimate, *_response(estimate, frequency)))
    (first, at_first, of_first), (second, at_second, of_second) = found
    difference = np.log(at_first / at_second)
    apart = np.array([difference.real, difference.imag])
    covariance = of_first + of_second
    if not bool(np.all(np.isfinite(covariance))):
        return None
    square = 0.5 * float(apart @ np.linalg.pinv(covariance, hermitian=True) @ apart)
    # Where a half determines little, its fit may end far away, at a covariance that holds there
    # alone. No difference is more certain than that the halves differ at all.
    square = min(square, 0.5 * evidence)
    models = tuple(
        estimate.model
        for estimate, own in ((first, of_first), (second, of_second))
        if math.sqrt(float(np.trace(own))) <= _TOLD
    )
    return Halves(square, models)


def _evidence(half: Problem, own: Trial, whole: Trial) -> float:
    """Return twice the logarithm of the likelihood ratio of a half's fit and the whole's.

    :param half: the samples of the half.
    :param own: their fit.
    :param whole: the fit to all samples; the half has an offset, drift and past of its own.
    """
    left, _ = left_beside(half, whole)
    return half.time.size * math.log(max(float(left @ left) / max(own.cost, 1e-300), 1.0))


def _response(estimate: Estimate, frequency: float) -> tuple[complex, FloatArray]:
    """Return the response at a frequency, and the covariance of its logarithm, shape (2, 2)."""
    s, build = 1j * frequency, estimate.structure.build
    at = complex(estimate.model(s))
    slopes = np.zeros((2, estimate.values.size))
    for i, value in enumerate(estimate.values):
        moved = estimate.values.copy()
        step = _STEP * (abs(value) or 1.0 / frequency)
        moved[i] += step
        change = complex(np.log(build(moved)(s) / at)) / step
        slopes[:, i] = change.real, change.imag
    root = estimate.root
    spread = slopes @ estimate.covariance @ slopes.T
    if root is not None:
        spread = (slopes @ root) @ (slopes @ root).T
    return at, np.asarray(spread)


_MOST_SAMPLES = 1200
_STEPS, _HALVINGS, _SETTLED = 10, 4, 1e-3
# Standard deviations of the prior: of logarithms of times, of a gain relative to its value, of a
# dead time relative to all times together.
_TIMES, _GAIN, _DEAD_TIME = 1.0, 2.0, 1.0
_DRAWS = 40
_FARTHEST = 20.0
# Ratio of two sums of squares up to which they count as equal.
_AS_WELL = 1.1
# Excess of the criterion up to which a model is as good: odds of e^3.
_AS_GOOD = 6.0


@dataclass(frozen=True)
class Part:
    """The models that a part of a record allows.

    :param begin: its first time [s].
    :param end: its last time [s].
    :param models: drawn from their posterior.
    :param worse: residual that the best of them leaves of the whole record, over the least one.
    """

    begin: float
    end: float
    models: tuple[TransferFunction, ...]
    worse: float = 1.0

    @property
    def span(self) -> str:
        """Its times as text."""
        return f"{self.begin:.4g} s to {self.end:.4g} s"


def halves(found: Identification, record: Record) -> tuple[Part, ...]:
    """Return the models that each half of a record allows in the chosen structure.

    The halves hold equal information on the parameters. Each has its own offset and free initial
    state; the first half has no free state where the record began at rest.

    :param found: a fit to the samples.
    :param record: what was fitted.
    :return: empty where no half can be fitted, or the process grows by itself.
    """
    structure = found.estimate.structure
    if isinstance(structure, GivenModel) or structure.unstable:
        return ()
    problem = _problem(found, record, structure)
    theta = theta_of(structure, found.values)
    whole = evaluate(problem, theta)
    halved = parted(problem, whole)
    if halved is None:
        return ()
    scale = float(np.ptp(record.measurement))
    gain = whole.coefficients[: len(structure.powers)]
    parts = []
    for part in (halved[0], _with_free_state(halved[1])):
        best, models = _allowed(part, gain, theta, scale)
        if models:
            left, _ = _linearised(problem, best, gain.size)
            worse = math.sqrt(float(left @ left) / max(whole.cost, 1e-300))
            parts.append(Part(float(part.time[0]), float(part.time[-1]), models, worse))
    return tuple(parts)


def _problem(found: Identification, record: Record, structure: Structure) -> Problem:
    """Return the samples that were fitted, thinned, with terms for their unknown beginning."""
    y = (record.measurement - record.measurement[0]) / float(np.ptp(record.measurement))
    problem = problem_of([(record.time, y, record.drive())], structure)
    problem = problem.part(np.isfinite(found.fitted)).thinned(_MOST_SAMPLES)
    # The free state of an integrator is the offset; a command off its balance is a drift.
    problem = replace(problem, drift=structure.integrators > 0)
    return problem if _begins_at_rest(problem, found, record) else _with_free_state(problem)


def _with_free_state(problem: Problem) -> Problem:
    return replace(problem, relaxation=bool(problem.structure.factors))


def _begins_at_rest(problem: Problem, found: Identification, record: Record) -> bool:
    """Return whether the model that was found explains the samples from rest as well."""
    own = found.estimate.structure
    if isinstance(own, GivenModel) or own.unstable:
        return False
    left = (record.measurement - found.fitted)[problem.index] / float(np.ptp(record.measurement))
    rested = replace(problem, structure=own, drift=own.integrators > 0)
    from_rest = evaluate(rested, theta_of(own, found.values)).cost
    return from_rest <= _AS_WELL * max(float(left @ left), left.size * NEGLIGIBLE**2)


def _allowed(
    problem: Problem, gain: FloatArray, theta: FloatArray, scale: float
) -> tuple[FloatArray, tuple[TransferFunction, ...]]:
    """Return the best point, and models drawn from the posterior that some samples give.

    :param problem: the samples.
    :param gain: coefficients of the known model's numerator, shape (k,).
    :param theta: of the known model, shape (m,).
    :param scale: of the measurement in the problem [y].
    """
    structure = problem.structure
    known = np.concatenate((gain, theta))
    units = unit_steps(structure, theta)
    slow = float(units[-1])
    weak = _GAIN * np.abs(gain[0]) * slow ** np.arange(gain.size)
    deviation = np.concatenate((weak, np.full(theta.size - 1, _TIMES), [_DEAD_TIME * slow]))
    if not np.all(deviation > 0.0):
        return known, ()
    precision = 1.0 / deviation**2
    at = known
    left, jacobian = _linearised(problem, at, gain.size)
    variance = max(float(left @ left) / left.size, NEGLIGIBLE**2)
    cost = float(left @ left) / variance
    for _ in range(_STEPS):
        normal = jacobian @ jacobian.T / variance + np.diag(precision)
        step = np.linalg.solve(normal, jacobian @ left / variance - precision * (at - known))
        for _ in range(_HALVINGS):
            trial = _bounded(at + step)
            new, slopes = _linearised(problem, trial, gain.size)
            away = precision @ (trial - known) ** 2
            now = float(new @ new) / variance + float(away)
            if now < cost:
                break
            step = 0.5 * step
        else:
            break
        gained, at, left, jacobian = cost - now, trial, new, slopes
        # Noise of this part; correlated samples count less.
        variance = max(float(left @ left) / left.size / worth(left), NEGLIGIBLE**2)
        cost = float(left @ left) / variance + float(precision @ (at - known) ** 2)
        if gained < _SETTLED * cost:
            break
    normal = jacobian @ jacobian.T / variance + np.diag(precision)
    # In units of the prior, so that the root has no small numbers.
    root = np.linalg.cholesky(np.linalg.inv(normal * np.outer(deviation, deviation)))
    shifts = np.random.default_rng(0).standard_normal((_DRAWS, at.size))
    models = []
    for shift in np.concatenate((np.zeros((1, at.size)), shifts)):
        drawn = _bounded(at + deviation * (root @ shift))
        try:
            model = structure.model_at(drawn[gain.size :], scale * drawn[: gain.size])
        except ModelError:
            model = None
        if model is not None:
            models.append(model)
    return at, tuple(models)


def _bounded(point: FloatArray) -> FloatArray:
    """Return a point with a dead time that is not negative, and finite times."""
    point = np.clip(point, -1e12, 1e12)
    point[-1] = max(float(point[-1]), 0.0)
    return point


def _linearised(problem: Problem, point: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return a model's residual and its derivatives, both after the fit of the nuisances.

    :param problem: the samples.
    :param point: coefficients of the numerator, then theta.
    :param count: of these coefficients.
    :return: shapes (n,) and (p, n).
    """
    gain = point[:count]
    theta = np.concatenate((np.clip(point[count:-1], -_FARTHEST, _FARTHEST), point[-1:]))
    columns, derivatives = problem.columns(theta)
    own, beside = columns[:count], columns[count:]
    basis, _ = np.linalg.qr(beside.T)
    by_theta = np.einsum("k,mkn->mn", gain, derivatives[:, :count])
    rows = np.concatenate(((problem.y - gain @ own)[None, :], own, by_theta))
    rows = rows - (rows @ basis) @ basis.T
    return rows[0], rows[1:]


def plain_models(found: Identification, record: Record) -> tuple[TransferFunction, ...]:
    """Return the plain models that explain a record as well as the one that was chosen.

    They are a lag and two lags with dead time, fitted to all samples by simulation with an unknown
    offset and initial state. Correlated samples count less: in coloured noise, or where no
    structure is true, only a visible difference decides.

    :param found: a fit to the samples.
    :param record: what was fitted.
    """
    every = _problem(found, record, FOPDT)
    scale = float(np.ptp(record.measurement))
    left = (record.measurement - found.fitted)[every.index] / scale
    if left.size < _FEWEST:
        return ()
    n, each = left.size, worth(left)
    floor = n * NEGLIGIBLE**2
    own = information_criterion(float(left @ left), n, len(found.parameters) + 1, floor, each)
    first = refine_best(every, start_fopdt(every), tolerance=_TRIAL)
    second = replace(every, structure=SOPDT)
    fits = [(every, first)]
    if found.structure not in (FOPDT.name, SOPDT.name):
        fits.append((second, refine_best(second, Starts(every, first).sopdt(), tolerance=_TRIAL)))
    models = []
    for problem, state in fits:
        # The unknown state before the record is not counted as a parameter.
        parameters = len(problem.structure.names) + 1
        other = information_criterion(state.cost, n, parameters, floor, each)
        model = problem.structure.model_at(state.theta, state.coefficients * scale)
        if model is None or other > own + _AS_GOOD:
            continue
        interval = record.mean_interval
        if not is_unseen(model, interval, record.duration):
            models.append(model)
    return tuple(models)


def other_sign(models: Sequence[TransferFunction], sign: int) -> float:
    """Return the share of models whose process does not have this sign.

    :param models: at least one.
    :param sign: 1 or -1.
    """
    return sum(m.process_sign != sign for m in models) / len(models)
