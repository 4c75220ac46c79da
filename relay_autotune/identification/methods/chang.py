# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `chang`: models 1 to 5 by the exact equations (Chang, Shen and Yu 1992).

Models of lags from the period and the amplitude of a relay test, exact in time.

Chang, Shen and Yu, "Derivation of Transfer Function from Relay Feedback Systems", Ind. Eng. Chem.
Res. 1992: models 1 to 3 (n equal lags, eqs 8 to 10), 4 (two lags, eq 11), 5 (two equal lags and
one, eq 12), with the amplitude equations 21 to 25, of which eq 23 has the exponent 3/2 (printed:
2/3). The gain and the dead time D are given.

The period equations say that y = 0 where an ideal relay switches. With a hysteresis epsilon it is
y = epsilon there, so that their exact generalisation has epsilon/(K h) for zero on the right-hand
side; it is the default here, and a level of zero gives the paper's equations. The amplitude
equations are the describing function's; with all the harmonics of eq 19 they are exact too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from scipy.optimize import brentq

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods.lags import (
    MODEL_4,
    MODEL_5,
    Solution,
    level,
    peak,
    require_equal_lags,
    slope_sign,
)
from relay_autotune.identification.methods.symmetric_method import (
    SymmetricMethod,
    from_numbers,
    from_record,
)
from relay_autotune.identification.result import Identification
from relay_autotune.identification.shown.limit_cycle import SymmetricCycle, require_switching
from relay_autotune.process.structures import Structure
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record

_STEP = 1.1
_LONGEST = 1e10
_NEARLY_ONE = 1.0 - 1e-12
_WITH_LAG = 1.0 - 1e-6


def time_constant_from_period(
    order: int, period: float, dead_time: float, switch_level: float = 0.0
) -> float:
    """Return tau of n equal lags from the period: eqs 8 (n = 1), 9 (2) and 10 (3), and any n.

    The equation is F_n = epsilon/(K h), see
    :mod:`~relay_autotune.identification.methods.lags`. The smallest of several roots is
    the limit cycle that a relay starts, if y rises there. Eq 8 also has the trivial root
    tau = infinity, which is excluded.

    :param order: n >= 1.
    :param period: P [s].
    :param dead_time: D [s].
    :param switch_level: epsilon/(K h), 0 for an ideal relay.
    :raises IdentificationError: if no such process has this period; for n = 1 and an ideal relay
        P/4 < D < P/2 is needed.
    """
    _require_dead_time(period, dead_time)
    _require_level(switch_level)
    if order == 1 and switch_level == 0.0:
        _require_fopdt(period, dead_time, 0.25)
    part = 1.0 - 2.0 * dead_time / period
    return _smallest(
        order, period, part, lambda tau: level((tau,) * order, period, part) - switch_level
    )


def time_constant_from_amplitude(
    order: int, period: float, relative_amplitude: float, harmonics: int | None = 1
) -> float:
    """Return tau of n equal lags from the amplitude: eqs 21 (n = 1), 22 (2), 23 (3), and any n.

    :param order: n >= 1.
    :param period: P [s].
    :param relative_amplitude: a/(K h).
    :param harmonics: terms of eq 19 that make the amplitude; 1: as the paper has it; None: all.
    :raises IdentificationError: if the amplitude is too large for a process of this gain.
    """
    return _with_amplitude((1.0 / order,) * order, period, relative_amplitude, harmonics)[0]


def two_time_constants(
    period: float,
    dead_time: float,
    relative_amplitude: float,
    switch_level: float = 0.0,
    harmonics: int | None = 1,
) -> tuple[float, float]:
    """Return the two time constants of model 4, the larger first (eqs 11 and 24).

    :param period: P [s].
    :param dead_time: D [s].
    :param relative_amplitude: a/(K h).
    :param switch_level: epsilon/(K h), 0 for an ideal relay.
    :param harmonics: terms of eq 19 that make the amplitude; 1: as the paper has it; None: all.
    :raises IdentificationError: if the process has less lag than one lag or more than two equal
        ones, so that there is no solution.
    """
    _require_dead_time(period, dead_time)
    _require_level(switch_level)
    part = 1.0 - 2.0 * dead_time / period

    def lags(share: float) -> tuple[float, ...]:
        return _with_amplitude((1.0 - share, share), period, relative_amplitude, harmonics)

    def excess(share: float) -> float:
        return level(lags(share), period, part) - switch_level

    least = _with_amplitude((1.0,), period, relative_amplitude, harmonics)
    if level(least, period, part) - switch_level <= 0.0:
        raise IdentificationError(_outside("model 4", "less lag than one lag has", "model 1"))
    if excess(0.5) > 0.0:
        raise IdentificationError(
            _outside("model 4", "more lag than two equal lags have", "model 3 or 5")
        )
    first, second = lags(_root(excess, 1e-12, 0.5))
    return first, second


def two_equal_and_one(
    period: float,
    dead_time: float,
    relative_amplitude: float,
    switch_level: float = 0.0,
    harmonics: int | None = 1,
) -> tuple[tuple[float, float], ...]:
    """Return the time constants (repeated, single) of model 5 (eqs 12 and 25).

    Between two equal lags and three there are two solutions, one with the larger constant
    repeated and one with the smaller; period and amplitude do not tell them apart.

    :param period: P [s].
    :param dead_time: D [s].
    :param relative_amplitude: a/(K h).
    :param switch_level: epsilon/(K h), 0 for an ideal relay.
    :param harmonics: terms of eq 19 that make the amplitude; 1: as the paper has it; None: all.
    :return: one or two solutions, the one with the larger single constant first.
    :raises IdentificationError: if the process has less lag than one lag or more than three
        equal ones, so that there is no solution.
    """
    _require_dead_time(period, dead_time)
    _require_level(switch_level)
    part = 1.0 - 2.0 * dead_time / period

    def lags(share: float) -> tuple[float, ...]:
        # Two equal lags are the end of the second branch, where the single one vanishes.
        shares = (share, share, max(1.0 - 2.0 * share, 1e-13))
        return _with_amplitude(shares, period, relative_amplitude, harmonics)

    def excess(share: float) -> float:
        return level(lags(share), period, part) - switch_level

    least = _with_amplitude((1.0,), period, relative_amplitude, harmonics)
    if level(least, period, part) - switch_level <= 0.0:
        raise IdentificationError(_outside("model 5", "less lag than one lag has", "model 1"))
    if excess(1.0 / 3.0) > 0.0:
        raise IdentificationError(
            _outside("model 5", "more lag than three equal lags have", "more equal lags")
        )
    roots = [_root(excess, 1e-12, 1.0 / 3.0)]
    if excess(0.5) > 0.0:
        roots.append(_root(excess, 1.0 / 3.0, 0.5))
    found = [lags(share) for share in roots]
    return tuple((repeated, single) for repeated, _, single in found)


def gain_and_time_constant(
    order: int,
    period: float,
    amplitude: float,
    dead_time: float,
    relay: float,
    hysteresis: float = 0.0,
    harmonics: int | None = None,
) -> tuple[float, float]:
    """Return (K, tau) of n equal lags where the gain is not known.

    An ideal relay's period does not depend on the gain: tau from eq 8, 9 or 10, then K from the
    amplitude. With a hysteresis the two are one equation, F_n = (epsilon/a) a/(K h).

    :param order: n >= 1.
    :param period: P [s].
    :param amplitude: a [y].
    :param dead_time: D [s].
    :param relay: h [u].
    :param hysteresis: epsilon [y].
    :param harmonics: terms of eq 19 that make the amplitude; 1: eqs 21 to 23; None: all.
    :raises IdentificationError: if no such process has this limit cycle; for n = 1
        (1 - epsilon/a) P/4 < D < P/2 is needed.
    """
    _require_dead_time(period, dead_time)
    require_switching(amplitude, hysteresis)
    share = hysteresis / amplitude
    if order == 1:
        _require_fopdt(period, dead_time, 0.25 * (1.0 - share))
    part = 1.0 - 2.0 * dead_time / period

    def excess(tau: float) -> float:
        lags = (tau,) * order
        return level(lags, period, part) - (share * peak(lags, period) if share else 0.0)

    tau = _smallest(order, period, part, excess)
    return amplitude / (relay * peak((tau,) * order, period, harmonics)), tau


def _with_amplitude(
    shares: Sequence[float], period: float, relative_amplitude: float, harmonics: int | None
) -> tuple[float, ...]:
    """Return time constants that share the attenuation of a given amplitude.

    Eqs 21 to 25 in one: 4 K h/(pi a_1) = prod(1 + (w tau_i)^2)^(1/2), where factor i is the
    attenuation to the power ``shares[i]``. With more harmonics a_1 differs from a by a ratio that
    depends on the time constants; solving for it gives the limit of the paper's iteration.
    """
    w = 2.0 * math.pi / period
    whole = math.log(4.0 / (math.pi * relative_amplitude))
    most = 1.0 if harmonics is None else peak((), period, harmonics)
    if not relative_amplitude < most:
        raise IdentificationError(
            f"an amplitude of {relative_amplitude:g} K h is more than the {most:g} that lags of "
            "this gain can have: the gain given is too small, or the relay's amplitude is wrong"
        )

    def lags(attenuation: float) -> tuple[float, ...]:
        return tuple(math.sqrt(math.expm1(2.0 * s * attenuation)) / w for s in shares)

    if harmonics == 1:
        return lags(whole)

    def excess(attenuation: float) -> float:
        return math.log(peak(lags(attenuation), period, harmonics) / relative_amplitude)

    # The first harmonic of a square wave is 4/pi of it, that of a triangle 8/pi^2.
    low, high = max(whole - 0.3, 1e-13), max(whole, 0.0) + 0.3
    return lags(_root(excess, low, high))


def _smallest(order: int, period: float, part: float, excess: Callable[[float], float]) -> float:
    """Smallest tau at which ``excess`` vanishes and y rises; it is positive for small tau."""
    tau = before = 0.5 * period * part / (3.0 * order + 60.0)
    while tau < _LONGEST * period:
        before, tau = tau, tau * _STEP
        if excess(tau) > 0.0 or not excess(before) > 0.0:
            continue
        root = _root(excess, before, tau)
        if slope_sign((root,) * order, period, part) > 0.0:
            return root
    raise IdentificationError(
        f"no process of {order} equal lags with a dead time of {period * (1.0 - part) / 2.0:g} s "
        f"oscillates with a period of {period:g} s under this relay: the dead time is misread, or "
        "the process is of another structure"
    )


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    at_low, at_high = function(low), function(high)
    if at_low * at_high > 0.0:
        # At the very end of the range of solutions, rounding may put the root outside.
        return low if abs(at_low) < abs(at_high) else high
    return float(brentq(function, low, high, xtol=1e-300, rtol=1e-15))


def _require_dead_time(period: float, dead_time: float) -> None:
    if not 0.0 <= dead_time < 0.5 * period * _WITH_LAG:
        raise IdentificationError(
            f"a dead time of {dead_time:g} s cannot be: a switch takes effect only after it, so "
            f"that it is less than half the period, {0.5 * period:g} s"
        )


def _require_fopdt(period: float, dead_time: float, least: float) -> None:
    if not dead_time > least * period:
        raise IdentificationError(
            f"no stable FOPDT process with a dead time of {dead_time:g} s oscillates with a "
            f"period of {period:g} s; the dead time would lie between {least * period:g} s and "
            f"{0.5 * period:g} s: the process has more than one lag, or is unstable, or the dead "
            "time is misread"
        )


def _require_level(switch_level: float) -> None:
    if not 0.0 <= switch_level < _NEARLY_ONE:
        raise IdentificationError(
            f"a hysteresis of {switch_level:g} K h cannot be: below 1 the relay would never have "
            "switched; the gain or the amplitude of the relay is wrong"
        )


def _outside(model: str, what: str, instead: str) -> str:
    return (
        f"no process of {model} has this period and amplitude: it has {what} at this gain and "
        f"dead time; try {instead}, or check gain and dead time"
    )


_AGREEMENT = 0.05


def identify_chang(record: Record, known: Known = NOTHING) -> Identification:
    """Identify one of models 1 to 5 from an unbiased relay test, by the exact equations.

    The equations include the hysteresis of the relay, and all harmonics of the amplitude. A
    warning tells what the paper's equations give literally.

    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known. Without the gain
        only equal lags can be found; a dead time that is not known is read from the record;
        without the structure the simplest model that fits is taken.
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
        require_equal_lags(model)
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
    :return: infinite where no tau gives the period: the process has too much lag.
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
    """Return what the paper's equations, with their errata, give literally, if it differs."""
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
