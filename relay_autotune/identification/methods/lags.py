# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Models of lags and dead time from the period and the amplitude of a relay test.

Models 1 to 3 of Chang, Shen and Yu 1992 have n equal lags, model 4 two lags, model 5 two equal
lags and one. Whatever the model, two equations hold in the limit cycle of an unbiased relay with
the hysteresis epsilon, and the gain K and the time constants follow from them:

    y = epsilon at the switch,  with y from a half period before on, after the dead time D,
    max y = a.

With all harmonics and epsilon = 0 the first is eq 8, 9, 10 (n = 1, 2, 3), 11 or 12; with epsilon
it has epsilon/(K h) for zero on its right-hand side. By the first harmonic the second is eq 21 to
25, of which eq 23 has the exponent 3/2 (printed: 2/3), and the first the phase of eqs 7 and 13,

    w D + sum of atan(w tau_i) = pi - asin(epsilon/a),   w = 2 pi/P.

A `Wave` says which harmonics count.

The oscillation of lags under a square wave, exactly and by its first harmonic.

Static gain and height of the square wave are 1, so that y here is y/(K h). With T half a period,
x = T/tau and m the part of a half period since the square wave went up, the output of one lag is

    f(m, x) = 1 - 2 exp(-m x)/(1 + exp(-x)).

That of lags x_1 ... x_n in a row is the value at 0 of the polynomial through the points
(x_i, f(m, x_i)). Newton's form of it equals the partial fractions (Chang, Shen and Yu 1992,
appendix), but stays accurate where lags are equal or nearly so. For n equal lags it is

    F_n = sum over k < n of (-x)^k/k! d^k f/dx^k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.process.structures import (
    FOPDT,
    LAG_N,
    SOPDT,
    TWO_EQUAL_ONE,
    Structure,
)
from relay_autotune.scalar import root

_CLOSE = 0.25
_TERMS = 15


def level(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return y/(K h) at a part m of the half period in which the square wave is up.

    :param time_constants: equal ones, of which the last may differ from the others [s].
    :param period: P [s].
    :param part: m, from 0 to 1.
    """
    x = [0.5 * period / tau for tau in time_constants]
    # In a form without cancellation where x is small.
    value = (math.expm1(-x[0]) - 2.0 * math.expm1(-part * x[0])) / (1.0 + math.exp(-x[0]))
    factor = 1.0
    for ratio, difference in zip(x, _differences(part, x)[1:], strict=False):
        factor *= -ratio
        value += factor * difference
    return value


def slope_sign(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return a number with the sign of dy/dt at a part m of the upper half period.

    The rate is the highest difference times the product of all -x.

    :param time_constants: as for :func:`level` [s].
    :param period: P [s].
    :param part: m, from 0 to 1.
    """
    x = [0.5 * period / tau for tau in time_constants]
    return (-1.0) ** len(x) * _differences(part, x)[-1]


def peak_part(time_constants: Sequence[float], period: float) -> float:
    """Return when the measurement peaks: the part of a half period after the command arrived.

    A square wave through real lags has one maximum in each period and one minimum half a period
    later, so that there is one of the two. In the limit cycle of a relay it is a minimum.

    :param time_constants: as for :func:`level` [s].
    :param period: P [s].
    """
    if len(time_constants) == 1:
        return 0.0
    # Where all that was before has died away, the sign is rounding and the first end is taken.
    return root(lambda m: slope_sign(time_constants, period, m), 0.0, 1.0, 1e-12)


def peak(time_constants: Sequence[float], period: float) -> float:
    """Return the amplitude y/(K h): the maximum over t of eq 19 of Chang et al.

    The sum of eq 19 starts at n = 0 (printed: n = 1), and the root in its denominators covers
    all factors.

    :param time_constants: as for :func:`level` [s].
    :param period: P [s].
    """
    return abs(level(time_constants, period, peak_part(time_constants, period)))


def _differences(m: float, x: Sequence[float]) -> list[float]:
    """Return the divided differences g[x1], g[x1, x2], ... of ``g = f - 1``."""
    step, equal = x[-1] - x[0], len(x) - (x[-1] != x[0])
    if step == 0.0:
        return _series(m, x[0], equal)
    if abs(step) < _CLOSE:
        c = _series(m, x[0], _TERMS)
        return [*c[:equal], sum(c[k] * step ** (k - equal) for k in range(equal, _TERMS))]
    c, (last,) = _series(m, x[0], equal), _series(m, x[-1], 1)
    for each in c:
        last = (last - each) / step
    return [*c, last]


def _series(m: float, x: float, count: int) -> list[float]:
    """Return the first coefficients of g(m, x + d) in powers of d, the quotient of two series."""
    above, e = -2.0 * math.exp(-m * x), math.exp(-x)
    below, found = [1.0 + e], [above / (1.0 + e)]
    for k in range(1, count):
        above *= -m / k
        e /= -k
        below.append(e)
        rest = above - sum(below[j] * found[k - j] for j in range(1, k + 1))
        found.append(rest / below[0])
    return found


def fundamental(time_constants: Sequence[float], period: float) -> float:
    """Return the amplitude of the first harmonic, 4/pi |G(j w)|/K (eq 20).

    :param time_constants: any real ones [s].
    :param period: P [s].
    """
    w = 2.0 * math.pi / period
    return 4.0 / math.pi / math.prod(math.hypot(1.0, w * tau) for tau in time_constants)


def first_level(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return the first harmonic of :func:`level`; with its amplitude, the describing function.

    :param time_constants: any real ones [s].
    :param period: P [s].
    :param part: m, from 0 to 1.
    """
    # Beyond a quarter turn it is past its least value; the relay switches before it rises again.
    angle = max(_angle(time_constants, period, part), -0.5 * math.pi)
    return fundamental(time_constants, period) * math.sin(angle)


def first_slope_sign(time_constants: Sequence[float], period: float, part: float) -> float:
    """Return a number with the sign of the rate of :func:`first_level`, as its parameters."""
    return math.cos(_angle(time_constants, period, part))


def _angle(time_constants: Sequence[float], period: float, part: float) -> float:
    w = 2.0 * math.pi / period
    return math.pi * part - sum(math.atan(w * tau) for tau in time_constants)


@dataclass(frozen=True)
class Wave:
    """What of the square wave enters the equations of a limit cycle.

    :param level: from lags, period and part of the half period to y/(K h).
    :param slope_sign: from the same to a number with the sign of its rate.
    :param peak: from lags and period to a/(K h).
    :param largest: the limit of that where the lags vanish.
    """

    level: Callable[[Sequence[float], float, float], float]
    slope_sign: Callable[[Sequence[float], float, float], float]
    peak: Callable[[Sequence[float], float], float]
    largest: float


# All harmonics; the period by all of them and the amplitude by the first (eqs 8 to 12 and 21 to 25
# of Chang et al. as they stand); the first alone, which is the describing function.
EXACT = Wave(level, slope_sign, peak, 1.0)
MIXED = Wave(level, slope_sign, fundamental, 4.0 / math.pi)
FIRST = Wave(first_level, first_slope_sign, fundamental, 4.0 / math.pi)


_STEP = 1.1
_LONGEST = 1e10
_NEARLY_ONE = 1.0 - 1e-12
_WITH_LAG = 1.0 - 1e-6
_NONE = 1e-12

# Models 1, 2 and 3, 4 and 5 of Chang et al.
STRUCTURES = (FOPDT, LAG_N, SOPDT, TWO_EQUAL_ONE)


def model_text(model: Structure) -> str:
    """Return the name of a model, with its order where it may have any."""
    return f"{model.name} of order {model.order}" if model.any_order else model.name


def solutions(
    model: Structure, cycle: SymmetricCycle, gain: float = math.nan, wave: Wave = EXACT
) -> list[tuple[float, ...]]:
    """Return (K, time constants ...) of the processes of a model that have a limit cycle.

    :param model: n equal lags, which take the first equation alone where the gain is known;
        model 4 or 5, which take both.
    :param cycle: the limit cycle.
    :param gain: K > 0 [y/u]; NaN: to be found, for equal lags.
    :param wave: which harmonics count.
    :return: two for model 5 between two equal lags and three, which period and amplitude do not
        tell apart, that with the larger single constant first; one otherwise.
    :raises IdentificationError: if there is none, or models 4 or 5 lack the gain.
    """
    if model.equal_lags:
        return [equal(model.order, cycle, gain, wave)]
    if math.isnan(gain):
        raise IdentificationError(
            f"{model_text(model)} needs the gain of the process: its two time constants take "
            "both the period and the amplitude; give the gain, or use the method li"
        )
    _require_possible(cycle, gain)
    count, relative = model.order - 1, cycle.amplitude / (gain * cycle.relay)

    def lags(*shares: float) -> tuple[float, ...]:
        return with_amplitude(shares, cycle.period, relative, wave)

    def excess(share: float) -> float:
        return above(both(share))

    def both(share: float) -> tuple[float, ...]:
        return lags(*(share,) * count, max(1.0 - count * share, 1e-13))

    def above(time_constants: tuple[float, ...]) -> float:
        height = wave.level(time_constants, cycle.period, cycle.part)
        return height - cycle.level / (gain * cycle.relay)

    # The equal lags' share of the attenuation: from one lag alone to all equal. From there to
    # two equal lags without the third, a second solution has the smaller constant alone.
    low, middle, high = _NONE, 1.0 / model.order, 1.0 / count
    too_little = above(lags(1.0)) <= 0.0
    if too_little or excess(middle) > 0.0:
        what = "less lag than fopdt" if too_little else f"more lag than {model.order} equal lags"
        raise IdentificationError(
            f"no process of the structure {model.name} has this period and amplitude: it has "
            f"{what} at this gain and dead time; try another structure, or check gain and dead "
            "time"
        )
    shares = [root(excess, low, middle)]
    if count > 1 and excess(high) > 0.0:
        shares.append(root(excess, middle, high))
    ends = [(found[0], found[-1]) for found in map(both, shares)]
    return [(gain, *(pair if count > 1 else pair[::-1])) for pair in ends]


def equal(
    order: int,
    cycle: SymmetricCycle,
    gain: float = math.nan,
    wave: Wave = EXACT,
    ratio: float = 0.0,
) -> tuple[float, float]:
    """Return (K, tau) of n equal lags.

    An ideal relay's period does not depend on the gain: tau from the first equation, then K from
    the second. With a hysteresis the two are one, level = (epsilon/a) peak. The smallest of
    several roots is the limit cycle that a relay starts, if y rises there. Eq 8 also has the
    trivial root tau = infinity, which is excluded.

    :param order: n >= 1.
    :param cycle: the limit cycle.
    :param gain: K > 0, of which the second equation is not asked then [y/u]; NaN: to be found.
    :param wave: which harmonics count.
    :param ratio: the dead time is that of the cycle and ``ratio tau``.
    :raises IdentificationError: if no such process has this limit cycle; for n = 1 and all
        harmonics (1 - epsilon/a) P/4 < D < P/2 is needed.
    """
    _require_possible(cycle, gain)
    period, unknown = cycle.period, math.isnan(gain)
    share = cycle.level / cycle.amplitude
    least = 0.25 * (1.0 - share) if unknown else 0.25 if cycle.level == 0.0 else -1.0
    if order == 1 and wave is not FIRST and not cycle.dead_time > least * period:
        raise IdentificationError(
            f"no stable FOPDT process with a dead time of {cycle.dead_time:g} s oscillates with a "
            f"period of {period:g} s; the dead time would lie between {least * period:g} s and "
            f"{0.5 * period:g} s: the process has more than one lag, or is unstable, or the dead "
            "time is misread"
        )

    if order < 3 and not (cycle.dead_time or ratio or cycle.level):
        raise IdentificationError(
            f"{order} lags without dead time do not oscillate under an ideal relay; at least 3 do"
        )

    def part(tau: float) -> float:
        return cycle.part - 2.0 * ratio * tau / period

    def excess(tau: float) -> float:
        lags = (tau,) * order
        at_switch = cycle.level / (gain * cycle.relay)
        if unknown:
            at_switch = share * wave.peak(lags, period) if share else 0.0
        return wave.level(lags, period, part(tau)) - at_switch

    longest = min(_LONGEST * period, 0.5 * period * cycle.part / ratio if ratio else math.inf)
    tau = 0.5 * period * cycle.part / (3.0 * order + 60.0)
    height = excess(tau)
    while tau * _STEP < longest:
        before, tau, was, height = tau, tau * _STEP, height, excess(tau * _STEP)
        if height <= 0.0 < was:
            fits = root(excess, before, tau)
            if wave.slope_sign((fits,) * order, period, part(fits)) > 0.0:
                relative = wave.peak((fits,) * order, period)
                return (cycle.amplitude / (cycle.relay * relative) if unknown else gain), fits
    raise IdentificationError(
        f"no process of {order} equal lags with a dead time of {cycle.dead_time:g} s "
        + (f"and {ratio:g} tau " if ratio else "")
        + f"oscillates with a period of {period:g} s under this relay: the dead time is misread, "
        "or the process is of another structure"
    )


def with_amplitude(
    shares: Sequence[float], period: float, relative_amplitude: float, wave: Wave = EXACT
) -> tuple[float, ...]:
    """Return the time constants that have an amplitude (eqs 21 to 25, by the first harmonic).

    The eqs in one: 4 K h/(pi a_1) = prod(1 + (w tau_i)^2)^(1/2), where factor i is the attenuation
    to the power ``shares[i]``. With all harmonics a_1 differs from a by a ratio that depends on
    the time constants; solving for it gives the limit of the paper's iteration.

    :param shares: of each lag in the logarithm of the attenuation, their sum 1.
    :param period: P [s].
    :param relative_amplitude: a/(K h).
    :param wave: which harmonics count.
    :raises IdentificationError: if the amplitude is too large for a process of this gain.
    """
    if not relative_amplitude < wave.largest:
        raise IdentificationError(
            f"an amplitude of {relative_amplitude:g} K h is more than the {wave.largest:g} that "
            "lags of this gain can have: the gain given is too small, or the relay's amplitude "
            "is wrong"
        )
    whole = math.log(4.0 / (math.pi * relative_amplitude))

    def lags(attenuation: float) -> tuple[float, ...]:
        w = 2.0 * math.pi / period
        return tuple(math.sqrt(math.expm1(2.0 * s * attenuation)) / w for s in shares)

    if wave is not EXACT:
        return lags(whole)

    def excess(attenuation: float) -> float:
        return math.log(wave.peak(lags(attenuation), period) / relative_amplitude)

    # The first harmonic of a square wave is 4/pi of it, that of a triangle 8/pi^2.
    return lags(root(excess, max(whole - 0.3, 1e-13), max(whole, 0.0) + 0.3))


def _require_possible(cycle: SymmetricCycle, gain: float) -> None:
    """Refuse numbers of no limit cycle.

    :param cycle: the limit cycle.
    :param gain: K > 0 [y/u]; NaN: not known.
    """
    if not 0.0 <= cycle.dead_time < 0.5 * cycle.period * _WITH_LAG:
        raise IdentificationError(
            f"a dead time of {cycle.dead_time:g} s cannot be: a switch takes effect only after "
            f"it, so that it is less than half the period, {0.5 * cycle.period:g} s"
        )
    if math.isnan(gain):
        cycle.require_switching()
    elif not cycle.level < _NEARLY_ONE * gain * cycle.relay:
        raise IdentificationError(
            f"a hysteresis of {cycle.level / (gain * cycle.relay):g} K h cannot be: below 1 the "
            "relay would never have switched; the gain or the amplitude of the relay is wrong"
        )
