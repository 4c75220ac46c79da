# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Numbers read from many serialized messages at once.

The layout is that of plain CDR (OMG formal/02-06-51, 15.3): each number is aligned to its own
size, counted from behind the four bytes of the encapsulation; a string or a sequence is preceded
by its length as uint32. Where all messages have their fields in the same places, as those of
fixed size do, a place is one number; else it is one for each message.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.bag.arrays import IntArray
from relay_autotune.bag.definitions import first_line
from relay_autotune.bag.field_path import (
    NUMBERS,
    Element,
    Number,
    Repeated,
    Step,
    Struct,
    Text,
    Type,
    reading,
    written,
)
from relay_autotune.bag.limits import MOST_ELEMENTS, MOST_STEPS
from relay_autotune.bag.mcap_records import Content, values_at
from relay_autotune.errors import BagError, FieldError, visible

_ENCAPSULATION = 4
_UINT32 = NUMBERS["uint32"]
_EVERY_MESSAGE = np.ones(1, dtype=np.bool_)

Place = int | IntArray
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Path:
    """A number within a message type.

    :param root: the message type.
    :param steps: names of fields, and elements, from the root on.
    """

    root: Struct
    steps: tuple[Step, ...]

    def read(
        self, content: Content, begin: IntArray, end: IntArray
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return the number in each of some messages, and which messages have it.

        :param content: bytes with the messages.
        :param begin: where each begins, shape (n,), n >= 1.
        :param end: where it ends, shape (n,).
        :return: the numbers in their own type, shape (n,); a mask of those that are there.
        :raises FieldError: if the names in a message do not tell which element is meant.
        """
        fits = end - begin >= _ENCAPSULATION
        # A message shorter than that may lie at the very end.
        kinds = values_at(content, "<u2", begin if fits.all() else np.where(fits, begin, 0))
        values = np.zeros(begin.size)
        good = np.zeros(begin.size, dtype=np.bool_)
        for order, kind in (("<", 0x0100), (">", 0x0000)):
            at = np.flatnonzero((kinds == kind) & fits)
            if at.size == begin.size:
                return self._of_one_order(content, begin, end, order)
            if at.size:
                values[at], good[at] = self._of_one_order(content, begin[at], end[at], order)
        return values, good

    def why(self, message: bytes) -> str:
        """Return why a message does not have the number, "" where the message cannot say.

        :param message: serialized.
        """
        try:
            reading(self.steps)(Decoder(self.root).decoded(message))
        except FieldError as error:
            return str(error)
        except BagError:
            pass
        return ""

    def _of_one_order(
        self, content: Content, begin: IntArray, end: IntArray, order: str
    ) -> tuple[NDArray[Any], Mask]:
        def cursor() -> _Cursor:
            return _Cursor(content, begin + _ENCAPSULATION, end, order)

        def refuse(unclear: Mask) -> None:
            if bool(unclear.any()):
                k = int(np.flatnonzero(unclear)[0])
                why = self.why(bytes(content[int(begin[k]) : int(end[k])]))
                raise FieldError(why or f"{written(self.steps)}: the names are not clear")

        good = np.ones(begin.size, dtype=np.bool_)
        way: list[str | Place] = []
        for step in self.steps:
            if isinstance(step, str):
                way.append(step)
                continue
            place, found = self._place(cursor, way, step, refuse)
            way.append(place)
            good &= found
        last = cursor()
        kind = last.go(self.root, way)
        assert isinstance(kind, Number)
        values = last.take(kind)
        return values, good & last.good

    def _place(
        self,
        cursor: Callable[[], _Cursor],
        way: list[str | Place],
        element: Element,
        refuse: Callable[[Mask], None],
    ) -> tuple[Place, Mask]:
        """Return the place of an element in each message, and which messages have it."""
        by, chosen = element.names, element.chosen
        if by is None:
            assert isinstance(chosen, int)
            return chosen, _EVERY_MESSAGE
        named = cursor()
        kind = named.go(self.root, way if by.depth is None else [*way[: by.depth], by.field])
        assert isinstance(kind, Repeated)
        if isinstance(chosen, int):
            has = named.count(kind)
        else:
            place, hits, has = named.named(kind, by.field, chosen)
        known = named.good
        if by.depth is not None:
            array = cursor()
            elements = array.go(self.root, way)
            assert isinstance(elements, Repeated)
            # Only a list of as many names as elements names them.
            count = array.count(elements)
            known = known & array.good & (np.asarray(count) == has)
        if isinstance(chosen, int):
            refuse(known & (np.asarray(has) > chosen))
            return chosen, _EVERY_MESSAGE
        refuse(named.good & (hits > 1))
        found = known & (hits == 1)
        place = np.where(found, place, 0)
        if bool((place == place[0]).all()):
            return int(place[0]), found
        return place, found


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

    def go(self, kind: Type, way: Sequence[str | Place]) -> Type:
        """Go to what fields and places of elements lead to; return its type."""
        for step in way:
            if isinstance(step, str):
                assert isinstance(kind, Struct)
                kind = self._field(kind, step)
            else:
                assert isinstance(kind, Repeated)
                self.good &= np.asarray(self.count(kind)) > step
                self._skip_items(kind.item, step)
                kind = kind.item
        return kind

    def count(self, kind: Repeated) -> Place:
        """Return the number of elements of an array, and go on to the first of them."""
        return self._length() if kind.count is None else kind.count

    def named(self, kind: Repeated, field: str, name: str) -> tuple[IntArray, IntArray, Place]:
        """Look for a name in an array.

        :param kind: of texts, or of structures.
        :param field: the structures' field with the name.
        :param name: what is looked for.
        :return: the first place of the name, how often it is there, and the number of elements.
        """
        count = self.count(kind)
        place = np.zeros(self.good.size, dtype=np.int64)
        hits = np.zeros(self.good.size, dtype=np.int64)
        for number in self._each(count):
            is_it = self._is_named(kind.item, field, name) & self.good & (number < count)
            place[is_it & (hits == 0)] = number
            hits += is_it
        return place, hits, count

    def _is_named(self, item: Type, field: str, name: str) -> Mask:
        """Pass an element; return in which messages it has the name."""
        self._note_passed()
        if isinstance(item, Text):
            return self._is_text(name.encode())
        assert isinstance(item, Struct)
        found = np.zeros(self.good.size, dtype=np.bool_)
        for own, inner in item.fields:
            if own != field:
                self._skip(inner)
            elif isinstance(inner, Text):
                found = self._is_text(name.encode())
            else:
                assert isinstance(inner, Number)
                values = self.take(inner)
                found = np.array([str(int(value)) == name for value in values])
        return found

    def _is_text(self, wanted: bytes) -> Mask:
        """Pass a text; return in which messages it is the one that is wanted."""
        length = self._length()
        size = len(wanted)
        # The zero at the end counts where it is written, as ROS does.
        fits = ((length == size) | (length == size + 1)) & (self._place + length <= self._room)
        found = np.zeros(self.good.size, dtype=np.bool_)
        at = np.flatnonzero(fits & self.good)
        if at.size:
            begin = (self._origin + self._place)[at]
            rows = values_at(self._content, "u1", begin[:, np.newaxis] + np.arange(size))
            found[at] = (rows == np.frombuffer(wanted, dtype=np.uint8)).all(axis=1)
            ends = np.broadcast_to(np.asarray(length), found.shape)[at] > size
            zero = values_at(self._content, "u1", np.where(ends, begin + size, begin)) == 0
            found[at] &= zero | ~ends
        self._advance(length)
        return found

    def _field(self, kind: Struct, wanted: str) -> Type:
        for name, inner in kind.fields:
            if name == wanted:
                return inner
            self._skip(inner)
        raise AssertionError(f"{kind.name} has no {wanted}")

    def take(self, kind: Number) -> NDArray[Any]:
        """Return the numbers here, and go on behind them; where there are none it is zero."""
        self._align(kind.size)
        after = self._place + kind.size
        at = self._origin + self._place
        if not (isinstance(after, int) and after <= self._least_room):
            fits = after <= self._room
            self.good &= fits
            at = np.where(self.good, at, 0)
        self._place = after
        return values_at(self._content, self._order + kind.form, at)

    def _align(self, size: int) -> None:
        if size > 1:
            self._place = (self._place + (size - 1)) & -size

    def _advance(self, size: Place) -> None:
        self._place = self._place + size
        if not isinstance(self._place, int):
            # A place far outside must not overflow; nothing is read there any more.
            self.good &= self._place <= self._room
            self._place = np.where(self.good, self._place, 0)

    def _length(self) -> Place:
        lengths = self.take(_UINT32).astype(np.int64)
        lengths = np.where(self.good, lengths, 0)
        known = lengths[self.good]
        if known.size and bool((known == known[0]).all()):
            return int(known[0])
        return lengths

    def _note_passed(self) -> None:
        self._passed += 1
        if self._passed > MOST_STEPS:
            raise BagError(
                f"the field that is wanted lies behind more than {MOST_STEPS} others, "
                f"too far into a message to be read"
            )

    def _skip(self, kind: Type) -> None:
        self._note_passed()
        if isinstance(kind, Number):
            self._align(kind.size)
            self._advance(kind.size)
        elif isinstance(kind, Text):
            if kind.wide:
                raise BagError(
                    "a field of type wstring lies before the one that is wanted; "
                    "its length differs between middlewares, so that it cannot be passed"
                )
            self._advance(self._length())
        elif isinstance(kind, Struct):
            for _, inner in kind.fields:
                self._skip(inner)
        else:
            self._skip_items(kind.item, self.count(kind))

    def _skip_items(self, item: Type, count: Place) -> None:
        """Pass a number of elements of an array or sequence."""
        if isinstance(item, Number):
            # Where a sequence is empty nothing is aligned.
            before = self._place
            self._align(item.size)
            if not isinstance(count, int):
                self._place = np.where(count > 0, self._place, before)
            elif not count:
                self._place = before
            self._advance(count * item.size)
            return
        for _ in self._each(count):
            self._skip(item)

    def _each(self, count: Place) -> Iterator[int]:
        """Yield the number of each element; passing one counts in the messages that have it."""
        most = count if isinstance(count, int) else int(count.max(initial=0))
        # A string, or a structure, takes a byte at least.
        most = min(most, int(self._room.max()) + 1)
        for number in range(most):
            before, good = self._place, self.good.copy()
            yield number
            if not isinstance(count, int):
                more = number < count
                self._place = np.where(more, self._place, before)
                self.good = np.where(more, self.good, good)
            if not bool(self.good.any()):
                return


class Decoder:
    """Decodes messages of a type, with a limit on the structures and elements in all of them.

    :param root: the type.
    :param of: what to say of a message in an error.
    """

    def __init__(self, root: Struct, of: str = "") -> None:
        self._root, self._of = root, of
        self._left = MOST_ELEMENTS

    def decoded(self, data: bytes) -> Any:
        """Return a message in plain CDR as an object with the fields as attributes.

        Bytes after its end are allowed. ROS 2's own serialization leaves some there: it makes
        room for the alignment of a sequence's elements even if the sequence is empty.

        :param data: the serialized message.
        :raises BagError: if it does not fit its type.
        """
        try:
            if data[:2] not in (b"\x00\x00", b"\x00\x01") or len(data) < _ENCAPSULATION:
                raise ValueError("it is not in plain CDR")
            self._order, self._at = "<" if data[1] else ">", 0
            self._data = memoryview(data)[_ENCAPSULATION:]
            return self._take(self._root)
        except (ValueError, struct.error, MemoryError) as error:
            raise BagError(
                f"a message{self._of} does not fit its definition: {first_line(error)}"
            ) from None

    def _count(self, number: int) -> None:
        """Count structures or elements, each of which takes memory."""
        self._left -= number
        if self._left < 0:
            raise ValueError(f"more than {MOST_ELEMENTS} structures and elements of lists")

    def _take(self, kind: Type) -> Any:
        """Return the next value: a number, a text, an array, a list, or an object with fields."""
        if isinstance(kind, Number):
            return self._number(kind)
        if isinstance(kind, Text):
            return self._text(kind)
        if isinstance(kind, Struct):
            self._count(1)
            return SimpleNamespace(**{name: self._take(inner) for name, inner in kind.fields})
        count = self._number(_UINT32) if kind.count is None else kind.count
        if isinstance(kind.item, Number):
            return self._array(kind.item, count)
        self._count(count)
        return [self._take(kind.item) for _ in range(count)]

    def _number(self, kind: Number) -> Any:
        self._align(kind.size)
        (value,) = struct.unpack_from(self._order + kind.form, self._data, self._at)
        self._at += kind.size
        return bool(value) if kind.name == "bool" else value

    def _array(self, kind: Number, count: int) -> NDArray[Any]:
        if count == 0:
            # Where a sequence is empty nothing is aligned.
            return np.empty(0, dtype=kind.form)
        self._align(kind.size)
        values = np.frombuffer(self._data, self._order + kind.form, count, self._at)
        self._at += count * kind.size
        return values

    def _text(self, kind: Text) -> str:
        if kind.wide:
            raise ValueError("the length of a wstring differs between middlewares")
        end = self._number(_UINT32) + self._at
        if end > len(self._data):
            raise ValueError(f"a text ends {end - len(self._data)} bytes behind the message")
        text = bytes(self._data[self._at : end]).removesuffix(b"\0").decode("utf-8")
        self._at = end
        return visible(text)

    def _align(self, size: int) -> None:
        self._at = (self._at + size - 1) & -size
