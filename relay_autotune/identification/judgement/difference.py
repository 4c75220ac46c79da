# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a record shows of a process beside the model.

No structure is true. What a record shows of the process beside the model is estimated without any
structure (a model-error model, Ljung 1999): the residual of the simulation is regressed on the
past command,

    e(t) = sum_j g_j v_j(t) + nuisances + noise,

with v_j the mean of the command over a bin of lags, so that g_j is an increment of the step
response of the difference, and the noise an autoregression. The increments have a normal prior
about zero that decays with the lag; its size is the most likely one (stochastic embedding:
Goodwin, Gevers and Ninness 1992), which is zero where noise alone explains the residual. So the
difference has draws, as the model has, and each process that the record allows is a draw of both.

What stands beside the model from the only move of a command on, as a load or a drift does, may be
a part of the response as well: a share of the draws has it as such, by the odds of the two.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.posterior import DRAWS
from relay_autotune.identification.waveform.residuals import (
    IMITATES_A_DRIFT,
    Colour,
    colour_cost,
    colour_of,
)
from relay_autotune.identification.waveform.separable import residual_of
from relay_autotune.process.model_set import ModelErrors
from relay_autotune.process.response import response
from relay_autotune.record.excitation import LEAST_SAMPLES
from relay_autotune.record.moves import only_move
from relay_autotune.record.record import PiecewiseConstant, Record

_BINS = 48
_MOST_COMPARED = 2000
# Responses of the model in which the prior decays: a resonance beside a fast lag outlasts it, but
# so does what imitates a slow disturbance.
_DECAYS = (3.0, 12.0)
# Ratios of the powers of difference and noise, of which the most likely one is taken.
_RATIOS = np.concatenate(([0.0], np.geomspace(1e-3, 1e12, 61)))
_TURNS = 2
# Length of a piece with a drift of its own, times w_u, about ten periods of the loop, and least
# number of its samples.
_A_PIECE, _LEAST_PIECE = 60.0, 8
# Largest factor of an ultimate point from the model's, and frequencies at which it is sought.
_FAR, _NEAR = 4.0, 241
# Shares below which a direction of the nuisances, and the square of one of the increments, are
# those of rounding.
_DEPENDENT, _ROUNDING = 1e-9, 1e-13


@dataclass(frozen=True, eq=False)
class Difference:
    """The response that a record shows beside the model's, without a structure.

    :param lags: ends of their bins [s], shape (m + 1,).
    :param mean: increments of its step response [y/u], shape (m,).
    :param root: of their covariance, shape (m, k).
    :param residual: rms of what neither model nor difference explain [y].
    :param unexplained: share of the measurement's variance that neither they nor noise explain,
        beside a slow drift.
    :param lowest: frequency of which the record shows one radian [rad/s].
    :param late: increments of what stands beside the model, as a response [y/u], shape (m,).
    :param share: probability that it is one.
    """

    lags: FloatArray
    mean: FloatArray
    root: FloatArray
    residual: float
    unexplained: float
    lowest: float
    late: FloatArray
    share: float

    def draws(self, count: int, rng: np.random.Generator) -> ModelErrors:
        """Return responses drawn from its posterior.

        :param count: how many.
        :param rng: the source.
        """
        normal = rng.standard_normal((count, self.root.shape[1]))
        late = np.outer(rng.random(count) < self.share, self.late)
        return ModelErrors(self.lags, self.mean + normal @ self.root.T + late, self.lowest)


def widened(found: Identification, beside: Difference | None) -> Identification:
    """Return a model whose intervals of K_u and w_u hold what the record shows beside it.

    To the variances over the models those are added of the logarithms of the ratios that the
    ultimate points of the model with each draw of the difference have to its own, and that of
    the unequal effects of commands, with which K_u differs from side to side.

    :param found: the model, with the intervals of models alone.
    :param beside: what the record shows beside it; None: it cannot tell.
    """
    sides = abs(found.ultimate_gain) * 0.5 * abs(found.effects[0] - found.effects[1])
    found = replace(found, ultimate_gain_std=math.hypot(found.ultimate_gain_std, sides))
    if beside is None or not math.isfinite(found.ultimate_gain_std):
        return found
    model, own = found.model, found.ultimate_frequency
    w = own * np.geomspace(1.0 / _FAR, _FAR, _NEAR)
    alone = model(1j * w)[:, None]
    ratio = 1.0 + beside.draws(DRAWS, np.random.default_rng(0))(1j * w) / alone
    phase = model.phase(w)[:, None] + np.unwrap(np.angle(ratio), axis=0)
    size = np.log(np.abs(alone * ratio)) + math.log(abs(found.ultimate_gain))
    away = np.log(w / own)
    # The crossing of -180 degrees that is nearest to the model's; without one, the end before it.
    above = phase > -math.pi
    crossed = above[:-1] & ~above[1:]
    far = np.where(crossed, np.abs(away[:-1])[:, None], math.inf)
    none = np.where(above[-1], w.size - 2, 0)
    cell, each = np.where(crossed.any(axis=0), far.argmin(axis=0), none), np.arange(DRAWS)
    before, after = phase[cell, each], phase[cell + 1, each]
    share = np.clip((before + math.pi) / (before - after), 0.0, 1.0)
    sizes = (1.0 - share) * size[cell, each] + share * size[cell + 1, each]
    times = (1.0 - share) * away[cell] + share * away[cell + 1]
    gain = found.ultimate_gain * math.sqrt(float(np.mean(sizes**2)))
    frequency = own * math.sqrt(float(np.mean(times**2)))
    return replace(
        found,
        ultimate_gain_std=math.hypot(found.ultimate_gain_std, gain),
        ultimate_frequency_std=math.hypot(found.ultimate_frequency_std, frequency),
    )


def difference(found: Identification, record: Record) -> Difference | None:
    """Return the response that a record shows beside a model's; None where it cannot tell.

    :param found: the model, and what was estimated with it: of that the two effects of the
        command count, and the rest has a size of its own.
    :param record: the record.
    """
    try:
        return _difference(found, record)
    except (ModelError, np.linalg.LinAlgError):
        return None


def _difference(found: Identification, record: Record) -> Difference | None:
    model = found.model
    if model.grows or len(record) < LEAST_SAMPLES:
        return None
    u = record.input()
    few = np.unique(np.linspace(0, len(record) - 1, _MOST_COMPARED).astype(np.int64))
    time = record.time[few]
    answer = response(model, time, found.felt_input(u))
    # The measurement's zero and the command before the record are not known.
    before = response(model, time, PiecewiseConstant(time[:1], np.ones(1), 0.0))
    beside = [np.ones(time.size), before]
    if len(found.fitted) == len(record):
        beside.append(found.fitted[few] - answer)
    left, nuisances = record.measurement[few] - answer, np.stack(beside)
    known = np.isfinite(nuisances).all(axis=0)
    if np.count_nonzero(known) < LEAST_SAMPLES:
        return None
    # No bin is narrower than the time between samples, which tell nothing of what is within it.
    shortest = max(float(np.median(np.diff(time))), 1e-6 * record.duration)
    widths = np.geomspace(1.0, record.duration / shortest, _BINS)
    edges = shortest * np.concatenate(([0.0], np.unique(np.round(widths))))
    past = _integral(u, time[known, None] - edges)
    moved = ((past[:, :-1] - past[:, 1:]) / np.diff(edges)).T
    if not np.any(moved):
        return None
    whole = model.response_time or record.duration
    # Of what is faster than the samples they tell nothing.
    whole = max(whole, shortest)
    lag = np.sqrt(np.maximum(edges[:-1], 0.5 * shortest) * edges[1:])
    # An impulse response without jumps has increments as its bins are wide, which is as their lag,
    # and alike where the lags are (a kernel of correlated decay, Chen, Ohlsson and Ljung 2012; in
    # the form of Matern, since the response to what lies between two frequencies of the command
    # differs little from that to both).
    sizes = (lag / whole * np.exp(-lag / (decay * whole)) for decay in _DECAYS)
    ratio = math.sqrt(3.0) * np.abs(np.subtract.outer(np.log(lag), np.log(lag)))
    alike = (1.0 + ratio) * np.exp(-ratio) + 1e-9 * np.eye(lag.size)
    root = np.linalg.cholesky(alike)
    priors = [size[:, None] * root for size in sizes]
    shown = _posterior(left[known], nuisances[:, known], moved, priors)
    residual = math.sqrt(float(np.mean(shown.left**2)))
    w = found.ultimate_frequency
    pieces = record.duration * (w if math.isfinite(w) else 1.0 / whole) / _A_PIECE
    pieces = max(int(min(pieces, shown.left.size / _LEAST_PIECE)), 1)
    noise, total = (
        _power_beside_lines(time[known], x, pieces)
        for x in (shown.left, record.measurement[few[known]])
    )
    unexplained = max(noise - record.noise**2, 0.0) / max(total, 1e-300)
    lowest = 1.0 / record.duration
    late, share = np.zeros(edges.size - 1), 0.0
    begin, at = only_move(u, time), time[known]
    if len(beside) == 3 and begin is not None:
        curve, size = nuisances[2, known], np.diff(u.levels)[u.times == begin]
        curve = np.where(at < begin, 0.0, curve - np.interp(begin, at, curve))
        response_too = np.vstack((nuisances[:2, known], curve))
        other = _posterior(left[known], response_too, moved, priors)
        share = 1.0 / (1.0 + math.exp(min(0.5 * (other.unlikely - shown.unlikely), 700.0)))
        late = np.diff(np.interp(begin + edges, at, curve)) / size
    return Difference(edges, shown.mean, shown.root, residual, unexplained, lowest, late, share)


def _power_beside_lines(time: FloatArray, x: FloatArray, pieces: int) -> float:
    """Return the variance of samples about a line of its own in each of some pieces.

    A disturbance so slow is no evidence for or against a model near its ultimate frequency.

    :param time: s, shape (n,).
    :param x: shape (n,).
    :param pieces: with as many samples each.
    """
    parts = zip(np.array_split(time, pieces), np.array_split(x, pieces), strict=True)
    left = [residual_of(part, np.stack((np.ones(t.size), t - t[0]))) for t, part in parts]
    return sum(float(e @ e) for e in left) / (x.size - 2 * pieces)


@dataclass(frozen=True, eq=False)
class _Posterior:
    """Increments of the difference in noise of one colour.

    :param mean: of the increments, shape (m,).
    :param root: of their covariance, shape (m, k).
    :param left: what they and the nuisances leave [y], shape (n,).
    :param unlikely: BIC of the samples with the most likely size of the prior.
    """

    mean: FloatArray
    root: FloatArray
    left: FloatArray
    unlikely: float


def _posterior(
    left: FloatArray, nuisances: FloatArray, moved: FloatArray, priors: Sequence[FloatArray]
) -> _Posterior:
    """Return the posterior of increments in the most likely colour of the noise.

    Noise and difference are estimated in turn (Cochrane and Orcutt 1949), once from noise that
    explains all and once from a difference that does.

    :param left: residual of the simulation [y], shape (n,).
    :param nuisances: curves of any size, shape (p, n).
    :param moved: responses to an increment each, shape (m, n).
    :param priors: roots of their relative covariances, each less likely than the one before
        unless the samples show it, shape (m, m).
    """
    basis = np.linalg.svd(nuisances, full_matrices=False)[2]
    found = []
    noise_alone = colour_of([left - (left @ basis.T) @ basis])
    for (k, prior), colour in itertools.product(enumerate(priors), (noise_alone, None)):
        for _ in range(_TURNS):
            shown = _in_colour(colour, left, nuisances, moved, prior)
            found.append(replace(shown, unlikely=shown.unlikely + k * IMITATES_A_DRIFT))
            colour = colour_of([shown.left])
    return min(found, key=lambda f: f.unlikely)


def _in_colour(
    colour: Colour | None,
    left: FloatArray,
    nuisances: FloatArray,
    moved: FloatArray,
    prior: FloatArray,
) -> _Posterior:
    def white(x: FloatArray) -> FloatArray:
        return x if colour is None else colour.whitened(x)

    aside = white(nuisances)
    _, values, shapes = np.linalg.svd(aside, full_matrices=False)
    basis = shapes[values > _DEPENDENT * values[0]]

    def beside(x: FloatArray) -> FloatArray:
        return x - (x @ basis.T) @ basis

    free = beside(white(left))
    rows, n = beside(white(prior.T @ moved)), free.size
    squares, axes = np.linalg.eigh(rows @ rows.T)
    known = squares > _ROUNDING * squares[-1]
    axes, values = axes[:, known], np.sqrt(squares[known])
    along = (axes.T @ (rows @ free)) / values
    # Powers of the difference over those of the noise.
    power = np.outer(_RATIOS, (values / values[-1]) ** 2)
    total = float(free @ free) - np.sum(along**2 * power / (1.0 + power), axis=1)
    noise = np.maximum(total, _ROUNDING * float(free @ free)) / n
    unlikely = n * np.log(noise) + np.sum(np.log1p(power), axis=1)
    k = int(np.argmin(unlikely))
    size = math.sqrt(_RATIOS[k]) / values[-1]
    reached = size**2 * values / (1.0 + power[k])
    turned = prior @ axes
    mean = turned @ (reached * along)
    root = turned * (size * np.sqrt(noise[k] / (1.0 + power[k])))
    rest = left - mean @ moved
    rest = rest - np.linalg.lstsq(aside.T, white(rest), rcond=None)[0] @ nuisances
    return _Posterior(mean, root, rest, float(unlikely[k]) + colour_cost(colour, n))


def _integral(u: PiecewiseConstant, at: FloatArray) -> FloatArray:
    """Return the integral of the command's deviation from its first value up to given times."""
    if u.times.size == 0:
        return np.zeros(at.shape)
    away = u.values - u.initial
    before = np.concatenate(([0.0], np.cumsum(away[:-1] * np.diff(u.times))))
    k = np.searchsorted(u.times, at, side="right") - 1
    value = before[k] + away[k] * (at - u.times[k])
    return np.where(k >= 0, value, 0.0)
