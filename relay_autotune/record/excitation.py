# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Find the experiments in a long record: the parts in which the command moves the process."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.record.cycles import (
    GAP_INTERVALS,
    follow_measurement,
    runs_of,
    two_level_runs,
)
from relay_autotune.record.record import (
    PiecewiseConstant,
    Record,
    cached_on_record,
    roughness,
)

# Least number of switches between two levels for a relay phase: two whole cycles.
_FEWEST_SWITCHES = 4
# A stay this many times the usual one ends a relay phase.
_LONG_STAY = 4.0

# Changes form one experiment unless the process rests between them this many times as long as it
# moved.
_REST = 10.0

# A command that changes at more than this share of the samples, and takes this many values, comes
# from a controller.
_CONTINUOUS = 0.2
_FEWEST_VALUES = 20

# A command of several levels rests where it moves by less than this share of its range in the
# whole recording, as one that is measured does.
_JITTER = 0.01

# A break in the record: no sample for this time, and for a multiple of the usual interval.
_BREAK_S = 60.0
_BREAK_INTERVALS = 1000.0

# Where more than a tenth of the intervals in a table are longer than this multiple of the usual
# one, a row was written when something changed.
_REGULAR = 1.5

# Number of equal samples at an end of the measurement's range that means saturation, if the
# measurement was a share of its range away within twice the time in which it crossed another
# share fastest. Before a rest it has slowed down.
_SATURATED = 20
_AWAY, _CROSSED = 0.04, 0.2
_MOST_FOR_SPEED = 2000
# Share of a sensor's other samples that equal the one before, below which it hardly ever repeats a
# value: 20 equal ones are chance once in 10^24 samples.
_REPEATS = 0.05
# Ratio of a sensor's jumps to the largest of all smaller moves from sample to sample, and the
# largest share of the samples in which it is away: of data as they come 1 to 10 % are gross errors
# (Hampel, Ronchetti, Rousseeuw and Stahel 1986).
_APART, MOST_AWAY = 2.0, 0.1

# The measurement moves if it leaves its rest by this many standard deviations of its noise, and by
# a share of its range.
_NOISE = 4.0
_SHARE = 0.05
# A controller's command, which follows the noise and creeps at rest, moves far beyond this share.
_FAR = 0.5

# Least number of samples that show what a model lacks.
LEAST_SAMPLES = 60


@dataclass(frozen=True)
class Stretch:
    """A part of a record that is an experiment.

    :param first: index of its first sample.
    :param last: index of its last sample.
    :param kind: ``relay``, ``steps``, ``pulses``, ``sequence`` (of two levels) or ``closed loop``.
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
    A saturated or frozen measurement, a break, or a change of the command in a gap ends one.

    :param record: a record of any origin.
    :returns: the stretches; empty if the command does not move the measurement.
    """
    found: list[Stretch] = []
    if np.any(away := jumped_away(record.measurement)):
        # A sensor that drops out says nothing of where the process moves.
        there = np.interp(record.time, record.time[~away], record.measurement[~away])
        record = replace(record, measurement=there)
    for first, last in _unbroken(record):
        found += _in_part(record, first, last)
    return tuple(found)


@dataclass(frozen=True)
class Gaps:
    """Gaps in the rows of a table.

    :param before: index of the sample after each, shape (n,).
    :param longest: s.
    :param hidden: those over which the command changed, nobody knows when, shape (m,).
    """

    before: IntArray
    longest: float
    hidden: IntArray

    def known_from(self, sample: int) -> int:
        """Return the first sample from which the command is known without a break to another."""
        return int(self.hidden[self.hidden <= sample].max(initial=0))


@cached_on_record
def gaps_of(record: Record) -> Gaps:
    """Return the gaps in a table whose rows were written at a fixed interval.

    :param record: a record of any origin.
    """
    if len(record) < 2:
        return Gaps(np.empty(0, dtype=np.int64), 0.0, np.empty(0, dtype=np.int64))
    interval = np.diff(record.time)
    usual = float(np.median(interval))
    long = interval > GAP_INTERVALS * usual
    if not record.is_table or float(np.quantile(interval, 0.9)) > _REGULAR * usual:
        long = np.zeros(interval.size, dtype=np.bool_)
    before = np.flatnonzero(long) + 1
    changes = np.diff(record.command) != 0.0
    # A controller that moves the command at each row has moved it a little in each gap.
    seldom = float(np.mean(changes)) < _CONTINUOUS
    hidden = before[changes[before - 1] & seldom]
    return Gaps(before, float(np.max(interval[long], initial=0.0)), hidden)


def _unbroken(record: Record) -> list[tuple[int, int]]:
    """Return first and last sample of each part without a break or a stuck measurement."""
    time, y = record.time, record.measurement
    interval = np.diff(time)
    if interval.size == 0:
        return [(0, 0)]
    usual = float(np.median(interval))
    broken = interval > max(_BREAK_S, _BREAK_INTERVALS * usual)
    broken[gaps_of(record).hidden - 1] = True
    kept = ~_saturated(y)
    for begin, stop in frozen(y):
        kept[begin + 1 : stop] = False
    apart = ~kept[1:] | ~kept[:-1] | broken
    begins = np.flatnonzero(kept & np.concatenate(([True], apart)))
    ends = np.flatnonzero(kept & np.concatenate((apart, [True])))
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


def at_its_ends(y: FloatArray, band: float = 0.0) -> list[tuple[int, int, float]]:
    """Return where a measurement stopped in mid-movement at an end of its range, and stayed.

    A sensor or a process at its end stops it so; where it comes to rest by itself it slows down.

    :param y: the measurement [y], shape (n,).
    :param band: distance from the end within which it stays, for noise [y].
    :return: of each stay the first sample, the one after the last, and how far from the end the
        measurement was just before, with the sign of the end [y].
    """
    low, high = float(np.min(y)), float(np.max(y))
    away = _AWAY * (high - low) + 3.0 * band
    if not away < 0.5 * (high - low):
        return []
    runs = []
    for end in (low, high):
        pairs = runs_of(np.abs(y - end) <= band)
        runs += [(begin, stop, end) for begin, stop in pairs if stop - begin >= _SATURATED]
    if not runs:
        return []
    step = max(y.size // _MOST_FOR_SPEED, 1)
    few, coarse = 1, y[::step]
    # A spike between the samples that are looked at may be all of the range.
    while few < coarse.size - 1 and (
        np.max(np.abs(coarse[few:] - coarse[:-few])) < _CROSSED * (high - low)
    ):
        few += 1
    return [
        (begin, stop, math.copysign(away, end - 0.5 * (low + high)))
        for begin, stop, end in sorted(runs)
        if np.any(np.abs(y[max(begin - 2 * few * step, 0) : begin] - end) > away)
    ]


def frozen(y: FloatArray) -> list[tuple[int, int]]:
    """Return where a measurement repeats a value, since its sensor or its log stood still.

    A sensor that hardly ever repeats a value repeats one for long that it gives at no other time.
    A rest before the first move is none, and a position that rests often repeats values often.

    :param y: the measurement [y], shape (n,).
    :return: of each stay the first sample, and the one after the last.
    """
    same = np.diff(y) == 0.0
    repeats, found = int(np.count_nonzero(same)), []
    for begin, last in runs_of(same):
        long = last - begin
        rarely = repeats - long < _REPEATS * (same.size - long)
        late = begin >= LEAST_SAMPLES and long >= _SATURATED
        if late and rarely and np.sum(y == y[begin]) == long + 1:
            found.append((begin, last + 1))
    return found


def jumped_away(y: FloatArray) -> NDArray[np.bool_]:
    """Return at which samples a measurement is away from where it jumped from, shape (n,).

    A sensor that drops out jumps by more than a process moves between any two samples, and jumps
    back, unless the record ends before. Where more than a tenth of the samples would be away, none
    is.

    :param y: the measurement [y], shape (n,).
    """
    steps, away = np.diff(y), np.zeros(y.size, dtype=np.bool_)
    if steps.size < 2:
        return away
    few = min(2 * int(MOST_AWAY * y.size) + 1, steps.size)
    size = np.sort(np.partition(np.abs(steps), -few)[-few:])[::-1]
    stands_out = (size[:-1] > _APART * size[1:]) & (size[1:] > 0.0)
    if not np.any(stands_out):
        return away
    least, begin, level = size[np.argmax(stands_out)], 0, 0.0
    for i in (np.flatnonzero(np.abs(steps) >= least) + 1).tolist():
        begin, level = (begin, level + steps[i - 1]) if begin else (i, steps[i - 1])
        if abs(level) < 0.5 * least:
            away[begin:i], begin = True, 0
    if begin:
        away[begin:] = True
    away ^= away.mean() > 0.5
    return away & (away.mean() <= MOST_AWAY)


def _saturated(y: FloatArray) -> NDArray[np.bool_]:
    """Return which samples are constant at an end of the measurement's range, but not at rest."""
    still = np.zeros(y.size, dtype=np.bool_)
    if float(np.mean(np.diff(y) == 0.0)) > 0.5:
        # A coarsely quantised measurement, or one without noise at rest, is often constant.
        return still
    for begin, stop, _ in at_its_ends(y):
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
    often = times.size >= _CONTINUOUS * instants
    if times.size and not often and times[-1] == record.time[last]:
        # A change at the last sample, as when all is switched off, has no response behind it.
        times, values, last = times[:-1], values[:-1], last - 1
    if times.size == 0:
        return []
    before = held.levels[int(np.argmax(inside))]
    levels = np.unique(np.append(values, before))
    if levels.size > 3 and np.ptp(levels) < _JITTER * np.ptp(record.command):
        return []
    noise = roughness(record.measurement[first : last + 1])
    if often and np.unique(values).size >= _FEWEST_VALUES:
        return _with_rest(record, first, last, noise, _moving(record, first, last, noise))
    noise = min(noise, _noise_between(record, first, last, times))
    changes = PiecewiseConstant(times, values, before)
    return _with_rest(record, first, last, noise, _switching_parts(record, last, changes, noise))


def _noise_between(record: Record, first: int, last: int, changes: FloatArray) -> float:
    """Return the noise in the later halves of the command's stays [y]; inf: they are too short.

    A process that answers fast moves at each change, which is no noise.

    :param changes: of the command [s], shape (m,).
    """
    time, y = record.time[first : last + 1], record.measurement[first : last + 1]
    bounds = np.concatenate(([time[0]], changes, [time[-1]]))
    k = np.clip(np.searchsorted(bounds, time[:-2], side="right"), 1, bounds.size - 1)
    quiet = (time[:-2] >= 0.5 * (bounds[k - 1] + bounds[k])) & (time[2:] <= bounds[k])
    return roughness(y, quiet) if np.any(quiet) else math.inf


# --- a command that is constant between its changes


def _switching_parts(
    record: Record, last: int, changes: PiecewiseConstant, noise: float
) -> list[tuple[float, float, str, str]]:
    """Return begin, end, kind and reason of each experiment, without the rest around it."""
    runs = _two_level_runs(changes)
    relays = [run for run in runs if _follows(record, changes, run)]
    if 2 * sum(stop - begin for begin, stop in relays) < changes.times.size:
        # A controller at its limits switches now and then as a relay would.
        relays = []
    around = [_with_kick(changes, run, relays) for run in relays]
    found = [_relay(changes, *each) for each in zip(relays, around, strict=True)]
    # Switches of one run belong together, however long the process rests between them.
    within = {k for begin, stop in runs for k in range(begin + 1, stop)}
    taken = {k for run in around for k in range(*run)}
    settled = _settled(record, last, changes, noise)
    group: list[int] = []
    for k in range(changes.times.size):
        apart = group and k not in within and _rests(changes, settled, group, k)
        if k in taken or apart:
            found += _steps(changes, settled, group)
            group = []
        if k not in taken:
            group.append(k)
    found += _steps(changes, settled, group)
    return sorted(found)


def _two_level_runs(changes: PiecewiseConstant) -> list[tuple[int, int]]:
    """Return first change and the one after the last of each run that may be a relay's."""
    found: list[tuple[int, int]] = []
    for begin, stop in two_level_runs(changes.levels):
        stays = np.diff(changes.times[begin:stop])
        long = stays > _LONG_STAY * np.median(stays) if stays.size else stays
        cuts = begin + 1 + np.flatnonzero(long)
        found += itertools.pairwise([begin, *cuts.tolist(), stop])
    return [(begin, stop) for begin, stop in found if stop - begin >= _FEWEST_SWITCHES]


def _with_kick(
    changes: PiecewiseConstant, run: tuple[int, int], runs: Sequence[tuple[int, int]]
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
    changes: PiecewiseConstant, run: tuple[int, int], around: tuple[int, int]
) -> tuple[float, float, str, str]:
    begin, stop = run
    values = changes.values[begin:stop]
    end = float(changes.times[around[1] - 1] + np.median(np.diff(changes.times[begin:stop])))
    reason = (
        f"{stop - begin} switches of the command between {values.min():g} and {values.max():g} "
        f"that follow the measurement"
    )
    return float(changes.times[around[0]]), end, "relay", reason


def _follows(record: Record, changes: PiecewiseConstant, run: tuple[int, int]) -> bool:
    """Return whether the switches of a run follow the measurement, as those of a relay do."""
    times, values = changes.times[slice(*run)], changes.values[slice(*run)]
    at = np.clip(np.searchsorted(record.time, times), 0, len(record) - 1)
    return follow_measurement(record, at, values > 0.5 * (values.min() + values.max()))


def _settled(record: Record, last: int, changes: PiecewiseConstant, noise: float) -> FloatArray:
    """Return when the measurement has come to rest after each change [s], shape (m,)."""
    ends = np.append(changes.times[1:], record.time[last])
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
        level = smooth(part)
        moving = np.flatnonzero(np.abs(level - final) > band)
        # A response below the noise may last until the next change.
        settled[k] = end if moving.size == 0 else record.time[low + moving[-1]]
    return settled


def _rests(changes: PiecewiseConstant, settled: FloatArray, group: Sequence[int], k: int) -> bool:
    """Return whether a long rest before a change separates two experiments."""
    moved = float(settled[k - 1] - changes.times[group[0]])
    return bool(changes.times[k] - settled[k - 1] > _REST * moved)


def _steps(
    changes: PiecewiseConstant, settled: FloatArray, group: Sequence[int]
) -> list[tuple[float, float, str, str]]:
    if not group:
        return []
    begin, stop = group[0], group[-1] + 1
    levels = changes.levels[begin : stop + 1]
    part = float(changes.times[begin]), float(settled[stop - 1])
    switches = np.unique(levels)
    if switches.size == 2 and stop - begin >= _FEWEST_SWITCHES:
        low, high = switches
        what = f"{stop - begin} switches of the command between {low:g} and {high:g}"
        return [(*part, "sequence", f"{what} whatever the measurement does")]
    listed = " to ".join(f"{level:g}" for level in levels[:6]) + (
        " ..." if stop - begin > 5 else ""
    )
    returns = levels.size > 2 and levels[-1] == levels[0]
    kind = "pulses" if returns else "steps"
    what = ("pulse" if returns else "step") if levels.size <= 3 else kind
    return [(*part, kind, f"{what} of the command from {listed}")]


# --- a command that a controller changes all the time


def _without_outliers(y: FloatArray) -> FloatArray:
    """Return a measurement without single samples far out, by medians of three."""
    if y.size < 3:
        return y
    inner = np.median(np.lib.stride_tricks.sliding_window_view(y, 3), axis=1)
    return np.concatenate((inner[:1], inner, inner[-1:]))


def smooth(y: FloatArray) -> FloatArray:
    """Return means of five samples each, since one of many may lie far out by chance.

    :param y: shape (n,), n >= 5.
    :return: shape (n - 4,).
    """
    return np.convolve(y, np.full(5, 0.2), mode="valid")


def _moving(
    record: Record, first: int, last: int, noise: float
) -> list[tuple[float, float, str, str]]:
    """Return the part from where measurement or command leaves its first rest to their last one.

    A controller moves them by all that happens in between, however slowly. A command that moves
    without an answer belongs to it: it speaks against a response.
    """
    y, u = (x[first : last + 1] for x in (record.measurement, record.command))
    if y.size < 5:
        return []
    moves = [*_off_the_ends(y, noise, _SHARE), *_off_the_ends(u, roughness(u), _FAR)]
    if not moves:
        return []
    begin, end = min(m[0] for m in moves), max(m[1] for m in moves)
    times = float(record.time[first + begin]), float(record.time[first + end])
    return [(*times, "closed loop", "the command varies all the time")]


def _off_the_ends(signal: FloatArray, noise: float, share: float) -> list[tuple[int, int]]:
    """Return where a signal leaves its first level and comes to its last; empty: it rests."""
    clean = _without_outliers(signal)
    level, reach = smooth(clean), max(_NOISE * noise, share * float(np.ptp(clean)))
    leaves = np.flatnonzero(np.abs(level - level[0]) > reach)
    comes = np.flatnonzero(np.abs(level - level[-1]) > reach)
    return [(int(leaves[0]), int(comes[-1]) + 4)] if leaves.size and comes.size else []


# --- both


def _with_rest(
    record: Record,
    first: int,
    last: int,
    noise: float,
    found: Sequence[tuple[float, float, str, str]],
) -> list[Stretch]:
    """Add the rest before and after each experiment, and drop those without a response."""
    stretches = []
    for k, (begin, end, kind, reason) in enumerate(found):
        # Rest shows noise and offset. It is short under a controller, which follows the noise.
        length = max(end - begin, 0.0) * (1.0 if kind in ("relay", "closed loop") else _REST)
        length = max(length, LEAST_SAMPLES * record.interval)
        earliest = found[k - 1][1] if k else float(record.time[first])
        latest = found[k + 1][0] if k + 1 < len(found) else float(record.time[last])
        low = int(np.searchsorted(record.time, max(begin - length, earliest), side="left"))
        high = int(np.searchsorted(record.time, min(end + length, latest), side="right")) - 1
        low, high = max(low, first), min(high, last)
        before = _without_outliers(record.measurement[first:low])
        still = max(2.0 * _NOISE * noise, _SHARE * float(np.ptp(record.measurement[first:last])))
        if not k and before.size and float(np.ptp(before)) > still:
            # No rest: a move before the recording may have made it.
            low = first
        part = record.measurement[low : high + 1]
        lasting = record.time[high] > record.time[low]
        # Many switches by the clock show a response below the noise, and so may those of a
        # controller, whose answers from row to row look like noise.
        least = 0.0 if kind in ("sequence", "closed loop") else 3.0 * _NOISE * noise
        if part.size < 10 or not lasting or float(np.ptp(part)) <= least:
            continue
        stretches.append(Stretch(low, high, kind, reason))
    return stretches
