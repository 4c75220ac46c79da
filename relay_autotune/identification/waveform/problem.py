# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What is fitted: samples, inputs, and the terms that are estimated beside the model."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.rational import Inputs, columns_of, free_motion
from relay_autotune.identification.waveform.residuals import Colour
from relay_autotune.process.structures import Structure
from relay_autotune.record.record import Input, PiecewiseConstant

# Residual that is rounding, as a share of the measurement's range.
NEGLIGIBLE = 1e-10
# The fractional parts of its multiples are spread evenly, without a period (Weyl 1916).
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# What may be estimated beside the model, as fields of a problem.
TERMS = ("drift", "relaxation", "past", "unequal", "play", "load", "ends", "rate", "friction")
# Range of a rest, in steps of the sensor, in which nothing moves.
_A_STEP = 1.5
# Instants at which a load is tried.
_INSTANTS = 60
# Least play, friction or shift of an end that counts, as a share of the command's range: the steps
# of a sensor look like a tenth.
_LEAST = 0.01
# Share of the time on one side of a command, or within an actuator's ends, that tells nothing of
# the effect there.
ONE_SIDE = 0.05


# Its arrays have no equality of their own.
@dataclass(frozen=True, eq=False)
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
    :param ends: lowest and highest command that the actuator follows [u]; small shifts of them are
        estimated. None: it follows all.
    :param rate: the fastest change of a command that is followed [u/s]; None: any.
    :param friction: True: dry friction is estimated: a command against each motion, and what it
        takes of the command while the process stands still.
    :param motions: the direction in which the measurement moves, 1 or -1, and the command from
        its first level while it stands still; empty: not seen.
    :param colour: of the noise; None: white.
    :param latest: longest dead time of a fit [s].
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
    ends: tuple[float, float] | None = None
    rate: float | None = None
    friction: bool = False
    motions: tuple[PiecewiseConstant, ...] = ()
    colour: Colour | None = None
    latest: float = math.inf

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
    def shows_its_curve(self) -> bool:
        """True if each command stays at more than two levels.

        Of two alone, the distance from a third one is the command itself.
        """
        return all(
            isinstance(u, PiecewiseConstant) and np.unique(u(self.time[part])).size > 2
            for u, part in zip(self.inputs, self.experiments, strict=True)
        )

    def most_play(self, *, held: bool) -> float:
        """Return the largest play that the commands show [u]; 0: they show none.

        Each command has to come to one level from above and from below, or to go ways of several
        lengths: between two levels alone, play only makes the moves smaller, as a smaller gain
        does. And all moves have to cross it.

        :param held: True: a relay held the process. In other tests a way of another length may
            lead to where the process has another gain.
        """
        return min(
            _shown_play(u, self.time[part], held=held)
            for u, part in zip(self.inputs, self.experiments, strict=True)
        )

    @cached_property
    def levels(self) -> FloatArray:
        """All levels of the commands that are held, ascending [u], shape (k,)."""
        held = [u.levels for u in self.inputs if isinstance(u, PiecewiseConstant)]
        return np.unique(np.concatenate([np.empty(0), *held]))

    @cached_property
    def least_command(self) -> float:
        """Least play or friction that counts [u]; infinite for ramps, which show neither."""
        return _LEAST * float(np.ptp(self.levels)) if self.levels.size else math.inf

    @cached_property
    def instants(self) -> FloatArray:
        """Instants at which a load is tried, after the command's first change [s], shape (k,)."""
        begin = max(float(self.inputs[0].times[0]), float(self.time[0]))
        return np.linspace(begin, float(self.time[-1]), _INSTANTS + 2)[1:-1]

    @property
    def _further(self) -> tuple[str, ...]:
        """What has responses of its own after the model's, a name for each, in their order."""
        counts = {
            "friction": 2 * self.friction,
            "past": int(self.past),
            "unequal": int(self.unequal),
            "play": int(self.play),
            "load": 2 * (self.load is not None),
            "ends": 2 * (self.ends is not None),
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
        """Return how strongly commands above and below their middle act, relative to the model.

        :param coefficients: of a fit, shape (k,).
        """
        share = self.relative("unequal", coefficients) if self.unequal else 0.0
        return 1.0 + share, 1.0 - share

    def ends_of(self, coefficients: FloatArray) -> tuple[float, float]:
        """Return the lowest and the highest command that the actuator follows [u].

        They are NaN of a fit without a gain.

        :param coefficients: of a fit, shape (k,).
        """
        if self.ends is None:
            return -math.inf, math.inf
        gain = float(coefficients[0]) or math.nan
        low, high = coefficients[self.places("ends")] / gain
        return self.ends[0] + float(low), self.ends[1] + float(high)

    def time_within(self, low: float, high: float) -> float:
        """Return the share of the samples at which held commands are between two levels."""
        parts = zip(self.inputs, self.experiments, strict=True)
        held = [u(self.time[at]) for u, at in parts if isinstance(u, PiecewiseConstant)]
        levels = np.concatenate(held)
        return float(np.mean((levels > low) & (levels < high)))

    def moved(self, coefficients: FloatArray) -> Problem:
        """Return the problem with its load and ends where a fit says that they are.

        It is this one where they are there already, and where the ends would cross.

        :param coefficients: of a fit, shape (k,).
        """
        problem = self
        if self.load is not None:
            step, shifts = coefficients[self.places("load")]
            shift = -float(shifts / step) * self.shortest if step else 0.0
            if abs(shift) >= self.shortest:
                first, second, *_, last = self.instants.tolist()
                shift = min(max(shift, first - second), second - first)
                problem = replace(problem, load=min(max(self.load + shift, first), last))
        if self.ends is not None:
            low, high = self.ends_of(coefficients)
            # An end that no command comes to is none.
            low = low if low > self.levels[0] else -math.inf
            high = high if high < self.levels[-1] else math.inf
            near = np.allclose((low, high), self.ends, rtol=0.0, atol=self.least_command)
            if low < high and not near:
                problem = replace(problem, ends=(low, high))
        return problem

    def terms_beyond(self, most: float, theta: FloatArray, coefficients: FloatArray) -> list[str]:
        """Return which of drift, free state and past move by themselves more than allowed.

        :param most: allowed, in times of the measurement's or the response's range, whichever is
            larger: where the first command is none at which the process rests, both are of the
            response's size.
        :param theta: of a fit, shape (m,).
        :param coefficients: of the fit, shape (k,); of several experiments none is asked.
        """
        if len(self.bounds) > 1 or not (self.drift or self.relaxation or self.past):
            return []
        count, columns = len(self.structure.powers), coefficients[:, None] * self.columns(theta)
        last = len(columns) - 1 - self.drift - count * len(self._further)
        places = {
            "drift": slice(len(columns) - self.drift, None),
            "relaxation": slice(count, last if self.relaxation else count),
        }
        if self.past:
            first = len(columns) + self.places("past")[0]
            places["past"] = slice(first, first + count)

        def moved(place: slice) -> float:
            return float(np.ptp(columns[place].sum(axis=0)))

        allowed = most * max(1.0, moved(slice(count)))
        return [term for term, place in places.items() if moved(place) > allowed]

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

    def columns(self, theta: FloatArray) -> FloatArray:
        """Return the linear coefficients' columns, shape (k, n).

        :param theta: shape (m,).
        """
        return self.with_slopes(theta, slopes=False)[0]

    def with_slopes(
        self, theta: FloatArray, *, slopes: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Return the linear coefficients' columns, and the derivatives of the first l by theta.

        :param theta: shape (m,).
        :param slopes: False: without derivatives, m = 0.
        :return: shapes (k, n) and (m, l, n); the k - l columns that theta does not change come
            last.
        """
        parts = self.experiments
        found = [self._of_one(theta, part, i, slopes=slopes) for i, part in enumerate(parts)]
        if len(parts) == 1:
            (columns, by_theta, rest) = found[0]
            return np.concatenate((columns, rest)), by_theta
        k, n = len(self.structure.powers), self.time.size
        own_rows = sum(columns.shape[0] - k for columns, _, _ in found)
        last = k + own_rows
        every = np.zeros((last + sum(rest.shape[0] for _, _, rest in found), n))
        derivatives = np.zeros((theta.size if slopes else 0, last, n))
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
        beside = replace(self, unequal=False, play=False, ends=None)
        return self.seen(beside.columns(theta)[len(self.structure.powers) :])

    def _of_one(
        self, theta: FloatArray, part: slice, number: int, *, slopes: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return one experiment's columns with their derivatives, and its straight line."""
        time, structure = self.time[part], self.structure
        first, *further = columns_of(structure, theta, time, self.delayed[number], slopes=slopes)
        blocks = [first]
        blocks += self.free_motions(theta, time, slopes=slopes)
        if self.friction:
            at_once = np.append(theta[:-1], 0.0)
            for columns, by_theta in columns_of(
                structure, at_once, time, Inputs(self.motions), slopes=slopes
            ):
                by_theta[-1:] = 0.0
                blocks.append((columns, by_theta))
        blocks += further
        rest = self.lines[number]
        if len(blocks) == 1:
            return *blocks[0], rest
        columns = np.concatenate([b[0] for b in blocks])
        return columns, np.concatenate([b[1] for b in blocks], axis=1), rest

    def free_motions(
        self, theta: FloatArray, time: FloatArray, *, slopes: bool = True
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Return what a free initial state adds, and derivatives, if any is estimated.

        What grows has one always: its response is followed backward.

        :param theta: shape (m,).
        :param time: of the samples of one experiment [s], shape (n,).
        :param slopes: False: without derivatives, m = 0.
        :return: nothing, or shapes (q, n) and (m, q, n).
        """
        if not (self.relaxation or self.structure.unstable):
            return []
        of, growing_only = self.structure.denominator, not self.relaxation
        return [free_motion(of, theta, time, growing_only=growing_only, slopes=slopes)]

    @cached_property
    def delayed(self) -> list[Inputs]:
        """The inputs whose responses have the model's dead time, of each experiment.

        They are the command, then those of `_further` but friction.
        """
        each = zip(self.inputs, self.experiments, strict=True)
        return [
            Inputs((_followed(u, self.ends, self.rate), *self._inputs_of_terms(u, part)))
            for u, part in each
        ]

    def _inputs_of_terms(self, u: Input, part: slice) -> Iterator[PiecewiseConstant]:
        if self.past:
            # The level before is that of a step at the first sample, with the same response.
            yield pulse(float(self.time[part][0]))
        if self.unequal:
            yield distance(u, middle_of(u))
        if self.play:
            yield _direction_of_moves(u)
        if self.load is not None:
            yield from (pulse(self.load, length) for length in (math.inf, self.shortest))
        if self.ends is not None:
            low, high = self.ends
            yield from (_mapped(u, lambda x: x < low), is_above(u, high))

    @cached_property
    def lines(self) -> list[FloatArray]:
        """Offset and, where estimated, drift of each experiment, shape (1 or 2, n)."""
        found: list[FloatArray] = []
        for time in (self.time[part] for part in self.experiments):
            rows = np.ones((1 + self.drift, time.size))
            if self.drift:
                rows[1] = (time - time.mean()) / np.ptp(time)
            found.append(rows)
        return found

    @cached_property
    def y_seen(self) -> FloatArray:
        """What is fitted, as it is seen, shape (n,)."""
        return self.seen(self.y)

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

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Problem:
        """Return the problem of some of the samples, of each experiment at least a few."""
        return replace(
            self,
            time=self.time[chosen],
            y=self.y[chosen],
            index=self.index[chosen],
            weight=None if self.weight is None else self.weight[chosen],
        )

    def each(self) -> list[Problem]:
        """Return the problem of each experiment, with the terms that are estimated beside all."""
        parts = zip(self.experiments, self.inputs, strict=True)
        return [replace(self.part(part), inputs=(u,), bounds=(0,)) for part, u in parts]

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


def _mapped(u: Input, of: Callable[[FloatArray], NDArray[Any]]) -> PiecewiseConstant:
    """Return a function of a held command, from its value at first."""
    assert isinstance(u, PiecewiseConstant)
    values = np.asarray(of(u.levels), dtype=float)
    return PiecewiseConstant(u.times, values[1:] - values[0], 0.0)


def _followed(u: Input, ends: tuple[float, float] | None, rate: float | None) -> Input:
    """Return what an actuator makes of a command.

    :param ends: as ``Problem.ends``.
    :param rate: as ``Problem.rate``.
    """
    if ends is not None:
        u = _mapped(u, lambda x: np.clip(x, *ends))
    return u.slewed(rate) if rate and isinstance(u, PiecewiseConstant) else u


def is_above(u: Input, level: float) -> PiecewiseConstant:
    """Return 1 while a held command is above a level, less what it is at first."""
    return _mapped(u, lambda x: x > level)


def middle_of(u: Input) -> float:
    """Return the command above and below which effects may differ [u].

    It is the first one, or half the range where the command is hardly ever on one side of that.
    """
    assert isinstance(u, PiecewiseConstant)
    # How long the first and the last level last is not part of the command.
    gaps = np.diff(u.times)
    typical = float(gaps.mean()) if gaps.size else 1.0
    lasting = np.array([typical, *gaps, typical])
    seldom = min(lasting[u.levels < u.initial].sum(), lasting[u.levels > u.initial].sum())
    if seldom >= ONE_SIDE * lasting.sum():
        return u.initial
    middle = 0.5 * (float(u.levels.min()) + float(u.levels.max()))
    # Not what rounding leaves of 0.
    return middle if abs(middle) > NEGLIGIBLE * float(np.ptp(u.levels)) else 0.0


def distance(u: Input, level: float) -> PiecewiseConstant:
    """Return how much farther from a level a held command is than at first [u]."""
    return _mapped(u, lambda x: np.abs(x - level))


def _direction_of_moves(u: Input) -> PiecewiseConstant:
    """Return the direction of a held command's last move, 1 or -1, and 0 before the first.

    Behind a play that every move crosses, a process feels the command less half of the play in
    that direction.
    """
    assert isinstance(u, PiecewiseConstant)
    moves = np.sign(np.diff(u.levels))
    moved = moves != 0.0
    return PiecewiseConstant(u.times[moved], moves[moved], 0.0)


def _shown_play(u: Input, time: FloatArray, *, held: bool) -> float:
    """Return the least way of a command between two turns, where that shows a play [u]; or 0."""
    if not isinstance(u, PiecewiseConstant):
        return 0.0
    turns = _direction_of_moves(u)
    # Of the last move little is seen.
    times = turns.times[(turns.times >= time[0]) & (turns.times < time[-1])][:-1]
    if not times.size:
        return 0.0
    level, direction = u(times), turns(times)
    ends = level[np.append(np.diff(direction) != 0.0, True)]
    ways = np.abs(np.diff(ends, prepend=u.initial))
    # Where in its play the process rested before the first way is not known.
    differ = held and not np.allclose(ways[1:], ways[-1])
    if not (differ or np.intersect1d(level[direction > 0.0], level[direction < 0.0]).size):
        return 0.0
    return float(ways.min())


def nuisances_of(problem: Problem, terms: Iterable[str] = TERMS) -> tuple[bool, ...]:
    """Return which of some terms beside the model are estimated."""
    # A load may come at 0 s, which is no False.
    return tuple(
        getattr(problem, t) is not False and getattr(problem, t) is not None for t in terms
    )


def without(problem: Problem, terms: Iterable[str]) -> Problem:
    """Return a problem without some of the terms beside the model.

    :param problem: any.
    :param terms: some of ``TERMS``.
    """
    absent: dict[str, Any] = {t: None if t in ("load", "ends", "rate") else False for t in terms}
    return replace(problem, **absent)


def with_terms_of(other: Problem, problem: Problem) -> Problem:
    """Return a problem with the structure and the terms beside the model of another one.

    :param other: has these.
    :param problem: has the samples and the colour.
    """
    terms = {term: getattr(other, term) for term in TERMS}
    return replace(problem, structure=other.structure, **terms)


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
