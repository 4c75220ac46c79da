"""Reading an MCAP file, finished or torn: its channels, and the messages that are wanted.

A file without its footer, as a killed recorder leaves it, is read from its front to the tear.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.bag.locate import (
    Content,
    Messages,
    indexed_offsets,
    messages_at,
    messages_by_channel,
    record_offsets,
)
from relay_autotune.bag.mcap_index import (
    Segment,
    damage_note,
    is_chunk_there,
    read_layout,
    scan,
    segment_content,
)
from relay_autotune.bag.mcap_records import Channel, DamageError
from relay_autotune.bag.source import Source

# Two records cannot begin nearer to each other than this.
_SMALLEST_RECORD = 9


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
            layout = read_layout(self._source, largest_chunk)
        except BaseException:
            self.close()
            raise
        self.channels: dict[int, Channel] = layout.declared.channels
        self.metadata = layout.declared.metadata
        self.notes = [*self._source.notes, *layout.notes]
        self.segments = layout.segments
        self._unseen = layout.by_index
        self._counts = layout.declared.message_counts

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
        self._source.close()

    @property
    def size(self) -> int:
        """Size of the file, expanded if it is compressed as a whole [bytes]."""
        return self._source.size

    def message_count(self, channel: int) -> int:
        """Return how many messages of a channel the file says it has; 0: it does not say."""
        return self._counts.get(channel, 0)

    def read(self, channels: Collection[int]) -> Iterator[tuple[int, int, Messages]]:
        """Yield the messages of some channels, a run of them at a time.

        Chunks without any of them are left alone. What is damaged is left out, with a note.

        :param channels: their ids.
        :return: the channel; the number of bytes that came before the run, so that messages of
            different channels can be put into the order of the file; the messages.
        """
        wanted, before = frozenset(channels), 0
        for segment in self._with(wanted):
            try:
                content = segment_content(self._source, segment, self._largest)
                found = self._found(segment, content, wanted)
            except DamageError as damage:
                self._note(damage_note(self._source, segment, damage))
                continue
            for channel, messages in found.items():
                yield channel, before, messages
            before += len(content) + _SMALLEST_RECORD

    def _with(self, wanted: frozenset[int]) -> list[Segment]:
        """Return the segments that may hold messages of some channels."""

        def chosen() -> list[Segment]:
            return [s for s in self.segments if s.channels is None or s.channels & wanted]

        # Only the chunks that are read are looked at before: on a disk each look takes its time.
        if self._unseen and not all(is_chunk_there(self._source, s) for s in chosen()):
            layout = scan(self._source, self._largest)
            self.segments, self._unseen = layout.segments, False
            self.notes += [note for note in layout.notes if note not in self.notes]
        return chosen()

    def _found(
        self, segment: Segment, content: Content, wanted: frozenset[int]
    ) -> dict[int, Messages]:
        if segment.index:
            try:
                return self._by_index(segment, content, wanted)
            except DamageError as damage:
                self._note(
                    f"{self.path.name} has a bad message index at byte {segment.end}: {damage}; "
                    f"the chunk before it is searched instead"
                )
        offsets, end = record_offsets(content)
        if segment.whole and end != len(content):
            self._note(
                damage_note(
                    self._source, segment, DamageError(f"a record of impossible length at {end}")
                )
            )
        places, _ = messages_by_channel(content, offsets)
        return {
            channel: messages_at(content, found, channel)
            for channel, found in places.items()
            if channel in wanted
        }

    def _by_index(
        self, segment: Segment, content: Content, wanted: frozenset[int]
    ) -> dict[int, Messages]:
        records = self._source.read(segment.end, segment.index_end)
        return {
            channel: messages_at(
                content,
                indexed_offsets(records[place - segment.end :], channel, len(content)),
                channel,
            )
            for channel, place in segment.index.items()
            if channel in wanted
        }

    def _note(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)
