# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The batch of test processes of Astrom and Hagglund: 133 processes in nine families.

Often quoted as 134; every transcription found lists 133.
"""

from __future__ import annotations

import math

from relay_autotune.process.transfer_function import TransferFunction

_RATIOS = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.3, 1.5, 2.0, 4.0, 6.0, 8.0, 10.0, 20.0, 50.0)
_LONG = (100.0, 200.0, 500.0)
_TENTHS = tuple(k / 10.0 for k in range(1, 10))
# L1 and T1 of P6 and P7, whose sum is 1.
_SHARES = tuple(
    (share, round(1.0 - share, 9)) for share in (0.01, 0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
)

Named = tuple[str, TransferFunction]


def _process(
    gain: float, dead_time: float, *lags: complex, zero: float = 0.0, integrators: int = 0
) -> TransferFunction:
    return TransferFunction(gain, (zero,), lags, integrators, dead_time)


def _oscillating(time: float) -> tuple[complex, complex]:
    """Return the two constants of ``(s T)^2 + 1.4 s T + 1``."""
    constant = time * complex(0.7, math.sqrt(1.0 - 0.7**2))
    return constant, constant.conjugate()


# Title and processes of each family, each process with its parameters.
FAMILIES: dict[str, list[Named]] = {
    "P1 = e^(-s)/(1 + s T)": [
        (f"T = {t:g}", _process(1.0, 1.0, t)) for t in (0.02, 0.05, *_RATIOS, *_LONG, 1000.0)
    ],
    "P2 = e^(-s)/(1 + s T)^2": [
        (f"T = {t:g}", _process(1.0, 1.0, t, t)) for t in (0.01, 0.02, 0.05, *_RATIOS, *_LONG)
    ],
    "P3 = 1/((s + 1)(1 + s T)^2)": [
        (f"T = {t:g}", _process(1.0, 0.0, 1.0, t, t))
        for t in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0)
    ],
    "P4 = 1/(s + 1)^n": [
        (f"n = {n}", _process(1.0, 0.0, *([1.0] * n))) for n in (3, 4, 5, 6, 7, 8)
    ],
    "P5 = 1/((1 + s)(1 + a s)(1 + a^2 s)(1 + a^3 s))": [
        (f"a = {a:g}", _process(1.0, 0.0, 1.0, a, a**2, a**3)) for a in _TENTHS
    ],
    "P6 = e^(-s L)/(s (1 + s T)), T + L = 1": [
        (f"L = {d:g}", _process(1.0, d, t, integrators=1)) for d, t in _SHARES
    ],
    "P7 = T e^(-s L)/((1 + s T)(1 + s T1)), T1 + L = 1": [
        (f"T = {slow:g}, L = {d:g}", _process(slow, d, slow, t))
        for slow in (1.0, 2.0, 5.0, 10.0)
        for d, t in _SHARES
    ],
    "P8 = (1 - a s)/(s + 1)^3": [
        (f"a = {a:g}", _process(1.0, 0.0, 1.0, 1.0, 1.0, zero=-a)) for a in (*_TENTHS, 1.0, 1.1)
    ],
    "P9 = 1/((s + 1)((s T)^2 + 1.4 s T + 1))": [
        (f"T = {t:g}", _process(1.0, 0.0, 1.0, *_oscillating(t))) for t in (*_TENTHS, 1.0)
    ],
}
