# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Recordings made for benchmarks: small ones of every kind, and large ones of a few numbers."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray

REPOSITORY = Path(__file__).resolve().parents[1]
START = 1_790_000_000_000_000_000

_FLOAT64 = struct.Struct("<4sd")
_HEADER = struct.Struct("<4sIII")

IMU = "Header header\nVector3 linear_acceleration\nfloat64[9] covariance\n" + "".join(
    f"{'=' * 80}\nMSG: {name}\n{text}"
    for name, text in (
        ("x_msgs/Header", "Time stamp\nstring frame_id\n"),
        ("x_msgs/Time", "int32 sec\nuint32 nanosec\n"),
        ("x_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    )
)
JOINTS = "Header header\nstring[] name\nfloat64[] position\nint8 mode\n" + "".join(
    f"{'=' * 80}\nMSG: {name}\n{text}"
    for name, text in (
        ("x_msgs/Header", "Time stamp\nstring frame_id\n"),
        ("x_msgs/Time", "int32 sec\nuint32 nanosec\n"),
    )
)


def float64(value: float) -> bytes:
    """Return a std_msgs/Float64."""
    return _FLOAT64.pack(b"\0\1\0\0", value)


def _header(k: int) -> bytes:
    # The frame's name takes 4 bytes with its end.
    return _HEADER.pack(b"\0\1\0\0", 1000 + k, 5, 4) + b"imu\0"


def imu(k: int) -> bytes:
    """Return a message of the definition IMU."""
    # Aligned to 8 after the encapsulation, which holds since the header has 16 bytes.
    return _header(k) + np.array([k, k % 29, 9.81, *range(9)], dtype="<f8").tobytes()


def joints(k: int) -> bytes:
    """Return a message of the definition JOINTS."""
    names = b"".join(struct.pack("<I", 4) + b"arm\0" for _ in range(2))
    body = _header(k) + struct.pack("<I", 2) + names + struct.pack("<I", 2)
    body += bytes(-(len(body) - 4) % 8)
    return body + struct.pack("<ddb", float(k % 31), float(k % 17), 1)


def seeds() -> list[bytes]:
    """Return small recordings of every kind."""
    options: list[dict[str, Any]] = [
        {"compression": compression, "chunk_size": size}
        for compression in CompressionType
        for size in (800, 100_000)
    ]
    options += [
        {"use_chunking": False},
        {"compression": CompressionType.NONE, "chunk_size": 800, "index_types": IndexType.NONE},
        {"compression": CompressionType.NONE, "chunk_size": 3000, "enable_crcs": False},
        {"compression": CompressionType.ZSTD, "chunk_size": 3000, "enable_crcs": False},
        {"compression": CompressionType.LZ4, "chunk_size": 3000, "enable_crcs": False},
    ]
    made = [_small(**chosen) for chosen in options]
    made.append(zstandard.ZstdCompressor().compress(made[0]))
    made.append(_small(each=True, compression=CompressionType.NONE, chunk_size=3000))
    stored = sorted((REPOSITORY / "bags").glob("*relay*/*.mcap"))
    return made + [path.read_bytes() for path in stored]


def _small(*, each: bool = False, **options: Any) -> bytes:
    """Return a recording of four topics.

    :param each: compress its messages one by one, as rosbag2 can.
    :param options: of the mcap package's writer.
    """
    squeeze = zstandard.ZstdCompressor().compress if each else bytes
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start("ros2", "benchmark")
    writer.add_metadata("rosbag2", {"serialized_metadata": "version: 9"})
    plain = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
    types = {
        "/measurement": plain,
        "/command": plain,
        "/imu": writer.register_schema("x_msgs/msg/Imu", "ros2msg", IMU.encode()),
        "/joints": writer.register_schema("x_msgs/msg/Joints", "ros2msg", JOINTS.encode()),
    }
    ids = {topic: writer.register_channel(topic, "cdr", kind) for topic, kind in types.items()}
    content: dict[str, Callable[[int], bytes]] = {
        "/measurement": lambda k: float64(float(k % 29)),
        "/command": lambda k: float64(float(k // 10 % 2)),
        "/imu": imu,
        "/joints": joints,
    }
    for k in range(60):
        for topic, make in content.items():
            stamp = START + k * 10**8
            writer.add_message(ids[topic], stamp + 1000, squeeze(make(k)), stamp, k)
    writer.finish()
    return stream.getvalue()


# --- large ones


@dataclass(frozen=True)
class Chunk:
    """Records of messages, and where each is.

    :param content: the records.
    :param entries: log time and offset of each message by its channel, shape (n, 2).
    """

    content: bytes
    entries: dict[int, NDArray[np.uint64]]


MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("kind", "<u4"),
        ("value", "<f8"),
    ]
)
_CHUNK_MESSAGES = 24_000
INTERVAL_NS = 1_000_000


def pair_of_numbers(count: int, chunk_messages: int = _CHUNK_MESSAGES) -> Iterator[Chunk]:
    """Yield chunks of std_msgs/Float64 on the channels 1 and 2 in turns.

    :param count: number of messages on both together.
    :param chunk_messages: number of messages of a chunk.
    """
    rng = np.random.default_rng(1)
    for first in range(0, count, chunk_messages):
        k = np.arange(first, min(first + chunk_messages, count))
        data = np.zeros(k.size, MESSAGE)
        data["opcode"], data["length"], data["kind"] = 5, MESSAGE.itemsize - 9, 0x0100
        data["channel"] = 1 + k % 2
        data["sequence"] = k // 2
        data["log_time"] = START + k * INTERVAL_NS
        data["publish_time"] = data["log_time"] - rng.integers(20_000, 90_000, k.size)
        data["value"] = np.where(k % 2, k // 5000 % 2, rng.normal(20.0, 1.0, k.size))
        offsets = np.arange(k.size) * MESSAGE.itemsize
        places = np.stack((data["log_time"], offsets), axis=1).astype(np.uint64)
        yield Chunk(data.tobytes(), {c: places[data["channel"] == c] for c in (1, 2)})


def among_others(count: int) -> Iterator[Chunk]:
    """Yield chunks of the same pair in irregular turns, among messages of varying size.

    :param count: number of messages on both together; half as many others lie between them.
    """
    rng = np.random.default_rng(2)
    head = struct.Struct("<BQHIQQ")
    junk = rng.bytes(4096)
    done, stamp = 0, START
    while done < count:
        parts: list[bytes] = []
        entries: dict[int, list[tuple[int, int]]] = {1: [], 2: [], 3: []}
        size = 0
        for channel in rng.choice([1, 2, 3], 18_000, p=[0.4, 0.267, 0.333]).tolist():
            if channel == 3:
                data = b"\0\1\0\0" + junk[: int(rng.integers(4, 200))]
            elif done < count:
                data = float64(float(done % 977))
                done += 1
            else:
                continue
            stamp += INTERVAL_NS
            entries[channel].append((stamp, size))
            parts += (head.pack(5, 22 + len(data), channel, done, stamp, stamp - 50_000), data)
            size += 31 + len(data)
        yield Chunk(
            b"".join(parts),
            {c: np.array(e, dtype=np.uint64) for c, e in entries.items() if e},
        )


def among_images(seconds: int, *, apart: bool) -> Iterator[Chunk]:
    """Yield chunks of 30 camera images a second, and 100 messages a second of the pair.

    :param seconds: length of the recording.
    :param apart: whether images and numbers lie in different chunks.
    """
    image = np.random.default_rng(3).bytes(900_000)
    head = struct.Struct("<BQHIQQ")
    for second in range(seconds):
        start = START + second * 10**9
        numbers = [
            (start + k * 20_000_000, 1 + c, float64(float(k % 29 + c)))
            for k in range(50)
            for c in (0, 1)
        ]
        images = [(start + k * 33_000_000, 3, b"\0\1\0\0" + image) for k in range(30)]
        groups = [numbers, *([i] for i in images)] if apart else _mixed(numbers, images)
        for group in groups:
            parts: list[bytes] = []
            entries: dict[int, list[tuple[int, int]]] = {}
            size = 0
            for stamp, channel, data in group:
                entries.setdefault(channel, []).append((stamp, size))
                parts += (head.pack(5, 22 + len(data), channel, 0, stamp, stamp), data)
                size += 31 + len(data)
            yield Chunk(
                b"".join(parts), {c: np.array(e, dtype=np.uint64) for c, e in entries.items()}
            )


Stamped = tuple[int, int, bytes]


def _mixed(numbers: list[Stamped], images: list[Stamped]) -> Iterator[list[Stamped]]:
    share = len(numbers) / len(images)
    for k, image in enumerate(images):
        yield [*numbers[int(k * share) : int((k + 1) * share)], image]


def write_recording(path: Path, chunks: Iterable[Chunk], *, compression: str = "") -> None:
    """Write chunks as the mcap package would: with checksums, indexes and statistics.

    :param path: the file.
    :param chunks: of the channels 1 `/measurement`, 2 `/command` and 3 `/other`.
    :param compression: ``zstd``, or none.
    """

    def record(opcode: int, body: bytes) -> bytes:
        return struct.pack("<BQ", opcode, len(body)) + body

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    declared = b""
    for number, name, definition in (
        (1, "std_msgs/msg/Float64", "float64 data\n"),
        (2, "x_msgs/msg/Other", "uint8[] data\n"),
    ):
        body = struct.pack("<H", number) + text(name) + text("ros2msg") + text(definition)
        declared += record(3, body)
    for number, topic in enumerate(("/measurement", "/command", "/other"), start=1):
        body = struct.pack("<HH", number, 1 if number < 3 else 2) + text(topic) + text("cdr")
        declared += record(4, body + struct.pack("<I", 0))
    compressor = zstandard.ZstdCompressor()
    counts = dict.fromkeys((1, 2, 3), 0)
    indexes: list[bytes] = []
    with path.open("wb") as file:
        file.write(b"\x89MCAP0\r\n" + record(1, text("ros2") + text("benchmark")) + declared)
        for chunk in chunks:
            data = compressor.compress(chunk.content) if compression else chunk.content
            times = np.concatenate([e[:, 0] for e in chunk.entries.values()])
            span = (int(times.min()), int(times.max()))
            size, crc = len(chunk.content), zlib.crc32(chunk.content)
            begin = file.tell()
            body = struct.pack("<QQQI", *span, size, crc) + text(compression)
            file.write(record(6, body + struct.pack("<Q", len(data)) + data))
            end, places = file.tell(), b""
            for channel, entries in chunk.entries.items():
                counts[channel] += len(entries)
                places += struct.pack("<HQ", channel, file.tell())
                listed = entries.astype("<u8").tobytes()
                file.write(record(7, struct.pack("<HI", channel, len(listed)) + listed))
            body = struct.pack("<QQQQI", *span, begin, end - begin, len(places)) + places
            body += struct.pack("<Q", file.tell() - end) + text(compression)
            indexes.append(record(8, body + struct.pack("<QQ", len(data), size)))
        file.write(record(15, struct.pack("<I", 0)))
        start = file.tell()
        listed = b"".join(struct.pack("<HQ", *item) for item in counts.items())
        total = sum(counts.values())
        body = struct.pack("<QHIIIIQQ", total, 2, 3, 0, 0, len(indexes), 0, 0)
        body += struct.pack("<I", len(listed))
        file.write(declared + record(11, body + listed) + b"".join(indexes))
        file.write(record(2, struct.pack("<QQI", start, 0, 0)) + b"\x89MCAP0\r\n")
