# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The methods `wang_biased` and `wang_unbiased`: FOPDT models from one relay test.

Wang, Hang and Zou, "Low-Order Modeling from Relay Feedback", Ind. Eng. Chem. Res. 1997. The
equations are exact for FOPDT. T_u1 is the duration of u = mu0 + mu, T_u2 of u = mu0 - mu. Eq 10
has T_u2, where T_u1 is printed.

Peaks and fundamental are those of the averaged period, whose peaks noise does not raise; the
levels at which the relay was seen to switch take the place of its hysteresis.

A FOPDT process comes from its symmetric limit cycle by one number, in which methods differ.

With the period P, the amplitude a, h that of the relay and epsilon where it switches, all numbers
follow from q = P/(4 tau), negative for an unstable process:

    K h tanh q = a,   D = tau ln[(K h - epsilon)/(K h - a)].

These are eqs 21 and 22 of Wang, Hang and Zou 1997, with ``mu K + A`` in the first logarithm of
eq 22 (printed: ``mu K - A``), and eqs 8 to 11 and 14 to 17 of Thyagarajan and Yu 2003 with a
level; in their eq 17 the bracket divides.

| what gives q | equation |
|---|---|
| the gain | tanh q = a/(K h) |
| the fundamental A_0 | tanh q hypot(1, pi/(2 q)) = a/(h A_0), eqs 23 to 25 of Wang et al. |
| the rise | 2 exp(-t_{a/2}/tau) - exp(-t_a/tau) = 1, eq 20 of Thyagarajan and Yu |
| the time to the peak, D | D/tau = ln[(1 - v epsilon/a)/(1 - v)], v = tanh q, their 10 and 16 |

All functions return (K, tau, D) of K exp(-D s)/(tau s + 1) [y/u, s, s].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import Fold, Reading
from relay_autotune.identification.limit_cycle.fourier import (
    UNKNOWN_REST,
    StaticGain,
    static_gain,
    steady_state,
)
from relay_autotune.identification.limit_cycle.limit_cycle import relay_test
from relay_autotune.identification.limit_cycle.shape import relative_amplitude
from relay_autotune.identification.methods.solved import solved
from relay_autotune.identification.result import Identification
from relay_autotune.process.structures import FOPDT
from relay_autotune.record.record import Record
from relay_autotune.scalar import root

# A/(mu A_0), the limit of eq 25 for T -> infinity: the triangle of an integrator.
INTEGRATOR_RATIO = 0.5 * math.pi
# Ends of q for a stable process.
_SMALLEST_Q, _LARGEST_Q = 2.5e-5, 300.0
_INTEGRATING = 1e-9

Fopdt = tuple[float, float, float]


def first_order(q: float, period: float, amplitude: float, relay: float, level: float) -> Fopdt:
    """Return the process of a given q, K and tau negative for an unstable one.

    :param q: P/(4 tau).
    :param period: P [s].
    :param amplitude: a [y].
    :param relay: h [u].
    :param level: epsilon [y].
    """
    tau, g = 0.25 * period / q, amplitude / math.tanh(q)
    # (K h - epsilon)/(K h - a) over exp(2 q), without the difference of nearly equal numbers.
    ratio = (g - level) * -math.expm1(-2.0 * q) / (2.0 * amplitude)
    return g / relay, tau, 0.5 * period + tau * math.log(ratio)


def fopdt_with_gain(
    gain: float, period: float, amplitude: float, relay: float, level: float
) -> Fopdt:
    """Return the process of a given gain (eqs 21 and 22 of Wang et al.).

    :param gain: K > 0 [y/u].
    :param period: P [s].
    :param amplitude: a [y].
    :param relay: h [u].
    :param level: epsilon [y].
    :raises IdentificationError: if no FOPDT process of this gain has the limit cycle.
    """
    size = relay * gain
    log_ratio(size + amplitude, size - amplitude, "eq 21")
    log_ratio(size - level, size - amplitude, "eq 22")
    q = math.atanh(amplitude / size)
    return gain, *first_order(q, period, amplitude, relay, level)[1:]


def log_ratio(numerator: float, denominator: float, where: str) -> float:
    """Return the logarithm of a ratio above 1.

    :param where: the equation, for the message.
    :raises IdentificationError: if it is not above 1.
    """
    if not (denominator > 0.0 and numerator > denominator):
        raise IdentificationError(
            f"{where} needs the logarithm of {numerator:g}/{denominator:g}, which is not a ratio "
            "above 1: these numbers are not the limit cycle of a FOPDT process"
        )
    return math.log(numerator / denominator)


def fopdt_from_unbiased(
    period: float, amplitude: float, response: float, relay: float, level: float
) -> Fopdt:
    """Return the process of a given fundamental (eqs 22 to 25 of Wang et al.).

    :param period: P [s].
    :param amplitude: a [y].
    :param response: A_0 = |G(j w0)| at the fundamental, from Fourier integrals (eq 23) [y/u].
    :param relay: h [u].
    :param level: epsilon [y].
    :raises IdentificationError: if eq 25 has no solution, so that no stable FOPDT process has
        this limit cycle.
    """
    ratio = amplitude / (relay * response)

    def excess(q: float) -> float:
        # It falls from an integrator's pi/2 to 1.
        return math.tanh(q) * math.hypot(INTEGRATOR_RATIO / q, 1.0) - ratio

    if not excess(_SMALLEST_Q) > 0.0 > excess(_LARGEST_Q):
        raise IdentificationError(
            f"no stable FOPDT process has a limit cycle of period {period:g} s, amplitude "
            f"{amplitude:g} and |G| = {response:g} at its fundamental: the process is of another "
            "structure, or noise spoils the peaks; try the waveform method"
        )
    q = root(excess, _SMALLEST_Q, _LARGEST_Q)
    return fopdt_with_gain(amplitude / (relay * math.tanh(q)), period, amplitude, relay, level)


def rise_time_constant(rise: float, rise_half: float) -> float:
    """Return tau from the rise to the peak and to half of it (eq 20) [s].

    With x = exp(-t_{a/2}/tau) it is 2 x - x^{t_a/t_{a/2}} = 1, whose trivial root x = 1 is
    excluded. Both times count from where y passes zero, whatever the level at which the relay
    switches.

    :param rise: t_a [s].
    :param rise_half: t_{a/2} [s].
    :raises IdentificationError: unless 0 < t_{a/2}/t_a < 1/2.
    """
    if not 0.0 < rise_half < 0.5 * rise:
        raise IdentificationError(
            f"half the peak is reached after {rise_half:g} s and the peak after {rise:g} s, but "
            "an exponential rise reaches half of it in less than half the time (eq 20)"
        )
    ratio = rise / rise_half
    top = (2.0 / ratio) ** (1.0 / (ratio - 1.0))
    x = root(lambda x: 2.0 * x - x**ratio - 1.0, 0.5, top)
    return -rise_half / math.log(x)


def flat_fopdt(
    period: float,
    amplitude: float,
    rise: float,
    rise_half: float,
    relay: float,
    level: float | None = None,
) -> Fopdt:
    """Return the process of a given rise, category 1b (eqs 20 to 22 of Thyagarajan and Yu).

    Literally D and K follow from the phase and the size of the first harmonic, so that a true
    FOPDT process with D/tau = 10 gets 0.79 to 0.87 of its gain.

    :param period: P [s].
    :param amplitude: a [y].
    :param rise: t_a, from the zero crossing to the peak [s].
    :param rise_half: t_{a/2}, from the zero crossing to half of it [s].
    :param relay: h [u].
    :param level: epsilon [y]; None: eqs 21 and 22 literally.
    :raises IdentificationError: if eq 20 has no root.
    """
    tau = rise_time_constant(rise, rise_half)
    if level is None:
        w, ultimate_gain = 2.0 * math.pi / period, 4.0 * relay / (math.pi * amplitude)
        dead_time = (math.pi - math.atan(tau * w)) / w
        return math.hypot(1.0, tau * w) / ultimate_gain, tau, dead_time
    return first_order(0.25 * period / tau, period, amplitude, relay, level)


def fopdt(
    period: float,
    amplitude: float,
    time_to_peak: float,
    relay: float,
    level: float = 0.0,
    *,
    unstable: bool = False,
) -> Fopdt:
    """Return the process of a given dead time (eqs 10, 11, 16, 17 of Thyagarajan and Yu).

    :param period: P [s].
    :param amplitude: a [y].
    :param time_to_peak: from the switch to the peak, which is D [s].
    :param relay: h [u].
    :param level: epsilon [y]; 0: the equations as they stand.
    :param unstable: True: K exp(-D s)/(tau s - 1).
    :raises IdentificationError: unless (1 - epsilon/a) P/4 < D < P/2 for a stable process,
        0 < D < (1 - epsilon/a) P/4 for an unstable one.
    """
    e, half = level / amplitude, 0.5 * period
    if not abs(e) < 1.0:
        raise IdentificationError(
            f"a period of {period:g} s with an amplitude of {amplitude:g} about a switching level "
            f"of {level:g} is no limit cycle: the amplitude must exceed the level"
        )
    v = relative_amplitude(time_to_peak, half, e)
    if math.isnan(v):
        raise IdentificationError(
            f"a peak {time_to_peak:g} s after the switch does not lie within the half period of "
            f"{half:g} s, or at its very end: no FOPDT process has a lag that shows there"
        )
    side = -1.0 if unstable else 1.0
    if side * v <= _INTEGRATING:
        kind, eq = ("unstable", "eq 16") if unstable else ("stable", "eq 10")
        quarter = 0.5 * half * (1.0 - e)
        raise IdentificationError(
            f"the peak comes {time_to_peak:g} s after the switch, and (1 - epsilon/a) P/4 is "
            f"{quarter:g} s: no {kind} FOPDT process does that ({eq}); an unstable one peaks "
            "before, a stable one after, and an integrator just then"
        )
    gain, tau, _ = first_order(math.atanh(v), period, amplitude, relay, level)
    return side * gain, side * tau, time_to_peak


@dataclass(frozen=True)
class FopdtCycle:
    """The limit cycle of a FOPDT process about its steady state.

    :param high: T_u1, duration of u = mu0 + mu [s].
    :param low: T_u2, duration of u = mu0 - mu [s].
    :param up: A_u, highest deviation of y [y].
    :param down: A_d, lowest deviation of y [y], negative.
    """

    high: float
    low: float
    up: float
    down: float


def fopdt_from_biased(
    cycle: FopdtCycle, gain: float, mu: float, mu0: float, epsilon: float
) -> Fopdt:
    """Return (K, T, L) from a limit cycle and the gain (eqs 7 to 11, the pairs averaged).

    The normalised dead time is the mean of eqs 7 and 8, the time constant the mean of eqs 9
    and 10; in the limit cycle of a FOPDT process all agree.

    :param cycle: the limit cycle.
    :param gain: K > 0, from the means of y and u over whole cycles (eq 6) [y/u].
    :param mu: amplitude of the relay [u].
    :param mu0: its bias [u].
    :param epsilon: its hysteresis [y].
    :raises IdentificationError: if the numbers are no limit cycle of a FOPDT process.
    """
    k = gain
    theta7 = log_ratio((mu0 + mu) * k - epsilon, (mu0 + mu) * k - cycle.up, "eq 7")
    theta8 = log_ratio((mu - mu0) * k - epsilon, (mu - mu0) * k + cycle.down, "eq 8")
    theta = 0.5 * (theta7 + theta8)
    rise = math.exp(theta)
    t9 = cycle.high / log_ratio(
        2 * mu * k * rise + mu0 * k - mu * k + epsilon, mu * k + mu0 * k - epsilon, "eq 9"
    )
    t10 = cycle.low / log_ratio(
        2 * mu * k * rise - mu0 * k - mu * k + epsilon, mu * k - mu0 * k - epsilon, "eq 10"
    )
    time_constant = 0.5 * (t9 + t10)
    return k, time_constant, time_constant * theta


# Standard deviations above an integrator's ratio beyond which noise does not explain a ratio.
_CERTAIN = 3.0
_LIKE_AN_INTEGRATOR = (
    "the peaks are those of an integrator's limit cycle, or noise makes them look like it: of "
    "gain and time constant hardly more than the ratio is known; a biased relay or the method "
    "waveform determines both"
)


def identify_biased(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a FOPDT model from a biased relay test (eqs 6 to 11).

    Deviations are taken from the measured steady state; where the set-point lies elsewhere, the
    bias about it is ``mu0 - (setpoint - rest)/K``. The uncertainty of the steady state is part of
    that of the gain.

    :param record: a relay test with a bias.
    :param known: a known gain takes the place of eq 6.
    :raises IdentificationError: if the relay was unbiased, or the numbers are no limit cycle of a
        FOPDT process.
    """
    test = relay_test("wang_biased", record)
    settings, sign = test.settings, test.sign
    rest = steady_state(record, settings)
    gain = (
        static_gain(test, rest)
        if math.isnan(known.gain)
        else StaticGain(known.gain, 0.0, math.inf)
    )
    if not sign * gain.value > 0.0:
        raise IdentificationError(
            f"a gain of {gain.value:g} is against the direction of the relay: the state before "
            "the test was not steady, the load changed, or the known gain has the wrong sign"
        )

    def equations(numbers: FloatArray) -> Fopdt:
        high, low, down, up, about, epsilon, measured, error = numbers.tolist()
        # A steady state that is a little higher makes the gain lower; with the command turned
        # round a reverse-acting process has a positive gain.
        k = sign * (measured - error / gain.excursion)
        bias = sign * settings.bias - (settings.setpoint + about - rest.value - error) / k
        cycle = FopdtCycle(high, low, up - about, down - about)
        return fopdt_from_biased(cycle, k, settings.amplitude, bias, epsilon)

    def measure(seen: Fold) -> FloatArray:
        halves = (seen.period_high, seen.period_low)[::sign]
        return np.array((*halves, *seen.peaks(), *seen.switching, gain.value, 0.0))

    reading = Reading.of(record, measure)
    # Noise may put the levels in the order in which no relay switches.
    reading.values[5] = max(reading.values[5], 0.0)
    reading = reading.with_number(6, gain.value, gain.scatter)
    reading = reading.with_number(7, 0.0, rest.std if rest.measured else 0.0)
    return solved(
        *("wang_biased", FOPDT, equations, reading),
        sign=sign,
        late=settings.extra_delay,
        remarks=["" if rest.measured else UNKNOWN_REST, *test.remarks(symmetric=False)],
    )


def identify_unbiased(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a FOPDT model from an unbiased relay test (eqs 21 to 25).

    Gain and time constant come from the ratio of the amplitude to that of the fundamental, which
    is at most that of an integrator. With a short dead time it is hardly less, and noise may put
    it above. Then its expected value below that limit takes its place, with its uncertainty.

    :param record: a relay test without bias.
    :param known: a known gain takes the place of eqs 23 to 25.
    :raises IdentificationError: if the relay was biased, or no FOPDT process has the limit cycle.
    """
    test = relay_test("wang_unbiased", record, unbiased=True)
    gain, mu = test.known_gain(known), test.settings.amplitude

    def equations(numbers: FloatArray) -> Fopdt:
        period, amplitude, epsilon, ratio = numbers.tolist()
        if math.isnan(gain):
            response = amplitude / (mu * ratio)
            return fopdt_from_unbiased(period, amplitude, response, mu, epsilon)
        return fopdt_with_gain(gain, period, amplitude, mu, epsilon)

    def over_fundamental(seen: Fold, amplitude: float) -> float:
        return amplitude / (mu * abs(seen.fundamental())) if math.isnan(gain) else 1.0

    reading = test.read(over_fundamental)
    remark, ratio = "", float(reading.values[3])
    if math.isnan(gain) and reading.covariance is not None:
        likely, std = _likely_ratio(ratio, float(reading.std[3]))
        if likely != ratio:
            remark, reading = _LIKE_AN_INTEGRATOR, reading.with_number(3, likely, std)
    return solved(
        *("wang_unbiased", FOPDT, equations, reading),
        sign=test.sign,
        late=test.settings.extra_delay,
        remarks=[remark, *test.remarks(symmetric=False)],
    )


def _likely_ratio(ratio: float, scatter: float) -> tuple[float, float]:
    """Return expectation and scatter of a ratio, given that it is below an integrator's.

    :return: the ratio itself where it is below, or far above.
    """
    room = INTEGRATOR_RATIO - ratio
    if room > 0.0 or not -room < _CERTAIN * scatter:
        return ratio, scatter
    # Mean and variance of a normal distribution below a limit.
    a = room / scatter
    beyond = math.exp(-0.5 * a * a) / (math.sqrt(2.0 * math.pi) * float(ndtr(a)))
    return ratio - scatter * beyond, scatter * math.sqrt(1.0 - a * beyond - beyond**2)
