"""Where the messages of an MCAP file are: by the index at its end, or by going through it."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from relay_autotune.bag.chunks import chunk_content
from relay_autotune.bag.limits import LARGEST_SUMMARY
from relay_autotune.bag.locate import (
    Content,
    every_byte,
    messages_by_channel,
    record_offsets,
)
from relay_autotune.bag.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_SIZE,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    RECORD,
    SCHEMA,
    DamageError,
    Declarations,
    records,
    sized_bytes,
    unsigned,
)
from relay_autotune.bag.source import MAGIC, Source

# Records outside of chunks are read in pieces of this size.
_PIECE = 4 << 20

# What a chunk takes beside its content, compressed or not.
_CHUNK_OVERHEAD = 1 << 20

# Records that declare or hold messages; others are of no use inside of a chunk.
_INSIDE = (SCHEMA, CHANNEL, MESSAGE)


@dataclass(frozen=True)
class Segment:
    """A run of bytes with messages: a chunk, or records outside of any chunk.

    :param start: where its first record begins in the file.
    :param end: where its last one ends, or the file if that ends before.
    :param whole: whether all of it is there.
    :param is_chunk: whether it is a chunk.
    :param channels: those of its messages; None: not known.
    :param index: where the message index of each channel begins in the file.
    :param index_end: where the last of them ends.
    """

    start: int
    end: int
    whole: bool
    is_chunk: bool
    channels: frozenset[int] | None = None
    index: dict[int, int] = field(default_factory=dict)
    index_end: int = 0


@dataclass
class Layout:
    """What a file holds, and where.

    :param declared: channels and metadata.
    :param segments: in the order of the file.
    :param notes: what was found amiss, each a sentence.
    :param by_index: whether the index says so, whose places are yet to be looked at.
    """

    declared: Declarations = field(default_factory=Declarations)
    segments: list[Segment] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    by_index: bool = False


def segment_content(source: Source, segment: Segment, largest: int) -> Content:
    """Return the records of a segment.

    :param largest: size that a chunk may have [bytes].
    :raises DamageError: if nothing of it can be used.
    """
    if not segment.is_chunk:
        return source.read(segment.start, segment.end)
    if segment.end - segment.start > largest + _CHUNK_OVERHEAD:
        raise DamageError(
            f"a chunk takes {segment.end - segment.start} bytes, more than the {largest} that "
            f"--max-chunk allows"
        )
    body = source.read(segment.start + RECORD.size, segment.end)
    whole = segment.whole and len(body) == segment.end - segment.start - RECORD.size
    return chunk_content(body, whole=whole, largest=largest)


def read_layout(source: Source, largest: int) -> Layout:
    """Return what a file holds.

    :param largest: size that a chunk may have [bytes].
    """
    layout = _by_summary(source)
    return scan(source, largest) if layout is None else layout


def is_chunk_there(source: Source, segment: Segment) -> bool:
    """Return whether a chunk of the index begins where that says."""
    head = source.read(segment.start, segment.start + RECORD.size)
    return head == RECORD.pack(CHUNK, segment.end - segment.start - RECORD.size)


# --- by the index at the end


def _by_summary(source: Source) -> Layout | None:
    """Take channels and chunks from the summary; None if there is none to trust."""
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
    layout = Layout(by_index=True)
    try:
        for opcode, begin, end in records(summary):
            if opcode == CHUNK_INDEX:
                layout.segments.append(_chunk_of_index(summary[begin:end], start))
            else:
                layout.declared.take(opcode, summary[begin:end])
        layout.segments.sort(key=lambda chunk: chunk.start)
        _check_chunks(source, layout, start)
    except DamageError:
        return None
    if not layout.segments or not layout.declared.channels:
        # Messages outside of chunks, or no index of them: they must be looked for.
        return None
    return layout


def _chunk_of_index(body: bytes, data_end: int) -> Segment:
    start, length = unsigned(body, 16, "<Q"), unsigned(body, 24, "<Q")
    if not (len(MAGIC) <= start < start + length <= data_end and length > RECORD.size):
        raise DamageError("a chunk outside of the data")
    offsets, at = sized_bytes(body, 32)
    if len(offsets) % 10:
        raise DamageError("a list of message indexes of impossible length")
    index_end = start + length + unsigned(body, at, "<Q")
    if index_end > data_end:
        raise DamageError("message indexes outside of the data")
    index = dict(struct.iter_unpack("<HQ", offsets))
    if not all(start + length <= place < index_end for place in index.values()):
        raise DamageError("a message index that does not follow its chunk")
    # A file without message indexes does not say which channels its chunks hold.
    channels = frozenset(index) or None
    return Segment(start, start + length, True, True, channels, index, index_end)


def _check_chunks(source: Source, layout: Layout, data_end: int) -> None:
    """See that the index knows of all data, and read the metadata between the chunks."""
    position = len(MAGIC)
    for chunk in (*layout.segments, Segment(data_end, data_end, whole=True, is_chunk=False)):
        if chunk.start < position:
            raise DamageError("chunks that overlap")
        for opcode, begin, end in file_records(source, position, chunk.start):
            if opcode in (CHUNK, MESSAGE):
                raise DamageError("data that the index does not know")
            if opcode == METADATA:
                layout.declared.take(opcode, _bounded(source, begin, end))
        position = max(chunk.end, chunk.index_end)


def file_records(source: Source, position: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of each record of a file.

    :raises DamageError: if a record is longer than what is left.
    """
    while position < stop:
        head = source.read(position, min(position + RECORD.size, stop))
        if len(head) == RECORD.size:
            opcode, length = RECORD.unpack(head)
            begin = position + RECORD.size
            if opcode != 0 and length <= stop - begin:
                yield opcode, begin, begin + length
                position = begin + length
                continue
        raise DamageError(f"a record of impossible length at {position}")


def _bounded(source: Source, begin: int, end: int) -> bytes:
    if end - begin > LARGEST_SUMMARY:
        raise DamageError(f"a record of {end - begin} bytes")
    return source.read(begin, end)


# --- by going through it


class _Scan:
    """Goes through a file from its front, as far as it makes sense."""

    def __init__(self, source: Source, largest: int) -> None:
        self.source = source
        self.largest = largest
        self.layout = Layout()
        self.count = 0
        self.first: int | None = None
        self.last = 0
        self._chunk: Segment | None = None
        self._indexed = 0

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
                torn = position if opcode == CHUNK else -1
                break
            if opcode == MESSAGE_INDEX:
                self._index(position, begin, end)
            else:
                self._settle()
                if opcode == CHUNK:
                    self._chunk = Segment(position, end, whole=True, is_chunk=True)
                elif opcode == METADATA:
                    with contextlib.suppress(DamageError):
                        self.layout.declared.take(opcode, _bounded(source, begin, end))
                elif opcode in (DATA_END, FOOTER):
                    unfinished = source.read(source.size - len(MAGIC), source.size) != MAGIC
                    self._declared_again(end)
                    break
            position = end
        self._settle(complete=not unfinished)
        if unfinished and torn >= 0:
            self._look_inside(Segment(torn, source.size, whole=False, is_chunk=True))
        if unfinished:
            self._tell_tear()
        return self.layout

    def _declared_again(self, position: int) -> None:
        """Take channels from the end of the file, in case those among the data are damaged."""
        with contextlib.suppress(DamageError):
            for opcode, begin, end in file_records(self.source, position, self.source.size):
                if opcode in (SCHEMA, CHANNEL):
                    self.layout.declared.take(opcode, _bounded(self.source, begin, end))

    def _tell_tear(self) -> None:
        until = ""
        if self.first is not None:
            until = f" until {(self.last - self.first) / 1e9:.3f} s after the first"
        self.layout.notes.append(
            f"unfinished recording: {self.source.path.name} ends without its footer; "
            f"it holds {self.count} messages{until}"
        )

    def _index(self, position: int, begin: int, end: int) -> None:
        """Take note of a message index behind the chunk that it belongs to."""
        if self._chunk is None or end - begin < 6:
            return
        ends = self.source.read(begin, begin + 14) + self.source.read(end - 16, end - 8)
        if end - begin < 22 or len(ends) < 22:
            # A channel without messages in the chunk, or a file that shrank.
            return
        channel, _, first, last = struct.unpack("<HIQQ", ends)
        self._chunk.index[channel] = position
        self._chunk = Segment(
            self._chunk.start,
            self._chunk.end,
            whole=True,
            is_chunk=True,
            channels=frozenset(self._chunk.index),
            index=self._chunk.index,
            index_end=end,
        )
        self._seen((end - begin - 6) // 16, first, last)
        self._indexed += (end - begin - 6) // 16

    def _settle(self, *, complete: bool = True) -> None:
        """Take the chunk before this place, whose message indexes have all been seen.

        :param complete: False where the file ends, and some of them may be missing.
        """
        chunk, self._chunk = self._chunk, None
        if chunk is None:
            return
        known = self.layout.declared.channels.keys()
        if complete and chunk.channels is not None and chunk.channels <= known:
            self.layout.segments.append(chunk)
        else:
            self.count -= self._indexed
            self._look_inside(Segment(chunk.start, chunk.end, whole=True, is_chunk=True))
        self._indexed = 0

    def _look_inside(self, segment: Segment) -> None:
        """Learn what a chunk declares, and the channels of its messages."""
        channels: frozenset[int] = frozenset()
        try:
            content = segment_content(self.source, segment, self.largest)
            channels = self._declare(content)
        except DamageError as damage:
            if not segment.whole:
                return
            self.layout.notes.append(damage_note(self.source, segment, damage))
        self.layout.segments.append(
            Segment(segment.start, segment.end, segment.whole, True, channels)
        )

    def _declare(self, content: Content) -> frozenset[int]:
        offsets, _ = record_offsets(content)
        places, others = messages_by_channel(content, offsets)
        for at in others.tolist():
            opcode, length = RECORD.unpack_from(content, at)
            body = bytes(content[at + RECORD.size : at + RECORD.size + length])
            with contextlib.suppress(DamageError):
                self.layout.declared.take(opcode, body)
        for found in places.values():
            times = every_byte(content, "<u8", RECORD.size + 6)[found]
            if found.size:
                self._seen(found.size, int(times.min()), int(times.max()))
        return frozenset(places)

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
            if length <= self.largest:
                piece = self.source.read(position, after)
            return self._take_loose(piece, position, after)
        outside = np.flatnonzero(~np.isin(every_byte(piece, "u1")[offsets], _INSIDE))
        if outside.size:
            end = int(offsets[outside[0]])
        return self._take_loose(piece[:end], position, position + end)

    def _take_loose(self, piece: bytes, position: int, end: int) -> int:
        if len(piece) == end - position:
            channels = self._declare(piece)
            self.layout.segments.append(Segment(position, end, True, False, channels))
        return end

    def _seen(self, count: int, first: int, last: int) -> None:
        self.count += count
        self.first = first if self.first is None else min(self.first, first)
        self.last = max(self.last, last)


def scan(source: Source, largest: int) -> Layout:
    """Return what a file holds by going through it, without its index.

    :param largest: size that a chunk may have [bytes].
    """
    source.look_again()
    return _Scan(source, largest).run()


def damage_note(source: Source, segment: Segment, damage: DamageError) -> str:
    """Return what to say of a segment that cannot be used."""
    return (
        f"{source.path.name} is damaged at byte {segment.start}: {damage}; "
        f"what lay there is left out"
    )
