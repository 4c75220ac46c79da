# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The limit cycle that a relay would make of a model, and what the describing function reads."""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.optimize import brentq

from relay_autotune.errors import ModelError
from relay_autotune.identification.shown.shape import shape_of_half_cycle
from relay_autotune.process.half_cycle import HalfCycle
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint, ultimate_point

_REACH = np.geomspace(1.0, 4.0, 60)
_AT_SWITCH = np.zeros(1)


def half_cycle(model: TransferFunction) -> HalfCycle | None:
    """Return half a period of the limit cycle under an ideal relay of amplitude 1.

    The half period is the one nearest to ``pi/w_u`` at which the output passes zero upward at the
    switch.

    :param model: the process.
    :return: None if it has no ultimate point or no such oscillation.
    """
    point = ultimate_point(model)
    if point is None:
        return None
    middle = math.pi / point.frequency
    for low, high in itertools.pairwise(_REACH):
        for a, b in ((middle * low, middle * high), (middle / high, middle / low)):
            found = _between(model, a, b)
            if found is not None:
                return found
    return None


def _between(model: TransferFunction, low: float, high: float) -> HalfCycle | None:
    low = max(low, model.dead_time * (1.0 + 1e-9))
    if not low < high:
        return None

    def level(half_period: float) -> float:
        return float(HalfCycle(model, half_period)(_AT_SWITCH)[0])

    try:
        if level(low) * level(high) > 0.0:
            return None
        cycle = HalfCycle(model, float(brentq(level, low, high, rtol=1e-14, xtol=1e-300)))
    except (ModelError, np.linalg.LinAlgError):
        return None
    return cycle if cycle.slope(_AT_SWITCH)[0] > 0.0 else None


def describing_point_of(model: TransferFunction) -> UltimatePoint | None:
    """Return K_u and w_u that an ideal relay test of a model would give.

    ``K_u = 4 h/(pi a)``, ``w_u = 2 pi/P`` (Chang, Shen and Yu 1992, eqs 1 and 2), with the exact
    amplitude and period of the limit cycle.

    :param model: the process.
    :return: None if it has no limit cycle.
    """
    cycle = half_cycle(model)
    if cycle is None:
        return None
    a = shape_of_half_cycle(cycle).amplitude
    return UltimatePoint(model.process_sign * 4.0 / (math.pi * a), math.pi / cycle.half_period)


def describing_point_of_cycle(
    period: float, period_high: float, amplitude: float, relay: float, sign: float
) -> UltimatePoint:
    """Return K_u and w_u that the describing function reads from a limit cycle that was recorded.

    ``K_u = 4 h/(pi a) sin(pi T_high/P)``: the first harmonic of the relay's wave over the
    amplitude; the sine is 1 for an unbiased relay.

    :param period: P [s].
    :param period_high: time with the command high [s].
    :param amplitude: half of peak to peak of the measurement, a [y].
    :param relay: h [u].
    :param sign: of the process.
    """
    gain = 4.0 * relay / (math.pi * amplitude) * math.sin(math.pi * period_high / period)
    return UltimatePoint(math.copysign(gain, sign), 2.0 * math.pi / period)
