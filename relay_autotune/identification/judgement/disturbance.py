# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Leave out the part of a record that a disturbance has made useless."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.judgement.quality import is_contradicted, misfit
from relay_autotune.identification.result import Identification
from relay_autotune.record.record import Cycle, Record

# Ratio of residuals beyond the noise below which the end of a record alone is better.
_BETTER = 0.5

# Structures in which a load is searched for; empty: the one that was found without a load.
_SIMPLE = ("sopdt", "", "fopdt")

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
    if not _unexplained(alone, record) < _BETTER * _unexplained(found, record):
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


def with_its_load(
    found: Identification,
    record: Record,
    cycles: tuple[Cycle, ...],
    identify: Callable[[Record, str], Identification],
) -> tuple[Identification, Record]:
    """Estimate a load step together with the model, where no model fits without one.

    It is searched for in a simple structure first: a model that was fitted without the load has
    adapted to it.

    :param found: what was identified.
    :param record: the record.
    :param cycles: its whole cycles.
    :param identify: identifies a record in a structure by the method that fits samples; "": it
        chooses the structure.
    :return: the identification, and the record with the load added to its command; those given,
        where a load does not explain the misfit.
    """
    relay = record.settings is not None and bool(cycles)
    samples = relay and len(found.fitted) == len(record)
    if not samples or record.continuous_command or not is_contradicted(found, record):
        return found, record
    # Imported here, since few records need it.
    from relay_autotune.identification.judgement.load import identify_with_load

    for structure in _SIMPLE:
        try:
            start = identify(record, structure) if structure else found
            chosen = identify_with_load(start, record, lambda part: identify(part, ""))
        except RelayAutotuneError:
            continue
        if chosen is not None and not is_contradicted(chosen[0], record):
            return chosen
    return found, record
