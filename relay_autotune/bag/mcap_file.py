# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Reading an MCAP file, finished or torn: its channels, and the messages that are wanted.

A file without its footer, as a killed recorder leaves it, is read from its front to the tear.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relay_autotune.arrays import IntArray
from relay_autotune.bag.bag_file import BagFile
from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.bag.locate import (
    Content,
    Messages,
    Sorted,
    indexed_offsets,
    messages_at,
    record_offsets,
    sorted_records,
)
from relay_autotune.bag.mcap_layout import (
    Segment,
    damage_note,
    is_chunk_there,
    layout_by_summary,
    scan,
    segment_content,
)
from relay_autotune.bag.mcap_records import RECORD, DamageError

# Least distance between the beginnings of two records [bytes].
_SMALLEST_RECORD = 9

# Size up to which segments are joined [bytes]: an array operation on few messages takes as long
# as one on a thousand.
_BATCH = 256 << 10

_NOWHERE: IntArray = np.empty(0, dtype=np.int64)


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


class McapFile(BagFile):
    """An MCAP file open for reading.

    :param path: the file.
    :param largest_chunk: size that a chunk may have [bytes]; one that declares more is left out.
    :raises BagError: if it is missing, empty, too short or not MCAP.
    """

    def __init__(self, path: Path, largest_chunk: int = LARGEST_CHUNK) -> None:
        super().__init__(path, largest_chunk)
        try:
            layout = layout_by_summary(self._source) or scan(self._source, largest_chunk)
        except BaseException:
            self.close()
            raise
        self.channels = layout.declared.channels
        self.metadata = layout.declared.metadata
        self.notes += layout.notes
        self._layout = layout

    def message_count(self, channel: int) -> int:
        """Return how many messages of a channel the file says it has; 0: it does not say."""
        return (self._layout.declared.message_counts or {}).get(channel, 0)

    def segments(self, channels: Collection[int]) -> list[Segment]:
        """Return the segments that may hold messages of some channels, in the order of the file.

        :param channels: their ids.
        """
        wanted = frozenset(channels)
        index = self._layout.index
        if index is None:
            return self._layout.holding(wanted)
        counts = self._layout.declared.message_counts
        # An index that leads to fewer messages than there are, or to more, chooses no chunk.
        trusted = counts is not None and index.lists(wanted, counts)
        chosen = index.holding(wanted if trusted else None)
        self._source.announce((segment.start, segment.index_end) for segment in chosen)
        # Only the chunks that will be read are checked: on a disk each check takes time.
        if all(is_chunk_there(self._source, segment) for segment in chosen):
            return chosen
        self._layout = scan(self._source, self._largest)
        for note in self._layout.notes:
            self._note(note)
        found = self._layout.declared.channels
        for channel in wanted:
            if found.get(channel) != self.channels.get(channel):
                self._note(
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
                    for part in self._as_sent(channel, messages, f" of {self._name(channel)}"):
                        yield channel, before, part
                before += size + _SMALLEST_RECORD
        self._compare(counts)

    def _compare(self, counts: dict[int, int]) -> None:
        """Note where the file has more or fewer messages of a channel than its statistics say."""
        declared = self._layout.declared.message_counts
        for contradiction in self._layout.declared.contradictions:
            self._note(f"{self.path.name} contradicts itself: {contradiction}; the first counts")
        if declared is None:
            return
        for channel, count in counts.items():
            if count != declared.get(channel, 0) and channel in self.channels:
                self._note(
                    f"{self.path.name} says that it has {declared.get(channel, 0)} messages of "
                    f"{self._name(channel)}; it has {count}"
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
            indexes = self._source.read(segment.end, segment.index_end)
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
        listed = [
            places + begin
            for piece, begin in zip(pieces, begins[:-1], strict=True)
            for places in piece.listed.values()
        ]
        hints = np.concatenate(listed) if listed else None
        offsets, end = record_offsets(content, hints)
        if len(pieces) > 1 and not bool(np.isin(begins, np.append(offsets, end)).all()):
            # One of them does not end with a record.
            return [found for piece in pieces for found in self._messages([piece], wanted)]
        if end != len(content) and pieces[0].segment.whole:
            damage = DamageError(f"a record of impossible length at {end}")
            self._note(damage_note(self._source, pieces[0].segment, damage))
        found = sorted_records(content, offsets, wanted, self.channels)
        self._check(content, found)
        for piece, begin, stop in zip(pieces, begins[:-1], begins[1:], strict=True):
            self._check_index(piece, found, wanted, int(begin), int(stop))
        return [(len(content), {c: messages_at(content, at) for c, at in found.places.items()})]

    def _check(self, content: Content, found: Sorted) -> None:
        """Note what in some records cannot be used, or contradicts what is known."""
        name = self.path.name
        try:
            self._layout.declared.take_all(content, found.others)
        except DamageError as damage:
            self._note(f"{name} holds a declaration that makes no sense: {damage}")
        if found.unknown.size:
            at = int(found.unknown[0]) + RECORD.size
            channel = int.from_bytes(content[at : at + 2], "little")
            self._note(
                f"{name} holds messages of channels that it does not declare, such as {channel}; "
                f"they are left out"
            )
        if found.short:
            self._note(f"{name} holds messages shorter than their own head; they are left out")

    def _check_index(
        self, piece: _Piece, found: Sorted, wanted: frozenset[int], begin: int, stop: int
    ) -> None:
        """Note if the message indexes of a chunk do not list what it holds."""
        if piece.segment.index_end <= piece.segment.end:
            return
        for channel in wanted:
            there = found.places.get(channel, _NOWHERE)
            there = there[np.searchsorted(there, begin) : np.searchsorted(there, stop)]
            listed = piece.listed.get(channel, _NOWHERE) + begin
            if np.array_equal(there, listed) or np.array_equal(there, np.sort(listed)):
                continue
            self._note(
                f"{self.path.name} has a bad message index at byte {piece.segment.end}: of "
                f"{there.size} messages of {self._name(channel)} it lists "
                f"{np.isin(there, listed).sum()}, and {np.count_nonzero(~np.isin(listed, there))} "
                f"places without one; the chunk before it was gone through instead"
            )

    def _name(self, channel: int) -> str:
        declared = self.channels.get(channel)
        return declared.topic if declared else f"channel {channel}"
