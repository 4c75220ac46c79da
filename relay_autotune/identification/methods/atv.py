# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The original ATV: lags from the describing function's ultimate point (Luyben 1987).

As Chang, Shen and Yu 1992 have it (eqs 1, 2, 6, 7, 13): period and amplitude give an estimate of
the ultimate frequency, w = 2 pi/P, and of the ultimate gain, K_u = 4 h/(pi a). With the gain K and
the dead time D known, the phase there gives one equation for the time constants,

    w D + sum of atan(w tau_i) = pi,

and the magnitude another, prod(1 + (w tau_i)^2)^(1/2) = K K_u (eqs 21 to 25, of which eq 23 has
the exponent 3/2; printed: 2/3). For equal lags tau is the mean of the two.

A relay with hysteresis epsilon does not switch at phase -pi: its describing function has
pi - asin(epsilon/a) for pi above. That is the default here; the paper's is epsilon = 0.
"""

from __future__ import annotations

import math
from dataclasses import replace

from scipy.optimize import brentq

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods.lags import MODEL_4, Solution, require_equal_lags
from relay_autotune.identification.methods.symmetric_method import (
    Found,
    SymmetricMethod,
    from_numbers,
    from_record,
)
from relay_autotune.identification.result import Identification
from relay_autotune.identification.shown.limit_cycle import SymmetricCycle, require_switching
from relay_autotune.process.structures import Structure
from relay_autotune.record.record import Record

_LEAST_PHASE = 1e-6


def ultimate_estimate(period: float, amplitude: float, relay: float) -> tuple[float, float]:
    """Return (K_u, w_u) by the describing function (eqs 2 and 1).

    :param period: P [s].
    :param amplitude: a [y].
    :param relay: h [u].
    """
    return 4.0 * relay / (math.pi * amplitude), 2.0 * math.pi / period


def phase_of_lags(
    period: float, dead_time: float, amplitude: float = 1.0, hysteresis: float = 0.0
) -> float:
    """Return the phase lag that remains for the lags [rad].

    :param period: P [s].
    :param dead_time: D [s].
    :param amplitude: a [y].
    :param hysteresis: epsilon [y].
    :raises IdentificationError: if the hysteresis is not below the amplitude, or the dead time
        alone has more phase.
    """
    require_switching(amplitude, hysteresis)
    phase = math.pi - math.asin(hysteresis / amplitude) - 2.0 * math.pi * dead_time / period
    if not phase > _LEAST_PHASE:
        raise IdentificationError(
            f"a dead time of {dead_time:g} s alone has more phase than the period of {period:g} s "
            "allows: the dead time is misread"
        )
    return phase


def time_constant_from_phase(order: int, period: float, phase: float) -> float:
    """Return tau of n equal lags from the phase: eq 13 for n = 1, and the same for other n.

    :param order: n >= 1.
    :param period: P [s].
    :param phase: of the lags, from :func:`phase_of_lags` [rad].
    :raises IdentificationError: if this number of lags cannot have that phase.
    """
    each = phase / order
    if not each < 0.5 * math.pi:
        raise IdentificationError(
            f"{order} {'lag' if order == 1 else 'lags'} cannot make up a phase of "
            f"{math.degrees(phase):.4g} degrees: the process has more lags, or the dead time is "
            "misread"
        )
    return math.tan(each) * period / (2.0 * math.pi)


def time_constant_from_magnitude(order: int, period: float, attenuation: float) -> float:
    """Return tau of n equal lags from the magnitude: eqs 21 to 23, and the same for other n.

    :param order: n >= 1.
    :param period: P [s].
    :param attenuation: K K_u.
    :raises IdentificationError: if that is not above 1.
    """
    _require_attenuation(attenuation)
    return math.sqrt(attenuation ** (2.0 / order) - 1.0) * period / (2.0 * math.pi)


def two_time_constants(period: float, phase: float, attenuation: float) -> tuple[float, float]:
    """Return the time constants of model 4, the larger first (eqs 6 and 7).

    With angles alpha and beta of the two lags, eq 7 is their sum and eq 6 the product of their
    cosines, so that cos(alpha - beta) = 2/(K K_u) - cos(alpha + beta).

    :param period: P [s].
    :param phase: of the lags, from :func:`phase_of_lags` [rad].
    :param attenuation: K K_u.
    :raises IdentificationError: if there is no solution.
    """
    _require_attenuation(attenuation)
    cosine = 2.0 / attenuation - math.cos(phase)
    difference = math.acos(cosine) if abs(cosine) <= 1.0 else math.nan
    larger, smaller = 0.5 * (phase + difference), 0.5 * (phase - difference)
    if not (smaller > 0.0 and larger < 0.5 * math.pi):
        raise _no_solution("two lags", phase, attenuation)
    scale = period / (2.0 * math.pi)
    return math.tan(larger) * scale, math.tan(smaller) * scale


def two_equal_and_one(
    period: float, phase: float, attenuation: float
) -> tuple[tuple[float, float], ...]:
    """Return the time constants (repeated, single) of model 5 (eq 25 and the phase).

    :param period: P [s].
    :param phase: of the lags, from :func:`phase_of_lags` [rad].
    :param attenuation: K K_u.
    :return: one or two solutions, the one with the larger single constant first.
    :raises IdentificationError: if there is none.
    """
    _require_attenuation(attenuation)

    def excess(angle: float) -> float:
        return math.cos(angle) ** 2 * math.cos(phase - 2.0 * angle) - 1.0 / attenuation

    # Both angles lie between 0 and a quarter turn; the product is largest for equal ones.
    low, middle, high = (
        max(0.5 * phase - 0.25 * math.pi, 0.0),
        phase / 3.0,
        min(0.5 * phase, 0.5 * math.pi),
    )
    found = []
    for ends in ((low, middle), (middle, high)):
        if low < high and excess(ends[0]) * excess(ends[1]) < 0.0:
            angle = float(brentq(excess, *ends, xtol=1e-300, rtol=1e-15))
            constants = (math.tan(angle), math.tan(phase - 2.0 * angle))
            repeated, single = (c * period / (2.0 * math.pi) for c in constants)
            found.append((repeated, single))
    if not found:
        raise _no_solution("two equal lags and one", phase, attenuation)
    return tuple(found)


def _require_attenuation(attenuation: float) -> None:
    if not attenuation > 1.0:
        raise IdentificationError(
            f"K K_u = {attenuation:g} is not above 1, as lags have it: the gain given is too "
            "small, or the relay's amplitude is wrong"
        )


def _no_solution(lags: str, phase: float, attenuation: float) -> IdentificationError:
    return IdentificationError(
        f"{lags} cannot have a phase of {math.degrees(phase):.4g} degrees where they attenuate "
        f"by {attenuation:.4g}: the process is of another structure, or gain or dead time are "
        "wrong"
    )


def identify_atv(record: Record, known: Known = NOTHING) -> Identification:
    """Identify one of models 1 to 5 from an unbiased relay test, by the original ATV.

    The ultimate point is that of eqs 1 and 2; with a hysteresis, which shifts it, that of the
    model.

    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known. Without the gain
        only equal lags can be found; a dead time that is not known is read from the record;
        without the structure the simplest model that fits is taken.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    return _with_estimate(from_record(ATV, record, known))


def atv_from_numbers(cycle: SymmetricCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from the numbers of a limit cycle, by the original ATV.

    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    return _with_estimate(from_numbers(ATV, cycle, known))


def solve(model: Structure, cycle: SymmetricCycle, gain: float) -> Solution:
    """Return the parameters of a model.

    :param model: which one.
    :param cycle: the limit cycle.
    :param gain: K > 0 [y/u]; NaN: not known, then the phase gives tau and the magnitude K.
    :raises IdentificationError: if there is no solution, or models 4 or 5 lack the gain.
    """
    period, order = cycle.period, model.order
    k_u, w_u = ultimate_estimate(period, cycle.amplitude, cycle.relay)
    phase = phase_of_lags(period, cycle.dead_time, cycle.amplitude, cycle.hysteresis)
    if math.isnan(gain):
        require_equal_lags(model)
        tau = time_constant_from_phase(order, period, phase)
        return Solution(math.hypot(1.0, w_u * tau) ** order / k_u, (tau,))
    if model.equal_lags:
        tau = 0.5 * (
            time_constant_from_phase(order, period, phase)
            + time_constant_from_magnitude(order, period, gain * k_u)
        )
        return Solution(gain, (tau,))
    if model == MODEL_4:
        return Solution(gain, two_time_constants(period, phase, gain * k_u))
    first, *rest = two_equal_and_one(period, phase, gain * k_u)
    return Solution(gain, first, tuple(rest))


def _mismatch(order: int, cycle: SymmetricCycle, gain: float) -> float:
    k_u, _ = ultimate_estimate(cycle.period, cycle.amplitude, cycle.relay)
    by_magnitude = time_constant_from_magnitude(order, cycle.period, gain * k_u)
    phase = phase_of_lags(cycle.period, cycle.dead_time, cycle.amplitude, cycle.hysteresis)
    if phase >= 0.5 * math.pi * order:
        return math.inf
    return math.log(time_constant_from_phase(order, cycle.period, phase) / by_magnitude)


def _remarks(model: Structure, cycle: SymmetricCycle, gain: float) -> list[str]:
    """Return what eqs 1 and 2 give literally, where a hysteresis makes them wrong."""
    if cycle.hysteresis == 0.0:
        return []
    k_u, w_u = ultimate_estimate(cycle.period, cycle.amplitude, cycle.relay)
    begin = (
        f"eqs 1 and 2 give K_u = {k_u:.4g} and w_u = {w_u:.4g} rad/s, but the hysteresis of "
        f"{cycle.hysteresis:.4g} keeps the limit cycle off the ultimate point; K_u and w_u are "
        "those of the model"
    )
    try:
        literal = solve(model, replace(cycle, hysteresis=0.0), gain)
    except IdentificationError:
        return [f"{begin}, whose equations have no solution without the hysteresis"]
    return [f"{begin}, which without the hysteresis would have {literal}"]


def _with_estimate(found: Found) -> Identification:
    identification, cycle = found.identification, found.cycle
    if cycle.hysteresis > 0.0:
        return identification
    k_u, w_u = ultimate_estimate(cycle.period, cycle.amplitude, cycle.relay)
    return replace(
        identification,
        ultimate_gain=identification.model.process_sign * k_u,
        ultimate_gain_std=found.amplitude_std / cycle.amplitude * k_u,
        ultimate_frequency=w_u,
        ultimate_frequency_std=found.period_std / cycle.period * w_u,
    )


# Difference of the two time constants that the describing function alone explains.
_AGREEMENT = 0.1

ATV = SymmetricMethod("atv", solve, _mismatch, _AGREEMENT, _remarks)
