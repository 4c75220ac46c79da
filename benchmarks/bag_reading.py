# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time and memory of reading bags: `python3 benchmarks/bag_reading.py [--quick] [--folder DIR]`.

Two topics of std_msgs/Float64 are read with their times, by this package and by the fastest way of
each library that reads the same file, in one run. The files, up to 4 GB, are made in a temporary
folder and removed at the end.
"""

from __future__ import annotations

import argparse
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import zstandard
from made_recordings import (
    Chunk,
    among_images,
    among_others,
    pair_of_numbers,
    write_recording,
)
from markdown import table, three

from relay_autotune.bag.bag_file import McapFile
from relay_autotune.bag.topics import Topics

TOPICS = ("/measurement", "/command")
MESSAGES, QUICK_MESSAGES = 2_000_000, 200_000
GROWTH = (100_000, 1_000_000, 10_000_000, 30_000_000)
QUICK_GROWTH = (10_000, 100_000)
# 27 MB a second.
IMAGE_SECONDS, QUICK_IMAGE_SECONDS = 150, 1
LARGE, QUICK_LARGE = 68_000_000, 100_000
TURNS = 7


def ours(path: Path) -> int:
    """Read the pair with this package; return the number of values."""
    with McapFile(path) as file:
        signals = Topics(path, [file]).signals(TOPICS)
    return sum(map(len, signals.values()))


def by_mcap(path: Path) -> int:
    """Read the pair by the iteration of the package mcap, values unpacked by hand."""
    from mcap.reader import make_reader

    unpack = struct.Struct("<d").unpack_from
    found: dict[str, list[tuple[int, float]]] = {topic: [] for topic in TOPICS}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(topics=TOPICS):
            found[channel.topic].append((message.publish_time, unpack(message.data, 4)[0]))
    return sum(map(len, found.values()))


def by_rosbags(path: Path) -> int:
    """Read the pair by rosbags."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    decode, kind = store.deserialize_cdr, "std_msgs/msg/Float64"
    found: dict[str, list[tuple[int, float]]] = {topic: [] for topic in TOPICS}
    with Reader(path) as reader:
        wanted = [c for c in reader.connections if c.topic in TOPICS]
        for connection, stamp, data in reader.messages(wanted):
            found[connection.topic].append((stamp, decode(data, kind).data))
    return sum(map(len, found.values()))


def by_mcap_ros2(path: Path) -> int:
    """Read the pair by mcap-ros2-support."""
    from mcap_ros2.reader import read_ros2_messages

    found: dict[str, list[tuple[int, float]]] = {topic: [] for topic in TOPICS}
    for message in read_ros2_messages(str(path), topics=list(TOPICS)):
        found[message.channel.topic].append((message.publish_time_ns, message.ros_msg.data))
    return sum(map(len, found.values()))


LIBRARIES: dict[str, Callable[[Path], int]] = {
    "mcap": by_mcap,
    "rosbags": by_rosbags,
    "mcap-ros2-support": by_mcap_ros2,
}


def seconds(work: Callable[..., object], *arguments: object) -> float:
    """Return the processor time of a piece of work.

    All of them run in one thread on files in the page cache. So this is the elapsed time on an
    idle machine, and nearly the same on a busy one.
    """
    begin = time.process_time()
    work(*arguments)
    return time.process_time() - begin


def from_disk(path: Path, work: Callable[..., object], *arguments: object) -> float:
    """Return the elapsed time of a piece of work with a file that is not in memory."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    begin = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - begin


def compressed_chunks(chunks: Iterable[Chunk]) -> list[tuple[bytes, int]]:
    """Return the chunks as the file holds them, with their sizes."""
    compressor = zstandard.ZstdCompressor()
    return [(compressor.compress(chunk.content), len(chunk.content)) for chunk in chunks]


def expand(chunks: list[tuple[bytes, int]]) -> None:
    """Only decompress, as zstd itself does."""
    decompressor = zstandard.ZstdDecompressor()
    for data, size in chunks:
        decompressor.decompress(data, max_output_size=size)


def comparison(folder: Path, count: int, turns: int) -> list[tuple[str, ...]]:
    """Compare with the libraries, on pairs in regular and irregular turns."""
    cases = (
        ("in turns, zstd", pair_of_numbers, "zstd", 40),
        ("in turns, uncompressed", pair_of_numbers, "", 75),
        ("irregular among others, zstd", among_others, "zstd", 27),
        ("irregular among others, uncompressed", among_others, "", 50),
    )
    rows = []
    for name, make, compression, target in cases:
        path = folder / "pair.mcap"
        write_recording(path, make(count), compression=compression)
        chunks = compressed_chunks(make(count)) if compression else []
        assert ours(path) == count
        times = {library: seconds(read, path) for library, read in LIBRARIES.items()}
        mine, alone = [], []
        for _ in range(turns):
            mine.append(seconds(ours, path))
            alone.append(seconds(expand, chunks))
        best = min(times, key=times.__getitem__)
        ratio = f"{min(mine) / min(alone):.2f}" if compression else ""
        rates = (three(count / t / 1e6) for t in (min(mine), *times.values()))
        factor = f"{times[best] / min(mine):.0f} x {best}"
        rows.append((name, *rates, factor, f">= {target}", ratio, "<= 2.5" if compression else ""))
        path.unlink()
    return rows


def needed_bytes(path: Path) -> Callable[[], None]:
    """Return the work of reading the bytes of the chunks in which the pair lies."""
    with McapFile(path) as file:
        ranges = [(s.start, s.end) for s in file.segments((1, 2))]

    def work() -> None:
        with path.open("rb") as handle:
            for begin, end in ranges:
                os.pread(handle.fileno(), end - begin, begin)

    return work


def images(folder: Path, length: int, turns: int) -> list[tuple[str, ...]]:
    """Compare with the time to read the needed chunks' bytes."""
    rows = []
    for apart, compression in ((True, "zstd"), (True, ""), (False, "zstd"), (False, "")):
        path = folder / "images.mcap"
        write_recording(path, among_images(length, apart=apart), compression=compression)
        plain = needed_bytes(path)
        # Imports at first use are not counted.
        ours(path)
        # Mixed, each turn reads all of the file.
        counted = range(turns if apart else min(turns, 3))
        taken = [(from_disk(path, ours, path), from_disk(path, plain)) for _ in counted]
        mine, base = (statistics.median(column) for column in zip(*taken, strict=True))
        name = f"{'apart' if apart else 'mixed'}, {compression or 'uncompressed'}"
        size = path.stat().st_size / 1e9
        peak, signals = memory(path)
        rows.append(
            (
                *(name, three(size), three(1e3 * mine), three(1e3 * base)),
                *(three(mine / base), "<= 3" if apart else "", three(peak - signals)),
                "<= 300",
            )
        )
        path.unlink()
    return rows


def memory(path: Path) -> tuple[float, float]:
    """Return the peak memory of reading beyond that of the imports, and the signals' [MB]."""
    done = subprocess.run(
        [sys.executable, __file__, "--memory-of", str(path)],
        stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    peak, signals = map(float, done.stdout.split())
    return peak, signals


def print_memory(path: Path) -> None:
    """Print the result for `memory`."""
    begin = high_water()
    values = ours(path)
    print(high_water() - begin, 16 * values / 1e6)


def high_water() -> float:
    """Return the most memory that this process ever took [MB]."""
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) * 1024 / 1e6


def growth(folder: Path, counts: Iterable[int], turns: int) -> list[tuple[str, ...]]:
    """Measure the time for a message, at many numbers of them."""
    rows = []
    for count in counts:
        path = folder / "growth.mcap"
        write_recording(path, pair_of_numbers(count))
        best = min(seconds(ours, path) for _ in range(turns if count < 10**7 else 3))
        rows.append((f"{count:,}", three(1e3 * best), three(1e9 * best / count)))
        path.unlink()
    return rows


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small files: does it run?")
    parser.add_argument("--folder", type=Path, help="where to make the files, 5 GB")
    parser.add_argument(
        "--messages", type=int, default=MESSAGES, help="of the comparison (%(default)s)"
    )
    parser.add_argument("--part", choices=PARTS, help="one of the tables alone")
    parser.add_argument("--memory-of", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory_of:
        print_memory(options.memory_of)
        return 0
    with tempfile.TemporaryDirectory(dir=options.folder, prefix="bag_reading_") as name:
        for part in [options.part] if options.part else PARTS:
            print(PARTS[part](Path(name), options), flush=True)
    return 0


def comparison_table(folder: Path, options: argparse.Namespace) -> str:
    """Return the table of (a) and (g)."""
    count, turns = (QUICK_MESSAGES, 1) if options.quick else (options.messages, TURNS)
    headings = ("pair", "this", *LIBRARIES, "faster", "target", "x zstd alone", "target")
    said = f"Million messages a second, of {count:,} on two topics; least time of {turns}:"
    return f"{said}\n\n{table(headings, comparison(folder, count, turns))}\n"


def images_table(folder: Path, options: argparse.Namespace) -> str:
    """Return the table of (b) and (c)."""
    length, turns = (QUICK_IMAGE_SECONDS, 1) if options.quick else (IMAGE_SECONDS, TURNS)
    headings = (
        *("images and numbers", "[GB]", "this [ms]", "bytes alone [ms]", "x", "target"),
        *("memory beyond the signals [MB]", "target"),
    )
    said = (
        f"The pair, 100 messages a second, in a bag of camera images that is on the disk; "
        f"median of {turns} turns (mixed: at most 3) in which both are timed:"
    )
    return f"{said}\n\n{table(headings, images(folder, length, turns))}\n"


def large_table(folder: Path, options: argparse.Namespace) -> str:
    """Return the table of (c)."""
    path = folder / "large.mcap"
    write_recording(path, pair_of_numbers(QUICK_LARGE if options.quick else LARGE))
    peak, signals = memory(path)
    row = (*map(three, (path.stat().st_size / 1e9, peak, signals, peak - signals)), "<= 300")
    path.unlink()
    headings = ("[GB]", "peak [MB]", "signals [MB]", "beyond them [MB]", "target")
    said = "Peak memory of a bag that holds nothing but the pair:"
    return f"{said}\n\n{table(headings, [row])}\n"


def growth_table(folder: Path, options: argparse.Namespace) -> str:
    """Return the table of (d)."""
    rows = growth(folder, QUICK_GROWTH if options.quick else GROWTH, 1 if options.quick else TURNS)
    said = "Time and number of messages, uncompressed:"
    return f"{said}\n\n{table(('messages', '[ms]', 'ns/message'), rows)}\n"


PARTS: dict[str, Callable[[Path, argparse.Namespace], str]] = {
    "comparison": comparison_table,
    "images": images_table,
    "large": large_table,
    "growth": growth_table,
}


if __name__ == "__main__":
    sys.exit(main())
