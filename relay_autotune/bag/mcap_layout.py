# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Where the messages of an MCAP file are: its chunks, and the records outside of any.

The summary at the end of the file says it; where there is none, or a wrong one, a scan from the
front finds what makes sense. The content of a chunk is expanded within limits and checked.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from relay_autotune.bag.arrays import IntArray
from relay_autotune.bag.limits import LARGEST_SUMMARY, LARGEST_WINDOW, MOST_DECLARATIONS
from relay_autotune.bag.mcap_records import (
    FOOTER_SIZE,
    RECORD,
    Content,
    DamageError,
    Declarations,
    Opcode,
    opcodes,
    record_offsets,
    summed_up,
    text,
    unsigned,
    values_at,
)
from relay_autotune.bag.source import MAGIC, Source, expanding, file_records, record_body

# What a chunk takes beside its content, compressed or not.
_CHUNK_OVERHEAD = 1 << 20


@dataclass(frozen=True)
class Segment:
    """A run of bytes with messages: a chunk, or records outside of any chunk.

    :param start: where its first record begins in the file.
    :param end: where its last one ends, or the file if that ends before.
    :param whole: whether all of it is there.
    :param is_chunk: whether it is a chunk.
    :param channels: those of its messages, where it was gone through.
    :param index_end: where the message indexes that follow it end; 0: there are none.
    """

    start: int
    end: int
    whole: bool
    is_chunk: bool
    channels: frozenset[int] = frozenset()
    index_end: int = 0


@dataclass(frozen=True)
class ChunkIndex:
    """The chunks of a file by the index at its end, as columns: a bag may have very many.

    :param start: where each chunk begins in the file, rising, shape (n,).
    :param end: where it ends, shape (n,).
    :param index_end: where its message indexes end, shape (n,).
    :param count: number of its message indexes; 0: which messages it holds is not known;
        shape (n,).
    :param channel: channel of each message index, those of a chunk together, shape (m,).
    :param listed: number of messages that it can list, shape (m,).
    """

    start: IntArray
    end: IntArray
    index_end: IntArray
    count: IntArray
    channel: IntArray
    listed: IntArray

    def holding(self, channels: frozenset[int] | None) -> list[Segment]:
        """Return the chunks that may hold messages of some channels, in the order of the file.

        :param channels: their ids; None: all chunks.
        """
        wanted = np.isin(self.channel, list(channels or ()))
        chosen = (self.count == 0) | (channels is None)
        chosen[np.repeat(np.arange(self.start.size), self.count)[wanted]] = True
        return [
            Segment(start, end, whole=True, is_chunk=True, index_end=index_end)
            for start, end, index_end in zip(
                self.start[chosen].tolist(),
                self.end[chosen].tolist(),
                self.index_end[chosen].tolist(),
                strict=True,
            )
        ]

    def lists(self, channels: frozenset[int], counts: dict[int, int]) -> bool:
        """Return whether it lists as many messages as the statistics of the file.

        :param channels: the ids of those that are wanted.
        :param counts: number of messages of each channel, by the statistics.
        """
        listed = np.bincount(self.channel, self.listed, 1 << 16)
        return all(listed[channel] == counts.get(channel, 0) for channel in channels)


@dataclass
class Layout:
    """What a file holds, and where.

    :param declared: channels and metadata.
    :param notes: faults of the file, each a sentence.
    :param segments: in the order of the file, where it was gone through.
    :param index: the index at its end, whose places are not checked yet; None: it was gone
        through.
    """

    declared: Declarations = field(default_factory=Declarations)
    notes: list[str] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    index: ChunkIndex | None = None

    def holding(self, channels: frozenset[int]) -> list[Segment]:
        """Return the segments that hold messages of some channels, where it was gone through."""
        return [s for s in self.segments if s.channels & channels]


# Times of the first and the last message, size of the content, its checksum.
_HEAD = struct.Struct("<QQQI")


def segment_content(source: Source, segment: Segment) -> Content:
    """Return the records of a segment; of a cut chunk the part that can be read.

    :raises DamageError: if nothing of it can be used.
    :raises BagError: if the chunks of the file together expand to more than a recording does.
    """
    begin, end, largest = segment.start, segment.end, source.largest
    if not segment.is_chunk:
        return source.read(begin, end)
    if end - begin > largest + _CHUNK_OVERHEAD:
        raise DamageError(
            f"a chunk takes {end - begin} bytes, more than the {largest} that --max-chunk allows"
        )
    body = source.read(begin + RECORD.size, end)
    whole = segment.whole and len(body) == end - begin - RECORD.size
    if len(body) < _HEAD.size + 12:
        raise DamageError("the head of a chunk is cut")
    _, _, size, crc = _HEAD.unpack_from(body)
    compression, at = text(body, _HEAD.size)
    stored = unsigned(body, at, "<Q")
    data = memoryview(body)[at + 8 :]
    if size > largest:
        raise DamageError(
            f"a chunk declares {size} bytes, more than the {largest} that --max-chunk allows"
        )
    if whole and stored != len(data):
        raise DamageError("the lengths of a chunk contradict each other")
    content = _expand(data, compression, size, whole=whole)
    if whole and len(content) != size:
        raise DamageError(f"a chunk declares {size} bytes, but does not hold that many")
    if whole and crc and zlib.crc32(content) != crc:
        raise DamageError("the checksum of a chunk is wrong")
    source.count_expanded(len(content))
    return content


def is_chunk_there(source: Source, segment: Segment) -> bool:
    """Return whether a chunk begins where the index says."""
    head = source.read(segment.start, segment.start + RECORD.size)
    return head == RECORD.pack(Opcode.CHUNK, segment.end - segment.start - RECORD.size)


def damage_note(source: Source, segment: Segment, damage: DamageError) -> str:
    """Return the note on a segment that cannot be used."""
    return (
        f"{source.path.name} is damaged at byte {segment.start}: {damage}; "
        f"what lay there is left out"
    )


_PACKAGES = {"zstd": "zstandard", "lz4": "lz4.frame"}


def _expand(data: memoryview, compression: str, size: int, *, whole: bool) -> bytes | memoryview:
    """Decompress a chunk, or the part of a cut one.

    :param size: declared size; at most one byte more than that is taken.
    """
    if compression == "":
        return data
    if compression not in _PACKAGES:
        raise DamageError(f"a chunk is compressed with {compression!r}; known are zstd and lz4")
    with expanding(_PACKAGES[compression], "a chunk cannot be decompressed") as package:
        if compression == "lz4":
            found = package.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif not whole:
            decompressor = package.ZstdDecompressor(max_window_size=LARGEST_WINDOW)
            found = decompressor.stream_reader(data).read(size + 1)
        elif size == 0:
            found = b""
        # zstd allocates at once the size that the frame declares.
        elif package.frame_content_size(data) not in (-1, size):
            raise DamageError("a chunk and its compressed content differ in their size")
        else:
            found = package.ZstdDecompressor().decompress(data, max_output_size=size)
    return bytes(found)


# Size of the pieces in which records outside of chunks are read [bytes].
_PIECE = 4 << 20

# Records that declare or hold messages; others are of no use inside of a chunk.
_INSIDE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


class _Scan:
    """Goes through a file, and looks into each chunk once its message indexes have passed."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.layout = Layout()
        self.count = 0
        self.first: int | None = None
        self.last = 0
        self._chunk: Segment | None = None

    def run(self) -> Layout:
        source = self.source
        position, unfinished, torn = len(MAGIC), True, -1
        while position < source.size:
            head = source.read(position, position + RECORD.size)
            if len(head) < RECORD.size:
                break
            opcode, length = RECORD.unpack(head)
            if opcode in _INSIDE:
                self._settle()
                after = self._loose(position)
                if after == position:
                    break
                position = after
                continue
            begin = position + RECORD.size
            end = begin + length
            if opcode == 0 or end > source.size:
                torn = position if opcode == Opcode.CHUNK else -1
                break
            if opcode == Opcode.MESSAGE_INDEX:
                if self._chunk is not None:
                    self._chunk = replace(self._chunk, index_end=end)
            else:
                self._settle()
                if opcode == Opcode.CHUNK:
                    self._chunk = Segment(position, end, whole=True, is_chunk=True)
                elif opcode == Opcode.METADATA:
                    with contextlib.suppress(DamageError):
                        self.layout.declared.take(opcode, record_body(source, begin, end))
                elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    unfinished = source.read(source.size - len(MAGIC), source.size) != MAGIC
                    self._declared_again(end)
                    break
            position = end
        self._settle()
        if unfinished and torn >= 0:
            self._look_inside(Segment(torn, source.size, whole=False, is_chunk=True))
        if unfinished:
            self._tell_tear()
        return self.layout

    def _declared_again(self, position: int) -> None:
        """Take channels and statistics from the end of the file, beside those of the data."""
        with contextlib.suppress(DamageError):
            for opcode, begin, end in file_records(self.source, position, self.source.size):
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
                    self.layout.declared.take(opcode, record_body(self.source, begin, end))

    def _tell_tear(self) -> None:
        until = ""
        if self.first is not None:
            until = f" until {(self.last - self.first) / 1e9:.3f} s after the first"
        self.layout.notes.append(
            f"unfinished recording: {self.source.path.name} ends without its footer; "
            f"it holds {self.count} messages{until}"
        )

    def _settle(self) -> None:
        """Take the chunk before this place, whose message indexes have all been seen."""
        chunk, self._chunk = self._chunk, None
        if chunk is not None:
            self._look_inside(chunk)

    def _look_inside(self, segment: Segment) -> None:
        """Learn what a chunk declares, and the channels of its messages."""
        channels: frozenset[int] = frozenset()
        try:
            content = segment_content(self.source, segment)
            channels = self._declare(content)
        except DamageError as damage:
            if not segment.whole:
                return
            self.layout.notes.append(damage_note(self.source, segment, damage))
        self.layout.segments.append(replace(segment, channels=channels))

    def _declare(self, content: Content) -> frozenset[int]:
        offsets, _ = record_offsets(content)
        # Before they take several times the memory of the content.
        self.source.count_messages(self.count + offsets.size - MOST_DECLARATIONS)
        channels, times, others = summed_up(content, offsets)
        with contextlib.suppress(DamageError):
            self.layout.declared.take_all(content, others)
        if times.size:
            self.count += times.size
            first = int(times.min())
            self.first = first if self.first is None else min(self.first, first)
            self.last = max(self.last, int(times.max()))
        return frozenset(channels.tolist())

    def _loose(self, position: int) -> int:
        """Take a piece of records outside of chunks; return where the next one begins."""
        stop = min(position + _PIECE, self.source.size)
        piece = self.source.read(position, stop)
        offsets, end = record_offsets(piece)
        if len(piece) < RECORD.size:
            return position
        if end == 0:
            # A record larger than a piece, or one that is cut.
            length = unsigned(piece, 1, "<Q")
            after = position + RECORD.size + length
            if after > self.source.size:
                return position
            if length <= self.source.largest:
                piece = self.source.read(position, after)
            return self._take_loose(piece, position, after)
        outside = np.flatnonzero(~np.isin(opcodes(piece, offsets), _INSIDE))
        if outside.size:
            end = int(offsets[outside[0]])
        return self._take_loose(piece[:end], position, position + end)

    def _take_loose(self, piece: bytes, position: int, end: int) -> int:
        if len(piece) == end - position:
            channels = self._declare(piece)
            self.layout.segments.append(Segment(position, end, True, False, channels))
        return end


def scan(source: Source) -> Layout:
    """Return what a file holds by going through it, without its index."""
    source.look_again()
    return _Scan(source).run()


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
    if RECORD.unpack_from(tail) != (Opcode.FOOTER, FOOTER_SIZE):
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
    is_chunk = opcodes(summary, offsets) == Opcode.CHUNK_INDEX
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
    size = values_at(summary, "<u8", offsets + 1)
    body = offsets + RECORD.size
    # The length of the message indexes follows the list.
    if bool((size < _LIST + 8).any()):
        raise DamageError("a record is cut")
    start, length = (
        values_at(summary, "<u8", body + _START),
        values_at(summary, "<u8", body + _LENGTH),
    )
    _demand(
        start >= len(MAGIC),
        length > RECORD.size,
        length <= data_end,
        start + np.minimum(length, data_end) <= data_end,
        start <= data_end,
        otherwise="a chunk outside of the data",
    )
    listed = values_at(summary, "<u4", body + _LIST_LENGTH).astype(np.int64)
    _demand(
        listed <= size.astype(np.int64) - _LIST - 8,
        listed % _ENTRY == 0,
        otherwise="a list of message indexes of impossible length",
    )
    indexed = values_at(summary, "<u8", body + _LIST + listed)
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
    channel = values_at(summary, "<u2", at).astype(np.int64)
    place = values_at(summary, "<u8", at + 2)
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


def _demand(*conditions: NDArray[np.bool_], otherwise: str) -> None:
    if not all(bool(condition.all()) for condition in conditions):
        raise DamageError(otherwise)


def _check_between(source: Source, chunks: ChunkIndex, data_end: int, layout: Layout) -> None:
    """Check that the index lists all data, and read the metadata between the chunks."""
    begins = np.append(len(MAGIC), chunks.index_end)
    ends = np.append(chunks.start, data_end)
    for gap in np.flatnonzero(begins < ends).tolist():
        for opcode, begin, end in file_records(source, int(begins[gap]), int(ends[gap])):
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                raise DamageError("data that the index does not know")
            if opcode == Opcode.METADATA:
                layout.declared.take(opcode, record_body(source, begin, end))
