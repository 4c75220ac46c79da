# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `li`: gain, lags and dead time from several relay tests (Li et al. 1991).

Li, Eskinat and Luyben, "An Improved Autotune Identification Method", Ind. Eng. Chem. Res. 1991.
Where the gain of the process is not known, one test leaves one number open. A second test with a
known dead time Delta added to the relay oscillates more slowly and gives a second point: by the
describing function

    G(j w) = -(pi a/4 h) exp(j (w Delta + asin(epsilon/a))),   w = 2 pi/P,

with the hysteresis epsilon zero in the paper, where a model is fitted to the points of all tests.
Here it is fitted to periods and amplitudes themselves, which a model of lags predicts exactly
(Chang, Shen and Yu 1992, eqs 8 to 12 and 19 with a hysteresis).
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import Reading
from relay_autotune.identification.limit_cycle.limit_cycle import (
    CHART_ERRORS,
    RelayTest,
    SymmetricCycle,
    relay_test,
)
from relay_autotune.identification.methods.chang import alike, shape_misfit
from relay_autotune.identification.methods.lags import STRUCTURES, equal, level, model_text, peak
from relay_autotune.identification.methods.solved import Fit, literally, structure_asked_for
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import FOPDT, SOPDT, TWO_EQUAL_ONE, Structure, equal_lags
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record

METHOD = "li"
# Largest misfit that is agreement, in assumed errors.
AGREEMENT = 2.0

_DEAD_TIMES = (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98)
_SPREAD = 3.0
_PENALTY = 1e3
_TINY = 1e-30
_LEAST_APART = 1e-3
# Least relative errors of averages over cycles, whatever their scatter: a sampled relay's limit
# cycle is not quite that of an ideal one.
_LEAST_PERIOD_ERROR = 2e-4
_LEAST_AMPLITUDE_ERROR = 1e-3
_SHARE_OF_INTERVAL = 0.3


_CHOICE = (FOPDT, equal_lags(2), equal_lags(3), SOPDT, TWO_EQUAL_ONE)


@dataclass(frozen=True)
class JointFit:
    """A model fitted to several tests.

    :param model: its structure.
    :param values: of its parameters, shape (p,).
    :param misfit: root mean square of the residuals, in units of the errors assumed.
    :param covariance: of the values; zero for those that were not fitted, shape (p, p).
    """

    model: Structure
    values: FloatArray
    misfit: float
    covariance: FloatArray


def describing_function_point(cycle: SymmetricCycle) -> tuple[float, complex]:
    """Return (w, G(j w)) of the process, by the describing function.

    :param cycle: a limit cycle whose ``dead_time`` is what was added to the relay.
    :raises IdentificationError: if the hysteresis is not below the amplitude.
    """
    cycle.require_switching()
    size = math.pi * cycle.amplitude / (4.0 * cycle.relay)
    turn = cycle.frequency * cycle.dead_time + math.asin(cycle.level / cycle.amplitude)
    return cycle.frequency, -size * cmath.exp(1j * turn)


def fit_jointly(
    model: Structure,
    tests: Sequence[SymmetricCycle],
    dead_time: float = math.nan,
    *,
    exact: bool = True,
    sign: int = 1,
) -> JointFit:
    """Fit a model to the limit cycles of several tests.

    :param model: which one.
    :param tests: at least two; the ``dead_time`` of each is what was added to the relay. Their
        ``errors`` weight them.
    :param dead_time: of the process [s]; NaN: fitted.
    :param exact: False: to the points of the describing function.
    :param sign: of the gain.
    :raises IdentificationError: if the tests do not differ, or no such model comes near them.
    """
    require_difference(tests)
    longest = 0.999 * min(0.5 * t.period - t.dead_time for t in tests)
    if not longest > 0.0:
        raise IdentificationError(
            "the dead time added is more than half the period of its test, in which a switch "
            "must take effect: the numbers are wrong"
        )
    if dead_time >= longest:
        raise IdentificationError(
            f"a dead time of {dead_time:g} s, beside the one added, leaves less than half a "
            f"period for a switch to take effect: it must be below {longest:g} s"
        )
    measure = _of_cycle if exact else _of_point
    # A point is as uncertain as its amplitude, in its phase too; both are as those of a chart.
    deviations = np.array([t.errors if exact else CHART_ERRORS[1:] * 2 for t in tests]).ravel()

    def residual(values: FloatArray) -> FloatArray:
        away = [each for test in tests for each in measure(model, values, test)]
        return np.clip(np.array(away) / deviations, -_PENALTY, _PENALTY)

    given = np.full(len(model.names), math.nan)
    given[-1] = dead_time
    unit = 1.0 / max(test.frequency for test in tests)
    fit = Fit(model, given, sign, residual, unit, longest)
    starts = list(_starts(model, tests, longest, dead_time))
    if not starts:
        raise IdentificationError(
            f"{model_text(model)} has no such limit cycles at any dead time: the process is of "
            "another structure, or the numbers are wrong"
        )
    cost, x = fit.best(starts)
    values = fit.values(x)
    if model == SOPDT:
        values[1:3] = max(values[1:3]), min(values[1:3])
    misfit = math.sqrt(cost / deviations.size)
    # A misfit above 1 shows that the assumed errors were too small.
    covariance = fit.covariance(fit.searched(values)) * max(misfit, 1.0) ** 2
    return JointFit(model, values, misfit, covariance)


def fits_jointly(tests: Sequence[SymmetricCycle], known: Known, sign: int = 1) -> list[JointFit]:
    """Fit the structure that is known, or models 1 to 5, and return those that agree.

    They agree with all tests, the simplest first; if none does, it is the one that comes nearest.

    :param tests: as for :func:`fit_jointly`.
    :param known: structure, order and dead time where they are known.
    :param sign: of the gain.
    :raises IdentificationError: if no model can be fitted.
    """
    fits: list[JointFit] = []
    refusals: list[IdentificationError] = []
    asked = structure_asked_for(METHOD, known, STRUCTURES)
    for model in (asked,) if asked else _CHOICE:
        try:
            fits.append(fit_jointly(model, tests, known.dead_time, sign=sign))
        except IdentificationError as error:
            refusals.append(error)
    if not fits:
        raise refusals[0]
    agreeing = [fit for fit in fits if fit.misfit <= AGREEMENT]
    return agreeing or [min(fits, key=lambda fit: fit.misfit)]


def require_difference(tests: Sequence[SymmetricCycle]) -> None:
    """Refuse tests that do not differ in the dead time added to the relay.

    :raises IdentificationError: if there are fewer than two, or all have the same dead time
        added.
    """
    if len(tests) < 2:
        raise IdentificationError(
            "li needs two relay tests of one process, one of them with a dead time added to the "
            "relay (its extra_delay), and there is one: record another, or use the method chang"
        )
    added = [t.dead_time for t in tests]
    if max(added) - min(added) < _LEAST_APART * min(t.period for t in tests):
        raise IdentificationError(
            f"the tests all have the same dead time added, {added[0]:g} s, so that the second "
            "adds nothing: add one to the relay (its extra_delay) in one of them, such as a "
            "quarter of the period"
        )


def _of_cycle(model: Structure, values: FloatArray, test: SymmetricCycle) -> tuple[float, float]:
    """Return how far period and amplitude are from the model's, relatively and to first order."""
    gain, *constants, dead_time = np.abs(values).tolist()
    lags = tuple(t.real for t in model.build((gain, *constants, dead_time)).time_constants)

    def excess(period: float) -> float:
        part = 1.0 - 2.0 * (dead_time + test.dead_time) / period
        return level(lags, period, max(part, 0.0)) - test.level / (gain * test.relay)

    # The level at the switch grows with the period that is given to a model.
    step = 1e-4
    rise = (excess(test.period * (1 + step)) - excess(test.period * (1 - step))) / (2 * step)
    # The response of extremely long lags is below rounding.
    amplitude = max(gain * test.relay * peak(lags, test.period), _TINY * test.amplitude)
    return excess(test.period) / max(rise, 1e-9), math.log(amplitude / test.amplitude)


def _of_point(model: Structure, values: FloatArray, test: SymmetricCycle) -> tuple[float, float]:
    """Return how far the logarithm of G is from that of the describing function's point."""
    w, point = describing_function_point(test)
    away = cmath.log(complex(model.build(np.abs(values))(1j * w)) / point)
    return away.real, away.imag


def _starts(
    model: Structure, tests: Sequence[SymmetricCycle], longest: float, dead_time: float
) -> Iterator[FloatArray]:
    """Return values to begin from: each agrees with one test, for equal lags."""
    delays = [dead_time] if dead_time >= 0.0 else [share * longest for share in _DEAD_TIMES]
    spreads = (
        ((1.0,),) if model.equal_lags else ((_SPREAD, 1.0 / _SPREAD), (1.0 / _SPREAD, _SPREAD))
    )
    for delay, test in itertools.product(delays, tests):
        with suppress(IdentificationError):
            gain, tau = equal(model.order, replace(test, dead_time=delay + test.dead_time))
            yield from (np.array((gain, *(tau * s for s in each), delay)) for each in spreads)


def identify_li(record: Record, known: Known = NOTHING) -> Identification:
    """Refuse a single record; several are for :func:`identify_li_jointly`.

    :param record: a relay test.
    :param known: what is known of the process.
    :raises IdentificationError: always, with what to do.
    """
    return identify_li_jointly((record,), known)


def identify_li_jointly(records: Sequence[Record], known: Known = NOTHING) -> Identification:
    """Identify one of models 1 to 5, with its gain, from several unbiased relay tests.

    :param records: relay tests of one process without bias, at least two, with different
        ``extra_delay``.
    :param known: dead time, structure and order where they are known; the gain is found.
    :raises IdentificationError: if there are too few tests, one was biased, they do not differ,
        or no model agrees with them.
    """
    tests = [relay_test(METHOD, record, unbiased=True) for record in records]
    if len({test.sign for test in tests}) > 1:
        raise IdentificationError(
            "one of the tests had a reverse-acting relay and another did not: they are not of "
            "one process"
        )
    readings = [test.read(lambda *_, test=test: test.settings.extra_delay) for test in tests]
    cycles = [_cycle(*pair) for pair in zip(tests, readings, strict=True)]
    remarks = [
        f"test {number}: {remark}"
        for number, test in enumerate(tests, start=1)
        for remark in test.remarks()
    ]
    return _identified(cycles, known, tests, readings, remarks)


def li_from_numbers(cycles: Sequence[SymmetricCycle], known: Known) -> Identification:
    """Identify one of models 1 to 5, with its gain, from the numbers of several limit cycles.

    :param cycles: limit cycles of unbiased relays; the ``dead_time`` of each is what was added
        to the relay.
    :param known: dead time, structure and order where they are known.
    :raises IdentificationError: if they do not differ, or no model agrees with them.
    """
    return _identified(cycles, known)


def _identified(
    cycles: Sequence[SymmetricCycle],
    known: Known,
    tests: Sequence[RelayTest] = (),
    readings: Sequence[Reading] = (),
    remarks: Sequence[str] = (),
) -> Identification:
    candidates = fits_jointly(cycles, known, tests[0].sign if tests else 1)
    away = [_shape_misfit(tests, cycles, candidate) for candidate in candidates]
    fit = next(c for c, a in zip(candidates, away, strict=True) if alike(a, min(away)))
    known_scatter = any(read.covariance is not None for read in readings)
    averaged = sum(read.cycles - 1 for read in readings) + 1
    return identified(
        METHOD,
        Estimate.of(fit.model, fit.values, fit.covariance if known_scatter else None),
        Reading(fit.values, None, averaged).quantile,
        warnings=(*remarks, *_remarks(cycles, known.dead_time, fit)),
    )


def _shape_misfit(
    tests: Sequence[RelayTest], cycles: Sequence[SymmetricCycle], fit: JointFit
) -> float:
    """Return how far the half cycles of all tests are from a model's, over their amplitudes."""
    process = fit.model.build(np.abs(fit.values))

    def late(cycle: SymmetricCycle) -> TransferFunction:
        return replace(process, dead_time=process.dead_time + cycle.dead_time)

    return math.hypot(*(shape_misfit(t, late(c), c) for t, c in zip(tests, cycles, strict=False)))


def _cycle(test: RelayTest, read: Reading) -> SymmetricCycle:
    """Return the averaged limit cycle, with the relative errors of period and amplitude."""
    period, amplitude, level, added = read.values.tolist()
    scatter = np.nan_to_num(read.std[:2]) / read.values[:2]
    sampled = _SHARE_OF_INTERVAL * test.record.interval / period
    errors = (
        max(float(scatter[0]), sampled, _LEAST_PERIOD_ERROR),
        max(float(scatter[1]), _LEAST_AMPLITUDE_ERROR),
    )
    return SymmetricCycle(period, amplitude, test.settings.amplitude, level, added, errors)


def _remarks(cycles: Sequence[SymmetricCycle], dead_time: float, fit: JointFit) -> list[str]:
    """Return how well the tests agree, and what the paper's describing function gives."""
    found = []
    if fit.misfit > AGREEMENT:
        found.append(
            f"the tests do not agree with {model_text(fit.model)}: periods and amplitudes miss it "
            f"by {fit.misfit:.2g} times their errors; the process is of another structure, or "
            "changed between the tests"
        )
    sign = 1 if fit.values[0] > 0.0 else -1
    return found + literally(
        "the equations of the describing function",
        fit.model,
        lambda: fit_jointly(fit.model, cycles, dead_time, exact=False, sign=sign).values.tolist(),
        fit.values,
    )
