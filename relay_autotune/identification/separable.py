"""Separable least squares: linear coefficients by QR, the others by Levenberg and Marquardt.

Variable projection (Golub and Pereyra 1973) with Kaufman's approximation of the Jacobian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from relay_autotune.identification.structures import RationalStructure
from relay_autotune.record import PiecewiseConstant

FloatArray = NDArray[np.float64]

_MOST_ITERATIONS = 80
_MOST_ROUGH_ITERATIONS = 25
_LEAST_GAIN = 1e-15
_SMALLEST_STEP = 1e-14
_FIRST_DAMPING = 1e-3
_LITTLE_DAMPING = 0.1
_LEAST_DAMPING = 1e-12
_MOST_DAMPING = 1e12
_GROWTH = 4.0
_WEAK = 1e-13


@dataclass(frozen=True)
class Problem:
    """Samples, input and structure, with the terms that are estimated beside the model.

    :param time: sample times, not decreasing [s], shape (n,).
    :param y: what is fitted, in units of its own range, shape (n,).
    :param u: the input.
    :param structure: the structure.
    :param drift: True: a straight line is estimated, not only an offset.
    :param relaxation: True: a free initial state is estimated.
    """

    time: FloatArray
    y: FloatArray
    u: PiecewiseConstant
    structure: RationalStructure
    drift: bool = False
    relaxation: bool = False

    def columns(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the linear coefficients' columns and the derivatives of those that have some.

        :param theta: shape (m,).
        :return: shapes (k, n) and (m, l, n); the k - l columns that theta does not change come
            last.
        """
        columns, derivatives = self.structure.columns(theta, self.time, self.u)
        rows = [columns]
        if self.relaxation or self.structure.unstable:
            state, by_theta = self.structure.relaxation(
                theta, self.time, growing_only=not self.relaxation
            )
            rows.append(state)
            derivatives = np.concatenate((derivatives, by_theta), axis=1)
        rows.append(np.ones((1, self.time.size)))
        if self.drift:
            rows.append(((self.time - self.time.mean()) / np.ptp(self.time))[None, :])
        return np.concatenate(rows), derivatives

    def part(self, chosen: NDArray[np.bool_] | slice) -> Problem:
        """Return the problem of some of the samples."""
        return replace(self, time=self.time[chosen], y=self.y[chosen])


@dataclass(frozen=True)
class State:
    """A trial theta with everything that follows from it.

    :param theta: shape (m,).
    :param coefficients: the best linear coefficients, shape (k,).
    :param residual: what is left, shape (n,).
    :param cost: its sum of squares.
    :param basis: orthonormal columns of the linear part, shape (n, k).
    :param derivative: of the model by theta, shape (m, n).
    :param columns: of the linear part, shape (k, n).
    :param damping: Marquardt's, where a fit ended.
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
        """Number of all that was estimated."""
        return int(self.theta.size + self.coefficients.size)


def evaluate(problem: Problem, theta: FloatArray) -> State:
    """Return the best linear coefficients for one theta, and what they leave.

    :param problem: the problem.
    :param theta: shape (m,).
    """
    columns, derivatives = problem.columns(theta)
    size = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    size[size == 0.0] = 1.0
    q, r = np.linalg.qr((columns / size[:, None]).T)
    # A column that the others make up carries no information: its coefficient stays zero.
    weak = np.abs(np.diag(r)) < _WEAK
    r[np.diag_indices_from(r)] += weak
    projection = q.T @ problem.y
    coefficients = np.linalg.solve(r, np.where(weak, 0.0, projection)) / size
    residual = problem.y - coefficients @ columns
    derivative = np.einsum("k,mkn->mn", coefficients[: derivatives.shape[1]], derivatives)
    cost = float(residual @ residual)
    return State(theta, coefficients, residual, cost, q, derivative, columns)


def refine(
    problem: Problem,
    theta: FloatArray,
    *,
    tolerance: float = _LEAST_GAIN,
    most: int = _MOST_ITERATIONS,
    damping: float = _FIRST_DAMPING,
) -> State:
    """Return the least sum of squares near a theta.

    :param problem: the problem.
    :param theta: where to begin, shape (m,).
    :param tolerance: relative gain of a step that is not worth another one; by default, rounding.
    :param most: steps that are tried at most.
    :param damping: Marquardt's, at the start; that of an earlier fit lets it go on.
    """
    state = evaluate(problem, theta)
    growth = _GROWTH
    # A rough answer must not take as many trials as an exact one.
    rough = tolerance > _LEAST_GAIN
    for _ in range(min(most, _MOST_ROUGH_ITERATIONS) if rough else most):
        scale = problem.structure.scale(state.theta)
        jacobian = state.derivative * scale[:, None]
        jacobian = jacobian - (jacobian @ state.basis) @ state.basis.T
        normal = jacobian @ jacobian.T
        gradient = jacobian @ state.residual
        step = _solve(normal, gradient, damping)
        least = -float(state.theta[-1] / scale[-1])
        if step[-1] < least:
            # The dead time stops at zero, and the others go where that leaves them to go.
            rest = gradient[:-1] - normal[:-1, -1] * least
            step = np.append(_solve(normal[:-1, :-1], rest, damping), least)
        predicted = float(step @ (2.0 * gradient - normal @ step))
        if rough and predicted <= tolerance * state.cost and damping <= _LITTLE_DAMPING:
            break
        trial = evaluate(problem, problem.structure.move(state.theta, step))
        smallest = float(np.abs(step).max()) < _SMALLEST_STEP
        if not trial.cost < state.cost:
            damping *= growth
            growth *= 2.0
            # Where even the undamped step promises less than rounding, no other will be seen.
            promised = float(gradient @ _solve(normal, gradient, 0.0))
            if promised <= tolerance * state.cost or damping > _MOST_DAMPING or smallest:
                break
            continue
        gained = state.cost - trial.cost
        # By how well the linear model foretold the gain (Nielsen 1999).
        factor = 1.0 - (2.0 * gained / predicted - 1.0) ** 3 if predicted > 0.0 else 1.0
        damping = max(damping * min(max(factor, 0.1), 2.0), _LEAST_DAMPING)
        growth = _GROWTH
        state = trial
        # A step that damping made small gains little wherever it begins.
        if smallest or (gained <= tolerance * state.cost and damping <= _LITTLE_DAMPING):
            break
    return replace(state, damping=damping)


def _solve(normal: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    """Solve the normal equations, each direction in its own units, with Marquardt's damping."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / size[:, None] / size
    scaled[np.diag_indices_from(scaled)] += damping
    try:
        step = np.linalg.solve(scaled, gradient / size)
    except np.linalg.LinAlgError:
        # Without damping, directions that the data do not tell apart.
        step = np.linalg.lstsq(scaled, gradient / size, rcond=None)[0]
    return np.asarray(step / size)


def information_criterion(cost: float, samples: int, parameters: int, floor: float) -> float:
    """Return the Bayesian information criterion, ``n log(cost/n) + p log n``.

    :param cost: sum of squared residuals.
    :param samples: n.
    :param parameters: p, all that was estimated.
    :param floor: what lies below it is rounding, and counts as equal.
    """
    return samples * math.log(max(cost, floor) / samples) + parameters * math.log(samples)
