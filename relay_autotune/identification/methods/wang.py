# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The methods `wang_biased` and `wang_unbiased`: FOPDT models from one relay test.

Wang, Hang and Zou, "Low-Order Modeling from Relay Feedback", Ind. Eng. Chem. Res. 1997. The
equations are exact for FOPDT. T_u1 is the duration of u = mu0 + mu, T_u2 of u = mu0 - mu. Eq 10
has T_u2, where T_u1 is printed; eqs 21 to 25 are in
:mod:`~relay_autotune.identification.methods.first_order`.

Peaks and fundamental are those of the averaged period, whose peaks noise does not raise; the
levels at which the relay was seen to switch take the place of its hysteresis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import Fold, Reading, level_at_switch
from relay_autotune.identification.limit_cycle.fourier import (
    UNKNOWN_REST,
    StaticGain,
    static_gain,
    steady_state,
)
from relay_autotune.identification.limit_cycle.limit_cycle import relay_test
from relay_autotune.identification.methods.first_order import (
    INTEGRATOR_RATIO,
    Fopdt,
    fopdt_from_unbiased,
    fopdt_with_gain,
    log_ratio,
)
from relay_autotune.identification.methods.solved import solved
from relay_autotune.identification.result import Identification
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
        high, low, down, up, at_high, at_low, measured, error = numbers.tolist()
        # A steady state that is a little higher makes the gain lower; with the command turned
        # round a reverse-acting process has a positive gain.
        k = sign * (measured - error / gain.excursion)
        about = 0.5 * (at_high + at_low)
        bias = sign * settings.bias - (settings.setpoint + about - rest.value - error) / k
        high, low = (high, low)[::sign]
        cycle = FopdtCycle(high, low, up - about, down - about)
        epsilon = 0.5 * sign * (at_low - at_high)
        return fopdt_from_biased(cycle, k, settings.amplitude, bias, epsilon)

    def measure(seen: Fold) -> FloatArray:
        at = seen(np.array([0.0, seen.period_high]))
        return np.array((seen.period_high, seen.period_low, *seen.peaks(), *at, gain.value, 0.0))

    reading = Reading.of(record, test.cycle.cycles, measure)
    if sign * (reading.values[5] - reading.values[4]) < 0.0:
        # Noise put the levels in the order in which no relay switches.
        reading.values[4:6] = np.mean(reading.values[4:6])
    reading = reading.with_number(6, gain.value, gain.scatter)
    reading = reading.with_number(7, 0.0, rest.std if rest.measured else 0.0)
    return solved(
        *("wang_biased", FOPDT, equations, reading),
        sign=sign,
        extra_delay=settings.extra_delay,
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
    test = relay_test("wang_unbiased", record)
    settings = test.settings
    test.require_unbiased()
    gain, mu = test.known_gain(known), settings.amplitude

    def equations(numbers: FloatArray) -> Fopdt:
        period, amplitude, epsilon, ratio = numbers.tolist()
        if math.isnan(gain):
            response = amplitude / (mu * ratio)
            return fopdt_from_unbiased(period, amplitude, response, mu, epsilon)
        return fopdt_with_gain(gain, period, amplitude, mu, epsilon)

    def measure(seen: Fold) -> FloatArray:
        down, up = seen.peaks()
        amplitude = 0.5 * (up - down)
        ratio = amplitude / (mu * abs(seen.fundamental())) if math.isnan(gain) else 1.0
        return np.array((seen.period, amplitude, level_at_switch(seen), ratio))

    reading = Reading.of(record, test.cycle.cycles, measure)
    # Noise may put it below zero, where no relay switches; the scatter is to both sides.
    reading.values[2] = max(reading.values[2], 0.0)
    remark, ratio = "", float(reading.values[3])
    if math.isnan(gain) and reading.covariance is not None:
        likely, std = _likely_ratio(ratio, float(reading.std[3]))
        if likely != ratio:
            remark, reading = _LIKE_AN_INTEGRATOR, reading.with_number(3, likely, std)
    return solved(
        *("wang_unbiased", FOPDT, equations, reading),
        sign=test.sign,
        extra_delay=settings.extra_delay,
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
