# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The content of a chunk, expanded within limits and checked; of a cut chunk, what is there."""

from __future__ import annotations

import struct
import zlib

from relay_autotune.bag.limits import LARGEST_WINDOW
from relay_autotune.bag.mcap_records import DamageError, text, unsigned
from relay_autotune.bag.source import expanding_package

# Times of the first and the last message, size of the content, its checksum.
_HEAD = struct.Struct("<QQQI")


def chunk_content(body: bytes, *, whole: bool, largest: int) -> bytes | memoryview:
    """Return the records inside of a chunk.

    :param body: the chunk's record without opcode and length, or as much as the file has of it.
    :param whole: whether that is all of it; if not, the part that can be read is returned.
    :param largest: size that the content may have [bytes].
    :raises DamageError: if nothing of it can be used.
    """
    if len(body) < _HEAD.size + 12:
        raise DamageError("the head of a chunk is cut")
    _, _, size, crc = _HEAD.unpack_from(body)
    compression, at = text(body, _HEAD.size)
    stored = unsigned(body, at, "<Q")
    data = memoryview(body)[at + 8 :]
    if size > largest:
        raise DamageError(
            f"a chunk declares {size} bytes, more than the {largest} that --max-chunk allows"
        )
    if whole and stored != len(data):
        raise DamageError("the lengths of a chunk contradict each other")
    content = _expand(data, compression, size, whole=whole)
    if whole and len(content) != size:
        raise DamageError(f"a chunk declares {size} bytes, but does not hold that many")
    if whole and crc and zlib.crc32(content) != crc:
        raise DamageError("the checksum of a chunk is wrong")
    return content


def _expand(data: memoryview, compression: str, size: int, *, whole: bool) -> bytes | memoryview:
    """Decompress a chunk, or the part of a cut one.

    :param size: declared size; at most one byte more than that is taken.
    """
    if compression == "":
        return data
    if compression == "zstd":
        return _whole_zstd(data, size) if whole else _part_of_zstd(data, size)
    if compression == "lz4":
        return _expand_lz4(data, size)
    raise DamageError(f"a chunk is compressed with {compression!r}; known are zstd and lz4")


def _whole_zstd(data: memoryview, size: int) -> bytes:
    zstandard = expanding_package("zstandard")
    if size == 0:
        return b""
    try:
        # zstd allocates at once the size that the frame declares.
        if zstandard.frame_content_size(data) not in (-1, size):
            raise DamageError("a chunk and its compressed content differ in their size")
        content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamageError(f"a chunk cannot be decompressed ({error})") from None
    return bytes(content)


def _part_of_zstd(data: memoryview, size: int) -> bytes:
    zstandard = expanding_package("zstandard")
    try:
        decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW)
        with decompressor.stream_reader(data) as stream:
            return bytes(stream.read(size + 1))
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamageError(f"a chunk cannot be decompressed ({error})") from None


def _expand_lz4(data: memoryview, size: int) -> bytes:
    frame = expanding_package("lz4.frame")
    try:
        return bytes(frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (RuntimeError, EOFError, MemoryError) as error:
        raise DamageError(f"a chunk cannot be decompressed ({error})") from None
