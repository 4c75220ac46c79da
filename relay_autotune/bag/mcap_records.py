# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The records of an MCAP file, and the messages among them, found by array operations.

Layout: https://mcap.dev/spec. Every length is checked against what is there before it is used.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import IntArray
from relay_autotune.bag.limits import MOST_DECLARATIONS
from relay_autotune.text import visible


class Opcode:
    """The kinds of records that are read."""

    FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
    MESSAGE_INDEX, CHUNK_INDEX, STATISTICS = 0x07, 0x08, 0x0B
    METADATA, DATA_END = 0x0C, 0x0F


RECORD = struct.Struct("<BQ")
# Channel, sequence, log time and publish time, before the message itself.
MESSAGE_HEAD_SIZE = 22
FOOTER_SIZE = 20


class DamageError(Exception):
    """Bytes that are no MCAP records."""


def unsigned(data: bytes, at: int, form: str) -> int:
    """Return the number at a place of a record."""
    if at + struct.calcsize(form) > len(data):
        raise DamageError("a record is cut")
    return int(struct.unpack_from(form, data, at)[0])


def sized_bytes(data: bytes, at: int) -> tuple[bytes, int]:
    """Return the bytes after their length, and the place after them."""
    length = unsigned(data, at, "<I")
    if length > len(data) - at - 4:
        raise DamageError("a text is longer than its record")
    return data[at + 4 : at + 4 + length], at + 4 + length


def text(data: bytes, at: int) -> tuple[str, int]:
    """Return the text after its length, made visible, and the place after it."""
    raw, at = sized_bytes(data, at)
    try:
        return visible(raw.decode("utf-8")), at
    except UnicodeDecodeError:
        raise DamageError("a name is not UTF-8") from None


def map_of_text(data: bytes, at: int) -> tuple[dict[str, str], int]:
    """Return the texts by their names, and the place after them."""
    body, after = sized_bytes(data, at)
    found: dict[str, str] = {}
    at = 0
    while at < len(body):
        key, at = text(body, at)
        found[key], at = text(body, at)
    return found, after


@dataclass(frozen=True)
class Channel:
    """A topic as the file declares it.

    :param id: number that its messages carry.
    :param topic: name.
    :param type: message type, the name of the schema; empty: unknown.
    :param encoding: of the messages, such as ``cdr``.
    :param schema_encoding: such as ``ros2msg``.
    :param definition: text of the schema.
    :param metadata: what the recorder noted, such as QoS.
    """

    id: int
    topic: str
    type: str
    encoding: str
    schema_encoding: str
    definition: bytes
    metadata: dict[str, str]


_DECLARING = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.STATISTICS)


class Declarations:
    """What the records of a file declare: its channels, metadata and number of messages.

    What is declared twice is expected to be the same; if it is not, the first one counts, and
    `contradictions` says so.
    """

    def __init__(self) -> None:
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.message_counts: dict[int, int] | None = None
        self.contradictions: list[str] = []
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._channels: dict[int, tuple[str, int, str, dict[str, str]]] = {}
        self._taken: set[tuple[int, bytes]] = set()

    @property
    def channels(self) -> dict[int, Channel]:
        """The channels by their ids, each with its type, wherever that is declared."""
        return {
            number: Channel(number, topic, name, encoding, schema_encoding, definition, metadata)
            for number, (topic, schema, encoding, metadata) in self._channels.items()
            for name, schema_encoding, definition in [self._schemas.get(schema, ("", "", b""))]
        }

    @property
    def have_all_types(self) -> bool:
        """True if the type of each channel is declared; 0 stands for a channel without a type."""
        return all(
            schema in self._schemas or schema == 0 for _, schema, *_ in self._channels.values()
        )

    def take_all(self, content: bytes | memoryview, offsets: IntArray) -> None:
        """Take in those of the records inside of a chunk that declare channels.

        :param content: the records.
        :param offsets: where each begins, shape (n,).
        :raises DamageError: if one contradicts itself, or there are too many; the others are
            taken in.
        """
        opcodes = np.ndarray((len(content),), "u1", content)[offsets]
        damage: DamageError | None = None
        for at in offsets[(opcodes == Opcode.SCHEMA) | (opcodes == Opcode.CHANNEL)].tolist():
            opcode, length = RECORD.unpack_from(content, at)
            begin = at + RECORD.size
            try:
                self.take(opcode, bytes(content[begin : begin + length]))
            except DamageError as error:
                damage = damage or error
        if damage is not None:
            raise damage

    def take(self, opcode: int, body: bytes) -> None:
        """Take in a record, if it declares anything.

        :raises DamageError: if it contradicts itself, or there are too many.
        """
        if opcode not in _DECLARING:
            return
        if (opcode, body) in self._taken:
            return
        if len(self._taken) >= MOST_DECLARATIONS:
            raise DamageError(f"more than {MOST_DECLARATIONS} schemas, channels and metadata")
        self._taken.add((opcode, body))
        if opcode == Opcode.SCHEMA:
            number = unsigned(body, 0, "<H")
            name, at = text(body, 2)
            encoding, at = text(body, at)
            definition, _ = sized_bytes(body, at)
            schema = (name, encoding, definition)
            if self._schemas.setdefault(number, schema) != schema:
                self.contradictions.append(f"two different types have the number {number}")
        elif opcode == Opcode.CHANNEL:
            number, schema_number = unsigned(body, 0, "<H"), unsigned(body, 2, "<H")
            topic, at = text(body, 4)
            encoding, at = text(body, at)
            metadata, _ = map_of_text(body, at)
            first = self._channels.setdefault(number, (topic, schema_number, encoding, metadata))
            if first[:3] != (topic, schema_number, encoding):
                self.contradictions.append(
                    f"channel {number} is declared as {first[0]} and, differently, as {topic}"
                )
        elif opcode == Opcode.METADATA:
            name, at = text(body, 0)
            self.metadata.append((name, map_of_text(body, at)[0]))
        elif self.message_counts is None:
            counts, _ = sized_bytes(body, 42)
            if len(counts) % 10:
                raise DamageError("statistics of impossible length")
            self.message_counts = dict(struct.iter_unpack("<HQ", counts))


Content = bytes | memoryview

_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_LENGTH = struct.Struct("<Q")
# A message index: its channel, the bytes of its entries, and these.
_INDEX_HEAD = struct.Struct("<HI")
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])

# Records of one size that must follow each other before a longer run of them is looked for.
_RUN = 4
_LONGEST_RUN = 1 << 16
_NOWHERE: IntArray = np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Messages:
    """Messages of one channel within a run of records.

    :param content: the records, or what they hold.
    :param order: where each one's record begins in the run, which tells the order of messages of
        several channels; shape (n,).
    :param log_time: when each was recorded [ns], shape (n,).
    :param publish_time: when each was sent [ns]; 0: unknown; shape (n,).
    :param begin: where each serialized message begins in the content, shape (n,).
    :param end: where it ends, shape (n,).
    """

    content: Content
    order: IntArray
    log_time: IntArray
    publish_time: IntArray
    begin: IntArray
    end: IntArray

    def __len__(self) -> int:
        return int(self.begin.size)

    def payloads(self) -> Iterator[bytes]:
        """Yield a copy of each of them, serialized."""
        for begin, end in zip(self.begin.tolist(), self.end.tolist(), strict=True):
            yield bytes(self.content[begin:end])

    def payload(self, number: int, most: int = sys.maxsize) -> bytes:
        """Return a copy of one of them, serialized, or of its beginning.

        :param number: of the message.
        :param most: size of the copy [bytes].
        """
        begin, end = int(self.begin[number]), int(self.end[number])
        return bytes(self.content[begin : min(end, begin + most)])


def every_byte(content: Content, form: str | np.dtype[Any], shift: int = 0) -> NDArray[Any]:
    """Return values that begin at each byte of some content, without a copy.

    :param content: the bytes.
    :param form: type of the values.
    :param shift: where the first one begins.
    :return: as many as fit.
    """
    kind = np.dtype(form)
    count = max(len(content) - shift - kind.itemsize + 1, 0)
    if count == 0:
        return np.empty(0, dtype=kind)
    return np.ndarray((count,), kind, content, shift, (1,))


@dataclass(frozen=True)
class Records:
    """The records that follow each other in some content.

    :param content: the records.
    :param offsets: where each begins, shape (n,).
    :param end: where the last whole one ends.
    :param read: the heads of all of them as `heads` has them, where they are read already.
    """

    content: Content
    offsets: IntArray
    end: int
    read: NDArray[Any] | None = None

    @property
    def heads(self) -> NDArray[Any]:
        """The heads of messages as opaque bytes, shape (m,).

        The content ends within those of the last n - m records, which are none of messages.
        """
        if self.read is not None:
            return self.read
        last = len(self.content) - _HEAD.itemsize
        return _heads(self.content, self.offsets[: np.searchsorted(self.offsets, last, "right")])


def _heads(content: Content, offsets: IntArray) -> NDArray[Any]:
    # Copied as opaque bytes: numpy copies a structure field by field, ten times as slowly.
    return every_byte(content, f"V{_HEAD.itemsize}")[offsets]


class _Hints:
    """Places at which messages are said to begin; each is checked before it is used.

    :param content: the records.
    :param places: in any order, wrong ones among them; shape (n,).
    """

    def __init__(self, content: Content, places: IntArray) -> None:
        last = len(content) - _HEAD.itemsize
        # Each channel lists its places rising, and this sort is for such runs; to find equal ones
        # takes numpy ten times as long as to leave them out here.
        at = np.sort(places, kind="stable")
        at = at[np.searchsorted(at, 0) : np.searchsorted(at, last, "right")]
        at, _ = _parted(at, np.append(at[1:] != at[:-1], [True] * bool(at.size)))
        heads = _heads(content, at)
        # A length beyond the signed range is negative here.
        length = heads.view(_HEAD)["length"].astype(np.int64)
        fits = (length >= 0) & (length <= len(content) - RECORD.size - at)
        fits &= heads.view(_HEAD)["opcode"] != 0
        if not fits.all():
            at, heads, length = at[fits], heads[fits], length[fits]
        self._at, self._heads = at, heads
        self._after = at + length + RECORD.size
        # A run ends where the next place is not the one that its last record leads to.
        self._ends = np.append(np.flatnonzero(self._after[:-1] != at[1:]), at.size - 1)
        self.next = int(at[0]) if at.size else len(content)

    def run(self, position: int, size: int) -> tuple[IntArray, NDArray[Any], int]:
        """Return records that follow each other from a place on, and where the last one ends.

        :param position: where a record begins; `next` is not beyond it.
        :param size: of the content.
        :return: where they begin, their heads, and the end.
        """
        first = last = int(np.searchsorted(self._at, position))
        begin = position
        if first < self._at.size and self._at[first] == position:
            last = int(self._ends[np.searchsorted(self._ends, first)]) + 1
            position = int(self._after[last - 1])
        after = last if position == begin else int(np.searchsorted(self._at, position))
        self.next = int(self._at[after]) if after < self._at.size else size
        return self._at[first:last], self._heads[first:last], position


def records_of(content: Content, places: IntArray | None = None) -> Records:
    """Return the records that follow each other from the beginning of some content.

    They end before the content where it has more of them than messages and declarations can be
    in it: records of nothing would take several times its memory.

    :param content: the records.
    :param places: where messages are said to begin, which saves time and changes nothing else.
    """
    size, unpack = len(content), _LENGTH.unpack_from
    hints: _Hints | None = None
    left = size // _HEAD.itemsize + MOST_DECLARATIONS
    parts: list[IntArray] = []
    found: list[int] = []
    position, previous, repeats, needed = 0, -1, 0, _RUN

    def keep(more: IntArray) -> None:
        nonlocal found, left
        parts.extend((np.array(found, dtype=np.int64), more))
        left -= len(found) + more.size
        found = []

    while position + RECORD.size <= size and left > len(found):
        if hints is not None and hints.next <= position:
            run, heads, after = hints.run(position, size)
            if position == 0 and after == size:
                return Records(content, run, size, heads)
            if run.size:
                position = after
                keep(run)
                continue
        (length,) = unpack(content, position + 1)
        if length > size - position - RECORD.size or content[position] == 0:
            break
        found.append(position)
        position += RECORD.size + length
        repeats = repeats + 1 if length == previous else 0
        previous = length
        if repeats >= needed:
            count = min(_equal_records(content, position, length), left)
            # Where runs are short, looking for them costs more than it gives.
            needed = _RUN if count >= 4 * _RUN else 2 * needed
            step = RECORD.size + length
            keep(position + step * np.arange(count, dtype=np.int64))
            position += count * step
            repeats = 0
        elif hints is None and places is not None and len(found) >= 2 * _RUN:
            # Records of equal size are found sooner without. All at once from the beginning.
            hints = _Hints(content, places)
            if not parts:
                found, position = [], 0
        elif len(found) >= _LONGEST_RUN:
            keep(_NOWHERE)
    keep(_NOWHERE)
    return Records(content, np.concatenate(parts), position)


def _equal_records(content: Content, position: int, length: int) -> int:
    """Return how many records of a length follow each other from a place on."""
    step = RECORD.size + length
    most = min((len(content) - position) // step, _LONGEST_RUN)
    tried, held = 64, 0
    while held < most:
        count = min(tried, most - held)
        at = position + held * step
        opcodes = np.ndarray((count,), "u1", content, at, (step,))
        lengths = np.ndarray((count,), "<u8", content, at + 1, (step,))
        equal = (opcodes != 0) & (lengths == length)
        if not bool(equal.all()):
            return held + int(np.argmin(equal))
        held += count
        tried *= 4
    return held


def indexed_offsets(indexes: bytes) -> dict[int, IntArray]:
    """Return where the messages of each channel are said to begin in their chunk.

    :param indexes: the records of message indexes that follow the chunk; what makes no sense in
        them is left out.
    """
    found: dict[int, IntArray] = {}
    for at in records_of(indexes).offsets.tolist():
        opcode, length = RECORD.unpack_from(indexes, at)
        if opcode != Opcode.MESSAGE_INDEX or length < 6:
            continue
        channel, listed = _INDEX_HEAD.unpack_from(indexes, at + RECORD.size)
        count = min(listed, length - 6) // _INDEX_ENTRY.itemsize
        begin = at + RECORD.size + _INDEX_HEAD.size
        entries = np.frombuffer(indexes, _INDEX_ENTRY, count, begin)
        places = nanoseconds(entries["offset"])
        found[channel] = np.append(found[channel], places) if channel in found else places
    return found


@dataclass(frozen=True)
class Sorted:
    """The records of some content by what they are.

    :param messages: those of each wanted channel that has any.
    :param others: where the records begin that are no messages, shape (m,).
    :param unknown: where messages of channels begin that are not declared, shape (k,).
    :param short: number of messages that are too short to be one.
    """

    messages: dict[int, Messages]
    others: IntArray
    unknown: IntArray
    short: int


def sorted_records(
    records: Records, wanted: Collection[int] | None, declared: Collection[int]
) -> Sorted:
    """Tell messages by their channels, and from other records.

    :param records: all of them.
    :param wanted: the channels whose messages are wanted; None: all of them.
    :param declared: the channels that there are.
    """
    offsets, opaque = records.offsets, records.heads
    near = opaque.size
    last = _opcodes(records.content, offsets[near:]) == Opcode.MESSAGE
    is_message = opaque.view(_HEAD)["opcode"] == Opcode.MESSAGE
    others = np.append(offsets[:near][~is_message], offsets[near:][~last])
    whole = is_message & (opaque.view(_HEAD)["length"] >= MESSAGE_HEAD_SIZE)
    short = np.count_nonzero(is_message) - np.count_nonzero(whole) + np.count_nonzero(last)
    places = offsets[:near]
    if not whole.all():
        places, opaque = places[whole], opaque[whole]
    channels = np.ascontiguousarray(opaque.view(_HEAD)["channel"])
    known = np.zeros(1 << 16, dtype=np.bool_)
    known[list(declared)] = True
    _, unknown = _parted(places, known[channels])
    chosen = np.flatnonzero(np.bincount(channels)).tolist() if wanted is None else sorted(wanted)
    found: dict[int, Messages] = {}
    for number in chosen:
        own = np.flatnonzero(channels == number)
        if own.size:
            found[number] = _messages_at(records.content, places[own], opaque[own].view(_HEAD))
    return Sorted(found, others, unknown, int(short))


def _parted(places: IntArray, chosen: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Return the places that are chosen, mostly all of them, and the others."""
    if chosen.all():
        return places, places[:0]
    return places[chosen], places[~chosen]


def _messages_at(content: Content, offsets: IntArray, heads: NDArray[Any]) -> Messages:
    body = offsets + RECORD.size
    times = nanoseconds(heads["log_time"]), nanoseconds(heads["publish_time"])
    end = body + heads["length"].astype(np.int64)
    return Messages(content, offsets, *times, body + MESSAGE_HEAD_SIZE, end)


def nanoseconds(values: NDArray[np.uint64]) -> IntArray:
    """Return times as signed numbers; one beyond their range is no time of any clock."""
    signed = values.astype(np.int64)
    beyond = signed < 0
    if bool(beyond.any()):
        signed[beyond] = np.iinfo(np.int64).max
    return signed


def _opcodes(content: Content, offsets: IntArray) -> NDArray[np.uint8]:
    found: NDArray[np.uint8] = every_byte(content, "u1")[offsets]
    return found
