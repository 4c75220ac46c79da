# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The fit where what is left is no white noise: generalised least squares in the noise's colour.

A criterion that takes correlated samples for independent ones prefers what bends to the noise.
Here all structures are fitted to all samples by generalised least squares (Aitken 1935), in the
colour of what the best of them leaves (Cochrane and Orcutt 1949, iterated), and compared by what
their samples are worth.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from relay_autotune.identification.known import LOSSES, Known
from relay_autotune.identification.waveform.colour import Colour, colour_of, slow_colour
from relay_autotune.identification.waveform.fit_covariance import (
    NEGLIGIBLE,
    Fit,
    Noise,
    estimate_of,
)
from relay_autotune.identification.waveform.residuals import ljung_box, worth
from relay_autotune.identification.waveform.selection import Candidate, Ground, nuisances_of
from relay_autotune.identification.waveform.separable import Problem, Trial, refine
from relay_autotune.identification.waveform.starts import (
    Starts,
    changes_within,
    refine_best,
    start_fopdt,
)
from relay_autotune.identification.waveform.theta import unit_steps

FloatArray = NDArray[np.float64]

# Less probable than this as white noise, a residual has a colour.
_WHITE = 1e-3
# Samples that are compared: of correlated ones more tell little, unless the process is fast; but
# samples much denser than its response would weigh what is faster than the process most.
_FEW, _MOST = 1200, 4000
_A_RESPONSE, _AT_LEAST = 5.0, 2.0
_MOST_TIMES = 4
# A structure whose criterion is larger by this in one colour is not tried in the next one, but
# for the plain ones, on whose models gains have to hold, too.
_HOPELESS = 30.0
PLAIN = ("fopdt", "sopdt")
# Length of the record in correlation times of the slow disturbance that is tried first.
_SLOWEST = 10.0
_ALIKE = 0.01
_TRIAL = 1e-6
_STEPS = 15
# What is looked at first: initial state, command before.
_PASTS = ((False, False), (False, True), (True, True))
_FIRST = ("fopdt", "sopdt", "sopdt_zero")
# Equal lags in some numbers only: in coloured noise neighbours differ by chance alone.
_OTHERS = (("lag_n", 3), ("lag_n", 5), ("lag_n", 8), ("three_lags", 0))
_INTEGRATING = (("ipdt", 0), ("integrator_lag", 0), ("integrator_inverse", 0))
_UNSTABLE = (("unstable_fopdt", 0), ("unstable_sopdt", 0))
# Samples of a rest that shows the past, in which the measurement moves by no more than this share.
_ENOUGH_REST = 15
_STILL = 0.05
# Latest response, as a share of the record: a later one cannot be told from a drift.
_LONGEST = 0.25
# An integrator or a growing mode bends to any drift: what it explains better has to be clear.
_EARNED = 10.0
# Lengths of the record up to which a lag is one.
_LASTING = 2.0
# Standard deviations of parameters in their own sizes beyond which samples do not tell them.
_TOLD = 1.0
# Before all structures are tried: a flexible one that leaves this much colour is enough to know.
_CLEAR = 1e-12
_LITTLE_WORTH = 0.5
# Parts of a record, and how many times more than usual one of them leaves where something came.
_BLOCKS = 10
_UNEVEN = 5.0


def is_coloured(fit: Fit) -> bool:
    """Return whether what a fit leaves is no white noise."""
    state = fit.state
    if fit.loss != LOSSES[0] or state.cost <= state.residual.size * NEGLIGIBLE**2:
        return False
    p = ljung_box(state.residual)
    return not math.isnan(p) and p < _WHITE


def is_an_event(fit: Fit) -> bool:
    """Return whether most of what a fit leaves came at one time, as a step of the load does.

    That is no noise, of whatever colour: the load is estimated, or the cycles are left out.
    """
    blocks = np.array_split(fit.state.residual, _BLOCKS)
    powers = np.array([float(np.mean(block**2)) for block in blocks])
    return float(powers.max()) > _UNEVEN * float(np.median(powers))


def is_clearly_coloured(problem: Problem, sign: int) -> bool:
    """Return whether even a flexible structure with an unknown past leaves no white noise.

    It saves the choice among structures as if noise were white, which takes longest on such data.

    :param problem: samples and input, with a FOPDT structure.
    :param sign: direction of the relay; 0: not known.
    """
    few = replace(problem.thinned(_FEW), past=problem.past_is_open)
    found = Ground.of(few, few.time.size * NEGLIGIBLE**2, sign)
    if found.problem.time.size < few.time.size:
        # What no past explains comes first.
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
    :return: None: no structure can be read, or the noise is white.
    """
    whole = replace(problem, drift=False, relaxation=False, past=False)
    names = (known.structure,) if known.structure else ()
    found = _compared(*_dense_enough(whole, sign), sign, names, known.order, held=held)
    if not found or found[0].problem.colour is None:
        return None
    chosen = next((c for c in found if _is_told(c)), found[0])
    found = [chosen, *(c for c in found if c is not chosen)]
    return Fit(chosen.problem, refine(chosen.problem, chosen.state.theta), tuple(found), scale)


def _is_told(candidate: Candidate) -> bool:
    """Return whether the samples tell each parameter.

    A gain and a lag to their own size, a zero and a dead time to that of all times together: what
    is less sure is a lag between the samples or beyond the record, or two that are one.
    """
    problem, state = candidate.problem, candidate.state
    estimate = estimate_of(problem, state, Fit(problem, state, (), 1.0), Noise(False))
    if estimate is None or estimate.root is None:
        return False
    deviation = np.sqrt(np.einsum("pk,pk->p", estimate.root, estimate.root))
    model = estimate.model
    slow = model.dead_time + sum(abs(t) for t in model.time_constants)
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
    """Return the colour of what a fit leaves, each sample as it counts."""
    columns, _ = problem.columns(state.theta)
    left = problem.y - state.coefficients @ columns
    if problem.weight is not None:
        left = left * problem.weight
    return colour_of([left[part] for part in problem.experiments])


def _compared(
    problem: Problem, few: Problem, sign: int, names: tuple[str, ...], order: int, *, held: bool
) -> list[Candidate]:
    """Return all structures in one colour, the one that counts first.

    The noise is estimated in turn with the models, from two beginnings: what the best simulation
    leaves, and a slow disturbance, which a simulation would bend to. The likelier end counts.
    """
    grounds = [
        _ground(replace(few, relaxation=relaxation, past=past), sign)
        for relaxation, past in (_PASTS[:1] if _rests(problem) else _PASTS)
        if problem.past_is_open or not past
    ]
    # Each past in the colour of what it leaves itself, and a richer one has to earn its place.
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
    return _ordered(min(ends, key=_joint))


def _of_all(ground: Ground, problem: Problem) -> Ground:
    """Return a ground of all samples, with the past of one of some of them."""
    past = ground.problem
    problem = replace(problem, relaxation=past.relaxation, past=past.past)
    return replace(ground, problem=problem, floor=problem.time.size * NEGLIGIBLE**2)


def _fitted_to(problem: Problem, found: list[Candidate]) -> list[Candidate]:
    """Return candidates as models of a problem's samples, for their residual there."""
    return [replace(c, problem=replace(problem, structure=c.structure)) for c in found]


def _in_its_own(found: list[Candidate], ground: Ground) -> list[Candidate]:
    """Return candidates in the colour of what the best of them leaves, the best first."""
    best = min(found, key=lambda c: c.criterion)
    return _in(_colour(best.problem, best.state), found, ground)


def _unasked(problem: Problem) -> float:
    """Return what an unknown past has to earn: like a drift, it bends to what is slow."""
    return _EARNED * sum(nuisances_of(problem))


def _ground(problem: Problem, sign: int) -> Ground:
    """Return where fits to all samples begin, whatever past they have."""
    fopdt = refine_best(problem, start_fopdt(problem, sign), tolerance=_TRIAL)
    floor = problem.time.size * NEGLIGIBLE**2
    return Ground(problem, fopdt, Starts(problem, fopdt), floor, sign)


def _rests(problem: Problem) -> bool:
    """Return whether each experiment begins with a rest, which shows what came before."""
    for part, u in zip(problem.experiments, problem.inputs, strict=True):
        time, y = problem.time[part], problem.y[part]
        changes = changes_within(u, time)
        before = time < (changes[0] if changes.size else time[0])
        if np.count_nonzero(before) < _ENOUGH_REST:
            return False
        moved = np.polyfit(time[before], y[before], 1)[0] * np.ptp(time[before])
        if abs(float(moved)) > _STILL * float(np.ptp(y)):
            return False
    return True


def _converged(found: list[Candidate], ground: Ground) -> list[Candidate]:
    """Return candidates in the colour of what the best of them leaves."""
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
        # A past that is not known explains all that a dead time as long as the record leaves over.
        if candidate is not None and candidate.model.dead_time <= _LONGEST * length:
            again.append(_earned(candidate, length))
    return sorted(again, key=lambda c: c.criterion)


def _earned(candidate: Candidate, length: float) -> Candidate:
    """Return a candidate with what an integrator, or a lag that looks like one, has to earn.

    :param length: of the record [s].
    """
    model = candidate.model
    if model.is_stable and all(abs(t) <= _LASTING * length for t in model.time_constants):
        return candidate
    return replace(candidate, criterion=candidate.criterion + _EARNED)


def _ordered(found: list[Candidate]) -> list[Candidate]:
    """Return the candidates, the simplest that the criterion cannot tell from the best first."""
    found = sorted(found, key=lambda c: c.criterion)
    best = found[0].criterion
    rivals = [c for c in found if c.criterion <= best + 2.0]
    chosen = min(rivals, key=lambda c: (c.state.parameters, c.structure.order, c.criterion))
    return [chosen, *(c for c in found if c is not chosen)]
