# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The fit where the residual is not white: generalised least squares in the noise's colour.

A criterion that takes correlated samples for independent ones prefers models that follow the
noise. Here all structures are fitted by generalised least squares (Aitken 1935) in the colour of
the best one's residual (Cochrane and Orcutt 1949, iterated), and compared in that colour.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relay_autotune.identification.known import LOSSES, Known
from relay_autotune.identification.waveform.fit_covariance import (
    NEGLIGIBLE,
    Fit,
    Noise,
    estimate_of,
)
from relay_autotune.identification.waveform.rational import unit_steps
from relay_autotune.identification.waveform.residuals import (
    Colour,
    colour_of,
    ljung_box,
    slow_colour,
    worth,
)
from relay_autotune.identification.waveform.selection import (
    Candidate,
    Ground,
    begins_at_rest,
    needs_no_past,
    nuisances_of,
    of_shown_direction,
)
from relay_autotune.identification.waveform.separable import (
    Problem,
    Trial,
    left_beside,
    left_of,
    refine,
)
from relay_autotune.identification.waveform.starts import Starts, refine_best, start_fopdt
from relay_autotune.process.transfer_function import TransferFunction

# Probability as white noise below which a residual has a colour.
_WHITE = 1e-3
# Numbers of samples, and samples for each response of the process. More correlated samples tell
# little, unless the process is fast; much denser ones would favour what is faster than it.
_FEW, _MOST = 1200, 4000
_A_RESPONSE, _AT_LEAST = 5.0, 2.0
_MOST_TIMES = 4
# Excess of the criterion beyond which a structure is not tried in the next colour. The plain ones
# always are: gains have to hold on their models, too.
_HOPELESS = 30.0
PLAIN = ("fopdt", "sopdt")
# Length of the record in correlation times of the slow disturbance that is tried first.
_SLOWEST = 10.0
_ALIKE = 0.01
_TRIAL = 1e-6
_STEPS = 15
# Pasts that are tried: free initial state, unknown command before.
_PASTS = ((False, False), (False, True), (True, True))
_FIRST = ("fopdt", "sopdt", "sopdt_zero")
# Structure and order. Few numbers of equal lags: in coloured noise neighbours differ by chance.
_OTHERS = (("lag_n", 3), ("lag_n", 5), ("lag_n", 8), ("three_lags", 0))
_INTEGRATING = (("ipdt", 0), ("integrator_lag", 0), ("integrator_inverse", 0))
_UNSTABLE = (("unstable_fopdt", 0), ("unstable_sopdt", 0))
# Longest dead time, as a share of the record: a later response cannot be told from a drift.
_LONGEST = 0.25
# Gain in the criterion asked of an integrator, a growing mode or a free past: they fit any drift.
_EARNED = 10.0
# Longest lag in lengths of the record: a longer one counts as an integrator.
_LASTING = 2.0
# Largest standard deviation of a parameter that the samples determine, relative to its size.
_TOLD = 1.0
# Share of the sum of squares that a model in colour may always leave, and how many times that of
# the best simulation it may leave.
_EXPLAINS, _WORSE = 0.05, 25.0
# Probability as white noise, and worth of a sample, below which one flexible structure's residual
# is clearly coloured.
_CLEAR = 1e-12
_LITTLE_WORTH = 0.5
# Number of blocks of a record, and the ratio of one block's residual power to the median beyond
# which an event caused it.
_BLOCKS = 10
_UNEVEN = 5.0


def is_coloured(fit: Fit) -> bool:
    """Return whether the residual of a fit is not white noise."""
    state = fit.state
    if fit.loss != LOSSES[0] or state.cost <= state.residual.size * NEGLIGIBLE**2:
        return False
    p = ljung_box(state.residual)
    return not math.isnan(p) and p < _WHITE


def is_an_event(fit: Fit) -> bool:
    """Return whether most of a fit's residual came at one time, as from a step of the load.

    That is not noise of any colour: the load is estimated, or the cycles are left out.
    """
    blocks = np.array_split(fit.state.residual, _BLOCKS)
    powers = np.array([float(np.mean(block**2)) for block in blocks])
    return float(powers.max()) > _UNEVEN * float(np.median(powers))


def is_clearly_coloured(problem: Problem, sign: int) -> bool:
    """Return whether even a flexible structure with an unknown past leaves coloured noise.

    Then the choice of a structure for white noise is skipped, which takes longest on such data.

    :param problem: samples and input, with a FOPDT structure.
    :param sign: direction of the relay; 0: not known.
    """
    rested = needs_no_past(problem, sign)
    # A drift is no colour; a free past explains it as well.
    past = problem.past_is_open and not rested
    few = replace(problem.thinned(_FEW), past=past, drift=rested)
    found = Ground.of(few, few.time.size * NEGLIGIBLE**2, sign)
    if found.problem.time.size < few.time.size:
        # The first samples, which no past explains, were left out.
        return False
    flexible = next(iter(found.fit(("sopdt_zero",))), None)
    if flexible is None or flexible.state.cost <= few.time.size * NEGLIGIBLE**2:
        return False
    left = flexible.state.residual
    p = ljung_box(left)
    return not math.isnan(p) and p < _CLEAR and worth(left) < _LITTLE_WORTH


def in_colour(
    problem: Problem, scale: float, known: Known, sign: int, *, held: bool
) -> Fit | None:
    """Return the fit of all structures in the colour of their noise.

    :param problem: samples and input, with a FOPDT structure.
    :param scale: range of the measurement [y].
    :param known: the structure, if it is known.
    :param sign: direction of the relay; 0: not known.
    :param held: True: a relay held the process, so that it may be unstable.
    :return: None: no structure fits, or the noise is white.
    """
    whole = replace(problem, drift=False, relaxation=False, past=False)
    names = (known.structure,) if known.structure else ()
    found = _compared(*_dense_enough(whole, sign), sign, names, known.order, held=held)
    if not found or found[0].problem.colour is None:
        return None
    # The last steps of a fit may lead to where a pole and a zero cancel: they come first.
    chosen = first = _finished(found[0])
    if not _is_told(first):
        chosen = next((c for c in map(_finished, found[1:]) if _is_told(c)), first)
    others = (c for c in found if c.structure != chosen.structure)
    return Fit(chosen.problem, chosen.state, (chosen, *others), scale)


def _finished(candidate: Candidate) -> Candidate:
    state = refine(candidate.problem, candidate.state.theta)
    return replace(candidate, state=state)


def _is_told(candidate: Candidate) -> bool:
    """Return whether the samples determine each parameter.

    The standard deviation of a gain or a lag is compared with its value, that of a zero or a dead
    time with all times together. It is larger where a lag is shorter than the sampling interval,
    or where two lags cannot be told apart. A lag of more than two lengths of the record is that of
    an integrator.
    """
    problem, state = candidate.problem, candidate.state
    estimate = estimate_of(problem, state, Fit(problem, state, (), 1.0), Noise(False))
    if estimate is None or estimate.root is None:
        return False
    deviation = np.sqrt(np.einsum("pk,pk->p", estimate.root, estimate.root))
    model = estimate.model
    slow = model.dead_time + sum(abs(t) for t in model.time_constants)
    if _outlasts(model, float(np.ptp(problem.time))):
        return False
    pairs = zip(estimate.structure.parameters, estimate.values, strict=True)
    size = [abs(float(v)) if p.logarithmic else slow for p, v in pairs]
    return bool(np.all(deviation <= _TOLD * np.maximum(size, 1e-300)))


def _dense_enough(problem: Problem, sign: int) -> tuple[Problem, Problem]:
    """Return evenly spaced samples, a few for each response of the process, and fewer of them."""
    few = problem.thinned(_FEW)
    if few.time.size == problem.time.size:
        return problem, problem
    log_tau, dead_time = _ground(few, sign).fopdt.theta
    responses = float(np.ptp(problem.time)) / (math.exp(log_tau) + dead_time)
    every, some = (
        problem.thinned(int(min(max(each * responses, _FEW), _MOST)))
        for each in (_A_RESPONSE, _AT_LEAST)
    )
    return every, some


def _colour(problem: Problem, state: Trial) -> Colour | None:
    """Return the colour of a fit's weighted residual."""
    columns, _ = problem.columns(state.theta)
    left = problem.y - state.coefficients @ columns
    if problem.weight is not None:
        left = left * problem.weight
    return colour_of([left[part] for part in problem.experiments])


def _compared(
    problem: Problem, few: Problem, sign: int, names: tuple[str, ...], order: int, *, held: bool
) -> list[Candidate]:
    """Return all structures in one colour, the chosen one first.

    Noise and models are estimated in turn, from two starts: the residual of the best simulation,
    and a slow disturbance, which a simulation would follow. The more likely result counts.
    """
    grounds = [
        _ground(replace(few, relaxation=relaxation, past=past), sign)
        for relaxation, past in (_PASTS[:1] if begins_at_rest(problem) else _PASTS)
        if problem.past_is_open or not past
    ]
    # Each past is judged in the colour of its own residual; a richer one has to be clearly better.
    found = []
    for ground in grounds:
        begun = [c for name in names or _FIRST for c in ground.fit((name,), order)]
        asked = _of_all(ground, problem)
        if begun and (own := _in_its_own(_fitted_to(asked.problem, begun), asked)):
            found.append((_joint(own) + _unasked(asked.problem), begun, ground, asked))
    if not found:
        return []
    _, begun, ground, asked = min(found, key=lambda f: f[0])
    if not names:
        tried = (*_OTHERS, *_INTEGRATING, *(_UNSTABLE if held else ()))
        begun += [c for name, n in tried for c in ground.fit((name,), n)]
    simulated = _fitted_to(asked.problem, begun)
    once = _in_its_own(simulated, asked)
    slow = slow_colour(1.0 - _SLOWEST / problem.time.size)
    ends = [_converged(once, asked), _converged(_in(slow, simulated, asked), asked)]
    chosen = min((e for e in ends if _simulates(e, simulated)), key=_joint, default=once)
    return _ordered(chosen if sign or names else of_shown_direction(chosen))


def _of_all(ground: Ground, problem: Problem) -> Ground:
    """Return a ground of all samples, with the past of a ground of fewer samples."""
    past = ground.problem
    problem = replace(problem, relaxation=past.relaxation, past=past.past)
    return replace(ground, problem=problem, floor=problem.time.size * NEGLIGIBLE**2)


def _fitted_to(problem: Problem, found: list[Candidate]) -> list[Candidate]:
    """Return candidates as models of a problem's samples, for their residual there."""
    return [replace(c, problem=replace(problem, structure=c.structure)) for c in found]


def _in_its_own(found: list[Candidate], ground: Ground) -> list[Candidate]:
    """Return candidates in the colour of the best one's residual, the best first."""
    best = min(found, key=lambda c: c.criterion)
    return _in(_colour(best.problem, best.state), found, ground)


def _unasked(problem: Problem) -> float:
    """Return the penalty of an unknown past: like a drift, it fits any slow disturbance."""
    return _EARNED * sum(nuisances_of(problem))


def _ground(problem: Problem, sign: int) -> Ground:
    """Return the ground of all samples: none are left out for their unknown past."""
    fopdt = refine_best(problem, start_fopdt(problem, sign), tolerance=_TRIAL)
    floor = problem.time.size * NEGLIGIBLE**2
    return Ground(problem, fopdt, Starts(problem, fopdt), floor, sign)


def _converged(found: list[Candidate], ground: Ground) -> list[Candidate]:
    """Fit in the colour of the best one's residual, again until that changes no more."""
    for _ in range(_MOST_TIMES):
        if not found:
            return []
        best = found[0]
        near = [
            c
            for c in found
            if c.criterion <= best.criterion + _HOPELESS or c.structure.name in PLAIN
        ]
        found = _in(_colour(best.problem, best.state), near, ground)
        if found and found[0].structure == best.structure:
            scale = unit_steps(best.structure, best.state.theta)
            change = np.abs(found[0].state.theta - best.state.theta) / scale
            if float(change.max()) <= _ALIKE:
                break
    return found


def _joint(found: list[Candidate]) -> float:
    """Return the criterion of the best candidate together with its colour."""
    if not found:
        return math.inf
    colour, n = found[0].problem.colour, found[0].problem.time.size
    if colour is None:
        return found[0].criterion
    return found[0].criterion + colour.log_determinant + colour.order * math.log(n)


def _in(colour: Colour | None, found: list[Candidate], ground: Ground) -> list[Candidate]:
    """Return candidates fitted in one colour, the best first."""
    again, length = [], float(np.ptp(ground.problem.time))
    for c in found:
        problem = replace(c.problem, colour=colour)
        state = refine(problem, c.state.theta, tolerance=_TRIAL, most=_STEPS)
        candidate = ground.candidate(problem, state)
        # With a dead time as long as the record, an unknown past would explain everything.
        if candidate is not None and candidate.model.dead_time <= _LONGEST * length:
            again.append(_earned(candidate, length))
    return sorted(again, key=lambda c: c.criterion)


def _earned(candidate: Candidate, length: float) -> Candidate:
    """Return a candidate with the penalty of an integrator, or of a lag that looks like one.

    :param length: of the record [s].
    """
    model = candidate.model
    if model.is_stable and not _outlasts(model, length):
        return candidate
    return replace(candidate, criterion=candidate.criterion + _EARNED)


def _outlasts(model: TransferFunction, length: float) -> bool:
    """Return whether a lag is so long beside a record that it is that of an integrator."""
    return any(abs(t) > _LASTING * length for t in model.time_constants)


def _simulates(found: list[Candidate], simulated: list[Candidate]) -> bool:
    """Return whether a model simulates the record about as well as the best simulation does.

    A colour near a random walk lets the noise explain the whole response but its quick changes.

    :param found: fitted in a colour, the best first.
    :param simulated: fitted to the measurement itself.
    """
    if not found:
        return False
    left, total = left_beside(replace(found[0].problem, colour=None), found[0].state)
    square = float(left @ left)
    if square <= _EXPLAINS * float(total @ total):
        return True
    return square <= _WORSE * min(_left_by(c) for c in simulated)


def _left_by(candidate: Candidate) -> float:
    """Return the sum of squares that a simulation leaves of its problem's samples."""
    problem = candidate.problem
    columns = problem.seen(problem.columns(candidate.state.theta)[0])
    left = left_of(problem.seen(problem.y), columns)
    return float(left @ left)


def _ordered(found: list[Candidate]) -> list[Candidate]:
    """Return the candidates; first the simplest that the criterion cannot tell from the best."""
    if not found:
        return []
    found = sorted(found, key=lambda c: c.criterion)
    best = found[0].criterion
    rivals = [c for c in found if c.criterion <= best + 2.0]
    chosen = min(rivals, key=lambda c: (c.state.parameters, c.structure.order, c.criterion))
    return [chosen, *(c for c in found if c is not chosen)]
