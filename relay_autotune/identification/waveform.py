r"""Fit of a model to every sample of a record, by separable least squares.

The model is

    y(t_i) = K r(t_i; theta) + offset [+ drift t_i] [+ free initial state] + noise,

with r the exact response to the recorded command, the dead time any real number. Only theta is
nonlinear: the linear coefficients are eliminated by QR at each step (variable projection,
Golub and Pereyra 1973, with Kaufman's approximation of the Jacobian), the step in theta is
Levenberg's and Marquardt's. Whether drift and initial state belong to the model is decided by
the Bayesian information criterion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.lags import Fopdt
from relay_autotune.identification.residuals import covariance_meat, ljung_box
from relay_autotune.identification.result import FitReport, Identification, with_uncertainty
from relay_autotune.record import PiecewiseConstant, Record

FloatArray = NDArray[np.float64]

_GRID_SAMPLES = 240
_STARTS = 3
_NEGLIGIBLE = 1e-10
_MOST_ITERATIONS = 80
_LEAST_GAIN = 1e-15
_UNEXPLAINED = 1.5
_WHITE = 1e-3

STRUCTURES = {Fopdt.structure: Fopdt}


@dataclass(frozen=True)
class _Problem:
    """Samples, input and structure, with the nuisance terms that the model has."""

    time: FloatArray
    y: FloatArray
    u: PiecewiseConstant
    structure: type[Fopdt]
    drift: bool = False
    relaxation: bool = False

    def columns(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns of the linear coefficients (k, n), derivatives of the first of them (m, l, n).

        The columns that theta does not change come last.
        """
        columns, derivatives = self.structure.columns(theta, self.time, self.u)
        rows = [columns]
        if self.relaxation:
            state, by_theta = self.structure.relaxation(theta, self.time)
            rows.append(state)
            derivatives = np.concatenate((derivatives, by_theta), axis=1)
        rows.append(np.ones((1, self.time.size)))
        if self.drift:
            rows.append(((self.time - self.time.mean()) / np.ptp(self.time))[None, :])
        return np.concatenate(rows), derivatives

    def part(self, chosen: NDArray[np.bool_] | slice) -> _Problem:
        return replace(self, time=self.time[chosen], y=self.y[chosen])


@dataclass(frozen=True)
class _State:
    """A trial theta with its linear coefficients, residual and projected Jacobian."""

    theta: FloatArray
    coefficients: FloatArray
    residual: FloatArray
    cost: float
    basis: FloatArray
    derivative: FloatArray
    columns: FloatArray


def _evaluate(problem: _Problem, theta: FloatArray) -> _State:
    columns, derivatives = problem.columns(theta)
    size = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    size[size == 0.0] = 1.0
    q, r = np.linalg.qr((columns / size[:, None]).T)
    # A column that the others make up carries no information: its coefficient stays zero.
    weak = np.abs(np.diag(r)) < 1e-13
    r[np.diag_indices_from(r)] += weak
    projection = q.T @ problem.y
    coefficients = np.linalg.solve(r, np.where(weak, 0.0, projection))
    coefficients = coefficients / size
    residual = problem.y - coefficients @ columns
    derivative = np.einsum("k,mkn->mn", coefficients[: derivatives.shape[1]], derivatives)
    cost = float(residual @ residual)
    return _State(theta, coefficients, residual, cost, q, derivative, columns)


def _refine(problem: _Problem, theta: FloatArray) -> _State:
    state = _evaluate(problem, theta)
    damping = 1e-3
    for _ in range(_MOST_ITERATIONS):
        scale = problem.structure.scale(state.theta)
        jacobian = state.derivative * scale[:, None]
        jacobian = jacobian - (jacobian @ state.basis) @ state.basis.T
        normal = jacobian @ jacobian.T
        gradient = jacobian @ state.residual
        diagonal = np.diag(np.maximum(np.diag(normal), 1e-300))
        damped = normal + damping * diagonal
        step: FloatArray = np.asarray(np.linalg.lstsq(damped, gradient, rcond=None)[0])
        trial = _evaluate(problem, problem.structure.move(state.theta, step))
        if not trial.cost < state.cost:
            damping *= 10.0
            # Where even the undamped step promises less than rounding, no other will be seen.
            promised = gradient @ np.linalg.lstsq(normal, gradient, rcond=None)[0]
            if (
                promised <= _LEAST_GAIN * state.cost
                or damping > 1e12
                or float(np.abs(step).max()) < 1e-14
            ):
                break
            continue
        gained = state.cost - trial.cost
        state = trial
        damping = max(damping / 10.0, 1e-12)
        if gained <= _LEAST_GAIN * state.cost or float(np.abs(step).max()) < 1e-14:
            break
    return state


def _time_scales(time: FloatArray, u: PiecewiseConstant) -> tuple[float, float]:
    """Shortest time that the samples resolve, longest in which the dead time must lie."""
    gaps = np.diff(time)
    shortest = float(np.median(gaps[gaps > 0.0]))
    inside = u.times[(u.times >= time[0]) & (u.times < time[-1])]
    rest = float(time[-1] - inside[0])
    if inside.size < 4:
        return shortest, rest
    # In a relay test the process answers one switch before the next.
    return shortest, min(1.1 * float(np.max(np.diff(inside))), rest)


def _costs(problem: _Problem, shape: FloatArray, dead_times: FloatArray) -> FloatArray:
    """Return the sums of squares that a shape and a constant leave, for each dead time."""
    # A dead time only moves the response, so that one pass over moved samples gives all of them.
    moved = (problem.time - dead_times[:, None]).ravel()
    columns, _ = problem.structure.columns(np.append(shape, 0.0), moved, problem.u)
    columns = columns.reshape(-1, dead_times.size, problem.time.size)
    columns = columns - columns.mean(axis=2, keepdims=True)
    size = np.sqrt(np.einsum("kdn,kdn->kd", columns, columns))
    size[size == 0.0] = 1.0
    columns = columns / size[:, :, None]
    y = problem.y - problem.y.mean()
    projection = np.einsum("kdn,n->dk", columns, y)
    inverse = np.linalg.pinv(np.einsum("kdn,ldn->dkl", columns, columns), hermitian=True)
    return np.asarray(y @ y - np.einsum("dk,dkl,dl->d", projection, inverse, projection))


def _start(problem: _Problem) -> _State:
    shortest, longest = _time_scales(problem.time, problem.u)
    stride = max(1, problem.time.size // _GRID_SAMPLES)
    coarse = problem.part(slice(None, None, stride))
    shapes, dead_times = problem.structure.starts(min(shortest, 0.1 * longest), longest)
    grid = [np.append(shape, dead_time) for shape in shapes for dead_time in dead_times]
    costs = np.concatenate([_costs(coarse, shape, dead_times) for shape in shapes])
    best: list[FloatArray] = []
    for i in np.argsort(costs, kind="stable"):
        apart = [float(np.abs(np.log((grid[i] + longest * 1e-3) / b)).max()) for b in best]
        if not apart or min(apart) > 0.5:
            best.append(grid[i] + longest * 1e-3)
        if len(best) == _STARTS:
            break
    refined = [_refine(coarse, theta) for theta in best]
    theta = min(refined, key=lambda s: s.cost).theta
    return _refine(problem, theta)


def _criterion(cost: float, samples: int, parameters: int, floor: float) -> float:
    """Bayesian information criterion; what lies below rounding counts as equal."""
    return samples * math.log(max(cost, floor) / samples) + parameters * math.log(samples)


def _parameters(state: _State) -> int:
    return state.theta.size + state.coefficients.size


def _select(problem: _Problem, first: _State, floor: float) -> tuple[_Problem, _State]:
    """Add drift and initial state where the data ask for them."""
    candidates = [(problem, first)]
    for drift in (False, True):
        for relaxation in (False, True):
            if not (drift or relaxation):
                continue
            extended = replace(problem, drift=drift, relaxation=relaxation)
            candidates.append((extended, _refine(extended, first.theta)))
    n = problem.time.size
    return min(candidates, key=lambda c: _criterion(c[1].cost, n, _parameters(c[1]), floor))


def identify_waveform(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a model from all samples of a record.

    :param record: any record whose command moves; baseline samples before the test help.
    :param known: its structure, one of ``STRUCTURES``, is fitted; by default a FOPDT.
    :raises IdentificationError: if the record holds too little, or no response to the command.
    """
    structure = known.structure or Fopdt.structure
    if structure not in STRUCTURES:
        raise IdentificationError(
            f"the waveform fit has no structure {structure!r}; it has {', '.join(STRUCTURES)}"
        )
    u = record.input()
    time, y = record.time, record.measurement
    _require_content(time, y, u)
    # In units of its own range, so that no unit of measurement is too large or too small.
    scale = max(float(np.ptp(y)), float(np.abs(y).max()) * 1e-6)
    problem = _Problem(time, (y - y[0]) / scale, u, STRUCTURES[structure])
    floor = y.size * _NEGLIGIBLE**2
    chosen, state = _select(problem, _start(problem), floor)
    if chosen.relaxation:
        # What the process was fed before the record is unknown, and acts for one dead time.
        after = time >= time[0] + float(state.theta[1])
        if np.count_nonzero(after) > 4 * _parameters(state):
            chosen = chosen.part(after)
            state = _refine(chosen, state.theta)
            floor = chosen.y.size * _NEGLIGIBLE**2
    _require_response(chosen, state, floor)
    return _report(record, chosen, state, floor, scale)


def _require_content(time: FloatArray, y: FloatArray, u: PiecewiseConstant) -> None:
    if y.size < 12:
        raise IdentificationError(
            f"the record holds {y.size} samples; a fit needs at least 12: record longer"
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


def _require_response(problem: _Problem, state: _State, floor: float) -> None:
    constant = problem.y - problem.y.mean()
    nuisance = state.columns[1:]
    left = constant - np.linalg.lstsq(nuisance.T, constant, rcond=None)[0] @ nuisance
    n = problem.y.size
    without = _criterion(float(left @ left), n, nuisance.shape[0], floor)
    if not _criterion(state.cost, n, _parameters(state), floor) < without:
        raise IdentificationError(
            "the measurement shows no response to the command beyond its noise: raise the "
            "amplitude, or check that both topics belong to one loop"
        )


def _report(
    record: Record, problem: _Problem, state: _State, floor: float, scale: float
) -> Identification:
    n, k = state.residual.size, _parameters(state)
    rms = scale * math.sqrt(state.cost / n)
    exact = state.cost <= floor
    whiteness = math.nan if exact else ljung_box(state.residual)
    jacobian = np.concatenate((state.columns[:1], state.derivative, state.columns[1:]))
    size = np.sqrt(np.einsum("pn,pn->p", jacobian, jacobian))
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv((jacobian @ jacobian.T) / np.outer(size, size), rcond=1e-15)
    inverse = inverse / np.outer(size, size)
    degrees = max(n - k, 1)
    coloured = not math.isnan(whiteness) and whiteness < _WHITE
    if coloured:
        scores = jacobian * state.residual
        meat = covariance_meat(scores, state.residual) * (n / degrees)
        covariance = inverse @ meat @ inverse
    else:
        covariance = inverse * (state.cost / degrees)
    p = len(problem.structure.parameters)
    values = np.concatenate((scale * state.coefficients[:1], state.theta))
    units = np.ones(p)
    units[0] = scale
    spread = scale * math.sqrt(float(np.mean((problem.y - problem.y.mean()) ** 2)))
    # The samples of the fit are the last ones of the record.
    fitted = np.full(len(record), math.nan)
    fitted[-n:] = record.measurement[-n:] - scale * state.residual
    fit = FitReport(
        residual_rms=rms,
        noise_std=record.noise_std,
        fit=1.0 - rms / spread if spread > 0.0 else math.nan,
        whiteness_p=whiteness,
        prediction=scale * _prediction(record, problem, state),
    )
    return with_uncertainty(
        "waveform",
        problem.structure.model,
        problem.structure.parameters,
        values,
        covariance[:p, :p] * np.outer(units, units),
        quantile=float(stdtrit(degrees, 0.975)),
        fit=fit,
        warnings=_warnings(record, fit, coloured, scale, problem),
        fitted=fitted,
    )


def _prediction(record: Record, problem: _Problem, state: _State) -> float:
    """Error over the last cycle of the model that the samples before it give."""
    if len(record.cycle_start) < 3:
        return math.nan
    split = record.time[record.cycle_start[-2]]
    end = record.time[record.cycle_start[-1]]
    before = problem.part(problem.time < split)
    last = problem.part((problem.time >= split) & (problem.time < end))
    if before.y.size < 4 * _parameters(state) or last.y.size == 0:
        return math.nan
    if before.y.size + last.y.size > problem.y.size or before.relaxation or before.drift:
        # Relaxation and drift are counted from the ends of the samples given.
        return math.nan
    earlier = _refine(before, state.theta)
    columns, _ = last.columns(earlier.theta)
    error = last.y - earlier.coefficients @ columns
    return math.sqrt(float(np.mean(error**2)))


def _warnings(
    record: Record, fit: FitReport, coloured: bool, scale: float, problem: _Problem
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
