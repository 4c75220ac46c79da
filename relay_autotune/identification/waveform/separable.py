# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Separable least squares: linear coefficients by QR, the others by Levenberg and Marquardt.

Variable projection (Golub and Pereyra 1973) with Kaufman's approximation of the Jacobian.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.rational import (
    columns_of,
    free_motion,
    stepped,
    unit_steps,
)
from relay_autotune.identification.waveform.residuals import Colour
from relay_autotune.process.structures import Structure
from relay_autotune.record.record import Input, PiecewiseConstant

# Residual that is rounding, as a share of the measurement's range.
NEGLIGIBLE = 1e-10
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
# The fractional parts of its multiples are spread evenly, without a period (Weyl 1916).
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# Range of a rest, in steps of the sensor, in which nothing moves.
_A_STEP = 1.5


@dataclass(frozen=True)
class Problem:
    """Samples, inputs and structure, with the terms that are estimated beside the model.

    The samples of several experiments on one process follow one another. They share gain and
    theta; each has its own offset, drift and initial state.

    :param time: sample times, in each experiment not decreasing [s], shape (n,).
    :param y: what is fitted, in units of its own range, shape (n,).
    :param inputs: the input of each experiment.
    :param structure: the structure.
    :param index: number of each sample among all that were recorded, shape (n,).
    :param bounds: number of the first sample of each experiment.
    :param drift: True: a straight line is estimated, not only an offset.
    :param relaxation: True: a free initial state is estimated.
    :param weight: square root of each sample's weight, shape (n,); None: all are equal.
    :param past: True: the command before each experiment is estimated: the process rested, or
        moved freely, under another level than its first one.
    :param unequal: True: commands above and below the first one have effects of their own.
    :param play: True: play between command and process is estimated, which delays each reversal.
    :param load: when a step of the load came, in the first experiment [s]; its size and a small
        shift of its time are estimated. None: none came.
    :param friction: True: dry friction is estimated: a command against each motion, and what it
        takes of the command while the process stands still.
    :param motions: the direction in which the measurement moves, 1 or -1, and the command from
        its first level while it stands still; empty: not seen.
    :param colour: of the noise; None: white.
    """

    time: FloatArray
    y: FloatArray
    inputs: tuple[Input, ...]
    structure: Structure
    index: NDArray[np.int64]
    bounds: tuple[int, ...] = (0,)
    drift: bool = False
    relaxation: bool = False
    weight: FloatArray | None = None
    past: bool = False
    unequal: bool = False
    play: bool = False
    load: float | None = None
    friction: bool = False
    motions: tuple[PiecewiseConstant, ...] = ()
    colour: Colour | None = None

    @property
    def past_is_open(self) -> bool:
        """True if no command is known from before an experiment begins."""
        return all(
            not (u.times.size and u.times[0] <= self.time[part][0])
            for part, u in zip(self.experiments, self.inputs, strict=True)
        )

    @cached_property
    def shortest(self) -> float:
        """Typical time between samples [s]."""
        gaps = np.diff(self.time)
        return float(np.median(gaps[gaps > 0.0]))

    @property
    def acts_both_ways(self) -> bool:
        """True if each command moves to both sides of its first level, and stays there, too.

        Of two levels alone, the distance from a third one is the command itself.
        """
        return all(
            isinstance(u, PiecewiseConstant)
            and bool(u.values.size)
            and float(u.values.min()) < u.initial < float(u.values.max())
            and np.unique(u(self.time[part])).size > 2
            for u, part in zip(self.inputs, self.experiments, strict=True)
        )

    @cached_property
    def most_play(self) -> float:
        """Largest play that the commands show [u]; 0: they show none.

        Each command has to come to one level from above and from below: between two levels alone,
        play only makes the moves smaller, as a smaller gain does. And all moves have to cross it.
        """
        return min(
            _shown_play(u, self.time[part])
            for u, part in zip(self.inputs, self.experiments, strict=True)
        )

    @property
    def _further(self) -> tuple[str, ...]:
        """What has responses of its own after the model's, a name for each, in their order."""
        counts = {
            "friction": 2 * self.friction,
            "past": int(self.past),
            "unequal": int(self.unequal),
            "play": int(self.play),
            "load": 2 * (self.load is not None),
        }
        return tuple(name for name, count in counts.items() for _ in range(count))

    def places(self, term: str) -> list[int]:
        """Return where each input of a term has its first coefficient, from the end of all.

        :param term: one of the names in `_further`; of several experiments the last one has these
            places.
        """
        count, lines = len(self.structure.powers), len(self.bounds) * (1 + self.drift)
        names = self._further
        return [-lines - (len(names) - k) * count for k, n in enumerate(names) if n == term]

    def relative(self, term: str, coefficients: FloatArray) -> float:
        """Return the size of what is estimated as an input of its own, per that of the command.

        :param term: as of `places`, one that is estimated.
        :param coefficients: of a fit, shape (k,).
        """
        return float(coefficients[self.places(term)[0]] / coefficients[0])

    def effects(self, coefficients: FloatArray) -> tuple[float, float]:
        """Return how strongly commands above and below the first one act, relative to the model.

        :param coefficients: of a fit, shape (k,).
        """
        share = self.relative("unequal", coefficients) if self.unequal else 0.0
        return 1.0 + share, 1.0 - share

    def play_of(self, coefficients: FloatArray) -> float:
        """Return the command that a reversal loses in the play [u]; 0: not estimated.

        :param coefficients: of a fit, shape (k,).
        """
        return -2.0 * self.relative("play", coefficients) if self.play else 0.0

    def dry_friction(self, coefficients: FloatArray) -> float:
        """Return the command that dry friction takes from each motion [u]; 0: not estimated.

        :param coefficients: of a fit, shape (k,).
        """
        return -self.relative("friction", coefficients) if self.friction else 0.0

    @property
    def experiments(self) -> list[slice]:
        """The samples of each experiment."""
        if len(self.bounds) == 1:
            return [slice(0, self.time.size)]
        ends = [*np.searchsorted(self.index, self.bounds).tolist(), self.time.size]
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    @property
    def starts(self) -> FloatArray:
        """Time of the first sample of each sample's experiment [s], shape (n,)."""
        found = np.empty(self.time.size)
        for part in self.experiments:
            found[part] = self.time[part][0]
        return found

    def columns(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the linear coefficients' columns, and the derivatives of the first l by theta.

        :param theta: shape (m,).
        :return: shapes (k, n) and (m, l, n); the k - l columns that theta does not change come
            last.
        """
        parts = self.experiments
        found = [self._of_one(theta, part, i) for i, part in enumerate(parts)]
        if len(parts) == 1:
            (columns, by_theta, rest) = found[0]
            return np.concatenate((columns, rest)), by_theta
        k, n = len(self.structure.powers), self.time.size
        own_rows = sum(columns.shape[0] - k for columns, _, _ in found)
        last = k + own_rows
        every = np.zeros((last + sum(rest.shape[0] for _, _, rest in found), n))
        derivatives = np.zeros((theta.size, last, n))
        first = k
        for part, (columns, by_theta, rest) in zip(parts, found, strict=True):
            # The responses are common to all experiments, the other columns their own.
            every[:k, part], derivatives[:, :k, part] = columns[:k], by_theta[:, :k]
            place = slice(first, first + columns.shape[0] - k)
            every[place, part], derivatives[:, place, part] = columns[k:], by_theta[:, k:]
            every[last : last + rest.shape[0], part] = rest
            first, last = place.stop, last + rest.shape[0]
        return every, derivatives

    def nuisances(self, theta: FloatArray) -> FloatArray:
        """Return the columns that are no response to the command, as seen, shape (p, n).

        :param theta: shape (m,).
        """
        beside = replace(self, unequal=False, play=False)
        return self.seen(beside.columns(theta)[0][len(self.structure.powers) :])

    def _of_one(
        self, theta: FloatArray, part: slice, number: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return one experiment's columns with their derivatives, and its straight line."""
        time = self.time[part]
        blocks = [columns_of(self.structure, theta, time, self.inputs[number])]
        if self.relaxation or self.structure.unstable:
            growing_only = not self.relaxation
            blocks.append(
                free_motion(self.structure.denominator, theta, time, growing_only=growing_only)
            )
        if self.friction:
            blocks += [self._at_once(theta, time, seen) for seen in self.motions]
        further = self.further_inputs(number)
        blocks += [columns_of(self.structure, theta, time, u) for u in further]
        rest = self.line(time)
        if len(blocks) == 1:
            return *blocks[0], rest
        columns = np.concatenate([b[0] for b in blocks])
        return columns, np.concatenate([b[1] for b in blocks], axis=1), rest

    def further_inputs(self, number: int) -> list[PiecewiseConstant]:
        """Return the inputs beside the command whose responses have the model's dead time.

        :param number: of the experiment.
        """
        found = []
        if self.past:
            # The level before is that of a step at the first sample, with the same response.
            found.append(pulse(float(self.time[self.experiments[number]][0])))
        if self.unequal:
            found.append(_folded(self.inputs[number]))
        if self.play:
            found.append(_turns(self.inputs[number]))
        if self.load is not None:
            found += [pulse(self.load, length) for length in (math.inf, self.shortest)]
        return found

    def line(self, time: FloatArray) -> FloatArray:
        """Return the offset and, where estimated, the drift of one experiment, shape (1 or 2, n).

        :param time: of its samples [s], shape (n,).
        """
        rows = np.ones((1 + self.drift, time.size))
        if self.drift:
            rows[1] = (time - time.mean()) / np.ptp(time)
        return rows

    def _at_once(
        self, theta: FloatArray, time: FloatArray, u: PiecewiseConstant
    ) -> tuple[FloatArray, FloatArray]:
        """Return the response to an input that acts without dead time, with its derivatives."""
        columns, by_theta = columns_of(self.structure, np.append(theta[:-1], 0.0), time, u)
        by_theta[-1] = 0.0
        return columns, by_theta

    def seen(self, rows: FloatArray) -> FloatArray:
        """Return rows multiplied by the samples' weights, and whitened by the noise's colour.

        :param rows: shape (..., n).
        """
        if self.weight is not None:
            rows = rows * self.weight
        if self.colour is None:
            return rows
        parts = [self.colour.whitened(rows[..., part]) for part in self.experiments]
        return np.concatenate(parts, axis=-1)

    def part(self, chosen: NDArray[np.bool_] | slice) -> Problem:
        """Return the problem of some of the samples, of each experiment at least a few."""
        return replace(
            self,
            time=self.time[chosen],
            y=self.y[chosen],
            index=self.index[chosen],
            weight=None if self.weight is None else self.weight[chosen],
        )

    def thinned(self, most: int, *, scattered: bool = False) -> Problem:
        """Return the problem of evenly spaced samples.

        :param most: largest number to keep, of all experiments together.
        :param scattered: True: one out of each such space, anywhere in it. Evenly spaced ones may
            meet a command that repeats itself at the same instant each time.
        """
        share = max(most // len(self.bounds), 1)
        if all(part.stop - part.start <= share for part in self.experiments):
            return self
        chosen = np.zeros(self.time.size, dtype=bool)
        for part in self.experiments:
            step = -(-(part.stop - part.start) // share)
            at = np.arange(part.start, part.stop, step)
            if scattered:
                away = (step * (_GOLDEN * np.arange(at.size) % 1.0)).astype(np.int64)
                at = np.minimum(at + away, part.stop - 1)
            chosen[at] = True
        return self.part(chosen)


def pulse(begin: float = 0.0, length: float = math.inf) -> PiecewiseConstant:
    """Return a unit step, or a pulse that ends after a while.

    :param begin: s.
    :param length: s.
    """
    if math.isinf(length):
        return PiecewiseConstant(np.array([begin]), np.ones(1), 0.0)
    return PiecewiseConstant(np.array([begin, begin + length]), np.array([1.0, 0.0]), 0.0)


def _folded(u: Input) -> PiecewiseConstant:
    """Return the distance of a held command from its first level."""
    assert isinstance(u, PiecewiseConstant)
    return PiecewiseConstant(u.times, np.abs(u.values - u.initial), 0.0)


def _turns(u: Input) -> PiecewiseConstant:
    """Return the direction of a held command's last move, 1 or -1, and 0 before the first.

    Behind a play that every move crosses, a process feels the command less half of the play in
    that direction.
    """
    assert isinstance(u, PiecewiseConstant)
    moves = np.sign(np.diff(u.values, prepend=u.initial))
    moved = moves != 0.0
    return PiecewiseConstant(u.times[moved], moves[moved], 0.0)


def _shown_play(u: Input, time: FloatArray) -> float:
    """Return the least way of a command between two turns, where that shows a play [u]; or 0."""
    if not isinstance(u, PiecewiseConstant):
        return 0.0
    turns = _turns(u)
    # Of the last move little is seen.
    times = turns.times[(turns.times >= time[0]) & (turns.times < time[-1])][:-1]
    level, direction = u(times), turns(times)
    if not np.intersect1d(level[direction > 0.0], level[direction < 0.0]).size:
        return 0.0
    ends = level[np.append(np.diff(direction) != 0.0, True)]
    return float(np.abs(np.diff(ends, prepend=u.initial)).min())


def problem_of(
    records: Sequence[tuple[FloatArray, FloatArray, Input]], structure: Structure
) -> Problem:
    """Return the problem of fitting a structure to one or several experiments.

    :param records: sample times [s], what is fitted, and input of each.
    :param structure: the structure.
    """
    sizes = [time.size for time, _, _ in records]
    return Problem(
        np.concatenate([time for time, _, _ in records]),
        np.concatenate([y for _, y, _ in records]),
        tuple(u for _, _, u in records),
        structure,
        np.arange(sum(sizes)),
        tuple(int(b) for b in np.cumsum([0, *sizes[:-1]])),
    )


def motions_of(time: FloatArray, y: FloatArray, u: Input) -> tuple[PiecewiseConstant, ...]:
    """Return in which direction the measurement moves, where its samples show that.

    They do if it rests at one value before the command's first change, to a step of the sensor,
    and most samples later differ from the one before. In noise no sample tells of a motion.

    :param time: of the samples [s], shape (n,).
    :param y: the measurement, in any unit, shape (n,).
    :param u: the command.
    :return: as ``Problem.motions``.
    """
    steps = np.diff(y)
    first = u.times[0] if u.times.size else math.inf
    rest, later = steps[time[1:] <= first], steps[time[1:] > first]
    sizes = np.abs(later[later != 0.0])
    if not rest.size or 2 * sizes.size <= later.size or not isinstance(u, PiecewiseConstant):
        return ()
    if np.ptp(np.cumsum(rest)) > _A_STEP * sizes.min():
        return ()
    held = np.where(steps == 0.0, u(time[:-1]) - u.initial, 0.0)
    # Of samples with one stamp, as a slow clock gives them, the last one counts.
    last = np.diff(time) > 0.0
    return tuple(PiecewiseConstant(time[:-1][last], x[last], 0.0) for x in (np.sign(steps), held))


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
    columns, derivatives = problem.columns(theta)
    y, columns = problem.seen(problem.y), problem.seen(columns)
    size = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    size[size == 0.0] = 1.0
    q, r = np.linalg.qr((columns / size[:, None]).T)
    coefficients = _backward(r.tolist(), (q.T @ y).tolist()) / size
    residual = y - coefficients @ columns
    derivative = problem.seen(
        np.einsum("k,mkn->mn", coefficients[: derivatives.shape[1]], derivatives)
    )
    cost = float(residual @ residual)
    return Trial(theta, coefficients, residual, cost, q, derivative, columns)


def left_of(y: FloatArray, rows: FloatArray) -> FloatArray:
    """Return what the best combinations of some rows leave of one or several others.

    :param y: shape (..., n).
    :param rows: such as offset and drift, shape (k, n).
    """
    factors = np.linalg.lstsq(rows.T, y.T, rcond=None)[0]
    return np.asarray(y - factors.T @ rows)


def left_by(problem: Problem, gain: FloatArray, theta: FloatArray) -> FloatArray:
    """Return what a model leaves, as seen, once all beside it is fitted, shape (n,).

    :param problem: the samples.
    :param gain: coefficients of the numerator, shape (k,).
    :param theta: shape (m,).
    """
    columns, _ = problem.columns(theta)
    left = problem.y - gain @ columns[: gain.size]
    first, *beside = problem.seen(np.concatenate((left[None, :], columns[gain.size :])))
    return left_of(first, np.array(beside))


def left_in_simulation(
    problem: Problem, coefficients: FloatArray, theta: FloatArray
) -> tuple[float, float]:
    """Return the rms that a model leaves in simulation, and that of what it is to explain.

    All beside the model is fitted anew; the model keeps its own coefficients.

    :param problem: may hold other samples than those that the model was fitted to.
    :param coefficients: of the model, those of the numerator first.
    :param theta: of the model, shape (m,).
    """
    problem = replace(problem, colour=None)
    left = left_by(problem, coefficients[: len(problem.structure.powers)], theta)
    total = left_of(problem.seen(problem.y), problem.nuisances(theta))
    return math.sqrt(float(np.mean(left**2))), math.sqrt(float(np.mean(total**2)))


def _backward(r: list[list[float]], right: list[float]) -> FloatArray:
    """Solve ``r c = right`` for an upper triangle r of a few columns, each of length one.

    The coefficient of a column that depends on the others stays zero. So do those of columns
    beyond the number of samples, where r has fewer rows than columns.
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
        state = evaluate(problem, start)
    growth = _GROWTH
    longest = _LONGEST * float(np.ptp(problem.time))
    # A rough answer must not take as many trials as an exact one.
    rough = tolerance > _LEAST_GAIN
    idle = 0
    scale, normal, gradient = _linearised(problem, state)
    for _ in range(min(most, _MOST_ROUGH_ITERATIONS) if rough else most):
        step = _solve(normal, gradient, damping)
        least = -float(state.theta[-1] / scale[-1])
        if step[-1] < least:
            # The dead time stops at zero, and the other steps are solved with it fixed there.
            rest = gradient[:-1] - normal[:-1, -1] * least
            step = np.append(_solve(normal[:-1, :-1], rest, damping), least)
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
