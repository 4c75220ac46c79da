# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The history of a controller's gains on disk; it survives a kill and a loss of power.

Each state replaces the previous one in one step: write a temporary file, fsync it, rename it over
the old file, fsync the folder. A lock lets one process at a time use the file.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import threading
from dataclasses import fields
from pathlib import Path
from typing import Any

from relay_autotune.control.gains_history import Entry, GainSet, GainsHistory, Standing, Work
from relay_autotune.errors import RelayAutotuneError

_VERSION = 1


class JournalError(RelayAutotuneError):
    """A journal that cannot be read, written or locked."""


class GainsJournal:
    """The file of one controller's gains.

    :param folder: folder of the file; created if missing.
    :param node: fully qualified name of the node, which names the file.
    :param domain: the ROS domain: node names are unique only within a domain.
    :param loop: what the node controls, such as its measurement; the file of another loop is
        refused.
    :raises JournalError: if another process uses the file.
    """

    def __init__(self, folder: Path, node: str, domain: int, loop: str) -> None:
        within = f".domain{domain}" if domain else ""
        # A node name never contains a dot, so the replacement is unique.
        self.path = folder / f"gains{node.replace('/', '.')}{within}.json"
        self._loop = loop
        self._lock = threading.Lock()
        self._newest = 0
        self._held: int | None = None
        # A folder that is not writable is reported by `save`; some file systems have no locks.
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            self._held = os.open(
                self.path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644
            )
        try:
            if self._held is not None:
                fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise JournalError(
                f"another process has {self.path}: a second {node} runs on this machine; end it, "
                "or give this one another record_directory"
            ) from None
        except OSError:
            self.close()

    def close(self) -> None:
        """Leave the file to other processes."""
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def load(self) -> GainsHistory | None:
        """Return the state saved last, None if there is no file.

        :raises JournalError: if the file is not a journal of this loop.
        """
        try:
            text = self.path.read_text(encoding="utf-8")
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, UnicodeDecodeError) as error:
            raise self._unreadable(str(error)) from error
        try:
            found = json.loads(text)
            version, loop = found["version"], found["loop"]
            history = _history_of(found)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise self._unreadable(f"{type(error).__name__}: {error}") from error
        if version != _VERSION:
            raise self._unreadable(f"it is of version {version!r}, expected {_VERSION}")
        if loop != self._loop:
            raise JournalError(
                f"{self.path} is of the loop {loop!r}, found {self._loop!r}: give another "
                "record_directory, or remove the file"
            )
        return history

    def ticket(self) -> int:
        """Return the number of the next state to save."""
        self._newest += 1
        return self._newest

    def save(self, history: GainsHistory, ticket: int) -> None:
        """Write a state and wait until it is on the disk; may be called by any thread.

        :param history: the state.
        :param ticket: its number; a state is skipped once a later ticket was issued.
        :raises JournalError: if it cannot be written; the previous state stays on the disk.
        """
        document = {"version": _VERSION, "loop": self._loop, **_values_of(history)}
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        new = self.path.with_suffix(".tmp")
        with self._lock:
            if ticket != self._newest:
                return
            try:
                with new.open("w", encoding="utf-8") as file:
                    file.write(text)
                    file.flush()
                    os.fsync(file.fileno())
                new.replace(self.path)
                folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                try:
                    os.fsync(folder)
                finally:
                    os.close(folder)
            except OSError as error:
                with contextlib.suppress(OSError):
                    new.unlink(missing_ok=True)
                raise JournalError(
                    f"the gains cannot be kept in {self.path}: {error.strerror or error}; make "
                    "the folder writable, or give another record_directory"
                ) from error

    def _unreadable(self, why: str) -> JournalError:
        return JournalError(
            f"{self.path} is not a journal of gains ({why}): remove it to start with the gains of "
            "the parameters"
        )


def _values_of(value: Any) -> Any:
    """Return a history, or a part of it, as JSON values."""
    if isinstance(value, GainSet):
        return value.by_name()
    if isinstance(value, (Standing, Work)):
        return value.value
    if isinstance(value, tuple):
        return [_values_of(each) for each in value]
    if value is None:
        return None
    return {field.name: _values_of(getattr(value, field.name)) for field in fields(value)}


def _history_of(found: dict[str, Any]) -> GainsHistory:
    def entry(value: dict[str, Any]) -> Entry:
        return Entry(GainSet.of(value["gains"]), Standing(value["standing"]))

    def optional(value: Any, made: Any) -> Any:
        return None if value is None else made(value)

    return GainsHistory(
        given=optional(found["given"], GainSet.of),
        in_force=optional(found["in_force"], entry),
        before=tuple(entry(each) for each in found["before"]),
        failed=tuple(GainSet.of(each) for each in found["failed"]),
        doubtful=tuple(GainSet.of(each) for each in found["doubtful"]),
        work=Work(found["work"]),
    )
