"""The method `chang`: models 1 to 5 by the exact equations (Chang, Shen and Yu 1992)."""

from __future__ import annotations

import math
from dataclasses import replace

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods.chang1992 import (
    gain_and_time_constant,
    time_constant_from_amplitude,
    time_constant_from_period,
    two_equal_and_one,
    two_time_constants,
)
from relay_autotune.identification.methods.lag_models import MODEL_4, MODEL_5, Solution, model_text
from relay_autotune.identification.methods.symmetric_method import (
    SymmetricMethod,
    from_numbers,
    from_record,
)
from relay_autotune.identification.result import Identification
from relay_autotune.identification.shown.symmetric_cycle import SymmetricCycle
from relay_autotune.process.structures import Structure
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record

_AGREEMENT = 0.05


def identify_chang(record: Record, known: Known = NOTHING) -> Identification:
    """Identify one of models 1 to 5 from an unbiased relay test, by the exact equations.

    Where the relay has a hysteresis, so have the equations; all harmonics are in the amplitude.
    What the paper's equations give literally is said in a warning.

    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known. Without the gain
        only equal lags can be had, without the dead time it is read from the record, without the
        structure the simplest model that fits is taken.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    return from_record(CHANG, record, known).identification


def chang_from_numbers(cycle: SymmetricCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from the numbers of a limit cycle, by the exact equations.

    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    return from_numbers(CHANG, cycle, known).identification


def solve(
    model: Structure, cycle: SymmetricCycle, gain: float, harmonics: int | None = None
) -> Solution:
    """Return the parameters of a model.

    With a known gain models 1 to 3 follow from the period alone (eqs 8 to 10), models 4 and 5
    from period and amplitude (eqs 11 and 24, 12 and 25). Without it models 1 to 3 take both.

    :param model: which one.
    :param cycle: the limit cycle.
    :param gain: K > 0 [y/u]; NaN: not known.
    :param harmonics: terms of eq 19 that make the amplitude; 1: eqs 21 to 25; None: all.
    :raises IdentificationError: if there is no solution, or models 4 or 5 lack the gain.
    """
    period, dead_time, h = cycle.period, cycle.dead_time, cycle.relay
    if math.isnan(gain):
        if not model.equal_lags:
            raise IdentificationError(
                f"{model_text(model)} needs the gain of the process: its two time constants take "
                "both the period and the amplitude; give the gain, or use the method li"
            )
        k, tau = gain_and_time_constant(
            model.order, period, cycle.amplitude, dead_time, h, cycle.level, harmonics
        )
        return Solution(k, (tau,))
    relative, level = cycle.amplitude / (gain * h), cycle.level / (gain * h)
    if model.equal_lags:
        return Solution(gain, (time_constant_from_period(model.order, period, dead_time, level),))
    if model == MODEL_4:
        return Solution(gain, two_time_constants(period, dead_time, relative, level, harmonics))
    first, *rest = two_equal_and_one(period, dead_time, relative, level, harmonics)
    return Solution(gain, first, tuple(rest))


def mismatch(order: int, cycle: SymmetricCycle, gain: float) -> float:
    """Return log(tau by the period/tau by the amplitude) of n equal lags, both exact.

    :param order: n >= 1.
    :param cycle: the limit cycle.
    :param gain: K > 0 [y/u].
    :return: infinite where the process has so much lag that the period has no tau.
    :raises IdentificationError: if the gain is too small for the amplitude or the hysteresis, or
        the dead time too large for the period.
    """
    h = gain * cycle.relay
    by_amplitude = time_constant_from_amplitude(order, cycle.period, cycle.amplitude / h, None)
    try:
        by_period = time_constant_from_period(
            order, cycle.period, cycle.dead_time, cycle.level / h
        )
    except IdentificationError:
        if cycle.part <= 0.0 or cycle.level >= h:
            raise
        return math.inf
    return math.log(by_period / by_amplitude)


_EQUATIONS = {1: ("eq 8", "eq 21"), 2: ("eq 9", "eq 22"), 3: ("eq 10", "eq 23")}


def _remarks(model: Structure, cycle: SymmetricCycle, gain: float) -> list[str]:
    """Say what the paper's equations, with their errata, give literally, where that differs."""
    unknown = math.isnan(gain)
    left_out = []
    if cycle.hysteresis > 0.0:
        left_out.append(f"the hysteresis of {cycle.hysteresis:.4g}")
    if unknown or not model.equal_lags:
        left_out.append("the higher harmonics")
    if not left_out:
        return []
    if model == MODEL_4:
        equations = "eqs 11 and 24"
    elif model == MODEL_5:
        equations = "eqs 12 and 25"
    else:
        by_period, by_amplitude = _EQUATIONS.get(
            model.order, (f"F_{model.order} = 0", "its amplitude equation")
        )
        equations = f"{by_period} and {by_amplitude}" if unknown else by_period
    begin = f"without {' and '.join(left_out)}, as in the paper, {equations} would "
    try:
        literal = solve(model, replace(cycle, switch_level=0.0), gain, 1)
    except IdentificationError:
        return [f"{begin}have no solution"]
    point = ultimate_point(model.build(literal.values(1, cycle.dead_time)))
    text = f"K = {literal.gain:.4g}, {literal}" if unknown else str(literal)
    ultimate = f", K_u = {point.gain:.4g}" if point else ""
    return [f"{begin}give {text}{ultimate}"]


CHANG = SymmetricMethod("chang", solve, mismatch, _AGREEMENT, _remarks)
