# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Separable least squares: linear coefficients by QR, the others by Levenberg and Marquardt.

Variable projection (Golub and Pereyra 1973) with Kaufman's approximation of the Jacobian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dgeqrf, dorgqr

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.problem import Problem
from relay_autotune.identification.waveform.rational import stepped, unit_steps

# A step that gains less than this share of the sum of squares changes no choice.
TRIAL = 1e-6
_MOST_ITERATIONS = 80
_MOST_ROUGH_ITERATIONS = 25
_LEAST_GAIN = 1e-15
_SMALLEST_STEP = 1e-14
_FIRST_DAMPING = 1e-3
_LITTLE_DAMPING = 0.1
# Useless trials in a row that end a rough fit: it stands at a kink, as a dead time makes.
_PATIENCE = 10
_LEAST_DAMPING = 1e-12
_MOST_DAMPING = 1e12
_GROWTH = 4.0
# Longest lag in lengths of the record: a slower one is an integrator to a thousandth.
_LONGEST = 1e3
_WEAK = 1e-11


@dataclass(frozen=True)
class Trial:
    """A trial theta with everything that follows from it.

    :param theta: shape (m,).
    :param coefficients: the best linear coefficients, shape (k,).
    :param residual: weighted and whitened, shape (n,).
    :param cost: its sum of squares.
    :param basis: orthonormal columns of the linear part, shape (n, k).
    :param derivative: of the model by theta, weighted, shape (m, n).
    :param columns: of the linear part, weighted, shape (k, n).
    :param damping: Marquardt's damping at the end of a fit.
    """

    theta: FloatArray
    coefficients: FloatArray
    residual: FloatArray
    cost: float
    basis: FloatArray
    derivative: FloatArray
    columns: FloatArray
    damping: float = _FIRST_DAMPING

    @property
    def parameters(self) -> int:
        """Number of estimated parameters, the linear ones included."""
        return int(self.theta.size + self.coefficients.size)


def evaluate(problem: Problem, theta: FloatArray) -> Trial:
    """Return the fit of the linear coefficients for one theta.

    :param problem: the problem.
    :param theta: shape (m,).
    """
    columns, derivatives = problem.with_slopes(theta)
    y, columns = problem.y_seen, problem.seen(columns)
    size = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    size[size == 0.0] = 1.0
    # As numpy.linalg.qr, which takes twice as long for its copies.
    factored, reflectors, *_ = dgeqrf((columns / size[:, None]).T, overwrite_a=True)
    least = min(factored.shape)
    r = factored[:least].tolist()
    q = dorgqr(factored[:, :least], reflectors)[0]
    coefficients = _back_substituted(r, (q.T @ y).tolist()) / size
    residual = y - coefficients @ columns
    derivative = problem.seen(
        np.einsum("k,mkn->mn", coefficients[: derivatives.shape[1]], derivatives)
    )
    cost = float(residual @ residual)
    return Trial(theta, coefficients, residual, cost, q, derivative, columns)


def residual_of(y: FloatArray, rows: FloatArray) -> FloatArray:
    """Return what the best combinations of some rows leave of one or several others.

    :param y: shape (..., n).
    :param rows: such as offset and drift, shape (k, n).
    """
    factors = np.linalg.lstsq(rows.T, y.T, rcond=None)[0]
    return np.asarray(y - factors.T @ rows)


def residual_of_model(problem: Problem, gain: FloatArray, theta: FloatArray) -> FloatArray:
    """Return what a model leaves, as seen, once all beside it is fitted, shape (n,).

    :param problem: the samples.
    :param gain: coefficients of the numerator, shape (k,).
    :param theta: shape (m,).
    """
    columns = problem.columns(theta)
    left = problem.y - gain @ columns[: gain.size]
    first, *beside = problem.seen(np.concatenate((left[None, :], columns[gain.size :])))
    return residual_of(first, np.array(beside))


def rms_in_simulation(
    problem: Problem, coefficients: FloatArray, theta: FloatArray
) -> tuple[float, float]:
    """Return the rms of both results of :func:`errors_in_simulation`."""
    left, total = errors_in_simulation(problem, coefficients, theta)
    return math.sqrt(float(np.mean(left**2))), math.sqrt(float(np.mean(total**2)))


def errors_in_simulation(
    problem: Problem, coefficients: FloatArray, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what a model leaves in simulation, and what it is to explain, shapes (n,).

    All beside the model is fitted anew; the model keeps its own coefficients.

    :param problem: may hold other samples than those that the model was fitted to.
    :param coefficients: of the model, those of the numerator first.
    :param theta: of the model, shape (m,).
    """
    problem = replace(problem, colour=None)
    left = residual_of_model(problem, coefficients[: len(problem.structure.powers)], theta)
    return left, residual_of(problem.y_seen, problem.nuisances(theta))


def _back_substituted(r: list[list[float]], right: list[float]) -> FloatArray:
    """Solve ``r c = right`` for an upper triangle r of a few columns, each of length one.

    What is below the diagonal is not read. The coefficient of a column that depends on the others
    stays zero. So do those of columns beyond the number of samples, where r has fewer rows than
    columns.
    """
    # For a few columns plain numbers are quicker than arrays.
    found = [0.0] * len(r[0])
    for i in range(len(right) - 1, -1, -1):
        if abs(r[i][i]) >= _WEAK:
            rest = sum(a * c for a, c in zip(r[i][i + 1 :], found[i + 1 :], strict=True))
            found[i] = (right[i] - rest) / r[i][i]
    return np.array(found)


def refine(
    problem: Problem,
    start: FloatArray | Trial,
    *,
    tolerance: float = _LEAST_GAIN,
    most: int = _MOST_ITERATIONS,
    damping: float = _FIRST_DAMPING,
) -> Trial:
    """Return the least sum of squares near a theta.

    :param problem: the problem.
    :param start: theta, shape (m,), or an earlier fit to the same problem, which goes on.
    :param tolerance: relative gain below which a step is the last one; by default, rounding.
    :param most: largest number of steps that are tried.
    :param damping: Marquardt's damping at the start.
    """
    if isinstance(start, Trial):
        state, damping = start, start.damping
    else:
        state = evaluate(problem, np.append(start[:-1], min(start[-1], problem.latest)))
    growth = _GROWTH
    longest = _LONGEST * float(np.ptp(problem.time))
    # A rough answer must not take as many trials as an exact one.
    rough = tolerance > _LEAST_GAIN
    idle = 0
    scale, normal, gradient = _linearised(problem, state)
    for _ in range(min(most, _MOST_ROUGH_ITERATIONS) if rough else most):
        step = _solve(normal, gradient, damping)
        low, high = (np.array((0.0, problem.latest)) - state.theta[-1]) / scale[-1]
        last = min(max(step[-1], low), high)
        if step[-1] != last:
            # The dead time stops at a bound, and the other steps are solved with it fixed there.
            rest = gradient[:-1] - normal[:-1, -1] * last
            step = np.append(_solve(normal[:-1, :-1], rest, damping), last)
        predicted = float(step @ (2.0 * gradient - normal @ step))
        if rough and predicted <= tolerance * state.cost and damping <= _LITTLE_DAMPING:
            break
        moved = stepped(problem.structure, state.theta, step, longest, problem.shortest)
        trial = evaluate(problem, moved)
        smallest = float(np.abs(step).max()) < _SMALLEST_STEP
        idle = 0 if state.cost - trial.cost > tolerance * state.cost else idle + 1
        if rough and idle == _PATIENCE:
            state = min(state, trial, key=lambda s: s.cost)
            break
        if not trial.cost < state.cost:
            damping *= growth
            growth *= 2.0
            # Not even the undamped step promises a gain above the tolerance.
            undamped = float(gradient @ _solve(normal, gradient, 0.0))
            if undamped <= tolerance * state.cost or damping > _MOST_DAMPING or smallest:
                break
            continue
        gained = state.cost - trial.cost
        # The damping follows the ratio of the actual gain to the predicted one (Nielsen 1999).
        # From a ratio of 1 on it is the least one.
        ratio = gained / predicted if predicted > gained else 1.0
        factor = 1.0 - (2.0 * ratio - 1.0) ** 3 if predicted > 0.0 else 1.0
        damping = max(damping * min(max(factor, 0.1), 2.0), _LEAST_DAMPING)
        growth = _GROWTH
        state = trial
        # A small gain ends the fit only where it was not the damping that made the step small.
        if smallest or (gained <= tolerance * state.cost and damping <= _LITTLE_DAMPING):
            break
        scale, normal, gradient = _linearised(problem, state)
    return replace(state, damping=damping)


def predicted_cost(problem: Problem, state: Trial) -> float:
    """Return what the sum of squares would become if the model were linear in theta.

    :param problem: the problem.
    :param state: any of its states.
    """
    _, normal, gradient = _linearised(problem, state)
    return state.cost - float(gradient @ _solve(normal, gradient, 0.0))


def _linearised(problem: Problem, state: Trial) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the units of steps, and the normal equations' matrix and right side in them."""
    scale = unit_steps(problem.structure, state.theta, problem.shortest)
    jacobian = state.derivative * scale[:, None]
    jacobian = jacobian - (jacobian @ state.basis) @ state.basis.T
    return scale, jacobian @ jacobian.T, jacobian @ state.residual


def _solve(normal: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    """Solve the normal equations, each direction in its own units, with Marquardt's damping."""
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal / size[:, None] / size
    scaled.flat[:: size.size + 1] += damping
    try:
        step = np.linalg.solve(scaled, gradient / size)
    except np.linalg.LinAlgError:
        # Singular: there is no damping, and the data do not tell some directions apart.
        step = np.linalg.lstsq(scaled, gradient / size, rcond=None)[0]
    return np.asarray(step / size)


def information_criterion(
    cost: float,
    samples: int,
    parameters: int,
    floor: float,
) -> float:
    """Return the Bayesian information criterion, ``n log(cost/samples) + p log n``.

    :param cost: sum of squared residuals.
    :param samples: number of samples.
    :param parameters: p, number of estimated parameters.
    :param floor: sum of squares that is rounding: smaller ones count as equal to it.
    """
    likely = samples * math.log(max(cost, floor) / samples)
    return likely + parameters * math.log(max(samples, 3.0))
