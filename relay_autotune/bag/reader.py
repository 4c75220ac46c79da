# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Recordings on disk: which files they are, opened as one timeline, and their signals."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from relay_autotune.bag.bag_file import BagFile, McapFile, SqliteFile
from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.bag.signals import CLOCKS, Signal
from relay_autotune.bag.source import known_start, open_regular
from relay_autotune.bag.topics import Progress, Topics
from relay_autotune.errors import BagError, RelayAutotuneError, os_errors_as

_STORED = (".mcap", ".db3")
_TEXTS = (".csv", ".txt", ".dat", ".tsv", ".log")
# What can be read, in words.
READABLE = f"{', '.join(_STORED)}, or a table of numbers in {', '.join(_TEXTS)}"
# A file compressed as a whole, as rosbag2 and the zstd command name it.
_WHOLE = tuple([kind, end] for kind in _STORED for end in (".zstd", ".zst"))


def read(
    path: Path | str | Sequence[Path | str],
    columns: Sequence[str] | None = None,
    clock: str = CLOCKS[0],
) -> dict[str, Signal]:
    """Return columns of a recording as signals, by their names.

    :param path: a rosbag2 directory, an MCAP or ``.db3`` file, or a text with columns; or several
        of the first three that are one timeline.
    :param columns: names of topics, ``TOPIC:FIELD`` where a message holds several numbers, or of
        the text's columns; default: every topic of one number, every column but the time.
    :param clock: which time of a message counts, one of ``CLOCKS``; a text has but one.
    :raises SelectionError: if there is no such column.
    :raises BagError: if the recording cannot be read.
    """
    paths = paths_of(path)
    if is_text(paths[0]):
        # Imported here: it is not needed for a bag.
        from relay_autotune.bag.csv_file import read_columns

        return read_columns(paths[0], columns)
    with opened(paths, clock) as topics:
        return topics.signals(columns)


def paths_of(given: Path | str | Sequence[Path | str]) -> list[Path]:
    """Return the paths of a recording, at least one.

    :param given: one path, or several.
    :raises BagError: if it is something else.
    """
    parts = [given] if isinstance(given, Path | str) else given
    try:
        paths = [Path(part) for part in parts]
    except TypeError:
        paths = []
    if not paths:
        raise BagError(f"a recording is read from its path, a text, found {given!r:.80}")
    return paths


@contextmanager
def opened(
    paths: Sequence[Path],
    clock: str = CLOCKS[0],
    largest_chunk: int = LARGEST_CHUNK,
    progress: Progress | None = None,
) -> Iterator[Topics]:
    """Give the topics of bags that are one timeline, with their files open.

    :param paths: files, or folders of them.
    :param clock: which time of a message counts, one of ``CLOCKS``.
    :param largest_chunk: size of a chunk, or a message outside of chunks, beyond which it is left
        out [bytes].
    :param progress: called with the progress of reading.
    :raises BagError: if one cannot be read; faults of the files that were found are said with it.
    """
    with ExitStack() as stack:
        files = [
            stack.enter_context(_opened(file, largest_chunk))
            for part in paths
            for file in _data_files(part)
        ]
        topics = Topics(paths[0], files, clock, progress)
        try:
            yield topics
        except BagError as error:
            # The faults of the files may be the reason.
            amiss = [note for note in topics.notes if note not in str(error)]
            if not amiss:
                raise
            raise type(error)("; ".join((str(error), *amiss))) from error


def recordings_in(path: Path) -> list[Path]:
    """Return the recordings in a folder of them; empty: it is one itself, or holds none.

    A folder without a description is one recording where its files are one series, as those of a
    recorder that was killed are.

    :param path: a file or a folder.
    """
    if not os.access(path, os.R_OK) or not path.is_dir():
        return []
    entries = sorted(path.iterdir(), key=_natural)
    found = [e for e in entries if not e.name.startswith(".") and may_be_recording(e)]
    series = {re.sub(r"_\d+$", "", e.name.partition(".")[0]) for e in found if _named_so(e)}
    is_one = len(series) == 1 and all(map(_named_so, found))
    return [] if is_one or any(e.name == "metadata.yaml" for e in entries) else found


def may_be_recording(path: Path) -> bool:
    """Return whether a path is to be read, by its name or its first bytes.

    A path that is missing, damaged or of ROS 1 is, too: reading it tells what is wrong.

    :param path: a file or a folder, such as one of many that a pattern of the shell gave.
    """
    if path.is_dir():
        names = {entry.name for entry in path.iterdir()} if os.access(path, os.R_OK) else set()
        # A bag that lost its files still has its description.
        return "metadata.yaml" in names or not names or any(map(_named_so, map(Path, names)))
    if not path.exists() or _named_so(path) or path.suffix.lower() == _TEXTS[0]:
        return True
    try:
        with open_regular(path) as file:
            return _has_table(path, file) if is_text(path) else known_start(file.read(32))
    except RelayAutotuneError:
        return True


def is_text(path: Path) -> bool:
    """Return whether a path is called like a text with columns."""
    return path.suffix.lower() in _TEXTS


def _has_table(path: Path, file: BinaryIO) -> bool:
    """Return whether a text has rows of numbers: many are notes, or logs of what happened."""
    # Imported here: it is not needed for a bag.
    from relay_autotune.bag.text_table import TextTable

    try:
        return TextTable(path, file).is_sure
    except (BagError, UnicodeError, csv.Error):
        return False


def _named_so(path: Path) -> bool:
    return path.suffix in _STORED or path.suffixes[-2:] in _WHOLE


def _opened(path: Path, largest: int) -> BagFile:
    kind = SqliteFile if ".db3" in path.suffixes[-2:] else McapFile
    return kind(path, largest)


def _data_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    with os_errors_as(BagError, f"cannot read {path}"):
        entries = sorted(path.iterdir(), key=_natural)
    # The folder itself counts: a killed recorder's metadata.yaml is missing or out of date.
    plain = {entry.name for entry in entries if entry.suffix in _STORED}
    # A recorder that was killed while it compressed leaves both.
    files = [e for e in entries if e.name in plain or (_named_so(e) and e.stem not in plain)]
    if not files:
        found = ", ".join(entry.name for entry in entries[:5])
        held = f"holds no .mcap or .db3 file, but {found}" if found else "is empty"
        raise BagError(f"the directory {path} {held}; expected a rosbag2 directory")
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    # Split bags are numbered without leading zeros: bag_2 comes before bag_10.
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
