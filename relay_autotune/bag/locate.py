"""Where the messages are in a run of records, found by array operations."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relay_autotune.bag.mcap_records import (
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    MESSAGE_INDEX,
    RECORD,
    DamageError,
    unsigned,
)
from relay_autotune.record.record import IntArray

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


def record_offsets(content: Content) -> tuple[IntArray, int]:
    """Return where each record begins, and where the last whole one ends."""
    size, unpack = len(content), _LENGTH.unpack_from
    parts: list[IntArray] = []
    found: list[int] = []
    position, previous, repeats, needed = 0, -1, 0, _RUN
    while position + RECORD.size <= size:
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


def indexed_offsets(index: bytes, channel: int, size: int) -> IntArray:
    """Return where the messages of a channel begin, by the index record after their chunk.

    :param index: the record with opcode and length.
    :param channel: to which it must belong.
    :param size: of the chunk's content.
    :raises DamageError: if the index makes no sense.
    """
    if len(index) < RECORD.size:
        raise DamageError("a message index is cut")
    opcode, length = RECORD.unpack_from(index)
    if opcode != MESSAGE_INDEX or length > len(index) - RECORD.size:
        raise DamageError("the index does not lead to a message index")
    if unsigned(index, RECORD.size, "<H") != channel:
        raise DamageError("a message index belongs to another channel")
    bytes_of_entries = unsigned(index, RECORD.size + 2, "<I")
    if bytes_of_entries % 16 or bytes_of_entries > length - 6:
        raise DamageError("a message index of impossible length")
    count = bytes_of_entries // 16
    offsets = np.ndarray((count,), "<u8", index, RECORD.size + 6 + 8, (16,)).astype(np.int64)
    if not bool((offsets[1:] > offsets[:-1]).all()):
        # An index is in the order of the log times.
        offsets = np.unique(offsets)
        if offsets.size < count:
            raise DamageError("a message index leads to one message twice")
    if count and (offsets[0] < 0 or offsets[-1] > size - _HEAD.itemsize):
        raise DamageError("a message index leads out of its chunk")
    return offsets


def messages_at(
    content: Content, offsets: IntArray, channel: int, limit: IntArray | None = None
) -> Messages:
    """Return the messages at some places.

    :param content: the records.
    :param offsets: where messages of the channel are said to begin, shape (n,).
    :param channel: their channel.
    :param limit: where each must have ended, shape (n,); None: at the end of the content.
    :raises DamageError: if one of the places holds something else.
    """
    heads = _heads(content, offsets)
    length = heads["length"].astype(np.int64)
    body = offsets + RECORD.size
    wrong = (
        (heads["opcode"] != MESSAGE)
        | (heads["channel"] != channel)
        # A length beyond the signed range is negative here.
        | (length < MESSAGE_HEAD_SIZE)
        | (length > (len(content) if limit is None else limit) - body)
    )
    if bool(wrong.any()):
        raise DamageError("an index does not lead to a message of its channel")
    times = nanoseconds(heads["log_time"]), nanoseconds(heads["publish_time"])
    return Messages(content, offsets, *times, body + MESSAGE_HEAD_SIZE, body + length)


def messages_by_channel(
    content: Content, offsets: IntArray
) -> tuple[dict[int, IntArray], IntArray]:
    """Sort the records of some content.

    :param content: the records.
    :param offsets: where each begins.
    :return: where the messages of each channel begin, and where all other records do.
    """
    opcodes = every_byte(content, "u1")[offsets]
    is_message = opcodes == MESSAGE
    others = offsets[~is_message]
    places = offsets[is_message]
    lengths = every_byte(content, "<u8", 1)[places]
    # One shorter than its head is none.
    places = places[lengths >= MESSAGE_HEAD_SIZE]
    channels = every_byte(content, "<u2", RECORD.size)[places]
    return {int(c): places[channels == c] for c in np.unique(channels)}, others


def nanoseconds(values: NDArray[np.uint64]) -> IntArray:
    """Return times as signed numbers; one beyond their range is no time of any clock."""
    signed = values.astype(np.int64)
    beyond = signed < 0
    if bool(beyond.any()):
        signed[beyond] = np.iinfo(np.int64).max
    return signed


def _heads(content: Content, offsets: IntArray) -> NDArray[Any]:
    # Copied as opaque bytes: numpy copies a structure field by field, ten times as slowly.
    opaque = every_byte(content, f"V{_HEAD.itemsize}")[offsets]
    return opaque.view(_HEAD)
