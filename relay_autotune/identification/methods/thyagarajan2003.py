# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""FOPDT models from the shape of an unbiased relay test, and the paper's correlations.

Thyagarajan and Yu, "Improved Autotuning Using the Shape Factor from Relay Feedback", Ind. Eng.
Chem. Res. 2003. t = 0 is where y rises through the level at which the relay switches; P is the
period, a the amplitude, h that of the relay.

The literal equations are for an ideal relay that switches at zero; eqs 21 to 24, 26 and 27 use the
first harmonic alone. The exact ones are for a relay that switches at the level epsilon, with all
harmonics. Corrected are eq 17, where the bracket divides, and eq 23, which the paper solved with
22/7 for pi. Those of equal lags (eqs 5, 23 and 24 for two with D = 0.001 tau; 6, 26
and 27 for five without dead time) are `equal` of
:mod:`~relay_autotune.identification.methods.lags`, literally with the first harmonic and a level
of zero.
"""

from __future__ import annotations

import math

from scipy.optimize import brentq

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.methods.first_order import first_order

SMALL_DEAD_TIME = 0.001
HIGHER_ORDER = 5

_NEARLY_ONE = 1.0 - 1e-14
_INTEGRATING = 1e-9


def fopdt(
    period: float, amplitude: float, time_to_peak: float, relay: float, level: float = 0.0
) -> tuple[float, float, float]:
    """Return (K, tau, D) of a stable FOPDT process (eqs 10 and 11, with a level).

    D is the time to the peak, and

        tau = (P/2)/ln[(2 a e^{D/tau} - a - epsilon)/(a - epsilon)],
        K = (a - epsilon e^{-D/tau})/(h (1 - e^{-D/tau})).

    :param period: P [s].
    :param amplitude: a [y].
    :param time_to_peak: from the switch to the peak [s].
    :param relay: h [u].
    :param level: epsilon [y]; 0: eqs 10 and 11 as they stand.
    :raises IdentificationError: unless (1 - epsilon/a) P/4 < D < P/2.
    """
    v = _reach(period, amplitude, time_to_peak, level)
    if v <= _INTEGRATING:
        raise IdentificationError(
            f"the peak comes {time_to_peak:g} s after the switch, before (1 - epsilon/a) P/4 = "
            f"{_earliest(period, amplitude, level):g} s: no stable FOPDT process does that (eq "
            "10); the process has more lags, integrates, or is unstable"
        )
    gain, tau, _ = first_order(math.atanh(v), period, amplitude, relay, level)
    return gain, tau, time_to_peak


def unstable_fopdt(
    period: float, amplitude: float, time_to_peak: float, relay: float, level: float = 0.0
) -> tuple[float, float, float]:
    """Return (K, tau, D) of K exp(-D s)/(tau s - 1) (eqs 16 and 17, with a level).

    In eq 17 the bracket divides, K = a/[h (e^{D/tau} - 1)] (printed: multiplies). With a level,

        tau = (P/2)/ln[(a - epsilon)/(2 a e^{-D/tau} - a - epsilon)],
        K = (a - epsilon e^{D/tau})/(h (e^{D/tau} - 1)).

    :param period: P [s].
    :param amplitude: a [y].
    :param time_to_peak: from the switch to the peak, which is D [s].
    :param relay: h [u].
    :param level: epsilon [y]; 0: eqs 16 and 17 as they stand.
    :raises IdentificationError: unless 0 < D < (1 - epsilon/a) P/4.
    """
    v = _reach(period, amplitude, time_to_peak, level)
    if v >= -_INTEGRATING:
        raise IdentificationError(
            f"the peak comes {time_to_peak:g} s after the switch, not before (1 - epsilon/a) P/4 "
            f"= {_earliest(period, amplitude, level):g} s: no unstable FOPDT process does that "
            "(eq 16)"
        )
    gain, tau, _ = first_order(math.atanh(v), period, amplitude, relay, level)
    return -gain, -tau, time_to_peak


def _earliest(period: float, amplitude: float, level: float) -> float:
    return 0.25 * period * (1.0 - level / amplitude)


def _reach(period: float, amplitude: float, time_to_peak: float, level: float) -> float:
    """Return v = a/(K h), negative for an unstable process.

    P/(2 tau) = 2 atanh v and D/tau = ln[(1 - e v)/(1 - v)], e = epsilon/a, so that 2 D/P is a
    function of v alone that rises from 0 at -1, by (1 - e)/2 at 0, to 1 at 1.
    """
    e = level / amplitude
    if not (period > 0.0 and amplitude > 0.0 and abs(e) < 1.0):
        raise IdentificationError(
            f"a period of {period:g} s with an amplitude of {amplitude:g} about a switching level "
            f"of {level:g} is no limit cycle: the amplitude must exceed the level"
        )
    share = 2.0 * time_to_peak / period
    if not 0.0 < share < 1.0:
        raise IdentificationError(
            f"a peak {time_to_peak:g} s after the switch does not lie within the half period of "
            f"{0.5 * period:g} s"
        )

    def excess(v: float) -> float:
        if abs(v) < 1e-12:
            return 0.5 * (1.0 - e) - share
        return (math.log1p(-e * v) - math.log1p(-v)) / (2.0 * math.atanh(v)) - share

    for place, side in (("end", 1.0), ("beginning", -1.0)):
        if side * excess(side * _NEARLY_ONE) < 0.0:
            raise IdentificationError(
                f"a peak {time_to_peak:g} s after the switch is at the very {place} of the half "
                f"period of {0.5 * period:g} s: no FOPDT process has a lag that shows there"
            )
    return float(brentq(excess, -_NEARLY_ONE, _NEARLY_ONE, xtol=1e-16, rtol=1e-15))


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
) -> tuple[float, float, float]:
    """Return (K, tau, D) of the FOPDT process of category 1b (eqs 20 to 22).

    Literally D and K follow from the phase and the size of the first harmonic, so that a true
    FOPDT process with D/tau = 10 gets 0.79 to 0.87 of its gain. Exactly, from y = epsilon at the
    switch and the peak: K = a/(h tanh(P/(4 tau))), D = tau ln[(K h - epsilon)/(K h - a)].

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


def dead_time_ratio(growth: float) -> float:
    """Return D/tau of a second-order process (eq 25, the logarithm to base 10).

    Within 10 % at D/tau = 0.001 and 0.01, 40 to 50 % too large between, useless above.

    :param growth: tau_G/P, the time constant of the growing peaks over the period.
    """
    return float(10.0 ** (-0.3031 * growth - 1.4767))


def order_from_curvature(curvature: float) -> float:
    """Return the order n (eq 28, the logarithm to base 10).

    The paper does not define tau_C; see :func:`~relay_autotune.identification.limit_cycle.shape.
    curvature_time`. Even for that reading n = 5 comes out as 7, and any other start of the test
    than at rest under an ideal relay gives other numbers.

    :param curvature: tau_C/P.
    """
    return float(10.0 ** (1.9040 - 1.3736 * curvature))
