# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The structures that may explain the data, every one fitted, with the criterion of its fit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.residuals import worth
from relay_autotune.identification.waveform.separable import (
    Problem,
    Trial,
    information_criterion,
    left_of,
    refine,
)
from relay_autotune.identification.waveform.starts import (
    Starts,
    begin,
    changes_within,
    coarse,
    go_on,
    is_unseen,
    latest_dead_times,
    least_promised,
    longest_push,
    refine_all,
    refine_best,
    start_fopdt,
    time_scales,
)
from relay_autotune.process.structures import (
    FOPDT,
    INTEGRATOR_INVERSE,
    INTEGRATOR_LAG,
    IPDT,
    LAG_COMPLEX,
    LAG_N,
    LAG_N_ZERO,
    SOPDT,
    SOPDT_ZERO,
    THREE_LAGS,
    TWO_EQUAL_ONE,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
    Structure,
    equal_lags,
)
from relay_autotune.process.transfer_function import TransferFunction

MOST_LAGS = 8
_MOST_LAGS_WITH_ZERO = 4
_SAMPLES_EACH = 8
# Ratio of the mean squares with and without the beginning, from which it is left out.
_MUCH_BETTER = 4.0
# Least correlation of neighbours that counts, in standard errors.
_CORRELATED = 4.0
# Least gain in the criterion for which drift or initial state is fitted: they blur the gain K.
_EVIDENCE = 6.0
# Least number of samples of a rest that shows the past; the largest share of its range by which
# the measurement moves during it, and by which it would, going on like that, in the whole record.
_ENOUGH_REST = 15
_STILL, _STILL_LATER = 0.05, 0.5
# Least number of moves of a command that tell whether one came before the record.
_MANY = 6
# A step that gains less than this share of the sum of squares changes no choice.
_TRIAL = 1e-6
# A structure whose mean square is this many times the least one has no support.
_BEYOND_HOPE = 4.0
# Ratio of the promised mean square to the least one, from which a fit is given up. Below the
# second, in squares of the range, the residual is curvature, which the promise neglects.
_NO_PROMISE = 6.0
_CLEAN = 1e-6
# Order in which structures are fitted: first those that show which others are hopeless.
_TRIED = (
    *(FOPDT, LAG_N, SOPDT, THREE_LAGS, TWO_EQUAL_ONE, LAG_N_ZERO, SOPDT_ZERO),
    *(IPDT, INTEGRATOR_LAG, INTEGRATOR_INVERSE, UNSTABLE_FOPDT, UNSTABLE_SOPDT),
)
_SIMPLE = (FOPDT.name, SOPDT.name, IPDT.name)
# Structures that are fitted to the end, whatever residual they leave.
_ALWAYS = (FOPDT.name, IPDT.name)

# A structure, and the first trials of its fit.
_Begun = tuple[Structure, list[Trial]]


@dataclass(frozen=True)
class Candidate:
    """One structure with its best fit.

    :param problem: what was fitted.
    :param state: the fit.
    :param model: the transfer function that was fitted.
    :param criterion: Bayesian information criterion; smaller is better.
    """

    problem: Problem
    state: Trial
    model: TransferFunction
    criterion: float

    @property
    def structure(self) -> Structure:
        """The structure."""
        return self.problem.structure

    @property
    def lenience(self) -> float:
        """What Schwarz's penalty exceeds Akaike's by, where the noise has a colour."""
        if self.problem.colour is None:
            return 0.0
        n = max(self.problem.time.size, 3)
        return self.state.parameters * (math.log(n) - 2.0)


@dataclass(frozen=True)
class Ground:
    """What structures are fitted to, and where their fits begin.

    :param problem: samples and input, drift and initial state, with a FOPDT structure.
    :param fopdt: the FOPDT that fits best.
    :param starts: of every structure.
    :param floor: sum of squares that is rounding.
    :param sign: the direction in which the relay worked, 1 or -1, which a model must share; 0:
        not known.
    """

    problem: Problem
    fopdt: Trial
    starts: Starts
    floor: float
    sign: int

    @classmethod
    def of(cls, problem: Problem, floor: float, sign: int = 0) -> Ground:
        """Return the ground that a record gives.

        :param problem: samples and input, with a FOPDT structure.
        :param floor: sum of squares that is rounding.
        :param sign: the direction in which the relay worked; 0: not known.
        """
        fopdt = refine_best(problem, start_fopdt(problem, sign), tolerance=_TRIAL)
        problem, fopdt = _without_the_unknown(problem, fopdt, floor, sign)
        return cls(problem, fopdt, Starts(problem, fopdt), floor, sign)

    @cached_property
    def unstable(self) -> list[Trial]:
        """The beginning of an unstable FOPDT's fit, from which two structures go on."""
        problem = replace(self.problem, structure=UNSTABLE_FOPDT)
        return begin(problem, self.starts.unstable(problem))

    @cached_property
    def latest(self) -> tuple[float, float]:
        """Longest dead time of a gain below zero, and of one above [s]."""
        return latest_dead_times(self.problem, self.sign)

    @cached_property
    def pushed(self) -> float:
        """Longest time for which the command acted in one direction [s]; infinite for a relay."""
        if self.sign:
            return math.inf
        parts = zip(self.problem.experiments, self.problem.inputs, strict=True)
        return max(longest_push(self.problem.time[part], u) for part, u in parts)

    @cached_property
    def rested(self) -> bool:
        """Whether the samples show that the process was at rest before."""
        return needs_no_past(self.problem, self.sign)

    def candidate(self, problem: Problem, state: Trial) -> Candidate | None:
        """Return a fit as a candidate; None if it cannot be read as its structure."""
        structure = problem.structure
        model = structure.model_at(state.theta, state.coefficients)
        if model is None and structure == THREE_LAGS:
            problem = replace(problem, structure=LAG_COMPLEX)
            model = LAG_COMPLEX.model_at(state.theta, state.coefficients)
        if model is None or model.dead_time > self.latest[model.process_sign > 0]:
            return None
        shortest, _ = time_scales(self.problem)
        time = self.problem.time
        if is_unseen(model, shortest, float(time[-1] - time[0]), self.pushed):
            return None
        criterion = information_criterion(
            state.cost, problem.time.size, state.parameters, self.floor
        )
        return Candidate(problem, state, model, criterion)

    def with_nuisances(self, found: Candidate) -> Candidate:
        """Add drift, a free initial state and a command before where the data ask for them.

        :param found: a fit with or without them.
        """
        best = found
        now = found.problem
        for drift, relaxation, past in itertools.product((False, True), repeat=3):
            if (drift, relaxation, past) == nuisances_of(now):
                continue
            if relaxation and not found.structure.factors:
                # The free state of an integrator is the offset.
                continue
            if past and not now.past_is_open:
                continue
            if (relaxation or past) and self.rested:
                continue
            problem = replace(now, drift=drift, relaxation=relaxation, past=past)
            state = refine(problem, found.state.theta, tolerance=_TRIAL)
            other = self.candidate(problem, state)
            if other is None or other.criterion > found.criterion - _EVIDENCE:
                continue
            if other.criterion < best.criterion:
                best = other
        return best

    def beside(self, nuisances: Problem) -> Ground:
        """Return the ground with the drift and initial state of a problem.

        :param nuisances: the problem.
        """
        problem = replace(nuisances, structure=FOPDT)
        if problem.relaxation:
            # A FOPDT has the longest dead time of all, since it includes every small lag.
            first = refine(problem, self.fopdt.theta, tolerance=_TRIAL)
            problem = after_the_unknown(problem, first)
        return replace(self, problem=problem)

    def fit(
        self, names: Iterable[str], order: int = 0, ready: Sequence[Candidate] = ()
    ) -> list[Candidate]:
        """Fit structures, one after the other: a hopeless one is given up early.

        :param names: of the structures.
        :param order: of equal lags; 0: several.
        :param ready: what was fitted before, perhaps to the same samples with the same terms.
        """
        terms = _terms(self.problem)
        same = {c.structure.name: c for c in ready if _terms(c.problem) == terms}
        # The least mean square so far.
        least = math.inf
        found: list[Candidate | None] = []
        for name in names:
            if name in same:
                found.append(same[name])
                continue
            for structure, begun in self._family(name, order):
                problem = replace(self.problem, structure=structure)
                state = _followed(problem, begun, least)
                if state is not None:
                    least = min(least, max(state.cost, self.floor) / problem.time.size)
                    found.append(self.candidate(problem, state))
        return [c for c in found if c is not None]

    def refit(self, found: Candidate) -> Candidate | None:
        """Fit the structure of a candidate here, from where it is."""
        for structure, begun in self._begun(found.structure, [found.state.theta]):
            problem = replace(self.problem, structure=structure)
            state = _followed(problem, begun, math.inf)
            return None if state is None else self.candidate(problem, state)
        return None

    def _begun(self, structure: Structure, thetas: list[FloatArray]) -> Iterator[_Begun]:
        """Begin fits; with too few samples, of first order only."""
        enough = _SAMPLES_EACH * (structure.order + 4) <= self.problem.time.size
        if enough or structure.order <= 1:
            yield structure, begin(replace(self.problem, structure=structure), thetas)

    def _family(self, name: str, order: int) -> Iterator[_Begun]:
        starts, begun = self.starts, self._begun
        match name:
            case FOPDT.name:
                yield from begun(FOPDT, [self.fopdt.theta])
            case LAG_N.name:
                for n in [order] if order else range(2, MOST_LAGS + 1):
                    yield from begun(equal_lags(n), [starts.lag_n(n)])
            case LAG_N_ZERO.name:
                for n in [order] if order else range(2, _MOST_LAGS_WITH_ZERO + 1):
                    yield from begun(LAG_N_ZERO.of_order(n), starts.lag_n_zero(n))
            case SOPDT.name:
                yield from begun(SOPDT, starts.sopdt())
            case SOPDT_ZERO.name:
                yield from begun(SOPDT_ZERO, [*starts.sopdt(), self._two_equal_lags()])
            case TWO_EQUAL_ONE.name:
                yield from begun(TWO_EQUAL_ONE, starts.two_equal_one())
            case THREE_LAGS.name | LAG_COMPLEX.name:
                yield from begun(THREE_LAGS, starts.third())
            case IPDT.name:
                yield from begun(IPDT, [starts.integrator()])
            case INTEGRATOR_LAG.name:
                yield from begun(INTEGRATOR_LAG, starts.integrator_lag())
            case INTEGRATOR_INVERSE.name:
                yield from begun(INTEGRATOR_INVERSE, starts.integrator_lag())
            case UNSTABLE_FOPDT.name:
                yield UNSTABLE_FOPDT, self.unstable
            case UNSTABLE_SOPDT.name:
                yield from begun(UNSTABLE_SOPDT, starts.unstable_second(self.unstable[0].theta))

    def _two_equal_lags(self) -> FloatArray:
        """Return a start of two lags and a zero: the two equal ones that fit best.

        The starts from a FOPDT do not lead to every inverse response.
        """
        problem = replace(self.problem, structure=LAG_N_ZERO.of_order(2))
        best = go_on(problem, begin(problem, self.starts.lag_n_zero(2)))[0]
        return np.array((best.theta[0], 0.0, best.theta[1]))


def fit_one(ground: Ground, name: str, order: int = 0) -> Candidate | None:
    """Fit one structure; None if the data cannot be read as it.

    :param ground: what it is fitted to.
    :param name: of the structure.
    :param order: of equal lags; 0: the best of them.
    """
    return min(ground.fit([name], order), key=lambda c: c.criterion, default=None)


def fit_all(ground: Ground) -> list[Candidate]:
    """Fit every structure; the best first.

    :param ground: what they are fitted to.
    """
    # Drift and initial state are decided with the better of two flexible structures, and with
    # an integrator, for which a command off its balance looks like a drift.
    simple = ground.fit(_SIMPLE)
    flexible = [c for c in simple if c.structure != IPDT]
    if not flexible:
        return []
    decided = ground.with_nuisances(min(flexible, key=lambda c: c.criterion))
    for integrator in simple:
        if integrator.structure == IPDT:
            other = ground.with_nuisances(integrator)
            decided = min(decided, other, key=lambda c: c.criterion)
    base = decided.problem
    found = _sorted(ground.beside(base), simple)
    if found and any(nuisances_of(base)):
        # The residual of the simple structures may look like a drift: decide with the best again.
        plain = ground.refit(found[0])
        again = base if plain is None else ground.with_nuisances(plain).problem
        if nuisances_of(again) != nuisances_of(base):
            return _sorted(ground.beside(again), simple) or found
    return found


def _sorted(ground: Ground, ready: Sequence[Candidate]) -> list[Candidate]:
    """Fit all structures, and return them by their criterion, the best first.

    Where even the best residual is correlated, by jitter or by what no structure explains, each
    sample counts less.
    """
    # What runs away by itself is not recorded, except where a relay held it.
    names = [s.name for s in _TRIED if ground.sign or not s.unstable]
    found = sorted(ground.fit(names, ready=ready), key=lambda c: c.criterion)
    if not found or found[0].state.cost <= ground.floor:
        return found
    n = found[0].problem.time.size
    each = worth(found[0].state.residual, _CORRELATED)
    if each == 1.0:
        return found

    def weighed(c: Candidate) -> Candidate:
        criterion = information_criterion(c.state.cost, n, c.state.parameters, ground.floor, each)
        return replace(c, criterion=criterion)

    return sorted(map(weighed, found), key=lambda c: c.criterion)


def _terms(problem: Problem) -> tuple[tuple[bool, bool, bool], int]:
    """Return what two problems of one record may differ in, beside the structure."""
    return nuisances_of(problem), problem.time.size


def nuisances_of(problem: Problem) -> tuple[bool, bool, bool]:
    """Return whether drift, initial state and the command before are estimated."""
    return problem.drift, problem.relaxation, problem.past


def _followed(problem: Problem, begun: list[Trial], least: float) -> Trial | None:
    """Return the best fit that a beginning leads to; None where it is hopeless.

    :param problem: the problem.
    :param begun: the beginning.
    :param least: the least mean square of another structure.
    """
    asked = problem.structure.name in _ALWAYS

    def promises_nothing(states: list[Trial]) -> bool:
        return least_promised(problem, states) > _NO_PROMISE * max(least, _CLEAN)

    def is_hopeless(state: Trial) -> bool:
        return state.cost / state.residual.size > _BEYOND_HOPE * least

    if not asked and promises_nothing(begun):
        return None
    rough = go_on(problem, begun)
    if not rough:
        # No response of any of them can be told, as of a command that is far too small.
        return None
    if not asked and is_hopeless(rough[0]):
        if promises_nothing(rough[:1]):
            return None
        # It may not have converged yet.
        best = rough[0]
        rough = [refine(coarse(problem), best.theta, tolerance=_TRIAL, damping=best.damping)]
        if is_hopeless(rough[0]):
            return None
    return refine_all(problem, rough, _TRIAL)


def needs_no_past(problem: Problem, sign: int) -> bool:
    """Return whether a record of a few steps shows that the process was at rest before.

    A free past explains any single step. Many moves tell of themselves whether one is needed: a
    command that moved just before the record acts in the rest, or after it where the dead time is
    longer. A relay test began where its settings say, and is asked of its samples all the same.

    :param problem: all samples.
    :param sign: the direction in which the relay worked, 1 or -1; 0: not known.
    """
    changes = (
        changes_within(u, problem.time[part])
        for part, u in zip(problem.experiments, problem.inputs, strict=True)
    )
    return not sign and all(c.size < _MANY for c in changes) and begins_at_rest(problem)


def begins_at_rest(problem: Problem) -> bool:
    """Return whether each experiment begins with a rest, which shows what came before.

    :param problem: all samples.
    """
    for part, u in zip(problem.experiments, problem.inputs, strict=True):
        time, y = problem.time[part], problem.y[part]
        changes = changes_within(u, time)
        before = time < (changes[0] if changes.size else time[0])
        if np.count_nonzero(before) < _ENOUGH_REST:
            return False
        t, wide = time[before] - float(np.mean(time[before])), float(np.ptp(y))
        slope = float(t @ y[before]) / float(t @ t)
        left = y[before] - np.mean(y[before]) - slope * t
        chance = 2.0 * math.sqrt(float(left @ left) / left.size / float(t @ t))
        if abs(slope) * float(np.ptp(t)) > _STILL * wide:
            return False
        if abs(slope) > chance and abs(slope) * float(np.ptp(time)) > _STILL_LATER * wide:
            return False
    return True


def _without_the_unknown(
    problem: Problem, fopdt: Trial, floor: float, sign: int
) -> tuple[Problem, Trial]:
    """Leave out the beginning of a record that was cut out of a movement, if that fits better.

    :param problem: all samples.
    :param fopdt: the FOPDT that fits them best.
    :param floor: sum of squares that is rounding.
    :param sign: the direction in which the relay worked; 0: not known.
    :return: the samples to be fitted, and the FOPDT that fits these best.
    """
    if needs_no_past(problem, sign):
        return problem, fopdt
    whole = replace(problem, relaxation=True)
    _, longest = time_scales(whole)
    later = whole.part(whole.time >= whole.starts + longest)
    if 2 * later.time.size < whole.time.size or not _is_driven(later):
        return problem, fopdt
    first = refine(whole, fopdt.theta, tolerance=_TRIAL)
    if first.cost <= _MUCH_BETTER * floor:
        return problem, fopdt
    second = refine_best(later, start_fopdt(later, sign), tolerance=_TRIAL)
    enough = _MUCH_BETTER * second.cost / later.time.size
    if enough >= first.cost / whole.time.size:
        return problem, fopdt
    # A long first swing from rest shows small lags, which a FOPDT cannot fit.
    third = replace(problem, structure=THREE_LAGS)
    flexible = refine_best(third, Starts(third, fopdt).third(), tolerance=_TRIAL)
    if flexible.cost / third.time.size <= enough:
        return problem, fopdt
    return later, second


def after_the_unknown(problem: Problem, state: Trial) -> Problem:
    """Return the samples whose input is known; all of them where the process was at rest.

    The input before the record is not known, unless it is estimated, and acts for one dead time.

    :param problem: the problem.
    :param state: a fit, for its dead time.
    """
    if not problem.relaxation or problem.past:
        return problem
    some = problem.part(problem.time >= problem.starts + float(state.theta[-1]))
    least = min(part.stop - part.start for part in some.experiments)
    return some if least > 4 * state.parameters and _is_driven(some) else problem


def _is_driven(problem: Problem) -> bool:
    """Return whether the command changes within the samples of each experiment."""
    return all(
        part.stop > part.start and changes_within(u, problem.time[part]).size > 0
        for part, u in zip(problem.experiments, problem.inputs, strict=True)
    )


def of_shown_direction(found: list[Candidate]) -> list[Candidate]:
    """Leave out the candidates whose gain has another sign than what explains nearly all.

    A zero and an integrator beside a drift follow a slow disturbance between a few steps, with a
    gain of either sign. Where a FOPDT explains nearly all, its direction is that of the process.

    :param found: in any order.
    """
    plain = next((c for c in found if c.structure == FOPDT), None)
    if plain is None or _unexplained(plain) > _NEARLY_ALL:
        return found
    return [c for c in found if c.model.process_sign == plain.model.process_sign]


def _unexplained(candidate: Candidate) -> float:
    """Return the share of the sum of squares beside drift and the like that a model leaves."""
    problem, own = candidate.problem, len(candidate.structure.powers)
    columns, _ = problem.columns(candidate.state.theta)
    left, response = (left_of(problem.y, rows) for rows in (columns, columns[own:]))
    return float(left @ left) / max(float(response @ response), 1e-300)


# Largest share that a model leaves unexplained which shows the direction of the process.
_NEARLY_ALL = 0.1
_INDIFFERENT = 2.0
# Largest rms residual of an exact structure, and of one that is good enough, as shares of the
# measurement's range.
_EXACT = 1e-7
_ENOUGH = 4e-3


def choose(candidates: list[Candidate]) -> Candidate:
    """Return the simplest structure that the criterion cannot tell from the best.

    :param candidates: the best first, at least one.
    """
    best = candidates[0].criterion
    enough = _good_enough(candidates)
    if enough is not None:
        return enough
    rivals = [c for c in candidates if c.criterion <= best + _INDIFFERENT]
    return min(rivals, key=lambda c: (c.state.parameters, c.structure.order, c.criterion))


def _good_enough(candidates: list[Candidate]) -> Candidate | None:
    """Return a FOPDT whose residual is so small that jitter or rounding explains it; else None.

    Below that, the criterion would prefer a structure that fits the errors of the sample times,
    which are not white. They are absent where a structure is exact, and negligible in means of
    many samples.
    """

    def rms(candidate: Candidate) -> float:
        return math.sqrt(candidate.state.cost / candidate.problem.time.size)

    fopdt = next((c for c in candidates if c.structure.name == "fopdt"), None)
    integrator = next((c for c in candidates if c.structure.name == "ipdt"), None)
    if candidates[0].problem.averaged:
        return None
    if fopdt is None or rms(candidates[0]) < _EXACT or rms(fopdt) > _ENOUGH:
        return None
    slower = integrator is not None and integrator.criterion < fopdt.criterion
    return None if slower else fopdt


def support(candidates: list[Candidate]) -> list[float]:
    """Return the weight of each candidate, ``exp(-criterion/2)``; their sum is 1.

    White noise leaves nothing that another structure would explain, and the criterion is that of
    the choice. In a colour, some of the residual may be what no structure explains: Akaike's
    penalty, 2 for each parameter, stands in the place of Schwarz's, so that richer structures
    count (Burnham and Anderson 2002).

    :param candidates: in any order.
    """
    criteria = np.array([c.criterion - c.lenience for c in candidates])
    weights = np.exp(-0.5 * np.minimum(criteria - criteria.min(), 1400.0))
    return [float(w) for w in weights / weights.sum()]
