# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Find the relay in a record of unknown origin: its levels, its cycles, its settings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.record.record import Record, RelaySettings, asked_once

# Two commands that differ by less than this part of the command's range are one level.
_LEVEL_TOLERANCE = 1e-6

# A command with more levels than this comes from a controller, not from a relay. The number leaves
# room for the levels before and after the experiment and a few manual steps.
_MAX_LEVELS = 12

# Least number of switches that shows whether the first one belongs to the oscillation.
_ENOUGH_TO_TELL = 5

# A stay at a level shorter than this fraction of the usual stay is noise at a switch.
_SHORT_STAY = 0.1


@dataclass(frozen=True)
class RelayStretch:
    """The part of a record in which the command switches between two levels.

    :param low: the lower level [u].
    :param high: the upper level [u].
    :param first: index of the first sample at one of the levels.
    :param last: index of the last one.
    :param up: indices of the samples answered by a switch from low to high, shape (m,), m >= 2.
    :param down: indices of the samples answered by a switch from high to low, shape (k,).
    """

    low: float
    high: float
    first: int
    last: int
    up: IntArray
    down: IntArray


@asked_once
def find_cycles(record: Record) -> tuple[int, ...]:
    """Return the samples at which cycles begin, from the switches of the command alone.

    Levels before and after the oscillation (a baseline, a manual step) may differ from the two
    levels of the relay. A stay at a level of less than a tenth of the usual one counts as noise at
    a switch and begins no cycle.

    :param record: a record of any origin.
    :returns: indices as in ``Record.cycle_start``; empty if the command does not switch to a
        high level from a low one at least twice.
    """
    stretch = find_relay(record)
    return () if stretch is None else tuple(int(i) for i in stretch.up)


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


@asked_once
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


def find_relay(record: Record) -> RelayStretch | None:
    """Return the longest stretch in which the command switches between two levels.

    :param record: a record of any origin.
    :returns: the stretch; None without two switches from a lower to a higher level.
    """
    command = record.command
    change = np.flatnonzero(np.diff(command) != 0.0) + 1
    if change.size < 3:
        return None
    begins = np.concatenate(([0], change))
    level = _levels(command[begins])
    if level is None:
        return None
    # Command changes within one level are no switches.
    kept = np.concatenate(([True], np.diff(level) != 0))
    begins, level = begins[kept], level[kept]
    best: tuple[int, int] | None = None
    run = 0
    for k in range(2, level.size + 1):
        if k < level.size and level[k] == level[k - 2]:
            continue
        # Stays run .. k - 1 alternate between two levels.
        if best is None or k - run > best[1] - best[0]:
            best = (run, k)
        run = k - 1
    if best is None:
        return None
    return _stretch(record, begins, slice(*best))


def _levels(values: FloatArray) -> IntArray | None:
    """Return the number of the level of each value; None if there are too many for a relay."""
    spread = float(np.max(values) - np.min(values))
    order = np.argsort(values, kind="stable")
    jumps = np.diff(values[order]) > _LEVEL_TOLERANCE * spread
    if int(np.count_nonzero(jumps)) >= _MAX_LEVELS:
        return None
    number = np.empty(values.size, dtype=np.int64)
    number[order] = np.concatenate(([0], np.cumsum(jumps)))
    return number


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
        last=last,
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
