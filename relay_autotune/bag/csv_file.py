"""Logs of other tools: CSV with a header line, and columns of time, measurement and command."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from relay_autotune.bag.signals import Signal
from relay_autotune.bag.source import open_regular
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.escape import visible
from relay_autotune.record.record import FloatArray

# Times from here on are taken as seconds since 1970; no experiment lasts that long.
EPOCH = 1.0e8


def read_csv(
    path: Path,
    measurement: str | None = None,
    command: str | None = None,
    time: str | None = None,
) -> tuple[Signal, Signal, bool]:
    """Return measurement and command of a CSV file, and whether its times are dates.

    Times are rounded to a nanosecond, as those of a bag are, so that a file and the bag made
    of it give the same numbers.

    :param path: the file; its first line names the columns.
    :param measurement: name of the column of the measurement; may be left out if there are
        three columns, which are then time, measurement and command.
    :param command: name of the column of the command.
    :param time: name of the column of the time [s]; default: the first.
    :raises SelectionError: if a column is not named, or not there.
    :raises BagError: if the file cannot be read, or holds something else than numbers.
    """
    names, rows = _rows(path)
    chosen = _choose(path, names, measurement, command, time)
    columns = {name: _numbers(path, rows, names.index(name), name) for name in chosen}
    t = columns[chosen[0]]
    back = np.flatnonzero(np.diff(t) < 0.0)
    if back.size:
        raise BagError(
            f"{path}, line {rows[back[0] + 1][0]}: the time goes back from {t[back[0]]:g} s to "
            f"{t[back[0] + 1]:g} s; expected rows in the order of their time"
        )
    if max(abs(t[0]), abs(t[-1])) > 9e9:
        raise BagError(
            f"{path}: the column {chosen[0]!r} runs to {t[-1]:g}; expected a time in seconds"
        )
    time_ns = np.array([_nanoseconds(value) for value in t], dtype=np.int64)
    return (
        Signal(chosen[1], time_ns, columns[chosen[1]]),
        Signal(chosen[2], time_ns, columns[chosen[2]]),
        bool(t[0] > EPOCH),
    )


def _nanoseconds(seconds: float) -> int:
    # In two steps, since a date in nanoseconds is finer than a double.
    whole = math.floor(seconds)
    return whole * 1_000_000_000 + round((seconds - whole) * 1e9)


def _rows(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the column names, and each row with its line number."""
    try:
        with io.TextIOWrapper(open_regular(path), newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            names = [visible(name.strip()) for name in next(reader, [])]
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise BagError(f"{path} is not a text file; expected CSV in UTF-8") from None
    except csv.Error as error:
        raise BagError(f"{path} is no CSV file: {error}") from None
    if not names:
        raise BagError(f"{path} is empty; expected a header line, then rows of numbers")
    if all(_is_number(name) for name in names):
        raise BagError(
            f"{path} has no header line: its first line is {', '.join(names)}; expected names "
            f"such as time, measurement, command"
        )
    if len(names) < 3:
        raise BagError(
            f"{path} has the columns {_listed(names)}; expected at least three, separated by "
            f"commas: time, measurement, command"
        )
    twice = next((name for name in names if name and names.count(name) > 1), None)
    if twice is not None:
        raise SelectionError(
            f"{path} has {names.count(twice)} columns named {twice!r}; expected a name of its own "
            f"for each"
        )
    for line, row in rows:
        # A separator at a line's end is no cell.
        if len(row) > len(names) and any(cell.strip() for cell in row[len(names) :]):
            raise BagError(
                f"{path}, line {line}: {len(row)} cells, but {len(names)} columns have a name; a "
                f"decimal comma, or a separator within a text, would make such a line"
            )
    if len(rows) < 2:
        raise BagError(f"{path} has {len(rows)} rows of numbers; expected at least two")
    return names, rows


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
    chosen = (names[0] if time is None else time, measurement, command)
    for name in chosen:
        if name not in names:
            raise SelectionError(
                f"{path} has no column {name!r}; its columns are {_listed(names)}"
            )
    if len(set(chosen)) < 3:
        raise SelectionError(
            f"time, measurement and command must be three columns of {path}, "
            f"found {_listed(chosen)}"
        )
    return chosen


def _numbers(
    path: Path, rows: Sequence[tuple[int, list[str]]], column: int, name: str
) -> FloatArray:
    values = np.empty(len(rows))
    for i, (line, row) in enumerate(rows):
        cell = row[column].strip() if column < len(row) else ""
        if not cell:
            raise BagError(f"{path}, line {line}: the column {name!r} is missing")
        if not _is_number(cell):
            raise BagError(f"{path}, line {line}: {name!r} is {cell!r}; expected a number")
        values[i] = float(cell)
        if not math.isfinite(values[i]):
            raise BagError(f"{path}, line {line}: {name!r} is {cell}; expected a finite number")
    return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names)
