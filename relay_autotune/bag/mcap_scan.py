# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The layout of an MCAP file, by going through it from its front as far as it makes sense."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np

from relay_autotune.arrays import IntArray
from relay_autotune.bag.locate import (
    Content,
    every_byte,
    indexed_offsets,
    nanoseconds,
    record_offsets,
    sorted_records,
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
    STATISTICS,
    DamageError,
    unsigned,
)
from relay_autotune.bag.source import MAGIC, Source, file_records, record_body

# Size of the pieces in which records outside of chunks are read [bytes].
_PIECE = 4 << 20

# Records that declare or hold messages; others are of no use inside of a chunk.
_INSIDE = (SCHEMA, CHANNEL, MESSAGE)


class _Scan:
    """Goes through a file, and looks into each chunk once its message indexes have passed."""

    def __init__(self, source: Source, largest: int) -> None:
        self.source = source
        self.largest = largest
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
                torn = position if opcode == CHUNK else -1
                break
            if opcode == MESSAGE_INDEX:
                if self._chunk is not None:
                    self._chunk = replace(self._chunk, index_end=end)
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
                if opcode in (SCHEMA, CHANNEL, STATISTICS):
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
            content = segment_content(self.source, segment, self.largest)
            listed = indexed_offsets(self.source.read(segment.end, segment.index_end))
            places = np.concatenate([*listed.values()]) if listed else None
            channels = self._declare(content, record_offsets(content, places)[0])
        except DamageError as damage:
            if not segment.whole:
                return
            self.layout.notes.append(damage_note(self.source, segment, damage))
        self.layout.segments.append(replace(segment, channels=channels))

    def _declare(self, content: Content, offsets: IntArray) -> frozenset[int]:
        found = sorted_records(content, offsets, None, ())
        with contextlib.suppress(DamageError):
            self.layout.declared.take_all(content, found.others)
        for places in found.places.values():
            times = nanoseconds(every_byte(content, "<u8", RECORD.size + 6)[places])
            self.count += places.size
            first = int(times.min())
            self.first = first if self.first is None else min(self.first, first)
            self.last = max(self.last, int(times.max()))
        return frozenset(found.places)

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
            channels = self._declare(piece, record_offsets(piece)[0])
            self.layout.segments.append(Segment(position, end, True, False, channels))
        return end


def scan(source: Source, largest: int) -> Layout:
    """Return what a file holds by going through it, without its index.

    :param largest: size that a chunk may have [bytes].
    """
    source.look_again()
    return _Scan(source, largest).run()
