r"""FOPDT models from one biased or unbiased relay test, exact for FOPDT.

Wang, Hang and Zou, "Low-Order Modeling from Relay Feedback", Ind. Eng. Chem. Res. 1997.
T_u1 is the duration of u = mu0 + mu, T_u2 of u = mu0 - mu. Two equations are used as corrected:
eq 10 has T_u2 where T_u1 is printed, and the first logarithm of eq 22 has ``mu K - A`` where
``mu K + A`` is printed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from relay_autotune.errors import IdentificationError


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
    :raises IdentificationError: if ``K (mu - |mu0|) <= epsilon``: there is no limit cycle.
    """
    k, t = gain, time_constant
    if not k * (mu - abs(mu0)) > epsilon:
        raise IdentificationError(
            f"no limit cycle: K (mu - |mu0|) = {k * (mu - abs(mu0)):g} must exceed the "
            f"hysteresis {epsilon:g}"
        )
    rise, decay = math.exp(dead_time / t), math.exp(-dead_time / t)
    upward = (2 * mu * k * rise + mu0 * k - mu * k + epsilon) / (mu * k + mu0 * k - epsilon)
    downward = (2 * mu * k * rise - mu * k - mu0 * k + epsilon) / (mu * k - mu0 * k - epsilon)
    return FopdtCycle(
        high=t * math.log(upward),
        low=t * math.log(downward),
        up=(mu0 + mu) * k * (1.0 - decay) + epsilon * decay,
        down=(mu0 - mu) * k * (1.0 - decay) - epsilon * decay,
    )


def fopdt_from_biased(
    cycle: FopdtCycle, gain: float, mu: float, mu0: float, epsilon: float
) -> tuple[float, float, float]:
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
    theta7 = _log_ratio((mu0 + mu) * k - epsilon, (mu0 + mu) * k - cycle.up, "eq 7")
    theta8 = _log_ratio((mu - mu0) * k - epsilon, (mu - mu0) * k + cycle.down, "eq 8")
    theta = 0.5 * (theta7 + theta8)
    rise = math.exp(theta)
    t9 = cycle.high / _log_ratio(
        2 * mu * k * rise + mu0 * k - mu * k + epsilon, mu * k + mu0 * k - epsilon, "eq 9"
    )
    t10 = cycle.low / _log_ratio(
        2 * mu * k * rise - mu0 * k - mu * k + epsilon, mu * k - mu0 * k - epsilon, "eq 10"
    )
    time_constant = 0.5 * (t9 + t10)
    return k, time_constant, time_constant * theta


# A/(mu A_0), the limit of eq 25 for T -> infinity: the triangle of an integrator.
INTEGRATOR_RATIO = 0.5 * math.pi


def fopdt_from_unbiased(
    period: float, amplitude: float, response: float, mu: float, epsilon: float
) -> tuple[float, float, float]:
    """Return (K, T, L) from a symmetric limit cycle (eqs 22 to 25).

    :param period: T_u [s].
    :param amplitude: A, highest deviation of y [y].
    :param response: A_0 = |G(j w0)| at the fundamental, from Fourier integrals (eq 23) [y/u].
    :param mu: amplitude of the relay [u].
    :param epsilon: its hysteresis [y].
    :raises IdentificationError: if eq 25 has no solution, so that no stable FOPDT process has
        this limit cycle.
    """
    w0 = 2.0 * math.pi / period

    def mismatch(log_t: float) -> float:
        t = math.exp(log_t)
        reach = mu * response * math.hypot(w0 * t, 1.0)
        # Eq 25 with the exponential taken to the other side, so that nothing overflows.
        return reach * -math.expm1(-period / (2.0 * t)) - amplitude * (
            1.0 + math.exp(-period / (2.0 * t))
        )

    grid = np.linspace(math.log(period * 1e-4), math.log(period * 1e4), 400)
    values = np.array([mismatch(x) for x in grid])
    signs = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    if signs.size == 0:
        raise IdentificationError(
            f"no stable FOPDT process has a limit cycle of period {period:g} s, amplitude "
            f"{amplitude:g} and |G| = {response:g} at its fundamental: the process is of another "
            "structure, or noise spoils the peaks; try the waveform method"
        )
    i = int(signs[-1])
    t = math.exp(float(brentq(mismatch, grid[i], grid[i + 1], xtol=1e-300, rtol=1e-15)))
    k = response * math.hypot(w0 * t, 1.0)
    return fopdt_with_gain(k, period, amplitude, mu, epsilon)


def fopdt_with_gain(
    gain: float, period: float, amplitude: float, mu: float, epsilon: float
) -> tuple[float, float, float]:
    """Return (K, T, L) from a symmetric limit cycle and the gain (eqs 21 and 22).

    :param gain: K > 0 [y/u].
    :param period: T_u [s].
    :param amplitude: A, highest deviation of y [y].
    :param mu: amplitude of the relay [u].
    :param epsilon: its hysteresis [y].
    :raises IdentificationError: if no FOPDT process of this gain has the limit cycle.
    """
    whole = _log_ratio(mu * gain + amplitude, mu * gain - amplitude, "eq 21")
    dead = _log_ratio(mu * gain - epsilon, mu * gain - amplitude, "eq 22")
    return gain, 0.5 * period / whole, 0.5 * period * dead / whole


def _log_ratio(numerator: float, denominator: float, where: str) -> float:
    if not (denominator > 0.0 and numerator > denominator):
        raise IdentificationError(
            f"{where} needs the logarithm of {numerator:g}/{denominator:g}, which is not a ratio "
            "above 1: these numbers are not the limit cycle of a FOPDT process"
        )
    return math.log(numerator / denominator)
