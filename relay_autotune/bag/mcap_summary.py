# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The layout of an MCAP file by the summary at its end, parsed by array operations."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import IntArray
from relay_autotune.bag.limits import LARGEST_SUMMARY
from relay_autotune.bag.locate import every_byte, record_offsets
from relay_autotune.bag.mcap_layout import ChunkIndex, Layout
from relay_autotune.bag.mcap_records import (
    CHUNK,
    CHUNK_INDEX,
    FOOTER,
    FOOTER_SIZE,
    MESSAGE,
    METADATA,
    RECORD,
    DamageError,
)
from relay_autotune.bag.source import MAGIC, Source, file_records, record_body

# A chunk index up to its list of message indexes: times of the first and the last message, start
# and length of the chunk, and the list's length.
_LIST = 36
_START, _LENGTH, _LIST_LENGTH = 16, 24, 32
# One entry of the list: a channel, and the place of its message index.
_ENTRY = 10
# Sizes in a message index [bytes]: channel and length of the list; each place.
_PLACES, _PLACE = 6, 16


def layout_by_summary(source: Source) -> Layout | None:
    """Return channels and chunks as the summary has them; None if there is none to trust."""
    foot = source.size - len(MAGIC) - FOOTER_SIZE - RECORD.size
    if foot < len(MAGIC):
        return None
    tail = source.read(foot, source.size)
    if len(tail) != source.size - foot or tail[-len(MAGIC) :] != MAGIC:
        return None
    if RECORD.unpack_from(tail) != (FOOTER, FOOTER_SIZE):
        return None
    start, _, crc = struct.unpack_from("<QQI", tail, RECORD.size)
    if not len(MAGIC) <= start < foot or foot - start > LARGEST_SUMMARY:
        return None
    summary = source.read(start, foot)
    # The checksum covers the summary and the footer up to the checksum itself.
    if crc and crc != zlib.crc32(tail[: RECORD.size + 16], zlib.crc32(summary)):
        return None
    layout = Layout()
    try:
        chunks = _take(summary, start, layout)
        _check_between(source, chunks, start, layout)
    except DamageError:
        return None
    if not chunks.start.size or not layout.declared.channels:
        # Messages outside of chunks, or no index of them: they must be looked for.
        return None
    if not layout.declared.have_all_types:
        # A type that is missing here may stand among the data.
        return None
    layout.index = chunks
    return layout


def _take(summary: bytes, data_end: int, layout: Layout) -> ChunkIndex:
    """Take in what a summary declares, and return its chunks."""
    offsets, end = record_offsets(summary)
    if end != len(summary):
        raise DamageError(f"a record of impossible length at {end}")
    is_chunk = every_byte(summary, "u1")[offsets] == CHUNK_INDEX
    for at in offsets[~is_chunk].tolist():
        opcode, length = RECORD.unpack_from(summary, at)
        begin = at + RECORD.size
        layout.declared.take(opcode, summary[begin : begin + length])
    return _chunks(summary, offsets[is_chunk], data_end)


def _chunks(summary: bytes, offsets: IntArray, data_end: int) -> ChunkIndex:
    """Return the chunks of an index.

    :param summary: the records at the end of the file.
    :param offsets: where each chunk index begins in it, shape (n,).
    :param data_end: where the data end in the file.
    :raises DamageError: if one of them leads out of the data, or two overlap.
    """
    size = _u64(summary, offsets + 1)
    body = offsets + RECORD.size
    # The length of the message indexes follows the list.
    if bool((size < _LIST + 8).any()):
        raise DamageError("a record is cut")
    start, length = _u64(summary, body + _START), _u64(summary, body + _LENGTH)
    _demand(
        start >= len(MAGIC),
        length > RECORD.size,
        length <= data_end,
        start + np.minimum(length, data_end) <= data_end,
        start <= data_end,
        otherwise="a chunk outside of the data",
    )
    listed = every_byte(summary, "<u4")[body + _LIST_LENGTH].astype(np.int64)
    _demand(
        listed <= size.astype(np.int64) - _LIST - 8,
        listed % _ENTRY == 0,
        otherwise="a list of message indexes of impossible length",
    )
    indexed = _u64(summary, body + _LIST + listed)
    end = (start + length).astype(np.int64)
    _demand(
        indexed <= (data_end - end).astype(np.uint64),
        otherwise="message indexes outside of the data",
    )
    index_end = end + indexed.astype(np.int64)
    order = np.argsort(start, kind="stable")
    body, listed, index_end, end = body[order], listed[order], index_end[order], end[order]
    channel, room = _entries(summary, body + _LIST, listed // _ENTRY, end, index_end)
    begin = start[order].astype(np.int64)
    _demand(begin[1:] >= index_end[:-1], otherwise="chunks that overlap")
    return ChunkIndex(begin, end, index_end, listed // _ENTRY, channel, room // _PLACE)


def _entries(
    summary: bytes, lists: IntArray, count: IntArray, end: IntArray, index_end: IntArray
) -> tuple[IntArray, IntArray]:
    """Return channel and room for entries [bytes] of the message indexes of all chunks.

    :param summary: the records at the end of the file.
    :param lists: where the list of each chunk begins in it, shape (n,).
    :param count: number of its entries, shape (n,).
    :param end: where each chunk ends in the file, shape (n,).
    :param index_end: where its message indexes end, shape (n,).
    :raises DamageError: if one does not lie behind its chunk.
    """
    before = np.cumsum(count) - count
    at = np.repeat(lists - _ENTRY * before, count) + _ENTRY * np.arange(int(count.sum()))
    channel = every_byte(summary, "<u2")[at].astype(np.int64)
    place = _u64(summary, at + 2)
    _demand(
        place >= np.repeat(end, count).astype(np.uint64),
        place < np.repeat(index_end, count).astype(np.uint64),
        otherwise="a message index that does not follow its chunk",
    )
    # A message index ends where the next one of its chunk begins.
    begin, room = place.astype(np.int64), np.empty(place.size, dtype=np.int64)
    order = np.argsort(begin, kind="stable")
    ends = np.append(begin[order][1:], np.iinfo(np.int64).max)
    room[order] = np.minimum(ends, np.repeat(index_end, count)[order]) - begin[order]
    return channel, np.maximum(room - RECORD.size - _PLACES, 0)


def _u64(summary: bytes, at: IntArray) -> NDArray[np.uint64]:
    found: NDArray[np.uint64] = every_byte(summary, "<u8")[at]
    return found


def _demand(*conditions: NDArray[np.bool_], otherwise: str) -> None:
    if not all(bool(condition.all()) for condition in conditions):
        raise DamageError(otherwise)


def _check_between(source: Source, chunks: ChunkIndex, data_end: int, layout: Layout) -> None:
    """Check that the index lists all data, and read the metadata between the chunks."""
    begins = np.append(len(MAGIC), chunks.index_end)
    ends = np.append(chunks.start, data_end)
    for gap in np.flatnonzero(begins < ends).tolist():
        for opcode, begin, end in file_records(source, int(begins[gap]), int(ends[gap])):
            if opcode in (CHUNK, MESSAGE):
                raise DamageError("data that the index does not know")
            if opcode == METADATA:
                layout.declared.take(opcode, record_body(source, begin, end))
