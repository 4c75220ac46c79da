# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The original ATV: lags from the describing function's ultimate point (Luyben 1987).

As Chang, Shen and Yu 1992 have it: period and amplitude give an estimate of the ultimate
frequency, w = 2 pi/P (eq 1), and of the ultimate gain, K_u = 4 h/(pi a) (eq 2). With the gain K
and the dead time D known, the phase there gives one equation for the time constants (eqs 7, 13),
and the magnitude another, prod(1 + (w tau_i)^2)^(1/2) = K K_u (eqs 6, 21 to 25). They are those of
:mod:`~relay_autotune.identification.methods.lags` with the first harmonic alone. For equal lags
tau is the mean of the two.

A relay with hysteresis epsilon does not switch at phase -pi: its describing function has
pi - asin(epsilon/a) for pi above. That is the default here; the paper's is epsilon = 0.
"""

from __future__ import annotations

import math
from dataclasses import replace

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.dead_time import DeadTime
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.methods.lags import constants_text
from relay_autotune.identification.methods.square_wave import FIRST
from relay_autotune.identification.methods.symmetric_method import (
    LimitCycle,
    SymmetricMethod,
    from_cycle,
    read_limit_cycle,
)
from relay_autotune.identification.result import Identification
from relay_autotune.process.structures import Structure
from relay_autotune.record.record import Record


def ultimate_estimate(cycle: SymmetricCycle) -> tuple[float, float]:
    """Return (K_u, w_u) by the describing function (eqs 2 and 1)."""
    return 4.0 * cycle.relay / (math.pi * cycle.amplitude), cycle.frequency


def _literal(model: Structure, cycle: SymmetricCycle, gain: float) -> list[str]:
    """Return what eqs 1 and 2 give literally, where a hysteresis makes them wrong."""
    if cycle.hysteresis == 0.0:
        return []
    k_u, w_u = ultimate_estimate(cycle)
    begin = (
        f"eqs 1 and 2 give K_u = {k_u:.4g} and w_u = {w_u:.4g} rad/s, but the hysteresis of "
        f"{cycle.hysteresis:.4g} keeps the limit cycle off the ultimate point; K_u and w_u are "
        "those of the model"
    )
    try:
        _, *constants = ATV.solve(model, replace(cycle, hysteresis=0.0), gain)[0]
    except IdentificationError:
        return [f"{begin}, whose equations have no solution without the hysteresis"]
    return [f"{begin}, which without the hysteresis would have {constants_text(constants)}"]


# The describing function alone explains a difference of 0.1.
ATV = SymmetricMethod("atv", FIRST, 0.1, _literal)


def identify_atv(record: Record, known: Known = NOTHING) -> Identification:
    """Identify one of models 1 to 5 from an unbiased relay test, by the original ATV.

    The ultimate point is that of eqs 1 and 2; with a hysteresis, which shifts it, that of the
    model.

    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known; see `identify_chang`.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    return _identified(read_limit_cycle(ATV, record, known), known)


def atv_from_numbers(cycle: SymmetricCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from the numbers of a limit cycle, by the original ATV.

    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    sign = -1 if known.gain < 0.0 else 1
    return _identified(LimitCycle(cycle, DeadTime(cycle.dead_time), sign), known)


def _identified(seen: LimitCycle, known: Known) -> Identification:
    found = from_cycle(ATV, seen, known)
    if seen.cycle.hysteresis > 0.0:
        return found
    k_u, w_u = ultimate_estimate(seen.cycle)
    return replace(
        found,
        ultimate_gain=seen.sign * k_u,
        ultimate_gain_std=seen.std(lambda cycle: ultimate_estimate(cycle)[0]),
        ultimate_frequency=w_u,
        ultimate_frequency_std=seen.std(lambda cycle: ultimate_estimate(cycle)[1]),
    )
