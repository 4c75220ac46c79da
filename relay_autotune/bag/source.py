# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The bytes of a recording: ranges of a file, expanded first if it is compressed as a whole."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

from relay_autotune.bag.limits import (
    FREE_DISK,
    LARGEST_CHUNK,
    LARGEST_WINDOW,
    MOST_EXPANSION,
    MOST_MESSAGES,
    MOST_NOTES,
    UNSUSPICIOUS,
)
from relay_autotune.errors import BagError, os_errors_as, system_says

MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

# Largest part of an announced range that is fetched before it is read [bytes].
_ANNOUNCED = 64 << 10

# What the file might be instead, by its first bytes.
_OTHERS = (
    (b"SQLite format 3", "an SQLite file; expected a name that ends with .db3"),
    (b"#ROSBAG", "a ROS 1 bag; convert it with: rosbags-convert"),
)
# Tables of other programs, which are no recordings.
_TABLES = (
    (b"PK\x03\x04", "a zip archive, as workbooks are; save the table as CSV"),
    (b"MATLAB ", "a MATLAB file; save time, measurement and command as CSV"),
)


class DamageError(Exception):
    """Bytes of a recording that make no sense."""


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading: a pipe or a device may never end.

    :param path: the file.
    :raises BagError: if it is missing, unreadable, or no regular file.
    """
    try:
        # Without this flag, opening a pipe waits for its other end.
        opened = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise BagError(f"{path} does not exist; expected a recording") from None
    except (OSError, ValueError) as error:
        raise BagError(f"cannot read {path}: {system_says(error)}") from error
    if stat.S_ISREG(os.fstat(opened).st_mode):
        return os.fdopen(opened, "rb")
    folder = stat.S_ISDIR(os.fstat(opened).st_mode)
    os.close(opened)
    raise BagError(
        f"{path} is {'a folder' if folder else 'no regular file'}; expected a recording in a file"
    )


def known_start(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is a recording of some kind.

    :param head: its first bytes, 16 or more.
    """
    return head.startswith((MAGIC, SQLITE_MAGIC, ZSTD_MAGIC, *(magic for magic, _ in _OTHERS)))


class Source:
    """A file that begins as recordings do, open for reading ranges of it.

    The file is read, not mapped: a file that another process cuts short then gives fewer bytes,
    where a mapping would end this process.

    :param path: the file; it may be compressed as a whole with zstd.
    :param largest_chunk: size that a chunk, or a message outside of chunks, may have [bytes].
    :raises BagError: if it is missing, unreadable, empty or something else.
    """

    _magic = MAGIC
    """The bytes with which it has to begin."""

    def __init__(self, path: Path, largest_chunk: int = LARGEST_CHUNK) -> None:
        self.path, self.largest = path, largest_chunk
        self.notes: list[str] = []
        self._expanded = 0
        self._file = open_regular(path)
        try:
            self.look_again()
            if self.span(0, len(ZSTD_MAGIC)) == ZSTD_MAGIC:
                self._expand()
                self.look_again()
                # What it holds is counted anew.
                self._expanded = 0
            self._check_start()
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        """Learn what the file holds."""

    def look_again(self) -> None:
        """Update the size of the file, which may have grown or shrunk."""
        self.size = os.fstat(self._file.fileno()).st_size

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def span(self, start: int, stop: int) -> bytes:
        """Return the bytes between two places; fewer if the file ends before.

        :raises BagError: if the file system refuses.
        """
        try:
            data = os.pread(self._file.fileno(), max(stop - start, 0), start)
            while data and len(data) < stop - start:
                # A single read gives at most 2 GiB, or what a slow medium has at once.
                more = os.pread(self._file.fileno(), stop - start - len(data), start + len(data))
                if not more:
                    break
                data += more
        except OSError as error:
            raise BagError(f"cannot read {self.path}: {system_says(error)}") from error
        return data

    def count_expanded(self, size: int, of: str = "") -> None:
        """Count what a compressed part has expanded to.

        Each part has a limit of its own; a small file of many parts could still keep a reader busy
        for hours.

        :param size: of the part [bytes].
        :param of: what is expanded, for the error; empty: what the file holds.
        :raises BagError: if all parts together expand to more than a recording does.
        """
        self._expanded += size
        most = max(UNSUSPICIOUS, MOST_EXPANSION * self.size)
        if self._expanded > most:
            raise BagError(
                f"{of or f'what {self.path} holds'} expands to more than {most} bytes, over "
                f"{MOST_EXPANSION} times its size; expected a recording"
            )

    def count_messages(self, count: int) -> None:
        """Count messages, which take time and memory, however little a compressed file takes.

        :param count: of the messages that were found together.
        :raises BagError: if there are more of them than a recording of this size has.
        """
        most = max(MOST_MESSAGES, self.size)
        if count > most:
            raise BagError(
                f"{self.path} holds more than {most} messages in {self.size} bytes; expected a "
                f"recording"
            )

    def note(self, fault: str) -> None:
        """Note a fault of the file, each once, and a limited number of them."""
        if fault in self.notes or len(self.notes) > MOST_NOTES:
            return
        if len(self.notes) == MOST_NOTES:
            fault = f"{self.path.name} has more faults, which are not listed"
        self.notes.append(fault)

    def announce(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Tell the system what will be read, so that a disk fetches it all at once.

        :param ranges: where each begins and ends; of a long one the beginning is announced, the
            rest is then read ahead by itself.
        """
        for start, end in ranges:
            length = min(end - start, _ANNOUNCED)
            # A file system that takes no advice can be read all the same.
            with contextlib.suppress(OSError):
                os.posix_fadvise(self._file.fileno(), start, length, os.POSIX_FADV_WILLNEED)

    def _check_start(self) -> None:
        kind = "an MCAP file" if self._magic == MAGIC else "a rosbag2 file in SQLite"
        start = self.span(0, 16)
        if not start and self.notes:
            raise BagError(f"{self.path} is not a recording: {self.notes[0]}")
        if not start:
            raise BagError(
                f"{self.path} is empty (0 bytes); expected an MCAP recording: "
                f"the recorder was ended before it wrote anything"
            )
        if start[: len(self._magic)] != self._magic[: len(start)]:
            known = (*_OTHERS, *_TABLES)
            other = next((what for head, what in known if start.startswith(head)), None)
            found = f"it is {other}" if other else f"it begins with {start[:8]!r}"
            raise BagError(f"{self.path} is not {kind}: {found}; expected a bag or a CSV table")
        if len(start) < len(self._magic):
            raise BagError(
                f"{self.path} holds only the first {len(start)} bytes of {kind}; "
                f"nothing was recorded in it"
            )

    def _expand(self) -> None:
        """Expand a file that is compressed as a whole into a temporary file."""
        try:
            with os_errors_as(BagError, f"cannot expand {self.path}"), self._file as compressed:
                # close() closes it, which deletes it.
                self._file = tempfile.TemporaryFile(prefix="relay_autotune_")  # noqa: SIM115
                room = shutil.disk_usage(tempfile.gettempdir()).free - FREE_DISK
                with expanding() as zstandard:
                    decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW)
                    stream = decompressor.stream_reader(compressed)
                    while piece := stream.read(1 << 20):
                        self.count_expanded(len(piece), str(self.path))
                        if self._expanded > room:
                            raise BagError(
                                f"{self.path} expands to more than the {max(room, 0)} bytes that "
                                f"are free in {tempfile.gettempdir()}; set TMPDIR to a larger disk"
                            )
                        self._file.write(piece)
                        self._file.flush()
            if not self._expanded:
                self.notes.append(f"{self.path.name} ends before anything can be expanded")
        except DamageError as damage:
            # What came before is a recording that ends there.
            self.notes.append(f"{self.path.name} cannot be expanded to its end ({damage})")


@contextlib.contextmanager
def expanding(what: str = "") -> Iterator[ModuleType]:
    """Give zstandard, imported only where a compressed recording is met.

    :param what: cannot be expanded if it, or lz4, raises an error, for the message.
    :raises DamageError: in place of their errors.
    """
    import zstandard

    try:
        yield zstandard
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise DamageError(f"{what} ({error})" if what else str(error)) from None
