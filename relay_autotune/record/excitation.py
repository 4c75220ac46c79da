# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Find the experiments in a long record: the parts in which the command moves the process."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.record.record import Record, roughness

# Least number of switches between two levels for a relay phase: two whole cycles.
_FEWEST_SWITCHES = 4
# A stay this many times the usual one ends a relay phase.
_LONG_STAY = 4.0

# Steps form one experiment unless the process rests between them this many times as long as it
# moved.
_REST = 10.0

# A command that changes at more than this share of the samples comes from a controller.
_CONTINUOUS = 0.2
_FEWEST_CHANGES = 20

# A break in the record: no sample for this time, and for a multiple of the usual interval.
_BREAK_S = 60.0
_BREAK_INTERVALS = 1000.0

# Number of equal samples at an end of the measurement's range that means saturation, if the
# measurement was a share of its range away within twice the time in which it crossed another
# share fastest. Before a rest it has slowed down.
_SATURATED = 20
_AWAY, _CROSSED = 0.04, 0.2
_MOST_FOR_SPEED = 2000

# The measurement moves if it leaves its rest by this many standard deviations of its noise, and by
# a share of its range.
_NOISE = 4.0
_SHARE = 0.05

# Number of parts of a record under a controller, to separate movement from rest.
_BLOCKS = 400


@dataclass(frozen=True)
class Stretch:
    """A part of a record that is an experiment.

    :param first: index of its first sample.
    :param last: index of its last sample.
    :param kind: ``relay``, ``steps``, ``pulses`` or ``closed loop``.
    :param reason: description for the user.
    """

    first: int
    last: int
    kind: str
    reason: str


def find_experiments(record: Record) -> tuple[Stretch, ...]:
    """Return the stretches of a record in which the process is excited, in order.

    A stretch includes the rest before and after it, which shows the operating point and the noise.
    Each rest is at most as long as the experiment itself, or ten times as long for steps and
    pulses.
    A saturated measurement or a break ends an experiment.

    :param record: a record of any origin.
    :returns: the stretches; empty if the command does not move the measurement.
    """
    found: list[Stretch] = []
    for first, last in _unbroken(record):
        found += _in_part(record, first, last)
    return tuple(found)


def _unbroken(record: Record) -> list[tuple[int, int]]:
    """Return first and last sample of each part without a break or a saturated measurement."""
    time, y = record.time, record.measurement
    interval = np.diff(time)
    if interval.size == 0:
        return [(0, 0)]
    usual = float(np.median(interval))
    broken = interval > max(_BREAK_S, _BREAK_INTERVALS * usual)
    kept = ~_saturated(y)
    apart = ~kept[1:] | ~kept[:-1] | broken
    begins = np.flatnonzero(kept & np.concatenate(([True], apart)))
    ends = np.flatnonzero(kept & np.concatenate((apart, [True])))
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


def _saturated(y: FloatArray) -> np.ndarray:
    """Return which samples are constant at an end of the measurement's range, but not at rest.

    A sensor or a process at its end stops the measurement in mid-movement. One at rest, as an
    encoder at standstill, has slowed down before, or has not moved yet.
    """
    low, high = float(np.min(y)), float(np.max(y))
    still = np.zeros(y.size, dtype=np.bool_)
    equal = np.diff(y) == 0.0
    if low == high or float(np.mean(equal)) > 0.5:
        # A coarsely quantised measurement, or one without noise at rest, is often constant.
        return still
    runs = []
    for end in (low, high):
        edges = np.flatnonzero(np.diff(np.concatenate(([0], (y == end).astype(np.int8), [0]))))
        pairs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        runs += [(begin, stop, end) for begin, stop in pairs if stop - begin >= _SATURATED]
    if not runs:
        return still
    step = max(y.size // _MOST_FOR_SPEED, 1)
    few, coarse = 1, y[::step]
    # A spike between the samples that are looked at may be all of the range.
    while few < coarse.size - 1 and (
        np.max(np.abs(coarse[few:] - coarse[:-few])) < _CROSSED * (high - low)
    ):
        few += 1
    for begin, stop, end in runs:
        away = np.abs(y[max(begin - 2 * few * step, 0) : begin] - end)
        if np.any(away > _AWAY * (high - low)):
            still[begin:stop] = True
    return still


def _in_part(record: Record, first: int, last: int) -> list[Stretch]:
    if last - first < 2 or bool(
        np.all(record.measurement[first : last + 1] == record.measurement[first])
    ):
        return []
    held = record.input()
    # A change at the first sample of a recording is its step.
    after = held.times > record.time[first]
    inside = (after if first else held.times >= record.time[0]) & (held.times <= record.time[last])
    times, values = held.times[inside], held.values[inside]
    # Rows that share a time stamp are one instant, at which the command changes once.
    instants = np.count_nonzero(np.diff(record.time[first : last + 1]))
    varies = times.size >= max(_FEWEST_CHANGES, _CONTINUOUS * instants)
    if times.size and not varies and times[-1] == record.time[last]:
        # A change at the last sample, as when all is switched off, has no response behind it.
        times, values, last = times[:-1], values[:-1], last - 1
    if times.size == 0:
        return []
    earlier = held.values[: int(np.argmax(inside))]
    before = float(earlier[-1]) if earlier.size else held.initial
    if varies:
        found = _moving_parts(record, first, last)
    else:
        changes = _Changes(times, np.concatenate(([before], values)))
        found = _switching_parts(record, last, changes)
    return _with_rest(record, first, last, found)


@dataclass(frozen=True)
class _Changes:
    """Changes of a command.

    :param times: of each [s], shape (m,).
    :param levels: before the first and after each, shape (m + 1,).
    """

    times: FloatArray
    levels: FloatArray


# --- a command that is constant between its changes


def _switching_parts(
    record: Record, last: int, changes: _Changes
) -> list[tuple[float, float, str, str]]:
    """Return begin, end, kind and reason of each experiment, without the rest around it."""
    relay = _relay_runs(changes)
    around = [_with_kick(changes, run, relay) for run in relay]
    found = [_relay(record, changes, *runs) for runs in zip(relay, around, strict=True)]
    follows = sum(b - a for (a, b), part in zip(relay, found, strict=True) if part[2] == "relay")
    if 2 * follows < changes.times.size:
        # Parts of a timed sequence look like a relay by chance.
        found = [(begin, end, "pulses", reason) for begin, end, _, reason in found]
    taken = {k for run in around for k in range(*run)}
    settled = _settled(record, last, changes)
    group: list[int] = []
    for k in range(changes.times.size):
        if k in taken:
            found += _steps(changes, settled, group)
            group = []
            continue
        if group and _rests(changes, settled, group, k):
            found += _steps(changes, settled, group)
            group = []
        group.append(k)
    found += _steps(changes, settled, group)
    return _merged(changes, sorted(found))


def _merged(
    changes: _Changes, found: Sequence[tuple[float, float, str, str]]
) -> list[tuple[float, float, str, str]]:
    """Join parts without a relay if the process does not rest for long between them."""
    merged: list[tuple[float, float, str, str]] = []
    for part in found:
        last = merged[-1] if merged else None
        if (
            last is None
            or "relay" in (last[2], part[2])
            or part[0] - last[1] > _REST * (last[1] - last[0])
        ):
            merged.append(part)
            continue
        inside = (changes.times >= last[0]) & (changes.times <= part[1])
        levels = changes.levels[1:][inside]
        reason = (
            f"{levels.size} changes of the command between {levels.min():g} and "
            f"{levels.max():g} whatever the measurement does"
        )
        merged[-1] = (last[0], max(last[1], part[1]), "pulses", reason)
    return merged


def _relay_runs(changes: _Changes) -> list[tuple[int, int]]:
    """Return first change and the one after the last of each run between the same two levels."""
    levels, times = changes.levels, changes.times
    spread = float(np.ptp(levels))
    runs = []
    k = 0
    while k < times.size:
        stop = k + 1
        while stop < times.size and abs(levels[stop + 1] - levels[stop - 1]) <= 1e-6 * spread:
            stop += 1
        for begin, end in _without_long_stays(times, k, stop):
            if end - begin >= _FEWEST_SWITCHES:
                runs.append((begin, end))
        k = stop
    return runs


def _without_long_stays(times: FloatArray, begin: int, stop: int) -> list[tuple[int, int]]:
    stays = np.diff(times[begin:stop])
    if stays.size < _FEWEST_SWITCHES - 1:
        return []
    cuts = begin + 1 + np.flatnonzero(stays > _LONG_STAY * np.median(stays))
    bounds = [begin, *cuts.tolist(), stop]
    return list(itertools.pairwise(bounds))


def _with_kick(
    changes: _Changes, run: tuple[int, int], runs: Sequence[tuple[int, int]]
) -> tuple[int, int]:
    """Add the changes just before and after a relay phase."""
    times, (begin, stop) = changes.times, run
    reach = _LONG_STAY * float(np.median(np.diff(times[begin:stop])))
    others = {k for other in runs if other != run for k in range(*other)}
    while begin > 0 and begin - 1 not in others and times[begin] - times[begin - 1] <= reach:
        begin -= 1
    while stop < times.size and stop not in others and times[stop] - times[stop - 1] <= reach:
        stop += 1
    return begin, stop


def _relay(
    record: Record, changes: _Changes, run: tuple[int, int], around: tuple[int, int]
) -> tuple[float, float, str, str]:
    begin, stop = run
    times, levels = changes.times[begin:stop], changes.levels[begin + 1 : stop + 1]
    usual = float(np.median(np.diff(times)))
    low, high = float(np.min(levels)), float(np.max(levels))
    end = float(changes.times[around[1] - 1]) + usual
    at = np.clip(np.searchsorted(record.time, times), 0, len(record) - 1)
    kind = "relay" if _follows(record, at, levels > 0.5 * (low + high)) else "pulses"
    who = "that follow the measurement" if kind == "relay" else "whatever the measurement does"
    reason = f"{stop - begin} switches of the command between {low:g} and {high:g} {who}"
    return float(changes.times[around[0]]), end, kind, reason


def _follows(record: Record, at: IntArray, up: np.ndarray) -> bool:
    """Distinguish a relay from timed pulses: a relay switches at the same measurements."""
    inside = record.measurement[at[0] : at[-1] + 1]
    swing = float(np.ptp(inside))
    if swing == 0.0 or np.count_nonzero(up) < 2 or np.count_nonzero(~up) < 2:
        return False
    y = record.measurement[at]
    scatter = max(float(np.std(y[up])), float(np.std(y[~up])))
    middle = 0.5 * (float(np.max(inside)) + float(np.min(inside)))
    off = max(abs(float(np.median(y[up])) - middle), abs(float(np.median(y[~up])) - middle))
    return scatter < 0.15 * swing and off < 0.35 * swing


def _settled(record: Record, last: int, changes: _Changes) -> FloatArray:
    """Return when the measurement has come to rest after each change [s], shape (m,)."""
    ends = np.append(changes.times[1:], record.time[last])
    noise = roughness(record.measurement)
    settled = np.empty(changes.times.size)
    for k, (begin, end) in enumerate(zip(changes.times, ends, strict=True)):
        low, high = np.searchsorted(record.time, (begin, end), side="right")
        part = record.measurement[low:high]
        settled[k] = end
        if part.size < 5:
            continue
        final = float(np.median(part[-max(part.size // 5, 3) :]))
        band = max(_NOISE * noise, _SHARE * float(np.max(np.abs(part - final))))
        # One of many samples may lie far out by chance; the mean of five does not.
        smooth = np.convolve(part, np.full(5, 0.2), mode="valid")
        moving = np.flatnonzero(np.abs(smooth - final) > band)
        settled[k] = begin if moving.size == 0 else record.time[low + moving[-1]]
    return settled


def _rests(changes: _Changes, settled: FloatArray, group: Sequence[int], k: int) -> bool:
    """Return whether a long rest before a change separates two experiments."""
    moved = float(settled[k - 1] - changes.times[group[0]])
    return bool(changes.times[k] - settled[k - 1] > _REST * moved)


def _steps(
    changes: _Changes, settled: FloatArray, group: Sequence[int]
) -> list[tuple[float, float, str, str]]:
    if not group:
        return []
    begin, stop = group[0], group[-1] + 1
    levels = changes.levels[begin : stop + 1]
    listed = " to ".join(f"{level:g}" for level in levels[:6]) + (
        " ..." if stop - begin > 5 else ""
    )
    returns = levels.size > 2 and levels[-1] == levels[0]
    kind = "pulses" if returns else "steps"
    what = ("pulse" if returns else "step") if levels.size <= 3 else kind
    what = "step" if levels.size == 2 else what
    reason = f"{what} of the command from {listed}"
    return [(float(changes.times[begin]), float(settled[stop - 1]), kind, reason)]


# --- a command that a controller changes all the time


def _without_outliers(y: FloatArray) -> FloatArray:
    """Return a measurement without single samples far out, by medians of three."""
    if y.size < 3:
        return y
    inner = np.median(np.lib.stride_tricks.sliding_window_view(y, 3), axis=1)
    return np.concatenate((inner[:1], inner, inner[-1:]))


def _moving_parts(record: Record, first: int, last: int) -> list[tuple[float, float, str, str]]:
    """Return the parts in which the set-point or a load moved the measurement."""
    time, y = record.time[first : last + 1], record.measurement[first : last + 1]
    edges = np.unique(np.linspace(0, y.size, min(_BLOCKS, max(y.size // 5, 1)) + 1).astype(int))
    noise = roughness(y)
    y = _without_outliers(y)
    means = np.add.reduceat(y, edges[:-1]) / np.diff(edges)
    span = float(np.ptp(y))
    reach = max(_NOISE * noise, _SHARE * span)
    if span < 2.5 * reach:
        return []
    window = 5
    padded = np.pad(means, window // 2, mode="edge")
    views = np.lib.stride_tricks.sliding_window_view(padded, window)
    moving = np.ptp(views, axis=1) > reach
    bounds = np.flatnonzero(np.diff(np.concatenate(([0], moving.astype(np.int8), [0]))))
    runs = [
        (float(time[edges[a]]), float(time[min(edges[b], y.size - 1)]))
        for a, b in zip(bounds[::2], bounds[1::2], strict=True)
    ]
    if not runs:
        # It moves evenly, as on a ramp, or so fast that no window is like the others.
        why = "the command varies all the time, and so does the measurement"
        return [(float(time[0]), float(time[-1]), "closed loop", why)]
    merged: list[list[float]] = []
    moves: list[int] = []
    for begin, end in runs:
        if merged and begin - merged[-1][1] <= _REST * (merged[-1][1] - merged[-1][0]):
            merged[-1][1] = end
            moves[-1] += 1
        else:
            merged.append([begin, end])
            moves.append(1)
    return [
        (
            begin,
            end,
            "closed loop",
            f"the command varies all the time, and the measurement moves {count} "
            f"{'time' if count == 1 else 'times'}",
        )
        for (begin, end), count in zip(merged, moves, strict=True)
    ]


# --- both


def _with_rest(
    record: Record, first: int, last: int, found: Sequence[tuple[float, float, str, str]]
) -> list[Stretch]:
    """Add the rest before and after each experiment, and drop those without a response."""
    stretches = []
    noise = roughness(record.measurement[first : last + 1])
    for k, (begin, end, kind, reason) in enumerate(found):
        # Rest shows noise and offset. It is short under a controller, which follows the noise.
        length = max(end - begin, 0.0) * (_REST if kind in ("steps", "pulses") else 1.0)
        earliest = found[k - 1][1] if k else float(record.time[first])
        latest = found[k + 1][0] if k + 1 < len(found) else float(record.time[last])
        low = int(np.searchsorted(record.time, max(begin - length, earliest), side="left"))
        high = int(np.searchsorted(record.time, min(end + length, latest), side="right")) - 1
        low, high = max(low, first), min(high, last)
        part = record.measurement[low : high + 1]
        lasting = record.time[high] > record.time[low]
        if part.size < 10 or not lasting or float(np.ptp(part)) < 3.0 * _NOISE * noise:
            continue
        stretches.append(Stretch(low, high, kind, reason))
    return stretches
