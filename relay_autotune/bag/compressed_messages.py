# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Messages that were compressed one by one, as rosbag2 does it with compression_mode MESSAGE.

Each serialized message is then a frame of zstd that declares its size (rosbag2_compression_zstd,
ZstdCompressor::compress_serialized_bag_message). They are recognised by their first bytes, with
which no message in CDR begins: where a recorder was killed, there is no metadata.yaml.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from relay_autotune.bag.locate import Content, Messages
from relay_autotune.bag.mcap_records import DamageError
from relay_autotune.bag.source import ZSTD_MAGIC, Source, expanding_package

# Size of the expanded messages that are handed on together [bytes].
_EXPANDED = 16 << 20


def are_compressed(messages: Messages) -> bool:
    """Tell by the first of some messages whether they are compressed one by one."""
    if messages.begin.size == 0:
        return False
    begin, end = int(messages.begin[0]), int(messages.end[0])
    return bytes(messages.content[begin : min(end, begin + len(ZSTD_MAGIC))]) == ZSTD_MAGIC


class Expander:
    """Expands messages within limits, and counts those that cannot be expanded.

    :param source: the file that holds the messages.
    :param largest: size that a message may have [bytes].
    """

    def __init__(self, source: Source, largest: int) -> None:
        self._source = source
        self._largest = largest
        self._zstandard = expanding_package("zstandard")
        self._decompressor = self._zstandard.ZstdDecompressor()
        self.first_refusal = ""

    def expand(self, messages: Messages) -> Iterator[Messages]:
        """Yield messages as they were before they were compressed, some at a time.

        Those that cannot be expanded are left out; `first_refusal` then says why.

        :raises BagError: if they expand to more than a recording does.
        """
        view = memoryview(messages.content)
        parts: list[bytes] = []
        kept: list[int] = []
        size = 0
        for number, (begin, end) in enumerate(
            zip(messages.begin.tolist(), messages.end.tolist(), strict=True)
        ):
            try:
                part = self._expanded(view[begin:end])
            except DamageError as damage:
                self.first_refusal = self.first_refusal or str(damage)
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

    def _expanded(self, frame: Content) -> bytes:
        if frame[: len(ZSTD_MAGIC)] != ZSTD_MAGIC:
            return bytes(frame)
        zstandard = self._zstandard
        try:
            # zstd allocates at once the size that the frame declares.
            size = zstandard.frame_content_size(frame)
            if size < 0:
                raise DamageError("it does not declare its size")
            if size > self._largest:
                raise DamageError(
                    f"it declares {size} bytes, more than the {self._largest} that --max-chunk "
                    f"allows"
                )
            data = self._decompressor.decompress(frame, max_output_size=size) if size else b""
        except (zstandard.ZstdError, MemoryError) as error:
            raise DamageError(str(error)) from None
        return bytes(data)


def _together(messages: Messages, kept: list[int], parts: list[bytes]) -> Messages:
    """Return some of the messages with what they expanded to."""
    at = np.array(kept, dtype=np.int64)
    end = np.cumsum([len(part) for part in parts])
    begin = np.append(0, end[:-1])
    times = messages.log_time[at], messages.publish_time[at]
    return Messages(b"".join(parts), messages.order[at], *times, begin, end)
