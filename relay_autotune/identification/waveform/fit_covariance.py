# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A waveform fit, and the covariance of its parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.estimate import Estimate, jacobian, relative_steps
from relay_autotune.identification.waveform.candidates import Candidate
from relay_autotune.identification.waveform.problem import NEGLIGIBLE, Problem
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.residuals import (
    mean_slope,
    scale_of,
    weights,
)
from relay_autotune.identification.waveform.separable import Trial
from relay_autotune.record.record import Record

# Standard deviation of the prior of a dead time, over all times of the process together.
_DEAD_TIME = 0.5
_EPSILON = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Fit:
    """A fit with all that it came from.

    :param problem: what was fitted.
    :param state: the fit.
    :param candidates: all structures tried, the best first.
    :param scale: range of the measurement, in which the problem counts [y].
    :param base: the samples' weights without those of the loss, shape (n,); None: the weights
        themselves.
    :param loss: the loss that was minimised.
    :param warnings: sentences on what was left out.
    :param plain: fits the FOPDT beside the same terms to the end; None: there is none.
    :param opposed: returns how well models of the other direction explain the record, 0 to 1;
        None: the direction is known.
    """

    problem: Problem
    state: Trial
    candidates: tuple[Candidate, ...]
    scale: float
    base: FloatArray | None = None
    loss: str = "squares"
    warnings: tuple[str, ...] = ()
    plain: Callable[[], Fit | None] | None = None
    opposed: Callable[[], float] | None = None


def raw_residual(problem: Problem, state: Trial) -> FloatArray:
    """Return the residual of a fit, neither weighted nor whitened, shape (n,)."""
    columns = problem.columns(state.theta)
    return np.asarray(problem.y - state.coefficients @ columns)


def coarse_step(records: Sequence[Record], rms: float) -> float:
    """Return the largest step of a sensor that exceeds the residual [y]; 0: none does.

    :param records: what was fitted.
    :param rms: of the residual [y].
    """
    step = max(quantisation_step(r.measurement) for r in records)
    return step if rms < step else 0.0


def noise_inflation(records: Sequence[Record], rms: float, fit: Fit) -> float:
    """Return the ratio of the covariance to that of white noise of the residual's size.

    Rounding errors stay alike until the next level is crossed: each held level counts as one
    sample with the variance of a rounding, however many samples it lasts. A colour includes that.

    :param records: what was fitted.
    :param rms: of the residual [y].
    :param fit: their fit.
    """
    step = coarse_step(records, rms)
    if step == 0.0 or fit.problem.colour is not None:
        return 1.0
    held = sum(1 + int(np.count_nonzero(np.diff(r.measurement))) for r in records)
    samples = sum(len(r) for r in records)
    larger = max(step**2 / 12.0 / rms**2, 1.0) if rms > 0.0 else 1.0
    return larger * samples / held


def estimate_of(
    problem: Problem, state: Trial, fit: Fit, inflation: float = 1.0
) -> Estimate | None:
    """Return the structure's parameters with their covariance to first order.

    A dead time is known to half of all times of the process together: without samples before the
    response, gain and dead time cannot be distinguished at all.

    :param problem: what was fitted.
    :param state: its fit.
    :param fit: for its scale and loss.
    :param inflation: ratio of the covariance to that of white noise of the residual's size.
    :return: None if the fit left its structure.
    """
    read = problem.structure.read(state.theta, fit.scale * state.coefficients)
    if read is None:
        return None
    gradient = _gradient(problem, state, fit.scale)
    with np.errstate(over="ignore", invalid="ignore"):
        root = gradient @ _root(problem, state, fit, inflation)
    return Estimate.of_root(*read, root)


def _root(problem: Problem, state: Trial, fit: Fit, inflation: float) -> FloatArray:
    """Return B of the covariance B B' of all linear coefficients and theta, in this order.

    For least squares that is ``s^2 (J'J)^-1``. For a robust loss r is the loss's derivative, over
    the mean of its second one (Huber 1981). With J = Q R, R is inverted: J'J would lose half of
    the digits where two parameters can hardly be distinguished.
    """
    n = state.residual.size
    jacobian, scores, slope = _scores(problem, state, fit)
    slow = unit_steps(problem.structure, state.theta)[-1]
    prior = np.zeros((jacobian.shape[0], 1))
    prior[-1] = math.sqrt(float(scores @ scores) / n) / (_DEAD_TIME * slow)
    jacobian, scores = np.append(jacobian, prior, axis=1), np.append(scores, 0.0)
    size = np.sqrt(np.einsum("pn,pn->p", jacobian, jacobian))
    size[size == 0.0] = 1.0
    r = np.linalg.qr((jacobian / size[:, None]).T, mode="r")
    left, singular, right = np.linalg.svd(r, full_matrices=False)
    # A direction whose effect is below rounding counts as uncertain, not as exact.
    singular = np.maximum(singular, _EPSILON * n * singular[0])
    inverse = (right.T / singular) @ left.T / size[:, None]
    degrees = max(n - state.parameters, 1)
    variance = float(scores @ scores) / degrees * inflation
    return np.asarray(inverse * math.sqrt(variance) / slope)


def _scores(problem: Problem, state: Trial, fit: Fit) -> tuple[FloatArray, FloatArray, float]:
    """Return Jacobian, derivative of the loss at each sample, and mean of its second one."""
    if fit.loss == "squares" or fit.base is None:
        return np.concatenate((state.columns, state.derivative)), state.residual, 1.0
    columns, derivatives = problem.with_slopes(state.theta)
    derivative = np.einsum("k,mkn->mn", state.coefficients[: derivatives.shape[1]], derivatives)
    residual = fit.base * (problem.y - state.coefficients @ columns)
    scale = max(scale_of(residual), NEGLIGIBLE)
    scores = weights(residual, scale, fit.loss) * residual
    jacobian = fit.base * np.concatenate((columns, derivative))
    return jacobian, scores, max(mean_slope(residual, scale, fit.loss), 0.1)


def _gradient(problem: Problem, state: Trial, scale: float) -> FloatArray:
    """Return d(structure's parameters)/d(linear coefficients, theta), shape (p, k + m)."""
    structure, k = problem.structure, state.coefficients.size

    def values(point: FloatArray) -> FloatArray:
        read = structure.read(point[k:], scale * point[:k], like=state.theta)
        assert read is not None
        return read[1]

    point = np.concatenate((state.coefficients, state.theta))
    numbers = np.arange(point.size)
    logarithms = (k <= numbers) & (numbers < point.size - 1)
    return jacobian(values, point, relative_steps(point, logarithms))


# Least number of samples for each value, on average: values on a grid repeat.
_TIMES_EACH = 3.0
_ROUNDED = 1e-3


def quantisation_step(measurement: FloatArray) -> float:
    """Return the step of the grid on which all values lie; 0 if there is none.

    :param measurement: the samples [y], shape (n,).
    """
    levels = np.unique(measurement)
    if levels.size < 2 or _TIMES_EACH * levels.size > measurement.size:
        return 0.0
    gaps = np.diff(levels)
    # Decimal numbers are on their grid to rounding only.
    rounding = 1e-9 * float(np.abs(levels).max())
    gaps = gaps[gaps > rounding]
    if gaps.size == 0:
        return 0.0
    step = float(gaps.min())
    multiples = gaps / step
    on_grid = np.abs(multiples - np.round(multiples)) <= _ROUNDED + rounding / step
    return step if bool(np.all(on_grid)) else 0.0
