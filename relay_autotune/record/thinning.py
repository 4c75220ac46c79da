# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Average a long record in blocks that are short against its response.

Some thousand samples determine a model of a few parameters; a million of them cost time and
memory for useless digits. The mean over a block keeps the information of its samples: white noise
of standard deviation sigma becomes one of sigma/sqrt(k) in the mean of k.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.record.record import PiecewiseConstant, Record, Unthinned, roughness

# Largest number of samples of a record that is not thinned, and number of blocks of a longer one.
LEFT_ALONE = 10_000
BLOCKS = 5_000
# Largest number of changes of a command that is not averaged: each costs as much as a sample.
_MOST_CHANGES = BLOCKS // 4
# Largest move of the measurement from block to block, beyond its noise, as a share of its range:
# a lag then has 20 blocks in its time constant.
_MOST_MOVE = 0.05
# A difference of two means beyond this number of its standard deviations is not noise.
_NOISE = 6.0
# Share before the command's first change, where only a part of the record is used.
_BEFORE = 0.1


def thinned(record: Record) -> Record:
    """Return a record that is short enough to be analysed in bounded time and memory.

    Up to ``LEFT_ALONE`` samples it is the record itself. Of a longer one, blocks of equally many
    samples are averaged into about ``BLOCKS``. Blocks begin at the changes of the command, so
    that switches stay where they were; the command itself stays exact if it changes seldom, and
    is averaged between the blocks' beginnings if it changes often. Where a response is too fast
    for such blocks, they are made smaller, and only the part of the record about the first
    changes of the command is used, ``LEFT_ALONE`` blocks at most.

    :param record: any record.
    """
    n = len(record)
    if n <= LEFT_ALONE:
        return record
    changes = _changes(record)
    often = changes.size > _MOST_CHANGES
    room = BLOCKS if often else BLOCKS - changes.size
    wanted = math.ceil(n / room)
    size = _slow_enough(record.measurement, wanted, white=often)
    part, said = record, ""
    if size < wanted:
        length = size * LEFT_ALONE
        low = _before_first(record, changes, length)
        part = record.part(low, min(low + length, n))
        changes = _changes(part)
        often = changes.size > _MOST_CHANGES
        begun = float(record.time[low] - record.time[0])
        said = (
            f", from {begun:.6g} s to {begun + part.duration:.6g} s alone: the measurement moves "
            "too fast for means of more; choose another part with --start and --end"
        )
    begins = _begins(part, changes[:0] if often else changes, size)
    means = f", means of {len(part) / begins.size:.3g} each" if size > 1 else ""
    return _averaged(
        part,
        begins,
        Unthinned(
            record.interval,
            record.noise_std if record.noise_std > 0.0 else roughness(record.measurement),
            f"of {n} samples {begins.size} are used{means}{said}",
        ),
        often=often,
    )


def _changes(record: Record) -> IntArray:
    """Return the samples from which on the process sees another command, shape (m,)."""
    at = np.searchsorted(record.time, record.input().times, side="left")
    at = np.unique(np.concatenate((at, np.flatnonzero(np.diff(record.command) != 0.0) + 1)))
    return at[(at > 0) & (at < len(record))]


def _slow_enough(y: FloatArray, wanted: int, *, white: bool) -> int:
    """Return the largest block, up to the wanted size, that is short against the response.

    :param y: the measurement [y], shape (n,).
    :param wanted: samples in a block.
    :param white: True: only white noise is allowed for. The response to a command that changes
        all the time looks like noise that is not white.
    """
    noise, size = roughness(y), 1
    while size < wanted:
        larger = min(2 * size, wanted)
        count = y.size // larger
        mean = y[: count * larger].reshape(count, larger).mean(axis=1)
        # A median of three leaves out spikes.
        mean = np.median(np.lib.stride_tricks.sliding_window_view(mean, 3), axis=1)
        # Third differences show noise, of whatever colour, without a slow response.
        own = float(np.median(np.abs(np.diff(mean, 3)))) / (0.6745 * math.sqrt(20.0))
        allowed = _NOISE * math.sqrt(2.0) * (noise / math.sqrt(larger) if white else own)
        if float(np.abs(np.diff(mean)).max()) - allowed > _MOST_MOVE * float(np.ptp(mean)):
            break
        size = larger
    return size


def _before_first(record: Record, changes: IntArray, length: int) -> int:
    """Return where a part of a given length begins that shows the first change of the command."""
    first = int(changes[0]) if changes.size else 0
    return max(0, min(first - int(_BEFORE * length), len(record) - length))


def _begins(record: Record, changes: IntArray, size: int) -> IntArray:
    """Return the first sample of each block, about ``size`` samples long, shape (m,)."""
    kept = [0]
    for at in changes.tolist():
        # Blocks much shorter than others would have much more noise.
        if min(at - kept[-1], len(record) - at) >= size / 2:
            kept.append(at)
    kept.append(len(record))
    pieces = [
        np.linspace(a, b, max(1, round((b - a) / size)), endpoint=False).astype(np.int64)
        for a, b in itertools.pairwise(kept)
    ]
    return np.concatenate(pieces)


def _averaged(record: Record, begins: IntArray, before: Unthinned, *, often: bool) -> Record:
    """Return the means of a record's blocks."""
    count = np.diff(np.append(begins, len(record)))
    time = np.add.reduceat(record.time, begins) / count
    held, command = record.input(), record.command[begins + count - 1]
    if often:
        at = _instants(record, begins, held)
        command = np.add.reduceat(record.command, begins) / count
        if record.continuous_command:
            values = np.interp(at, held.times, held.values, left=held.initial)
            held = PiecewiseConstant(at, values, held.initial)
        else:
            from_then_on = np.append(at[0] - 1.0, at[:-1])
            means = np.append(held.initial, _means(held, at))
            held = PiecewiseConstant.from_samples(from_then_on, means)
    mean = np.add.reduceat(record.measurement, begins) / count
    # Noise that is not white loses less in a mean.
    left = roughness(mean) / max(roughness(record.measurement), np.finfo(float).tiny)
    left = min(max(left, math.sqrt(begins.size / len(record))), 1.0)
    return replace(
        record,
        time=time,
        measurement=mean,
        command=command,
        receive_time=time,
        command_time=time,
        noise_std=left * record.noise_std,
        cycle_start=_same_cycles(record, begins),
        held_input=held,
        unthinned=before,
    )


def _same_cycles(record: Record, begins: IntArray) -> tuple[int, ...]:
    """Return the blocks with which the cycles of a record begin."""
    at = np.searchsorted(begins, np.array(record.cycle_start, dtype=np.int64))
    return tuple(int(i) for i in np.unique(at[at < begins.size]))


def _instants(record: Record, begins: IntArray, held: PiecewiseConstant) -> FloatArray:
    """Return the instants between which a command is averaged [s], strictly increasing."""
    at = np.unique(np.append(record.time[begins], record.time[-1]))
    history = float(at[0] - held.times[0]) if held.times.size else 0.0
    if history > 0.0:
        # What came before the record counts, too.
        pieces = min(BLOCKS, math.ceil(history / float(np.median(np.diff(at)))))
        at = np.append(np.linspace(held.times[0], at[0], pieces, endpoint=False), at)
    return at


def _means(held: PiecewiseConstant, at: FloatArray) -> FloatArray:
    """Return the mean of a held signal between each two instants, shape (m - 1,)."""
    first, last = min(held.times[0], at[0]) - 1.0, max(held.times[-1], at[-1]) + 1.0
    knots = np.concatenate(([first], held.times, [last]))
    area = np.append(0.0, np.cumsum(held.levels * np.diff(knots)))
    return np.asarray(np.diff(np.interp(at, knots, area)) / np.diff(at))
