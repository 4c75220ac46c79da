# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `chang`: models 1 to 5 by the exact equations (Chang, Shen and Yu 1992).

Chang, Shen and Yu, "Derivation of Transfer Function from Relay Feedback Systems", Ind. Eng. Chem.
Res. 1992: eqs 8 to 12 for the period, 21 to 25 for the amplitude, see
:mod:`~relay_autotune.identification.methods.lags`. The gain and the dead time D are given.

The paper's equations are those of an ideal relay, and its amplitude equations the describing
function's. Here the hysteresis of the relay and all harmonics of eq 19 are in them; a warning
tells what the paper's give literally.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.methods.lags import (
    MODEL_4,
    MODEL_5,
    constants_text,
    solutions,
)
from relay_autotune.identification.methods.square_wave import EXACT, MIXED
from relay_autotune.identification.methods.symmetric_method import (
    SymmetricMethod,
    from_numbers,
    from_record,
)
from relay_autotune.identification.result import Identification
from relay_autotune.process.structures import Structure
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record

_EQUATIONS = {1: ("eq 8", "eq 21"), 2: ("eq 9", "eq 22"), 3: ("eq 10", "eq 23")}


def _literal(model: Structure, cycle: SymmetricCycle, gain: float) -> list[str]:
    """Return what the paper's equations, with their errata, give literally, if it differs."""
    unknown = math.isnan(gain)
    left_out = [f"the hysteresis of {cycle.hysteresis:.4g}"] if cycle.hysteresis > 0.0 else []
    left_out += ["the higher harmonics"] if unknown or not model.equal_lags else []
    if not left_out:
        return []
    equations = {MODEL_4: "eqs 11 and 24", MODEL_5: "eqs 12 and 25"}.get(model, "")
    if not equations:
        other = f"F_{model.order} = 0", "its amplitude equation"
        equations = " and ".join(_EQUATIONS.get(model.order, other)[: 1 + unknown])
    begin = f"without {' and '.join(left_out)}, as in the paper, {equations} would "
    try:
        k, *constants = solutions(model, replace(cycle, switch_level=0.0), gain, MIXED)[0]
    except IdentificationError:
        return [f"{begin}have no solution"]
    point = ultimate_point(model.build(np.array((k, *constants, cycle.dead_time))))
    text = f"K = {k:.4g}, " if unknown else ""
    ultimate = f", K_u = {point.gain:.4g}" if point else ""
    return [f"{begin}give {text}{constants_text(constants)}{ultimate}"]


CHANG = SymmetricMethod("chang", EXACT, 0.05, _literal)


def identify_chang(record: Record, known: Known = NOTHING) -> Identification:
    """Identify one of models 1 to 5 from an unbiased relay test, by the exact equations.

    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known. Without the gain
        only equal lags can be found; a dead time that is not known is read from the record;
        without the structure the simplest model that fits is taken.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    return from_record(CHANG, record, known)


def chang_from_numbers(cycle: SymmetricCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from the numbers of a limit cycle, by the exact equations.

    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    return from_numbers(CHANG, cycle, known)
