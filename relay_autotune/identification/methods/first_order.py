# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A FOPDT process from its symmetric limit cycle, by the one number that methods differ in.

With the period P, the amplitude a, h that of the relay and epsilon where it switches, all numbers
follow from q = P/(4 tau), negative for an unstable process:

    K h tanh q = a,   D = tau ln[(K h - epsilon)/(K h - a)].

These are eqs 21 and 22 of Wang, Hang and Zou 1997, with ``mu K + A`` in the first logarithm of
eq 22 (printed: ``mu K - A``), and eqs 8 to 11 and 14 to 17 of Thyagarajan and Yu 2003 with a
level.
What tells q is the gain, the fundamental (eqs 23 to 25 of Wang et al.), the rise (eq 20 of
Thyagarajan and Yu) or the time to the peak, which is D (their eqs 10 and 16).
"""

from __future__ import annotations

import math


def first_order(
    q: float, period: float, amplitude: float, relay: float, level: float
) -> tuple[float, float, float]:
    """Return (K, tau, D) of K exp(-D s)/(tau s + 1), K and tau negative for an unstable process.

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
