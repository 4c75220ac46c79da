# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A measurement and a command that were recorded on their own, joined to a record."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.bag.limits import LARGEST_VALUE
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.exchange.messages import start_seconds
from relay_autotune.record.record import PiecewiseConstant, Record


@dataclass(frozen=True)
class Signal:
    """One recorded quantity.

    :param name: topic or column.
    :param time_ns: time of each value [ns], not decreasing, shape (n,).
    :param values: the values, shape (n,).
    """

    name: str
    time_ns: IntArray
    values: FloatArray

    def __len__(self) -> int:
        return int(self.values.size)


def preceded(command: Signal, before: float | None) -> Signal:
    """Return a command with the level that held before its first value.

    :param command: the command.
    :param before: the level; None: it is not known.
    """
    if before is None or not len(command):
        return command
    time_ns = np.concatenate((command.time_ns[:1], command.time_ns))
    return replace(command, time_ns=time_ns, values=np.append(before, command.values))


def join(measurement: Signal, command: Signal, *, dated: bool = True) -> Record:
    """Return the record of a loop of which measurement and command were recorded.

    ``command[i]`` is the level in force when sample ``i + 1`` is taken. Where commands came more
    often than samples, or before the first one, ``held_input`` of the record carries them all.
    Samples taken before the first command is known are left out.

    :param measurement: what the loop measured.
    :param command: what it commanded; each value holds until the next.
    :param dated: whether the times are since the epoch.
    :raises BagError: if one of them is empty, constant, not finite or absurdly large, or they
        do not overlap.
    """
    _check(measurement, "measurement")
    _check(command, "command")
    t, y = measurement.time_ns, measurement.values
    c, u = command.time_ns, command.values
    # The last sample before the first command is kept: it is the one that command answers.
    first = max(int(np.searchsorted(t, c[0], side="right")) - 1, 0)
    t, y = t[first:], y[first:]
    if c[0] > t[-1]:
        raise BagError(
            f"the command {command.name} begins {(c[0] - t[-1]) / 1e9:g} s after the last "
            f"sample of {measurement.name}; expected recordings of the same time"
        )
    if c[-1] < t[0] and not bool(np.any(np.diff(u) != 0.0)):
        raise BagError(f"the command {command.name} ends before {measurement.name} begins")
    # The level that holds at the end of each sample's interval, and when it was commanded.
    last = np.searchsorted(c, t[1:], side="left") - 1
    held = np.maximum(np.append(last, c.size - 1), 0)
    sent = np.maximum(t, c[held])
    origin = int(t[0])
    record = Record(
        time=_seconds(t, origin),
        measurement=y,
        command=u[held],
        command_time=_seconds(sent, origin),
        start=start_seconds(origin) if dated else 0.0,
    )
    exact = PiecewiseConstant.from_samples(_seconds(c, origin), u)
    seen = record.input()
    if not (
        seen.initial == exact.initial
        and np.array_equal(seen.times, exact.times)
        and np.array_equal(seen.values, exact.values)
    ):
        record = replace(record, held_input=exact)
    return record


def window(record: Record, start: float | None, end: float | None) -> Record:
    """Return the part of a record between two times; the command's history is kept.

    :param record: the record.
    :param start: first time to keep [s from the first sample]; None: the beginning.
    :param end: last time to keep [s from the first sample]; None: the end.
    :raises SelectionError: if no sample lies between them.
    """
    if start is None and end is None:
        return record
    time = record.time - record.time[0]
    low = 0 if start is None else int(np.searchsorted(time, start, side="left"))
    high = time.size if end is None else int(np.searchsorted(time, end, side="right"))
    if high <= low:
        raise SelectionError(
            f"no sample lies between --start {0.0 if start is None else start:g} s and "
            f"--end {time[-1] if end is None else end:g} s; the recording is {time[-1]:g} s long"
        )
    return record.part(low, high)


def _check(signal: Signal, role: str) -> None:
    if len(signal) == 0:
        raise BagError(f"the {role} {signal.name} holds no value")
    # NaN compares as False.
    wrong = np.flatnonzero(~(np.abs(signal.values) <= LARGEST_VALUE))
    if wrong.size:
        where = (signal.time_ns[wrong[0]] - signal.time_ns[0]) / 1e9
        raise BagError(
            f"the {role} {signal.name} is {signal.values[wrong[0]]} at {where:g} s "
            f"({wrong.size} of {len(signal)} values are not finite, or beyond "
            f"{LARGEST_VALUE:g}, which no quantity is); leave such a stretch out of the "
            f"recording"
        )
    if bool(np.all(signal.values == signal.values[0])):
        what, remedy = "is constant", ""
        if role == "command":
            what = "never changes"
            remedy = "; if it was another before the recording, give that as --command-before"
        raise BagError(
            f"the {role} {signal.name} {what} ({signal.values[0]:g} in all of {len(signal)} "
            f"values): nothing can be identified from it{remedy}"
        )


def _seconds(time_ns: IntArray, origin: int) -> FloatArray:
    return (time_ns - origin) / 1e9
