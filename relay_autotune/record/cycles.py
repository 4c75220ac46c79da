# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Cycles of a relay experiment: their features, their agreement, their averages.

In a record of unknown origin the relay is found first: its levels, its cycles, its settings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.errors import RecordError
from relay_autotune.quantities import result_field
from relay_autotune.record.record import (
    Cycle,
    CycleFeatures,
    Outcome,
    Record,
    RelaySettings,
    cached_on_record,
)

# Two commands that differ by less than this part of the command's range are one level.
_LEVEL_TOLERANCE = 1e-6

# A command with more levels than this comes from a controller, not from a relay. The number leaves
# room for the levels before and after the experiment and a few manual steps.
_MAX_LEVELS = 12

# Least number of switches that shows whether the first one belongs to the oscillation.
_ENOUGH_TO_TELL = 5

# A stay at a level shorter than this fraction of the usual stay is noise at a switch.
_SHORT_STAY = 0.1

# A relay switches when the measurement comes to its level, within a share of its range, so that
# this part of a stay at most is left then. A process that comes to rest, within 5 %, is there
# after three time constants, and a timer lets it be for a fourth or more.
_THERE, _LEFT = 0.05, 0.25


@dataclass(frozen=True)
class RelayStretch:
    """The part of a record in which the command switches between two levels.

    :param low: the lower level [u].
    :param high: the upper level [u].
    :param first: index of the first sample at one of the levels.
    :param up: indices of the samples answered by a switch from low to high, shape (m,), m >= 2.
    :param down: indices of the samples answered by a switch from high to low, shape (k,).
    """

    low: float
    high: float
    first: int
    up: IntArray
    down: IntArray


def infer_settings(record: Record) -> RelaySettings | None:
    """Estimate the settings of a relay from a record that carries none.

    The levels are those of the command. The baseline is the level before the oscillation if that
    is a third level; otherwise the mean of the command over whole cycles, which holds the process
    where it oscillates. The switching levels of the
    measurement lie between the samples before and at the switches. So set-point and hysteresis are
    accurate to about half of the measurement's change in a sample interval, and less accurate if
    the relay acted on another signal than the recorded one. The relay is direct-acting if the
    measurement is higher at the switches down than at the switches up.

    :param record: a record of any origin.
    :returns: the settings, or None if the command is not that of a relay.
    """
    stretch = find_relay(record)
    if stretch is None or stretch.down.size == 0:
        return None
    y = record.measurement
    at_up, at_down = float(np.mean(y[stretch.up])), float(np.mean(y[stretch.down]))
    reverse = at_up > at_down
    rising, falling = (stretch.up, stretch.down) if reverse else (stretch.down, stretch.up)
    upper = _crossed_level(y, rising)
    lower = -_crossed_level(-y, falling)
    middle = 0.5 * (stretch.high + stretch.low)
    baseline = float(record.command[0]) if stretch.first > 0 else _mean_command(record, stretch)
    return RelaySettings(
        setpoint=0.5 * (upper + lower),
        baseline=baseline,
        amplitude=0.5 * (stretch.high - stretch.low),
        bias=middle - baseline,
        hysteresis=max(0.0, 0.5 * (upper - lower)),
        reverse_acting=reverse,
    )


@cached_on_record
def settings_of(record: Record) -> RelaySettings | None:
    """Return the relay settings of a record: its own, or else those inferred from its data.

    :param record: a record of any origin.
    :returns: as :func:`infer_settings`.
    """
    return record.settings or infer_settings(record)


def _mean_command(record: Record, stretch: RelayStretch) -> float:
    first, last = int(stretch.up[0]), int(stretch.up[-1])
    held = np.diff(record.time[first : last + 1])
    if not np.sum(held) > 0.0:
        return 0.5 * (stretch.high + stretch.low)
    return float(np.average(record.command[first:last], weights=held))


def _crossed_level(measurement: FloatArray, at: IntArray) -> float:
    """Return the level that the measurement crosses from below at given samples."""
    before = measurement[np.maximum(at - 1, 0)]
    reached = measurement[at]
    lowest, highest = float(np.max(before)), float(np.min(reached))
    if lowest <= highest:
        return 0.5 * (lowest + highest)
    return 0.5 * float(np.mean(before) + np.mean(reached))


def is_switched(record: Record) -> bool:
    """Return whether the commands of a record are those of a relay.

    With a relay on the set-point, a controller answers with another command in each sample. They
    are those of the last cycle, or of all samples where there is no cycle.

    :param record: of a relay experiment.
    """
    starts = record.cycle_start
    last = slice(*starts[-2:]) if len(starts) > 1 else slice(None)
    return np.unique(record.command[last]).size < _MAX_LEVELS


@cached_on_record
def find_relay(record: Record) -> RelayStretch | None:
    """Return the longest stretch in which the command switches between two levels.

    Levels before and after the oscillation (a baseline, a manual step) may differ from the two
    levels of the relay. A stay at a level of less than a tenth of the usual one counts as noise at
    a switch and begins no cycle.

    :param record: a record of any origin.
    :returns: the stretch; None without two switches from a lower to a higher level, or if they
        come by the clock.
    """
    command = record.command
    change = np.flatnonzero(np.diff(command) != 0.0) + 1
    if change.size < 3:
        return None
    begins = np.concatenate(([0], change))
    values = command[begins]
    tolerance = _LEVEL_TOLERANCE * float(np.ptp(values))
    if np.count_nonzero(np.diff(np.sort(values)) > tolerance) >= _MAX_LEVELS:
        return None
    # Command changes within one level are no switches.
    begins = begins[np.concatenate(([True], np.abs(np.diff(values)) > tolerance))]
    begin, stop = max(two_level_runs(command[begins]), key=lambda run: run[1] - run[0])
    stretch = _stretch(record, begins, slice(begin, stop + 1))
    if stretch is None:
        return None
    at = np.sort(np.append(stretch.up, stretch.down))
    return stretch if follow_measurement(record, at, np.isin(at, stretch.up)) else None


def two_level_runs(levels: FloatArray) -> list[tuple[int, int]]:
    """Return first change and the one after the last of each run between the same two levels.

    :param levels: of a command, before its first change and after each, shape (m + 1,).
    """
    same = np.abs(levels[2:] - levels[:-2]) <= _LEVEL_TOLERANCE * np.ptp(levels)
    return list(pairwise([0, *(1 + np.flatnonzero(~same)).tolist(), levels.size - 1]))


def follow_measurement(record: Record, at: IntArray, rises: NDArray[np.bool_]) -> bool:
    """Return whether switches follow the measurement, as those of a relay do.

    A relay switches when the measurement comes to a level, which is the same each time. So the
    switch comes soon after the first sample of its stay that is there. A timer lets the process
    be there for long, or switches before.

    :param record: a record of any origin.
    :param at: sample of each switch, shape (m,).
    :param rises: whether the command rises there, shape (m,).
    """
    y = record.measurement
    margin = _THERE * float(np.ptp(y[at[0] : at[-1] + 1]))
    # The command of a relay rises where the measurement has fallen, or where it has risen.
    return (
        margin > 0.0
        and at[-1] > at[0]
        and any(_left(record.time, side * y, at, rises, margin) < _LEFT for side in (-1.0, 1.0))
    )


def _left(
    time: FloatArray, y: FloatArray, at: IntArray, rises: NDArray[np.bool_], margin: float
) -> float:
    """Return the share of the time for which the measurement is at its level before a switch.

    Where it never comes there, the whole stay counts.

    :param time: of the samples [s], shape (n,).
    :param y: measurement, which has risen where the command rises, shape (n,).
    :param at: sample of each switch, shape (m,).
    :param rises: whether the command rises there, shape (m,).
    :param margin: distance within which the measurement is there [y].
    """
    late = 0.0
    for up in (True, False):
        ends = 1 + np.flatnonzero(rises[1:] == up)
        if not ends.size:
            continue
        there = y if up else -y
        level = np.median(there[at[ends]]) - margin
        for begin, end in zip(at[ends - 1], at[ends], strict=True):
            # It may have come right after the sample before.
            come = begin + np.flatnonzero(there[begin + 1 : end + 1] >= level)
            late += time[end] - time[come[0] if come.size else begin]
    return float(late / (time[at[-1]] - time[at[0]]))


def _stretch(record: Record, begins: IntArray, stays: slice) -> RelayStretch | None:
    n = len(record)
    last = n - 1 if stays.stop >= begins.size else int(begins[stays.stop]) - 1
    starts = begins[stays]
    if starts.size < 3:
        return None
    value = record.command[starts]
    is_high = value > 0.5 * (np.max(value) + np.min(value))
    stay = np.diff(np.append(record.time[starts], record.time[last]))
    long = stay >= _SHORT_STAY * _usual_stay(stay)
    # A switch counts if the stay before it was not noise, and it goes to the other level than the
    # last switch that counted.
    up: list[int] = []
    down: list[int] = []
    at_high: bool | None = None
    for k in range(1, starts.size):
        if not long[k - 1] or at_high is bool(is_high[k]):
            continue
        at_high = bool(is_high[k])
        (up if at_high else down).append(int(starts[k]))
    _drop_the_way_there(record.measurement, up, down)
    if len(up) < 2:
        return None
    return RelayStretch(
        low=float(np.min(value)),
        high=float(np.max(value)),
        first=int(starts[0]),
        up=np.array(up, dtype=np.int64),
        down=np.array(down, dtype=np.int64),
    )


def _drop_the_way_there(y: FloatArray, up: list[int], down: list[int]) -> None:
    """Leave out a first switch where the process was still outside of the oscillation.

    A heater that is switched on from cold begins a stay, but not at the relay's lower level.
    """
    if len(up) + len(down) < _ENOUGH_TO_TELL:
        return
    first, *rest = sorted((*up, *down))
    swing = y[rest[0] : rest[-1] + 1]
    if not float(swing.min()) <= float(y[first]) <= float(swing.max()):
        (up if first in up else down).remove(first)


def _usual_stay(stay: FloatArray) -> float:
    """Return the time-weighted median of the stays: half of the time was spent in longer ones."""
    ordered = np.sort(stay)
    total = np.cumsum(ordered)
    return float(ordered[int(np.searchsorted(total, 0.5 * total[-1]))])


MIN_CYCLES = 3
TOLERANCE = 0.02

# A pause between samples is a gap if it is longer than 5 median intervals and than a twentieth of
# the cycle.
GAP_INTERVALS = 5.0
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
        disturbed=gap > max(GAP_INTERVALS * float(np.median(interval)), _GAP_SHARE * period),
    )


def runs_of(there: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return where each run of samples begins, and the sample after its last one.

    :param there: True within the runs, shape (n,).
    """
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _longest_low(time: FloatArray, high: NDArray[np.bool_]) -> int:
    """Return the first sample of the longest stay at the low level, 0 if there is none."""
    stays = [(begin, stop) for begin, stop in runs_of(~high) if begin]
    return max(stays, key=lambda stay: time[stay[1]] - time[stay[0]], default=(0, 0))[0]


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
    swing = 2.0 * sum(c.amplitude for c in cycles) / count
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
    cycle: Cycle,
    interval: float,
    noise_std: float,
    min_cycles: int,
    tolerance: float,
) -> Cycle:
    """Return a cycle with the answer to whether it agrees with those before it.

    It uses only data up to this cycle, so that a live experiment and a replay of its record give
    identical cycles.

    :param before: the cycles so far, in order.
    :param cycle: the next one.
    :param interval: mean interval of its samples [s].
    :param noise_std: standard deviation of the measurement noise [y]; NaN: not known.
    :param min_cycles: number of cycles, this one included, that must agree.
    :param tolerance: relative difference allowed, see :func:`agree`.
    """
    if len(before) + 1 < min_cycles:
        return cycle
    window = (*before[len(before) + 1 - min_cycles :], cycle)
    return replace(cycle, converged=agree(window, noise_std, interval, tolerance))


@cached_on_record
def cycles_of(record: Record) -> tuple[Cycle, ...]:
    """Compute the whole cycles of a record; missing settings are inferred.

    :param record: the record of an experiment.
    """
    bounds = cycle_bounds(record)
    settings = settings_of(record)
    if settings is None or len(bounds) < 2:
        return ()
    cycles: list[Cycle] = []
    for first, last in pairwise(bounds):
        samples = slice(first, last + 1)
        time, sent = record.time[samples], record.command[first:last]
        low, high = float(sent.min()), float(sent.max())
        middle = settings.baseline + settings.bias
        if not low < middle < high:
            # The levels were shifted later, to compensate a load.
            middle = 0.5 * (low + high)
        y, reverse = record.measurement[samples], settings.reverse_acting
        cycle = cycle_from_samples(
            len(cycles), time, y, sent, middle=middle, reverse_acting=reverse
        )
        interval, noise = cycle.period / (last - first), record.noise_std
        cycles.append(next_cycle(cycles, cycle, interval, noise, MIN_CYCLES, TOLERANCE))
    return tuple(cycles)


def cycle_bounds(record: Record) -> tuple[int, ...]:
    """Return the samples at which the cycles of a record begin, and at which the last one ends.

    They are ``record.cycle_start``. If that is empty and the outcome is unknown (a truncated
    recording, or one of another program), they are the switches to the high level that
    :func:`find_relay` finds; none if it finds no relay.

    :param record: the record of an experiment.
    """
    if record.cycle_start or record.outcome is not Outcome.UNKNOWN:
        return record.cycle_start
    stretch = find_relay(record)
    return () if stretch is None else tuple(stretch.up.tolist())


@dataclass(frozen=True)
class LimitCycle(CycleFeatures):
    """Averages over the cycles that agree, or over the last ones if none do."""

    # Standard deviation of the period between the cycles [s]; 0 for one cycle.
    period_std: float = 0.0
    cycles: tuple[int, ...] = result_field("", ())
    """Indices of the cycles averaged."""
    converged: bool = result_field("", False)
    """True if they agree."""


_AVERAGED = tuple(f.name for f in fields(CycleFeatures))


def limit_cycle(source: Record | Sequence[Cycle]) -> LimitCycle:
    """Average the cycles of the limit cycle.

    These are the last unbroken run of converged cycles and the two cycles before it, with which
    they agree. Without a converged cycle they are the last three. Disturbed cycles are left out
    if others remain.

    :param source: a record, or its cycles.
    :raises RecordError: if there is no whole cycle.
    """
    cycles = cycles_of(source) if isinstance(source, Record) else tuple(source)
    if not cycles:
        raise RecordError(
            "found no whole cycle, expected at least one: the command must switch to its high "
            "level twice or more"
        )
    chosen, converged = _steady_cycles(cycles)
    values = {name: np.array([getattr(c, name) for c in chosen]) for name in _AVERAGED}
    return LimitCycle(
        **{name: float(np.mean(v)) for name, v in values.items()},
        period_std=float(np.std(values["period"], ddof=1)) if len(chosen) > 1 else 0.0,
        cycles=tuple(c.index for c in chosen),
        converged=converged,
    )


def _steady_cycles(cycles: tuple[Cycle, ...]) -> tuple[tuple[Cycle, ...], bool]:
    runs = runs_of(np.array([c.converged for c in cycles]))
    first, stop = runs[-1] if runs else (len(cycles) - 1, len(cycles))
    chosen = cycles[max(0, first + 1 - MIN_CYCLES) : stop]
    return tuple(c for c in chosen if not c.disturbed) or chosen, bool(runs)
