# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Fits that explain the samples by something that no sample can show."""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant

# Least number of samples in each period of an oscillation of the process.
_SAMPLES_A_SWING = 4.0
# Shortest response of a process, in intervals between samples.
_SHORTEST_RESPONSE = 0.5
# Longest zero in lengths of the record: beyond, a slow pole cancels it, or it is a drift.
_LONGEST_ZERO = 2.0


def is_unseen(model: TransferFunction, interval: float, length: float) -> bool:
    """Return whether a fit owes its small residual to what happens between the samples.

    It rings faster than the samples show: noise alone leads to such a resonance, of any height,
    and it would limit every gain. Or its whole response falls between two samples, or comes from
    an unreasonable zero: so a controller responds, where command and measurement were swapped. Or
    its response turns into the direction of its gain only after the record's end: what the record
    shows is the other direction, and the rest is a drift.

    :param model: the fit.
    :param interval: between samples [s].
    :param length: of the record [s].
    """
    swing = _SAMPLES_A_SWING * interval / (2.0 * math.pi)
    if any(c.imag != 0.0 and abs(c) < swing for c in model.time_constants):
        return True
    whole = model.dead_time + sum(abs(c) for c in model.time_constants)
    if not model.integrators and whole < _SHORTEST_RESPONSE * interval:
        return True
    if any(abs(zero) > _LONGEST_ZERO * length for zero in model.zeros):
        return True
    if not (model.is_stable or model.integrators) or all(zero.real >= 0.0 for zero in model.zeros):
        return False
    step = PiecewiseConstant(np.zeros(1), np.ones(1), 0.0)
    return float(response(model, np.array([length]), step)[0]) * model.process_sign <= 0.0
