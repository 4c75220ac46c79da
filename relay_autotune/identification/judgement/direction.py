# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Whether a record fits a process of the opposite direction to its relay's.

A process with an inverse response (a zero in the right half plane) first answers the other way.
A relay of the wrong direction then oscillates on that first answer, and models of the relay's
direction explain the cycles well enough, with a drift or a load for what they lack. The gains of
such a model have the wrong sign, and the loop would run away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.fit_covariance import NEGLIGIBLE
from relay_autotune.identification.waveform.residuals import worth
from relay_autotune.identification.waveform.separable import (
    Problem,
    Trial,
    information_criterion,
    problem_of,
)
from relay_autotune.identification.waveform.starts import (
    Starts,
    refine_best,
    start_fopdt,
    two_lags,
)
from relay_autotune.process.response import response
from relay_autotune.process.structures import FOPDT, INTEGRATOR_INVERSE, SOPDT_ZERO
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Input, PiecewiseConstant, Record

_MOST_SAMPLES = 4096
# Least correlation of neighbours that counts, in standard errors.
_CORRELATED = 2.0
# Least share of the measurement's range that counts as estimated beside the model.
_BESIDE = 1e-6
# Slow lags at the start, relative to the fast one.
_SLOWER = (2.0, 6.0, 20.0)
# Latest turn of an inverse response, in lengths of the test: a later one is a drift.
_HORIZON = 2.0
_TRIAL = 1e-6


@dataclass(frozen=True)
class OtherDirection:
    """A model of the opposite direction to the relay's.

    :param model: the best one.
    :param lead: criterion of the relay's own direction minus this one's; a difference of 6 is
        odds of e^3.
    """

    model: TransferFunction
    lead: float


def other_direction(
    found: Identification, record: Record, *, beside: int = 0
) -> OtherDirection | None:
    """Return the best model of the other direction; None: the record does not ask for one.

    A process at rest before the relay needs neither drift nor load nor initial state in its own
    direction. So the other one is fitted without them, and only where the model of the relay's
    direction needs them or leaves something unexplained. The two are compared by the Bayesian
    information criterion.

    :param found: what was identified from all samples, in the direction of the relay.
    :param record: the relay test.
    :param beside: number of parameters that were estimated beside the model, as those of a load.
    """
    drive = record.drive()
    residual = (record.measurement - found.fitted)[np.isfinite(found.fitted)]
    moved, left_out = _moved_beside(found, record, drive), residual.size < len(record)
    if not (moved or left_out or beside or worth(residual, _CORRELATED) < 1.0):
        return None
    sign, scale = found.model.process_sign, float(np.ptp(record.measurement))
    y = (record.measurement - record.measurement[0]) / scale
    whole = problem_of([(record.time, y, drive)], FOPDT)
    problem = whole.thinned(_MOST_SAMPLES)
    horizon = _HORIZON * float(record.time[-1] - drive.times[0])
    inverse = [
        f
        for f in _inverse(problem, sign)
        if f[0].process_sign == -sign and any(-horizon < z.real < 0.0 for z in f[0].zeros)
    ]
    if not inverse:
        return None
    n = problem.time.size
    floor = n * NEGLIGIBLE**2
    model, state = min(
        inverse, key=lambda f: information_criterion(f[1].cost, n, f[1].parameters, floor)
    )
    # The worth of a sample in both criteria comes from the other direction's residual.
    each = worth(state.residual)
    parameters = len(found.parameters) + 1 + beside + moved + left_out
    left = n * float(np.mean(residual**2)) / scale**2
    told = information_criterion(left, n, parameters, floor, each)
    other = information_criterion(state.cost, n, state.parameters, floor, each)
    return OtherDirection(model, told - other)


def _moved_beside(found: Identification, record: Record, drive: Input) -> bool:
    """Return whether more than an offset was estimated beside the model."""
    stable = all(t.real > 0.0 for t in found.model.time_constants)
    if not (stable and isinstance(drive, PiecewiseConstant)):
        return True
    rest: FloatArray = found.fitted - response(found.model, record.time, drive)
    return not float(np.ptp(rest)) <= _BESIDE * float(np.ptp(record.measurement))


def _inverse(problem: Problem, sign: int) -> list[tuple[TransferFunction, Trial]]:
    """Fit structures with an inverse response; with others no oscillation lasts.

    In the direction of the relay, a FOPDT shows the fast part of an inverse response.
    """
    first = refine_best(problem, start_fopdt(problem, sign), tolerance=_TRIAL)
    starts = Starts(problem, first)
    fast, dead_time = starts.tau, starts.dead_time
    tried = (
        (SOPDT_ZERO, [two_lags(n * fast, fast, dead_time) for n in _SLOWER]),
        (INTEGRATOR_INVERSE, [np.array((math.log(fast), dead_time))]),
    )
    found = []
    for structure, thetas in tried:
        plain = replace(problem, structure=structure)
        state = refine_best(plain, thetas, tolerance=_TRIAL)
        model = structure.model_at(state.theta, state.coefficients)
        if model is not None:
            found.append((model, state))
    return found
