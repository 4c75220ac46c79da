"""Reading an MCAP file, finished or torn: its channels, and the messages that are wanted.

A file without its footer, as a killed recorder leaves it, is read from its front to the tear.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from relay_autotune.bag.compressed_messages import Expander, are_compressed
from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.bag.locate import (
    Content,
    Messages,
    indexed_offsets,
    messages_at,
    messages_by_channel,
    record_offsets,
)
from relay_autotune.bag.mcap_layout import Segment, damage_note, is_chunk_there, segment_content
from relay_autotune.bag.mcap_records import Channel, DamageError
from relay_autotune.bag.mcap_scan import scan
from relay_autotune.bag.mcap_summary import layout_by_summary
from relay_autotune.bag.source import Source
from relay_autotune.record.record import IntArray

# Two records cannot begin nearer to each other than this.
_SMALLEST_RECORD = 9

# Segments are put together up to this size: an array operation on few messages takes as long as
# one on a thousand.
_BATCH = 256 << 10


@dataclass(frozen=True)
class _Piece:
    """A segment with the places at which messages are said to begin.

    :param segment: where it lies.
    :param content: its records.
    :param wanted: the channels that are wanted.
    :param places: where their messages begin in the content, by channel, shape (n,) each.
    :param by_index: whether the file says so; else they were found there.
    """

    segment: Segment
    content: Content
    wanted: frozenset[int]
    places: dict[int, IntArray]
    by_index: bool


class McapFile:
    """An MCAP file open for reading.

    :param path: the file.
    :param largest_chunk: size that a chunk may have [bytes]; one that declares more is left out.
    :raises BagError: if it is missing, empty, too short or not MCAP.
    """

    def __init__(self, path: Path, largest_chunk: int = LARGEST_CHUNK) -> None:
        self.path = path
        self._largest = largest_chunk
        self._source = Source(path)
        try:
            layout = layout_by_summary(self._source) or scan(self._source, largest_chunk)
        except BaseException:
            self.close()
            raise
        self.channels: dict[int, Channel] = layout.declared.channels
        self.metadata = layout.declared.metadata
        self.notes = [*self._source.notes, *layout.notes]
        self._layout = layout
        self._refused: set[int] = set()
        self._counts = layout.declared.message_counts

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        self._source.close()

    @property
    def size(self) -> int:
        """Size of the file, expanded if it is compressed as a whole [bytes]."""
        return self._source.size

    def message_count(self, channel: int) -> int:
        """Return how many messages of a channel the file says it has; 0: it does not say."""
        return self._counts.get(channel, 0)

    def segments(self, channels: Collection[int]) -> list[Segment]:
        """Return the segments that may hold messages of some channels, in the order of the file.

        :param channels: their ids.
        """
        wanted = frozenset(channels)
        chosen = self._layout.holding(wanted)
        if self._layout.index is None:
            return chosen
        self._source.announce((segment.start, segment.index_end) for segment in chosen)
        # Only the chunks that are read are looked at before: on a disk each look takes its time.
        if all(is_chunk_there(self._source, segment) for segment in chosen):
            return chosen
        self._layout = scan(self._source, self._largest)
        for note in self._layout.notes:
            self._note(note)
        return self._layout.holding(wanted)

    def read(self, channels: Collection[int]) -> Iterator[tuple[int, int, Messages]]:
        """Yield the messages of some channels, a run of them at a time.

        Chunks without any of them are left alone. What is damaged is left out, with a note.

        :param channels: their ids.
        :return: the channel; the number of bytes that came before the run, so that messages of
            different channels can be put into the order of the file; the messages.
        """
        before = 0
        for pieces in self._batches(frozenset(channels)):
            for size, found in self._messages(pieces):
                for channel, messages in found.items():
                    for part in self._expanded(channel, messages):
                        yield channel, before, part
                before += size + _SMALLEST_RECORD

    def _expanded(self, channel: int, messages: Messages) -> Iterator[Messages]:
        """Yield messages as they were before rosbag2 compressed them, if it did."""
        if not are_compressed(messages):
            yield messages
            return
        expander = Expander(self._largest)
        yield from expander.expand(messages)
        if expander.first_refusal and channel not in self._refused:
            self._refused.add(channel)
            declared = self.channels.get(channel)
            self._note(
                f"{self.path.name} has compressed messages of "
                f"{declared.topic if declared else channel} that cannot be expanded, the first "
                f"of them because {expander.first_refusal}; they are left out"
            )

    def _batches(self, wanted: frozenset[int]) -> Iterator[list[_Piece]]:
        """Yield the segments that may hold messages of some channels, small ones together."""
        batch: list[_Piece] = []
        size = 0
        for segment in self.segments(wanted):
            try:
                content = segment_content(self._source, segment, self._largest)
            except DamageError as damage:
                self._note(damage_note(self._source, segment, damage))
                continue
            if batch and size + len(content) > _BATCH:
                yield batch
                batch, size = [], 0
            batch.append(self._piece(segment, content, wanted))
            size += len(content)
            if size >= _BATCH:
                # Not held while the next one is read: a chunk may be large.
                yield batch
                batch, size = [], 0
        if batch:
            yield batch

    def _piece(self, segment: Segment, content: Content, wanted: frozenset[int]) -> _Piece:
        if segment.index:
            try:
                places = self._by_index(segment, len(content), wanted)
                return _Piece(segment, content, wanted, places, by_index=True)
            except DamageError as damage:
                self._note_bad_index(segment, damage)
        return self._searched(segment, content, wanted)

    def _by_index(
        self, segment: Segment, size: int, wanted: frozenset[int]
    ) -> dict[int, IntArray]:
        """Return where messages begin, by the message indexes behind their chunk."""
        return {
            channel: indexed_offsets(self._source.read(begin, end), channel, size)
            for channel, (begin, end) in segment.index.items()
            if channel in wanted
        }

    def _searched(self, segment: Segment, content: Content, wanted: frozenset[int]) -> _Piece:
        """Find messages by going through the records."""
        offsets, end = record_offsets(content)
        if segment.whole and end != len(content):
            damage = DamageError(f"a record of impossible length at {end}")
            self._note(damage_note(self._source, segment, damage))
        places, _ = messages_by_channel(content, offsets)
        places = {channel: places[channel] for channel in places.keys() & wanted}
        return _Piece(segment, content, wanted, places, by_index=False)

    def _messages(self, pieces: Sequence[_Piece]) -> list[tuple[int, dict[int, Messages]]]:
        """Return the messages of each run of records, after the size of that."""
        if len(pieces) > 1:
            # Where an index leads astray, below is found out which one.
            with contextlib.suppress(DamageError):
                return [_joined(pieces)]
        return [self._alone(piece) for piece in pieces]

    def _alone(self, piece: _Piece) -> tuple[int, dict[int, Messages]]:
        try:
            return _joined([piece])
        except DamageError as damage:
            if not piece.by_index:
                raise
            self._note_bad_index(piece.segment, damage)
        return _joined([self._searched(piece.segment, piece.content, piece.wanted)])

    def _note_bad_index(self, segment: Segment, damage: DamageError) -> None:
        self._note(
            f"{self.path.name} has a bad message index at byte {segment.end}: {damage}; "
            f"the chunk before it is searched instead"
        )

    def _note(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)


def _joined(pieces: Sequence[_Piece]) -> tuple[int, dict[int, Messages]]:
    """Return the messages of segments as one run of records, after the size of that.

    :raises DamageError: if a place holds something else than a message of its channel.
    """
    if len(pieces) == 1:
        content, places = pieces[0].content, pieces[0].places
        found = {channel: messages_at(content, at, channel) for channel, at in places.items()}
        return len(content), found
    joined = b"".join(piece.content for piece in pieces)
    listed: dict[int, list[IntArray]] = {}
    limits: dict[int, list[IntArray]] = {}
    begin = 0
    for piece in pieces:
        end = begin + len(piece.content)
        for channel, at in piece.places.items():
            listed.setdefault(channel, []).append(at + begin)
            limits.setdefault(channel, []).append(np.full(at.size, end))
        begin = end
    found = {
        channel: messages_at(joined, np.concatenate(at), channel, np.concatenate(limits[channel]))
        for channel, at in listed.items()
    }
    return len(joined), found
