# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Whether a model of the other direction explains a record as well as the chosen one.

The criterion of the choice is a sum over all samples in the colour of the noise. Two kinds of
records mislead it: those that are nearly periodic, and those of what a controller keeps from
running away. What is left in simulation is compared here, such that no single stretch decides.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.candidates import Candidate, FitContext
from relay_autotune.identification.waveform.fit_covariance import Fit
from relay_autotune.identification.waveform.problem import NEGLIGIBLE, Problem, with_terms_of
from relay_autotune.identification.waveform.separable import Trial, errors_in_simulation
from relay_autotune.process.structures import FOPDT, UNSTABLE_FOPDT, UNSTABLE_SOPDT
from relay_autotune.process.transfer_function import TransferFunction

# Stretches of a record: enough for ranks, and each longer than its errors are correlated.
_STRETCHES = 20


def opposed(context: FitContext, fit: Fit) -> float:
    """Return how well models of the other direction explain a record, beside a fit.

    :param context: the samples.
    :param fit: has the terms beside the model.
    :return: 0 to 1, the larger of two; from 0.5 on the direction is open.
    """
    model = fit.problem.structure.model_at(fit.state.theta, fit.state.coefficients)
    assert model is not None
    beside = replace(with_terms_of(fit.problem, context.problem), structure=FOPDT, colour=None)
    inside = replace(context, problem=beside)
    # Until an inverse response turns, it is an answer of the other direction.
    turns = model.dead_time - sum(z.real for z in model.zeros if z.real < 0.0)
    found = _answered_earlier(inside, fit, turns, -model.process_sign) if turns > 0.0 else 0.0
    return max(found, _outgrown(inside, fit, model)) if context.bounded else found


def _answered_earlier(context: FitContext, fit: Fit, turns: float, sign: int) -> float:
    """Return how well a plain model that answers before a fit does explains as much.

    To a command that is nearly periodic, a process and its reverse half a period later answer
    alike. A short stretch, in which something else moved the measurement, may decide for the
    later one, though so long a dead time is rare: so the medians of the errors are compared.

    :param context: the samples, and the terms beside the model.
    :param fit: of some of them.
    :param turns: when the fit answers in its direction, after dead time and inverse response [s].
    :param sign: the other direction, 1 or -1.
    :return: the smaller of two ratios, of the fit's error over the other's and of what the other
        explains over what the fit does; 0 where there is none.
    """
    context = replace(context, problem=replace(context.problem, latest=turns))
    own, total = _typical_squares(fit)
    least = min(
        (
            _typical_squares(c)[0]
            for c in context.best_of_direction(sign)
            if c.model.response_time < turns
        ),
        default=math.inf,
    )
    floor = NEGLIGIBLE**2
    explained = max(total - least, 0.0) / max(total - own, floor)
    return min(math.sqrt(own / max(least, floor)), explained, 1.0)


def _outgrown(context: FitContext, fit: Fit, model: TransferFunction) -> float:
    """Return how clearly a growing model explains more of a closed loop's record than a fit.

    A controller that holds what would run away makes noise in whose colour a stable model can be
    the likelier one. The errors in simulation tell: their squares in stretches of the record are
    compared by Wilcoxon's signed ranks (1945), so that no single stretch decides.

    :param context: the samples, and the terms beside the model.
    :param fit: of some of them.
    :param model: of the fit.
    :return: the ranks of the stretches of which the growing one explains more, less those of the
        others, over all (the rank-biserial correlation, Kerby 2014); 0 where it explains less, or
        there is none of the other direction.
    """
    own = replace(context.problem, structure=fit.problem.structure)
    left = _squares_in_stretches(own, fit.state)
    found = [0.0]
    for other in context.fit((UNSTABLE_FOPDT.name, UNSTABLE_SOPDT.name)):
        if other.model.process_sign != model.process_sign:
            gain = left - _squares_in_stretches(other.problem, other.state)
            ranks = np.argsort(np.argsort(np.abs(gain))) + 1.0
            found.append(float(np.sign(gain) @ ranks / ranks.sum()))
    return max(found)


def _squares_in_stretches(problem: Problem, state: Trial) -> FloatArray:
    """Return the mean squares that a model leaves in stretches of equal length.

    :param problem: the samples.
    :param state: a fit of these, or of some of them.
    """
    left, _ = errors_in_simulation(problem, state.coefficients, state.theta)
    stretches = np.array_split(left, min(_STRETCHES, left.size))
    return np.array([np.mean(part**2) for part in stretches])


def _typical_squares(found: Candidate | Fit) -> tuple[float, float]:
    """Return the median squares of what a model leaves in simulation, and is to explain.

    :param found: with what was fitted.
    """
    parts = errors_in_simulation(found.problem, found.state.coefficients, found.state.theta)
    left, total = (float(np.median(np.square(part))) for part in parts)
    return left, total
