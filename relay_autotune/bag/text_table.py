# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Text with columns of numbers: its encoding, its separator, its header and its cells.

The rows of numbers tell where the table begins and what separates its columns: the separator is
the one that makes the most numbers, and the header is the text just above the first of them.
What the text does not tell is guessed, and each guess is a note.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone
from functools import cached_property
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from relay_autotune.bag.arrays import FloatArray, IntArray
from relay_autotune.bag.limits import LARGEST_TEXT, LONGEST_LINE
from relay_autotune.bag.source import open_regular
from relay_autotune.errors import BagError, visible

# Each is preferred to those after it where both make as many numbers: beside a semicolon, a tab
# or a space a comma may be the decimal point.
_SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "spaces"}
_REMARKS = ("#", "%", "//")
# The beginning of a file that tells its encoding and its separator [bytes].
_FIRST = 64 << 10
# Largest number of lines before the rows of numbers.
_LONGEST_HEAD = 1000
# Characters of a line that are shown.
_SHOWN = 60
# Largest share of rows with text in place of a number, or with another number of cells, that are
# left out, as a serial link garbles a line now and then; more are a fault.
_DAMAGED = 0.02
_UNEVEN = "have another number of cells"
# Largest share of rows at which a time goes back, and share of rows beyond which it rises.
_BACK, _RISING = 0.05, 0.5
_COMMAS = (
    ": where commas separate columns, a number has none; save the table with decimal points and "
    "without separators of thousands, or with semicolons between columns"
)
_GROUPED = "; save the table without separators of thousands"
_GROUPS = re.compile(r"[+-]?\d{1,3}([.,'\u2019\s]\d{3})+([.,]\d+)?")
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
    :param either: places of dates that could have the day or the month first, with their texts.
    :param day_first: what the others say.
    """

    numbers: list[float] = field(default_factory=list)
    dates: list[int] = field(default_factory=list)
    clock: list[int] = field(default_factory=list)
    either: list[tuple[int, str]] = field(default_factory=list)
    day_first: set[bool] = field(default_factory=set)


class TextTable:
    """The rows of a text: their separator, their header, their numbers.

    :param path: its name in messages.
    :param file: the file, from its beginning.
    :raises BagError: if it holds no table.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
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
        # Line and text of each column's first number with a decimal comma, and of the first with a
        # point; and the columns whose points part no thousands.
        self._comma: dict[int, tuple[int, str]] = {}
        self._point: dict[int, tuple[int, str]] = {}
        self._decimal: set[int] = set()
        # The units behind the numbers of each column.
        self._behind: dict[int, str] = {}
        self._head: list[str] = []
        self._waiting: list[tuple[int, list[str]]] = []
        self.units: dict[str, str] = {}
        self.names = self._header()
        self._day = self._day_before_its_time()
        self.names = self._joined(self.names)

    @property
    def is_sure(self) -> bool:
        """True if rows of numbers follow each other; one may be a sentence with numbers in it."""
        first = [cells for _, cells in self._waiting[:2]]
        return len(first) == 2 and _are_data(*first)

    @cached_property
    def looks(self) -> tuple[list[int], list[int]]:
        """Return the places of the columns that are not constant, and of those that rise.

        The file is read once more for it. A column that rises may begin anew at a few rows.
        """
        with open_regular(self.path) as file:
            return TextTable(self.path, file)._looks()

    def _looks(self) -> tuple[list[int], list[int]]:
        columns = range(len(self.names))
        last, rises, falls = ([value for _ in columns] for value in (math.nan, 0.0, 0.0))
        asked, count = list(columns), 0
        for count, (line, row) in enumerate(self._rows()):
            for at in tuple(asked):
                cell = row[at] if at < len(row) else ""
                date = None if _is_number(cell) else _date(cell)
                try:
                    value = float(date[0]) if date else self._number(line, at, cell)[0]
                except BagError:
                    continue
                rises[at] += value > last[at]
                falls[at] += value < last[at]
                last[at] = last[at] if math.isnan(value) else value
                if falls[at] > 1.0 + _BACK * (count + 1):
                    asked.remove(at)
        moving = [at for at in columns if rises[at] + falls[at]]
        limits = _BACK * count, _RISING * count
        return moving, [at for at in asked if falls[at] <= limits[0] and rises[at] > limits[1]]

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
            raise BagError(f"{self.path} is empty; expected a header line, then rows of numbers")
        self._waiting = rows[data:]
        width = len(self._waiting[0][1]) if self._waiting else 0
        # A separator at the end of each line makes no column.
        filled = max(
            (k + 1 for _, row in self._waiting for k, c in enumerate(row) if c), default=0
        )
        above = [(line, _bare(cells, filled)) for line, cells in rows[:data]]
        if above and not self._is_header(above[-1][1], filled):
            above[-1] = (above[-1][0], self._names_by_another_mark(above[-1][1], filled))
        fits = [self._is_header(cells, filled) for _, cells in above]
        if not fits or not fits[-1]:
            if not width:
                line, cells = rows[-1]
                found = visible(self._separator.join(cells))
                raise BagError(
                    f"{self.path} has 0 rows of numbers; line {line} is {found[:_SHOWN]!r}; "
                    "expected columns of time, measurement and command, separated by commas, "
                    "semicolons, tabs or spaces: write the numbers of such lines into columns"
                )
            names = [str(number) for number in range(1, width + 1)]
            why = "there is no header line"
            if above and not _is_data(above[-1][1]) and 2 * sum(map(bool, above[-1][1])) >= width:
                count = len(above[-1][1])
                why = (
                    f"line {above[-1][0]} has {count} names and the rows have {width} cells, so "
                    "that it does not tell which is which"
                )
                if self._separator == "," and width in (2 * count - 1, 2 * count):
                    # Each number stands in two cells, unless the time has no decimals.
                    raise BagError(f"{self.path}: {why}{_COMMAS}")
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

    def _names_by_another_mark(self, cells: list[str], width: int) -> list[str]:
        """Return the cells of a line, or its names if another mark than in rows separates them.

        Spaces do not count, since they separate the words of a title, too.
        """
        text = self._separator.join(cells)
        for mark in ",;\t".replace(self._separator, ""):
            names = [name.strip() for name in text.split(mark)]
            if len(names) == width > 1 and all(names) and not _is_data(names):
                self.notes.append(f"the names of columns are separated by {_SEPARATORS[mark]}")
                return names
        return cells

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
            yield line, self._joined(cells)
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
        lines: list[int] = []
        untimed, ragged, width = 0, False, len(self.names)
        # The number of rows with each fault, and the first of them.
        counts: Counter[str] = Counter()
        faults: dict[str, BagError] = {}
        for line, row in self._rows():
            stamp = "" if time is None or time >= len(row) else row[time]
            if time is not None and stamp.lower() in _MISSING:
                untimed += 1
                continue
            # Where more rows are short, their last cells are empty.
            short = len(row) <= max(places, default=0)
            ragged |= short and counts[_UNEVEN] >= int(_DAMAGED * len(lines))
            fault = _UNEVEN
            try:
                # A separator at a line's end is no cell.
                if any(row[width:]) or (short and not ragged):
                    raise self._uneven(line, len(row))
                fault = "hold something else than numbers"
                found = [self._value(line, row, at) for at in places]
                if time is not None:
                    self._stamp(line, time, stamp, times)
            except BagError as error:
                counts[fault] += 1
                faults.setdefault(fault, error)
                continue
            for column, number in zip(values, found, strict=True):
                column.append(number)
            lines.append(line)
        if counts.total() > _DAMAGED * len(lines):
            raise next(iter(faults.values()))
        self._settle_order(times)
        if len(lines) < 2:
            raise BagError(f"{self.path} has fewer than two rows of numbers; expected more")
        for count, what in ((len(times.dates), "dates"), (len(times.clock), "times of day")):
            if time is not None and 0 < count < len(lines):
                raise BagError(
                    f"{self.path}: of {len(lines)} cells of {self.names[time]!r} {count} are "
                    f"{what}, the others not; expected one of them"
                )
        unclear = self._comma.keys() & self._point.keys()
        if self._comma:
            # Beside a decimal comma, a point may part thousands.
            unclear |= self._point.keys() - self._decimal
        for at in unclear:
            seen = self._comma.get(at) or next(iter(self._comma.values())), self._point[at]
            comma, point = (f"{c!r} in line {n}" for n, c in seen)
            raise BagError(
                f"{self.path} has numbers with a decimal comma and others with a point, such as "
                f"{comma} and {point}; expected one of them"
            )
        if self._comma:
            self.notes.append("a comma within a number is taken as the decimal point")
        if untimed:
            self.notes.append(f"{untimed} rows without a time are left out")
        for fault, earliest in faults.items():
            first = str(earliest).removeprefix(f"{self.path}, ")
            self.notes.append(f"{counts[fault]} rows {fault} and are left out, the first: {first}")
        self.lines = np.array(lines, dtype=np.int64)
        return times, [np.array(column) for column in values]

    def _uneven(self, line: int, count: int) -> BagError:
        hint = "; a decimal comma, or a separator within a text, would make such a line"
        return BagError(
            f"{self.path}, line {line}: {count} cells, but {len(self.names)} columns have a name"
            + hint * (count > len(self.names))
        )

    def _value(self, line: int, row: list[str], at: int) -> float:
        """Return the number of a row at a place, whose unit stays the same; NaN: an empty cell."""
        cell = row[at] if at < len(row) else ""
        number, unit = self._number(line, at, cell)
        if not math.isnan(number) and self._behind.setdefault(at, unit) != unit:
            raise self._no_number(line, at, cell)
        return number

    def _stamp(self, line: int, at: int, cell: str, times: Times) -> None:
        date = None if _is_number(cell) else _date(cell)
        if date is None:
            times.numbers.append(self._number(line, at, cell)[0])
            return
        (times.dates if date[1] else times.clock).append(date[0])
        # A year of four digits leaves no choice.
        if "/" in cell[:3]:
            first, second = map(int, cell.split("/")[:2])
            if max(first, second) > 12:
                times.day_first.add(first > 12)
            elif first != second:
                times.either.append((len(times.dates) - 1, cell))

    def _settle_order(self, times: Times) -> None:
        """Read dates that could be read in two ways as the others of their column are."""
        if len(times.day_first) > 1:
            raise BagError(
                f"{self.path} has dates with the day first and others with the month first; "
                "expected one of them"
            )
        if times.day_first == {True}:
            for place, cell in times.either:
                times.dates[place] = _date(cell, day_first=True)[0]  # type: ignore[index]
        elif times.either and not times.day_first:
            cell = times.either[0][1]
            month, day = map(int, cell.split("/")[:2])
            self.notes.append(
                f"{cell!r} is taken with the month first, as in 12/31/2026: month {month}, "
                f"day {day}"
            )

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
                text = text.replace(",", ".")
                self._comma.setdefault(at, (line, cell))
            elif "." in text and at not in self._decimal:
                self._point.setdefault(at, (line, cell))
                if not _GROUPS.fullmatch(text):
                    self._decimal.add(at)
        if not _is_number(text):
            raise self._no_number(line, at, cell)
        value = float(text)
        if not math.isfinite(value):
            raise self._no_number(line, at, cell, finite=True)
        return value, suffix

    def _no_number(self, line: int, at: int, cell: str, *, finite: bool = False) -> BagError:
        shown = cell if finite else repr(visible(cell))
        between = self._separator == "," and "," in cell and _is_number(cell.replace(",", ""))
        hint = _COMMAS if between else _GROUPED * bool(_GROUPS.fullmatch(cell))
        return BagError(
            f"{self.path}, line {line}: {self.names[at]!r} is {shown}; expected a "
            f"{'finite ' if finite else ''}number{hint}"
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


def _date(cell: str, *, day_first: bool = False) -> tuple[int, bool] | None:
    """Return a date in nanoseconds since 1970, UTC where it names no zone, or a time of day.

    The second value tells whether it is a date. Of three numbers one of four digits is the year,
    and 1/2 is the second of January unless ``day_first``, or a number above 12, says otherwise;
    1.2 the first of February.
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
        day_first = day_first or mark != "/" or first > 12
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
