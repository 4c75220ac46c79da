# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Parts of a test that are left out, since a disturbance came in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from relay_autotune.errors import IdentificationError, RelayAutotuneError
from relay_autotune.identification.judgement.assessment import misfit
from relay_autotune.identification.result import Identification
from relay_autotune.record.cycles import cycles_of
from relay_autotune.record.record import Cycle, Record

# Ratio of residuals beyond the noise below which the end of a record alone is better, of the same
# samples: other amplitudes than those of the end show what is not linear.
_BETTER = 0.5

# Number of last cycles that are kept.
KEPT_CYCLES = 3


def _unexplained(found: Identification, record: Record, begin: int = 0) -> float:
    """Return a model's residual beyond the noise from some sample on, as an rms [y]."""
    noise = 0.0 if math.isnan(record.noise_std) else record.noise_std
    square = found.fit.residual_rms**2
    if begin and len(found.fitted) == len(record):
        square = float(np.nanmean((record.measurement - found.fitted)[begin:] ** 2))
    return math.sqrt(max(square - noise**2, 0.0))


def last_cycles(record: Record, cycles: tuple[Cycle, ...]) -> Record | None:
    """Return the end of a record, from the begin of its last cycles on.

    A load that came before them is then part of the offset.

    :param record: the record.
    :param cycles: its whole cycles.
    :return: the end; None where nothing would be left out.
    """
    starts = record.cycle_start
    if len(cycles) < KEPT_CYCLES + 1 or len(starts) < len(cycles) + 1:
        return None
    first = starts[-(KEPT_CYCLES + 1)]
    return record.part(first, len(record))


def without_disturbance(
    record: Record, identify: Callable[[Record], Identification]
) -> Identification:
    """Identify a record, or its end alone where that fits much better or the whole not at all.

    :param record: the record.
    :param identify: identifies a record by one method.
    :return: the better identification; a warning tells what it left out, and ``fitted`` is NaN
        there.
    :raises RelayAutotuneError: of the whole record, if its end is not explained either.
    """
    found: Identification | IdentificationError
    try:
        found = identify(record)
        if misfit(found, record) <= 1.0:
            return found
    except IdentificationError as error:
        found = error
    alone = _of_end(record, identify)
    if isinstance(found, IdentificationError):
        if alone is None:
            raise found
        return alone
    if alone is not None:
        begin = int(np.argmax(np.isfinite(alone.fitted))) if alone.fitted.size else 0
        if _unexplained(alone, record) < _BETTER * _unexplained(found, record, begin):
            return alone
    return found


def _of_end(record: Record, identify: Callable[[Record], Identification]) -> Identification | None:
    """Return what the last cycles alone show; None where they show nothing."""
    end = last_cycles(record, cycles_of(record))
    if end is None:
        return None
    try:
        alone = identify(end)
    except RelayAutotuneError:
        return None
    if alone.loaded:
        # An end that needs another load is no end after the load.
        return None
    left_out = len(record) - len(end)
    fitted = alone.fitted
    if len(fitted) == len(end):
        fitted = np.concatenate((np.full(left_out, math.nan), fitted))
    warning = (
        f"all before {record.time[left_out]:.4g} s is left out, since no model fits it together "
        f"with the last {KEPT_CYCLES} cycles: a load or another disturbance came"
    )
    # Its FOPDT has no samples of what is left out.
    return replace(alone, fitted=fitted, plain=None, warnings=(*alone.warnings, warning))
