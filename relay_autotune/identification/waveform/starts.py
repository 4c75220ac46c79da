# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Where a fit begins, and which models the record makes plausible.

For a FOPDT a grid of dead times and lags is searched; from its fit every other structure begins.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.waveform.problem import (
    NEGLIGIBLE,
    Problem,
    distance,
    is_above,
    pulse,
)
from relay_autotune.identification.waveform.rational import Inputs, columns_of, unit_steps
from relay_autotune.identification.waveform.separable import (
    TRIAL,
    Trial,
    evaluate,
    information_criterion,
    predicted_cost,
    refine,
    residual_of,
)
from relay_autotune.process.factors import Quadratic
from relay_autotune.process.response import response
from relay_autotune.process.structures import Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.moves import (
    answering_time,
    changes_within,
    first_response,
    large_changes,
    moves_always,
)
from relay_autotune.record.record import Input, PiecewiseConstant

# Least number of samples in each period of an oscillation of the process.
_SAMPLES_A_SWING = 4.0
# Shortest response of a process, in intervals between samples.
_SHORTEST_RESPONSE = 0.5


def is_unobservable(
    model: TransferFunction, interval: float, length: float, pushed: float = math.inf
) -> bool:
    """Return whether a fit owes its small residual to what happens between the samples.

    It rings faster than the samples show: noise alone leads to such a resonance, of any height,
    and it would limit every gain. Or its whole response falls between two samples: so a
    controller responds, where command and measurement were swapped. Or its response turns into
    the direction of its gain later than any push of the command lasted: what the record shows is
    the other direction, and the rest is a drift.

    :param model: the fit.
    :param interval: between samples [s].
    :param length: of the record [s].
    :param pushed: longest time for which the command acted in one direction [s]; the record's
        length where it is longer.
    """
    swing = _SAMPLES_A_SWING * interval / (2.0 * math.pi)
    if any(c.imag != 0.0 and abs(c) < swing for c in model.time_constants):
        return True
    if not model.integrators and model.response_time < _SHORTEST_RESPONSE * interval:
        return True
    if not (model.is_stable or model.integrators) or all(zero.real >= 0.0 for zero in model.zeros):
        return False
    return (
        float(response(model, np.array([min(pushed, length)]), pulse())[0]) * model.process_sign
        <= 0.0
    )


_GRID_SAMPLES = 240
# Number of rates that are tried, and the lowest one's time over the longest dead time; how many
# times as much as another one leaves, after which slower ones are hopeless; to which part the best
# one is known, and the largest share of the squares that it leaves.
_RATES, _LONGER, _TOO_SLOW, _RATE_KNOWN, _LESS = 16, 4.0, 3.0, 0.01, 0.8
_BEST = 3
_COARSE = 1e-4
# Rounds of steps on few samples: largest number of steps, and how many starts take them.
_ROUNDS = ((5, 99), (16, 3))
# Ratio of the predicted mean square to the least one, from which a fit is given up. Below the
# second, in squares of the range, the residual is curvature, which the prediction neglects.
_HOPELESS, _CLEAN = 6.0, 1e-6
# Slow lags of an inverse response at the start, relative to the fast one.
_SLOWER = (2.0, 6.0, 20.0)
# Damping at the start of what rings, and its least number of periods in the record.
_RINGING, _SWINGS = 0.05, 3
# Dampings at the start; shares of the dead time that fast lags have, and what a zero leaves of it.
_DAMPINGS, _SHARES_OF_FAST, _HIDDEN = (1.35, 0.9, 0.4), (0.3, 0.7, 3.0), 0.3
# Largest distance, in unit steps, of two fits that count as one; and the ratio of two fits' sums
# of squares up to which all samples decide between them.
_SAME = 0.02
_UNDECIDED = 1.05

# Levels at which an actuator may end, and lags of which any process is about a sum.
ENDS, _LAGS = 9, 8

# Dead times tried at the start, as shares of the longest one.
# Noise may make a relay switch faster than the process answers, hence those beyond 1.
_SHARES = (
    *(0.0, 0.01, 0.03, 0.06, 0.1, 0.15, 0.2, 0.27, 0.35, 0.45, 0.55, 0.67, 0.8, 0.95),
    *(1.2, 1.5, 1.9, 2.4),
)
# What starts have more than a dead time of the grid, as a share of its least step.
_OFF_GRID = 0.1
# Second lags of a process that grows by itself, relative to the time constant of its growth.
_RATIOS = (0.1, 0.3, 1.0, 3.0)


def time_scales(problem: Problem) -> tuple[float, float]:
    """Return the shortest time that samples resolve, and the longest possible dead time [s].

    :param problem: its inputs change within the samples, or between those that were left out.
    """
    scales = []
    for part, u in zip(problem.experiments, problem.inputs, strict=True):
        time = problem.time[part]
        gaps = np.diff(time)
        shortest = float(np.median(gaps[gaps > 0.0]))
        inside = changes_within(u, time)
        rest = answering_time(time, u)
        if isinstance(u, PiecewiseConstant) and moves_always(time, u):
            large = large_changes(u)
            inside = large[(large >= time[0]) & (large < time[-1])]
        if inside.size >= 4:
            # In a relay test the process answers one switch before the next.
            rest = min(1.1 * float(np.max(np.diff(inside))), rest)
        scales.append((shortest, rest))
    return min(s for s, _ in scales), min(longest for _, longest in scales)


def latest_dead_times(problem: Problem, sign: int) -> tuple[float, float]:
    """Return the longest dead time of a gain below zero, and of one above [s].

    In a relay test a load may come before the response, and the cycles show the dead time: there
    only the direction is known.

    :param problem: the problem.
    :param sign: the direction in which a relay worked, 1 or -1; 0: not known.
    :return: minus infinity for a direction that the relay or the first response rules out.
    :raises IdentificationError: if the records rule out both.
    """
    if sign:
        return (-math.inf, math.inf) if sign > 0 else (math.inf, -math.inf)
    parts = zip(problem.experiments, problem.inputs, strict=True)
    found = (first_response(problem.time[part], problem.y[part], u) for part, u in parts)
    each = list(zip(*found, strict=True))
    below, above = map(min, each)
    if max(below, above) < 0.0:
        one, other = sorted(1 + direction.index(-math.inf) for direction in each)
        raise IdentificationError(
            f"the first answers of records {one} and {other} go in opposite directions, and no "
            "model explains both: check their columns and signs, or take them one by one"
        )
    return below, above


def coarse(problem: Problem) -> Problem:
    """Return the problem of a few hundred samples."""
    return problem.thinned(_GRID_SAMPLES)


def multistart(
    problem: Problem, thetas: Sequence[FloatArray], least: float = math.inf, sign: int = 0
) -> Trial | None:
    """Return the best fit that any of some starts leads to; None where it is hopeless.

    All take a few steps on few samples, the best ones some more, and all samples decide between
    the last two.

    :param problem: the problem.
    :param thetas: starts.
    :param least: mean square of the best structure so far, in squares of the range: a fit that
        will not come near it is given up.
    :param sign: of the gain, 1 or -1, which only fits have that come to no other; 0: any.
    """
    few = coarse(problem)
    bound = _HOPELESS * max(least, _CLEAN) * few.time.size
    reached: list[Trial] = []
    starts: Sequence[FloatArray | Trial] = thetas
    for steps, count in _ROUNDS:
        reached = [refine(few, s, tolerance=_COARSE, most=steps) for s in starts[:count]]
        reached = _distinct(problem, reached)
        starts = reached = [s for s in reached if sign * s.coefficients[0] >= 0.0] or reached
        if not reached or min(predicted_cost(few, s) for s in reached) > bound:
            return None
    if reached[0].cost > bound:
        # It may not have converged yet.
        reached = [refine(few, reached[0], tolerance=TRIAL)]
        if reached[0].cost > bound:
            return None
    last = [s for s in reached if s.cost <= _UNDECIDED * reached[0].cost][:2]
    fits = [refine(problem, s.theta, tolerance=TRIAL, damping=s.damping) for s in last]
    return min(fits, key=lambda s: s.cost)


def best_of(problem: Problem, thetas: Sequence[FloatArray]) -> Trial:
    """Return the best fit that any of some starts leads to, whatever it leaves.

    :param problem: the problem.
    :param thetas: starts, at least one.
    """
    found = multistart(problem, thetas)
    assert found is not None
    return found


def _distinct(problem: Problem, states: list[Trial]) -> list[Trial]:
    """Return distinct states, the best first."""
    chosen: list[Trial] = []
    for state in sorted(states, key=lambda s: s.cost):
        size = unit_steps(problem.structure, state.theta)
        if all(np.abs((state.theta - c.theta) / size).max() >= _SAME for c in chosen):
            chosen.append(state)
    return chosen


def start_fopdt(problem: Problem, sign: int = 0) -> list[FloatArray]:
    """Return the best few of a grid of (log tau, D) for a FOPDT.

    :param problem: with a FOPDT structure.
    :param sign: of the gain, 1 or -1; 0: not known.
    """
    shortest, longest = time_scales(problem)
    logs = np.log(_lags(shortest, longest, 14))[:, None]
    dead_times = np.tile(longest * np.array(_SHARES), (logs.size, 1))
    return _best_of_grid(problem, logs, dead_times, latest_dead_times(problem, sign))


def best_fopdt(problem: Problem, sign: int = 0) -> Trial:
    """Return the best fit of a FOPDT.

    :param problem: with a FOPDT structure.
    :param sign: of the gain, 1 or -1; 0: not known.
    """
    return best_of(problem, start_fopdt(problem, sign))


def start_unstable(problem: Problem) -> list[FloatArray]:
    """Return the best few of a grid of lags and D for a process that grows by itself.

    A controller may hold one that is many times faster than the record is long, but none whose
    dead time is longer than the time constant of its growth.

    :param problem: with an unstable structure of one lag, or of two.
    """
    shortest, longest = time_scales(problem)
    growing = np.log(_lags(shortest, longest, 14))[:, None]
    logs = growing
    if problem.structure.order > 1:
        pairs = itertools.product(growing[:, 0], np.log(_RATIOS))
        logs = np.array([(one, one + ratio) for one, ratio in pairs])
    dead_times = np.exp(logs[:, :1]) * np.array(_SHARES[:14:2])
    return _best_of_grid(problem, logs, dead_times, (math.inf, math.inf))


def _best_of_grid(
    problem: Problem, logs: FloatArray, dead_times: FloatArray, latest: tuple[float, float]
) -> list[FloatArray]:
    """Return the best few of some theta, on few samples.

    :param problem: any structure without a zero.
    :param logs: parameters of the factors, shape (g, m - 1).
    :param dead_times: of each, ascending from 0 [s], shape (g, d).
    :param latest: as of :func:`latest_dead_times`.
    """
    few = problem.thinned(_GRID_SAMPLES, scattered=True)
    rows = zip(logs, dead_times, strict=True)
    costs = np.array([_costs(few, own, each, latest) for own, each in rows])
    best: list[FloatArray] = []
    for flat in np.argsort(costs, axis=None, kind="stable"):
        i, j = np.unravel_index(flat, costs.shape)
        theta = np.append(logs[i], dead_times[i, j] + _OFF_GRID * dead_times[i, 1])
        if all(_apart(theta, other) for other in best):
            best.append(theta)
        if len(best) == _BEST:
            break
    return best


def _lags(shortest: float, longest: float, count: int) -> FloatArray:
    """Return lags that span what a record may show, each a multiple of the one before [s]."""
    return np.geomspace(0.5 * min(shortest, 0.1 * longest), 30.0 * longest, count)


def _apart(a: FloatArray, b: FloatArray) -> bool:
    return bool(np.abs(a - b)[:-1].max() > 0.5) or abs(math.log(a[-1] / b[-1])) > 0.5


def _costs(
    problem: Problem, logs: FloatArray, dead_times: FloatArray, latest: tuple[float, float]
) -> FloatArray:
    """Return the sums of squares that lags and the terms beside them leave, for each dead time.

    Half a period later, a limit cycle of the other sign looks much the same: a lag of the wrong
    sign counts as no explanation, as does one that begins after the first response.
    """
    theta = np.append(logs, 0.0)
    along, power, total = (np.zeros(dead_times.size) for _ in range(3))
    every = zip(problem.experiments, problem.delayed, problem.lines, strict=True)
    for part, inputs, fixed in every:
        time, y = problem.time[part], problem.y[part]
        # A dead time only shifts a response: one pass over shifted samples gives all rows.
        moved = time - dead_times[:, None]
        response, *shifted = (
            shifted_columns(problem.structure, theta, moved, each)[0] for each in inputs.each
        )
        for free, _ in problem.free_motions(theta, time, slopes=False):
            fixed = np.concatenate((fixed, free))
        rows = np.stack(
            [np.broadcast_to(row, moved.shape) for row in (y, response, *fixed, *shifted)]
        )
        if problem.colour is not None:
            rows = problem.colour.whitened(rows)
        y, response, *beside = rows
        terms = np.stack(beside, -1)
        basis, _ = np.linalg.qr(terms / np.maximum(np.linalg.norm(terms, axis=1), 1e-300)[:, None])
        left, response = (
            rows - np.einsum("dnk,dk->dn", basis, np.einsum("dnk,dn->dk", basis, rows))
            for rows in (y, response)
        )
        power += np.einsum("dn,dn->d", response, response)
        along += np.einsum("dn,dn->d", response, left)
        total += np.einsum("dn,dn->d", left, left)
    power[power == 0.0] = 1.0
    refused = dead_times > np.where(along < 0.0, *latest)
    costs = total - np.where(refused, 0.0, along**2 / power)
    return np.where(dead_times > problem.latest, np.inf, costs)


def likeliest_ends(problem: Problem) -> tuple[float, float] | None:
    """Return the levels at which an actuator ends, as few samples tell without a structure.

    All pairs of some levels are tried. What an actuator makes of a command u is ``(|u - low| -
    |u - high|)/2``, with u in place of an infinite one, and the process is the best sum of several
    lags behind one dead time: one lag alone misses more than ends explain. Each end may be off its
    level, to first order. Between ends that are nearer than the levels, an actuator is a switch,
    and none are taken.

    :param problem: of commands that are held, with a FOPDT structure.
    :return: None: that it follows all is likeliest, by Schwarz's criterion.
    """
    few, (shortest, longest) = problem.thinned(_GRID_SAMPLES, scattered=True), time_scales(problem)
    taus = _lags(shortest, longest, _LAGS)
    dead_times = longest * np.array(_SHARES[:14:2])
    levels = np.linspace(problem.levels[0], problem.levels[-1], ENDS + 2)[1:-1].tolist()
    ends = (-math.inf, *levels, math.inf)
    measured, answers = [], []
    parts = zip(few.experiments, few.inputs, few.delayed, few.lines, strict=True)
    for part, u, delayed, line in parts:
        time = few.time[part]
        moved = time - dead_times[:, None]
        of_levels = (of(u, level) for of in (distance, is_above) for level in levels)
        inputs = (delayed.each[0], *of_levels)
        every = [
            shifted_columns(few.structure, np.array((math.log(tau), 0.0)), moved, each)[0]
            for tau in taus
            for each in inputs
        ]
        seen = np.concatenate((few.y[part][None], *every, line))
        if few.colour is not None:
            seen = few.colour.whitened(seen)
        left = residual_of(seen[: -len(line)], seen[-len(line) :])
        measured.append(left[0])
        answers.append(left[1:].reshape(_LAGS, len(inputs), dead_times.size, time.size))
    y, rows = np.concatenate(measured), np.concatenate(answers, axis=-1).swapaxes(0, 2)

    def score(pair: tuple[int, int]) -> float:
        low, high = (at % (ENDS + 1) for at in pair)
        finite = [at for at in (low, high) if at]
        costs = []
        # Of each dead time, the answers to all inputs, one for each lag.
        for of in rows:
            felt = 0.5 * (of[low] + (-of[high] if high else of[0]))
            gains = np.linalg.lstsq(felt.T, y, rcond=None)[0]
            shifts = (gains @ of[ENDS + at] for at in finite)
            costs.append(float(np.sum(residual_of(y, np.stack((*felt, *shifts))) ** 2)))
        return information_criterion(min(costs), y.size, len(finite), y.size * NEGLIGIBLE**2)

    pairs = itertools.combinations(range(ENDS + 2), 2)
    apart = (p for p in pairs if p[1] - p[0] > 1 or p[0] == 0 or p[1] > ENDS)
    low, high = min(apart, key=score)
    return (ends[low], ends[high]) if high - low <= ENDS else None


def likeliest_rate(problem: Problem) -> float | None:
    """Return the fastest change of a command that is followed, as few samples tell [u/s].

    The process is a lag behind a dead time.

    :param problem: of commands that are held, with a FOPDT structure.
    :return: None: that any is followed explains about as much.
    """
    few, (shortest, longest) = coarse(problem), time_scales(problem)
    # By which the command crosses its range in a sample, and in a few of the longest dead times.
    rates = float(np.ptp(problem.levels)) / np.geomspace(shortest, _LONGER * longest, _RATES)
    fits: list[Trial] = []
    for rate in rates:
        fits.append(best_fopdt(replace(few, rate=rate)))
        if fits[-1].cost > _TOO_SLOW * min(fit.cost for fit in fits):
            break
    k = min(range(len(fits)), key=lambda i: fits[i].cost)
    if k in (0, _RATES - 1):
        return None

    def cost(log: float) -> float:
        return refine(replace(few, rate=math.exp(log)), fits[k].theta, tolerance=TRIAL).cost

    within = np.log((rates[k + 1], rates[k - 1]))
    found = minimize_scalar(cost, bounds=within, method="bounded", options={"xatol": _RATE_KNOWN})
    return math.exp(found.x) if found.fun < _LESS * fits[0].cost else None


def shifted_columns(
    structure: Structure, theta: FloatArray, moved: FloatArray, u: Input
) -> FloatArray:
    """Return a structure's responses at shifted times, in one pass over all of them.

    :param structure: the structure.
    :param theta: shape (m,).
    :param moved: sample times less each shift [s], shape (rows, n).
    :param u: the input.
    :return: shape (k, rows, n).
    """
    order = np.argsort(moved, axis=None, kind="stable")
    columns, _ = columns_of(structure, theta, moved.ravel()[order], Inputs((u,)), slopes=False)[0]
    found = np.empty_like(columns)
    found[:, order] = columns
    return found.reshape(-1, *moved.shape)


@dataclass(frozen=True)
class Guess:
    """Where fits begin: at the FOPDT that fits best.

    :param tau: its lag [s].
    :param dead_time: its dead time [s].
    :param frequency: at which starts have its response, about that of a relay's oscillation
        [rad/s].
    :param shortest: least time of a start [s].
    :param ringing: at which most of what it leaves oscillates [rad/s].
    """

    tau: float
    dead_time: float
    frequency: float
    shortest: float
    ringing: float

    @classmethod
    def of(cls, problem: Problem, fopdt: Trial) -> Guess:
        """Return what a FOPDT's fit says.

        :param problem: the problem with its FOPDT structure.
        :param fopdt: its best fit.
        """
        shortest, longest = time_scales(problem)
        # A FOPDT that fits badly may run off to an integrator, which is no start for the others.
        tau, least = min(math.exp(float(fopdt.theta[0])), 3.0 * longest), 0.1 * shortest
        dead_time = max(float(fopdt.theta[1]), least)
        point = ultimate_point(TransferFunction.fopdt(1.0, tau, dead_time))
        frequency = 1.0 / longest if point is None else point.frequency
        return cls(tau, dead_time, frequency, least, _ringing(problem, fopdt))

    def equal_lags(self, order: int) -> tuple[float, float]:
        """Return tau and D of n equal lags with the FOPDT's response at one frequency [s]."""
        w = self.frequency
        square = (1.0 + (w * self.tau) ** 2) ** (1.0 / order) - 1.0
        tau = max(math.sqrt(square) / w, self.shortest)
        phase = w * self.dead_time + math.atan(w * self.tau) - order * math.atan(w * tau)
        return tau, max(phase / w, self.shortest)

    def starts(self, structure: Structure) -> list[FloatArray]:
        """Return starts of a structure: all its lags alike, or one slow and the others fast.

        The slow one is the FOPDT's, or an integrator; the fast ones take their share of its dead
        time, or are longer. A pair that hardly damps is found only from near its frequency, with
        which the FOPDT's error oscillates. A zero can look like a dead time, or hide it.

        :param structure: any that does not grow by itself.
        """
        factors = structure.factors
        if not factors:
            return [np.array([self.dead_time])]
        found = []
        stable = not structure.integrators
        may_ring = any(isinstance(f, Quadratic) for f in factors)
        if stable:
            tau, dead_time = self.equal_lags(structure.order)
            alike = [(tau, _DAMPINGS[0], dead_time)]
            if may_ring:
                alike += [(tau, zeta, dead_time) for zeta in _DAMPINGS[1:]]
                alike.append((1.0 / self.ringing, _RINGING, self.shortest))
            for lag, zeta, later in alike:
                pairs = ([lag, zeta] if isinstance(f, Quadratic) else [lag] for f in factors)
                found.append(np.array([*map(math.log, itertools.chain(*pairs)), later]))
        if may_ring or len(factors) > 1 or not stable:
            for slow in range(len(factors)) if stable else [-1]:
                for share in _SHARES_OF_FAST[:1] if stable else _SHARES_OF_FAST:
                    fast = max(share * self.dead_time, self.shortest)
                    logs: list[float] = []
                    for i, factor in enumerate(factors):
                        large = self.tau if i == slow else fast
                        pair = isinstance(factor, Quadratic)
                        logs += _two_lags(large, fast) if pair else [math.log(large)]
                    found.append(np.array([*logs, max(1.0 - share, 0.2) * self.dead_time]))
        if structure.zero is not None:
            found += [np.append(theta[:-1], _HIDDEN * theta[-1]) for theta in found]
        return found

    def of_opposite_sign(self, structure: Structure) -> list[FloatArray]:
        """Return starts of an inverse response, of which the FOPDT shows the fast part.

        :param structure: with a zero, and two lags, or an integrator and one.
        """
        if structure.integrators:
            return [np.array((math.log(self.tau), self.dead_time))]
        slow = (ratio * self.tau for ratio in _SLOWER)
        return [np.array((*_two_lags(large, self.tau), self.dead_time)) for large in slow]


def _ringing(problem: Problem, fopdt: Trial) -> float:
    """Return the frequency at which most of what a FOPDT leaves oscillates [rad/s].

    :param problem: the problem with its FOPDT structure.
    :param fopdt: its best fit.
    """
    part = max(problem.experiments, key=lambda p: p.stop - p.start)
    # The fit may have had other samples: those of a first dead time are left out later.
    time, left = problem.time[part], evaluate(problem, fopdt.theta).residual[part]
    even = np.linspace(time[0], time[-1], time.size)
    power = np.abs(np.fft.rfft(np.interp(even, time, left) * np.hanning(time.size)))
    power[:_SWINGS] = 0.0
    return 2.0 * math.pi * max(int(np.argmax(power)), _SWINGS) / float(np.ptp(time))


def _two_lags(large: float, small: float) -> list[float]:
    """Return log(1/w0) and log zeta of two lags, at least a little apart."""
    pair = math.sqrt(large * small)
    return [math.log(pair), math.log(max((large + small) / (2.0 * pair), 1.05))]
