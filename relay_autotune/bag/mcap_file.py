"""Reading an MCAP file, finished or torn: its channels, and the messages that are wanted.

A file without its footer, as a killed recorder leaves it, is read from its front to the tear.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from relay_autotune.bag.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_SIZE,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    RECORD,
    SCHEMA,
    DamageError,
    chunk_content,
    map_file,
    map_of_text,
    message_head,
    next_record,
    records,
    sized_bytes,
    text,
    unsigned,
)
from relay_autotune.record import IntArray


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


@dataclass
class Messages:
    """The messages of one channel in the order of the file.

    :param order: position among all messages that were read, shape (n,).
    :param log_time: when each was recorded [ns], shape (n,).
    :param publish_time: when each was sent [ns]; 0: unknown; shape (n,).
    :param payload: the serialized messages.
    """

    order: IntArray
    log_time: IntArray
    publish_time: IntArray
    payload: list[bytes]

    def __len__(self) -> int:
        return len(self.payload)


@dataclass
class _Columns:
    order: list[int] = field(default_factory=list)
    log_time: list[int] = field(default_factory=list)
    publish_time: list[int] = field(default_factory=list)
    payload: list[bytes] = field(default_factory=list)


@dataclass(frozen=True)
class _Segment:
    """A run of bytes with messages: a chunk, or records outside of any chunk.

    :param channels: those of its messages; None: not known.
    """

    start: int
    end: int
    is_chunk: bool
    channels: frozenset[int] | None = None


class McapFile:
    """An MCAP file open for reading.

    :param path: the file.
    :raises BagError: if it is missing, empty, too short or not MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.notes: list[str] = []
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._segments: list[_Segment] = []
        self._data = map_file(path)
        try:
            if not self._read_summary():
                self._scan()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        self._data.close()

    def read(self, channels: Collection[int]) -> dict[int, Messages]:
        """Return the messages of some channels; chunks without any of them are left alone.

        :param channels: their ids.
        """
        columns = {channel: _Columns() for channel in channels}
        order = 0
        for segment in self._segments:
            if segment.channels is not None and segment.channels.isdisjoint(columns):
                continue
            try:
                content, whole = self._content(segment)
                for opcode, begin, end in records(content, strict=whole):
                    if opcode != MESSAGE:
                        continue
                    channel, _, log_time, publish_time = message_head(content, begin, end)
                    into = columns.get(channel)
                    if into is not None:
                        into.order.append(order)
                        into.log_time.append(log_time)
                        into.publish_time.append(publish_time)
                        into.payload.append(content[begin + MESSAGE_HEAD.size : end])
                        order += 1
            except DamageError as damage:
                self._note_damage(segment, damage)
        return {
            channel: Messages(
                np.array(c.order, dtype=np.int64),
                _nanoseconds(c.log_time),
                _nanoseconds(c.publish_time),
                c.payload,
            )
            for channel, c in columns.items()
        }

    def _content(self, segment: _Segment) -> tuple[bytes, bool]:
        if segment.is_chunk:
            return chunk_content(self._data, segment.start, segment.end)
        return self._data[segment.start : segment.end], True

    def _note_damage(self, segment: _Segment, damage: DamageError) -> None:
        note = (
            f"{self.path.name} is damaged at byte {segment.start}: {damage}; "
            f"what lay there is left out"
        )
        if note not in self.notes:
            self.notes.append(note)

    def _read_summary(self) -> bool:
        """Take channels and chunks from the summary; False if there is none to trust."""
        data = self._data
        foot = len(data) - len(MAGIC) - FOOTER_SIZE - RECORD.size
        if foot < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
            return False
        if RECORD.unpack_from(data, foot) != (FOOTER, FOOTER_SIZE):
            return False
        start, _, crc = struct.unpack_from("<QQI", data, foot + RECORD.size)
        if not len(MAGIC) <= start < foot:
            return False
        # The checksum covers the summary and the footer up to the checksum itself.
        if crc and crc != zlib.crc32(data[start : foot + RECORD.size + 16]):
            return False
        chunks: list[_Segment] = []
        try:
            summary = data[start:foot]
            for opcode, begin, end in records(summary):
                if opcode == CHUNK_INDEX:
                    chunks.append(_chunk_of_index(summary[begin:end], start))
                else:
                    self._declare(opcode, summary[begin:end])
            chunks.sort(key=lambda chunk: chunk.start)
            self._check_chunks(chunks, start)
        except DamageError:
            chunks = []
        if not chunks or not self.channels:
            # Messages outside of chunks, or no index of them: they must be looked for.
            self.channels.clear()
            self._schemas.clear()
            self.metadata.clear()
            return False
        self._segments = chunks
        return True

    def _check_chunks(self, chunks: list[_Segment], data_end: int) -> None:
        """See that the index knows of all data, and read the metadata between the chunks."""
        position = len(MAGIC)
        for chunk in (*chunks, _Segment(data_end, data_end, is_chunk=False)):
            for opcode, begin, end in records(self._data, position, chunk.start):
                if opcode in (CHUNK, MESSAGE):
                    raise DamageError("data that the index does not know")
                if opcode == METADATA:
                    self._declare(opcode, self._data[begin:end])
            if chunk.is_chunk:
                length = chunk.end - chunk.start - RECORD.size
                if RECORD.unpack_from(self._data, chunk.start) != (CHUNK, length):
                    raise DamageError("the index does not lead to a chunk")
            position = chunk.end

    def _scan(self) -> None:
        """Go through the file from its front, as far as it makes sense."""
        data = self._data
        loose: int | None = None
        position = len(MAGIC)
        unfinished = True
        while (record := next_record(data, position, len(data))) is not None:
            opcode, begin, end = record
            if opcode in (SCHEMA, CHANNEL, MESSAGE):
                loose = position if loose is None else loose
            else:
                if loose is not None:
                    self._segments.append(_Segment(loose, position, is_chunk=False))
                    loose = None
                if opcode == CHUNK:
                    self._segments.append(_Segment(position, end, is_chunk=True))
                elif opcode == METADATA:
                    with contextlib.suppress(DamageError):
                        self._declare(opcode, data[begin:end])
                elif opcode in (DATA_END, FOOTER):
                    unfinished = data[-len(MAGIC) :] != MAGIC
                    break
            position = end
        if loose is not None:
            self._segments.append(_Segment(loose, position, is_chunk=False))
        if unfinished and position < len(data) and data[position] == CHUNK:
            torn = _Segment(position, len(data), is_chunk=True)
            with contextlib.suppress(DamageError):
                self._content(torn)
                self._segments.append(torn)
        count, first, last = self._look_inside()
        if unfinished:
            until = f" until {(last - first) / 1e9:.3f} s after the first" if count else ""
            self.notes.append(
                f"unfinished recording: {self.path.name} ends without its footer; "
                f"it holds {count} messages{until}"
            )

    def _look_inside(self) -> tuple[int, int, int]:
        """Learn the channels of each segment; return count and span [ns] of all messages."""
        count, first, last = 0, 0, 0
        for i, segment in enumerate(self._segments):
            seen: set[int] = set()
            try:
                content, whole = self._content(segment)
                for opcode, begin, end in records(content, strict=whole):
                    if opcode == MESSAGE:
                        channel, _, log_time, _ = message_head(content, begin, end)
                        seen.add(channel)
                        first = min(first, log_time) if count else log_time
                        last = max(last, log_time)
                        count += 1
                    else:
                        self._declare(opcode, content[begin:end])
            except DamageError as damage:
                self._note_damage(segment, damage)
            self._segments[i] = replace(segment, channels=frozenset(seen))
        return count, first, last

    def _declare(self, opcode: int, body: bytes) -> None:
        """Take in a schema, channel or metadata record."""
        if opcode == SCHEMA:
            number = unsigned(body, 0, "<H")
            name, at = text(body, 2, len(body))
            encoding, at = text(body, at, len(body))
            definition, _ = sized_bytes(body, at, len(body))
            self._schemas[number] = (name, encoding, definition)
        elif opcode == CHANNEL:
            number, schema = unsigned(body, 0, "<H"), unsigned(body, 2, "<H")
            topic, at = text(body, 4, len(body))
            encoding, at = text(body, at, len(body))
            metadata, _ = map_of_text(body, at)
            self.channels[number] = Channel(
                number, topic, *self._type(schema, encoding), metadata=metadata
            )
        elif opcode == METADATA:
            name, at = text(body, 0, len(body))
            self.metadata.append((name, map_of_text(body, at)[0]))

    def _type(self, schema: int, encoding: str) -> tuple[str, str, str, bytes]:
        name, schema_encoding, definition = self._schemas.get(schema, ("", "", b""))
        return name, encoding, schema_encoding, definition


def _nanoseconds(values: list[int]) -> IntArray:
    # Times are unsigned in the file; one beyond the signed range is no time of any clock.
    return np.minimum(np.array(values, dtype=np.uint64), np.uint64(2**63 - 1)).astype(np.int64)


def _chunk_of_index(body: bytes, data_end: int) -> _Segment:
    start, length = unsigned(body, 16, "<Q"), unsigned(body, 24, "<Q")
    if not (len(MAGIC) <= start < start + length <= data_end and length > RECORD.size):
        raise DamageError("a chunk outside of the data")
    offsets, _ = sized_bytes(body, 32, len(body))
    if len(offsets) % 10:
        raise DamageError("a message index of impossible length")
    channels = frozenset(entry[0] for entry in struct.iter_unpack("<HQ", offsets))
    # A file without message indexes does not say which channels its chunks hold.
    return _Segment(start, start + length, is_chunk=True, channels=channels or None)
