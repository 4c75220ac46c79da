# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Where the messages of an MCAP file are: its chunks, and the records outside of any.

The summary at the end of the file says it; where there is none, or a wrong one, a scan from the
front finds what makes sense. The content of a chunk is expanded within limits and checked.
"""

from __future__ import annotations

import contextlib
import zlib
from dataclasses import dataclass, field, replace

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from relay_autotune.bag.arrays import IntArray
from relay_autotune.bag.limits import LARGEST_SUMMARY, LARGEST_WINDOW, MOST_DECLARATIONS
from relay_autotune.bag.mcap_records import (
    RECORD,
    Content,
    Declarations,
    opcodes,
    parsed,
    record_offsets,
    summed_up,
    values_at,
)
from relay_autotune.bag.source import MAGIC, DamageError, Source, expanding

# What a chunk takes besides its content, compressed or not.
_CHUNK_OVERHEAD = 1 << 20
# Size of the pieces in which records outside of chunks are read [bytes].
_PIECE = 1 << 20
# Size of the record of a footer [bytes].
_FOOTER_SIZE = RECORD.size + 20
# A place behind all that any file holds.
_FAR = 1 << 60


@dataclass(frozen=True)
class Segment:
    """A run of bytes with messages: a chunk, or records outside of any chunk.

    :param start: where its first record begins in the file.
    :param end: where its last one ends, or the file if that ends before.
    :param index_end: where the message indexes that follow it end; 0: there are none.
    :param whole: whether all of it is there.
    :param is_chunk: whether it is a chunk.
    :param channels: those of its messages, where it was gone through.
    """

    start: int
    end: int
    index_end: int = 0
    whole: bool = True
    is_chunk: bool = True
    channels: frozenset[int] = frozenset()


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

    def holding(self, channels: frozenset[int], counts: dict[int, int] | None) -> list[Segment]:
        """Return the chunks that may hold messages of some channels, in the order of the file.

        An index that lists fewer of them than there are, or more, chooses no chunk.

        :param channels: their ids.
        :param counts: number of messages of each channel, by the statistics; None: not known.
        """
        listed = np.bincount(self.channel, self.listed, 1 << 16)
        trusted = counts is not None and all(listed[c] == counts.get(c, 0) for c in channels)
        chosen = (self.count == 0) | (not trusted)
        wanted = np.isin(self.channel, list(channels))
        chosen[np.repeat(np.arange(self.start.size), self.count)[wanted]] = True
        columns = (column[chosen].tolist() for column in (self.start, self.end, self.index_end))
        return list(map(Segment, *columns))


@dataclass
class Layout:
    """What a file holds, and where.

    :param declared: channels and metadata.
    :param segments: in the order of the file, where it was gone through.
    :param index: the index at its end, whose places are not checked yet; None: it was gone
        through.
    """

    declared: Declarations = field(default_factory=Declarations)
    segments: list[Segment] = field(default_factory=list)
    index: ChunkIndex | None = None

    def take(self, source: Source, opcode: int, begin: int, end: int) -> None:
        """Take in a record among the data, if it is one of metadata or statistics.

        :raises DamageError: if it makes no sense, or is larger than such records are.
        """
        if opcode in (Opcode.METADATA, Opcode.STATISTICS):
            if end - begin > LARGEST_SUMMARY:
                raise DamageError(f"a record of {end - begin} bytes")
            self.declared.take(opcode, source.span(begin + RECORD.size, end))

    def holding(self, channels: frozenset[int]) -> list[Segment]:
        """Return the segments that hold messages of some channels, where it was gone through."""
        return [s for s in self.segments if s.channels & channels]


def segment_content(source: Source, segment: Segment) -> Content:
    """Return the records of a segment; of a cut chunk the part that can be read.

    :raises DamageError: if nothing of it can be used.
    :raises BagError: if the chunks of the file together expand to more than a recording does.
    """
    begin, end, largest = segment.start, segment.end, source.largest
    if end - begin > largest + _CHUNK_OVERHEAD:
        raise DamageError(
            f"a {'chunk' if segment.is_chunk else 'message'} takes {end - begin} bytes, more than "
            f"the {largest} that --max-chunk allows"
        )
    if not segment.is_chunk:
        return source.span(begin, end)
    # Without its head, by which the content of a plain chunk is aligned.
    body = source.span(begin + RECORD.size, end)
    whole = segment.whole and len(body) == end - begin - RECORD.size
    chunk = parsed("Chunk", body, whole=whole)
    size, crc = chunk.uncompressed_size, chunk.uncompressed_crc
    if size > largest:
        raise DamageError(
            f"a chunk declares {size} bytes, more than the {largest} that --max-chunk allows"
        )
    content = _expand(chunk.data, chunk.compression, size)
    if whole and len(content) != size:
        raise DamageError(f"a chunk declares {size} bytes, but does not hold as many")
    if whole and crc and zlib.crc32(content) != crc:
        raise DamageError("the checksum of a chunk is wrong")
    source.count_expanded(len(content))
    return content


def note_damage(source: Source, segment: Segment, damage: DamageError) -> None:
    """Note that a segment cannot be used."""
    source.note(
        f"{source.path.name} is damaged at byte {segment.start}: {damage}; "
        f"what lay there is left out"
    )


def _expand(data: memoryview, compression: str, size: int) -> bytes | memoryview:
    """Decompress a chunk, or the part of a cut one.

    :param size: declared size; at most one byte more than that is taken.
    """
    if compression == "":
        return data
    if compression not in ("zstd", "lz4"):
        raise DamageError(f"a chunk is compressed with {compression!r}; known are zstd and lz4")
    with expanding("a chunk cannot be decompressed") as zstandard:
        if compression == "lz4":
            import lz4.frame

            found = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        else:
            # As a stream: at once, zstd allocates the size that the frame declares.
            decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW)
            found = decompressor.stream_reader(data).read(size + 1)
    return bytes(found)


def record_at(source: Source, position: int, stop: int) -> tuple[int, int] | None:
    """Return opcode and end of the record at a place; None: none that ends up to another place."""
    head = source.span(position, min(position + RECORD.size, stop))
    if len(head) < RECORD.size:
        return None
    opcode, length = RECORD.unpack(head)
    end = position + RECORD.size + length
    return (opcode, end) if opcode and end <= stop else None


# Records that declare or hold messages; others are of no use inside of a chunk.
_INSIDE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


class _Scan:
    """Goes through a file, and looks into each chunk and into what lies outside of any."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.layout = Layout()
        self.count = 0
        self.times: list[int] = []

    def run(self) -> Layout:
        source, segments = self.source, self.layout.segments
        position, indexed, ended, piece = len(MAGIC), 0, False, _PIECE
        while record := record_at(source, position, source.size):
            opcode, end = record
            if opcode in _INSIDE:
                # One that is larger than a piece is a piece of its own.
                stop = max(end, min(position + piece, source.size))
                end = self._look_inside(Segment(position, stop, is_chunk=False))
                # Little is read in vain where each record is followed by one of no use.
                piece = min(_PIECE, 1024 + 2 * (end - position))
            elif opcode == Opcode.CHUNK:
                indexed = self._look_inside(Segment(position, end))
            elif opcode == Opcode.MESSAGE_INDEX and position == indexed:
                segments[-1] = replace(segments[-1], index_end=end)
                indexed = end
            else:
                with contextlib.suppress(DamageError):
                    self.layout.take(source, opcode, position, end)
            ended |= opcode in (Opcode.DATA_END, Opcode.FOOTER)
            position = end
        if not ended or source.span(source.size - len(MAGIC), source.size) != MAGIC:
            if source.span(position, position + 1) == bytes([Opcode.CHUNK]):
                self._look_inside(Segment(position, source.size, whole=False))
            self._tell_tear()
        return self.layout

    def _tell_tear(self) -> None:
        until = ""
        if self.times:
            seconds = (max(self.times) - min(self.times)) / 1e9
            until = f" until {seconds:.3f} s after the first"
        # It is told however many other faults there are.
        self.source.notes.append(
            f"unfinished recording: {self.source.path.name} ends without its footer; "
            f"it holds {self.count} messages{until}"
        )

    def _look_inside(self, segment: Segment) -> int:
        """Learn what a segment declares, and the channels of its messages; return its end.

        One outside of chunks ends where other records begin.
        """
        channels: frozenset[int] = frozenset()
        try:
            content = segment_content(self.source, segment)
            offsets, size = record_offsets(content)
            if not segment.is_chunk:
                outside = np.flatnonzero(~np.isin(opcodes(content, offsets), _INSIDE))
                if outside.size:
                    offsets, size = offsets[: outside[0]], int(offsets[outside[0]])
                # A file that shrinks may have none of them any more.
                segment = replace(segment, end=segment.start + size if size else segment.end)
            # Before they take several times the memory of the content.
            self.source.count_messages(self.count + offsets.size - MOST_DECLARATIONS)
            own, times, others = summed_up(content, offsets)
            channels = frozenset(own.tolist())
            with contextlib.suppress(DamageError):
                self.layout.declared.take_all(content, others)
            if times.size:
                self.count += times.size
                self.times += [int(times.min()), int(times.max())]
        except DamageError as damage:
            if segment.whole:
                note_damage(self.source, segment, damage)
        self.layout.segments.append(replace(segment, channels=channels))
        return segment.end


def scan(source: Source) -> Layout:
    """Return what a file holds by going through it, without its index."""
    source.look_again()
    return _Scan(source).run()


def layout_by_summary(source: Source) -> Layout | None:
    """Return channels and chunks as the summary has them; None if there is none to trust."""
    foot = source.size - len(MAGIC) - _FOOTER_SIZE
    tail = source.span(foot, source.size) if foot >= len(MAGIC) else b""
    head = RECORD.pack(Opcode.FOOTER, _FOOTER_SIZE - RECORD.size)
    if tail[: RECORD.size] != head or tail[_FOOTER_SIZE:] != MAGIC:
        return None
    footer = parsed("Footer", tail[RECORD.size :])
    start, crc = footer.summary_start, footer.summary_crc
    if not len(MAGIC) <= start < foot or foot - start > LARGEST_SUMMARY:
        return None
    summary = source.span(start, foot)
    # The checksum covers the summary and the footer up to the checksum itself.
    if crc and crc != zlib.crc32(tail[: _FOOTER_SIZE - 4], zlib.crc32(summary)):
        return None
    layout = Layout()
    try:
        offsets, end = record_offsets(summary)
        _demand(end == len(summary))
        layout.declared.take_all(summary, offsets)
        is_chunk = opcodes(summary, offsets) == Opcode.CHUNK_INDEX
        layout.index = chunks = _chunks(summary, offsets[is_chunk], start)
        _check_between(source, chunks, start, layout)
        # Without any, or with a type that may stand among the data, those are gone through.
        _demand(chunks.start.size > 0, bool(layout.declared.channels))
        _demand(layout.declared.have_all_types)
    except DamageError:
        return None
    return layout


def _chunks(summary: bytes, offsets: IntArray, data_end: int) -> ChunkIndex:
    """Return the chunks of an index.

    An object of the package mcap for each takes seven times as long, and a bag may have very many.

    :param summary: the records at the end of the file.
    :param offsets: where each chunk index begins in it, shape (n,).
    :param data_end: where the data end in the file.
    :raises DamageError: if one of them leads out of the data, or two overlap.
    """

    def column(form: str, places: IntArray) -> IntArray:
        # Cut to what no sum of them overflows with.
        found = values_at(summary, form, places).astype(np.uint64)
        return np.minimum(found, np.uint64(_FAR)).astype(np.int64)

    # Behind the head: times of the first and the last message, start and length of the chunk,
    # bytes of a list of channels and places of message indexes, the list, length of those.
    size, body = column("<u8", offsets + 1), offsets + RECORD.size
    _demand(size >= 44)
    order = np.argsort(column("<u8", body + 16), kind="stable")
    size, body = size[order], body[order]
    start, length = column("<u8", body + 16), column("<u8", body + 24)
    listed, entries = column("<u4", body + 32), body + 36
    _demand(listed <= size - 44, listed % 10 == 0)
    end, count = start + length, listed // 10
    index_end = end + column("<u8", entries + listed)
    _demand(start >= len(MAGIC), length > RECORD.size)
    _demand(index_end <= np.append(start[1:], data_end))
    before = np.cumsum(count) - count
    at = np.repeat(entries - 10 * before, count) + 10 * np.arange(int(count.sum()))
    channel, place = column("<u2", at), column("<u8", at + 2)
    _demand(place >= np.repeat(end, count), place < np.repeat(index_end, count))
    # A message index ends where the next one of its chunk begins.
    order = np.argsort(place, kind="stable")
    ends = np.minimum(np.append(place[order][1:], _FAR), np.repeat(index_end, count)[order])
    room = np.empty_like(place)
    room[order] = ends - place[order]
    # 15 bytes before the entries, and 16 for each.
    return ChunkIndex(start, end, index_end, count, channel, np.maximum(room - 15, 0) // 16)


def _demand(*conditions: NDArray[np.bool_] | bool) -> None:
    if not all(np.all(condition) for condition in conditions):
        raise DamageError("an index that makes no sense")


def _check_between(source: Source, chunks: ChunkIndex, data_end: int, layout: Layout) -> None:
    """Check that the index lists all data, and read the metadata between the chunks."""
    begins = np.append(len(MAGIC), chunks.index_end)
    stops = np.append(chunks.start, data_end)
    gaps = begins < stops
    for begin, stop in zip(begins[gaps].tolist(), stops[gaps].tolist(), strict=True):
        position = begin
        while record := record_at(source, position, stop):
            opcode, end = record
            _demand(opcode not in (Opcode.CHUNK, Opcode.MESSAGE))
            layout.take(source, opcode, position, end)
            position = end
        _demand(position == stop)
