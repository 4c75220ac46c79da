# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How far an identified model is to be trusted: its residual, its limit cycle, its rivals.

Every method's model is judged alike, on the record that it was identified from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from relay_autotune.errors import IdentificationError, ModelError, RecordError
from relay_autotune.identification.judgement.validation import (
    integrated_error,
    validate_fold,
)
from relay_autotune.identification.result import FitReport, Identification, Validation
from relay_autotune.identification.shown.fold import Fold, fold
from relay_autotune.identification.shown.steady_state import steady_state
from relay_autotune.identification.waveform.residuals import ljung_box, noise_to_signal
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record

_NEGLIGIBLE = 1e-10
# More different commands than these in a cycle are not those of a relay.
_LEVELS = 6


def assess(models: Sequence[Identification], record: Record) -> tuple[Identification, ...]:
    """Add to identified models how well each one agrees with the record.

    Each gets the comparison of its limit cycle with the record's (Thyagarajan and Yu 2003,
    Fig 9), its error from the first model over two decades about w_u (eqs 29 and 30), and, where
    its method did not look at all samples, the quality of its fit to them.

    :param models: of one record, the selected one first.
    :param record: the record.
    """
    seen, rest = _averaged(record), operating_point(record)
    return tuple(
        replace(
            found,
            fit=_fit(found, record, rest),
            validation=_validated(found.model, seen, record),
            integrated_error=_error_from(models[0], found),
        )
        for found in models
    )


def _fit(found: Identification, record: Record, rest: float) -> FitReport:
    if found.fitted.size == 0:
        return fit_of_model(found.model, record, rest)
    used = np.isfinite(found.fitted)
    residual = (record.measurement - found.fitted)[used]
    power, mean = noise_to_signal(residual, found.fitted[used] - rest)
    return replace(found.fit, noise_to_signal_power=power, noise_to_signal=mean)


def fit_of_model(model: TransferFunction, record: Record, rest: float) -> FitReport:
    """Return how well a model reproduces all samples of a record.

    Estimated with it are the offset and, for a self-regulating process, the command before the
    record: a record may begin with its first step.

    :param model: any; an unstable one, which no open loop follows, gets no estimates.
    :param record: any record.
    :param rest: measurement about which it moves [y].
    """
    if model.grows:
        return FitReport(noise_std=record.noise_std)
    y = record.measurement
    answer = response(model, record.time, record.input())
    unknown = [np.ones_like(y)]
    if model.integrators == 0:
        before = PiecewiseConstant(record.time[:1], np.zeros(1), initial=1.0)
        unknown.append(response(model, record.time, before))
    columns = np.column_stack(unknown)
    residual = y - answer
    residual = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
    rms = math.sqrt(float(np.mean(residual**2)))
    spread = float(np.std(y))
    exact = rms <= _NEGLIGIBLE * float(np.ptp(y))
    power, mean = noise_to_signal(residual, y - residual - rest)
    return FitReport(
        residual_rms=rms,
        noise_std=record.noise_std,
        fit=1.0 - rms / spread if spread > 0.0 else math.nan,
        whiteness_p=math.nan if exact else ljung_box(residual),
        noise_to_signal_power=power,
        noise_to_signal=mean,
    )


def operating_point(record: Record) -> float:
    """Return the measurement about which a record moves [y].

    It is the mean at rest, before the command first changes. Without such samples it is the
    set-point of a relay test, and the mean of any other record.

    :param record: any record.
    """
    if record.settings is not None:
        return steady_state(record, record.settings).value
    changes = record.input().times
    resting = record.time <= changes[0] if changes.size else np.ones(len(record), dtype=bool)
    return float(np.mean(record.measurement[resting] if resting.any() else record.measurement))


def _averaged(record: Record) -> Fold | None:
    # With a relay on the set-point, a controller answers with other commands in each sample: the
    # same relay on the model's command would make another oscillation.
    *_, first, last = (0, 0, *record.cycle_start)
    if np.unique(record.command[first:last]).size > _LEVELS:
        return None
    try:
        return fold(record)
    except (IdentificationError, RecordError):
        # Such as a step test: it has no limit cycle to compare with.
        return None


def _validated(model: TransferFunction, seen: Fold | None, record: Record) -> Validation | None:
    if seen is None:
        return None
    try:
        return validate_fold(model, seen, steady_state(record, seen.settings))
    except IdentificationError as error:
        return Validation(reason=str(error))


def _error_from(reference: Identification, found: Identification) -> float:
    if found is reference or not math.isfinite(reference.ultimate_frequency):
        return math.nan
    try:
        return integrated_error(found.model, reference.model, reference.ultimate_frequency)
    except ModelError:
        return math.nan
