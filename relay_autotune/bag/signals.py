# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What is wanted of a recording, and its signals, each put into the order of a clock."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from relay_autotune.bag.arrays import FloatArray, IntArray
from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.errors import BagError, SelectionError

T = TypeVar("T", bound=np.generic)

_LARGE = 1 << 22


class Column(Generic[T]):
    """An array to which values are added at its end.

    It grows in place: joining pieces would for a moment take the memory twice.

    :param kind: type of the values.
    :param expected: expected number of values; memory is taken only for those that come.
    """

    def __init__(self, kind: DTypeLike, expected: int = 0) -> None:
        self._data = np.empty(expected, dtype=kind)
        self._size = 0

    def extend(self, values: NDArray[T]) -> None:
        """Add values, shape (n,)."""
        size = self._size + values.size
        if size > self._data.size:
            # Memory that is added is zeroed, so that it is taken at once: large arrays grow less.
            grown = self._data.size * (2 if size < _LARGE else 1.125)
            self._data.resize(max(size, int(grown), 1024), refcheck=False)
        self._data[self._size : size] = values
        self._size = size

    def values(self) -> NDArray[T]:
        """Return what was added; nothing can be added after that."""
        self._data.resize(self._size, refcheck=False)
        return self._data


# Which time of a message counts; the first is the default.
CLOCKS = ("publish", "log", "header")
# Units of the times in a file of text.
TIME_UNITS = ("s", "ms", "us", "min", "h", "d")


def flags_of(measurement: str, command: str) -> str:
    """Return the flags that select measurement and command, as one types them."""
    return f"--measurement {shlex.quote(measurement)} --command {shlex.quote(command)}"


@dataclass(frozen=True)
class Selection:
    """What of a recording is wanted, and what it does not say of itself.

    :param measurement: topic or column of the measurement; None: found.
    :param command: topic or column of the command; None: found.
    :param time: column of the time in a text; None: the first that is named so, else the first.
    :param start: beginning of the part to use [s from the first sample]; None: all.
    :param end: end of the part to use [s from the first sample]; None: all.
    :param clock: which time of a message counts, one of ``CLOCKS``.
    :param largest_chunk: size of a chunk, or a message outside of chunks, beyond which it is left
        out [bytes].
    :param joint: name of the joint that measurement and command are of; empty: none is named.
        The topics may then leave out the element.
    :param joint_order: the joints in the order of commands that do not name them; (): not known.
    :param time_unit: unit of the time in a text, one of ``TIME_UNITS``; None: as it says, else s.
    :param period: time from row to row of a text without times [s]; None: it has them.
    :param command_before: the command before the recording begins [u]; None: the first one.
    """

    measurement: str | None = None
    command: str | None = None
    time: str | None = None
    start: float | None = None
    end: float | None = None
    clock: str = CLOCKS[0]
    largest_chunk: int = LARGEST_CHUNK
    joint: str = ""
    joint_order: tuple[str, ...] = ()
    time_unit: str | None = None
    period: float | None = None
    command_before: float | None = None

    @property
    def is_part(self) -> bool:
        """Whether a part of the recording is named."""
        return self.start is not None or self.end is not None


@dataclass(frozen=True)
class Signal:
    """One recorded quantity.

    :param name: topic or column.
    :param time_ns: time of each value [ns], not decreasing, shape (n,): that of the chosen clock,
        or, where that is not known, the time at which it was recorded.
    :param values: the values, shape (n,).
    :param lag_ns: smallest time from the clock's time to recording [ns]: the delay of the
        transport and the difference of the two clocks.
    :param notes: what to know about it, each a sentence.
    """

    name: str
    time_ns: IntArray
    values: FloatArray
    lag_ns: int = 0
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return int(self.values.size)


class SignalReader:
    """Collects a signal.

    :param name: of the signal.
    :param clock: one of ``CLOCKS``.
    :param expected: number of its messages, as the file says.
    :param both: keep the recorder's times too, for times that are not in order; these take half
        as much memory again.
    """

    def __init__(self, name: str, clock: str, *, both: bool = False, expected: int = 0) -> None:
        self.name = name
        self.clock = clock
        self._values: Column[np.float64] = Column(np.float64, expected)
        self._times: Column[np.int64] = Column(np.int64, expected)
        self._log_times: Column[np.int64] | None = Column(np.int64, expected) if both else None
        self._lag = np.iinfo(np.int64).max
        self._last = np.iinfo(np.int64).min
        self._rising = True
        self._all_dated = True
        self._unfit = 0
        self.why_unfit = ""
        """Why a message has no value, as far as it says."""
        self.notes: list[str] = []
        """What to know about it, each a sentence."""

    def take(
        self, values: NDArray[Any], good: NDArray[np.bool_], times: IntArray, log_times: IntArray
    ) -> None:
        """Add messages, shape (n,) each.

        :param values: their values.
        :param good: those that have one; the others are left out.
        :param times: their times by the clock [ns], none negative; 0: unknown.
        :param log_times: when they were recorded [ns].
        """
        if not bool(good.all()):
            self._unfit += int(good.size - np.count_nonzero(good))
            values, times, log_times = values[good], times[good], log_times[good]
        if values.size == 0:
            return
        self._rising &= int(times[0]) >= self._last and bool((times[1:] >= times[:-1]).all())
        self._last = int(times[-1])
        if self.clock != "log":
            self._all_dated &= bool(times.all())
            self._lag = min(self._lag, int((log_times - times).min()))
        self._values.extend(values)
        self._times.extend(times)
        if self._log_times is not None:
            self._log_times.extend(log_times)

    @property
    def in_order(self) -> bool:
        """Whether the times need not be compared with the recorder's."""
        return self._log_times is not None or (self._rising and self._all_dated)

    def signal(self) -> Signal:
        """Return what was collected; nothing can be added after that.

        :raises SelectionError: if messages came, and say why none of them has a value.
        :raises BagError: if none of them has one otherwise.
        """
        values, times = self._values.values(), self._times.values()
        notes = [*self.notes]
        if self._unfit:
            if values.size == 0 and self.why_unfit:
                raise SelectionError(
                    f"none of the {self._unfit} messages of {self.name} has it: {self.why_unfit}"
                )
            if values.size == 0:
                raise BagError(
                    f"none of the {self._unfit} messages of {self.name} fits its definition; if "
                    f"they are compressed one by one, and not by zstd, convert the bag with: "
                    f"ros2 bag convert"
                )
            notes.append(
                f"{self._unfit} of {self._unfit + values.size} messages of {self.name} do not "
                f"fit their definition, or lack the field; they are left out"
                + (f" ({self.why_unfit})" if self.why_unfit else "")
            )
        lag = 0 if self.clock == "log" or values.size == 0 else self._lag
        if self._log_times is not None:
            log_times = self._log_times.values()
            order = np.argsort(log_times, kind="stable")
            log_times, times, values = log_times[order], times[order], values[order]
            back = bool((times[1:] < times[:-1]).any())
            if back or not self._all_dated:
                times, lag = log_times, 0
            if back and self._all_dated and self.clock != "log":
                notes.append(
                    f"the {self.clock} times of {self.name} go backwards; "
                    f"its log times are used instead"
                )
        return Signal(self.name, times, values, lag, tuple(notes))
