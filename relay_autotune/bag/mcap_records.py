# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The records of an MCAP file, and the messages among them, found by array operations.

Layout: https://mcap.dev/spec. Every length is checked against what is there before it is used.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from relay_autotune.bag.arrays import IntArray
from relay_autotune.bag.definitions import Channel
from relay_autotune.bag.limits import MOST_DECLARATIONS, MOST_DECLARED
from relay_autotune.bag.source import DamageError
from relay_autotune.errors import BagError, visible

RECORD = struct.Struct("<BQ")
# Channel, sequence, log time and publish time, before the message itself.
MESSAGE_HEAD_SIZE = 22

Content = bytes | memoryview


class _Fields:
    """What the package mcap reads a record from; by itself it takes a cut field for whole.

    :param content: of the record.
    :param whole: whether all of it is there.
    """

    def __init__(self, content: Content, whole: bool) -> None:
        self._content, self._whole, self._at = memoryview(content), whole, 0

    def read(self, length: int) -> memoryview:
        """Return the next bytes, without a copy."""
        begin, self._at = self._at, self._at + length
        data = self._content[begin : self._at]
        if self._whole and len(data) < length:
            raise DamageError("a record is cut")
        return data


def parsed(kind: str, content: Content, *, whole: bool = True) -> Any:
    """Return a record as the package mcap reads it.

    :param kind: name of its class there.
    :param content: of the record, which its binary fields are part of.
    :param whole: whether all of it is there; if not, its last field may be cut.
    :raises DamageError: if it makes no sense.
    """
    # Imported here: a command that reads no bag starts sooner.
    from mcap import data_stream, exceptions, records

    stream: Any = _Fields(content, whole)
    try:
        return getattr(records, kind).read(data_stream.ReadDataStream(stream))
    except UnicodeDecodeError:
        raise DamageError("a name is not UTF-8") from None
    except (struct.error, exceptions.EndOfFile):
        raise DamageError("a record is cut") from None


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
        self._channels: dict[int, tuple[str, int, str]] = {}
        self._taken: set[tuple[int, bytes]] = set()
        self._size = 0

    @property
    def channels(self) -> dict[int, Channel]:
        """The channels by their ids, each with its type, wherever that is declared."""
        return {
            number: Channel(number, topic, name, encoding, schema_encoding, definition)
            for number, (topic, schema, encoding) in self._channels.items()
            for name, schema_encoding, definition in [self._schemas.get(schema, ("", "", b""))]
        }

    @property
    def have_all_types(self) -> bool:
        """True if the type of each channel is declared; 0 stands for a channel without a type."""
        return all(
            schema in self._schemas or schema == 0 for _, schema, _ in self._channels.values()
        )

    @staticmethod
    def _too_many() -> BagError:
        return BagError(
            f"the recording declares more than {MOST_DECLARATIONS} schemas, channels and "
            f"metadata, or more than {MOST_DECLARED} bytes of them; expected a recording"
        )

    def take_all(self, content: Content, offsets: IntArray) -> None:
        """Take in those of some records that declare anything.

        :param content: the records.
        :param offsets: where each begins, shape (n,).
        :raises DamageError: if one makes no sense; the others are taken in.
        :raises BagError: if there are too many.
        """
        damage: DamageError | None = None
        declaring = offsets[np.isin(opcodes(content, offsets), _DECLARING)]
        if declaring.size > MOST_DECLARATIONS:
            raise self._too_many()
        for at in declaring.tolist():
            opcode, length = RECORD.unpack_from(content, at)
            begin = at + RECORD.size
            try:
                self.take(opcode, bytes(content[begin : begin + length]))
            except DamageError as error:
                damage = damage or error
        if damage is not None:
            raise damage

    def take(self, opcode: int, body: bytes) -> None:
        """Take in a record that declares something.

        :raises DamageError: if it makes no sense.
        :raises BagError: if there are too many.
        """
        if (opcode, body) in self._taken:
            return
        self._size += len(body)
        if len(self._taken) >= MOST_DECLARATIONS or self._size > MOST_DECLARED:
            raise self._too_many()
        self._taken.add((opcode, body))
        it = parsed(Opcode(opcode).name.title(), body)
        if opcode == Opcode.SCHEMA:
            schema = (visible(it.name), visible(it.encoding), bytes(it.data))
            if self._schemas.setdefault(it.id, schema) != schema:
                self.contradictions.append(f"two different types have the number {it.id}")
        elif opcode == Opcode.CHANNEL:
            channel = (visible(it.topic), it.schema_id, visible(it.message_encoding))
            first = self._channels.setdefault(it.id, channel)
            if first != channel:
                self.contradictions.append(
                    f"channel {it.id} is declared as {first[0]} and, differently, as {channel[0]}"
                )
        elif opcode == Opcode.METADATA:
            about = {visible(key): visible(value) for key, value in it.metadata.items()}
            self.metadata.append((visible(it.name), about))
        elif self.message_counts is None:
            self.message_counts = it.channel_message_counts


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

# numpy compares with a plain number eight times as fast.
_MESSAGE = int(Opcode.MESSAGE)

# Records of one size that must follow each other before a longer run of them is looked for.
_RUN = 4
_LONGEST_RUN = 1 << 16
# Number of channels up to which each one's messages are looked for among all.
_FEW = 16
NOWHERE: IntArray = np.empty(0, dtype=np.int64)


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


def values_at(content: Content, form: str, places: IntArray) -> NDArray[Any]:
    """Return the values at some places of some content.

    Those at equal distances, as one topic's often are, come without a copy.

    :param content: the bytes.
    :param form: type of the values.
    :param places: where each begins, and does not end behind the content, of any shape.
    :return: of the same shape.
    """
    kind = np.dtype(form)
    if places.ndim == 1 and places.size > 1:
        first, step = int(places[0]), int(places[1] - places[0])
        even = step > 0 and int(places[-1]) - first == step * (places.size - 1)
        if even and bool((np.diff(places) == step).all()):
            return np.ndarray(places.shape, kind, content, first, (step,))
    if not places.size:
        return np.empty(places.shape, kind)
    # Those that begin at each byte, of which some are taken.
    count = len(content) - kind.itemsize + 1
    found: NDArray[Any] = np.ndarray((count,), kind, content, 0, (1,))[places]
    return found


def opcodes(content: Content, offsets: IntArray) -> NDArray[np.uint8]:
    """Return the opcodes of the records that begin at some places."""
    return values_at(content, "u1", offsets)


def record_offsets(content: Content) -> tuple[IntArray, int]:
    """Return where each record begins, and where the last whole one ends.

    :param content: the records.
    :raises BagError: if it has more of them than messages and declarations can be in it: records
        of nothing would take several times its memory.
    """
    size, unpack = len(content), _LENGTH.unpack_from
    left = size // _HEAD.itemsize + MOST_DECLARATIONS
    parts: list[IntArray] = []
    found: list[int] = []
    position, previous, repeats, needed = 0, -1, 0, _RUN
    while position + RECORD.size <= size and left > 0:
        (length,) = unpack(content, position + 1)
        if length > size - position - RECORD.size or content[position] == 0:
            break
        found.append(position)
        left -= 1
        position += RECORD.size + length
        repeats = repeats + 1 if length == previous else 0
        previous = length
        count = 0
        if repeats >= needed:
            count = min(_equal_records(content, position, length), left)
            # Where runs are short, looking for them costs more than it gives.
            needed = _RUN if count >= 4 * _RUN else 2 * needed
            repeats = 0
        if count or len(found) >= _LONGEST_RUN:
            step = RECORD.size + length
            parts += [np.array(found, dtype=np.int64)]
            parts += [position + step * np.arange(count, dtype=np.int64)]
            found = []
            position += count * step
            left -= count
    if left <= 0:
        raise BagError(
            f"the recording holds {size} bytes with more records than messages that they can be; "
            f"expected a recording"
        )
    parts.append(np.array(found, dtype=np.int64))
    return np.concatenate(parts), position


def _equal_records(content: Content, position: int, length: int) -> int:
    """Return how many records of a length follow each other from a place on."""
    step = RECORD.size + length
    most = min((len(content) - position) // step, _LONGEST_RUN)
    tried, held = 64, 0
    while held < most:
        count = min(tried, most - held)
        at = position + held * step
        kinds = np.ndarray((count,), "u1", content, at, (step,))
        lengths = np.ndarray((count,), "<u8", content, at + 1, (step,))
        equal = (kinds != 0) & (lengths == length)
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
    for at in record_offsets(indexes)[0].tolist():
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
    content: Content, offsets: IntArray, wanted: Collection[int], declared: Collection[int]
) -> Sorted:
    """Tell messages by their channels, and from other records.

    :param content: the records.
    :param offsets: where each begins.
    :param wanted: the channels whose messages are wanted.
    :param declared: the channels that there are.
    """
    places, heads, others, short = _message_heads(content, offsets)
    channels = np.ascontiguousarray(heads["channel"])
    known = np.zeros(1 << 16, dtype=np.bool_)
    known[list(declared)] = True
    found: dict[int, Messages] = {}
    for number, own in _by_channel(channels, wanted):
        at = places[own]
        of_it = _heads(content, at)
        end = at + RECORD.size + of_it["length"].astype(np.int64)
        found[number] = _messages_at(content, at, of_it, end)
    return Sorted(found, others, places[~known[channels]], short)


def summed_up(content: Content, offsets: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return what the messages among some records are, without taking them apart.

    :param content: the records.
    :param offsets: where each begins.
    :return: the channels that have messages; the time at which each message was recorded [ns];
        where the other records begin.
    """
    _, heads, others, _ = _message_heads(content, offsets)
    used = np.flatnonzero(np.bincount(heads["channel"]))
    return used, nanoseconds(heads["log_time"]), others


def _message_heads(
    content: Content, offsets: IntArray
) -> tuple[IntArray, NDArray[Any], IntArray, int]:
    """Return where messages begin, and their heads; where others do; the number of short ones."""
    is_message = opcodes(content, offsets) == _MESSAGE
    others, places = offsets[~is_message], _chosen(offsets, is_message)
    # Nearer to the end of the content only one that is too short begins.
    last = len(content) - _HEAD.itemsize
    heads = _heads(content, places[: np.searchsorted(places, last, side="right")])
    whole = heads["length"] >= MESSAGE_HEAD_SIZE
    short = places.size - int(np.count_nonzero(whole))
    return _chosen(places[: heads.size], whole), _chosen(heads, whole), others, short


def _by_channel(
    channels: NDArray[np.uint16], wanted: Collection[int]
) -> Iterator[tuple[int, IntArray]]:
    """Yield each wanted channel that has messages, and which ones are its."""
    if len(wanted) <= _FEW:
        for number in sorted(wanted):
            own = np.flatnonzero(channels == number)
            if own.size:
                yield number, own
        return
    # To look through all messages for each of many channels takes hours.
    order = np.argsort(channels, kind="stable")
    ends = np.cumsum(np.bincount(channels))
    for number in sorted(set(wanted) & set(np.unique(channels).tolist())):
        yield number, order[ends[number - 1] if number else 0 : ends[number]]


def listed_records(
    content: Content,
    listed: Mapping[int, IntArray],
    wanted: Collection[int],
    declared: Collection[int],
) -> Sorted | None:
    """Return what `sorted_records` would, without going from record to record.

    Where each place that is listed holds a message of its channel, and all of them together are as
    long as the content, nothing else is in it.

    :param content: the records.
    :param listed: where messages are said to begin, by channel, shape (n,) each.
    :param wanted: the channels whose messages are wanted.
    :param declared: the channels that there are.
    :return: None: not all of that is so.
    """
    last, covered = len(content) - _HEAD.itemsize, 0
    if listed.keys() - set(declared):
        return None
    found: dict[int, Messages] = {}
    for channel, at in listed.items():
        if not at.size:
            continue
        if not bool((at[1:] > at[:-1]).all()) or int(at[0]) < 0 or int(at[-1]) > last:
            return None
        heads = _heads(content, at)
        right = (heads["opcode"] == _MESSAGE) & (heads["channel"] == channel)
        # One beyond the signed range is negative here, and behind the content without a sign.
        length = heads["length"].astype(np.int64)
        end = at + length
        if (
            not bool(right.all())
            or int(length.min()) < MESSAGE_HEAD_SIZE
            or int(end.view(np.uint64).max()) > last + MESSAGE_HEAD_SIZE
        ):
            return None
        covered += int(length.sum()) + RECORD.size * at.size
        if channel in wanted:
            found[channel] = _messages_at(content, at, heads, end + RECORD.size)
    # They begin at different places, and together they have all of its bytes.
    return Sorted(found, NOWHERE, NOWHERE, 0) if covered == len(content) > 0 else None


def _chosen(values: NDArray[Any], chosen: NDArray[np.bool_]) -> NDArray[Any]:
    """Return the values that are chosen, mostly all of them."""
    return values if chosen.all() else values[chosen]


def _heads(content: Content, offsets: IntArray) -> NDArray[Any]:
    # Copied as opaque bytes: numpy copies a structure field by field, ten times as slowly.
    return values_at(content, f"V{_HEAD.itemsize}", offsets).view(_HEAD)


def _messages_at(
    content: Content, offsets: IntArray, heads: NDArray[Any], end: IntArray
) -> Messages:
    times = nanoseconds(heads["log_time"]), nanoseconds(heads["publish_time"])
    begin = offsets + (RECORD.size + MESSAGE_HEAD_SIZE)
    return Messages(content, offsets, *times, begin, end)


def nanoseconds(values: NDArray[np.uint64]) -> IntArray:
    """Return times as signed numbers; one beyond their range is no time of any clock."""
    signed = values.astype(np.int64)
    if signed.size and int(signed.min()) < 0:
        signed[signed < 0] = np.iinfo(np.int64).max
    return signed
