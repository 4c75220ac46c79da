# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Where the messages are in a run of records, found by array operations."""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import IntArray
from relay_autotune.bag.mcap_records import (
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    MESSAGE_INDEX,
    RECORD,
)

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


class _Hints:
    """Places at which records are said to begin; each is checked before it is used.

    :param content: the records.
    :param places: in any order, wrong ones among them; shape (n,).
    """

    def __init__(self, content: Content, places: IntArray) -> None:
        inside = (places >= 0) & (places <= len(content) - RECORD.size)
        at = np.unique(places[inside])
        room = len(content) - RECORD.size - at
        length = every_byte(content, "<u8", 1)[at] if at.size else np.empty(0, np.uint64)
        fits = (length <= room.astype(np.uint64)) & (_opcodes(content, at) != 0)
        self._at = at[fits]
        self._after = self._at + RECORD.size + length[fits].astype(np.int64)
        # A run ends where the next place is not the one that its last record leads to.
        self._ends = np.append(np.flatnonzero(self._after[:-1] != self._at[1:]), self._at.size - 1)
        self.next = int(self._at[0]) if self._at.size else len(content)

    def run(self, position: int, size: int) -> tuple[IntArray, int]:
        """Return records that follow each other from a place on, and where the last one ends.

        :param position: where a record begins; `next` is not beyond it.
        :param size: of the content.
        """
        first = int(np.searchsorted(self._at, position))
        found = self._at[first:first]
        if first < self._at.size and self._at[first] == position:
            last = int(self._ends[np.searchsorted(self._ends, first)])
            found, position = self._at[first : last + 1], int(self._after[last])
            first = int(np.searchsorted(self._at, position))
        self.next = int(self._at[first]) if first < self._at.size else size
        return found, position


def record_offsets(content: Content, places: IntArray | None = None) -> tuple[IntArray, int]:
    """Return where each record begins, and where the last whole one ends.

    :param content: the records.
    :param places: where records are said to begin, which saves time and changes nothing else.
    """
    size, unpack = len(content), _LENGTH.unpack_from
    hints = None if places is None else _Hints(content, places)
    expected = size if hints is None else hints.next
    parts: list[IntArray] = []
    found: list[int] = []
    position, previous, repeats, needed = 0, -1, 0, _RUN
    while position + RECORD.size <= size:
        if hints is not None and expected <= position:
            run, position = hints.run(position, size)
            expected = hints.next
            if run.size:
                parts += [np.array(found, dtype=np.int64), run]
                found = []
                continue
        (length,) = unpack(content, position + 1)
        if length > size - position - RECORD.size or content[position] == 0:
            break
        found.append(position)
        position += RECORD.size + length
        repeats = repeats + 1 if length == previous else 0
        previous = length
        if repeats >= needed:
            count = _equal_records(content, position, length)
            # Where runs are short, looking for them costs more than it gives.
            needed = _RUN if count >= 4 * _RUN else 2 * needed
            if count:
                step = RECORD.size + length
                parts += [np.array(found, dtype=np.int64)]
                parts += [position + step * np.arange(count, dtype=np.int64)]
                found = []
                position += count * step
            repeats = 0
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
    offsets, _ = record_offsets(indexes)
    found: dict[int, IntArray] = {}
    for at in offsets.tolist():
        opcode, length = RECORD.unpack_from(indexes, at)
        if opcode != MESSAGE_INDEX or length < 6:
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

    :param places: where the messages of each wanted channel begin, shape (n,) each.
    :param others: where the records begin that are no messages, shape (m,).
    :param unknown: where messages of channels begin that are not declared, shape (k,).
    :param short: number of messages that are too short to be one.
    """

    places: dict[int, IntArray]
    others: IntArray
    unknown: IntArray
    short: int


def sorted_records(
    content: Content, offsets: IntArray, wanted: Collection[int] | None, declared: Collection[int]
) -> Sorted:
    """Tell messages by their channels, and from other records.

    :param content: the records.
    :param offsets: where each begins.
    :param wanted: the channels whose messages are wanted; None: all of them.
    :param declared: the channels that there are.
    """
    is_message = _opcodes(content, offsets) == MESSAGE
    others, places = offsets[~is_message], offsets[is_message]
    if not places.size:
        return Sorted({}, others, places, 0)
    whole = every_byte(content, "<u8", 1)[places] >= MESSAGE_HEAD_SIZE
    short = int(places.size - np.count_nonzero(whole))
    places = places[whole]
    channels = every_byte(content, "<u2", RECORD.size)[places]
    known = np.zeros(1 << 16, dtype=np.bool_)
    known[list(declared)] = True
    unknown = places[~known[channels]]
    chosen = np.unique(channels).tolist() if wanted is None else sorted(wanted)
    found = {number: places[channels == number] for number in chosen}
    return Sorted({n: at for n, at in found.items() if at.size}, others, unknown, short)


def messages_at(content: Content, offsets: IntArray) -> Messages:
    """Return the messages at some places.

    :param content: the records.
    :param offsets: where messages begin, as `sorted_records` found them, shape (n,).
    """
    # Copied as opaque bytes: numpy copies a structure field by field, ten times as slowly.
    heads = every_byte(content, f"V{_HEAD.itemsize}")[offsets].view(_HEAD)
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
