# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which fits explain the samples by what no sample can show."""

from __future__ import annotations

import math

from relay_autotune.process.transfer_function import TransferFunction

# Samples that an oscillation of the process must have in each of its periods.
_SAMPLES_A_SWING = 4.0
# Intervals between samples that a whole response takes at least, to be one.
_SHORTEST_RESPONSE = 0.5
# Lengths of the record up to which a zero counts; beyond, a slow pole cancels it, or nothing does,
# and what is left is a drift.
_LONGEST_ZERO = 2.0


def is_unseen(model: TransferFunction, interval: float, length: float) -> bool:
    """Return whether a fit owes its small residual to what happens between the samples.

    It rings faster than the samples show: noise alone asks for such a resonance, of any height,
    and it would bound every gain. Or its whole answer falls between two samples, or comes from a
    zero beyond reason: so answers a controller that is read backward, whose command follows the
    measurement in the same instant.

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
    return any(abs(zero) > _LONGEST_ZERO * length for zero in model.zeros)
