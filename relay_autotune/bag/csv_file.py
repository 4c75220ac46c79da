# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Logs of other tools: a table of text whose columns are time, measurement and command.

The rows of numbers tell where the table begins and what separates its columns: the separator is
the one that makes the most numbers, and the header is the text just above the first of them.
What the text does not tell is guessed, and each guess is a note.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from relay_autotune.bag.arrays import FloatArray, IntArray
from relay_autotune.bag.limits import LARGEST_TEXT, LONGEST_LINE
from relay_autotune.bag.signals import TIME_UNITS, Selection, Signal, flags_of
from relay_autotune.bag.source import open_regular
from relay_autotune.errors import BagError, SelectionError, visible

# Each is preferred to those after it where both make as many numbers: beside a semicolon, a tab
# or a space a comma may be the decimal point.
_SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "spaces"}
_REMARKS = ("#", "%", "//")
# The beginning of a file that tells its encoding and its separator [bytes].
_FIRST = 64 << 10
# Largest number of lines before the rows of numbers.
_LONGEST_HEAD = 1000
# Largest share of rows with text in place of a number that are left out; more are a fault.
_DAMAGED = 0.02
_MISSING = frozenset(("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--"))
_SWITCH = {"on": 1.0, "off": 0.0, "true": 1.0, "false": 0.0}
_QUANTITY = re.compile(r"([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(%|[^\W\d_/]{1,4}|\u00b0\w?)")
_1970 = datetime(1970, 1, 1, tzinfo=UTC)
_DATE = re.compile(
    r"(?:(\d{1,4})([-/.])(\d{1,2})\2(\d{1,4})(?:T|,?\s+))?"
    r"(\d{1,2}):(\d\d)(?::(\d\d)(?:[.,](\d{1,9}))?)?\s*([AaPp][Mm])?\s*(Z|[+-]\d\d:?\d\d)?"
)


@dataclass(frozen=True)
class Times:
    """The times of the rows in one of three forms, the others empty; all empty: they have none.

    :param numbers: as they stand.
    :param dates: nanoseconds since 1970.
    :param clock: times of day [ns].
    """

    numbers: list[float] = field(default_factory=list)
    dates: list[int] = field(default_factory=list)
    clock: list[int] = field(default_factory=list)


class TextTable:
    """The rows of a text: their separator, their header, their numbers.

    :param path: its name in messages.
    :param file: the file, from its beginning.
    :raises BagError: if it holds no table.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path = path
        self.notes: list[str] = []
        self.lines: IntArray = np.empty(0, dtype=np.int64)
        size = file.seek(0, io.SEEK_END)
        if size > LARGEST_TEXT:
            raise BagError(
                f"{path} has {size} bytes, more than the {LARGEST_TEXT} that are read of a text; "
                "cut it into parts, or make a bag of it"
            )
        file.seek(0)
        first = file.read(_FIRST)
        file.seek(0)
        # Closing the text would close the file a second time.
        self._text = io.TextIOWrapper(file, newline="", encoding=self._encoding(first))
        separator = _separator(self._text.read(_FIRST // 4))
        self._text.seek(0)
        if separator != ",":
            self.notes.append(f"columns are taken as separated by {_SEPARATORS[separator]}")
        self._separator = separator
        self._reader = csv.reader(
            _lines(path, self._text, separator),
            delimiter=separator,
            skipinitialspace=separator != "\t",
        )
        self._commas = self._points = False
        self._head: list[str] = []
        self._waiting: list[tuple[int, list[str]]] = []
        self.units: dict[str, str] = {}
        self.names = self._header()
        self._day = self._day_before_its_time()
        self.names = self._joined(self.names)

    def _encoding(self, first: bytes) -> str:
        if first[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return "utf-16"
        with suppress(UnicodeDecodeError):
            # A character may be cut at the end.
            first[: first.rfind(b"\n") + 1 or None].decode("utf-8-sig")
            return "utf-8-sig"
        if b"\0" in first:
            return "utf-8-sig"
        self.notes.append("the text is not UTF-8 and is taken as Latin-1")
        return "latin-1"

    def _header(self) -> list[str]:
        """Return the names of the columns; the rows of numbers wait."""
        rows: list[tuple[int, list[str]]] = []
        for row in islice(self._reader, _LONGEST_HEAD):
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((self._reader.line_num, cells))
            # One row of numbers may be a remark, such as the gains of a controller.
            if len(rows) > 1 and _are_data(rows[-2][1], rows[-1][1]):
                data = len(rows) - 2
                break
        else:
            data = next((k for k, (_, cells) in enumerate(rows) if _is_data(cells)), len(rows))
        if not rows:
            raise BagError(f"{self._path} is empty; expected a header line, then rows of numbers")
        self._waiting = rows[data:]
        width = len(self._waiting[0][1]) if self._waiting else 0
        # A separator at the end of each line makes no column.
        filled = max(
            (k + 1 for _, row in self._waiting for k, c in enumerate(row) if c), default=0
        )
        above = [(line, _bare(cells, filled)) for line, cells in rows[:data]]
        fits = [self._is_header(cells, filled) for _, cells in above]
        if not fits or not fits[-1]:
            if not width:
                raise BagError(
                    f"{self._path} has 0 rows of numbers; expected columns of time, measurement "
                    "and command, separated by commas, semicolons, tabs or spaces"
                )
            names = [str(number) for number in range(1, width + 1)]
            why = "there is no header line"
            if above and not _is_data(above[-1][1]) and sum(map(bool, above[-1][1])) > width // 2:
                why = (
                    f"line {above[-1][0]} has {len(above[-1][1])} names and the rows have {width} "
                    "cells, so that it does not tell which is which"
                )
            self.notes.append(f"{why}; the columns are called {listed(names)}")
            return names
        line, cells = above[-1]
        units: list[str] = []
        if len(above) > 1 and fits[-2] and len(above[-2][1]) == len(cells) and _are_units(cells):
            self.notes.append(f"line {line} holds no number and is taken for units")
            units, (line, cells) = cells, above[-2]
        self._head = cells
        while not cells[-1] and len(cells) > filled:
            cells = cells[:-1]
        names = [visible(name) for name in cells]
        self.units = {name: unit for name, unit in zip(names, units, strict=False) if unit}
        return names

    def _day_before_its_time(self) -> int | None:
        """Return the place of a column of dates just before one of times of day; None: none."""
        cells = self._waiting[0][1] if self._waiting else []
        for at, (day, time) in enumerate(pairwise(cells)):
            both = _date(f"{day} {time}")
            if both is not None and both[1] and _date(day) is None:
                named = listed(self.names[at : at + 2])
                self.notes.append(f"the columns {named} are read as one, of date and time")
                return at
        return None

    def _joined(self, cells: list[str]) -> list[str]:
        """Return cells with a date and the time of day behind it as one."""
        at = self._day
        if at is None or len(cells) < at + 2:
            return cells
        return [*cells[:at], " ".join(cells[at : at + 2]), *cells[at + 2 :]]

    def _is_header(self, cells: Sequence[str], width: int) -> bool:
        # Names with spaces in them make more cells than there are columns.
        fits = len(cells) == width if self._separator == " " else len(cells) >= max(width, 2)
        return fits and sum(map(bool, cells)) >= 2 and not _is_data(cells)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield each row of numbers with its line number."""
        following = ((self._reader.line_num, row) for row in self._reader)
        left_out = 0
        for line, row in chain(self._waiting, following):
            if not any(cell.strip() for cell in row):
                continue
            cells = [cell.strip() for cell in row]
            if cells[0].startswith(_REMARKS) or (self._head and cells == self._head):
                left_out += 1
                continue
            cells = self._joined(cells)
            # A separator at a line's end is no cell.
            if any(cells[len(self.names) :]):
                raise BagError(
                    f"{self._path}, line {line}: {len(cells)} cells, but {len(self.names)} "
                    f"columns have a name; a decimal comma, or a separator within a text, would "
                    f"make such a line"
                )
            yield line, cells
        if left_out:
            self.notes.append(f"{left_out} lines between the rows hold remarks and are left out")

    def columns(self, time: int | None, places: Sequence[int]) -> tuple[Times, list[FloatArray]]:
        """Return the times and the columns at some places; NaN: an empty cell.

        :param time: the place of the time; None: there is none, and rows are counted.
        :param places: of the other columns.
        :raises BagError: if a cell holds anything but a number.
        """
        times = Times()
        values: list[list[float]] = [[] for _ in places]
        suffixes: list[str | None] = [None] * len(places)
        lines: list[int] = []
        untimed, damaged = 0, []
        for line, row in self._rows():
            stamp = "" if time is None or time >= len(row) else row[time]
            if time is not None and stamp.lower() in _MISSING:
                untimed += 1
                continue
            try:
                found = self._numbers(line, row, places, suffixes)
                if time is not None:
                    self._stamp(line, time, stamp, times)
            except BagError as error:
                damaged.append(error)
                continue
            for column, number in zip(values, found, strict=True):
                column.append(number)
            lines.append(line)
        if damaged and len(damaged) > _DAMAGED * len(lines):
            raise damaged[0]
        if len(lines) < 2:
            raise BagError(f"{self._path} has {len(lines)} rows of numbers; expected at least two")
        for count, what in ((len(times.dates), "dates"), (len(times.clock), "times of day")):
            if time is not None and 0 < count < len(lines):
                raise BagError(
                    f"{self._path}: of {len(lines)} cells of {self.names[time]!r} {count} are "
                    f"{what}, the others not; expected one of them"
                )
        if self._commas and self._points:
            raise BagError(
                f"{self._path} has numbers with a decimal comma and others with a point; "
                "expected one of them"
            )
        if self._commas:
            self.notes.append("a comma within a number is taken as the decimal point")
        if untimed:
            self.notes.append(f"{untimed} rows without a time are left out")
        if damaged:
            self.notes.append(
                f"{len(damaged)} rows hold something else than numbers and are left out, "
                f"the first: {str(damaged[0]).removeprefix(f'{self._path}, ')}"
            )
        self.lines = np.array(lines, dtype=np.int64)
        return times, [np.array(column) for column in values]

    def _numbers(
        self, line: int, row: list[str], places: Sequence[int], suffixes: list[str | None]
    ) -> list[float]:
        """Return the numbers of a row at some places; NaN: an empty cell.

        :param suffixes: the units behind the numbers of each place so far, which stay the same.
        """
        found = []
        for k, at in enumerate(places):
            cell = row[at] if at < len(row) else ""
            number, suffix = self._number(line, at, cell)
            found.append(number)
            if math.isnan(number):
                continue
            if suffixes[k] not in (None, suffix):
                raise self._no_number(line, at, cell)
            suffixes[k] = suffix
        return found

    def _stamp(self, line: int, at: int, cell: str, times: Times) -> None:
        date = None if _is_number(cell) else _date(cell)
        if date is None:
            times.numbers.append(self._number(line, at, cell)[0])
        else:
            (times.dates if date[1] else times.clock).append(date[0])

    def _number(self, line: int, at: int, cell: str) -> tuple[float, str]:
        """Return a number, NaN of an empty cell, and the unit behind it."""
        low = cell.lower()
        if low in _MISSING:
            return math.nan, ""
        if low in _SWITCH:
            return _SWITCH[low], "on or off"
        text, suffix = cell, ""
        if not _is_number(text) and (quantity := _QUANTITY.fullmatch(text)) is not None:
            text, suffix = quantity[1], quantity[2]
        if self._separator != ",":
            # "1.234,5" is neither.
            if "," in text and "." not in text and text.count(",") == 1:
                text, self._commas = text.replace(",", "."), True
            elif "." in text:
                self._points = True
        if not _is_number(text):
            raise self._no_number(line, at, cell)
        value = float(text)
        if not math.isfinite(value):
            raise self._no_number(line, at, cell, finite=True)
        return value, suffix

    def _no_number(self, line: int, at: int, cell: str, *, finite: bool = False) -> BagError:
        shown = cell if finite else repr(visible(cell))
        return BagError(
            f"{self._path}, line {line}: {self.names[at]!r} is {shown}; expected a "
            f"{'finite ' if finite else ''}number"
        )


def _lines(path: Path, text: TextIO, separator: str) -> Iterator[str]:
    """Yield the lines of a text, and refuse one that is too long."""
    while line := text.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            raise BagError(
                f"{path} has a line of more than {LONGEST_LINE} characters; no CSV file"
            )
        # Where spaces separate, several are one, and a tab is one, too.
        yield " ".join(line.split()) + "\n" if separator == " " else line


def _separator(first: str) -> str:
    """Return the separator that makes the most numbers of the first lines."""
    lines = [line for line in first.splitlines()[:200] if line.strip()]

    def numbers(mark: str) -> int:
        counts = (
            sum(map(_is_value, line.split() if mark == " " else line.split(mark)))
            for line in lines
        )
        return sum(count for count in counts if count > 1)

    # The first of several that make as many.
    best = max(_SEPARATORS, key=numbers)
    return best if numbers(best) else ","


def _bare(cells: Sequence[str], width: int) -> list[str]:
    """Return the cells of a line without the mark of a remark, and without what a program adds."""
    first = cells[0].lstrip("#%/ ")
    rest = [first, *cells[1:]]
    # "# t y u" separated by spaces, or a program's indent
    spare = len(rest) - width
    return rest[spare:] if width and spare > 0 and not any(rest[:spare]) else rest


def _is_data(cells: Sequence[str]) -> bool:
    return not cells[0].startswith(_REMARKS) and sum(map(_is_value, cells)) >= 2


def _are_data(first: Sequence[str], second: Sequence[str]) -> bool:
    return len(first) == len(second) and _is_data(first) and _is_data(second)


def _is_value(cell: str) -> bool:
    text = cell.strip()
    quantity = _QUANTITY.fullmatch(text)
    number = (quantity[1] if quantity else text).replace(",", ".")
    return bool(text) and (_is_number(number) or _date(text) is not None)


def _are_units(row: Sequence[str]) -> bool:
    cells = [cell for cell in row if cell]
    return len(cells) >= 2 and not any(re.search(r"\d", cell) for cell in cells)


def _date(cell: str) -> tuple[int, bool] | None:
    """Return a date in nanoseconds since 1970, UTC where it names no zone, or a time of day.

    The second value tells whether it is a date. Of three numbers one of four digits is the year,
    and 1/2 is the second of January unless a number above 12 says otherwise; 1.2 the first of
    February.
    """
    match = _DATE.fullmatch(cell)
    if match is None:
        return None
    a, mark, b, c, hour, minute, second, fraction, half, zone = match.groups()
    hours = int(hour) % 12 + 12 * (half.lower() == "pm") if half else int(hour)
    seconds = int(hours) * 3600 + int(minute) * 60 + int(second or 0)
    ns = seconds * 10**9 + int((fraction or "0").ljust(9, "0"))
    if a is None:
        return ns, False
    first, middle, last = int(a), int(b), int(c)
    if len(a) == 4:
        year, month, day = first, middle, last
    else:
        year = last + 2000 * (last < 100)
        day_first = mark != "/" or first > 12
        day, month = (first, middle) if day_first else (middle, first)
    away = timedelta()
    if zone and zone != "Z":
        away = timedelta(hours=int(zone[1:3]), minutes=int(zone[-2:])) * (
            1 if zone[0] == "+" else -1
        )
    try:
        midnight = datetime(year, month, day, tzinfo=timezone(away))
    except ValueError:
        return None
    return (midnight - _1970) // timedelta(microseconds=1) * 1000 + ns, True


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def listed(names: Sequence[str]) -> str:
    """Return names in quotes."""
    return ", ".join(repr(name) for name in names)


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
}  # fmt: skip
_UNIT = re.compile(r"\s*[\[(]\s*(?P<unit>[^\])]*?)\s*[\])]\s*$")
# Words in the names of columns.
_TIMES = frozenset(
    ("time", "timestamp", "stamp", "date", "datetime", "clock", "elapsed", "millis", "micros",
     "ms", "us", "sec", "seconds", "zeit", "tempo", "tiempo", "temps", "czas", "tijd", "tid")
)  # fmt: skip
_COMMANDS = frozenset(
    ("u", "q", "cmd", "command", "control", "input", "heater", "duty", "pwm", "voltage", "volt",
     "power", "pump", "valve", "fan", "dac", "effort", "torque", "throttle", "actuator",
     "actuators", "op", "mv", "co", "esc", "drive")
)  # fmt: skip
_MEASUREMENTS = frozenset(
    ("y", "t", "pv", "temp", "temperature", "rpm", "speed", "velocity", "omega", "position",
     "angle", "level", "height", "pressure", "flow", "distance", "humidity", "measured",
     "measurement", "actual", "sensor", "adc", "encoder")
)  # fmt: skip
_SETPOINTS = frozenset(("setpoint", "sp", "target", "reference", "ref", "desired"))
# A text with many columns lets this many pairs be copied.
_MOST_CHOICES = 6
# Number of rows from which two stretches that overlap in time are two recordings.
_RESTART = 10
# From row to row, a time without a unit that steps more is not in seconds [s].
_LONGEST_STEP = 3600.0
# Range of a counter of milliseconds or microseconds, and what its numbers may be divided by.
_COUNTERS = (2.0**32, 2.0**16)
_COUNTED = (1.0, 1e-3, 1e-6)
# Usual steps from the last time before a counter wraps around to the first one behind it.
_FEW_STEPS = 3.0
# Smallest jump of a command that steps, as a share of its range, and largest share of rows with
# a change.
_JUMP, _MOVING = 0.05, 0.2


@dataclass(frozen=True)
class Log:
    """The columns read from a file.

    :param measurement: the samples.
    :param command: what was commanded.
    :param dated: whether the times are since the epoch.
    :param notes: what was guessed or left out, each a sentence.
    """

    measurement: Signal
    command: Signal
    dated: bool
    notes: tuple[str, ...] = ()


@contextmanager
def _table(path: Path) -> Iterator[TextTable]:
    """Give the table in a file, and sentences for what else may be in it."""
    try:
        with open_regular(path) as file:
            yield TextTable(path, file)
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror or error}") from error
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
        time = _time(path, table.names, Selection(), ())
        assert time is not None
        names = table.names if columns is None else columns
        places = [_named(path, table.names, name) for name in names]
        places = [at for at in places if columns is not None or at != time]
        times, values = table.columns(time, places)
    name = table.names[time]
    time_ns, _ = _nanoseconds(path, name, times, table.units.get(name), [])
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
        time, pair = _choose(path, table.names, wanted)
        times, (y, u) = table.columns(time, pair)
    notes = table.notes
    names = [table.names[at] for at in pair]
    if wanted.measurement is None and wanted.command is None:
        why = _swap(path, names, y, u)
        if why:
            names, y, u = names[::-1], u, y
            notes.append(
                f"{names[1]!r} is taken as the command and {names[0]!r} as the measurement, "
                f"{why}; --measurement and --command name others"
            )
    if wanted.period is not None:
        time_ns, dated = np.round(np.arange(y.size) * wanted.period * 1e9).astype(np.int64), False
    else:
        assert time is not None
        name = table.names[time]
        if time and wanted.time is None:
            notes.append(f"the time is taken from the column {name!r}")
        unit = wanted.time_unit or table.units.get(name)
        time_ns, dated = _nanoseconds(path, name, times, unit, notes)
        if wanted.time is None and not _is_time(name):
            _check_rises(path, name, time_ns)
    bounds = _recordings(time_ns)
    if len(bounds) > 2:
        lines = ", ".join(str(table.lines[at]) for at in bounds[1:-1])
        notes.append(
            f"the time starts anew at line {lines}: {len(bounds) - 1} recordings are read, one "
            "after the other"
        )
    logs = []
    for first, last in pairwise(bounds):
        part = slice(first, last)
        logs.append(_log(names, time_ns[part], (y[part], u[part]), dated, notes))
        notes = []
    return tuple(logs)


def _log(
    names: Sequence[str],
    time_ns: IntArray,
    values: tuple[FloatArray, FloatArray],
    dated: bool,
    notes: list[str],
) -> Log:
    """Return one recording, its rows in the order of their time."""
    back = int(np.count_nonzero(np.diff(time_ns) < 0))
    if back:
        notes.append(f"the time goes back at {back} rows; rows are put into its order")
    order = np.argsort(time_ns, kind="stable")
    time_ns = time_ns[order]
    same = int(np.count_nonzero(np.diff(time_ns) == 0))
    if 2 * same > time_ns.size:
        time_ns, rows = _spread(time_ns)
        notes.append(
            f"about {rows:g} rows share each time stamp, which is coarser than the sampling: they "
            "are spread evenly up to the next stamp"
        )
    elif same:
        notes.append(
            f"{same} rows have the time of the row before; of such rows the last one's command "
            "counts from then on"
        )
    signals = []
    for name, column in zip(names, values, strict=True):
        ordered = column[order]
        there = ~np.isnan(ordered)
        if not there.all():
            gap = _longest_gap(time_ns[there])
            notes.append(
                f"{np.count_nonzero(~there)} cells of the column {name!r} are empty and left out; "
                f"the longest gap is {gap / 1e9:.6g} s"
            )
        signals.append(Signal(name, time_ns[there], ordered[there]))
    return Log(signals[0], signals[1], dated, tuple(notes))


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
    path: Path, name: str, times: Times, given: str | None, notes: list[str]
) -> tuple[IntArray, bool]:
    """Return times in nanoseconds, and whether they are dates."""
    if times.dates:
        if max(map(abs, times.dates)) >= 2**63:
            raise BagError(
                f"{path}: the column {name!r} has dates before 1678 or after 2262, which cannot "
                "be counted in nanoseconds; expected those of a recording"
            )
        notes.append(f"the column {name!r} is taken as dates in UTC, unless they name a zone")
        return np.array(times.dates, dtype=np.int64), True
    if times.clock:
        notes.append(f"the column {name!r} is taken as the time of day")
        clock = np.array(times.clock, dtype=np.int64)
        half_day = 43200 * 10**9
        midnights = np.cumsum(np.diff(clock, prepend=clock[0]) < -half_day)
        return clock + 2 * half_day * midnights, False
    time = _unwrapped(np.array(times.numbers), name, notes)
    largest = float(np.abs(time).max())
    step = float(np.median(np.abs(np.diff(time))))
    unit = given or _unit_of(name)
    scale = _UNITS.get(unit.lower()) if unit else None
    if scale is not None and scale != 1e9:
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
    elif scale is None and step >= 5.0 and not np.any(time % 1.0):
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
    match = _UNIT.search(name)
    if match:
        return match["unit"]
    last = re.split(r"[\W_]+|(?<=[a-z])(?=[A-Z])", name.strip())[-1]
    return last if last.lower() in _UNITS else None


def _check_rises(path: Path, name: str, time_ns: IntArray) -> None:
    """Refuse a column that is not called a time and does not rise.

    :raises SelectionError: if so.
    """
    if np.count_nonzero(np.diff(time_ns) > 0) < 0.5 * (time_ns.size - 1):
        raise SelectionError(
            f"{path}: the column {name!r} does not rise from row to row, so it is no time; name "
            "that with --time NAME, or, if there is none, give the sampling period with "
            "--period S"
        )


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


def _longest_gap(time_ns: IntArray) -> int:
    return int(np.diff(time_ns).max()) if time_ns.size > 1 else 0


def _choose(path: Path, names: Sequence[str], wanted: Selection) -> tuple[int | None, list[int]]:
    """Return the places of the time, None without one, and of measurement and command."""
    given = (wanted.measurement, wanted.command)
    pair = [_named(path, names, name) for name in given if name is not None]
    time = _time(path, names, wanted, pair)
    rest = [k for k in range(len(names)) if k != time]
    if not pair and len(rest) == 2:
        pair = rest
    if len(pair) < 2:
        least = (
            "; expected time, measurement and command, or two columns and their sampling "
            "period with --period S"
        )
        if len(names) >= 3:
            other = "" if time is None else f", and --time NAME if it is not {names[time]!r}"
            least = f"; name two of them with --measurement NAME --command NAME{other}, such as"
        raise SelectionError(
            f"{path} has {len(names)} columns: {listed(names)}{least}",
            _choices([names[k] for k in rest], given),
        )
    if time in pair and wanted.time is None:
        raise SelectionError(
            f"{path} has no column that is named as a time: {listed(names)}; name it with --time "
            "NAME, or, if there is none, give the sampling period with --period S"
        )
    for at in pair:
        _named(path, names, names[at])
    if len({time, *pair}) < 3:
        chosen = [names[at] for at in (time, *pair) if at is not None]
        raise SelectionError(
            f"time, measurement and command must be three columns of {path}, "
            f"found {listed(chosen)}"
        )
    return time, pair


def _time(path: Path, names: Sequence[str], wanted: Selection, taken: Sequence[int]) -> int | None:
    """Return the place of the time; None: rows have none, and come one period after another.

    :param taken: places of columns that are named as something else.
    """
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
        return _named(path, names, wanted.time)
    # The first column, unless only another one is called so.
    called_so = [k for k, name in enumerate(names) if k not in taken and _is_time(name)]
    return called_so[0] if called_so and not _is_time(names[0]) else 0


def _choices(names: Sequence[str], given: Sequence[str | None]) -> list[tuple[str, str]]:
    """Return the flags of each pair of columns that may be measurement and command.

    :param names: of the columns that are free.
    :param given: measurement and command, as far as they are named.
    """
    free = [name for name in names if not _words(name) & _SETPOINTS]
    hints = [[n for n in free if _hint(n) == way] for way in (-1, 1)]
    unclear = [n for n in free if _hint(n) == 0]
    pair = [
        [name] if name is not None else hinted or unclear
        for name, hinted in zip(given, hints, strict=True)
    ]
    why = "as their names say" if all(hints) else ""
    found = [(flags_of(y, u), why) for y in pair[0] for u in pair[1] if y != u]
    return found[:_MOST_CHOICES]


def _hint(name: str) -> int:
    """Return 1 for a column that is called like a command, -1 for one like a measurement."""
    return bool(_words(name) & _COMMANDS) - bool(_words(name) & _MEASUREMENTS)


def _swap(path: Path, names: Sequence[str], first: FloatArray, second: FloatArray) -> str:
    """Return why the first of two columns is the command; empty: the second is.

    :raises SelectionError: if one is a set-point, of which nothing can be identified.
    """
    for name in names:
        if _words(name) & _SETPOINTS:
            raise SelectionError(
                f"{path}: the column {name!r} seems to be a set-point; expected the command that "
                "the controller put out; name columns with --measurement and --command if it is"
            )
    hints = [_hint(name) for name in names]
    if hints[0] != hints[1]:
        return "as their names say" if hints[0] > hints[1] else ""
    if _steps(first) and not _steps(second):
        return "since it moves in steps"
    return ""


def _steps(values: FloatArray) -> bool:
    """Return whether a signal rests for most of the time and then jumps."""
    there = values[~np.isnan(values)]
    moves = np.abs(np.diff(there))
    moves = moves[moves > 0.0]
    return 0 < moves.size <= _MOVING * there.size and float(np.median(moves)) >= _JUMP * float(
        np.ptp(there)
    )


def _words(name: str) -> frozenset[str]:
    """Return the words of a name without its unit and without digits, in lower case."""
    bare = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", _UNIT.sub("", name))
    return frozenset(re.findall(r"[^\W\d_]+", bare.lower()))


def _is_time(name: str) -> bool:
    # "T" and "t1" are temperatures.
    return bool(_words(name) & _TIMES) or re.match(r"t(?![^\W_])", name) is not None


def _named(path: Path, names: Sequence[str], wanted: str) -> int:
    """Return the place of a column, whose name may be without its unit."""
    fits = [k for k, name in enumerate(names) if name == wanted] or [
        k for k, name in enumerate(names) if _UNIT.sub("", name) == wanted
    ]
    if len(fits) > 1:
        raise SelectionError(
            f"{path} has {len(fits)} columns named {wanted!r}; expected a name of its own for each"
        )
    if not fits:
        raise SelectionError(f"{path} has no column {wanted!r}; its columns are {listed(names)}")
    return fits[0]
