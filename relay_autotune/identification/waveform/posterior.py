# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models that a record allows: draws from one posterior over all candidates, and of each half.

A candidate's posterior is that of its samples under the noise that was found, with a wide prior
about its estimate: each time is known to a factor of e, a dead time to all times together. So a
direction of which the samples tell nothing has draws around the estimate, not of any size. It is
approximated by Laplace's method (Gauss-Newton steps, then a normal distribution); a draw whose sum
of squares the data exclude is drawn again, so that none goes beyond what the profile allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.identification.result import Part
from relay_autotune.identification.waveform.candidates import TRIAL
from relay_autotune.identification.waveform.choice import PLAIN
from relay_autotune.identification.waveform.fit_covariance import Fit
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.separable import (
    NEGLIGIBLE,
    Problem,
    Trial,
    left_beside,
    refine,
)
from relay_autotune.process.transfer_function import TransferFunction

_MOST_SAMPLES = 1200
_FEWEST = 24
_STEPS, _HALVINGS, _SETTLED = 10, 4, 1e-3
# Standard deviations of the prior: of logarithms of times, of a gain relative to its value, of a
# dead time relative to all times together.
_TIMES, _GAIN, _DEAD_TIME = 1.0, 0.5, 1.0
DRAWS = 100
_DRAWS_OF_HALF = 40
_FARTHEST = 20.0
# Share of the posterior that is beyond the farthest draw, and tries for each draw.
_EXCLUDED, _TRIES = 1e-3, 4
# Draws of each half that differs, and copies of each plain model: more than the share that no
# promise of the design holds on.
_SHARE = DRAWS // 10
# Largest excess of another model's residual over the chosen one's, as a share of the spread.
_AS_WELL = 0.02
# Mean square of two standardised deviations that 99 % of equal halves do not exceed.
_BY_CHANCE = 4.6


@dataclass(frozen=True)
class Posterior:
    """The models that a record allows.

    :param models: drawn from the mixture over all candidates, each as likely as the others.
    :param halves: those of each half alone; empty where a half holds too little.
    :param temper: mean square of the difference of the halves over that by chance, at least 1:
        the ratio by which the record's variances are larger than its noise alone explains.
    """

    models: tuple[TransferFunction, ...]
    halves: tuple[Part, ...] = ()
    temper: float = 1.0


def posterior(fit: Fit, shares: Sequence[float], inflation: float, frequency: float) -> Posterior:
    """Return the models that a record allows, and those that each half allows.

    :param fit: with its candidates, the chosen one first.
    :param shares: support of each candidate; their sum is 1.
    :param inflation: ratio of the variances to those of the noise that was found.
    :param frequency: about that of the loop, at which the halves are compared [rad/s].
    """
    rng = np.random.default_rng(0)
    halves = _halves(fit, inflation, rng)
    temper = max(_apart(halves, frequency) / _BY_CHANCE, 1.0)
    most = _most_left(fit)
    models: list[TransferFunction] = []
    for candidate, share in zip(fit.candidates[1:], shares[1:], strict=True):
        problem, state = candidate.problem, candidate.state
        count = round(DRAWS * share)
        if count and _left(problem, state)[0] <= most:
            models += _draws(problem, state, fit.scale, inflation * temper, count, rng)
    rest = max(DRAWS - len(models), 1)
    models = [
        # The chosen one was fitted to the end.
        *_draws(fit.problem, fit.state, fit.scale, inflation * temper, rest, rng),
        *models,
    ]
    if temper > 1.0:
        # The process changed from one half to the other: both are among the models.
        models += [m for part in halves for m in part.models[:_SHARE]]
    models += [m for m in _plain(fit) for _ in range(_SHARE)]
    return Posterior(tuple(models), halves, temper)


def _plain(fit: Fit) -> list[TransferFunction]:
    """Return the plain models that simulate the record nearly as well as a fit in colour.

    Part of what a colour explains may be a response that a plain model would explain.
    """
    if fit.problem.colour is None:
        return []
    most, found = _most_left(fit), []
    for candidate in fit.candidates:
        if candidate.structure.name not in PLAIN:
            continue
        problem = replace(candidate.problem, colour=None)
        state = refine(problem, candidate.state.theta, tolerance=TRIAL)
        model = problem.structure.model_at(state.theta, fit.scale * state.coefficients)
        if model is not None and math.sqrt(state.cost / state.residual.size) <= most:
            found.append(model)
    return found


def _left(problem: Problem, state: Trial) -> tuple[float, float]:
    """Return the rms that a model leaves in simulation, and that of what is to be explained."""
    parts = left_beside(replace(problem, colour=None), state)
    left, total = (math.sqrt(float(np.mean(part**2))) for part in parts)
    return left, total


def _most_left(fit: Fit) -> float:
    """Return the largest rms of a model that simulates a record as well as the chosen one."""
    left, total = _left(fit.problem, fit.state)
    return left + _AS_WELL * total


def _draws(
    problem: Problem,
    state: Trial,
    scale: float,
    inflation: float,
    count: int,
    rng: np.random.Generator,
) -> tuple[TransferFunction, ...]:
    """Return models drawn from the posterior of some samples about their best fit."""
    few = problem.thinned(_MOST_SAMPLES) if problem.colour is None else problem
    degrees = max(problem.time.size - state.parameters, 1)
    # As much as all samples tell, of fewer of them, without the noise of just these.
    variance = inflation * state.cost / degrees * few.time.size / problem.time.size
    exact = replace(few, y=state.coefficients @ few.columns(state.theta)[0])
    gain = state.coefficients[: len(problem.structure.powers)]
    models, _ = _allowed(exact, gain, state.theta, scale, lambda _: variance, count, rng)
    above, below = problem.effects(state.coefficients)
    # Gains have to hold on both sides.
    return tuple(
        replace(m, gain=m.gain * (above, below)[i % 2]) if min(above, below) > 0.0 else m
        for i, m in enumerate(models)
    )


def _halves(fit: Fit, inflation: float, rng: np.random.Generator) -> tuple[Part, ...]:
    """Return the models that each half of a record allows in the chosen structure.

    The halves hold equal information on the parameters. Each has its own offset and free initial
    state, the first one only where the whole record has one.
    """
    problem, state = fit.problem, fit.state
    if len(problem.bounds) > 1 or problem.structure.unstable:
        return ()
    if problem.colour is None:
        problem = problem.thinned(2 * _MOST_SAMPLES)
    gain = state.coefficients[: len(problem.structure.powers)]
    _, jacobian = _linearised(problem, np.concatenate((gain, state.theta)), gain.size)
    size = np.einsum("pn,pn->p", jacobian, jacobian)
    size[size == 0.0] = 1.0
    information = np.cumsum(np.sum(jacobian**2 / size[:, None], axis=0))
    middle = int(np.searchsorted(information, 0.5 * information[-1]))
    if min(middle, problem.time.size - middle) < max(_FEWEST, 4 * state.parameters):
        return ()
    second = problem.part(slice(middle, None))
    # The free state of an integrator is the offset.
    second = replace(second, relaxation=bool(problem.structure.factors))
    parts = []
    for part in (problem.part(slice(None, middle)), second):
        own = refine(part, state.theta, tolerance=TRIAL, most=_STEPS)
        degrees = max(part.time.size - own.parameters, 1)

        def variance_of(left: FloatArray, degrees: int = degrees) -> float:
            return inflation * float(left @ left) / degrees

        found = _allowed(part, gain, state.theta, fit.scale, variance_of, _DRAWS_OF_HALF, rng)
        if found[0]:
            parts.append(Part(float(part.time[0]), float(part.time[-1]), *found))
    return tuple(parts)


def _apart(halves: Sequence[Part], frequency: float) -> float:
    """Return the mean square of the difference of two halves' responses over its covariance.

    With d the difference of the mean logarithms of their responses at one frequency, as real and
    imaginary part, and C the sum of their covariances, it is ``d' C^-1 d/2``: 1 on average for one
    process.
    """
    if len(halves) < 2:
        return 0.0
    found = []
    for part in halves:
        at = np.array([complex(m(1j * frequency)) for m in part.models])
        logs = np.log(at / at[0]) + np.log(at[0])
        found.append(np.stack((logs.real, logs.imag)))
    difference = found[0].mean(axis=1) - found[1].mean(axis=1)
    difference[1] = (difference[1] + math.pi) % (2.0 * math.pi) - math.pi
    covariance = np.cov(found[0]) + np.cov(found[1])
    if not np.all(np.isfinite(covariance)):
        return 0.0
    return 0.5 * float(difference @ np.linalg.pinv(covariance, hermitian=True) @ difference)


@dataclass(frozen=True)
class _Point:
    """A model in the search for the most likely one, as the samples and the prior see it.

    :param at: coefficients of its numerator, then theta, shape (p,).
    :param left: its residual, shape (n,).
    :param jacobian: derivatives of the response, shape (p, n).
    :param variance: of the noise that the residual shows.
    :param far: squared distance from the estimate in standard deviations of the prior.
    """

    at: FloatArray
    left: FloatArray
    jacobian: FloatArray
    variance: float
    far: float

    def cost(self, variance: float) -> float:
        """Return minus twice the logarithm of its density, for noise of some variance."""
        return float(self.left @ self.left) / variance + self.far


def _allowed(
    problem: Problem,
    gain: FloatArray,
    theta: FloatArray,
    scale: float,
    noise: Callable[[FloatArray], float],
    count: int,
    rng: np.random.Generator,
) -> tuple[tuple[TransferFunction, ...], bool]:
    """Return models drawn from the posterior that some samples give, and if it excludes the known.

    :param problem: the samples.
    :param gain: coefficients of the estimate's numerator, shape (k,).
    :param theta: of the estimate, shape (m,).
    :param scale: of the measurement in the problem [y].
    :param noise: variance of the noise that a residual shows.
    :param count: models to draw.
    :param rng: the source.
    """
    structure = problem.structure
    known = np.concatenate((gain, theta))
    slow = float(unit_steps(structure, theta)[-1])
    weak = _GAIN * np.abs(gain[0]) * slow ** np.arange(gain.size)
    deviation = np.concatenate((weak, np.full(theta.size - 1, _TIMES), [_DEAD_TIME * slow]))
    if not np.all(deviation > 0.0):
        return (), False
    own = refine(problem, theta, tolerance=TRIAL, most=_STEPS)

    def about(point: FloatArray) -> _Point:
        left, jacobian = _linearised(problem, point, gain.size)
        far = float(np.sum(((point - known) / deviation) ** 2))
        return _Point(point, left, jacobian, max(noise(left), NEGLIGIBLE**2), far)

    def axes_at(point: _Point) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return singular values of the slopes in units of prior and noise, and their axes."""
        scaled = point.jacobian * (deviation / math.sqrt(point.variance))[:, None]
        axes, values, rows = np.linalg.svd(scaled, full_matrices=False)
        return axes, values, rows

    here = start = about(known)
    # The best fit without the prior may be nearer, but also run off where samples tell little.
    elsewhere = about(_bounded(np.concatenate((own.coefficients[: gain.size], own.theta))))
    if elsewhere.cost(here.variance) < here.cost(here.variance):
        here = elsewhere
    for _ in range(_STEPS):
        axes, values, rows = axes_at(here)
        along = values * (rows @ here.left) / math.sqrt(here.variance)
        along = along - axes.T @ ((here.at - known) / deviation)
        step = deviation * (axes @ (along / (1.0 + values**2)))
        cost = here.cost(here.variance)
        for _ in range(_HALVINGS):
            trial = about(_bounded(here.at + step))
            now = trial.cost(here.variance)
            if now < cost:
                break
            step = 0.5 * step
        else:
            break
        here = trial
        if cost - now < _SETTLED * here.cost(here.variance):
            break
    axes, values, _ = axes_at(here)
    # The symmetric root, which turns on no sign or order of the axes.
    root = (axes / np.sqrt(1.0 + values**2)) @ axes.T
    farthest = 2.0 * float(gammaincinv(0.5 * known.size, 1.0 - _EXCLUDED))

    def is_excluded(point: _Point) -> bool:
        return point.cost(here.variance) - here.cost(here.variance) > farthest

    models: list[TransferFunction] = []
    for _ in range(_TRIES * count):
        if len(models) == count:
            break
        drawn = _bounded(here.at + deviation * (root @ rng.standard_normal(known.size)))
        if is_excluded(about(drawn)):
            continue
        try:
            model = structure.model_at(drawn[gain.size :], scale * drawn[: gain.size])
        except ModelError:
            continue
        if model is not None:
            models.append(model)
    return tuple(models), is_excluded(start)


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
    own, beside = problem.seen(columns[:count]), problem.seen(columns[count:])
    basis, _ = np.linalg.qr(beside.T)
    by_theta = problem.seen(np.einsum("k,mkn->mn", gain, derivatives[:, :count]))
    rows = np.concatenate(((problem.seen(problem.y) - gain @ own)[None, :], own, by_theta))
    rows = rows - (rows @ basis) @ basis.T
    return rows[0], rows[1:]
