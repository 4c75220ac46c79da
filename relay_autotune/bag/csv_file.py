# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Logs of other tools: text with columns of time, measurement and command, as tools write it.

Columns are separated by commas, semicolons or tabs; with the last two a decimal comma may be
used. What the file does not tell is guessed, and each guess is a note.
"""

from __future__ import annotations

import csv
import io
import math
import re
from array import array
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from relay_autotune.bag.limits import LARGEST_TEXT, LONGEST_LINE
from relay_autotune.bag.signals import Signal
from relay_autotune.bag.source import open_regular
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.escape import visible
from relay_autotune.record.record import FloatArray, IntArray

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
    "s": 1e9, "sec": 1e9, "second": 1e9, "seconds": 1e9,
    "ms": 1e6, "msec": 1e6, "millis": 1e6, "milliseconds": 1e6,
    "us": 1e3, "usec": 1e3, "\u00b5s": 1e3, "\u03bcs": 1e3, "microseconds": 1e3, "ns": 1.0,
    "min": 6e10, "minutes": 6e10, "h": 3.6e12, "hours": 3.6e12,
}  # fmt: skip
_UNIT = re.compile(r"\s*[\[(]\s*(?P<unit>[^\])]*?)\s*[\])]\s*$")
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
_1970 = datetime(1970, 1, 1, tzinfo=UTC)
# The beginning of a file that tells its encoding and its separator [bytes].
_FIRST = 64 << 10
# Number of rows from which two stretches that overlap in time are two recordings.
_RESTART = 10


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


def read_csv(
    path: Path,
    measurement: str | None = None,
    command: str | None = None,
    time: str | None = None,
) -> Log:
    """Return measurement and command of a CSV file.

    Times are rounded to a nanosecond, as those of a bag are, so that a file and the bag made
    of it give the same numbers. Rows are put into the order of their time; rows at the same time
    keep the order of the file.

    :param path: the file; its first line names the columns, else they are called 1, 2, 3.
    :param measurement: name of the column of the measurement, with or without its unit; may be
        left out if there are three columns, which are then time, measurement and command.
    :param command: name of the column of the command.
    :param time: name of the column of the time; default: the first.
    :raises SelectionError: if a column is not named, or not there.
    :raises BagError: if the file cannot be read, or holds anything but numbers.
    """
    try:
        with open_regular(path) as file:
            table = _Table(path, file)
            chosen = _choose(path, table.names, measurement, command, time)
            stamps, y, u = table.columns(chosen)
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeError:
        raise BagError(f"{path} is not a text file; expected CSV in UTF-8") from None
    except csv.Error as error:
        raise BagError(f"{path} is not a CSV file: {error}") from None
    notes = table.notes
    time_ns, dated = _nanoseconds(path, chosen[0], stamps, table.has_dates, notes)
    order = _order(path, time_ns, table.lines, notes)
    time_ns, y, u = time_ns[order], y[order], u[order]
    same = int(np.count_nonzero(np.diff(time_ns) == 0))
    if same:
        notes.append(
            f"{same} rows have the time of the row before; of such rows the last one's command "
            "counts from then on"
        )
    signals = []
    for name, values in zip(chosen[1:], (y, u), strict=True):
        there = ~np.isnan(values)
        if not there.all():
            gap = _longest_gap(time_ns[there])
            notes.append(
                f"{np.count_nonzero(~there)} cells of the column {name!r} are empty and left out; "
                f"the longest gap is {gap / 1e9:.6g} s"
            )
        signals.append(Signal(name, time_ns[there], values[there]))
    return Log(signals[0], signals[1], dated, tuple(notes))


class _Table:
    """The rows of a file: their separator, their header, their numbers.

    :param path: its name in messages.
    :param file: the file, from its beginning.
    """

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path = path
        self.notes: list[str] = []
        self.lines: IntArray = np.empty(0, dtype=np.int64)
        self.has_dates = False
        size = file.seek(0, io.SEEK_END)
        if size > LARGEST_TEXT:
            raise BagError(
                f"{path} has {size} bytes, more than the {LARGEST_TEXT} that are read of a text; "
                "cut it into parts, or make a bag of it"
            )
        file.seek(0)
        first = file.read(_FIRST)
        file.seek(0)
        text = io.TextIOWrapper(file, newline="", encoding=self._encoding(first))
        # Closing the text would close the file a second time.
        self._text = text
        separator = _separator(text.read(_FIRST // 4))
        text.seek(0)
        if separator != ",":
            self.notes.append(f"columns are taken as separated by {_SEPARATORS[separator]}")
        self._separator = separator
        self._reader = csv.reader(
            _lines(path, text), delimiter=separator, skipinitialspace=separator != "\t"
        )
        self._commas = self._points = False
        self._waiting: list[list[str]] = []
        self.names = self._header()

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
        cells = next(self._reader, [])
        while cells and (cells[0][:1] in ("#", "%") or cells[0].lower().startswith("sep=")):
            # Remarks before the header, and what spreadsheets say of the separator.
            bare = [cells[0].lstrip("#% "), *cells[1:]]
            following = next(self._reader, [])
            if len(cells) >= 3 and len(cells) == len(following):
                cells = bare
                self._waiting = [following]
                break
            cells = following
        names = [visible(name.strip()) for name in cells]
        if not names:
            raise BagError(f"{self._path} is empty; expected a header line, then rows of numbers")
        if len(names) < 3:
            raise BagError(
                f"{self._path} has the columns {_listed(names)}; expected at least three, "
                f"separated by commas, semicolons or tabs: time, measurement, command"
            )
        if all(self._is_value(name) for name in names):
            self._waiting = [cells, *self._waiting]
            names = [str(number) for number in range(1, len(names) + 1)]
            self.notes.append(f"there is no header line; the columns are called {_listed(names)}")
        twice = next((name for name in names if name and names.count(name) > 1), None)
        if twice is not None:
            raise SelectionError(
                f"{self._path} has {names.count(twice)} columns named {twice!r}; expected a name "
                f"of its own for each"
            )
        return names

    def _is_value(self, cell: str) -> bool:
        number = cell.replace(",", ".") if self._separator != "," else cell
        return _is_number(number) or _date(cell) is not None

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield each row with its line number."""
        line = self._reader.line_num
        for number, row in enumerate(self._waiting):
            yield line - len(self._waiting) + 1 + number, row
        for row in self._reader:
            if any(cell.strip() for cell in row):
                yield self._reader.line_num, row

    def columns(
        self, chosen: Sequence[str]
    ) -> tuple[FloatArray | IntArray, FloatArray, FloatArray]:
        """Return three columns, the time first; NaN: an empty cell of the others.

        Dates are whole nanoseconds since 1970.
        """
        places = [self.names.index(name) for name in chosen]
        lines, values = array("q"), (array("d"), array("d"), array("d"))
        dates = array("q")
        untimed = 0
        for line, row in self._rows():
            # A separator at a line's end is no cell.
            if len(row) > len(self.names) and any(c.strip() for c in row[len(self.names) :]):
                raise BagError(
                    f"{self._path}, line {line}: {len(row)} cells, but {len(self.names)} columns "
                    f"have a name; a decimal comma, or a separator within a text, would make such "
                    f"a line"
                )
            cells = [row[at].strip() if at < len(row) else "" for at in places]
            if not lines and line <= 2 + len(self._waiting) and _are_units(row):
                self.notes.append(f"line {line} holds no number and is taken for units")
                continue
            if not cells[0]:
                untimed += 1
                continue
            date = None if _is_number(cells[0]) else _date(cells[0])
            if date is not None:
                self.has_dates = True
                dates.append(date)
                values[0].append(math.nan)
            else:
                values[0].append(self._number(line, chosen[0], cells[0]))
            for column, name, cell in zip(values[1:], chosen[1:], cells[1:], strict=True):
                column.append(self._number(line, name, cell) if cell else math.nan)
            lines.append(line)
        if len(lines) < 2:
            raise BagError(f"{self._path} has {len(lines)} rows of numbers; expected at least two")
        if dates and len(dates) < len(lines):
            raise BagError(
                f"{self._path}: of {len(lines)} cells of {chosen[0]!r} {len(dates)} are dates, "
                f"the others numbers; expected one of them"
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
        self.lines = np.array(lines, dtype=np.int64)
        time = np.array(dates, dtype=np.int64) if dates else np.array(values[0])
        return time, np.array(values[1]), np.array(values[2])

    def _number(self, line: int, name: str, cell: str) -> float:
        text = cell
        if self._separator != ",":
            # "1.234,5" is neither.
            if "," in cell and "." not in cell and cell.count(",") == 1:
                text, self._commas = cell.replace(",", "."), True
            elif "." in cell:
                self._points = True
        if not _is_number(text):
            raise BagError(
                f"{self._path}, line {line}: {name!r} is {visible(cell)!r}; expected a number"
            )
        value = float(text)
        if not math.isfinite(value):
            raise BagError(
                f"{self._path}, line {line}: {name!r} is {cell}; expected a finite number"
            )
        return value


def _lines(path: Path, text: TextIO) -> Iterator[str]:
    """Yield the lines of a text, and refuse one that is too long."""
    while line := text.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            raise BagError(
                f"{path} has a line of more than {LONGEST_LINE} characters; no CSV file"
            )
        yield line


def _separator(first: str) -> str:
    """Return the separator with which most lines have three columns or more."""
    lines = [line for line in first.splitlines()[:50] if line.strip()]
    found = {mark: sum(line.count(mark) >= 2 for line in lines) for mark in (";", "\t", ",")}
    # Semicolons and tabs come first: beside them a comma may be the decimal point.
    enough = max(1, math.ceil(0.8 * len(lines)))
    return next((mark for mark in (";", "\t") if found[mark] >= enough), ",")


def _are_units(row: Sequence[str]) -> bool:
    cells = [cell.strip() for cell in row if cell.strip()]
    return len(cells) >= 2 and not any(
        re.search(r"\d", cell) or cell.lower().lstrip("+-") in ("nan", "inf", "infinity")
        for cell in cells
    )


def _date(cell: str) -> int | None:
    """Return an ISO 8601 date in nanoseconds since 1970, UTC where it names no zone."""
    if not re.match(r"\d{4}-\d\d-\d\d[T ]\d\d", cell):
        return None
    try:
        when = datetime.fromisoformat(cell)
    except ValueError:
        return None
    if when.tzinfo is None:
        when = when.replace(tzinfo=UTC)
    return (when - _1970) // timedelta(microseconds=1) * 1000


def _nanoseconds(
    path: Path, name: str, time: FloatArray | IntArray, dates: bool, notes: list[str]
) -> tuple[IntArray, bool]:
    """Return times in nanoseconds, and whether they are dates."""
    if dates:
        notes.append(f"the column {name!r} is taken as dates in UTC, unless they name a zone")
        return np.asarray(time, dtype=np.int64), True
    largest = float(np.abs(time).max())
    unit = _UNIT.search(name)
    scale = _UNITS.get(unit["unit"].lower()) if unit else None
    if scale is not None and scale != 1e9:
        notes.append(f"the time is taken in {unit['unit'] if unit else ''}, as {name!r} says")
    elif largest > _DATES[0][0]:
        fits = [date for date in _DATES[1:] if largest <= date[0]]
        # Dates of a recording lie close to each other; else it is no time.
        if not fits or float(np.min(time)) < 0.1 * largest:
            raise BagError(
                f"{path}: the column {name!r} runs to {largest:g}; expected a time in seconds"
            )
        scale = fits[0][1]
        notes.append(f"the column {name!r} is taken as {fits[0][2]} since 1970")
    scale = scale or 1e9
    if largest * scale > 9.2e18:
        raise BagError(
            f"{path}: the column {name!r} runs to {largest:g}; expected a time in seconds"
        )
    # In two steps, since a date in nanoseconds is finer than a double.
    whole = np.floor(time)
    ns = whole.astype(np.int64) * int(scale) + np.round((time - whole) * scale).astype(np.int64)
    return ns, bool(ns[0] > EPOCH * 1e9)


def _order(path: Path, time_ns: IntArray, lines: IntArray, notes: list[str]) -> IntArray:
    """Return the rows in the order of their time.

    :raises BagError: if the time starts anew, as where two recordings are in one file.
    """
    order = np.argsort(time_ns, kind="stable")
    back = np.flatnonzero(np.diff(time_ns) < 0)
    if back.size == 0:
        return order
    bounds = np.concatenate(([0], back + 1, [time_ns.size]))
    for k, at in enumerate((back + 1).tolist()):
        before, after = at - bounds[k], bounds[k + 2] - at
        behind = int(np.searchsorted(time_ns[bounds[k] : at], time_ns[at]))
        if min(before, after) >= _RESTART and before - behind >= _RESTART:
            raise BagError(
                f"{path}, line {lines[at]}: the time goes back from {time_ns[at - 1] / 1e9:g} s "
                f"to {time_ns[at] / 1e9:g} s and runs on from there; expected one recording in a "
                "file"
            )
    notes.append(f"the time goes back at {back.size} rows; rows are put into its order")
    return order


def _longest_gap(time_ns: IntArray) -> int:
    return int(np.diff(time_ns).max()) if time_ns.size > 1 else 0


def _choose(
    path: Path,
    names: Sequence[str],
    measurement: str | None,
    command: str | None,
    time: str | None,
) -> tuple[str, str, str]:
    if len(names) == 3 and measurement is None and command is None and time is None:
        return names[0], names[1], names[2]
    if measurement is None or command is None:
        raise SelectionError(
            f"{path} has {len(names)} columns: {_listed(names)}; name two of them with "
            f"--measurement NAME --command NAME, and --time NAME if the time is not the first"
        )
    wanted = (names[0] if time is None else time, measurement, command)
    chosen = tuple(_named(path, names, name) for name in wanted)
    if len(set(chosen)) < 3:
        raise SelectionError(
            f"time, measurement and command must be three columns of {path}, "
            f"found {_listed(chosen)}"
        )
    return chosen[0], chosen[1], chosen[2]


def _named(path: Path, names: Sequence[str], wanted: str) -> str:
    """Return the column of a name, which may be without its unit."""
    if wanted in names:
        return wanted
    fits = [name for name in names if _UNIT.sub("", name) == wanted]
    if len(fits) != 1:
        raise SelectionError(f"{path} has no column {wanted!r}; its columns are {_listed(names)}")
    return fits[0]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names)
