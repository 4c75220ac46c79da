# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Reading a rosbag2 file in SQLite: its channels, and the messages that are wanted."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from relay_autotune.bag.bag_file import BagFile
from relay_autotune.bag.definitions import find_definition
from relay_autotune.bag.limits import LARGEST_CHUNK, LARGEST_DEFINITION, MOST_DECLARATIONS
from relay_autotune.bag.locate import Messages
from relay_autotune.bag.mcap_records import Channel
from relay_autotune.bag.source import SQLITE_MAGIC
from relay_autotune.errors import BagError

# Size of the messages that are handed on together [bytes].
_BATCH = 4 << 20


class SqliteFile(BagFile):
    """A ``.db3`` file of rosbag2 open for reading.

    It holds definitions of types since Iron; for an older one, those of the installed packages
    count.

    :param path: the file; it may be compressed as a whole with zstd.
    :param largest: size that a message may have [bytes]; a larger one ends the reading.
    :raises BagError: if it is missing, unreadable or no such file.
    """

    def __init__(self, path: Path, largest: int = LARGEST_CHUNK) -> None:
        super().__init__(path, largest, SQLITE_MAGIC)
        if path.with_name(path.name + "-wal").exists():
            self.notes.append(f"{path.name}-wal holds the end of the recording and is not read")
        try:
            self._database = self._opened()
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, largest)
            self._database.text_factory = lambda text: text.decode("utf-8", "replace")
            # A file may define views and functions that never end.
            self._database.execute("PRAGMA trusted_schema = OFF")
            self.channels = self._declared()
        except sqlite3.Error as error:
            self.close()
            raise self._unreadable(error) from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        with suppress(AttributeError):
            self._database.close()
        super().close()

    def _opened(self) -> sqlite3.Connection:
        descriptor = self._source.fileno()
        if os.fstat(descriptor).st_nlink:
            # By its descriptor: what was checked is what is read. Nothing is written to it.
            return sqlite3.connect(
                f"file:/proc/self/fd/{descriptor}?mode=ro&immutable=1", uri=True
            )
        # What was expanded has no name by which SQLite could open it.
        database = sqlite3.connect(":memory:")
        database.deserialize(self._source.read(0, self.size))
        return database

    def _unreadable(self, error: Exception) -> BagError:
        return BagError(f"{self.path} cannot be read as a rosbag2 file in SQLite: {error}")

    def _tables(self) -> set[str]:
        made = self._database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'")
        return {str(n) for n, sql in made if "VIRTUAL" not in str(sql).upper().split("(")[0]}

    def _declared(self) -> dict[int, Channel]:
        tables = self._tables()
        if not {"topics", "messages"} <= tables:
            raise BagError(
                f"{self.path} is an SQLite file without the tables topics and messages; expected "
                "a recording of rosbag2"
            )
        definitions: dict[str, tuple[str, bytes]] = {}
        if "message_definitions" in tables:
            found = self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions "
                f"LIMIT {MOST_DECLARATIONS}"
            )
            for kind, encoding, text in found:
                if len(str(text)) <= LARGEST_DEFINITION:
                    definitions[str(kind)] = (str(encoding), str(text).encode())
        channels = {}
        topics = self._database.execute(
            f"SELECT id, name, type, serialization_format FROM topics LIMIT {MOST_DECLARATIONS}"
        )
        for number, name, kind, encoding in topics:
            known = definitions.get(str(kind))
            if known is None or not known[1]:
                with suppress(BagError):
                    known = ("ros2msg", find_definition(str(kind)).text.encode())
            form, text = known or ("", b"")
            channels[int(number)] = Channel(
                int(number), str(name), str(kind), str(encoding), form, text, {}
            )
        return channels

    def read(self, channels: Collection[int]) -> Iterator[tuple[int, int, Messages]]:
        """Yield the messages of some channels, a run of them at a time.

        :param channels: their ids.
        :return: the channel; the number of messages that came before the run; the messages.
        """
        wanted = sorted(set(channels))
        marks = ", ".join("?" * len(wanted))
        query = (
            "SELECT topic_id, timestamp, data FROM messages "
            f"WHERE topic_id IN ({marks}) ORDER BY timestamp, id"
        )
        rows: list[tuple[int, int, bytes]] = []
        before = size = 0
        try:
            for topic, time, data in self._database.execute(query, wanted):
                if not (isinstance(time, int) and isinstance(data, bytes)):
                    raise BagError(f"{self.path} holds a message without binary data or time")
                rows.append((topic, time, data))
                size += len(data)
                if size >= _BATCH:
                    yield from self._runs(rows, before)
                    before, size, rows = before + len(rows), 0, []
        except (sqlite3.Error, MemoryError) as error:
            self._note(f"{self.path.name} cannot be read to its end ({error})")
        yield from self._runs(rows, before)

    def _runs(
        self, rows: list[tuple[int, int, bytes]], before: int
    ) -> Iterator[tuple[int, int, Messages]]:
        for channel in dict.fromkeys(row[0] for row in rows):
            own = [(k, row) for k, row in enumerate(rows) if row[0] == channel]
            end = np.cumsum([len(row[2]) for _, row in own], dtype=np.int64)
            time: Any = np.array([row[1] for _, row in own], dtype=np.int64)
            messages = Messages(
                b"".join(row[2] for _, row in own),
                np.array([k for k, _ in own], dtype=np.int64),
                time,
                time,
                np.append(0, end[:-1]),
                end,
            )
            for part in self._as_sent(channel, messages):
                yield channel, before, part
