# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `li`: gain, lags and dead time from several relay tests (Li et al. 1991).

Li, Eskinat and Luyben, "An Improved Autotune Identification Method", Ind. Eng. Chem. Res. 1991.
Where the gain of the process is not known, one test leaves one number open. A second test with a
known dead time Delta added to the relay oscillates more slowly and gives a second point: by the
describing function

    G(j w) = -(pi a/4 h) exp(j (w Delta + asin(epsilon/a))),   w = 2 pi/P,

with the hysteresis epsilon zero in the paper. A model is fitted to the points of all tests
jointly. By default it is fitted to periods and amplitudes themselves, which a model of lags
predicts exactly (Chang, Shen and Yu 1992, eqs 8 to 12 and 19 with a hysteresis).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, exact_steps, jacobian
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods.chang import gain_and_time_constant
from relay_autotune.identification.methods.lags import (
    MODEL_1,
    MODEL_4,
    MODEL_5,
    Solution,
    lags_of,
    level,
    model_asked_for,
    model_text,
    peak,
)
from relay_autotune.identification.methods.symmetric_method import alike, shape_misfit
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.shown.limit_cycle import (
    NOT_SETTLED,
    CycleReader,
    RelayTest,
    SymmetricCycle,
    features,
    relay_test,
    require_unbiased,
    skew_warning,
)
from relay_autotune.process.structures import Structure, equal_lags
from relay_autotune.record.record import Record

# Relative errors of a period and an amplitude read off a chart.
CHART_ERRORS = (0.002, 0.01)

_DEAD_TIMES = (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98)
_STARTS = 3
_SPREAD = 3.0
_PENALTY = 1e3
_TINY = 1e-30
_MOST_STEPS = 60
_LEAST_APART = 1e-3


@dataclass(frozen=True)
class JointFit:
    """A model fitted to several tests.

    :param solution: gain > 0 and time constants.
    :param dead_time: of the process [s].
    :param misfit: root mean square of the residuals, in units of the errors assumed.
    :param jacobian: derivatives of the residuals by gain, time constants and dead time, shape
        (2 m, p).
    """

    solution: Solution
    dead_time: float
    misfit: float
    jacobian: FloatArray


def describing_function_point(cycle: SymmetricCycle) -> tuple[float, complex]:
    """Return (w, G(j w)) of the process, by the describing function.

    :param cycle: a limit cycle whose ``dead_time`` is what was added to the relay.
    :raises IdentificationError: if the hysteresis is not below the amplitude.
    """
    if not cycle.hysteresis < cycle.amplitude:
        raise IdentificationError(
            f"an amplitude of {cycle.amplitude:g} is not above the hysteresis of "
            f"{cycle.hysteresis:g}, so that the relay cannot have switched: check the numbers"
        )
    size = math.pi * cycle.amplitude / (4.0 * cycle.relay)
    turn = cycle.frequency * cycle.dead_time + math.asin(cycle.hysteresis / cycle.amplitude)
    return cycle.frequency, -size * cmath.exp(1j * turn)


def fit_jointly(
    model: Structure,
    tests: Sequence[SymmetricCycle],
    dead_time: float = math.nan,
    *,
    exact: bool = True,
    errors: Sequence[tuple[float, float]] = (),
) -> JointFit:
    """Fit a model to the limit cycles of several tests.

    :param model: which one.
    :param tests: at least two; the ``dead_time`` of each is what was added to the relay.
    :param dead_time: of the process [s]; NaN: fitted.
    :param exact: False: to the points of the describing function.
    :param errors: relative errors of the period and the amplitude of each test, which weight
        them; default: ``CHART_ERRORS``.
    :raises IdentificationError: if the tests do not differ, or no such model comes near them.
    """
    require_difference(tests)
    errors = errors or (CHART_ERRORS,) * len(tests)
    longest = 0.999 * min(0.5 * t.period - t.dead_time for t in tests)
    fitted = math.isnan(dead_time)
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
    residuals = _exact_residuals if exact else _point_residuals

    def unpacked(theta: FloatArray) -> tuple[float, tuple[float, ...], float]:
        if not fitted:
            return math.exp(theta[0]), tuple(np.exp(theta[1:]).tolist()), dead_time
        delay = longest / (1.0 + math.exp(-theta[-1]))
        return math.exp(theta[0]), tuple(np.exp(theta[1:-1]).tolist()), delay

    def misfit(theta: FloatArray) -> FloatArray:
        gain, constants, delay = unpacked(np.clip(theta, -80.0, 80.0))
        return residuals(model, gain, constants, delay, tests, errors)

    starts = _starts(model, tests, longest, dead_time)
    ranked = sorted(starts, key=lambda s: float(np.sum(misfit(s) ** 2)))
    best = None
    for start in ranked[:_STARTS]:
        found = least_squares(
            misfit, start, xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=_MOST_STEPS
        )
        if best is None or found.cost < best.cost:
            best = found
        if best.cost < 1e-20:
            break
    if best is None:
        raise IdentificationError(
            f"{model_text(model)} has no such limit cycles at any dead time: the process is of "
            "another structure, or the numbers are wrong"
        )
    gain, constants, delay = unpacked(best.x)
    if model == MODEL_4:
        constants = tuple(sorted(constants, reverse=True))
    values = np.array((gain, *constants, delay))

    def of_values(v: FloatArray) -> FloatArray:
        return residuals(model, v[0], tuple(v[1:-1].tolist()), v[-1], tests, errors)

    sizes = 1e-5 * np.where(values == 0.0, values[1], values)
    derivatives = jacobian(of_values, values, *exact_steps(values, sizes, 0.0))
    if not fitted:
        derivatives[:, -1] = 0.0
    return JointFit(
        Solution(gain, constants),
        delay,
        math.sqrt(2.0 * best.cost / (2 * len(tests))),
        derivatives,
    )


def fits_jointly(
    tests: Sequence[SymmetricCycle],
    dead_time: float = math.nan,
    *,
    errors: Sequence[tuple[float, float]] = (),
) -> list[tuple[Structure, JointFit]]:
    """Fit models 1 to 5, and return those that agree with all tests, the simplest first.

    If none does, the one that comes nearest.

    :param tests: as for :func:`fit_jointly`.
    :param dead_time: of the process [s]; NaN: fitted.
    :param errors: as for :func:`fit_jointly`.
    :raises IdentificationError: if no model can be fitted.
    """
    fits: list[tuple[Structure, JointFit]] = []
    refusal: IdentificationError | None = None
    for model in (MODEL_1, equal_lags(2), equal_lags(3), MODEL_4, MODEL_5):
        try:
            fits.append((model, fit_jointly(model, tests, dead_time, errors=errors)))
        except IdentificationError as error:
            refusal = refusal or error
    if not fits:
        assert refusal is not None
        raise refusal
    agreeing = [f for f in fits if f[1].misfit <= AGREEMENT]
    return agreeing or [min(fits, key=lambda f: f[1].misfit)]


# Largest misfit that is agreement, in assumed errors.
AGREEMENT = 2.0


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


def _exact_residuals(
    model: Structure,
    gain: float,
    constants: tuple[float, ...],
    dead_time: float,
    tests: Sequence[SymmetricCycle],
    errors: Sequence[tuple[float, float]],
) -> FloatArray:
    """Return how far periods and amplitudes are from the model's, to first order."""
    lags = lags_of(model, constants)
    found = []
    for test, (period_error, amplitude_error) in zip(tests, errors, strict=True):

        def excess(period: float, test: SymmetricCycle = test) -> float:
            part = 1.0 - 2.0 * (dead_time + test.dead_time) / period
            return level(lags, period, max(part, 0.0)) - test.level / (gain * test.relay)

        # The level at the switch grows with the period that is given to a model.
        step = 1e-4
        rise = (excess(test.period * (1 + step)) - excess(test.period * (1 - step))) / (2 * step)
        missed = excess(test.period) / max(rise, 1e-9)
        found.append(min(max(missed / period_error, -_PENALTY), _PENALTY))
        # The response of extremely long lags is below rounding.
        amplitude = max(gain * test.relay * peak(lags, test.period), _TINY * test.amplitude)
        found.append(math.log(amplitude / test.amplitude) / amplitude_error)
    return np.array(found)


def _point_residuals(
    model: Structure,
    gain: float,
    constants: tuple[float, ...],
    dead_time: float,
    tests: Sequence[SymmetricCycle],
    errors: Sequence[tuple[float, float]],
) -> FloatArray:
    """Return how far the logarithms of G are from the describing function's points."""
    found = []
    for test, (_, amplitude_error) in zip(tests, errors, strict=True):
        w, point = describing_function_point(test)
        size, phase = gain, -w * dead_time
        for tau in lags_of(model, constants):
            size /= math.hypot(1.0, w * tau)
            phase -= math.atan(w * tau)
        wanted = -math.pi + math.remainder(cmath.phase(-point), 2.0 * math.pi)
        found.append(math.log(size / abs(point)) / amplitude_error)
        found.append((phase - wanted) / amplitude_error)
    return np.array(found)


def _starts(
    model: Structure, tests: Sequence[SymmetricCycle], longest: float, dead_time: float
) -> list[FloatArray]:
    """Return points to begin from: each agrees with one test, for equal lags."""
    shares = _DEAD_TIMES if math.isnan(dead_time) else (math.nan,)
    starts = []
    for share in shares:
        delay = dead_time if math.isnan(share) else share * longest
        for test in tests:
            try:
                gain, tau = gain_and_time_constant(
                    model.order,
                    test.period,
                    test.amplitude,
                    delay + test.dead_time,
                    test.relay,
                    test.level,
                )
            except IdentificationError:
                continue
            tail = [] if math.isnan(share) else [math.log(share / (1.0 - share))]
            log_tau = math.log(tau)
            if model.equal_lags:
                starts.append(np.array([math.log(gain), log_tau, *tail]))
                continue
            for spread in (_SPREAD, 1.0 / _SPREAD):
                pair = [log_tau + math.log(spread), log_tau - math.log(spread)]
                starts.append(np.array([math.log(gain), *pair, *tail]))
    return starts


METHOD = "li"

# Least relative errors of averages over cycles, whatever their scatter: a sampled relay's limit
# cycle is not quite that of an ideal one.
_LEAST_PERIOD_ERROR = 2e-4
_LEAST_AMPLITUDE_ERROR = 1e-3
_SHARE_OF_INTERVAL = 0.3
_RAISED = 0.5


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
    tests = [relay_test(METHOD, record) for record in records]
    settings = [test.whole.settings for test in tests]
    for each in settings:
        require_unbiased(METHOD, each)
    if len({each.reverse_acting for each in settings}) > 1:
        raise IdentificationError(
            "one of the tests had a reverse-acting relay and another did not: they are not of "
            "one process"
        )
    cycles = [CycleReader.of(test.whole).read(test.whole, 0.0) for test in tests]
    require_difference(cycles)
    errors = [_errors(test) for test in tests]
    candidates = _fits(cycles, known, errors)
    away = [_shape_misfit(tests, cycles, *candidate) for candidate in candidates]
    model, fit = next(c for c, a in zip(candidates, away, strict=True) if alike(a, min(away)))
    values = fit.solution.values(-1 if settings[0].reverse_acting else 1, fit.dead_time)
    degrees = sum(len(test.singles) - 1 for test in tests)
    return identified(
        METHOD,
        Estimate.of(model, values, _covariance(fit) if degrees > 0 else None),
        float(stdtrit(max(degrees, 1), 0.975)),
        warnings=(*_warnings(tests), *_remarks(model, cycles, known, fit)),
    )


def li_from_numbers(cycles: Sequence[SymmetricCycle], known: Known) -> Identification:
    """Identify one of models 1 to 5, with its gain, from the numbers of several limit cycles.

    :param cycles: limit cycles of unbiased relays; the ``dead_time`` of each is what was added
        to the relay.
    :param known: dead time, structure and order where they are known.
    :raises IdentificationError: if they do not differ, or no model agrees with them.
    """
    model, fit = _fits(cycles, known, ())[0]
    return identified(
        METHOD,
        Estimate.of(model, fit.solution.values(1, fit.dead_time)),
        warnings=tuple(_remarks(model, cycles, known, fit)),
    )


def _fits(
    cycles: Sequence[SymmetricCycle], known: Known, errors: Sequence[tuple[float, float]]
) -> list[tuple[Structure, JointFit]]:
    model = model_asked_for(METHOD, known)
    if model is None:
        return fits_jointly(cycles, known.dead_time, errors=errors)
    return [(model, fit_jointly(model, cycles, known.dead_time, errors=errors))]


def _shape_misfit(
    tests: Sequence[RelayTest], cycles: Sequence[SymmetricCycle], model: Structure, fit: JointFit
) -> float:
    """Return how far the half cycles of all tests are from a model's, over their amplitudes."""
    squares = 0.0
    for test, cycle in zip(tests, cycles, strict=True):
        delayed = replace(cycle, dead_time=fit.dead_time + cycle.dead_time)
        away = shape_misfit(test.whole, model, delayed, fit.solution)
        squares += (away / cycle.amplitude) ** 2
    return math.sqrt(squares)


def _errors(test: RelayTest) -> tuple[float, float]:
    """Relative errors of the averaged period and amplitude."""
    whole = test.whole
    values = features(whole)
    interval = whole.record.interval
    covariance, _ = test.scatter(features)
    spread = np.zeros(2) if covariance is None else np.sqrt(np.diag(covariance))
    period, amplitude = (spread / values).tolist()
    # Noise makes every peak higher, which the scatter does not show.
    noise = whole.record.noise_std
    raised = _RAISED * noise / float(values[1]) if math.isfinite(noise) else 0.0
    return (
        max(period, _SHARE_OF_INTERVAL * interval / float(values[0]), _LEAST_PERIOD_ERROR),
        max(amplitude, raised, _LEAST_AMPLITUDE_ERROR),
    )


def _covariance(fit: JointFit) -> FloatArray:
    """Return the covariance of the values; zero for those that were not fitted."""
    size = np.linalg.norm(fit.jacobian, axis=0)
    fitted = size > 0.0
    scaled = fit.jacobian[:, fitted] / size[fitted]
    covariance = np.zeros((size.size, size.size))
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-14, hermitian=True)
    covariance[np.ix_(fitted, fitted)] = inverse / np.outer(size[fitted], size[fitted])
    # A misfit above 1 shows that the assumed errors were too small.
    return covariance * max(fit.misfit, 1.0) ** 2


def _warnings(tests: Sequence[RelayTest]) -> list[str]:
    found = []
    for number, test in enumerate(tests, start=1):
        remarks = [skew_warning(test.whole), "" if test.whole.cycle.converged else NOT_SETTLED]
        found += [f"test {number}: {remark}" for remark in remarks if remark]
    return found


def _remarks(
    model: Structure, cycles: Sequence[SymmetricCycle], known: Known, fit: JointFit
) -> list[str]:
    """Return how well the tests agree, and what the paper's describing function gives."""
    found = []
    if not math.isnan(known.gain):
        found.append("the gain given was not used: li finds it from the tests")
    if fit.misfit > AGREEMENT:
        found.append(
            f"the tests do not agree with {model_text(model)}: periods and amplitudes miss it by "
            f"{fit.misfit:.2g} times their errors; the process is of another structure, or "
            "changed between the tests"
        )
    try:
        literal = fit_jointly(model, cycles, known.dead_time, exact=False)
    except IdentificationError:
        return found
    found.append(
        f"by the describing function, as in the paper, the tests would give K = "
        f"{literal.solution.gain:.4g}, {literal.solution}, dead time {literal.dead_time:.4g} s"
    )
    return found
