# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Candidates: each structure fitted to the same samples, with the score of its fit.

A candidate is a structure, what is estimated beside the model (offset, drift, initial state,
command before), and the colour of the noise. Its score is Schwarz's criterion of the samples in
that colour, and the priors of the table below.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.past import drop_first_dead_time, needs_no_past
from relay_autotune.identification.waveform.problem import (
    NEGLIGIBLE,
    ONE_SIDE,
    TERMS,
    Problem,
    nuisances_of,
    pulse,
    without,
)
from relay_autotune.identification.waveform.rational import stepped
from relay_autotune.identification.waveform.residuals import (
    IMITATES_A_DRIFT,
    Colour,
    colour_cost,
)
from relay_autotune.identification.waveform.separable import (
    TRIAL,
    Trial,
    evaluate,
    information_criterion,
    refine,
    residual_of,
)
from relay_autotune.identification.waveform.starts import (
    ENDS,
    Guess,
    best_fopdt,
    best_of,
    coarse,
    is_unobservable,
    latest_dead_times,
    likeliest_ends,
    likeliest_rate,
    multistart,
    shifted_columns,
    start_fopdt,
    start_unstable,
    time_scales,
)
from relay_autotune.process.structures import (
    FOPDT,
    INTEGRATOR_INVERSE,
    LAG_COMPLEX,
    SOPDT,
    SOPDT_ZERO,
    TABLE,
    THREE_LAGS,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
    Structure,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.moves import (
    MOST_GROWTH,
    begins_with_only_move,
    changes_within,
    is_controlled,
    longest_push,
    longest_stay,
    moves_always,
)
from relay_autotune.record.record import Input, PiecewiseConstant

MOST_LAGS = 8
_MOST_LAGS_WITH_ZERO = 4
_SAMPLES_EACH = 8
# Gains have to hold on the models of these, too.
PLAIN = (FOPDT.name, SOPDT.name)
# What was before the record, and with an actuator's limits that for which a dead time or a lag can
# stand.
_BEFORE = frozenset(("drift", "relaxation", "past"))
_HIDDEN = _BEFORE | {"ends", "rate"}
# Steps of a fit with a further term or in another colour, and how often a load and ends are moved.
_STEPS, _MOVES = 15, 4
# Dead time on either side of a zero at 0, as a share of all times together.
_ASIDE = 0.1
# Farthest that drift, free state or past may move by itself, in ranges of the measurement or of
# the response: those that cancel one another explain anything.
_FARTHEST = 10.0
# Longest dead time with which a relay holds a process that grows, in time constants of its growth
# (Thyagarajan and Yu 2003); a controller then holds it only at the edge of stability. With longer
# ones, exp(-D s)/(1 - T s) is about the dead time D - T of any process.
_HELD = math.log(2.0)
# Gain in a score that changes no choice.
LITTLE = 0.5
# Longest time that a record shows, in its lengths: a longer lag acts as an integrator, and the
# zero of a slower inverse response as a drift.
_LASTING = 2.0


@dataclass(frozen=True)
class Candidate:
    """One structure with its best fit.

    :param problem: what was fitted.
    :param state: the fit.
    :param model: the transfer function that was fitted.
    :param score: smaller is better; a difference of 2 log(x) is odds of x.
    """

    problem: Problem
    state: Trial
    model: TransferFunction
    score: float

    @property
    def structure(self) -> Structure:
        """The structure."""
        return self.problem.structure

    @property
    def akaike(self) -> float:
        """The score with Akaike's penalty, 2 for each parameter, in place of log n."""
        return self.score - self.state.parameters * (math.log(max(self.problem.time.size, 3)) - 2)


def support(candidates: Sequence[Candidate]) -> list[float]:
    """Return the weight of each candidate, ``exp(-AIC/2)``; their sum is 1.

    Schwarz's penalty chooses the true structure where it is among them. But no process is exactly
    one of them, so that richer ones count beside it (Burnham and Anderson 2002).

    :param candidates: in any order.
    """
    scores = np.array([c.akaike for c in candidates])
    weights = np.exp(-0.5 * np.minimum(scores - scores.min(), 1400.0))
    return [float(w) for w in weights / weights.sum()]


@dataclass(frozen=True)
class FitContext:
    """What structures are fitted to, and where their fits begin.

    :param problem: samples and input, drift and initial state, with a FOPDT structure.
    :param fopdt: the FOPDT that fits best.
    :param sign: the direction in which the relay worked, 1 or -1, which a model must share; 0:
        not known.
    :param held: True: a relay held the process.
    :param bounded: True: a relay or a controller held the process, so that it may grow.
    :param latest: as of :func:`latest_dead_times`.
    :param loads: True: a step of the load may be estimated.
    :param rate: returns the fastest change of the command that may be followed [u/s]; None: any.
    :param closest: of all candidates in white noise, the one of each direction that leaves least.
    """

    problem: Problem
    fopdt: Trial
    sign: int
    held: bool
    bounded: bool
    latest: tuple[float, float]
    loads: bool
    rate: Callable[[], float | None]
    _fits: dict[tuple[object, ...], Trial] = field(default_factory=dict, repr=False)
    closest: dict[int, Candidate] = field(default_factory=dict, repr=False)
    _growing: dict[str, list[FloatArray]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._fits[_key_of_fit(self.problem)] = self.fopdt

    @classmethod
    def of(cls, problem: Problem, sign: int, *, held: bool, most: int = 0) -> FitContext:
        """Return the context of a record's samples, or of some of them.

        :param problem: all samples and their input, with a FOPDT structure.
        :param sign: the direction in which the relay worked; 0: not known.
        :param held: True: a relay held the process.
        :param most: number of samples that structures are fitted to; 0: all.
        """
        bounded = held or all(
            is_controlled(problem.time[part], problem.y[part], u)
            for part, u in zip(problem.experiments, problem.inputs, strict=True)
        )
        latest = latest_dead_times(problem, sign)
        few = problem.thinned(most) if most else problem
        rate = cache(lambda: likeliest_rate(problem))
        return cls(few, best_fopdt(few, sign), sign, held, bounded, latest, held, rate)

    def with_samples(self, problem: Problem) -> FitContext:
        """Return the context with other samples of the same record, of which nothing is fitted.

        :param problem: the samples, with a FOPDT structure.
        """
        fopdt = best_fopdt(problem, self.sign)
        return replace(self, problem=problem, fopdt=fopdt, _fits={}, closest={}, _growing={})

    @cached_property
    def guess(self) -> Guess:
        """Where the fits of all structures begin."""
        return Guess.of(self.problem, self.fopdt)

    @property
    def floor(self) -> float:
        """Sum of squares that is rounding."""
        return self.problem.time.size * NEGLIGIBLE**2

    @cached_property
    def length(self) -> float:
        """Length of the record [s]."""
        return float(np.ptp(self.problem.time))

    @cached_property
    def most_growth(self) -> float:
        """Fastest growth with which a process did not run away [1/s]; a relay shows it."""
        if self.held:
            return math.inf
        return MOST_GROWTH / max(longest_stay(time, u) for time, u in self._parts)

    @property
    def _parts(self) -> list[tuple[FloatArray, Input]]:
        """Sample times and input of each experiment."""
        parts = zip(self.problem.experiments, self.problem.inputs, strict=True)
        return [(self.problem.time[part], u) for part, u in parts]

    @cached_property
    def pushed(self) -> float:
        """Longest time for which the command acted in one direction [s]; infinite for a relay."""
        if self.sign:
            return math.inf
        return max(longest_push(time, u) for time, u in self._parts)

    def candidate(self, problem: Problem, state: Trial) -> Candidate | None:
        """Return a fit as a candidate; None if it cannot be read as its structure.

        :param problem: what was fitted.
        :param state: the fit.
        """
        model = problem.structure.model_at(state.theta, state.coefficients)
        if model is None:
            return None
        below, above = self.latest
        own, other = (above, below) if model.process_sign > 0 else (below, above)
        if own < 0.0:
            # What is first seen, and what a relay oscillates on, is that of an inverse response.
            if not any(-_LASTING * self.length < z.real < 0.0 for z in model.zeros):
                return None
            own = other
        if model.dead_time > own:
            # The measurement had moved by then, whatever else a fit would explain so.
            return self.refit(replace(problem, latest=own), state)
        if model.growth_in(1.0) > self.most_growth or model.growth_in(model.dead_time) > _HELD:
            return None
        if self._impossible(problem, state):
            return None
        shortest, _ = time_scales(self.problem)
        if is_unobservable(model, shortest, self.length, self.pushed):
            return None
        found = Candidate(problem, state, model, self._score(problem, state, model))
        if problem.colour is None:
            pair = (self.closest.get(model.process_sign, found), found)
            closer = min(pair, key=lambda c: c.state.cost / c.state.residual.size)
            self.closest[model.process_sign] = closer
        return found

    def _impossible(self, problem: Problem, state: Trial) -> list[str]:
        """Return the terms whose estimates are impossible, or too small to be a term.

        :param problem: what was fitted.
        :param state: the fit.
        """
        found, least = state.coefficients, self.problem.least_command
        low, high = problem.ends_of(found)
        most = problem.most_play(held=self.held) if problem.play else 0.0
        possible = {
            # Commands may lose their effect on one side, but not act the other way there.
            "unequal": min(problem.effects(found)) >= 0.0,
            "ends": problem.ends is None
            or (
                # Nearer than the levels at which they are sought, they make it a switch.
                (high - low) * (ENDS + 1) >= float(np.ptp(problem.levels))
                and (math.isfinite(low) or math.isfinite(high))
                and problem.time_within(low, high) >= ONE_SIDE
            ),
            # Beyond all commands nothing would move.
            "friction": not problem.friction
            or least <= problem.dry_friction(found) <= float(np.ptp(problem.levels)),
            "play": not problem.play or least <= problem.play_of(found) <= most,
        }
        wrong = [term for term, may_be in possible.items() if not may_be]
        return wrong + problem.terms_beyond(_FARTHEST, state.theta, found)

    def refit(self, problem: Problem, state: Trial) -> Candidate | None:
        """Fit a problem from the fit of a similar one; None as for :meth:`candidate`.

        :param problem: what is fitted.
        :param state: the fit of the similar one.
        """
        return self.candidate(problem, _refit(problem, state))

    def _score(self, problem: Problem, state: Trial, model: TransferFunction) -> float:
        n = problem.time.size
        # The instant of a load and the rate are estimated, too.
        count = state.parameters + (problem.load is not None) + (problem.rate is not None)
        score = information_criterion(state.cost, n, count, self.floor)
        score += colour_cost(problem.colour, n)
        imitations = sum(nuisances_of(problem))
        if not self.held:
            # A relay bounds an integrator and what grows by itself, and shows both.
            lasting = any(abs(t) > _LASTING * self.length for t in model.time_constants)
            imitations += lasting or not model.is_stable
            # The free rate of an integrator is what a free state is to a lag: one imitation.
            imitations -= problem.drift and model.integrators > 0
        return score + IMITATES_A_DRIFT * imitations

    def of_one_term(self) -> list[Candidate]:
        """Return the FOPDT with drift, free state or past, for where it needs one of them."""
        found = []
        for terms in self.terms:
            if _BEFORE.issuperset(terms):
                changed: dict[str, Any] = dict.fromkeys(terms, True)
                problem = replace(self.problem, **changed)
                found.append(self.candidate(problem, self._fopdt_of(problem)))
        return [c for c in found if c is not None]

    def with_one_more_term(self, candidate: Candidate) -> list[Candidate]:
        """Return a candidate with each further term beside the model that a record may need.

        :param candidate: in white noise.
        """
        return [each for terms in self.terms for each in self.with_terms(candidate, terms)]

    def with_terms(self, candidate: Candidate, terms: tuple[str, ...]) -> list[Candidate]:
        """Return a candidate with further terms beside the model; none where it has no such.

        :param candidate: in white noise.
        :param terms: some of ``TERMS``.
        """
        if all(nuisances_of(candidate.problem, terms)):
            return []
        if "relaxation" in terms and not candidate.structure.factors:
            # The free state of an integrator is the offset.
            return []
        if "friction" in terms and not candidate.structure.integrators:
            # It acts against the motion of a position.
            return []
        changed: dict[str, Any] = dict.fromkeys(terms, True)
        if "ends" in terms:
            changed["ends"] = self.ends
        if "rate" in terms:
            changed["rate"] = self.rate()
        if "load" in terms:
            changed["load"] = likeliest_load(candidate.problem, candidate.state)
        if None in changed.values():
            return []
        problem, state = _with_terms_in_place(
            replace(candidate.problem, **changed), candidate.state
        )
        if not _HIDDEN.isdisjoint(terms):
            again = self._restarted_from_fopdt(problem, state)
            problem, state = (
                (problem, state) if again is state else _with_terms_in_place(problem, again)
            )
        if "ends" in terms and self.bounded and self._grows_as_well(state.cost):
            # What a controller keeps from growing looks as if large commands were not answered.
            return []
        other = self.candidate(problem, state)
        return [] if other is None else [other]

    def _grows_as_well(self, cost: float) -> bool:
        """Return whether a process that grows by itself leaves no more than a sum of squares."""
        problems = (replace(self.problem, structure=s) for s in (UNSTABLE_FOPDT, UNSTABLE_SOPDT))
        fits = (self._best_fit(p, math.inf) for p in problems)
        return any(fit is not None and fit.cost <= cost for fit in fits)

    def with_a_load(self, candidate: Candidate) -> list[Candidate]:
        """Return a candidate with a step of the load, another one in place of its own; or none.

        :param candidate: in white noise.
        """
        candidate = replace(candidate, problem=without(candidate.problem, ["load"]))
        return self.with_terms(candidate, ("load",))

    @cached_property
    def ends(self) -> tuple[float, float] | None:
        """The levels at which the actuator may end; None: nothing speaks for any."""
        return likeliest_ends(self.problem)

    def _restarted_from_fopdt(self, problem: Problem, state: Trial) -> Trial:
        """Return a fit with a further term, begun anew where a FOPDT explains more.

        Without the term, a dead time or a lag may have stood for it. A richer structure explains
        at least what a FOPDT does; if it explains less, its fit is in a wrong minimum.

        :param problem: what was fitted.
        :param state: its fit, from that without the term.
        """
        beside, n = replace(problem, structure=FOPDT), problem.time.size
        fopdt = self._fopdt_of(beside)
        if problem.structure == FOPDT:
            return min(state, fopdt, key=lambda s: s.cost)
        own, plain = (information_criterion(s.cost, n, 0, self.floor) for s in (state, fopdt))
        if own - plain <= LITTLE:
            return state
        starts = self._starts(problem, Guess.of(beside, fopdt))
        return min(state, best_of(problem, starts), key=lambda s: s.cost)

    def _starts(self, problem: Problem, guess: Guess) -> list[FloatArray]:
        """Return where the fits of a structure begin; one that grows is not like any FOPDT.

        A grid tells them once, since the terms beside the model change them little.
        """
        structure = problem.structure
        if not structure.unstable:
            return guess.starts(structure)
        if structure.name not in self._growing:
            self._growing[structure.name] = start_unstable(problem)
        return self._growing[structure.name]

    def _fopdt_of(self, problem: Problem) -> Trial:
        """Return the best fit of a FOPDT with some terms, found once for the same samples.

        :param problem: of this context, with a FOPDT structure.
        """
        key = _key_of_fit(problem)
        if key not in self._fits:
            starts = [self.fopdt.theta, *start_fopdt(problem, self.sign)]
            self._fits[key] = best_of(problem, starts)
        return self._fits[key]

    @cached_property
    def terms(self) -> list[tuple[str, ...]]:
        """Names of the terms beside the model that the record may need, alone or together."""
        alone = all(begins_with_only_move(time, u) for time, u in self._parts)
        rested = alone or needs_no_past(self.problem, self.sign)
        needed = {
            "drift": not alone,
            "relaxation": not rested,
            "past": not rested and self.problem.past_is_open,
            "unequal": self.problem.shows_its_curve,
            "play": self.problem.most_play(held=self.held) >= self.problem.least_command,
            "load": self.loads and len(self.problem.bounds) == 1,
            "ends": not self.held and self.problem.shows_its_curve,
            # The shape of one answer shows lags as well.
            "rate": not self.bounded
            and all(
                isinstance(u, PiecewiseConstant)
                and not moves_always(time, u)
                and changes_within(u, time).size > 1
                for time, u in self._parts
            ),
            "friction": self.held and bool(self.problem.motions),
        }
        each: list[tuple[str, ...]] = [(term,) for term in TERMS if needed[term]]
        # Of a movement before the record, either part alone may explain nothing.
        return [*each, ("relaxation", "past")] if needed["past"] else each

    def with_nuisances_of(self, candidate: Candidate) -> FitContext:
        """Return the context with the terms beside the model of a candidate, in its own colour.

        :param candidate: fitted to the same samples.
        """
        problem = replace(candidate.problem, structure=FOPDT, colour=self.problem.colour)
        fopdt = self._fopdt_of(problem)
        # A FOPDT has the longest dead time of all, since it includes every small lag.
        problem = drop_first_dead_time(problem, fopdt)
        return replace(self, problem=problem, fopdt=fopdt, _fits={})

    def fit(
        self, names: Iterable[str], order: int = 0, ready: Sequence[Candidate] = ()
    ) -> list[Candidate]:
        """Fit structures in one colour, one after the other: a hopeless one is given up early.

        :param names: of the structures.
        :param order: of equal lags; 0: several.
        :param ready: what was fitted before, perhaps to the same samples with the same terms.
        """
        terms = (nuisances_of(self.problem), self.problem.time.size)
        same = {
            c.structure.name: c
            for c in ready
            if (nuisances_of(c.problem), c.problem.time.size) == terms
        }
        # The least mean square so far.
        least = math.inf
        found: list[Candidate] = []
        for name in names:
            if name in same:
                found.append(same[name])
                continue
            for structure in self._structures_of(name, order):
                problem = replace(self.problem, structure=structure)
                if not structure.integrators:
                    problem = without(problem, ["friction"])
                state = self._best_fit(problem, least)
                if state is not None and (wrong := self._impossible(problem, state)):
                    # Another structure needed them.
                    problem = without(problem, wrong)
                    state = self._best_fit(problem, least)
                candidate = None if state is None else self.candidate(problem, state)
                if candidate is not None:
                    # A controller read backward is no candidate and makes no other fit hopeless.
                    left = max(candidate.state.cost, self.floor)
                    least = min(least, left / problem.time.size)
                    found.append(candidate)
        return found

    def of_opposite_sign(self) -> list[Candidate]:
        """Return models of the direction opposite to the relay's, with an inverse response.

        With others no oscillation lasts. In the direction of the relay, a FOPDT shows the fast
        part of an inverse response.
        """
        found = []
        for structure in (SOPDT_ZERO, INTEGRATOR_INVERSE):
            problem = replace(self.problem, structure=structure)
            state = multistart(problem, self.guess.of_opposite_sign(structure))
            found.append(None if state is None else self.candidate(problem, state))
        return [c for c in found if c is not None and c.model.process_sign * self.sign < 0]

    def best_of_direction(self, sign: int) -> list[Candidate]:
        """Return plain models of one direction, from starts of their own.

        :param sign: of the gain, 1 or -1.
        """
        problem = replace(without(self.problem, ["friction"]), structure=FOPDT, colour=None)
        fopdt = best_fopdt(problem, sign)
        found = replace(self, problem=problem, fopdt=fopdt, _fits={}).fit(PLAIN)
        return [c for c in found if c.model.process_sign == sign]

    def refit_in_colour(self, candidate: Candidate, colour: Colour | None) -> Candidate | None:
        """Fit a candidate in another colour, without terms that come out impossible there.

        :param candidate: of this context's samples.
        :param colour: of the noise; None: white.
        """
        problem = replace(candidate.problem, colour=colour)
        state = _refit(problem, candidate.state)
        wrong = self._impossible(problem, state)
        return (
            self.refit(without(problem, wrong), state) if wrong else self.candidate(problem, state)
        )

    def _structures_of(self, name: str, order: int) -> Iterator[Structure]:
        """Yield the structures of a name that there are samples enough for."""
        row = TABLE[name]
        if row.any_order:
            most = _MOST_LAGS_WITH_ZERO if row.zero else MOST_LAGS
            family = [row.of_order(n) for n in ([order] if order else range(2, most + 1))]
        else:
            # Three lags of which two are complex.
            family = [THREE_LAGS if row == LAG_COMPLEX else row]
        for structure in family:
            enough = _SAMPLES_EACH * (structure.order + 4) <= self.problem.time.size
            if enough or structure.order <= 1:
                yield structure

    def _best_fit(self, problem: Problem, least: float) -> Trial | None:
        """Return the best fit of a structure; None where it is hopeless beside the least one."""
        zero, key = problem.structure.zero, _key_of_fit(problem)
        if zero is None and key in self._fits:
            return self._fits[key]
        sign = 0 if zero or problem.structure.unstable else self.sign
        state = multistart(problem, self._starts(problem, self.guess), least, sign)
        if zero is not None:
            return self._with_zero_on_either_side(problem, state, least)
        if state is not None:
            self._fits[key] = state
        return state

    def _with_zero_on_either_side(
        self, problem: Problem, state: Trial | None, least: float
    ) -> Trial | None:
        """Return a fit with a zero, begun anew where the structure without it explains more.

        With the zero it explains at least as much, or its fit is in a wrong minimum. At a zero of
        0, dead time and zero act alike to first order and the search would stay there, so that it
        begins on either side.

        :param problem: with a zero.
        :param state: its fit; None where it is hopeless beside the least one.
        :param least: mean square of the best structure so far.
        """
        structure = problem.structure
        without_it = replace(problem, structure=replace(structure, zero=None))
        within = self._best_fit(without_it, least)
        if within is None or (state is not None and state.cost < within.cost):
            return state
        aside = np.append(np.zeros(within.theta.size - 1), _ASIDE)
        starts = (stepped(structure, within.theta, by) for by in (-aside, aside))
        nearer = min((evaluate(problem, theta) for theta in starts), key=lambda s: s.cost)
        again = refine(problem, nearer, tolerance=TRIAL)
        return again if state is None else min(state, again, key=lambda s: s.cost)


def _key_of_fit(problem: Problem) -> tuple[object, ...]:
    """Return what tells the fits of one context apart, whose structures have no zero."""
    # The samples of a first dead time may have been dropped.
    terms = problem.load, problem.ends, problem.rate, *nuisances_of(problem)
    return problem.structure.denominator, problem.time.size, *terms


def _refit(problem: Problem, state: Trial) -> Trial:
    """Return the fit of a problem, from that of a similar one."""
    return refine(problem, state.theta, tolerance=TRIAL, most=_STEPS)


def _with_terms_in_place(problem: Problem, state: Trial) -> tuple[Problem, Trial]:
    """Return a problem with its load and ends where its fit says that they are, and that fit."""
    state = _refit(problem, state)
    for _ in range(_MOVES):
        moved = problem.moved(state.coefficients)
        if moved is problem:
            break
        problem, state = moved, _refit(moved, state)
    return problem, state


def likeliest_load(problem: Problem, state: Trial) -> float:
    """Return the instant of some at which a step of the load explains most [s].

    At each the least squares are found with the model linearised about its fit without a load.

    :param problem: of one experiment, without a load.
    :param state: its fit.
    """
    few = coarse(problem)
    known = evaluate(few, state.theta)
    basis, _ = np.linalg.qr(np.concatenate((known.columns, known.derivative)).T)
    left = known.residual - basis @ (basis.T @ known.residual)
    instants = problem.instants
    moved = few.time - instants[:, None]
    answers = few.seen(shifted_columns(few.structure, state.theta, moved, pulse()))
    answers = answers - (answers @ basis) @ basis.T
    remaining = [float(np.sum(residual_of(left, rows) ** 2)) for rows in answers.swapaxes(0, 1)]
    return float(instants[int(np.argmin(remaining))])
