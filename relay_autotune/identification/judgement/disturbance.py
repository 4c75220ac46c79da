# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Parts of a test that are left out, since a disturbance came in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.judgement.assessment import misfit
from relay_autotune.identification.result import Identification
from relay_autotune.record.record import Cycle, Record

# Ratio of residuals beyond the noise below which the end of a record alone is better.
_BETTER = 0.5

# Number of last cycles that are kept.
KEPT_CYCLES = 3


def _unexplained(found: Identification, record: Record) -> float:
    """Return a model's residual beyond the noise, as a root mean square [y]."""
    noise = 0.0 if math.isnan(record.noise_std) else record.noise_std
    return math.sqrt(max(found.fit.residual_rms**2 - noise**2, 0.0))


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
    found: Identification,
    record: Record,
    cycles: tuple[Cycle, ...],
    identify: Callable[[Record], Identification],
) -> Identification:
    """Identify the end of a record alone where that fits much better than the whole.

    :param found: what was identified from the whole record.
    :param record: the record.
    :param cycles: its whole cycles.
    :param identify: identifies a record by the same method.
    :return: the better identification; a warning tells what it left out, and ``fitted`` is NaN
        there.
    """
    end = last_cycles(record, cycles) if misfit(found, record) > 1.0 else None
    if end is None:
        return found
    try:
        alone = identify(end)
    except RelayAutotuneError:
        return found
    better = _unexplained(alone, record) < _BETTER * _unexplained(found, record)
    if alone.loaded or not better:
        # An end that needs another load is no end after the load.
        return found
    left_out = len(record) - len(end)
    fitted = alone.fitted
    if len(fitted) == len(end):
        fitted = np.concatenate((np.full(left_out, math.nan), fitted))
    warning = (
        f"all before {record.time[left_out]:.4g} s is left out, since no model fits it together "
        f"with the last {KEPT_CYCLES} cycles: a load or another disturbance came"
    )
    return replace(alone, fitted=fitted, warnings=(*alone.warnings, warning))
