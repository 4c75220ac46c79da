# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The files of bags, MCAP and SQLite: channels, notes, and the messages that are wanted.

rosbag2 compresses messages one by one with compression_mode MESSAGE. Each serialized message is
then a frame of zstd that declares its size (rosbag2_compression_zstd,
ZstdCompressor::compress_serialized_bag_message). They are recognised by their first bytes, with
which no message in CDR begins: where a recorder was killed, there is no metadata.yaml.

An MCAP file without its footer, as a killed recorder leaves it, is read from its front to the
tear.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import numpy as np
from mcap.opcode import Opcode

from relay_autotune.bag.arrays import IntArray
from relay_autotune.bag.definitions import Channel, find_definition
from relay_autotune.bag.limits import (
    LARGEST_CHUNK,
    LARGEST_DEFINITION,
    MOST_DECLARATIONS,
    MOST_DECLARED,
    MOST_SOUGHT,
    MOST_STEPS_OF_SQLITE,
    STEPS_OF_SQLITE_PER_BYTE,
)
from relay_autotune.bag.mcap_layout import (
    Segment,
    layout_by_summary,
    note_damage,
    record_at,
    scan,
    segment_content,
)
from relay_autotune.bag.mcap_records import (
    NOWHERE,
    RECORD,
    Content,
    Messages,
    Sorted,
    indexed_offsets,
    listed_records,
    record_offsets,
    sorted_records,
)
from relay_autotune.bag.source import (
    SQLITE_MAGIC,
    ZSTD_MAGIC,
    DamageError,
    Source,
    open_regular,
)
from relay_autotune.errors import BagError, visible

# Size of the expanded messages that are handed on together [bytes].
_EXPANDED = 16 << 20


class BagFile(Source):
    """A file of a bag, open for reading.

    :param path: the file; it may be compressed as a whole with zstd.
    :param largest_chunk: size that a chunk, or a message, may have [bytes].
    :raises BagError: if it is missing, unreadable, empty or something else.
    """

    def __init__(self, path: Path, largest_chunk: int = LARGEST_CHUNK) -> None:
        self.channels: dict[int, Channel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.message_counts: dict[int, int] = {}
        """How many messages of each channel the file says it has, where it says so."""
        self._refused: set[int] = set()
        super().__init__(path, largest_chunk)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def read(self, channels: Collection[int]) -> Iterator[tuple[int, int, Messages]]:
        """Yield the messages of some channels, a run of them at a time.

        :param channels: their ids.
        :return: the channel; what came before the run, so that messages of different channels
            can be put into the order of the file; the messages.
        """
        raise NotImplementedError

    def _as_sent(self, channel: int, messages: Messages, of: str = "") -> Iterator[Messages]:
        """Yield messages as they were before they were compressed one by one, some at a time.

        Those that cannot be expanded are left out, with a note.

        :param of: what to say of the channel in that note.
        :raises BagError: if they expand to more than a recording does.
        """
        # The first of them tells whether they are compressed.
        if messages.payload(0, len(ZSTD_MAGIC)) != ZSTD_MAGIC:
            yield messages
            return
        # Imported here: few recordings are compressed.
        import zstandard

        decompressor = zstandard.ZstdDecompressor()
        parts: list[bytes] = []
        kept: list[int] = []
        size, refusal, largest = 0, "", self.largest
        for number, frame in enumerate(messages.payloads()):
            try:
                part = _expanded(zstandard, decompressor, frame, largest)
            except (DamageError, zstandard.ZstdError, MemoryError) as damage:
                refusal = refusal or str(damage)
                continue
            self.count_expanded(len(part))
            parts.append(part)
            kept.append(number)
            size += len(part)
            if size >= _EXPANDED:
                yield _together(messages, kept, parts)
                parts, kept, size = [], [], 0
        if kept:
            yield _together(messages, kept, parts)
        if refusal and channel not in self._refused:
            self._refused.add(channel)
            self.note(
                f"{self.path.name} has compressed messages{of} that cannot be expanded, the "
                f"first of them because {refusal}; they are left out"
            )


def _expanded(zstandard: ModuleType, decompressor: Any, frame: bytes, largest: int) -> bytes:
    if not frame.startswith(ZSTD_MAGIC):
        return frame
    # zstd allocates at once the size that the frame declares.
    size = zstandard.frame_content_size(frame)
    if size < 0:
        raise DamageError("it does not declare its size")
    if size > largest:
        raise DamageError(
            f"it declares {size} bytes, more than the {largest} that --max-chunk allows"
        )
    return bytes(decompressor.decompress(frame, max_output_size=size) if size else b"")


def _together(messages: Messages, kept: list[int], parts: list[bytes]) -> Messages:
    """Return some of the messages with what they expanded to."""
    at = np.array(kept, dtype=np.int64)
    end = np.cumsum([len(part) for part in parts])
    begin = np.append(0, end[:-1])
    times = messages.log_time[at], messages.publish_time[at]
    return Messages(b"".join(parts), messages.order[at], *times, begin, end)


# Size up to which segments are joined [bytes]: an array operation on few messages takes as long
# as one on a thousand.
_BATCH = 256 << 10


@dataclass(frozen=True)
class _Piece:
    """A segment with the places at which messages are said to begin.

    :param segment: where it lies.
    :param content: its records.
    :param listed: where its message indexes say that messages begin in the content, by channel,
        shape (n,) each; this saves time, and is checked.
    """

    segment: Segment
    content: Content
    listed: dict[int, IntArray]


def _listed_together(pieces: Sequence[_Piece], begins: IntArray) -> dict[int, IntArray]:
    """Return where the messages of each channel are said to begin in all pieces together."""
    if len(pieces) == 1:
        return pieces[0].listed
    parts: dict[int, list[IntArray]] = {}
    for piece, begin in zip(pieces, begins[:-1], strict=True):
        for channel, places in piece.listed.items():
            parts.setdefault(channel, []).append(places + begin)
    return {channel: np.concatenate(some) for channel, some in parts.items()}


class McapFile(BagFile):
    """An MCAP file open for reading; a chunk that declares more than is allowed is left out."""

    def _open(self) -> None:
        self._layout = layout = layout_by_summary(self) or scan(self)
        self.channels = layout.declared.channels
        self.metadata = layout.declared.metadata
        self.message_counts = layout.declared.message_counts or {}

    def segments(self, channels: Collection[int]) -> list[Segment]:
        """Return the segments that may hold messages of some channels, in the order of the file.

        :param channels: their ids.
        """
        wanted = frozenset(channels)
        index = self._layout.index
        if index is None:
            return self._layout.holding(wanted)
        chosen = index.holding(wanted, self._layout.declared.message_counts)
        self.announce((segment.start, segment.index_end) for segment in chosen)
        # Only the chunks that will be read are checked: on a disk each check takes time.
        if all(record_at(self, s.start, s.end) == (Opcode.CHUNK, s.end) for s in chosen):
            return chosen
        self._layout = scan(self)
        found = self._layout.declared.channels
        for channel in wanted:
            if found.get(channel) != self.channels.get(channel):
                self.note(
                    f"{self.path.name} declares {self._name(channel)} at its end otherwise than "
                    f"among its data; its end counts"
                )
        return self._layout.holding(wanted)

    def read(self, channels: Collection[int]) -> Iterator[tuple[int, int, Messages]]:
        """Yield the messages of some channels, a run of them at a time.

        Chunks without any of them are left alone. What is damaged is left out, with a note.

        :param channels: their ids.
        :return: the channel; the number of bytes that came before the run, so that messages of
            different channels can be put into the order of the file; the messages.
        """
        wanted, before = frozenset(channels), 0
        counts = dict.fromkeys(wanted, 0)
        for pieces in self._batches(wanted):
            for size, found in self._messages(pieces, wanted):
                for channel, messages in found.items():
                    counts[channel] += messages.begin.size
                    self.count_messages(counts[channel])
                    for part in self._as_sent(channel, messages, f" of {self._name(channel)}"):
                        yield channel, before, part
                before += size + RECORD.size
        self._compare(counts)

    def _compare(self, counts: dict[int, int]) -> None:
        """Note where the file has more or fewer messages of a channel than its statistics say."""
        declared = self._layout.declared.message_counts
        for contradiction in self._layout.declared.contradictions:
            self.note(f"{self.path.name} contradicts itself: {contradiction}; the first counts")
        if declared is None:
            return
        for channel, count in counts.items():
            if count != declared.get(channel, 0) and channel in self.channels:
                self.note(
                    f"{self.path.name} says that it has {declared.get(channel, 0)} messages of "
                    f"{self._name(channel)}; it has {count}"
                )

    def _batches(self, wanted: frozenset[int]) -> Iterator[list[_Piece]]:
        """Yield the segments that may hold messages of some channels, small ones together."""
        batch: list[_Piece] = []
        size = 0
        for segment in self.segments(wanted):
            try:
                content = segment_content(self, segment)
            except DamageError as damage:
                note_damage(self, segment, damage)
                continue
            if batch and size + len(content) > _BATCH:
                yield batch
                batch, size = [], 0
            indexes = self.span(segment.end, segment.index_end)
            batch.append(_Piece(segment, content, indexed_offsets(indexes)))
            size += len(content)
            if size >= _BATCH:
                # Released before the next one is read: a chunk may be large.
                yield batch
                batch, size = [], 0
        if batch:
            yield batch

    def _messages(
        self, pieces: Sequence[_Piece], wanted: frozenset[int]
    ) -> list[tuple[int, dict[int, Messages]]]:
        """Return the messages of each run of records, after the size of that."""
        content = pieces[0].content if len(pieces) == 1 else b"".join(p.content for p in pieces)
        begins = np.cumsum([0, *(len(piece.content) for piece in pieces)])
        found = None
        if all(piece.listed for piece in pieces):
            found = listed_records(
                content, _listed_together(pieces, begins), wanted, self.channels
            )
        if found is None:
            offsets, end = record_offsets(content)
            self.count_messages(offsets.size - MOST_DECLARATIONS)
            if len(pieces) > 1 and not bool(np.isin(begins, np.append(offsets, end)).all()):
                # One of them does not end with a record.
                return [found for piece in pieces for found in self._messages([piece], wanted)]
            if end != len(content) and pieces[0].segment.whole:
                damage = DamageError(f"a record of impossible length at {end}")
                note_damage(self, pieces[0].segment, damage)
            found = sorted_records(content, offsets, wanted, self.channels)
            self._check(content, found)
            for piece, begin, stop in zip(pieces, begins[:-1], begins[1:], strict=True):
                self._check_index(piece, found, wanted, int(begin), int(stop))
        return [(len(content), found.messages)]

    def _check(self, content: Content, found: Sorted) -> None:
        """Note what in some records cannot be used, or contradicts what is known."""
        name = self.path.name
        try:
            self._layout.declared.take_all(content, found.others)
        except DamageError as damage:
            self.note(f"{name} holds a declaration that makes no sense: {damage}")
        if found.unknown.size:
            at = int(found.unknown[0]) + RECORD.size
            channel = int.from_bytes(content[at : at + 2], "little")
            self.note(
                f"{name} holds messages of channels that it does not declare, such as {channel}; "
                f"they are left out"
            )
        if found.short:
            self.note(f"{name} holds messages shorter than their own head; they are left out")

    def _check_index(
        self, piece: _Piece, found: Sorted, wanted: frozenset[int], begin: int, stop: int
    ) -> None:
        """Note if the message indexes of a chunk do not list what it holds."""
        if piece.segment.index_end <= piece.segment.end:
            return
        for channel in wanted & (found.messages.keys() | piece.listed.keys()):
            own = found.messages.get(channel)
            there = NOWHERE if own is None else own.order
            there = there[np.searchsorted(there, begin) : np.searchsorted(there, stop)]
            listed = piece.listed.get(channel, NOWHERE) + begin
            if np.array_equal(there, listed) or np.array_equal(there, np.sort(listed)):
                continue
            self.note(
                f"{self.path.name} has a bad message index at byte {piece.segment.end}: of "
                f"{there.size} messages of {self._name(channel)} it lists "
                f"{np.isin(there, listed).sum()}, and {np.count_nonzero(~np.isin(listed, there))} "
                f"places without one; the chunk before it was gone through instead"
            )

    def _name(self, channel: int) -> str:
        declared = self.channels.get(channel)
        return declared.topic if declared else f"channel {channel}"


# Size of the messages that are handed on together [bytes].
_ROWS = 4 << 20
# Steps of a query between two looks at how many it has taken.
_STEPS = 10_000


# With what the journal of a change begins that was not finished.
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")


def _is_hot(journal: Path) -> bool:
    """Return whether a journal holds what a change has overwritten."""
    try:
        with open_regular(journal) as file:
            return file.read(len(_JOURNAL_MAGIC)) == _JOURNAL_MAGIC
    except BagError:
        return False


class SqliteFile(BagFile):
    """A ``.db3`` file of rosbag2 open for reading.

    It holds definitions of types since Iron; for an older one, those of the installed packages
    count. A message that is larger than allowed ends the reading.
    """

    _magic = SQLITE_MAGIC
    _steps = 0

    def _open(self) -> None:
        if self.path.with_name(self.path.name + "-wal").exists():
            self.notes.append(
                f"{self.path.name}-wal holds the end of the recording and is not read"
            )
        if _is_hot(self.path.with_name(self.path.name + "-journal")):
            self.notes.append(
                f"{self.path.name} was cut within a change of it, which its -journal would undo "
                f"and which is read as it is: messages may be missing at the end, or make no "
                f"sense; sqlite3 {self.path.name} .tables undoes it"
            )
        try:
            self._database = self._connected()
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, self.largest)
            self._database.text_factory = lambda text: text.decode("utf-8", "replace")
            # A file may define views, functions and trees of pages that never end.
            self._database.execute("PRAGMA trusted_schema = OFF")
            self._database.set_progress_handler(self._count_steps, _STEPS)
            self.channels = self._declared()
        except sqlite3.Error as error:
            raise BagError(
                f"{self.path} cannot be read as a rosbag2 file in SQLite: {error}"
            ) from None

    def close(self) -> None:
        """Close the file."""
        with suppress(AttributeError):
            self._database.close()
        super().close()

    def _count_steps(self) -> bool:
        """Return whether to end a query, which has taken more steps than the file has rows for."""
        self._steps += _STEPS
        return self._steps > MOST_STEPS_OF_SQLITE + STEPS_OF_SQLITE_PER_BYTE * self.size

    def _connected(self) -> sqlite3.Connection:
        descriptor = self._file.fileno()
        if os.fstat(descriptor).st_nlink:
            # By its descriptor: what was checked is what is read. Nothing is written to it.
            return sqlite3.connect(
                f"file:/proc/self/fd/{descriptor}?mode=ro&immutable=1", uri=True
            )
        # What was expanded has no name by which SQLite could open it.
        database = sqlite3.connect(":memory:")
        database.deserialize(self.span(0, self.size))
        return database

    def _declared(self) -> dict[int, Channel]:
        made = self._database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'")
        tables = {str(n) for n, sql in made if "VIRTUAL" not in str(sql).upper().split("(")[0]}
        if not {"topics", "messages"} <= tables:
            raise BagError(
                f"{self.path} is an SQLite file without the tables topics and messages; expected "
                "a recording of rosbag2"
            )
        for table in tables & {"topics", "messages", "message_definitions"}:
            columns = self._database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (table,))
            if any(hidden for (hidden,) in columns):
                raise BagError(
                    f"{self.path} has a table {table} with columns that are computed; expected a "
                    f"recording of rosbag2, which stores them"
                )
        definitions: dict[str, tuple[str, bytes]] = {}
        if "message_definitions" in tables:
            for kind, encoding, text in self._rows(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                if len(str(text)) <= LARGEST_DEFINITION:
                    definitions[str(kind)] = (str(encoding), str(text).encode())
        channels: dict[int, Channel] = {}
        sought = 0
        for number, *texts in self._rows(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            if not isinstance(number, int) or number in channels:
                raise BagError(
                    f"{self.path} has a topic with the id {number!r}, expected a whole number "
                    f"that no other topic has"
                )
            name, kind, encoding = (visible(str(text)) for text in texts)
            if not definitions.get(kind, ("", b""))[1]:
                definitions[kind] = ("", b"")
                sought += 1
                with suppress(BagError):
                    if sought <= MOST_SOUGHT:
                        definitions[kind] = ("ros2msg", find_definition(kind).text.encode())
            form, text = definitions[kind]
            channels[number] = Channel(number, name, kind, encoding, form, text)
        return channels

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query for what the file declares.

        :raises BagError: if there are too many.
        """
        size = 0
        # An index of the file may list other rows than its table.
        for count, row in enumerate(self._database.execute(f"{query} NOT INDEXED")):
            size += sum(len(value) for value in row if isinstance(value, str | bytes))
            if count >= MOST_DECLARATIONS or size > MOST_DECLARED:
                raise BagError(
                    f"{self.path} declares more than {MOST_DECLARATIONS} topics or types, or more "
                    f"than {MOST_DECLARED} bytes of them; expected a recording"
                )
            yield row

    def read(self, channels: Collection[int]) -> Iterator[tuple[int, int, Messages]]:
        """Yield the messages of some channels, a run of them at a time.

        They come in the order in which they were written.

        :param channels: their ids.
        :return: the channel; the number of messages that came before the run; the messages.
        """
        wanted = sorted(set(channels))
        marks = ", ".join("?" * len(wanted))
        query = (
            # An index of the file may list other rows than its table.
            "SELECT topic_id, timestamp, data FROM messages NOT INDEXED "
            f"WHERE topic_id IN ({marks})"
        )
        rows: list[tuple[int, int, bytes]] = []
        before = size = 0
        try:
            for topic, time, data in self._database.execute(query, wanted):
                if not (isinstance(time, int) and isinstance(data, bytes)):
                    raise BagError(f"{self.path} holds a message without binary data or time")
                rows.append((topic, time, data))
                size += len(data)
                if size >= _ROWS:
                    yield from self._runs(rows, before)
                    before, size, rows = before + len(rows), 0, []
        except (sqlite3.Error, MemoryError) as error:
            self.note(f"{self.path.name} cannot be read to its end ({error})")
        yield from self._runs(rows, before)

    def _runs(
        self, rows: list[tuple[int, int, bytes]], before: int
    ) -> Iterator[tuple[int, int, Messages]]:
        places: dict[int, list[int]] = {}
        for k, (topic, _, _) in enumerate(rows):
            places.setdefault(topic, []).append(k)
        end = np.cumsum([len(data) for _, _, data in rows], dtype=np.int64)
        begin = np.append(0, end[:-1])
        time: IntArray = np.array([time for _, time, _ in rows], dtype=np.int64)
        content = b"".join(data for _, _, data in rows)
        for channel, own in places.items():
            at = np.array(own, dtype=np.int64)
            messages = Messages(content, at, time[at], time[at], begin[at], end[at])
            for part in self._as_sent(channel, messages):
                yield channel, before, part
