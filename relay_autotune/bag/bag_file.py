# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the files of bags have in common: channels, notes, and messages as they were sent.

rosbag2 compresses messages one by one with compression_mode MESSAGE. Each serialized message is
then a frame of zstd that declares its size (rosbag2_compression_zstd,
ZstdCompressor::compress_serialized_bag_message). They are recognised by their first bytes, with
which no message in CDR begins: where a recorder was killed, there is no metadata.yaml.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import numpy as np

from relay_autotune.bag.limits import MOST_NOTES
from relay_autotune.bag.locate import Content, Messages
from relay_autotune.bag.mcap_records import Channel, DamageError
from relay_autotune.bag.source import MAGIC, ZSTD_MAGIC, Source, expanding_package

# Size of the expanded messages that are handed on together [bytes].
_EXPANDED = 16 << 20


class BagFile:
    """A file of a bag, open for reading.

    :param path: the file; it may be compressed as a whole with zstd.
    :param largest: size that a message may have [bytes].
    :param magic: the bytes with which it has to begin.
    :raises BagError: if it is missing, unreadable or something else.
    """

    def __init__(self, path: Path, largest: int, magic: bytes = MAGIC) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self._largest = largest
        self._source = Source(path, magic)
        self.notes = [*self._source.notes]
        self._refused: set[int] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    @property
    def size(self) -> int:
        """Size of the file, expanded if it is compressed as a whole [bytes]."""
        return self._source.size

    def message_count(self, _channel: int) -> int:
        """Return how many messages of a channel the file says it has; 0: it does not say."""
        return 0

    def read(self, channels: Collection[int]) -> Iterator[tuple[int, int, Messages]]:
        """Yield the messages of some channels, a run of them at a time.

        :param channels: their ids.
        :return: the channel; what came before the run, so that messages of different channels
            can be put into the order of the file; the messages.
        """
        raise NotImplementedError

    def _note(self, note: str) -> None:
        if note in self.notes or len(self.notes) > MOST_NOTES:
            return
        if len(self.notes) == MOST_NOTES:
            note = f"{self.path.name} has more faults, which are not listed"
        self.notes.append(note)

    def _as_sent(self, channel: int, messages: Messages, of: str = "") -> Iterator[Messages]:
        """Yield messages as they were before they were compressed one by one, some at a time.

        Those that cannot be expanded are left out, with a note.

        :param of: what to say of the channel in that note.
        :raises BagError: if they expand to more than a recording does.
        """
        if not _are_compressed(messages):
            yield messages
            return
        zstandard = expanding_package("zstandard")
        decompressor, view = zstandard.ZstdDecompressor(), memoryview(messages.content)
        parts: list[bytes] = []
        kept: list[int] = []
        size, refusal = 0, ""
        for number, (begin, end) in enumerate(
            zip(messages.begin.tolist(), messages.end.tolist(), strict=True)
        ):
            try:
                part = _expanded(zstandard, decompressor, view[begin:end], self._largest)
            except DamageError as damage:
                refusal = refusal or str(damage)
                continue
            self._source.count_expanded(len(part))
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
            self._note(
                f"{self.path.name} has compressed messages{of} that cannot be expanded, the "
                f"first of them because {refusal}; they are left out"
            )


def _are_compressed(messages: Messages) -> bool:
    """Tell by the first of some messages whether they are compressed one by one."""
    if messages.begin.size == 0:
        return False
    begin, end = int(messages.begin[0]), int(messages.end[0])
    return bytes(messages.content[begin : min(end, begin + len(ZSTD_MAGIC))]) == ZSTD_MAGIC


def _expanded(zstandard: ModuleType, decompressor: Any, frame: Content, largest: int) -> bytes:
    if frame[: len(ZSTD_MAGIC)] != ZSTD_MAGIC:
        return bytes(frame)
    try:
        # zstd allocates at once the size that the frame declares.
        size = zstandard.frame_content_size(frame)
        if size < 0:
            raise DamageError("it does not declare its size")
        if size > largest:
            raise DamageError(
                f"it declares {size} bytes, more than the {largest} that --max-chunk allows"
            )
        return bytes(decompressor.decompress(frame, max_output_size=size) if size else b"")
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamageError(str(error)) from None


def _together(messages: Messages, kept: list[int], parts: list[bytes]) -> Messages:
    """Return some of the messages with what they expanded to."""
    at = np.array(kept, dtype=np.int64)
    end = np.cumsum([len(part) for part in parts])
    begin = np.append(0, end[:-1])
    times = messages.log_time[at], messages.publish_time[at]
    return Messages(b"".join(parts), messages.order[at], *times, begin, end)
