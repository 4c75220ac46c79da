"""The records of an MCAP file: reading each without trusting what it declares.

Layout: https://mcap.dev/spec. Every length is checked against what is there before it is used.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from relay_autotune.errors import BagError

MAGIC = b"\x89MCAP0\r\n"

# The largest chunk that is decompressed, whatever the file declares.
LARGEST_CHUNK = 1 << 30

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
CHUNK_INDEX, METADATA, DATA_END = 0x08, 0x0C, 0x0F

RECORD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
FOOTER_SIZE = 20

# What the file might be instead, by its first bytes.
_OTHERS = (
    (b"SQLite format 3", "an SQLite file; convert such a bag with: ros2 bag convert"),
    (b"\x28\xb5\x2f\xfd", "compressed as a whole with zstd; expand it with: zstd -d FILE"),
    (b"#ROSBAG", "a ROS 1 bag; convert it with: rosbags-convert"),
)


class DamageError(Exception):
    """Bytes that are no MCAP records."""


Buffer = bytes | mmap.mmap


def map_file(path: Path) -> mmap.mmap:
    """Map a file that begins as MCAP files do into memory.

    :raises BagError: if it is missing, unreadable, empty or something else.
    """
    try:
        with path.open("rb") as file:
            start = file.read(16)
            if not start:
                raise BagError(
                    f"{path} is empty (0 bytes); expected an MCAP recording: "
                    f"the recorder was ended before it wrote anything"
                )
            if start[: len(MAGIC)] != MAGIC[: len(start)]:
                told = next((what for head, what in _OTHERS if start.startswith(head)), None)
                found = f"it is {told}" if told else f"it begins with {start[:8]!r}"
                raise BagError(f"{path} is not an MCAP file: {found}")
            if len(start) < len(MAGIC):
                raise BagError(
                    f"{path} holds only the first {len(start)} bytes of an MCAP file; "
                    f"nothing was recorded in it"
                )
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError:
        raise BagError(f"{path} does not exist; expected a recording") from None
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror or error}") from error


def next_record(data: Buffer, position: int, stop: int) -> tuple[int, int, int] | None:
    """Return opcode, begin and end of the record at ``position``; None if it is cut."""
    if stop - position < RECORD.size:
        return None
    opcode, length = RECORD.unpack_from(data, position)
    begin = position + RECORD.size
    if opcode == 0 or length > stop - begin:
        return None
    return opcode, begin, begin + length


def records(
    data: Buffer, position: int = 0, stop: int | None = None, *, strict: bool = True
) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of each record.

    :param strict: raise if the last one is cut; else leave it out.
    :raises DamageError: if a record is longer than what is left.
    """
    stop = len(data) if stop is None else stop
    while position < stop:
        record = next_record(data, position, stop)
        if record is None:
            if strict:
                raise DamageError(f"a record of impossible length at {position}")
            return
        yield record
        position = record[2]


def message_head(data: bytes, begin: int, end: int) -> tuple[int, int, int, int]:
    """Return channel, sequence, log time [ns] and publish time [ns] of a message."""
    if end - begin < MESSAGE_HEAD.size:
        raise DamageError("a message shorter than its head")
    channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(data, begin)
    return channel, sequence, log_time, publish_time


def unsigned(data: bytes, at: int, form: str) -> int:
    """Return the number at a place of a record."""
    if at + struct.calcsize(form) > len(data):
        raise DamageError("a record is cut")
    return int(struct.unpack_from(form, data, at)[0])


def sized_bytes(data: Buffer, at: int, stop: int) -> tuple[bytes, int]:
    """Return the bytes after their length, and the place after them."""
    if stop - at < 4:
        raise DamageError("a record is cut")
    (length,) = struct.unpack_from("<I", data, at)
    if length > stop - at - 4:
        raise DamageError("a text is longer than its record")
    return data[at + 4 : at + 4 + length], at + 4 + length


def text(data: Buffer, at: int, stop: int) -> tuple[str, int]:
    """Return the text after its length, and the place after it."""
    raw, at = sized_bytes(data, at, stop)
    try:
        return raw.decode("utf-8"), at
    except UnicodeDecodeError:
        raise DamageError("a name is not UTF-8") from None


def map_of_text(data: bytes, at: int) -> tuple[dict[str, str], int]:
    """Return the texts by their names, and the place after them."""
    body, after = sized_bytes(data, at, len(data))
    found: dict[str, str] = {}
    at = 0
    while at < len(body):
        key, at = text(body, at, len(body))
        found[key], at = text(body, at, len(body))
    return found, after


def chunk_content(data: Buffer, start: int, end: int) -> tuple[bytes, bool]:
    """Return the records inside of a chunk, and whether all of them are there.

    :param start: where the chunk's record begins.
    :param end: where it ends, or the file if that ends before.
    :raises DamageError: if nothing of it can be used.
    """
    begin = start + RECORD.size
    if end - begin < _CHUNK_HEAD.size + 12:
        raise DamageError("the head of a chunk is cut")
    whole = begin + RECORD.unpack_from(data, start)[1] == end
    _, _, size, crc = _CHUNK_HEAD.unpack_from(data, begin)
    compression, begin = text(data, begin + _CHUNK_HEAD.size, end)
    if end - begin < 8:
        raise DamageError("the head of a chunk is cut")
    (stored,) = struct.unpack_from("<Q", data, begin)
    begin += 8
    if size > LARGEST_CHUNK:
        raise DamageError(f"a chunk declares {size} bytes, more than the {LARGEST_CHUNK} allowed")
    if whole and stored != end - begin:
        raise DamageError("the lengths of a chunk contradict each other")
    content = _expand(data[begin:end], compression, size)
    if whole and len(content) != size:
        raise DamageError(f"a chunk declares {size} bytes, but does not hold that many")
    if whole and crc and zlib.crc32(content) != crc:
        raise DamageError("the checksum of a chunk is wrong")
    return content, whole


def _expand(data: bytes, compression: str, size: int) -> bytes:
    """Decompress a chunk; of one that is cut, as much as there is.

    :param size: declared size; at most one byte more than that is taken.
    """
    if compression == "":
        return data
    if compression == "zstd":
        return _expand_zstd(data, size)
    if compression == "lz4":
        return _expand_lz4(data, size)
    raise DamageError(f"a chunk is compressed with {compression!r}; known are zstd and lz4")


def _expand_zstd(data: bytes, size: int) -> bytes:
    try:
        import zstandard
    except ImportError:
        raise _missing("zstandard") from None
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return bytes(stream.read(size + 1))
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamageError(f"a chunk cannot be decompressed ({error})") from None


def _expand_lz4(data: bytes, size: int) -> bytes:
    try:
        import lz4.frame
    except ImportError:
        raise _missing("lz4") from None
    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (RuntimeError, EOFError, MemoryError) as error:
        raise DamageError(f"a chunk cannot be decompressed ({error})") from None


def _missing(package: str) -> BagError:
    return BagError(
        f"the recording is compressed; to read it install the Python package {package}, "
        f"with: pip install {package}"
    )
