"""The structures that may explain the data, every one fitted, with the criterion of its fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from relay_autotune.identification.waveform.plausibility import is_unseen
from relay_autotune.identification.waveform.residuals import worth
from relay_autotune.identification.waveform.separable import (
    Problem,
    State,
    information_criterion,
    refine,
)
from relay_autotune.identification.waveform.starts import (
    Starts,
    begin,
    changes_within,
    coarse,
    go_on,
    least_promised,
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

FloatArray = NDArray[np.float64]

MOST_LAGS = 8
_MOST_LAGS_WITH_ZERO = 4
_SAMPLES_EACH = 8
# How many times smaller the mean square must be for the beginning to be left out.
_MUCH_BETTER = 4.0
# Standard errors from which a correlation of neighbours counts as one.
_CORRELATED = 4.0
# Drift and initial state belong to a fit only on strong evidence, since they blur the gain.
_EVIDENCE = 6.0
# A step that gains less than this share of the sum of squares changes no choice.
_TRIAL = 1e-6
# With a mean square so many times the least one, a structure has no support worth telling.
_BEYOND_HOPE = 4.0
# A fit that has begun is given up where it promises no less than so many times the least one; of
# a smaller mean square of the range, what it leaves is curvature that the promise does not know.
_NO_PROMISE = 6.0
_CLEAN = 1e-6
# What is asked for whatever it leaves.
_ALWAYS = ("fopdt", "ipdt")


@dataclass(frozen=True)
class Candidate:
    """One structure with its best fit.

    :param problem: what was fitted.
    :param state: the fit.
    :param model: the fit in the terms of the field.
    :param criterion: Bayesian information criterion; smaller is better.
    """

    problem: Problem
    state: State
    model: TransferFunction
    criterion: float

    @property
    def structure(self) -> Structure:
        """The structure."""
        return self.problem.structure


class Selection:
    """All structures on one record.

    :param problem: samples and input, with a FOPDT structure.
    :param floor: sum of squares that is rounding.
    :param sign: the direction in which the relay worked, 1 or -1, which a model must share; 0:
        not known.
    """

    def __init__(self, problem: Problem, floor: float, sign: int = 0) -> None:
        self._problem, self._floor, self._sign = problem, floor, sign
        # The least mean square so far.
        self._least = math.inf
        # How an unstable fit to a problem begins.
        self._begun: tuple[Problem, list[State]] | None = None
        self._fopdt = refine_best(problem, start_fopdt(problem, sign), tolerance=_TRIAL)
        self._leave_out_the_unknown()
        self._starts = Starts(self._problem, self._fopdt)

    def _leave_out_the_unknown(self) -> None:
        """Begin later where a record that was cut out of a movement explains itself better so."""
        whole = replace(self._problem, relaxation=True)
        _, longest = time_scales(whole)
        later = whole.part(whole.time >= whole.starts + longest)
        if 2 * later.time.size < whole.time.size or not _is_driven(later):
            return
        first = refine(whole, self._fopdt.theta, tolerance=_TRIAL)
        if first.cost <= _MUCH_BETTER * self._floor:
            return
        second = refine_best(later, start_fopdt(later, self._sign), tolerance=_TRIAL)
        enough = _MUCH_BETTER * second.cost / later.time.size
        if enough >= first.cost / whole.time.size:
            return
        # A long first swing from rest shows small lags, which a FOPDT lacks.
        third = replace(self._problem, structure=THREE_LAGS)
        flexible = refine_best(third, Starts(third, self._fopdt).third(), tolerance=_TRIAL)
        if flexible.cost / third.time.size > enough:
            self._problem, self._fopdt = later, second

    def candidate(self, problem: Problem, state: State) -> Candidate | None:
        """Return a fit as a candidate; None if it cannot be read as its structure."""
        structure = problem.structure
        model = structure.model_at(state.theta, state.coefficients)
        if model is None and structure == THREE_LAGS:
            problem = replace(problem, structure=LAG_COMPLEX)
            model = LAG_COMPLEX.model_at(state.theta, state.coefficients)
        if model is None:
            return None
        if self._sign and model.process_sign != self._sign:
            return None
        shortest, _ = time_scales(self._problem)
        time = self._problem.time
        if is_unseen(model, shortest, float(time[-1] - time[0])):
            return None
        criterion = information_criterion(
            state.cost, problem.time.size, state.parameters, self._floor
        )
        return Candidate(problem, state, model, criterion)

    def with_nuisances(self, found: Candidate) -> Candidate:
        """Add drift and a free initial state to a fit where the data ask for them.

        :param found: a fit with or without them.
        """
        best = found
        for drift in (False, True):
            for relaxation in (False, True):
                if (drift, relaxation) == (found.problem.drift, found.problem.relaxation):
                    continue
                if relaxation and not found.structure.factors:
                    # The free state of an integrator is the offset.
                    continue
                problem = replace(found.problem, drift=drift, relaxation=relaxation)
                state = refine(problem, found.state.theta, tolerance=_TRIAL)
                other = self.candidate(problem, state)
                if other is None or other.criterion > found.criterion - _EVIDENCE:
                    continue
                if other.criterion < best.criterion:
                    best = other
        return best

    def fit(self, name: str, order: int = 0) -> Candidate | None:
        """Fit one structure; None if the data cannot be read as it.

        :param name: of the structure.
        :param order: of equal lags; 0: the best of them.
        """
        found = [c for c in self._family(name, order) if c is not None]
        return min(found, key=lambda c: c.criterion) if found else None

    def all(self) -> list[Candidate]:
        """Fit every structure; the best first."""
        names = (
            *("fopdt", "lag_n", "sopdt", "three_lags", "two_equal_one"),
            *("lag_n_zero", "sopdt_zero", "ipdt", "integrator_lag", "integrator_inverse"),
            *("unstable_fopdt", "unstable_sopdt"),
        )
        # Drift and initial state are decided with the better of two flexible structures, and with
        # an integrator, to which a command off its balance is a drift.
        simple = [c for name in ("fopdt", "sopdt") if (c := self.fit(name)) is not None]
        integrator = self.fit("ipdt")
        if not simple:
            return []
        whole = self._problem
        decided = self.with_nuisances(min(simple, key=lambda c: c.criterion))
        if integrator is not None:
            other = self.with_nuisances(integrator)
            decided = min(decided, other, key=lambda c: c.criterion)
            simple.append(integrator)
        base = decided.problem
        found = self._fit_beside(base, names, simple)
        if found and (base.drift or base.relaxation):
            # What these two leave unexplained may pass for a drift: the best one is asked again.
            best = found[0]
            self._problem, self._least = whole, math.inf
            plain = self._best(best.structure, [best.state.theta])
            again = base if plain is None else self.with_nuisances(plain).problem
            if (again.drift, again.relaxation) != (base.drift, base.relaxation):
                return self._fit_beside(again, names, simple) or found
        return found

    def _fit_beside(
        self, nuisances: Problem, names: tuple[str, ...], ready: list[Candidate]
    ) -> list[Candidate]:
        """Fit structures to all samples with the drift and initial state of a problem.

        :param nuisances: the problem.
        :param names: of the structures.
        :param ready: what was fitted before, perhaps to the same problem.
        """
        problem = replace(nuisances, structure=FOPDT)
        if problem.relaxation:
            # A FOPDT has the longest dead time of all, since it counts every small lag to it.
            first = refine(problem, self._fopdt.theta, tolerance=_TRIAL)
            problem = after_the_unknown(problem, first)
        self._problem = problem
        same = {
            c.structure.name: c
            for c in ready
            if (c.problem.drift, c.problem.relaxation, c.problem.time.size)
            == (problem.drift, problem.relaxation, problem.time.size)
        }
        self._least = math.inf
        found: list[Candidate] = []
        for name in names:
            family = [same[name]] if name in same else self._family(name, 0)
            found += [c for c in family if c is not None]
        found.sort(key=lambda c: c.criterion)
        return self._weighed(found)

    def _weighed(self, found: list[Candidate]) -> list[Candidate]:
        """Return the candidates by what their samples are worth, the best first.

        Where even the best residual is correlated, it is by jitter or by what no structure holds.
        """
        if not found or found[0].state.cost <= self._floor:
            return found
        n = found[0].problem.time.size
        each = worth(found[0].state.residual, _CORRELATED)
        if each == 1.0:
            return found
        weighed = [
            replace(
                c,
                criterion=information_criterion(
                    c.state.cost, n, c.state.parameters, self._floor, each
                ),
            )
            for c in found
        ]
        return sorted(weighed, key=lambda c: c.criterion)

    def _family(self, name: str, order: int) -> list[Candidate | None]:
        starts = self._starts
        match name:
            case "fopdt":
                return [self._best(FOPDT, [self._fopdt.theta])]
            case "lag_n":
                orders = [order] if order else range(2, MOST_LAGS + 1)
                return [self._best(equal_lags(n), [starts.lag_n(n)]) for n in orders]
            case "lag_n_zero":
                orders = [order] if order else range(2, _MOST_LAGS_WITH_ZERO + 1)
                return [self._best(LAG_N_ZERO.of_order(n), starts.lag_n_zero(n)) for n in orders]
            case "sopdt":
                return [self._best(SOPDT, starts.sopdt())]
            case "sopdt_zero":
                thetas = [*starts.sopdt(), self._two_equal_lags()]
                return [self._best(SOPDT_ZERO, thetas)]
            case "two_equal_one":
                return [self._best(TWO_EQUAL_ONE, starts.two_equal_one())]
            case "three_lags" | "lag_complex":
                return [self._best(THREE_LAGS, starts.third())]
            case "ipdt":
                return [self._best(IPDT, [starts.integrator()])]
            case "integrator_lag":
                return [self._best(INTEGRATOR_LAG, starts.integrator_lag())]
            case "integrator_inverse":
                return [self._best(INTEGRATOR_INVERSE, starts.integrator_lag())]
            case "unstable_fopdt":
                return [self._continued(UNSTABLE_FOPDT, self._unstable())]
            case "unstable_sopdt":
                chosen = starts.unstable_second(self._unstable()[0].theta)
                return [self._best(UNSTABLE_SOPDT, chosen)]
        return []

    def _two_equal_lags(self) -> FloatArray:
        """Return a start of two lags and a zero: the two equal ones that fit best.

        From a FOPDT, which answers the right way at once, not every inverse response is found.
        """
        problem = replace(self._problem, structure=LAG_N_ZERO.of_order(2))
        best = go_on(problem, begin(problem, self._starts.lag_n_zero(2)))[0]
        return np.array((best.theta[0], 0.0, best.theta[1]))

    def _unstable(self) -> list[State]:
        """Return the beginning of an unstable FOPDT's fit, from which two structures go on."""
        if self._begun is None or self._begun[0] is not self._problem:
            problem = replace(self._problem, structure=UNSTABLE_FOPDT)
            self._begun = self._problem, begin(problem, self._starts.unstable(problem))
        return self._begun[1]

    def _best(self, structure: Structure, thetas: list[FloatArray]) -> Candidate | None:
        problem = replace(self._problem, structure=structure)
        if _SAMPLES_EACH * (structure.order + 4) > problem.time.size and structure.order > 1:
            # So few samples tell no more than a first order.
            return None
        return self._continued(structure, begin(problem, thetas))

    def _continued(self, structure: Structure, begun: list[State]) -> Candidate | None:
        """Return the best fit that a beginning leads to; None where it is hopeless."""
        problem = replace(self._problem, structure=structure)
        asked = structure.name in _ALWAYS
        if not asked and self._promises_nothing(problem, begun):
            return None
        rough = go_on(problem, begun)
        if not asked and self._is_hopeless(rough[0]):
            if self._promises_nothing(problem, rough[:1]):
                return None
            # Unless it was on its way still.
            best = rough[0]
            rough = [refine(coarse(problem), best.theta, tolerance=_TRIAL, damping=best.damping)]
            if self._is_hopeless(rough[0]):
                return None
        state = refine_all(problem, rough, _TRIAL)
        self._least = min(self._least, max(state.cost, self._floor) / problem.time.size)
        return self.candidate(problem, state)

    def _promises_nothing(self, problem: Problem, begun: list[State]) -> bool:
        return least_promised(problem, begun) > _NO_PROMISE * max(self._least, _CLEAN)

    def _is_hopeless(self, rough: State) -> bool:
        return rough.cost / rough.residual.size > _BEYOND_HOPE * self._least


def after_the_unknown(problem: Problem, state: State) -> Problem:
    """Return the samples whose input is known; all of them where the process was at rest.

    What was fed to a process that was not at rest before the record is not known, and acts for
    one dead time.

    :param problem: the problem.
    :param state: a fit, for its dead time.
    """
    if not problem.relaxation:
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
