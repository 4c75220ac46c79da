# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The single owner of a controller's gains: applies them and keeps a journal on disk.

The journal survives a kill and a loss of power. Each state replaces the previous one in one step:
write a temporary file, fsync it, rename it over the old file, fsync the folder. A lock lets one
process at a time use the file.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup

from relay_autotune.control.gains_history import (
    AT_WORK,
    Entry,
    GainSet,
    GainsHistory,
    HistoryError,
    Standing,
    Work,
)
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.nodes.gains_place import Place
from relay_autotune.nodes.lifetime import STEADY, ServedNode

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


# Time between attempts when the place of the gains does not answer [s].
_ASK_AGAIN = 1.0


class GainsKeeper:
    """Apply gains, revert them, and mark those that are proven or failed.

    The journal is written first: it names the new gains before they are sent. So if the process
    is killed, its successor knows what to undo.

    :param node: the node.
    :param place: where the gains act.
    :param journal: where their history is kept.
    :param given: gains of the node's configuration.
    :raises RelayAutotuneError: if the journal cannot be read.
    """

    def __init__(
        self, node: ServedNode, place: Place, journal: GainsJournal, given: GainSet | None
    ) -> None:
        self._node = node
        self._place = place
        self._journal = journal
        self._busy = self._abandoned = False
        # The state that the place must still reach, and whether it may hold foreign gains.
        self._goal: GainsHistory | None = None
        self._anothers = True
        self._retry = node.create_timer(
            _ASK_AGAIN,
            self._again,
            callback_group=ReentrantCallbackGroup(),
            clock=STEADY,
            autostart=False,
        )
        self._reported = ""
        found = journal.load()
        if found is None:
            self.history = GainsHistory.begun(given)
        elif place.outlives:
            self.history = found
            if (goal := found.after_interruption()) is not found:
                self._goal = goal
                self._retry.reset()
        else:
            self.history = found.after_restart(given)
        if self._goal is None:
            self._write(self.history)

    @property
    def is_at_work(self) -> bool:
        """True while gains are being put in force or verified, or are still to be undone."""
        return self._busy or self.history.work is not Work.NOTHING or self._goal is not None

    # Requests.

    async def apply(self, gains: GainSet) -> str:
        """Apply gains and return a sentence for the user.

        :param gains: the whole set.
        :raises RelayAutotuneError: if they are not in force; the previous gains are restored as
            soon as the place answers.
        """
        with self._alone():
            now = self._observed(await self._place.read())
            wanted = now.apply(gains)
            await self._save(wanted)
            self.history = wanted
            try:
                await self._place.put(gains)
            except RelayAutotuneError as error:
                self._goal, self._anothers = now, False
                await self._settle()
                raise type(error)(f"{error}{self._open()}") from error
            if self._abandoned:
                raise HistoryError("the node ends: the gains of before are brought back")
            self.history = wanted.settled()
            kept = await self._kept(self.history)
        return f"{self._place.said(gains)}{kept}"

    async def revert(self) -> str:
        """Return to the previous whole set, and return a sentence for the user.

        :raises RelayAutotuneError: if there is no previous set, or it is not in force.
        """
        with self._alone():
            wanted = self.history.revert()
            await self._place.put(wanted.gains)
            self.history = wanted
            kept = await self._kept(wanted)
        return f"{self._place.said(wanted.gains)} again{kept}"

    def require_editable(self, gains: GainSet | None) -> None:
        """Refuse a change by hand that is not allowed now.

        :raises RelayAutotuneError: if the gains failed a verification, or a change is in progress.
        """
        self._require_idle()
        self.history.edit(gains)

    def edited(self, gains: GainSet | None) -> None:
        """Note gains that were set by hand and are in force already."""
        self.history = self.history.edit(gains)
        self._node.compute(self._writing(self.history), self._wrote)

    # Proof.

    async def begin_verification(self) -> GainSet:
        """Begin the verification of the gains in force and return them.

        :raises RelayAutotuneError: if no gains are in force, or the journal cannot be written.
        """
        with self._alone():
            wanted = self._observed(await self._place.read()).verify()
            await self._save(wanted)
            self.history = wanted
            assert wanted.gains is not None
            return wanted.gains

    async def end_verification(self, passed: bool | None) -> str:
        """Take the verdict, and restore the previous gains if these failed.

        :param passed: None: the verification ended without a verdict, and the gains stay.
        :return: a sentence for the user, or "".
        """
        if self.history.work is not Work.VERIFY:
            return ""
        if passed is not False:
            self.history = self.history.passed() if passed else self.history.settled()
            return await self._kept(self.history)
        # Gains before journal: the journal already marks these gains as not trusted.
        self._goal, self._anothers = self.history.fail(), False
        await self._settle()
        return self._open() or f"; {self._place.said(self.history.gains)} again"

    async def abandon(self) -> None:
        """Undo an unfinished change, before the end of the process, if the gains outlive it."""
        goal = self.history.after_interruption()
        if self._place.outlives and goal is not self.history:
            self._abandoned = True
            self._goal, self._anothers = goal, False
            await self._settle()

    # Helpers.

    def _require_idle(self) -> None:
        if self._busy:
            raise HistoryError(AT_WORK)

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        self._require_idle()
        if self._goal is not None:
            raise HistoryError(f"gains of before are being brought back{self._open()}")
        self._busy = True
        try:
            yield
        finally:
            self._busy = False

    def _observed(self, found: GainSet | None) -> GainsHistory:
        return self.history if found is None else self.history.observe(found)

    def _open(self) -> str:
        """Return a sentence on gains that are still to be restored, or ""."""
        if self._goal is None:
            return ""
        return (
            f"; {self._place.name} is to get {self._goal.gains} back as soon as it answers"
            f"{f' ({self._reported})' if self._reported else ''}"
        )

    async def _settle(self) -> None:
        """Apply the goal state to the place; if it does not answer, try again later."""
        goal, left = self._goal, self.history.gains
        if goal is None:
            return
        try:
            if self._anothers and goal.gains is not None and left is not None:
                found = await self._place.read()
                if found is not None and not found.is_mixture(goal.gains, left):
                    self._node.get_logger().error(
                        f"{self._place.name} has gains that someone else set, {found}: they stay"
                    )
                    goal = goal.observe(found)
            await self._place.put(goal.gains)
        except RelayAutotuneError as error:
            self._say(str(error))
            self._retry.reset()
            return
        self.history, self._goal, self._reported = goal, None, ""
        if kept := await self._kept(goal):
            self._node.get_logger().error(kept.lstrip("; "))

    def _say(self, problem: str) -> None:
        if problem != self._reported:
            self._reported = problem
            self._node.get_logger().error(f"the gains of before are not in force: {problem}")

    async def _again(self) -> None:
        """Try once more to reach the goal state, unless a request is at work."""
        self._retry.cancel()
        if self._goal is None:
            return
        if self._busy:
            self._retry.reset()
            return
        self._busy = True
        try:
            await self._settle()
        finally:
            self._busy = False
        if not self._open():
            self._node.get_logger().info(f"{self._place.said(self.history.gains)} again")

    # The disk.

    def _writing(self, history: GainsHistory) -> Callable[[], None]:
        ticket = self._journal.ticket()
        return lambda: self._journal.save(history, ticket)

    def _write(self, history: GainsHistory) -> None:
        try:
            self._writing(history)()
        except RelayAutotuneError as error:
            self._node.get_logger().error(str(error))

    def _wrote(self, error: Exception | None) -> None:
        if error is not None:
            self._node.get_logger().error(str(error))

    async def _save(self, history: GainsHistory) -> None:
        """Save a state while the callbacks go on; return once it is on the disk.

        :raises JournalError: if it cannot be written.
        """
        await self._node.computed(self._writing(history))

    async def _kept(self, history: GainsHistory) -> str:
        try:
            await self._save(history)
        except RelayAutotuneError as error:
            return f"; {error}"
        return ""
