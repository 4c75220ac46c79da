"""The layout of an MCAP file by going through it from its front, as far as it makes sense."""

from __future__ import annotations

import contextlib
import struct

import numpy as np

from relay_autotune.bag.locate import (
    Content,
    every_byte,
    messages_by_channel,
    record_offsets,
)
from relay_autotune.bag.mcap_layout import Layout, Segment, damage_note, segment_content
from relay_autotune.bag.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    RECORD,
    SCHEMA,
    DamageError,
    unsigned,
)
from relay_autotune.bag.source import MAGIC, Source, file_records, record_body

# Records outside of chunks are read in pieces of this size.
_PIECE = 4 << 20

# Records that declare or hold messages; others are of no use inside of a chunk.
_INSIDE = (SCHEMA, CHANNEL, MESSAGE)


class _Scan:
    """Goes through a file, and remembers the chunk that it has just passed."""

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
                        self.layout.declared.take(opcode, record_body(source, begin, end))
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
                    self.layout.declared.take(opcode, record_body(self.source, begin, end))

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
        self._chunk.index[channel] = (position, end)
        self._chunk = Segment(
            self._chunk.start,
            self._chunk.end,
            whole=True,
            is_chunk=True,
            channels=frozenset(self._chunk.index),
            index=self._chunk.index,
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
