r"""FOPDT models from one biased or unbiased relay test, exact for FOPDT.

Wang, Hang and Zou, "Low-Order Modeling from Relay Feedback", Ind. Eng. Chem. Res. 1997.
T_u1 is the duration of u = mu0 + mu, T_u2 of u = mu0 - mu. Two equations are used as corrected:
eq 10 has T_u2 where T_u1 is printed, and the first logarithm of eq 22 has ``mu K - A`` where
``mu K + A`` is printed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from relay_autotune.cycles import LimitCycle, limit_cycle
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.fourier import cycle_means, frequency_point
from relay_autotune.identification.result import Identification, with_uncertainty
from relay_autotune.models import TransferFunction
from relay_autotune.record import Record, RelaySettings

FloatArray = NDArray[np.float64]

PARAMETERS = ("gain", "time_constant", "dead_time")


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
    return FopdtCycle(
        high=t * math.log((2 * mu * k * rise + mu0 * k - mu * k + epsilon) / (mu * k + mu0 * k - epsilon)),
        low=t * math.log((2 * mu * k * rise - mu * k - mu0 * k + epsilon) / (mu * k - mu0 * k - epsilon)),
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
    whole = _log_ratio(mu * k + amplitude, mu * k - amplitude, "eq 21")
    dead = _log_ratio(mu * k - epsilon, mu * k - amplitude, "eq 22")
    return k, t, 0.5 * period * dead / whole


def _log_ratio(numerator: float, denominator: float, where: str) -> float:
    if not (denominator > 0.0 and numerator > denominator):
        raise IdentificationError(
            f"{where} needs the logarithm of {numerator:g}/{denominator:g}, which is not a ratio "
            "above 1: these numbers are not the limit cycle of a FOPDT process"
        )
    return math.log(numerator / denominator)


def steady_state(record: Record, settings: RelaySettings) -> tuple[float, bool]:
    """Return the measurement at rest [y], and whether it was measured.

    Before the first kick the command is the baseline; the mean of those samples is the steady
    state. Without any, the set-point stands in for it.

    :param record: the record.
    :param settings: its relay.
    """
    moved = np.flatnonzero(record.command != settings.baseline)
    resting = int(moved[0]) if moved.size else 0
    # The sample that was answered by the kick was itself taken at rest.
    if resting >= 1:
        return float(np.mean(record.measurement[: resting + 1])), True
    return settings.setpoint, False


@dataclass(frozen=True)
class _Features:
    """The limit cycle in coordinates in which the gain is positive."""

    cycle: FopdtCycle
    mean_y: float
    mean_u: float
    shift: float
    sign: int


def _features(
    cycle: LimitCycle, settings: RelaySettings, rest: float, means: tuple[float, float]
) -> _Features:
    sign = -1 if settings.reverse_acting else 1
    up, down = (cycle.period_high, cycle.period_low)[::sign]
    about = settings.setpoint
    return _Features(
        FopdtCycle(up, down, cycle.peak_max - about, cycle.peak_min - about),
        means[0] - rest,
        sign * (means[1] - settings.baseline),
        about - rest,
        sign,
    )


def identify_biased(record: Record) -> Identification:
    """Identify a FOPDT model from a biased relay test (eqs 6 to 11).

    Deviations are taken from the measured steady state; where the set-point lies elsewhere, the
    bias about it is ``mu0 - (setpoint - rest)/K``.

    :param record: a completed relay test with a bias.
    :raises IdentificationError: if the relay was unbiased, or the numbers are no limit cycle of a
        FOPDT process.
    """

    def solve(features: _Features, settings: RelaySettings) -> FloatArray:
        if abs(features.mean_u) < 0.02 * settings.amplitude:
            raise IdentificationError(
                f"the mean command is only {features.mean_u:g} away from the baseline, so that "
                "its ratio to the measurement (eq 6) tells no gain: use a biased relay, or the "
                "method wang_unbiased; an integrating process always has a mean of zero"
            )
        gain = features.mean_y / features.mean_u
        if not gain > 0.0:
            raise IdentificationError(
                f"the means over whole cycles give a gain of {gain:g} against the direction of "
                "the relay: the steady state before the test was not one, or the load changed"
            )
        bias = features.sign * settings.bias - features.shift / gain
        k, t, dead = fopdt_from_biased(
            features.cycle, gain, settings.amplitude, bias, settings.hysteresis
        )
        return np.array((features.sign * k, t, dead))

    def measure(part: Record, cycle: LimitCycle, rest: float) -> FloatArray:
        assert part.settings is not None
        return solve(_features(cycle, part.settings, rest, cycle_means(part)), part.settings)

    return _identify("wang_biased", record, measure)


def identify_unbiased(record: Record) -> Identification:
    """Identify a FOPDT model from an unbiased relay test (eqs 22 to 25).

    :param record: a completed relay test without bias.
    :raises IdentificationError: if the relay was biased, or no FOPDT process has the limit cycle.
    """

    def measure(part: Record, cycle: LimitCycle, rest: float) -> FloatArray:
        settings = part.settings
        assert settings is not None
        if abs(settings.bias) > 0.01 * settings.amplitude:
            raise IdentificationError(
                f"the relay had a bias of {settings.bias:g}, but eqs 19 to 25 hold for a "
                "symmetric one: use the method wang_biased"
            )
        point = frequency_point(part)
        amplitude = 0.5 * (cycle.peak_max - cycle.peak_min)
        k, t, dead = fopdt_from_unbiased(
            cycle.period, amplitude, abs(point.value), settings.amplitude, settings.hysteresis
        )
        return np.array((-k if settings.reverse_acting else k, t, dead))

    return _identify("wang_unbiased", record, measure)
