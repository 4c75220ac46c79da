"""The method `li`: gain, lags and dead time from several relay tests (Li et al. 1991)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods.lag_models import model_asked_for, model_text
from relay_autotune.identification.methods.li1991 import (
    AGREEMENT,
    JointFit,
    fit_jointly,
    fits_jointly,
    require_difference,
)
from relay_autotune.identification.methods.symmetric_method import alike, shape_misfit
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.shown.cycle_scatter import NOT_SETTLED, RelayTest, relay_test
from relay_autotune.identification.shown.symmetric_cycle import (
    CycleReader,
    SymmetricCycle,
    features,
    require_unbiased,
    skew_warning,
)
from relay_autotune.process.structures import Structure
from relay_autotune.record.record import Record

FloatArray = NDArray[np.float64]

METHOD = "li"

# Averages over cycles are hardly better than this, whatever their scatter: a sampled relay's
# limit cycle is not quite that of an ideal one.
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
    tests: Sequence[RelayTest],
    cycles: Sequence[SymmetricCycle],
    model: Structure,
    fit: JointFit,
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
    """Covariance of the values; what was not fitted has none."""
    size = np.linalg.norm(fit.jacobian, axis=0)
    fitted = size > 0.0
    scaled = fit.jacobian[:, fitted] / size[fitted]
    covariance = np.zeros((size.size, size.size))
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-14, hermitian=True)
    covariance[np.ix_(fitted, fitted)] = inverse / np.outer(size[fitted], size[fitted])
    # Errors that were assumed too small show in the misfit.
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
    """Say how well the tests agree, and what the paper's describing function gives."""
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
