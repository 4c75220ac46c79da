# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Damage bags at random and read them: `python3 benchmarks/fuzz_bags.py [--quick] [--count N]`.

Seeds of every kind (chunks plain, zstd and lz4; without chunks, index or summary; compressed as a
whole, or message by message; our own experiments; types of every shape) are flipped, cut, spliced
and lengthened, and their lengths, offsets, counts and texts replaced. Each is read as `replay`
reads it in a process that is watched: a crash, an error or a warning that is not one of ours, more
than 5 s (twice, since the machine may have been busy) or more than 1 GB is a find, and its bag is
kept.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import struct
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from made_recordings import seeds
from markdown import table, three

from relay_autotune.bag.signals import Selection
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.recordings import read_experiments

COUNT, QUICK_COUNT = 20_000, 60
SECONDS, MEGABYTES = 5.0, 1000.0

# Numbers that stand for a length, an offset or a count.
_ODD = (0, 1, 7, 8, 9, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)

Mutate = Callable[[bytearray, np.random.Generator], bytearray]


def flip(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Change some bytes."""
    for at in rng.integers(0, len(data), int(rng.integers(1, 9))):
        data[at] = int(rng.integers(0, 256))
    return data


def cut(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Cut off the end."""
    return data[: int(rng.integers(0, len(data)))]


def remove(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Take some bytes out of the middle."""
    begin = int(rng.integers(0, len(data)))
    del data[begin : begin + int(rng.integers(1, 200))]
    return data


def splice(data: bytearray, rng: np.random.Generator, others: list[bytes]) -> bytearray:
    """Put a piece of another bag into the middle."""
    other = others[int(rng.integers(len(others)))]
    begin = int(rng.integers(0, len(other)))
    piece = other[begin : begin + int(rng.integers(1, 4000))]
    at = int(rng.integers(0, len(data)))
    return data[:at] + piece + data[at:]


def renumber(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Replace numbers by those at the ends of their ranges."""
    for _ in range(int(rng.integers(1, 4))):
        form, size = ("<Q", 8) if rng.integers(2) else ("<I", 4)
        if len(data) > size:
            at = int(rng.integers(0, len(data) - size))
            value = _ODD[int(rng.integers(len(_ODD)))] % 2 ** (8 * size)
            struct.pack_into(form, data, at, value)
    return data


def relength(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Replace the length of a record, and sometimes its opcode."""
    places = list(record_places(data))
    if not places:
        return data
    for _ in range(int(rng.integers(1, 3))):
        at = places[int(rng.integers(len(places)))]
        if rng.integers(2):
            near = int(rng.integers(-30, 30))
            (length,) = struct.unpack_from("<Q", data, at + 1)
            value = max(length + near, 0) if rng.integers(3) else _ODD[int(rng.integers(14))]
            struct.pack_into("<Q", data, at + 1, value % 2**64)
        else:
            data[at] = int(rng.integers(0, 18))
    return data


def retext(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Replace part of a definition by other words of definitions."""
    words = (b"float64", b"string", b"[99999999]", b"[]", b"<=4", b"/", b"\xff\xfe", b"MSG: x/Y\n")
    at = data.find(b"float64", int(rng.integers(0, len(data))))
    if at >= 0:
        data[at : at + 7] = words[int(rng.integers(len(words)))]
    return data


def repeat(data: bytearray, rng: np.random.Generator) -> bytearray:
    """Write a piece many times."""
    begin = int(rng.integers(0, len(data)))
    piece = data[begin : begin + int(rng.integers(1, 300))]
    return data[:begin] + piece * int(rng.integers(2, 60)) + data[begin:]


MUTATIONS: tuple[Mutate, ...] = (
    flip, cut, remove, renumber, relength, relength, retext, repeat
)  # fmt: skip


def record_places(data: bytes | bytearray) -> Iterator[int]:
    """Yield where records begin, those inside of plain chunks too."""
    at = 8
    while at + 41 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield at
        if opcode == 6 and length > 40 and struct.unpack_from("<I", data, at + 37)[0] == 0:
            # A plain chunk: its records follow at once.
            at += 9 + 28 + 4 + 8
            continue
        if length > len(data):
            return
        at += 9 + length


def mutated(number: int, bags: list[bytes]) -> bytes:
    """Return the damaged bag of a number; the same for ever."""
    rng = np.random.default_rng([20_261_121, number])
    data = bytearray(bags[int(rng.integers(len(bags)))])
    for _ in range(int(rng.integers(1, 4))):
        if data:
            chosen = int(rng.integers(len(MUTATIONS) + 1))
            data = MUTATIONS[chosen - 1](data, rng) if chosen else splice(data, rng, bags)
    return bytes(data)


def read(path: Path, number: int) -> str:
    """Read a bag as replay does; return what came of it."""
    chosen = (
        Selection(),
        Selection("/measurement", "/command", start=0.0),
        Selection("/joints:position[1]", "/command", clock="header"),
        Selection("/imu:linear_acceleration.y", "/command", clock="log"),
    )[number % 4]
    try:
        found = read_experiments(path, chosen)
    except RelayAutotuneError:
        return "refused"
    return "read, with a note" if found.notes else "read"


@dataclass(frozen=True)
class Trial:
    """How to make a bag from a number and how to judge it; a new process finds both by name.

    :param make: returns the bag of a number, from the seeds.
    :param judge: reads a file with the bag of a number, and returns one of ``EXPECTED``.
    """

    make: Callable[[int, list[bytes]], bytes]
    judge: Callable[[Path, int], str]


def worker(connection: Connection, path: Path, trial: Trial) -> None:
    """Read one bag after the other; tell what came of each, and the memory taken so far."""
    # A warning of numpy would be an unclear line on the standard error of a command.
    warnings.simplefilter("error", RuntimeWarning)
    bags = seeds()
    read_experiments_once(path, bags)
    while True:
        number = connection.recv()
        path.write_bytes(trial.make(number, bags))
        try:
            said = trial.judge(path, number)
        except BaseException as error:  # noqa: BLE001  any error that is not ours is a find
            said = f"{type(error).__name__}: {error}"
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        connection.send((said, used))


def read_experiments_once(path: Path, bags: list[bytes]) -> None:
    """Load everything that the first bag loads, so that it is not counted for another bag."""
    for number, bag in enumerate(bags):
        path.write_bytes(bag)
        read(path, number)


class Watched:
    """A process that reads bags, and is replaced when it does not answer."""

    def __init__(self, folder: Path, trial: Trial) -> None:
        self._path = folder / "bag.mcap"
        self._trial = trial
        self._context = multiprocessing.get_context("spawn")
        self._begin()

    def _begin(self) -> None:
        self._mine, theirs = self._context.Pipe()
        given = (theirs, self._path, self._trial)
        self._process = self._context.Process(target=worker, args=given)
        self._process.daemon = True
        self._process.start()
        theirs.close()

    def ask(self, number: int, limit: float) -> tuple[str, float]:
        """Return the result of a bag, and the peak memory so far [MB]."""
        self._mine.send(number)
        said: tuple[str, float] = ("took too long", 0.0)
        try:
            if self._mine.poll(limit):
                return self._mine.recv()
        except EOFError:
            said = ("ended its process", 0.0)
        self._process.kill()
        self._process.join()
        self._begin()
        return said

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


EXPECTED = ("read", "read, with a note", "refused")


def main() -> int:
    """Print the table; keep what is found."""
    return run(__doc__.splitlines()[0], "damaged bags", Trial(mutated, read))


def run(about: str, what: str, trial: Trial) -> int:
    """Print the table of a trial; keep what is found.

    :param about: what the program does.
    :param what: what the table counts.
    :param trial: what is tried.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--quick", action="store_true", help="a few bags: does it run?")
    parser.add_argument("--count", type=int, default=COUNT, help="bags (%(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first (%(default)s)")
    parser.add_argument("--keep", type=Path, help="folder for bags that are finds")
    options = parser.parse_args()
    count = QUICK_COUNT if options.quick else options.count
    outcomes: Counter[str] = Counter()
    finds: list[tuple[int, str]] = []
    slowest, most = 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        reader = Watched(Path(folder), trial)
        # The first answer waits for the imports.
        reader.ask(options.first, 120.0)
        for number in range(options.first, options.first + count):
            for _ in range(2):
                begin = time.monotonic()
                said, used = reader.ask(number, 60.0 if outcomes.total() == 0 else 3.0 * SECONDS)
                took = time.monotonic() - begin
                if took <= SECONDS:
                    break
            slowest, grew = max(slowest, took), used > MEGABYTES and most <= MEGABYTES
            most = max(most, used)
            if said not in EXPECTED or took > SECONDS or grew:
                finds.append((number, f"{said} after {took:.1f} s, {used:.0f} MB"))
                print(f"bag {number}: {finds[-1][1]}", file=sys.stderr, flush=True)
                said = "a find"
            outcomes[said] += 1
        reader.close()
    if options.keep and finds:
        options.keep.mkdir(parents=True, exist_ok=True)
        bags = seeds()
        for number, _ in finds:
            (options.keep / f"{number}.mcap").write_bytes(trial.make(number, bags))
    rows = [(name, outcomes[name]) for name in (*EXPECTED, "a find")]
    rows += [
        ("slowest [s]", three(slowest)),
        ("most memory of the reading process [MB]", three(most)),
    ]
    print(table((f"{count} {what}", "number"), rows))
    return 1 if finds else 0


if __name__ == "__main__":
    sys.exit(main())
