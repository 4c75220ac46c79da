# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Where the messages of an MCAP file are: its chunks, and the records outside of any."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from relay_autotune.arrays import IntArray
from relay_autotune.bag.chunks import chunk_content
from relay_autotune.bag.locate import Content
from relay_autotune.bag.mcap_records import CHUNK, RECORD, DamageError, Declarations
from relay_autotune.bag.source import Source

# What a chunk takes beside its content, compressed or not.
_CHUNK_OVERHEAD = 1 << 20


@dataclass(frozen=True)
class Segment:
    """A run of bytes with messages: a chunk, or records outside of any chunk.

    :param start: where its first record begins in the file.
    :param end: where its last one ends, or the file if that ends before.
    :param whole: whether all of it is there.
    :param is_chunk: whether it is a chunk.
    :param channels: those of its messages; None: not known.
    :param index_end: where the message indexes that follow it end; 0: there are none.
    """

    start: int
    end: int
    whole: bool
    is_chunk: bool
    channels: frozenset[int] | None = None
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
        return all(
            int(self.listed[self.channel == channel].sum()) == counts.get(channel, 0)
            for channel in channels
        )


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
        """Return the segments that may hold messages of some channels."""
        if self.index is not None:
            return self.index.holding(channels)
        return [s for s in self.segments if s.channels is None or s.channels & channels]


def segment_content(source: Source, segment: Segment, largest: int) -> Content:
    """Return the records of a segment.

    :param largest: size that a chunk may have [bytes].
    :raises DamageError: if nothing of it can be used.
    :raises BagError: if the chunks of the file together expand to more than a recording does.
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
    content = chunk_content(body, whole=whole, largest=largest)
    source.count_expanded(len(content))
    return content


def is_chunk_there(source: Source, segment: Segment) -> bool:
    """Return whether a chunk begins where the index says."""
    head = source.read(segment.start, segment.start + RECORD.size)
    return head == RECORD.pack(CHUNK, segment.end - segment.start - RECORD.size)


def damage_note(source: Source, segment: Segment, damage: DamageError) -> str:
    """Return the note on a segment that cannot be used."""
    return (
        f"{source.path.name} is damaged at byte {segment.start}: {damage}; "
        f"what lay there is left out"
    )
