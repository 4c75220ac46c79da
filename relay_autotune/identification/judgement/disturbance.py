# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Parts of a test that are left out, since a disturbance came in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from relay_autotune.errors import IdentificationError, RelayAutotuneError
from relay_autotune.identification.result import Identification
from relay_autotune.record.cycles import cycles_of
from relay_autotune.record.record import Record

# Number of last cycles that are kept.
KEPT_CYCLES = 3


def last_cycles(record: Record) -> Record | None:
    """Return the end of a record, from the begin of its last cycles on.

    A load that came before them is then part of the offset.

    :param record: the record.
    :return: the end; None where nothing would be left out.
    """
    starts, cycles = record.cycle_start, cycles_of(record)
    if len(cycles) < KEPT_CYCLES + 1 or len(starts) < len(cycles) + 1:
        return None
    first = starts[-(KEPT_CYCLES + 1)]
    return record.part(first, len(record))


def without_disturbance(
    record: Record, identify: Callable[[Record], Identification]
) -> Identification:
    """Identify a record, or its last cycles alone where all of it shows no response.

    :param record: the record.
    :param identify: identifies a record by one method.
    :return: the identification; a warning tells what it left out, and ``fitted`` is NaN there.
    :raises RelayAutotuneError: of the whole record, if its end is not explained either.
    """
    try:
        return identify(record)
    except IdentificationError:
        alone = _of_end(record, identify)
        if alone is None:
            raise
        return alone


def _of_end(record: Record, identify: Callable[[Record], Identification]) -> Identification | None:
    """Return what the last cycles alone show; None where they show nothing."""
    end = last_cycles(record)
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
