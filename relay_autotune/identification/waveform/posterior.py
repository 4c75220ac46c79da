# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models that a record allows: draws from one posterior over all candidates, and of each part.

A candidate's posterior is that of its samples under the noise that was found, with a wide prior
about its estimate: gain and each time are known to a factor of e, dead time and zero to all times
together. So a direction of which the samples tell nothing has draws around the estimate, not of
any size. It is approximated by Laplace's method (Gauss-Newton steps, then a normal distribution).
A draw that the samples make less likely than that is drawn again by the ratio of the two.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.identification.result import Part
from relay_autotune.identification.waveform.candidates import PLAIN
from relay_autotune.identification.waveform.fit_covariance import Fit
from relay_autotune.identification.waveform.problem import NEGLIGIBLE, Problem, without
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.separable import (
    TRIAL,
    Trial,
    evaluate,
    refine,
    residual_of,
    residual_of_model,
    rms_in_simulation,
)
from relay_autotune.identification.waveform.starts import Guess, best_fopdt, best_of
from relay_autotune.process.structures import FOPDT, SOPDT, Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.moves import changes_within
from relay_autotune.record.record import PiecewiseConstant

# Samples at which draws are compared with the fit, and those of both parts together.
_MOST_SAMPLES, _MOST_OF_PARTS = 600, 2400
# Least number of samples in a part that is asked for models of its own.
_FEWEST = 24
# Share of its farthest level from which a command has its full reach, and least share of the
# information that a part of the record has to hold.
_FULL, _LEAST_TOLD = 0.99, 0.05
# Gauss-Newton steps to the most likely point, halvings of each, and the relative gain that ends
# them: the draws need it to a small part of a standard deviation.
_STEPS, _HALVINGS, _SETTLED = 10, 4, 1e-3
# Standard deviation of the prior of a logarithm; that of a dead time or a zero is all times.
_LOGARITHM = 1.0
# Draws of the mixture, whose share of bad ones is known to 5 %, and of each part.
DRAWS = 100
_DRAWS_OF_PART = 40
# Most that the density may fall at a standard deviation, in which it falls by 1 if it is normal.
_FALLS = 2.0
# Farthest point of the search in standard deviations of the prior.
_FARTHEST = 20.0
# Tries for each draw.
_TRIES = 4
# Share of the posterior that lies farther than a model that the samples exclude.
_EXCLUDED = 1e-3
# Draws of each part that differs, and copies of each plain model: more than the share that no
# promise of the design holds on.
_SHARE = DRAWS // 10
# Largest excess of another model's residual over the chosen one's, as a share of the spread.
_AS_WELL = 0.05
# Mean square of two standardised deviations that 99 % of equal parts do not exceed.
_BY_CHANCE = 4.6


@dataclass(frozen=True)
class Posterior:
    """The models that a record allows.

    :param models: drawn from the mixture over all candidates, each as likely as the others, and
        what gains have to hold on besides: either side of an unequal process, all parts of one
        that changed, a plain model beside one in colour, and what large moves show.
    :param mixture: those of the candidates alone.
    :param values: of the chosen structure's parameters in its own draws, shape (k, p).
    :param own: the models of these.
    :param parts: those of each part alone; empty where a part holds too little.
    :param temper: mean square of the difference of two parts over that by chance, at least 1:
        the ratio by which the record's variances are larger than its noise alone explains.
    """

    models: tuple[TransferFunction, ...]
    mixture: tuple[TransferFunction, ...]
    values: FloatArray
    own: tuple[TransferFunction, ...]
    parts: tuple[Part, ...] = ()
    temper: float = 1.0


def posterior(fit: Fit, shares: Sequence[float], inflation: float, frequency: float) -> Posterior:
    """Return the models that a record allows, and those that each part allows.

    :param fit: with its candidates, the chosen one first.
    :param shares: support of each candidate; their sum is 1.
    :param inflation: ratio of the variances to those of the noise that was found.
    :param frequency: about that of the loop, at which the parts are compared [rad/s].
    """
    rng = np.random.default_rng(0)
    parts = _parts(fit, inflation, rng)
    temper = max(_difference_of_parts(parts, frequency) / _BY_CHANCE, 1.0)
    most = _largest_rms(fit)
    mixture: list[TransferFunction] = []
    models: list[TransferFunction] = []
    # The chosen one was fitted to the end.
    own = _draws(fit.problem, fit.state, fit.scale, inflation * temper, DRAWS, rng)
    for candidate, share in zip(fit.candidates[1:], shares[1:], strict=True):
        problem, state = candidate.problem, candidate.state
        count = round(DRAWS * share)
        if count and rms_in_simulation(problem, state.coefficients, state.theta)[0] <= most:
            drawn = _draws(problem, state, fit.scale, inflation * temper, count, rng).models
            mixture += drawn
            models += _on_both_sides(drawn, problem, state)
    rest = own.models[: max(DRAWS - len(mixture), 1)]
    mixture = [*rest, *mixture]
    models = [*_on_both_sides(rest, fit.problem, fit.state), *models]
    if temper > 1.0:
        # The process changed from one part to the other: all are among the models.
        models += [m for part in parts for m in part.models[:_SHARE]]
    models += [m for m in (*_plain_models(fit), *_large_moves(fit)) for _ in range(_SHARE)]
    return Posterior(tuple(models), tuple(mixture), own.values, own.models, parts, temper)


def _on_both_sides(
    models: Sequence[TransferFunction], problem: Problem, state: Trial
) -> list[TransferFunction]:
    """Return models with the effects of commands above and below the first one, in turn."""
    sides = problem.effects(state.coefficients)
    if not min(sides) > 0.0:
        return list(models)
    return [replace(m, gain=m.gain * sides[i // 2 % 2]) for i, m in enumerate(models)]


def _plain_models(fit: Fit) -> list[TransferFunction]:
    """Return the plain models that simulate the record as well, or nearly so beside a colour.

    Part of what a colour explains may be a response that a plain model would explain.
    """
    white = fit.problem.colour is None
    most, found = _largest_rms(fit, 0.0 if white else _AS_WELL), []
    for candidate in fit.candidates:
        if candidate.structure.name not in PLAIN:
            continue
        problem = replace(candidate.problem, colour=None)
        state = refine(problem, candidate.state.theta, tolerance=TRIAL)
        model = problem.structure.model_at(state.theta, fit.scale * state.coefficients)
        if model is not None and math.sqrt(state.cost / state.residual.size) <= most:
            found.append(model)
    return found


def _large_moves(fit: Fit) -> list[TransferFunction]:
    """Return the model that large moves show, where none is followed faster than at some rate."""
    if fit.problem.rate is None:
        return []
    first = without(replace(fit.problem, structure=FOPDT), ["rate"])
    guess = Guess.of(first, best_fopdt(first))
    found = best_of(replace(first, structure=SOPDT), guess.starts(SOPDT))
    model = SOPDT.model_at(found.theta, fit.scale * found.coefficients)
    return [] if model is None else [model]


def _largest_rms(fit: Fit, share: float = _AS_WELL) -> float:
    """Return the largest rms of a model that simulates a record as well as the chosen one."""
    left, total = rms_in_simulation(fit.problem, fit.state.coefficients, fit.state.theta)
    return left + share * total


def _draws(
    problem: Problem,
    state: Trial,
    scale: float,
    inflation: float,
    count: int,
    rng: np.random.Generator,
) -> _Drawn:
    """Return models drawn from the posterior of some samples about their best fit."""
    few = problem.thinned(_MOST_SAMPLES) if problem.colour is None else problem
    degrees = max(problem.time.size - state.parameters, 1)
    # As much as all samples tell, of fewer of them, without the noise of just these.
    variance = inflation * state.cost / degrees * few.time.size / problem.time.size
    exact = replace(few, y=state.coefficients @ few.columns(state.theta))
    gain = state.coefficients[: len(problem.structure.powers)]
    return _allowed(exact, gain, state.theta, scale, lambda _: variance, count, rng)


def _parts(fit: Fit, inflation: float, rng: np.random.Generator) -> tuple[Part, ...]:
    """Return the models that each part of a record allows in the chosen structure.

    Of several records each is a part. One that its own models do not explain, such as a rest after
    all responses, tells nothing.
    """
    problem, state = fit.problem, fit.state
    if problem.structure.unstable:
        return ()
    if problem.colour is None:
        problem = problem.thinned(_MOST_OF_PARTS)
    gain = state.coefficients[: len(problem.structure.powers)]
    several = len(problem.bounds) > 1
    parts = []
    for number, part in enumerate(problem.each() if several else _halves(problem, state), 1):
        if part.relaxation and not changes_within(part.inputs[0], part.time).size:
            # It moves freely, and a response of either direction fits what that leaves.
            continue
        degrees = max(part.time.size - evaluate(part, state.theta).parameters, 1)

        def variance_of(left: FloatArray, degrees: int = degrees) -> float:
            return inflation * float(left @ left) / degrees

        found = _allowed(
            part, gain, state.theta, fit.scale, variance_of, _DRAWS_OF_PART, rng, apart=several
        )
        if found.models and found.explains:
            ends = float(part.time[0]), float(part.time[-1])
            parts.append(Part(*ends, found.models, found.excludes_known, number * several))
    return tuple(parts)


def _halves(problem: Problem, state: Trial) -> tuple[Problem, ...]:
    """Return two parts of a record; none where one would hold too little.

    They meet where the command first has its full reach: an actuator at its end, or a process that
    is not linear, answers large moves otherwise than small ones. Where one of them would tell
    little, they hold equal information on the parameters. Each has its own offset, and a free
    initial state where the whole record has one or the command moved before.

    :param problem: of the record.
    :param state: its fit.
    """
    jacobian = _slopes(problem, state.coefficients[: len(problem.structure.powers)], state.theta)
    size = np.einsum("pn,pn->p", jacobian, jacobian)
    size[size == 0.0] = 1.0
    information = np.cumsum(np.sum(jacobian**2 / size[:, None], axis=0))
    middle = _full_reach(problem)
    if not _LEAST_TOLD < information[middle] / information[-1] < 1.0 - _LEAST_TOLD:
        middle = int(np.searchsorted(information, 0.5 * information[-1]))
    if min(middle, problem.time.size - middle) < max(_FEWEST, 4 * state.parameters):
        return ()
    first, second = problem.part(slice(None, middle)), problem.part(slice(middle, None))
    if changes_within(problem.inputs[0], first.time).size:
        # The free state of an integrator is the offset.
        second = replace(second, relaxation=bool(problem.structure.factors))
    return first, second


def _full_reach(problem: Problem) -> int:
    """Return where a held command is first as far from its first level as it comes; 0: a ramp."""
    u = problem.inputs[0]
    if not isinstance(u, PiecewiseConstant):
        return 0
    reach = np.abs(u(problem.time) - u.initial)
    return int(np.argmax(reach >= _FULL * reach.max()))


def _difference_of_parts(parts: Sequence[Part], frequency: float) -> float:
    """Return the mean square of the difference of two parts' responses over its covariance.

    With d the difference of the mean logarithms of their responses at one frequency, as real and
    imaginary part, and C the sum of their covariances, it is ``d' C^-1 d/2``: 1 on average for one
    process. Of several parts the largest one counts. Records may be of different processes, of
    which the slowest one's loop is meant.
    """
    if any(part.record for part in parts):
        ends = (ultimate_point(part.models[0]) for part in parts)
        frequency = min([frequency, *(end.frequency for end in ends if end is not None)])
    found = []
    for part in parts:
        at = np.array([complex(m(1j * frequency)) for m in part.models])
        logs = np.log(at / at[0]) + np.log(at[0])
        # One that knows the gain no better than the prior does tells nothing.
        if at.size > 1 and np.var(logs.real, ddof=1) < _LOGARITHM**2:
            found.append(np.stack((logs.real, logs.imag)))
    largest = 0.0
    for one, other in itertools.combinations(found, 2):
        difference = one.mean(axis=1) - other.mean(axis=1)
        difference[1] = (difference[1] + math.pi) % (2.0 * math.pi) - math.pi
        inverse = np.linalg.pinv(np.cov(one) + np.cov(other), hermitian=True)
        largest = max(largest, 0.5 * float(difference @ inverse @ difference))
    return largest


@dataclass(frozen=True)
class _Drawn:
    """Draws from one posterior.

    :param models: each as likely as the others.
    :param values: of their structure's parameters, shape (k, p).
    :param excludes_known: True: the samples exclude the estimate that they were asked of.
    :param explains: True: the most likely one explains more of the samples than it leaves.
    """

    models: tuple[TransferFunction, ...]
    values: FloatArray
    excludes_known: bool = False
    explains: bool = False


@dataclass(frozen=True)
class _Point:
    """A model in the search for the most likely one, as the samples and the prior see it.

    :param at: logarithm of its gain, its numerator's further coefficients over the gain, then
        theta, shape (p,).
    :param sign: of the gain.
    :param left: its residual, shape (n,).
    :param variance: of the noise that the residual shows.
    :param far: squared distance from the estimate in standard deviations of the prior.
    """

    at: FloatArray
    sign: float
    left: FloatArray
    variance: float
    far: float

    def cost(self, variance: float) -> float:
        """Return minus twice the logarithm of its density, for noise of some variance."""
        return float(self.left @ self.left) / variance + self.far


@dataclass(frozen=True)
class _Density:
    """Likelihood of some samples times the prior about an estimate.

    :param problem: the samples.
    :param centre: of the prior, as a point.
    :param deviation: standard deviations of the prior, shape (p,).
    :param noise: variance of the noise that a residual shows.
    """

    problem: Problem
    centre: FloatArray
    deviation: FloatArray
    noise: Callable[[FloatArray], float]

    def coefficients(self, point: _Point) -> FloatArray:
        """Return the numerator's coefficients at a point."""
        size = point.sign * math.exp(point.at[0])
        return size * np.append(1.0, point.at[1 : len(self.problem.structure.powers)])

    def theta(self, point: _Point) -> FloatArray:
        """Return theta at a point."""
        return point.at[len(self.problem.structure.powers) :]

    def about(self, at: FloatArray, sign: float) -> _Point:
        """Return the point next to some place within the bounds of the search."""
        reach = _FARTHEST * self.deviation
        at = np.clip(at, self.centre - reach, self.centre + reach)
        at[-1] = max(float(at[-1]), 0.0)
        far = float(np.sum(((at - self.centre) / self.deviation) ** 2))
        point = _Point(at, sign, np.empty(0), 1.0, far)
        left = residual_of_model(self.problem, self.coefficients(point), self.theta(point))
        return replace(point, left=left, variance=max(self.noise(left), NEGLIGIBLE**2))

    def axes_at(self, point: _Point) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return singular values of the slopes in units of prior and noise, and their axes."""
        gain = self.coefficients(point)
        slopes = _slopes(self.problem, gain, self.theta(point))
        by_log = gain @ slopes[: gain.size]
        slopes[1 : gain.size] *= gain[0]
        slopes[0] = by_log
        scaled = slopes * (self.deviation / math.sqrt(point.variance))[:, None]
        axes, values, rows = np.linalg.svd(scaled, full_matrices=False)
        return axes, values, rows

    def most_likely(self, here: _Point) -> _Point:
        """Return the most likely point near another one, by steps of Gauss and Newton."""
        for _ in range(_STEPS):
            axes, values, rows = self.axes_at(here)
            along = values * (rows @ here.left) / math.sqrt(here.variance)
            along = along - axes.T @ ((here.at - self.centre) / self.deviation)
            step = self.deviation * (axes @ (along / (1.0 + values**2)))
            cost = here.cost(here.variance)
            for _ in range(_HALVINGS):
                trial = self.about(here.at + step, here.sign)
                now = trial.cost(here.variance)
                if now < cost:
                    break
                step = 0.5 * step
            else:
                break
            here = trial
            if cost - now < _SETTLED * here.cost(here.variance):
                break
        return here

    def log_mass(self, mode: _Point, variance: float) -> float:
        """Return the logarithm of the probability about a mode, by Laplace's approximation.

        A narrow peak, as where a late response would follow the noise of a few samples, may be
        higher than a plain of models and yet hold less than it.

        :param mode: most likely point near some place.
        :param variance: of the noise, for all modes that are compared.
        """
        _, values, _ = self.axes_at(mode)
        return -0.5 * (mode.cost(variance) + float(np.sum(np.log1p(values**2))))

    def draws(self, here: _Point, count: int, rng: np.random.Generator) -> Iterator[_Point | None]:
        """Yield points by Laplace's approximation; None: the density is less than it says."""
        axes, values, _ = self.axes_at(here)
        # The symmetric root, which turns on no sign or order of the axes.
        root = (axes * self._reach(here, axes, 1.0 / np.sqrt(1.0 + values**2))) @ axes.T
        least = here.cost(here.variance)
        while True:
            for normal in _normal(count, here.at.size, rng)[:count]:
                point = self.about(here.at + self.deviation * (root @ normal), here.sign)
                # Density over that of the normal distribution about the most likely point.
                rise = point.cost(here.variance) - least - float(normal @ normal)
                yield point if math.log(1.0 - rng.random()) <= -0.5 * rise else None

    def _reach(self, here: _Point, axes: FloatArray, linear: FloatArray) -> FloatArray:
        """Return standard deviations along axes, halved where the density falls sooner.

        A zero and a dead time that cancel each other to first order do not for long.

        :param here: the most likely point.
        :param axes: in units of the prior, shape (p, p).
        :param linear: standard deviations by the slopes, shape (p,).
        """
        found, least = linear.copy(), here.cost(here.variance)
        for i, axis in enumerate(axes.T):
            for _ in range(_STEPS):
                away = found[i] * self.deviation * axis
                ends = (self.about(here.at + a, here.sign) for a in (-away, away))
                # On both sides: the longer one is not to be cut.
                if min(end.cost(here.variance) for end in ends) - least <= _FALLS:
                    break
                found[i] *= 0.5
        return found


def _point_of(gain: FloatArray, theta: FloatArray) -> FloatArray:
    return np.concatenate(([math.log(abs(gain[0]))], gain[1:] / gain[0], theta))


def _allowed(
    problem: Problem,
    gain: FloatArray,
    theta: FloatArray,
    scale: float,
    noise: Callable[[FloatArray], float],
    count: int,
    rng: np.random.Generator,
    *,
    apart: bool = False,
) -> _Drawn:
    """Return draws from the posterior that some samples give, and if it excludes the known.

    :param problem: the samples.
    :param gain: coefficients of the estimate's numerator, shape (k,).
    :param theta: of the estimate, shape (m,).
    :param scale: of the measurement in the problem [y].
    :param noise: variance of the noise that a residual shows.
    :param count: models to draw.
    :param rng: the source.
    :param apart: True: the samples are of a test of their own.
    """
    structure, k = problem.structure, gain.size
    slow = float(unit_steps(structure, theta)[-1])
    if not (slow > 0.0 and gain[0] != 0.0):
        return _Drawn((), np.empty((0, 0)))
    deviation = np.array([_LOGARITHM, *[slow] * (k - 1), *[_LOGARITHM] * (theta.size - 1), slow])
    length = float(np.ptp(problem.time))
    centre = _within_the_record(structure, _point_of(gain, theta), length)
    density = _Density(problem, centre, deviation, noise)
    start = density.about(centre, math.copysign(1.0, gain[0]))
    places = [start]
    # The best fit without the prior may be nearer, but also run off where samples tell little.
    # That of one of several records may be far away, behind fits to its noise.
    for later in (0.0, 0.5, 1.0) if apart else (0.0,):
        near = np.append(theta[:-1], theta[-1] + later * slow)
        own = refine(problem, near, tolerance=TRIAL, most=_STEPS)
        if own.coefficients[0] != 0.0:
            at = _point_of(own.coefficients[:k], own.theta)
            places.append(density.about(at, math.copysign(1.0, own.coefficients[0])))
    modes = [density.most_likely(place) for place in places]
    variance = min(mode.variance for mode in modes)
    here = max(modes, key=lambda mode: density.log_mass(mode, variance))
    models: list[TransferFunction] = []
    values: list[FloatArray] = []
    for point in itertools.islice(density.draws(here, count, rng), _TRIES * count):
        if len(models) == count:
            break
        if point is None:
            continue
        at, coefficients = density.theta(point), scale * density.coefficients(point)
        try:
            model = structure.model_at(at, coefficients)
            read = structure.read(at, coefficients, like=theta)
        except ModelError:
            continue
        if model is not None and read is not None:
            models.append(model)
            values.append(read[1])
    rise = start.cost(here.variance) - here.cost(here.variance)
    excluded = rise > 2.0 * float(gammaincinv(0.5 * centre.size, 1.0 - _EXCLUDED))
    left, total = rms_in_simulation(problem, density.coefficients(here), density.theta(here))
    explains = 2.0 * left**2 < total**2
    return _Drawn(tuple(models), np.array(values), excluded, explains)


def _within_the_record(structure: Structure, at: FloatArray, length: float) -> FloatArray:
    """Return a point whose lags are at most as long as the record, with the same first slope.

    A longer one acts as an integrator, however long it is: about an estimate that is too long, the
    prior would exclude the truth.

    :param structure: the structure.
    :param at: logarithm of the gain, further coefficients, theta, shape (p,).
    :param length: of the record [s].
    """
    found, first = at.copy(), len(structure.powers)
    for factor in structure.factors:
        place = slice(first, first + len(factor.parameters))
        first = place.stop
        slowest = max(abs(c) for c in factor.constants(at[place]))
        beyond = max(math.log(slowest / length), 0.0)
        found[place] -= beyond / len(factor.parameters)
        found[0] -= beyond * factor.multiplicity
    return found


def _normal(count: int, size: int, rng: np.random.Generator) -> FloatArray:
    """Return standard normal draws in opposite pairs, with mean 0 and covariance 1 as a sample.

    :param count: of draws.
    :param size: of each.
    :param rng: the source.
    """
    half = rng.standard_normal((max(-(-count // 2), size), size))
    values, axes = np.linalg.eigh(half.T @ half / half.shape[0])
    half = half @ (axes / np.sqrt(values)) @ axes.T
    return np.stack((half, -half), axis=1).reshape(-1, size)


def _slopes(problem: Problem, gain: FloatArray, theta: FloatArray) -> FloatArray:
    """Return a model's derivatives by numerator and theta beside the nuisances, (k + m, n).

    Where theta changes what is estimated beside the model, such as the answer to a load, so does
    it change what is seen.

    :param problem: the samples.
    :param gain: coefficients of the numerator, shape (k,).
    :param theta: shape (m,).
    """
    columns, derivatives = problem.with_slopes(theta)
    k = gain.size
    left = problem.y - gain @ columns[:k]
    rows = problem.seen(np.concatenate((left[None, :], columns[k:])))
    beside = np.linalg.lstsq(rows[1:].T, rows[0], rcond=None)[0]
    by_theta = np.einsum(
        "k,mkn->mn", np.concatenate((gain, beside))[: derivatives.shape[1]], derivatives
    )
    return residual_of(problem.seen(np.concatenate((columns[:k], by_theta))), rows[1:])
