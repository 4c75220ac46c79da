# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The methods `wang_biased` and `wang_unbiased`: FOPDT models from one relay test.

Wang, Hang and Zou, "Low-Order Modeling from Relay Feedback", Ind. Eng. Chem. Res. 1997. The
equations are exact for FOPDT. T_u1 is the duration of u = mu0 + mu, T_u2 of u = mu0 - mu. Two
equations are corrected: eq 10 has T_u2 where T_u1 is printed, and the first logarithm of eq 22 has
``mu K - A`` where ``mu K + A`` is printed.

Peaks and fundamental are those of the averaged period, whose peaks noise does not raise; the
levels at which the relay was seen to switch take the place of its hysteresis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, stdtrit

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, carried
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import (
    Fold,
    fold,
    level_at_switch,
    scatter_of_fold,
)
from relay_autotune.identification.limit_cycle.fourier import (
    UNKNOWN_REST,
    StaticGain,
    static_gain,
    steady_state,
)
from relay_autotune.identification.limit_cycle.limit_cycle import (
    NOT_SETTLED,
    RelayTest,
    known_gain,
    relay_test,
    require_unbiased,
)
from relay_autotune.identification.methods.first_order import first_order
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import FOPDT
from relay_autotune.record.record import Record


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
# Ends of P/(4 T).
_SMALLEST_Q, _LARGEST_Q = 2.5e-5, 300.0


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
    ratio = amplitude / (mu * response)

    def excess(q: float) -> float:
        # It falls from an integrator's pi/2 to 1.
        return math.tanh(q) * math.hypot(0.5 * math.pi / q, 1.0) - ratio

    low, high = _SMALLEST_Q, _LARGEST_Q
    if not excess(low) > 0.0 > excess(high):
        raise IdentificationError(
            f"no stable FOPDT process has a limit cycle of period {period:g} s, amplitude "
            f"{amplitude:g} and |G| = {response:g} at its fundamental: the process is of another "
            "structure, or noise spoils the peaks; try the waveform method"
        )
    q = float(brentq(excess, low, high, xtol=1e-300, rtol=1e-15))
    return fopdt_with_gain(amplitude / (mu * math.tanh(q)), period, amplitude, mu, epsilon)


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
    _log_ratio(mu * gain + amplitude, mu * gain - amplitude, "eq 21")
    _log_ratio(mu * gain - epsilon, mu * gain - amplitude, "eq 22")
    q = math.atanh(amplitude / (mu * gain))
    return gain, *first_order(q, period, amplitude, mu, epsilon)[1:]


def _log_ratio(numerator: float, denominator: float, where: str) -> float:
    if not (denominator > 0.0 and numerator > denominator):
        raise IdentificationError(
            f"{where} needs the logarithm of {numerator:g}/{denominator:g}, which is not a ratio "
            "above 1: these numbers are not the limit cycle of a FOPDT process"
        )
    return math.log(numerator / denominator)


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
    settings = test.whole.settings
    rest = steady_state(record, settings)
    gain = (
        static_gain(test, rest)
        if math.isnan(known.gain)
        else StaticGain(known.gain, 0.0, math.inf)
    )
    sign = -1 if settings.reverse_acting else 1
    if not sign * gain.value > 0.0:
        raise IdentificationError(
            f"a gain of {gain.value:g} is against the direction of the relay: the state before "
            "the test was not steady, the load changed, or the known gain has the wrong sign"
        )

    def solve(features: FloatArray) -> tuple[float, float, float]:
        high, low, down, up, at_high, at_low, measured, error = features.tolist()
        # A steady state that is a little higher makes the gain lower; with the command turned
        # round a reverse-acting process has a positive gain.
        k = sign * (measured - error / gain.excursion)
        about = 0.5 * (at_high + at_low)
        bias = sign * settings.bias - (settings.setpoint + about - rest.value - error) / k
        high, low = (high, low)[::sign]
        cycle = FopdtCycle(high, low, up - about, down - about)
        epsilon = 0.5 * sign * (at_low - at_high)
        return fopdt_from_biased(cycle, k, settings.amplitude, bias, epsilon)

    def features(seen: Fold) -> FloatArray:
        at = seen(np.array([0.0, seen.period_high]))
        return np.array((seen.period_high, seen.period_low, *seen.peaks(), *at, gain.value, 0.0))

    found, covariance = _features(test, record, features)
    if sign * (found[5] - found[4]) < 0.0:
        # Noise put the levels in the order in which no relay switches.
        found[4:6] = np.mean(found[4:6])
    if covariance is not None:
        covariance[6, 6] = gain.scatter**2
        covariance[7, 7] = rest.std**2 if rest.measured else 0.0
    remark = "" if rest.measured else UNKNOWN_REST
    return _identified("wang_biased", test, solve, found, covariance, remark)


def identify_unbiased(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a FOPDT model from an unbiased relay test (eqs 21 to 25).

    Gain and time constant come from the ratio of the amplitude to that of the fundamental, which
    is at most that of an integrator. With a short dead time it is hardly less, and noise may put
    it above. Then its expected value below that limit takes its place, with its uncertainty.

    :param record: a relay test without bias.
    :param known: a known gain takes the place of eqs 23 to 25.
    :raises IdentificationError: if the relay was biased, or no FOPDT process has the limit cycle.
    """
    test = relay_test("wang_unbiased", record)
    settings = test.whole.settings
    require_unbiased("wang_unbiased", settings)
    gain = known_gain(known, -1 if settings.reverse_acting else 1)
    mu = settings.amplitude

    def solve(features: FloatArray) -> tuple[float, float, float]:
        period, amplitude, epsilon, ratio = features.tolist()
        if math.isnan(gain):
            response = amplitude / (mu * ratio)
            return fopdt_from_unbiased(period, amplitude, response, mu, epsilon)
        return fopdt_with_gain(gain, period, amplitude, mu, epsilon)

    def features(seen: Fold) -> FloatArray:
        down, up = seen.peaks()
        amplitude = 0.5 * (up - down)
        ratio = amplitude / (mu * abs(seen.fundamental())) if math.isnan(gain) else 1.0
        return np.array((seen.period, amplitude, level_at_switch(seen), ratio))

    found, covariance = _features(test, record, features)
    # Noise may put it below zero, where no relay switches; the scatter is to both sides.
    found[2] = max(found[2], 0.0)
    remark = ""
    if math.isnan(gain) and covariance is not None:
        ratio, std = _likely_ratio(float(found[3]), math.sqrt(covariance[3, 3]))
        if ratio != found[3]:
            remark, found[3] = _LIKE_AN_INTEGRATOR, ratio
            covariance[3], covariance[:, 3] = 0.0, 0.0
            covariance[3, 3] = std**2
    return _identified("wang_unbiased", test, solve, found, covariance, remark)


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


def _features(
    test: RelayTest, record: Record, features: Callable[[Fold], FloatArray]
) -> tuple[FloatArray, FloatArray | None]:
    """Return what is measured on the averaged period, and its covariance."""
    cycles = test.whole.cycle.cycles
    return features(fold(record, cycles)), scatter_of_fold(record, cycles, features)


def _identified(
    method: str,
    test: RelayTest,
    solve: Callable[[FloatArray], tuple[float, float, float]],
    features: FloatArray,
    covariance: FloatArray | None,
    remark: str,
) -> Identification:
    """Solve for the averaged period, with the uncertainty of what was measured on it.

    :param solve: from features to K > 0, T and L.
    :param remark: for the user; may be empty.
    """
    settings, cycle = test.whole.settings, test.whole.cycle

    def values(numbers: FloatArray) -> FloatArray:
        k, t, dead = solve(numbers)
        # The dead time that the relay added is not the process's.
        dead = max(dead - settings.extra_delay, 0.0)
        return np.array((-k if settings.reverse_acting else k, t, dead))

    best = values(features)
    if covariance is not None:
        covariance = carried(values, features, covariance)
    remarks = [remark, "" if cycle.converged else NOT_SETTLED]
    return identified(
        method,
        Estimate.of(FOPDT, best, covariance),
        float(stdtrit(max(len(cycle.cycles) - 1, 1), 0.975)),
        warnings=tuple(r for r in remarks if r),
    )
