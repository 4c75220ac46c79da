# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A FOPDT process from its symmetric limit cycle, by the one number that methods differ in.

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

from scipy.optimize import brentq

from relay_autotune.errors import IdentificationError

# A/(mu A_0), the limit of eq 25 for T -> infinity: the triangle of an integrator.
INTEGRATOR_RATIO = 0.5 * math.pi
# Ends of q for a stable process.
_SMALLEST_Q, _LARGEST_Q = 2.5e-5, 300.0
_NEARLY_ONE = 1.0 - 1e-14
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
    # K h - a without the difference of nearly equal numbers.
    left = 2.0 * amplitude / math.expm1(2.0 * q)
    return g / relay, tau, tau * math.log((g - level) / left)


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
    q = float(brentq(excess, _SMALLEST_Q, _LARGEST_Q, xtol=1e-300, rtol=1e-15))
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
    x = float(brentq(lambda x: 2.0 * x - x**ratio - 1.0, 0.5, top, xtol=1e-300, rtol=1e-15))
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

    With v = a/(K h), negative for an unstable process, P/(2 tau) = 2 atanh v, so that 2 D/P is a
    function of v alone that rises from 0 at -1, by (1 - epsilon/a)/2 at 0, to 1 at 1.

    :param period: P [s].
    :param amplitude: a [y].
    :param time_to_peak: from the switch to the peak, which is D [s].
    :param relay: h [u].
    :param level: epsilon [y]; 0: the equations as they stand.
    :param unstable: True: K exp(-D s)/(tau s - 1).
    :raises IdentificationError: unless (1 - epsilon/a) P/4 < D < P/2 for a stable process,
        0 < D < (1 - epsilon/a) P/4 for an unstable one.
    """
    e, share = level / amplitude, 2.0 * time_to_peak / period
    earliest = 0.25 * period * (1.0 - e)
    if not abs(e) < 1.0:
        raise IdentificationError(
            f"a period of {period:g} s with an amplitude of {amplitude:g} about a switching level "
            f"of {level:g} is no limit cycle: the amplitude must exceed the level"
        )

    def excess(v: float) -> float:
        if abs(v) < 1e-12:
            return 0.5 * (1.0 - e) - share
        return (math.log1p(-e * v) - math.log1p(-v)) / (2.0 * math.atanh(v)) - share

    if not excess(-_NEARLY_ONE) <= 0.0 <= excess(_NEARLY_ONE):
        raise IdentificationError(
            f"a peak {time_to_peak:g} s after the switch does not lie within the half period of "
            f"{0.5 * period:g} s, or at its very end: no FOPDT process has a lag that shows there"
        )
    v = float(brentq(excess, -_NEARLY_ONE, _NEARLY_ONE, xtol=1e-16, rtol=1e-15))
    side = -1.0 if unstable else 1.0
    if side * v <= _INTEGRATING:
        kind, eq = ("unstable", "eq 16") if unstable else ("stable", "eq 10")
        raise IdentificationError(
            f"the peak comes {time_to_peak:g} s after the switch, and (1 - epsilon/a) P/4 is "
            f"{earliest:g} s: no {kind} FOPDT process does that ({eq}); an unstable one peaks "
            "before, a stable one after, and an integrator just then"
        )
    gain, tau, _ = first_order(math.atanh(v), period, amplitude, relay, level)
    return side * gain, side * tau, time_to_peak
