# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Logs of other tools: a table of text whose columns are time, measurement and command.

What the file does not tell is guessed, and each guess is a note.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from relay_autotune.bag.arrays import FloatArray, IntArray
from relay_autotune.bag.signals import TIME_UNITS, Selection, Signal, flags_of
from relay_autotune.bag.source import open_regular
from relay_autotune.bag.text_table import TextTable, Times, listed
from relay_autotune.bag.words import (
    COMMAND,
    MEASUREMENT,
    SETPOINT,
    doubts_about,
    is_date,
    is_time,
    role_of,
    tag_of,
    unit_in,
    without_unit,
)
from relay_autotune.errors import BagError, NotThereError, SelectionError, os_errors_as

# Least time that is taken as seconds since 1970: no experiment lasts that long.
EPOCH = 1.0e8

# Largest date in each unit, and the unit [ns]: a larger one is in the next unit.
_DATES = (
    (9e9, 1e9, "seconds"),
    (9e12, 1e6, "milliseconds"),
    (9e15, 1e3, "microseconds"),
    (9e18, 1.0, "nanoseconds"),
)
_UNITS = {
    "s": 1e9, "sec": 1e9, "secs": 1e9, "second": 1e9, "seconds": 1e9,
    "ms": 1e6, "msec": 1e6, "millis": 1e6, "milliseconds": 1e6,
    "us": 1e3, "usec": 1e3, "\u00b5s": 1e3, "\u03bcs": 1e3, "micros": 1e3, "microseconds": 1e3,
    "ns": 1.0, "nanoseconds": 1.0,
    "min": 6e10, "mins": 6e10, "minutes": 6e10, "h": 3.6e12, "hours": 3.6e12,
    "d": 8.64e13, "day": 8.64e13, "days": 8.64e13,
}  # fmt: skip
# Days since 1899-12-30, as spreadsheets count them: those of 1970-01-01, those of a date from 1954
# to 2119, and the longest mean step from row to row where nothing says that they are days: as
# seconds, a faster logger than one of 1 kHz.
_DAYS_OF_1970, _SERIAL, _SERIAL_STEP = 25569.0, (20_000.0, 80_000.0), 9e-4
# A text with many columns lets this many pairs be copied.
_MOST_CHOICES = 6
# Number of rows from which two stretches that overlap in time are two recordings.
_RESTART = 10
# From row to row, a time without a unit that steps more is not in seconds [s].
_LONGEST_STEP = 3600.0
# Range of a counter of milliseconds or microseconds, and what its numbers may be divided by.
_COUNTERS = (2.0**32, 2.0**16)
_COUNTED = (1.0, 1e-3, 1e-6)
# An hour [ns], and largest share of rows that a clock which was not set has stamped.
_HOUR, _UNSET = 3600 * 10**9, 0.02
# Usual steps from the last time before a counter wraps around to the first one behind it.
_FEW_STEPS = 3.0
# Rows that were stamped on arrival: the step within a burst, as a share of the mean step; the
# longest time between bursts [ns]; the deviation of their rate, and the least share within it.
_NEAR, _LONGEST_WAIT, _UNSTEADY, _MOST = 0.25, 1e9, 0.3, 0.8
# Smallest jump of a command that steps, as a share of its range, and largest share of rows with
# a change.
_JUMP, _MOVING = 0.05, 0.2


@dataclass(frozen=True)
class Log:
    """The columns read from a file.

    :param measurement: the samples.
    :param command: what was commanded.
    :param dated: whether the times are since the epoch.
    :param units: of the measurement, by "y", and of the command, by "u", as far as they are known.
    :param notes: what was guessed or left out, each a sentence.
    """

    measurement: Signal
    command: Signal
    dated: bool
    units: Mapping[str, str]
    notes: tuple[str, ...] = ()


@contextmanager
def _table(path: Path) -> Iterator[TextTable]:
    """Give the table in a file, and sentences for what else may be in it."""
    try:
        with os_errors_as(BagError, f"cannot read {path}"), open_regular(path) as file:
            yield TextTable(path, file)
    except UnicodeError:
        raise BagError(f"{path} is not a text file; expected CSV in UTF-8") from None
    except csv.Error as error:
        raise BagError(f"{path} is not a CSV file: {error}") from None


def read_columns(path: Path, columns: Sequence[str] | None = None) -> dict[str, Signal]:
    """Return columns of a text as signals, by their names, their rows in the order of their time.

    :param path: the file.
    :param columns: their names; default: all but that of the time.
    :raises SelectionError: if one is not there.
    :raises BagError: if the file cannot be read, or holds anything but numbers.
    """
    with _table(path) as table:
        time = _time(table, Selection(), ())
        assert time is not None
        names = table.names if columns is None else columns
        places = [_named(table, name) for name in names]
        places = [at for at in places if columns is not None or at != time]
        times, values = table.columns(time, places)
    time_ns, _ = _nanoseconds(table, time, times)
    order = np.argsort(time_ns, kind="stable")
    found = {}
    for at, column in zip(places, values, strict=True):
        kept = order[~np.isnan(column[order])]
        found[table.names[at]] = Signal(table.names[at], time_ns[kept], column[kept])
    return found


def read_csv(path: Path, wanted: Selection) -> tuple[Log, ...]:
    """Return measurement and command of each recording in a text with columns.

    Times are rounded to a nanosecond, as those of a bag are, so that a file and the bag made
    of it give the same numbers. Rows are put into the order of their time; rows at the same time
    keep the order of the file. Where the time starts anew, another recording begins.

    :param path: the file; the line above its numbers names the columns, else they are called 1,
        2, 3.
    :param wanted: the columns, and what the file does not say of its times.
    :raises SelectionError: if a column is not named, or not there.
    :raises BagError: if the file cannot be read, or holds anything but numbers.
    """
    with _table(path) as table:
        time, pair = _choose(table, wanted)
        times, columns = table.columns(time, pair)
    values, lines, notes = np.array(columns), table.lines, table.notes
    names = [table.names[at] for at in pair]
    if wanted.measurement is None and wanted.command is None:
        swapped, why = _order(path, names, *values)
        if swapped:
            names, values = names[::-1], values[::-1]
        if why:
            notes.append(
                f"{names[1]!r} is taken as the command and {names[0]!r} as the measurement, "
                f"{why}; --measurement and --command name others"
            )
    if wanted.period is not None:
        counted = np.arange(values.shape[1])
        time_ns, dated = np.round(counted * wanted.period * 1e9).astype(np.int64), False
    else:
        assert time is not None
        name = table.names[time]
        time_ns, dated = _nanoseconds(table, time, times, wanted.time_unit)
        unset = time_ns < EPOCH * 1e9
        if dated and 0 < np.count_nonzero(unset) <= _UNSET * unset.size:
            notes.append(
                f"rows whose {name!r} is before 1973 are left out, since their clock was not set: "
                f"{np.count_nonzero(unset)}, the first in line {lines[unset][0]}"
            )
            values, time_ns, lines = values[:, ~unset], time_ns[~unset], lines[~unset]
    units = {
        n: table.units.get(name) or unit_in(name) for n, name in zip("yu", names, strict=True)
    }
    bounds = _recordings(time_ns)
    if len(bounds) > 2:
        where = ", ".join(str(lines[at]) for at in bounds[1:-1])
        notes.append(
            f"the time starts anew at line {where}: {len(bounds) - 1} recordings are read, one "
            "after the other"
        )
    logs = []
    for first, last in pairwise(bounds):
        part = slice(first, last)
        logs.append(_log(names, time_ns[part], values[:, part], dated, units, notes))
        notes = []
    return tuple(logs)


def _log(
    names: Sequence[str],
    time_ns: IntArray,
    values: FloatArray,
    dated: bool,
    units: Mapping[str, str],
    notes: list[str],
) -> Log:
    """Return one recording, its rows in the order of their time.

    :param values: of both columns, shape (2, n).
    """
    back = int(np.count_nonzero(np.diff(time_ns) < 0))
    if back:
        notes.append(f"the time goes back at {back} rows; rows are put into its order")
    order = np.argsort(time_ns, kind="stable")
    time_ns, values = time_ns[order], values[:, order]
    again = np.append(False, np.diff(time_ns) == 0)
    now, before = values[:, 1:][:, again[1:]], values[:, :-1][:, again[1:]]
    if now.size and np.array_equal(now, before, equal_nan=True):
        notes.append(f"{now.shape[1]} rows stand twice, and count once")
        time_ns, values, again = time_ns[~again], values[:, ~again], again[~again]
    same = int(np.count_nonzero(again))
    if 2 * same > time_ns.size:
        time_ns, rows = _spread(time_ns)
        notes.append(
            f"about {rows:g} rows share each time stamp, which is coarser than the sampling: they "
            "are spread evenly up to the next stamp"
        )
    elif (arrivals := _arrivals(time_ns, values[0])) is not None:
        # What arrives together was taken since the burst before.
        late, rows = _spread(-arrivals[::-1])
        time_ns = -late[::-1]
        notes.append(
            f"rows come in bursts of about {rows:g}, in which the measurement goes on as from one "
            "to the next, so that they were stamped on arrival: they are spread evenly over the "
            "time since the burst before"
        )
    elif same:
        notes.append(
            f"{same} rows have the time of the row before; of such rows the last one's command "
            "counts from then on"
        )
    signals = []
    for name, ordered in zip(names, values, strict=True):
        there = ~np.isnan(ordered)
        if not there.all():
            gap = np.diff(time_ns[there]).max(initial=0)
            notes.append(
                f"{np.count_nonzero(~there)} cells of the column {name!r} are empty and left out; "
                f"the longest gap is {gap / 1e9:.6g} s"
            )
        signals.append(Signal(name, time_ns[there], ordered[there]))
    return Log(signals[0], signals[1], dated, units, tuple(notes))


def _arrivals(time_ns: IntArray, measurement: FloatArray) -> IntArray | None:
    """Return for each row the last stamp of its burst; None: rows were not stamped on arrival.

    Rows at a fixed rate that wait for their transport are many where the burst before is long ago,
    and over a burst the measurement goes on as it does from the burst before to the one after. In
    samples that were taken when they are stamped it would stand still, or move at one row.

    :param time_ns: stamps in order, shape (n,).
    :param measurement: the samples, shape (n,).
    """
    gaps = np.diff(time_ns)
    near = gaps < _NEAR * np.mean(gaps)
    last = np.append(np.flatnonzero(~near), gaps.size)
    many = 2 * np.count_nonzero(near) > gaps.size and last.size >= _RESTART
    if not many or bool(np.isnan(measurement).any()):
        return None
    counts, waits = np.diff(last, prepend=-1), np.diff(time_ns[last])
    rates = waits / counts[1:]
    moves = np.diff(measurement)
    steady = np.mean(np.abs(rates / np.median(rates) - 1.0) <= _UNSTEADY)
    once = 2.0 * np.mean(np.abs(moves[~near])) < np.mean(np.abs(moves[near]))
    if np.median(waits) > _LONGEST_WAIT or steady < _MOST or once:
        return None
    # Of each burst: how far the measurement goes in it, and would go at the pace around it.
    means = np.add.reduceat(measurement, last - counts + 1) / counts
    went = (measurement[last] - measurement[last - counts + 1])[1:-1]
    due = (means[2:] - means[:-2]) / 2.0 * (1.0 - 1.0 / counts[1:-1])
    power = float(np.sum(due**2))
    share = float(np.sum(went * due)) / power if power else 0.0
    error = float(np.sqrt(np.mean((went - share * due) ** 2) / power)) if power else 0.0
    return np.repeat(time_ns[last], counts) if 0.5 + 2.0 * error < share < 1.5 else None


def _spread(time_ns: IntArray) -> tuple[IntArray, float]:
    """Return the times of rows that share coarse stamps, and how many share one.

    :param time_ns: stamps in order, shape (n,).
    """
    stamps, counts = np.unique(time_ns, return_counts=True)
    usual = float(np.median(counts))
    gaps = np.diff(stamps)
    gaps = np.append(gaps, np.median(gaps) if gaps.size else 0)
    place = np.arange(time_ns.size) - np.repeat(np.cumsum(counts) - counts, counts)
    # The first stamp and the last one may have been cut short.
    rows = counts.astype(np.float64)
    rows[[0, -1]] = np.maximum(rows[[0, -1]], usual)
    begin = np.zeros(counts.size)
    begin[0] = rows[0] - counts[0]
    share = (np.repeat(begin, counts) + place) / np.repeat(rows, counts)
    return time_ns + np.round(share * np.repeat(gaps, counts)).astype(np.int64), usual


def _nanoseconds(
    table: TextTable, at: int, times: Times, time_unit: str | None = None
) -> tuple[IntArray, bool]:
    """Return times in nanoseconds, and whether they are dates.

    :param table: takes what is to be known of them as notes.
    :param at: place of their column.
    :param times: as they stand.
    :param time_unit: their unit; None: as the table says.
    """
    path, name, notes = table.path, table.names[at], table.notes
    given = time_unit or table.units.get(name)
    if times.dates:
        if max(map(abs, times.dates)) >= 2**63:
            raise BagError(
                f"{path}: the column {name!r} has dates before 1678 or after 2262, which cannot "
                "be counted in nanoseconds; expected those of a recording"
            )
        notes.append(f"the column {name!r} is taken as dates in UTC, unless they name a zone")
        return _summer_time(name, np.array(times.dates, dtype=np.int64), notes), True
    if times.clock:
        notes.append(f"the column {name!r} is taken as the time of day")
        clock = np.array(times.clock, dtype=np.int64)
        half_day = 43200 * 10**9
        midnights = np.cumsum(np.diff(clock, prepend=clock[0]) < -half_day)
        return _summer_time(name, clock + 2 * half_day * midnights, notes), False
    time = _unwrapped(np.array(times.numbers), name, notes)
    largest = float(np.abs(time).max())
    step = float(np.median(np.abs(np.diff(time))))
    unit = given or _unit_of(name)
    scale = _UNITS.get(unit.lower()) if unit else None
    in_days = scale == _UNITS["d"] or (scale is None and is_date(name))
    if (scale is None or in_days) and _is_serial(time, math.inf if in_days else _SERIAL_STEP):
        notes.append(
            f"the column {name!r} is taken as days since 1899-12-30, as spreadsheets count dates; "
            "--time-unit names another unit"
        )
        time, scale = (time - _DAYS_OF_1970) * 86400.0, 1e9
        largest = float(np.abs(time).max())
    elif scale is not None and scale != 1e9:
        said = "" if given else f", as {name!r} says"
        notes.append(f"the time is taken in {unit}{said}")
    elif scale is None and largest > _DATES[0][0]:
        fits = [date for date in _DATES[1:] if largest <= date[0]]
        # Dates of a recording lie close to each other; else it is no time.
        if not fits or float(np.min(time)) < 0.1 * largest:
            raise BagError(
                f"{path}: the column {name!r} runs to {largest:g}; expected a time in seconds"
            )
        scale = fits[0][1]
        notes.append(f"the column {name!r} is taken as {fits[0][2]} since 1970")
    elif scale is None and step > _LONGEST_STEP:
        raise SelectionError(
            f"{path}: the column {name!r} steps by {step:g} from row to row and names no unit; "
            f"expected seconds, or --time-unit {'|'.join(TIME_UNITS)}"
        )
    elif scale is None and step >= 2.0 and not np.any(time % 1.0):
        notes.append(
            f"the time is taken in seconds, {step:g} s from row to row; --time-unit names another"
        )
    scale = scale or 1e9
    if largest * scale > 9.2e18:
        raise BagError(
            f"{path}: the column {name!r} runs to {largest:g}; expected a time in seconds"
        )
    # In two steps, since a date in nanoseconds is finer than a double.
    whole = np.floor(time)
    ns = whole.astype(np.int64) * int(scale) + np.round((time - whole) * scale).astype(np.int64)
    return ns, bool(ns[0] > EPOCH * 1e9)


def _summer_time(name: str, time_ns: IntArray, notes: list[str]) -> IntArray:
    """Return times of a clock that may be set back by an hour, so that they go on rising."""
    moves = np.diff(time_ns)
    usual = float(np.median(np.abs(moves)))
    back = (moves + _HOUR > 0) & (moves + _HOUR <= _FEW_STEPS * usual) & (moves < 0)
    if not np.any(back) or usual > _HOUR / 10:
        return time_ns
    rows = ", ".join(map(str, np.flatnonzero(back) + 2))
    notes.append(
        f"the clock of {name!r} is set back by an hour at row {rows} of numbers, as at the end of "
        "summer time, and is counted on"
    )
    return time_ns + np.append(0, _HOUR * np.cumsum(back))


def _is_serial(time: FloatArray, longest: float) -> bool:
    """Return whether times are the dates of a spreadsheet.

    :param longest: mean step from row to row that they may have at most.
    """
    (low, high), first, last = _SERIAL, float(time.min()), float(time.max())
    return low <= first <= last <= high and last - first < longest * (time.size - 1)


def _unwrapped(time: FloatArray, name: str, notes: list[str]) -> FloatArray:
    """Return times of a counter of 16 or 32 bits as if it had more, so that they go on rising."""
    moves = np.diff(time)
    step = float(np.median(np.abs(moves)))
    for range_ in (bits * unit for bits in _COUNTERS for unit in _COUNTED):
        wraps = np.abs(moves + range_) <= _FEW_STEPS * step
        inside = float(time.min()) >= 0.0 and float(time.max()) <= range_
        if step < range_ / 100.0 and inside and bool(wraps.any()):
            notes.append(f"the column {name!r} wraps around at {range_:.10g} and is counted on")
            return time + range_ * np.append(0, np.cumsum(wraps))
    return time


def _unit_of(name: str) -> str | None:
    """Return the unit that a name ends with, in brackets or as its last word."""
    if unit := unit_in(name):
        return unit
    last = re.split(r"[\W_]+|(?<=[a-z])(?=[A-Z])", name.strip())[-1]
    return last if last.lower() in _UNITS else None


def _recordings(time_ns: IntArray) -> list[int]:
    """Return the first row of each recording, and the number of rows.

    A time that goes back and runs on from there begins another recording; one that goes back at
    single rows only is out of order.
    """
    back = (np.flatnonzero(np.diff(time_ns) < 0) + 1).tolist()
    ends = [*back, time_ns.size][1:]
    bounds = [0]
    for at, end in zip(back, ends, strict=True):
        before = at - bounds[-1]
        behind = int(np.count_nonzero(time_ns[bounds[-1] : at] < time_ns[at]))
        if min(before, end - at) >= _RESTART and before - behind >= _RESTART:
            bounds.append(at)
    return [*bounds, time_ns.size]


def _choose(table: TextTable, wanted: Selection) -> tuple[int | None, list[int]]:
    """Return the places of the time, None without one, and of measurement and command.

    :param table: takes how they were found as notes.
    :param wanted: the columns, as far as they are named.
    :raises SelectionError: if neither flags nor names tell which they are.
    """
    names, given = table.names, (wanted.measurement, wanted.command)
    pair = [_named(table, name) for name in given if name is not None]
    time = _time(table, wanted, pair)
    rest = [k for k in range(len(names)) if k != time]
    if not pair and len(rest) == 2:
        pair = rest
    table.notes += doubts_about(*given)
    choices, still, sure = [], [], False
    if len(pair) < 2:
        moving = {names[k] for k in table.looks[0]}
        still = [names[k] for k in rest if names[k] not in moving]
        # Of a command that never changes it may be told what it was before.
        held = still if wanted.command_before is None else ()
        free = [names[k] for k in rest]
        choices = _choices(free, given, (still, held))
        # Where another pair is constant, the one that moves may be of something else.
        sure = len(choices) == 1 and choices == _choices(free, given, ((), ()))
    if sure:
        ((y, u, named),) = choices
        pair = [names.index(y), names.index(u)]
        why = "as their names say" if named else "since no other pair is possible"
        table.notes.append(
            f"of {len(names)} columns {y!r} is taken as the measurement and {u!r} as the command, "
            f"{why}; --measurement and --command name others"
        )
    if len(pair) < 2:
        least = (
            "; expected time, measurement and command in each row (put blocks of single signals "
            "side by side), or two columns and their sampling period with --period S"
        )
        if len(set(names)) < len(names):
            choices = []
            least = "; expected a name of its own for each, in the line just above the numbers"
        elif len(names) >= 3:
            other = "" if time is None else f", and --time NAME if it is not {names[time]!r}"
            least = f"; name two of them with --measurement NAME --command NAME{other}"
            least += f" (constant, empty or text: {listed(still)})" * bool(still)
            least += ", such as" * bool(choices)
        raise SelectionError(
            f"{table.path} has {len(names)} columns: {listed(names)}{least}",
            [(flags_of(y, u), "as their names say" * named) for y, u, named in choices],
        )
    for at in pair:
        _named(table, names[at])
    if len({time, *pair}) < 3:
        chosen = [names[at] for at in (time, *pair) if at is not None]
        no_time = "; where there is no time, give the sampling period with --period S"
        untimed = no_time if time in pair else ""
        raise SelectionError(
            f"time, measurement and command must be three columns of {table.path}, "
            f"found {listed(chosen)}{untimed}"
        )
    return time, pair


def _time(table: TextTable, wanted: Selection, taken: Sequence[int]) -> int | None:
    """Return the place of the time; None: rows come one period after another.

    :param table: takes how it was found as a note.
    :param wanted: the column, if it is named.
    :param taken: places of columns that are named as something else.
    :raises SelectionError: if no column is named as a time, or is the first or only one to rise.
    """
    names = table.names
    if wanted.period is not None:
        if wanted.time is not None:
            raise SelectionError(
                "--period is for a file without times; leave out --time or --period"
            )
        if not wanted.period > 0.0:
            raise SelectionError(
                f"--period {wanted.period:g} is no time from row to row; expected > 0"
            )
        return None
    if wanted.time is not None:
        return _named(table, wanted.time)
    # The first column, unless only another one is called so.
    called_so = [k for k, name in enumerate(names) if k not in taken and is_time(name)]
    if is_time(names[0]) or len(names) < 3:
        return 0
    if called_so:
        table.notes.append(f"the time is taken from the column {names[called_so[0]]!r}")
        return called_so[0]
    rising = [k for k in table.looks[1] if k not in taken and role_of(names[k]) is None]
    if rising[:1] == [0]:
        return 0
    if len(rising) == 1:
        name = names[rising[0]]
        table.notes.append(f"the time is taken from the column {name!r}, which alone rises")
        return rising[0]
    others = f" as {listed([names[k] for k in rising])} do" * bool(rising)
    raise SelectionError(
        f"{table.path}: the column {names[0]!r} does not rise from row to row{others}, so it is "
        "no time; name that with --time NAME, or, if there is none, give the sampling period with "
        "--period S"
    )


def _choices(
    names: Sequence[str], given: Sequence[str | None], without: Sequence[Sequence[str]]
) -> list[tuple[str, str, bool]]:
    """Return columns that may be measurement and command, and whether both are named so.

    :param names: of the columns that are free.
    :param given: measurement and command, as far as they are named.
    :param without: columns that cannot be the measurement, and the command, unless they are given.
    """
    names = list(dict.fromkeys(names))
    roles = {name: role_of(name) for name in names}
    hints = [[n for n in names if roles[n] == role] for role in (MEASUREMENT, COMMAND)]
    unclear = [n for n in names if roles[n] is None]
    pair = [
        [name] if name is not None else [n for n in hinted or unclear if n not in out]
        for name, hinted, out in zip(given, hints, without, strict=True)
    ]
    found = [(y, u, all(hints)) for y in pair[0] for u in pair[1] if y != u]
    # Of a plant's columns, those of one loop belong together.
    tags = {name: tag_of(name) for pool in pair for name in pool}
    of_one = [(y, u, named) for y, u, named in found if tags[y] == tags[u] != ""]
    alike = [
        (y, u, named) for y, u, named in found if tags[u] and f" {tags[y]}".endswith(f" {tags[u]}")
    ]
    # One pair may be alike by chance.
    return (of_one or alike * (len(alike) > 1) or found)[:_MOST_CHOICES]


def _order(
    path: Path, names: Sequence[str], first: FloatArray, second: FloatArray
) -> tuple[bool, str]:
    """Return whether the first of two columns is the command, and why; empty: as is usual.

    :raises SelectionError: if one is a set-point, of which nothing can be identified.
    """
    for name in names:
        if role_of(name) == SETPOINT:
            raise SelectionError(
                f"{path}: the column {name!r} seems to be a set-point; expected the command that "
                "the controller put out; name columns with --measurement and --command if it is"
            )
    roles = [role_of(name) for name in names]
    if set(roles) != {MEASUREMENT, COMMAND}:
        # One name alone may be that of a part on either side: "T_out" and "flow", or "Ausgang".
        for looks, how in ((_rests, "never changes"), (_steps, "moves in steps")):
            if looks(first) != looks(second):
                return looks(first), f"since it {how}"
    if roles[0] == roles[1]:
        return False, "since it comes last"
    swapped = roles[0] == COMMAND or roles[1] == MEASUREMENT
    return swapped, "as their names say" if swapped else ""


def _rests(values: FloatArray) -> bool:
    """Return whether a signal has one value at most."""
    there = values[~np.isnan(values)]
    return not np.any(there != there[:1])


def _steps(values: FloatArray) -> bool:
    """Return whether a signal rests for most of the time and then jumps."""
    there = values[~np.isnan(values)]
    moves = np.abs(np.diff(there))
    moves = moves[moves > 0.0]
    return 0 < moves.size <= _MOVING * there.size and float(np.median(moves)) >= _JUMP * float(
        np.ptp(there)
    )


def _named(table: TextTable, wanted: str) -> int:
    """Return the place of a column by its name, perhaps without the unit, or by its number."""
    path, names = table.path, table.names
    numbers = [str(k + 1) for k in range(len(names))]
    ways = (names, map(without_unit, names), numbers)
    every = ([k for k, name in enumerate(way) if name == wanted] for way in ways)
    fits = next(filter(None, every), [])
    if len(fits) > 1:
        raise SelectionError(
            f"{path} has {len(fits)} columns named {wanted!r}; expected a name of its own for "
            "each: change them in its header line"
        )
    if not fits:
        known = {without_unit(name).casefold(): name for name in names}
        within = (name for name in known if wanted.casefold() in name)
        near = [*difflib.get_close_matches(wanted.casefold(), known, n=1), *within]
        meant = f"; did you mean {known[near[0]]!r}?" if near else ""
        raise NotThereError(
            f"{path} has no column {wanted!r}{meant}", f"its columns are {listed(names)}"
        )
    return fits[0]
