# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The choice among all candidates: structure, terms beside the model, and colour of the noise.

Noise and models are estimated in turn (Cochrane and Orcutt 1949, iterated): every structure is
fitted by generalised least squares (Aitken 1935) in the colour of the best one's residual, an
autoregression of the order that the data choose. White noise is its order 0. A criterion that
took correlated samples for independent ones would prefer models that follow the noise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.waveform.candidates import (
    LITTLE,
    PLAIN,
    Candidate,
    FitContext,
)
from relay_autotune.identification.waveform.direction import opposed
from relay_autotune.identification.waveform.fit_covariance import Fit, raw_residual
from relay_autotune.identification.waveform.past import drop_first_dead_time, moves_seldom
from relay_autotune.identification.waveform.problem import (
    NEGLIGIBLE,
    Problem,
    nuisances_of,
    with_terms_of,
)
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.residuals import (
    Colour,
    colour_cost,
    colour_of,
    ljung_box,
)
from relay_autotune.identification.waveform.separable import (
    TRIAL,
    Trial,
    information_criterion,
    refine,
    rms_in_simulation,
)
from relay_autotune.process.structures import (
    FOPDT,
    INTEGRATOR_INVERSE,
    INTEGRATOR_LAG,
    IPDT,
    LAG_N,
    LAG_N_ZERO,
    SOPDT,
    SOPDT_ZERO,
    TABLE,
    THREE_LAGS,
    TWO_EQUAL_ONE,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
)
from relay_autotune.record.moves import answering_time, large_changes
from relay_autotune.record.record import PiecewiseConstant
from relay_autotune.text import digits

# Order in which structures are fitted: first those that show which others are hopeless.
TRIED = tuple(
    structure.name
    for structure in (
        *(FOPDT, SOPDT, LAG_N, THREE_LAGS, TWO_EQUAL_ONE, LAG_N_ZERO, SOPDT_ZERO),
        *(IPDT, INTEGRATOR_LAG, INTEGRATOR_INVERSE, UNSTABLE_FOPDT, UNSTABLE_SOPDT),
    )
)
# By these it is decided what is estimated beside the model: a command off the balance of an
# integrator looks like a drift.
SIMPLE = (FOPDT.name, SOPDT.name, IPDT.name)
# Numbers of samples, and samples for each response of the process. More correlated samples tell
# little, unless the process is fast; much denser ones would favour what is faster than it.
_FEW, _MOST = 2000, 4000
_A_RESPONSE = 5.0
# Samples for each response that show its form, and the least number of such lengths: of fewer
# samples no colour of a smooth disturbance is found.
_A_CURVE, _RESPONSES = 20.0, 3.0
# In white noise every sample tells something; more than these change no choice.
_MOST_WHITE = 16_384
_MOST_TIMES = 4
# Turns between a colour and what it leaves.
_MOST_TURNS = 20
# Probability of white noise as correlated as a residual, from which that counts as white.
_CHANCE = 1e-3
# Score beyond which a structure is hopeless beside the best one: odds of e^15. The plain ones
# never are: gains have to hold on their models, too.
_HOPELESS = 30.0
_ALIKE = 0.01
# Gain in the score from which a response counts as one: odds of 20,000 to 1. Of 90 simulated pairs
# of command and measurement that belong together it refused 4 whose gains were trusted, and of 90
# that do not, 23 of the 43 with gains.
ANSWERED = 20.0
# Mean square that a model in colour may leave, over that of the best simulation: a colour near a
# random walk explains the response itself. Of 50 records with every kind of noise and a process
# that is not linear, the right model left up to 3.6 times as much (benchmarks/unmodelled.py).
_WORSE = 6.0
# Samples by which a measurement may be ahead of the command: of the one in its own row, which may
# have acted since the row before, and one more for what the structure lacks. Those that are tried.
_ROWS, _AHEAD = 2.0, 20.0
# Longest dead time as a share of the time after the first change of the command: what came later
# has nothing to confirm it, and may be of the past.
_LATEST = 0.5


class NoResponseError(IdentificationError):
    """No response explains the record.

    :param known: the structure, if it is known.
    """

    def __init__(self, known: Known) -> None:
        of, first = "", ""
        if known.structure:
            of, first = f" of a {known.structure}", "leave the structure open, "
        super().__init__(
            f"the measurement shows no response{of} to the command beyond its noise and a slow "
            f"disturbance: {first}record from a rest on, raise the amplitude, move the command "
            "more often, leave out parts in which something else acts, with --loss tukey where a "
            "sensor dropped out, and check that both topics belong to one loop"
        )


def chosen_fit(
    problem: Problem,
    known: Known,
    sign: int,
    scale: float,
    *,
    held: bool,
    among: Sequence[str] = TRIED,
    before: Fit | None = None,
) -> Fit:
    """Return the fit of the best structure, in the colour of its noise.

    :param problem: samples and input, with a FOPDT structure; its colour is that in which the
        search begins.
    :param known: the structure, if it is known.
    :param sign: direction of the relay, 1 or -1; 0: not known.
    :param scale: range of the measurement [y].
    :param held: True: a relay held the process, so that it may be unstable.
    :param among: names of the structures, where none is known.
    :param before: what was chosen for nearly the same samples, from which the search goes on, too.
    :raises NoResponseError: if no structure explains the record.
    :raises IdentificationError: if the response is within one sample.
    """
    if not held:
        parts = zip(problem.experiments, problem.inputs, strict=True)
        longest = max(answering_time(problem.time[part], u) for part, u in parts)
        problem = replace(problem, latest=_LATEST * longest)
    few = _context_of_few_samples(problem, sign, held)
    found = _compared(few, known, among, before)
    _require_dynamics(few, found)
    dense = problem.thinned(_MOST_WHITE)
    if found and dense.time.size > few.problem.time.size:
        found = _on_more_samples(replace(few, problem=dense), found)
    own = [c for c in found if sign * c.model.process_sign >= 0]
    if found and sign and not known.structure:
        turned = (few.refit_in_colour(c, found[0].problem.colour) for c in few.of_opposite_sign())
        found = [*found, *(c for c in turned if c is not None)]
    # A disturbance that no term describes can make a colour that explains the response as well.
    # The best simulation still shows the response and its direction: it is the second choice.
    slow = problem.colour is not None
    coloured = [c for c in own if not slow and c.problem.colour is not None]
    again = (few.refit_in_colour(c, None) for c in coloured)
    simulated = [c for c in again if c is not None]
    # A much closer one shows the direction, too, whatever its terms.
    closest = min(few.closest.values(), key=mean_square_left, default=None)
    if closest is not None and not (sign or slow):
        direction, least = closest.model.process_sign, mean_square_left(closest)
        own = [c for c in own if c.model.process_sign == direction or _simulates(c, least)]
        simulated = simulated if own else [closest]
    fits: list[Fit] = []
    for group in (own, simulated):
        ranked = sorted(group, key=lambda c: c.score)
        finished = (_fitted_to_all(c, found, problem, scale) for c in ranked)
        fits += itertools.islice((fit for fit in finished if fit is not None), 1)
    if not fits:
        raise NoResponseError(known)
    # Without odds of a response in colour, the best simulation: it shows jumps and spikes, which
    # are left out next.
    *first, last = fits
    best = next((f for f in first if odds_of_response(f.problem, f.state) > ANSWERED), last)
    if not sign:
        best = replace(best, opposed=partial(opposed, few, best))
    plain = next((c for c in own if c.structure == FOPDT), None)
    if plain is None or best.problem.structure == FOPDT:
        return best
    return replace(best, plain=partial(_fitted_to_all, plain, [], problem, scale))


def _on_more_samples(context: FitContext, found: list[Candidate]) -> list[Candidate]:
    """Return candidates fitted to more samples in white noise, unless these are correlated.

    :param context: of all samples.
    :param found: fitted to some of them, the best first.
    """
    again = []
    for c in found:
        if c.score <= found[0].score + _HOPELESS:
            problem = drop_first_dead_time(with_terms_of(c.problem, context.problem), c.state)
            more = context.refit(problem, c.state)
            if more is None:
                continue
            if c is found[0] and _colour_of_residual(more.problem, more.state) is not None:
                return found
            again.append(more)
    return sorted(again, key=lambda c: c.score) or found


def _require_dynamics(context: FitContext, found: Sequence[Candidate]) -> None:
    """Raise an error where a response within one sample explains most, and no candidate more."""
    problem, fopdt = context.problem, context.fopdt
    thinned = float(np.median(np.diff(problem.index))) > 1.0
    if thinned or unit_steps(FOPDT, fopdt.theta)[-1] > problem.shortest:
        return
    left, total = rms_in_simulation(problem, fopdt.coefficients, fopdt.theta)
    least = min(map(mean_square_left, found), default=math.inf)
    gain = math.log(max(left**2, NEGLIGIBLE**2)) - math.log(max(least, NEGLIGIBLE**2))
    # In a colour, a model leaves more in simulation and is no worse.
    coloured = bool(found) and found[0].problem.colour is not None
    needed = -math.log(_WORSE) if coloured else ANSWERED / problem.time.size
    if left < 0.5 * total and gain < needed:
        raise IdentificationError(
            "the measurement follows the command within one sample, "
            f"{digits(problem.shortest, 2)} s, and shows no dynamics: sample faster; where a "
            "controller made the command, move its set-point while recording; if there are no "
            "dynamics, an integral controller is enough"
        )


def odds_of_response(problem: Problem, state: Trial) -> float:
    """Return by how much the score of a response is better than that of a disturbance alone.

    Each score is in the colour of its own residual. A slow disturbance explains any single slow
    excursion of the measurement, so each further answer to the command adds to the odds. The odds
    are the better of two: of all samples, and of a few for each response, since a model can be
    right below the frequencies of the loop and wrong above them.

    :param problem: what was fitted.
    :param state: its fit.
    """
    white = replace(problem, colour=None)
    takes = unit_steps(problem.structure, state.theta, problem.shortest)[-1]
    some = int(_A_CURVE * max(float(np.ptp(problem.time) / takes), _RESPONSES))
    return max(
        _odds_over_disturbance(white.thinned(most), state.theta, problem.colour)
        for most in (_MOST, some)
    )


def ahead_of_command(problem: Problem, state: Trial) -> float:
    """Return by how long the measurement is ahead of the recorded command [s]; 0: it follows.

    It is where a FOPDT or SOPDT of a command that came earlier explains more than a model without
    a dead time does.

    :param problem: what was fitted.
    :param state: its fit.
    """
    if state.theta[-1] >= problem.shortest:
        return 0.0
    least = _AHEAD * problem.shortest
    earlier = float(unit_steps(problem.structure, state.theta, least)[-1])
    inputs = tuple(replace(u, times=u.times - earlier) for u in problem.inputs)
    moved = replace(problem, inputs=inputs, structure=FOPDT, colour=None)
    context = FitContext.of(moved, 0, held=True)

    def score(of: Trial) -> float:
        return information_criterion(of.cost, problem.time.size, of.parameters, context.floor)

    for c in context.fit(PLAIN):
        own = refine(replace(c.problem, colour=problem.colour), c.state.theta, tolerance=TRIAL)
        by = earlier - float(own.theta[-1])
        if by > _ROWS * problem.shortest and score(state) - score(own) > ANSWERED:
            return by
    return 0.0


def _odds_over_disturbance(problem: Problem, theta: FloatArray, colour: Colour | None) -> float:
    """Return by how much the score of a response is better than that of a disturbance alone.

    :param problem: has the samples, in white noise.
    :param theta: of the model.
    :param colour: in which it was fitted.
    """
    alone, own = _best_in_any_colour(problem, problem.nuisances(theta), None)
    rows = problem.seen(problem.columns(theta))
    answered = min(_best_in_any_colour(problem, rows, c)[0] for c in (colour, own))
    return alone - answered - theta.size * math.log(problem.time.size)


def _best_in_any_colour(
    problem: Problem, rows: FloatArray, colour: Colour | None
) -> tuple[float, Colour | None]:
    """Return the score of the best sum of some rows in the colour of what it leaves, and that.

    :param problem: has the samples, in white noise.
    :param rows: of any size, weighted, shape (k, n).
    :param colour: with which to begin.
    """
    n, floor = problem.y.size, problem.y.size * NEGLIGIBLE**2
    y, best = problem.y_seen, (math.inf, colour)
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), NEGLIGIBLE)
    for _ in range(_MOST_TURNS):
        whitened = replace(problem, weight=None, colour=colour)
        seen, by = whitened.seen(y), whitened.seen(rows)
        factors = np.linalg.lstsq(by.T, seen, rcond=None)[0]
        left = seen - factors @ by
        score = information_criterion(float(left @ left), n, rows.shape[0], floor)
        score += colour_cost(colour, n)
        if score > best[0] - LITTLE:
            break
        best = score, colour
        left = y - factors @ rows
        colour = colour_of([left[part] for part in problem.experiments])
    return best


def _context_of_few_samples(problem: Problem, sign: int, held: bool) -> FitContext:
    """Return the context of evenly spaced samples, a few for each response of the process."""
    few = FitContext.of(problem, sign, held=held, most=_FEW)
    if few.problem.time.size == problem.time.size:
        return few
    log_tau, dead_time = few.fopdt.theta
    responses = float(np.ptp(problem.time)) / (math.exp(log_tau) + dead_time)
    count = int(min(max(_A_RESPONSE * responses, _FEW), _MOST))
    more = problem.thinned(count)
    return few if more.time.size == few.problem.time.size else few.with_samples(more)


def _compared(
    context: FitContext, known: Known, among: Sequence[str], before: Fit | None
) -> list[Candidate]:
    """Return all structures in one colour, with the terms beside them, the best first.

    The terms are decided with a few simple structures.
    """
    # What runs away by itself is not recorded, except where a relay or a controller held it.
    names = [n for n in among if context.bounded or not TABLE[n].unstable]
    first = [*SIMPLE, *[INTEGRATOR_LAG.name] * bool(context.problem.motions)]
    if known.structure:
        names = first = [known.structure]
    simple = context.fit(first, known.order)
    if FOPDT.name in first and all(c.structure != FOPDT for c in simple):
        # Without what came before, it may have no response, or go in a direction ruled out.
        simple = [*simple, *context.of_one_term()] or context.fit(names, known.order)
    if before is not None:
        again = context.refit(with_terms_of(before.problem, context.problem), before.state)
        simple += [] if again is None else [again]
    if not simple:
        return []
    decided = _with_best_terms(context, simple)
    before_it = any(nuisances_of(decided.problem, ("relaxation", "past")))
    if before_it and moves_seldom(context.problem) and not known.structure:
        # What came just before a step acts as a zero does, which no simple structure has.
        zeros = (_with_best_terms(context, [c]) for c in context.fit([SOPDT_ZERO.name]))
        decided = min((decided, *zeros), key=lambda c: _in_own_colour(context, c).score)
    found = _structures_with_terms(context, known, names, decided, simple)
    if not found or context.loads or len(context.problem.bounds) > 1:
        return found
    if found[0].problem.colour is None and not context.bounded:
        # The end of a single step looks like a load; a controller answers both.
        return found
    return _with_a_load(replace(context, loads=True), known, names, found, simple)


def _with_a_load(
    context: FitContext,
    known: Known,
    names: Sequence[str],
    found: list[Candidate],
    simple: Sequence[Candidate],
) -> list[Candidate]:
    """Return structures beside a step of the load and those without one, the best first.

    A load counts only if a simple structure with it explains more than any without, and leaves
    white noise: between a few steps, a slow disturbance looks like a load.

    :param context: the samples; a load may be estimated.
    :param known: the structure, if it is known.
    :param names: of the structures.
    :param found: all without a load, the best first.
    :param simple: some of them in white noise, without any terms.
    """
    best = context.refit_in_colour(found[0], None)
    starts = [*simple, *([] if best is None else [best])]
    loaded = [each for without in starts for each in context.with_a_load(without)]
    if loaded:
        # From a lag alone, the others find their way out of a minimum without a load.
        inside = context.with_nuisances_of(min(loaded, key=lambda c: c.score))
        some = inside.fit([c.structure.name for c in simple], known.order)
        loaded += [each for rough in some for each in context.with_a_load(rough)]
    better = [
        c for c in loaded if c.score < found[0].score and _is_white(c) and _is_clear_of_moves(c)
    ]
    if not better:
        return found
    again = _structures_with_terms(
        context, known, names, min(better, key=lambda c: c.score), loaded
    )
    white = [c for c in _refit_all(None, again, context) if c.score < found[0].score]
    if not (white and _is_white(white[0]) and _is_clear_of_moves(white[0])):
        return found
    return sorted(_not_hopeless([*white, *found]), key=lambda c: c.score)


def _is_clear_of_moves(candidate: Candidate) -> bool:
    """Return whether a load comes a dead time apart from each large move of the command.

    A nearer load can stand for a part of the answer to that move.
    """
    u, load = candidate.problem.inputs[0], candidate.problem.load
    if load is None or not isinstance(u, PiecewiseConstant):
        return False
    nearest = np.min(np.abs(large_changes(u) - load), initial=math.inf)
    return bool(nearest > candidate.model.dead_time)


def _is_white(candidate: Candidate) -> bool:
    """Return whether white noise leaves what a candidate leaves, fitted in white noise."""
    return ljung_box(candidate.state.residual) >= _CHANCE


def _structures_with_terms(
    context: FitContext,
    known: Known,
    names: Sequence[str],
    decided: Candidate,
    ready: Sequence[Candidate],
) -> list[Candidate]:
    """Return structures with the terms of one candidate, in the likeliest colour, the best first.

    The best structure of all may need other terms than a simple one, with which all are compared
    again.

    :param context: the samples, and the terms that may be estimated.
    :param known: the structure, if it is known.
    :param names: of the structures.
    :param decided: has the terms, in white noise.
    :param ready: fitted before, in white noise.
    """
    best: list[Candidate] = []
    tried: set[tuple[bool, ...]] = set()
    while (terms := nuisances_of(decided.problem)) not in tried:
        tried.add(terms)
        inside = context.with_nuisances_of(decided)
        found = _likeliest_colour(inside, inside.fit(names, known.order, (*ready, decided)))
        if not found:
            break
        best = min(best or found, found, key=lambda each: each[0].score)
        start = context.refit_in_colour(found[0], context.problem.colour)
        if start is None or known.structure:
            break
        decided = _with_best_terms(context, [start])
    return best


def _with_best_terms(context: FitContext, found: Sequence[Candidate]) -> Candidate:
    """Return the best of some candidates with the terms beside the model that improve its score.

    To each they are added one after the other, each time the one that improves the score most.
    Each score is in the colour of its own residual: where a structure is too simple, the colour
    explains what a term would.

    :param found: in white noise, at least one.
    """

    def by_own_colour(some: Sequence[Candidate]) -> list[tuple[float, Candidate]]:
        return [(_in_own_colour(context, c).score, c) for c in some]

    reached = []
    for now in by_own_colour(found):
        best = now
        while more := by_own_colour(context.with_one_more_term(best[1])):
            better = min(more, key=itemgetter(0))
            if better[0] >= best[0]:
                break
            best = better
        reached.append(best)
    return min(reached, key=itemgetter(0))[1]


def _in_own_colour(context: FitContext, candidate: Candidate) -> Candidate:
    """Return a candidate in the colour of its residual, or white where that is likelier."""
    colour = _colour_of_residual(candidate.problem, candidate.state)
    if colour is None:
        return candidate
    # A term that comes out impossible in the colour stays, and has its score in white noise.
    coloured = context.refit(replace(candidate.problem, colour=colour), candidate.state)
    return candidate if coloured is None else min(candidate, coloured, key=lambda c: c.score)


def _likeliest_colour(context: FitContext, simulated: list[Candidate]) -> list[Candidate]:
    """Return structures in the likeliest colour of the best one, the best first.

    The colour counts where its best model simulates the record about as well as the best
    simulation of all does.

    :param simulated: fitted to the measurement itself.
    """
    simulated = sorted(simulated, key=lambda c: c.score)
    if not simulated or simulated[0].state.cost <= context.floor:
        return simulated
    own = _colour_of_residual(simulated[0].problem, simulated[0].state)
    if own is None:
        return simulated
    found = _iterated_in_colour(_refit_all(own, simulated, context), context)
    least = min(map(mean_square_left, simulated))
    return found if found and _simulates(found[0], least) else simulated


def _iterated_in_colour(found: list[Candidate], context: FitContext) -> list[Candidate]:
    """Fit in the colour of the best one's residual, again until that changes no more."""
    for _ in range(_MOST_TIMES):
        if not found:
            return []
        best = found[0]
        found = _refit_all(
            _colour_of_residual(best.problem, best.state), _not_hopeless(found), context
        )
        if found and found[0].structure == best.structure:
            scale = unit_steps(best.structure, best.state.theta)
            change = np.abs(found[0].state.theta - best.state.theta) / scale
            if float(change.max()) <= _ALIKE:
                break
    return found


def _not_hopeless(found: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that are not hopeless."""
    most = min(c.score for c in found) + _HOPELESS
    return [c for c in found if c.score <= most or c.structure.name in PLAIN]


def names_not_hopeless(fit: Fit) -> list[str]:
    """Return the names of the structures that are not hopeless beside a chosen one.

    :param fit: with its candidates.
    """
    return list(dict.fromkeys(c.structure.name for c in _not_hopeless(fit.candidates)))


def _refit_all(
    colour: Colour | None, found: list[Candidate], context: FitContext
) -> list[Candidate]:
    """Return candidates fitted in one colour, the best first."""
    again = (context.refit_in_colour(c, colour) for c in found)
    return sorted((c for c in again if c is not None), key=lambda c: c.score)


def _colour_of_residual(problem: Problem, state: Trial) -> Colour | None:
    """Return the colour of a fit's weighted residual; None: it is white."""
    left = raw_residual(problem, state)
    if problem.weight is not None:
        left = left * problem.weight
    return colour_of([left[part] for part in problem.experiments])


def _simulates(candidate: Candidate, least: float) -> bool:
    """Return whether a model simulates the record about as well as the best simulation does.

    :param candidate: fitted in a colour.
    :param least: mean square that the best simulation leaves.
    """
    return mean_square_left(candidate) <= _WORSE * least


def mean_square_left(found: Candidate | Fit) -> float:
    """Return the mean square that a candidate or a fit leaves in simulation.

    :param found: with what was fitted.
    """
    state = found.state
    return rms_in_simulation(found.problem, state.coefficients, state.theta)[0] ** 2


def _fitted_to_all(
    candidate: Candidate, found: list[Candidate], problem: Problem, scale: float
) -> Fit | None:
    """Return the fit of a candidate to the end, in white noise to all samples."""
    own = candidate.problem
    if own.colour is not None:
        state = refine(own, candidate.state.theta)
    else:
        own = drop_first_dead_time(with_terms_of(own, problem), candidate.state)
        state = refine(own, candidate.state.theta)
        if (
            own.time.size > candidate.problem.time.size
            and _colour_of_residual(own, state) is not None
        ):
            # Samples so dense are correlated: those that were compared are not.
            own = candidate.problem
            state = refine(own, candidate.state.theta)
    model = own.structure.model_at(state.theta, state.coefficients)
    # Other samples may lead the fit to a minimum that is not the candidate's.
    if model is None or model.process_sign != candidate.model.process_sign:
        return None
    others = (c for c in found if c is not candidate)
    return Fit(own, state, (candidate, *others), scale)
