# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Numbers out of many serialized messages at once.

The layout is that of plain CDR (OMG formal/02-06-51, 15.3): each number is aligned to its own
size, counted from behind the four bytes of the encapsulation; a string or a sequence is preceded
by its length as uint32. Where all messages have their fields in the same places, as those of
fixed size do, a place is one number; else it is one for each message.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.bag.limits import MOST_STEPS
from relay_autotune.bag.locate import Content, every_byte
from relay_autotune.bag.schema import Number, Repeated, Struct, Text, Type
from relay_autotune.errors import BagError
from relay_autotune.record.record import IntArray

_ENCAPSULATION = 4
_UINT32 = Number("uint32", "u4")

Place = int | IntArray
Step = str | int


@dataclass(frozen=True)
class Path:
    """A number within a message type.

    :param root: the message type.
    :param steps: names of fields and indices of elements, from the root on.
    """

    root: Struct
    steps: tuple[Step, ...]

    def read(
        self, content: Content, begin: IntArray, end: IntArray
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return the number in each of some messages, and which messages have it.

        :param content: bytes with the messages.
        :param begin: where each begins, shape (n,).
        :param end: where it ends, shape (n,).
        :return: the numbers in their own type, shape (n,); a mask of those that are there.
        """
        if begin.size == 0:
            return np.empty(0), np.empty(0, dtype=np.bool_)
        fits = end - begin >= _ENCAPSULATION
        # A message shorter than that may lie at the very end.
        kinds = every_byte(content, "<u2")[begin if fits.all() else np.where(fits, begin, 0)]
        little = (kinds == 0x0100) & fits
        if bool(little.all()):
            return self._of_one_order(content, begin, end, "<")
        values = np.zeros(begin.size)
        good = np.zeros(begin.size, dtype=np.bool_)
        for order, chosen in (("<", little), (">", (kinds == 0x0000) & fits)):
            at = np.flatnonzero(chosen)
            if at.size:
                values[at], good[at] = self._of_one_order(content, begin[at], end[at], order)
        return values, good

    def _of_one_order(
        self, content: Content, begin: IntArray, end: IntArray, order: str
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        cursor = _Cursor(content, begin + _ENCAPSULATION, end, order)
        values = cursor.find(self.root, self.steps)
        return values, cursor.good


class _Cursor:
    """A place in each of many messages."""

    def __init__(self, content: Content, origin: IntArray, limit: IntArray, order: str) -> None:
        self._content = content
        self._origin = origin
        self._room = limit - origin
        self._least_room = int(self._room.min())
        self._order = order
        self._place: Place = 0
        self._passed = 0
        self.good = np.ones(origin.size, dtype=np.bool_)

    def find(self, kind: Type, steps: tuple[Step, ...]) -> NDArray[Any]:
        """Return the number to which the steps lead."""
        if isinstance(kind, Number):
            return self._take(kind)
        if isinstance(kind, Struct):
            for name, inner in kind.fields:
                if name == steps[0]:
                    return self.find(inner, steps[1:])
                self._skip(inner)
        assert isinstance(kind, Repeated)
        index = int(steps[0])
        count = self._count(kind)
        self.good &= np.asarray(count) > index
        self._skip_items(kind.item, index)
        return self.find(kind.item, steps[1:])

    def _take(self, kind: Number) -> NDArray[Any]:
        """Return the numbers here, and go on behind them; where there are none it is zero."""
        self._align(kind.size)
        after = self._place + kind.size
        at = self._origin + self._place
        if not (isinstance(after, int) and after <= self._least_room):
            fits = after <= self._room
            self.good &= fits
            at = np.where(self.good, at, 0)
        self._place = after
        return every_byte(self._content, self._order + kind.form)[at]

    def _align(self, size: int) -> None:
        if size > 1:
            self._place = (self._place + (size - 1)) & -size

    def _advance(self, size: Place) -> None:
        self._place = self._place + size
        if not isinstance(self._place, int):
            # A place far outside must not overflow; what is there is no longer looked at.
            self.good &= self._place <= self._room
            self._place = np.where(self.good, self._place, 0)

    def _length(self) -> Place:
        lengths = self._take(_UINT32).astype(np.int64)
        lengths = np.where(self.good, lengths, 0)
        known = lengths[self.good]
        if known.size and bool((known == known[0]).all()):
            return int(known[0])
        return lengths

    def _count(self, kind: Repeated) -> Place:
        return self._length() if kind.count is None else kind.count

    def _skip(self, kind: Type) -> None:
        self._passed += 1
        if self._passed > MOST_STEPS:
            raise BagError(
                f"the field that is wanted lies behind more than {MOST_STEPS} others, "
                f"too far into a message to be read"
            )
        if isinstance(kind, Number):
            self._align(kind.size)
            self._advance(kind.size)
        elif isinstance(kind, Text):
            if kind.wide:
                raise BagError(
                    "a field of type wstring lies before the one that is wanted; "
                    "its length differs between middlewares, so that it cannot be passed"
                )
            self._advance_by_length()
        elif isinstance(kind, Struct):
            for _, inner in kind.fields:
                self._skip(inner)
        else:
            self._skip_items(kind.item, self._count(kind))

    def _advance_by_length(self) -> None:
        length = self._length()
        self._advance(length)

    def _skip_items(self, item: Type, count: Place) -> None:
        """Pass so many elements of an array or sequence."""
        if isinstance(item, Number):
            if isinstance(count, int):
                if count:
                    self._align(item.size)
                    self._advance(count * item.size)
                return
            # Where a sequence is empty nothing is aligned.
            before = self._place
            self._align(item.size)
            self._place = np.where(count > 0, self._place, before)
            self._advance(count * item.size)
            return
        most = count if isinstance(count, int) else int(count.max(initial=0))
        # A string, or a structure, takes a byte at least.
        most = min(most, int(self._room.max()) + 1)
        for number in range(most):
            before, good = self._place, self.good.copy()
            self._skip(item)
            if not isinstance(count, int):
                more = number < count
                self._place = np.where(more, self._place, before)
                self.good = np.where(more, self.good, good)
            if not bool(self.good.any()):
                return
