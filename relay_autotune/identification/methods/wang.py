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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, stdtrit

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.shown.fold import Fold, as_switched, fold, fold_without
from relay_autotune.identification.shown.fourier import (
    UNKNOWN_REST,
    StaticGain,
    static_gain,
    steady_state,
)
from relay_autotune.identification.shown.limit_cycle import (
    NOT_SETTLED,
    RelayTest,
    known_gain,
    relay_test,
    require_unbiased,
)
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


_LEAST_CYCLES = 3
_MOST_PARTS = 20
# Standard deviations above an integrator's ratio beyond which noise does not explain a ratio.
_CERTAIN = 3.0
_LIKE_AN_INTEGRATOR = (
    "the peaks are those of an integrator's limit cycle, or noise makes them look like it: of "
    "gain and time constant hardly more than the ratio is known; a biased relay or the method "
    "waveform determines both"
)


@dataclass(frozen=True)
class _Facts:
    """The facts that are the same for all cycles.

    :param sign: +1, or -1 for a reverse-acting relay.
    :param gain: K [y/u], with its sign; NaN: to be found.
    :param rest: measurement at rest [y].
    :param ratio: amplitude of the measurement over that of the relay times the response at the
        fundamental; NaN: that of the cycles.
    """

    sign: int
    gain: float
    rest: float
    ratio: float = math.nan


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
    rest = steady_state(record, test.whole.settings)
    gain = (
        static_gain(test, rest)
        if math.isnan(known.gain)
        else StaticGain(known.gain, 0.0, math.inf)
    )
    sign = -1 if test.whole.settings.reverse_acting else 1
    if not sign * gain.value > 0.0:
        raise IdentificationError(
            f"a gain of {gain.value:g} is against the direction of the relay: the state before "
            "the test was not steady, the load changed, or the known gain has the wrong sign"
        )
    facts = _Facts(sign, gain.value, rest.value)
    uncertain = [replace(facts, gain=gain.value + gain.scatter)]
    if rest.measured:
        # A steady state that is a little higher makes the gain lower.
        lower = gain.value - rest.std / gain.excursion
        uncertain.append(replace(facts, gain=lower, rest=rest.value + rest.std))
    remark = "" if rest.measured else UNKNOWN_REST
    return _identified("wang_biased", test, record, _from_biased, facts, tuple(uncertain), remark)


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
    require_unbiased("wang_unbiased", test.whole.settings)
    sign = -1 if test.whole.settings.reverse_acting else 1
    known_gain(known, sign)
    facts = _Facts(sign, known.gain, math.nan)
    run = partial(_identified, "wang_unbiased", test, record, _from_unbiased)
    if not math.isnan(known.gain):
        return run(facts, (), "")
    try:
        found = run(facts, (), "")
    except IdentificationError:
        likely = _likely_ratio(test, record)
        if likely is None:
            raise
        ratio, std = likely
        remark = _LIKE_AN_INTEGRATOR
    else:
        likely = None
        if not bool(np.all(np.isfinite(found.covariance))):
            likely = _likely_ratio(test, record)
        if likely is None:
            return found
        (ratio, std), remark = likely, ""
    lower = replace(facts, ratio=ratio - std)
    return run(replace(facts, ratio=ratio), (lower,), remark)


def _likely_ratio(test: RelayTest, record: Record) -> tuple[float, float] | None:
    """Return expectation and scatter of the ratio, given that it is below an integrator's.

    :param test: the relay test.
    :param record: the record.
    :return: None where the cycles are too few, or the ratio is far above.
    """
    cycles = test.whole.cycle.cycles
    if len(cycles) < _LEAST_CYCLES:
        return None
    seen = _ratio(fold(record, cycles))
    parts = np.array([_ratio(part) for part in _without_each(record, cycles)])
    scatter = math.sqrt(float(np.var(parts)) * (len(cycles) - 1))
    room = INTEGRATOR_RATIO - seen
    if room > 0.0:
        return seen, scatter
    if not -room < _CERTAIN * scatter:
        return None
    # Mean and variance of a normal distribution below a limit.
    a = room / scatter
    beyond = math.exp(-0.5 * a * a) / (math.sqrt(2.0 * math.pi) * float(ndtr(a)))
    return seen - scatter * beyond, scatter * math.sqrt(1.0 - a * beyond - beyond**2)


def _ratio(seen: Fold) -> float:
    down, up = seen.peaks()
    return 0.5 * (up - down) / (as_switched(seen).amplitude * abs(seen.fundamental()))


def _without_each(record: Record, cycles: tuple[int, ...]) -> Iterator[Fold]:
    """Yield the averages that leave out one cycle each; of many cycles, not every one."""
    for left_out in cycles[:: -(-len(cycles) // _MOST_PARTS)]:
        yield fold_without(record, cycles, left_out)


def _from_biased(seen: Fold, facts: _Facts) -> FloatArray:
    # With the command turned round a reverse-acting process has a positive gain.
    settings, gain = as_switched(seen), facts.sign * facts.gain
    high, low = (seen.period_high, seen.period_low)[:: facts.sign]
    about = settings.setpoint
    down, up = (p - about + seen.settings.setpoint for p in seen.peaks())
    bias = facts.sign * settings.bias - (about - facts.rest) / gain
    cycle = FopdtCycle(high, low, up, down)
    k, t, dead = fopdt_from_biased(cycle, gain, settings.amplitude, bias, settings.hysteresis)
    return np.array((facts.sign * k, t, dead))


def _from_unbiased(seen: Fold, facts: _Facts) -> FloatArray:
    settings = as_switched(seen)
    down, up = seen.peaks()
    amplitude, period = 0.5 * (up - down), seen.period
    if math.isnan(facts.gain):
        response = abs(seen.fundamental())
        if not math.isnan(facts.ratio):
            response = amplitude / (settings.amplitude * facts.ratio)
        k, t, dead = fopdt_from_unbiased(
            period, amplitude, response, settings.amplitude, settings.hysteresis
        )
    else:
        k, t, dead = fopdt_with_gain(
            facts.sign * facts.gain, period, amplitude, settings.amplitude, settings.hysteresis
        )
    return np.array((facts.sign * k, t, dead))


_Measure = Callable[[Fold, _Facts], FloatArray]


def _identified(
    method: str,
    test: RelayTest,
    record: Record,
    measure: _Measure,
    facts: _Facts,
    uncertain: tuple[_Facts, ...],
    remark: str,
) -> Identification:
    """Measure on the averaged period, with the uncertainty by leaving out each cycle.

    :param uncertain: facts of which one each is off by its standard deviation.
    :param remark: for the user; may be empty.
    """
    settings = test.whole.settings
    cycles = test.whole.cycle.cycles
    whole = fold(record, cycles)

    def values(seen: Fold, known: _Facts) -> FloatArray:
        found = measure(seen, known)
        # The dead time that the relay added is not the process's.
        found[2] = max(found[2] - settings.extra_delay, 0.0)
        return found

    best = values(whole, facts)
    covariance = None
    if len(cycles) >= _LEAST_CYCLES:
        covariance = _jackknife(
            record, cycles, lambda part: values(part, facts), partly=method == "wang_biased"
        )
    if covariance is not None:
        for other in uncertain:
            covariance = covariance + _by(lambda known: values(whole, known), other, best)
    remarks = [remark, "" if test.whole.cycle.converged else NOT_SETTLED]
    return identified(
        method,
        Estimate.of(FOPDT, best, covariance),
        float(stdtrit(max(len(cycles) - 1, 1), 0.975)),
        warnings=tuple(r for r in remarks if r),
    )


def _jackknife(
    record: Record, cycles: tuple[int, ...], measure: Callable[[Fold], FloatArray], *, partly: bool
) -> FloatArray | None:
    """Return the covariance by leaving out one cycle after the other; None: too few solve.

    :param partly: True: some need not solve.
    """
    parts, tried = [], 0
    for part in _without_each(record, cycles):
        tried += 1
        try:
            parts.append(measure(part))
        except IdentificationError:
            # Without that cycle the numbers are no limit cycle; the others show the scatter.
            continue
    if len(parts) < (_LEAST_CYCLES if partly else tried):
        return None
    away = np.array(parts) - np.mean(parts, axis=0)
    return np.asarray(away.T @ away * (len(cycles) - 1) / len(parts))


def _by(
    measure: Callable[[_Facts], FloatArray], uncertain: _Facts, best: FloatArray
) -> FloatArray:
    """Return the covariance that one uncertain fact causes."""
    if math.isnan(uncertain.ratio) and not math.isfinite(uncertain.gain + uncertain.rest):
        return np.full((best.size, best.size), math.nan)
    try:
        change = measure(uncertain) - best
    except IdentificationError:
        # So far off no FOPDT process has the limit cycle: nothing bounds the error.
        return np.full((best.size, best.size), math.nan)
    return np.outer(change, change)
