# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Cycles of a relay experiment: their features, their agreement, their averages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import RecordError
from relay_autotune.quantities import told
from relay_autotune.record.foreign import find_cycles, settings_of
from relay_autotune.record.record import Cycle, CycleFeatures, Outcome, Record, asked_once

__all__ = [
    "MIN_CYCLES",
    "TOLERANCE",
    "LimitCycle",
    "agree",
    "cycle_from_samples",
    "cycles_of",
    "find_cycles",
    "limit_cycle",
    "next_cycle",
    "settings_of",
]

MIN_CYCLES = 3
TOLERANCE = 0.02

# A pause between samples is a gap if it is longer than 5 median intervals and than a twentieth of
# the cycle.
_GAP_INTERVALS = 5.0
_GAP_SHARE = 0.05

# Allowance of `agree` for noise, in standard deviations.
_NOISE_MARGIN = 3.0


def cycle_from_samples(
    index: int,
    time: FloatArray,
    measurement: FloatArray,
    command: FloatArray,
    *,
    middle: float,
    reverse_acting: bool,
) -> Cycle:
    """Compute the features of one whole cycle from its samples.

    The first sample is the one answered by the switch to the high level. The last sample begins
    the next cycle: it bounds the last interval and is not part of this cycle. The mean of the
    measurement uses straight lines between the samples, the mean of the command the held command
    (Wang, Hang & Zou 1997, eq 6, needs both).

    Noise may make the relay switch back and forth for a moment. So the switch to the low level is
    the one before the longest stay there, and ``period_high`` and ``period_low`` are the total
    times at each level.

    :param index: number of the cycle.
    :param time: instants of the samples [s], shape (n,), n >= 2, not decreasing.
    :param measurement: the samples [y], shape (n,).
    :param command: the answers to all but the last [u], shape (n - 1,).
    :param middle: a command between the two levels [u].
    :param reverse_acting: True if the high level lowers the measurement.
    :raises RecordError: if there are fewer than two samples.
    """
    if len(time) < 2:
        raise RecordError(
            f"a cycle needs its samples and the first of the next, at least 2, found {len(time)}"
        )
    interval = np.diff(time)
    period = float(time[-1] - time[0])
    high = command > middle
    period_high = float(np.sum(interval[high]))
    if period > 0.0:
        mean_measurement = float(
            np.sum(0.5 * (measurement[:-1] + measurement[1:]) * interval) / period
        )
        mean_command = float(np.sum(command * interval) / period)
    else:
        mean_measurement = float(np.mean(measurement[:-1]))
        mean_command = float(np.mean(command))
    down = _longest_low(time, high)
    # Search the extremes without the first sample of the next cycle, each from the switch that
    # leads to it.
    y = measurement[:-1]
    raised, lowered = (0, down) if reverse_acting else (down, 0)
    top = raised + int(np.argmax(y[raised:]))
    bottom = lowered + int(np.argmin(y[lowered:]))
    gap = float(np.max(interval))
    return Cycle(
        index=index,
        start=float(time[0]),
        period=period,
        period_high=period_high,
        period_low=max(0.0, period - period_high),
        peak_max=float(np.max(y)),
        peak_min=float(np.min(y)),
        time_to_peak_max=float(time[top] - time[raised]),
        time_to_peak_min=float(time[bottom] - time[lowered]),
        mean_measurement=mean_measurement,
        mean_command=mean_command,
        disturbed=gap > max(_GAP_INTERVALS * float(np.median(interval)), _GAP_SHARE * period),
    )


def _longest_low(time: FloatArray, high: np.ndarray) -> int:
    """Return the first sample of the longest stay at the low level, 0 if there is none."""
    edges = np.diff(high.astype(np.int8))
    begins = np.flatnonzero(edges == -1) + 1
    if begins.size == 0:
        return 0
    ends = np.append(np.flatnonzero(edges == 1) + 1, high.size)
    ends = ends[ends > begins[0]]
    return int(begins[np.argmax(time[ends] - time[begins])])


def agree(cycles: Sequence[Cycle], noise_std: float, interval: float, tolerance: float) -> bool:
    """Return True if the half periods and the peaks of some cycles agree.

    The allowed difference between the largest and the smallest is

    - half periods: ``tolerance`` of their mean, plus two sample intervals, plus three standard
      deviations of the noise divided by the slope of the measurement on its slower way;
    - peaks: ``tolerance`` of the amplitude (half of peak to peak), plus the change of the
      measurement in two sample intervals on its faster way, plus three standard deviations of the
      noise.

    A sampled relay switches up to one interval late at both ends of a half period. So even the
    limit cycle varies within two intervals. The slopes are peak to peak over the shorter and the
    longer half period.

    :param cycles: the cycles to compare, at least one.
    :param noise_std: standard deviation of the measurement noise [y]; NaN (not known) counts as 0.
    :param interval: sample interval [s].
    :param tolerance: relative difference allowed.
    """
    count = len(cycles)
    swing = sum(c.peak_max - c.peak_min for c in cycles) / count
    highs, lows = [c.period_high for c in cycles], [c.period_low for c in cycles]
    shorter, longer = sorted((sum(highs) / count, sum(lows) / count))
    if swing <= 0.0 or shorter <= 0.0:
        return False
    noise = 0.0 if math.isnan(noise_std) else _NOISE_MARGIN * noise_std
    allowed_time = 2.0 * interval + noise * longer / swing
    allowed_peak = 0.5 * tolerance * swing + 2.0 * interval * swing / shorter + noise
    return all(
        max(half) - min(half) <= allowed_time + tolerance * sum(half) / count
        for half in (highs, lows)
    ) and all(
        max(peak) - min(peak) <= allowed_peak
        for peak in ([c.peak_max for c in cycles], [c.peak_min for c in cycles])
    )


def next_cycle(
    before: Sequence[Cycle],
    time: FloatArray,
    measurement: FloatArray,
    command: FloatArray,
    *,
    middle: float,
    reverse_acting: bool,
    noise_std: float = math.nan,
    min_cycles: int = MIN_CYCLES,
    tolerance: float = TOLERANCE,
) -> Cycle:
    """Compute the features of a cycle, and whether it agrees with those before it.

    It uses only data up to this cycle, so that a live experiment and a replay of its record give
    identical cycles.

    :param before: the cycles so far, in order.
    :param time: as for :func:`cycle_from_samples`, as are the next four.
    :param noise_std: standard deviation of the measurement noise [y]; NaN: not known.
    :param min_cycles: number of cycles, this one included, that must agree.
    :param tolerance: relative difference allowed, see :func:`agree`.
    """
    cycle = cycle_from_samples(
        len(before), time, measurement, command, middle=middle, reverse_acting=reverse_acting
    )
    if len(before) + 1 < min_cycles:
        return cycle
    window = (*before[len(before) + 1 - min_cycles :], cycle)
    interval = cycle.period / (len(time) - 1)
    if not agree(window, noise_std, interval, tolerance):
        return cycle
    return replace(cycle, converged=True)


@asked_once
def cycles_of(
    record: Record, *, min_cycles: int = MIN_CYCLES, tolerance: float = TOLERANCE
) -> tuple[Cycle, ...]:
    """Compute the whole cycles of a record.

    The cycles are bounded by ``record.cycle_start``. If that is empty and the outcome is unknown
    (a truncated recording, or one of another program), they are bounded by the switches of the
    command, see :func:`~relay_autotune.record.foreign.find_cycles`, and missing settings are
    inferred.

    :param record: the record of an experiment.
    :param min_cycles: number of successive cycles that must agree for ``converged``.
    :param tolerance: relative difference allowed between them, see :func:`agree`.
    """
    bounds = _bounds(record)
    settings = settings_of(record)
    if settings is None or len(bounds) < 2:
        return ()
    cycles: list[Cycle] = []
    for first, last in pairwise(bounds):
        part = slice(first, last + 1)
        sent = record.command[first:last]
        low, high = float(sent.min()), float(sent.max())
        middle = settings.baseline + settings.bias
        if not low < middle < high:
            # The levels were shifted later, to compensate a load.
            middle = 0.5 * (low + high)
        cycles.append(
            next_cycle(
                cycles,
                record.time[part],
                record.measurement[part],
                sent,
                middle=middle,
                reverse_acting=settings.reverse_acting,
                noise_std=record.noise_std,
                min_cycles=min_cycles,
                tolerance=tolerance,
            )
        )
    return tuple(cycles)


def _bounds(record: Record) -> tuple[int, ...]:
    if record.cycle_start or record.outcome is not Outcome.UNKNOWN:
        return record.cycle_start
    return find_cycles(record)


@dataclass(frozen=True)
class LimitCycle(CycleFeatures):
    """Averages over the cycles that agree, or over the last ones if none do."""

    # Standard deviation of each of the features between the cycles, by name; 0 for one cycle.
    std: dict[str, float] = field(default_factory=dict)
    cycles: tuple[int, ...] = told("", "Indices of the cycles averaged.", ())
    converged: bool = told("", "True if they agree.", False)


_AVERAGED = tuple(f.name for f in fields(CycleFeatures))


def limit_cycle(
    source: Record | Sequence[Cycle],
    *,
    min_cycles: int = MIN_CYCLES,
    tolerance: float = TOLERANCE,
) -> LimitCycle:
    """Average the cycles of the limit cycle.

    These are the last unbroken run of converged cycles and the ``min_cycles - 1`` cycles before
    it, with which they agree. Without a converged cycle they are the last ``min_cycles``.
    Disturbed cycles are left out if others remain.

    :param source: a record, or its cycles.
    :param min_cycles: number of successive cycles that had to agree.
    :param tolerance: relative difference allowed between them; used if a record is given.
    :raises RecordError: if there is no whole cycle.
    """
    if isinstance(source, Record):
        cycles = cycles_of(source, min_cycles=min_cycles, tolerance=tolerance)
    else:
        cycles = tuple(source)
    if not cycles:
        raise RecordError(
            "found no whole cycle, expected at least one: the command must switch to its high "
            "level twice or more"
        )
    chosen, converged = _steady_cycles(cycles, min_cycles)
    values = {name: np.array([getattr(c, name) for c in chosen]) for name in _AVERAGED}
    spread = {n: float(np.std(v, ddof=1)) if v.size > 1 else 0.0 for n, v in values.items()}
    return LimitCycle(
        **{name: float(np.mean(v)) for name, v in values.items()},
        std=spread,
        cycles=tuple(c.index for c in chosen),
        converged=converged,
    )


def _steady_cycles(cycles: tuple[Cycle, ...], min_cycles: int) -> tuple[tuple[Cycle, ...], bool]:
    last = max((k for k, c in enumerate(cycles) if c.converged), default=None)
    if last is None:
        chosen = cycles[-min_cycles:]
    else:
        first = last
        while first > 0 and cycles[first - 1].converged:
            first -= 1
        chosen = cycles[max(0, first + 1 - min_cycles) : last + 1]
    return tuple(c for c in chosen if not c.disturbed) or chosen, last is not None
