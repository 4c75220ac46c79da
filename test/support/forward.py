# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The papers' equations in the other direction: from a process to what its test shows."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.methods.wang import FopdtCycle


def fopdt_limit_cycle(
    gain: float, time_constant: float, dead_time: float, mu: float, mu0: float, epsilon: float
) -> FopdtCycle:
    """Return the limit cycle of a FOPDT process under a relay (eqs 2 to 5).

    :param gain: K > 0 [y/u].
    :param time_constant: T > 0 [s].
    :param dead_time: L > 0 [s].
    :param mu: amplitude of the relay [u].
    :param mu0: its bias [u].
    :param epsilon: its hysteresis [y].
    """
    k, t = gain, time_constant
    assert k * (mu - abs(mu0)) > epsilon, "no limit cycle"
    rise, decay = math.exp(dead_time / t), math.exp(-dead_time / t)
    upward = (2 * mu * k * rise + mu0 * k - mu * k + epsilon) / (mu * k + mu0 * k - epsilon)
    downward = (2 * mu * k * rise - mu * k - mu0 * k + epsilon) / (mu * k - mu0 * k - epsilon)
    return FopdtCycle(
        high=t * math.log(upward),
        low=t * math.log(downward),
        up=(mu0 + mu) * k * (1.0 - decay) + epsilon * decay,
        down=(mu0 - mu) * k * (1.0 - decay) - epsilon * decay,
    )


def first_half(
    time: FloatArray,
    gain: float,
    time_constant: float,
    dead_time: float,
    relay: float,
    level: float = 0.0,
) -> FloatArray:
    """Return y from one switch to the next (eqs 8 and 9; 14 and 15 for an unstable process).

    With K h = g, y = g - (g - epsilon) exp(-t/tau) until the dead time has passed, and falls
    towards -g from there. An unstable process is the same with negative K and tau.

    :param time: since the switch, up to half a period [s], shape (n,).
    :param gain: K of K exp(-D s)/(tau s + 1) [y/u].
    :param time_constant: tau [s].
    :param dead_time: D [s].
    :param relay: h [u].
    :param level: epsilon, where the relay switches; 0: as in the paper [y].
    """
    g = gain * relay
    rising = g - (g - level) * np.exp(-time / time_constant)
    late = np.maximum(time - dead_time, 0.0)
    return np.asarray(rising + 2.0 * g * np.expm1(-late / time_constant))


def unstable_limit_cycle(
    gain: float, time_constant: float, dead_time: float, relay: float, level: float = 0.0
) -> tuple[float, float]:
    """Return (P, a) of an unstable FOPDT process (eqs 14 and 16, with a level).

    :param gain: K > 0 of K exp(-D s)/(tau s - 1) [y/u].
    :param time_constant: tau > 0 [s].
    :param dead_time: D [s].
    :param relay: h [u].
    :param level: epsilon [y].
    """
    g, growth = gain * relay, math.exp(dead_time / time_constant)
    amplitude = (level + g) * growth - g
    assert amplitude < g, "no limit cycle: D/tau must be less than ln 2 - ln(1 + epsilon/(K h))"
    return 4.0 * time_constant * math.atanh(amplitude / g), amplitude


def step_response(
    time: FloatArray, gain: float, tau1: float, tau2: float, step: float
) -> FloatArray:
    """Return the response to a step (eq 2) [y].

    :param time: since the end of the dead time, >= 0 [s], shape (n,).
    :param gain: K [y/(u s)].
    :param tau1: of the inverse response [s].
    :param tau2: of the lag [s].
    :param step: du [u].
    """
    ramp = time - (tau1 + tau2) * -np.expm1(-time / tau2)
    return np.asarray(step * gain * ramp)


def step_features(
    gain: float, tau1: float, tau2: float, step: float
) -> tuple[float, float, float]:
    """Return time t1 and height of the extremum, and the return to zero t2 (eqs 4 to 6).

    :param gain: K [y/(u s)].
    :param tau1: > 0 [s].
    :param tau2: > 0 [s].
    :param step: du [u].
    :return: t1 [s], t2 [s], y_ext [y].
    """
    r = 1.0 + tau1 / tau2
    t1 = tau2 * math.log1p(tau1 / tau2)
    # z/(1 - exp(-z)) exceeds both 1 + z/2 and z.
    low, high = r - 1.0, min(2.0 * (r - 1.0), r)
    z = float(brentq(lambda z: z / -math.expm1(-z) - r, low, high, xtol=1e-300, rtol=1e-15))
    return t1, tau2 * z, step * gain * (t1 - tau1)


def peak_of_harmonics(lags: tuple[float, ...], period: float, harmonics: int) -> float:
    """Return the amplitude y/(K h) by the first terms of eq 19 of Chang et al.

    :param lags: time constants [s].
    :param period: P [s].
    :param harmonics: terms of the sum.
    """
    angle = np.linspace(0.0, math.pi, 32 * harmonics, endpoint=False)
    w, tau = 2.0 * math.pi / period, np.array(lags)[:, None]
    k = 2.0 * np.arange(harmonics) + 1.0
    size = np.prod(np.hypot(1.0, k * w * tau), axis=0) * k
    lag = np.sum(np.arctan(k * w * tau), axis=0)

    def wave(at: FloatArray) -> FloatArray:
        return np.abs(np.sin(np.outer(at, k) - lag) @ (4.0 / math.pi / size))

    top = float(angle[np.argmax(wave(angle))])
    return float(np.max(wave(top + np.linspace(-1.0, 1.0, 4001) * angle[1])))
