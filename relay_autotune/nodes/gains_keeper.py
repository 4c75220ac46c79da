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
import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup

from relay_autotune.control.controller import LARGEST_GAIN
from relay_autotune.control.gains_history import (
    KEPT,
    KNOWN,
    Entry,
    GainSet,
    GainsHistory,
    HistoryError,
    Standing,
    Work,
)
from relay_autotune.errors import RelayAutotuneError, system_says
from relay_autotune.nodes.gains_place import Place, controller_text
from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.reasons import Code, reason_of
from relay_autotune.text import visible

_VERSION = 1
# A file of ours is smaller [B]: some two thousand sets, each of a few names and numbers.
_LARGEST = 2_000_000
# Length to which a text of a file is cut in a message.
_TEXT_LENGTH = 80


class JournalError(RelayAutotuneError):
    """A journal that cannot be read, written or locked."""


class GainsJournal:
    """The file of one controller's gains.

    Node, domain, loop and command name the file: each loop has its own.

    :param folder: folder of the file; created if missing.
    :param node: fully qualified name of the node.
    :param domain: the ROS domain: node names are unique only within a domain.
    :param loop: what the node controls, such as its measurement.
    :param command: topic of its commands.
    :raises JournalError: if another process uses the file.
    """

    def __init__(self, folder: Path, node: str, domain: int, loop: str, command: str) -> None:
        within = f".domain{domain}" if domain else ""
        # Topics as a whole could be too long for the name of a file.
        which = hashlib.sha256(f"{loop} {command}".encode()).hexdigest()[:8]
        # A node name never contains a dot, so the replacement is unique.
        self.path = folder / f"gains{node.replace('/', '.')}{within}.{which}.json"
        self._loop = loop
        self._lock = threading.Lock()
        self._newest = 0
        self._held: int | None = None
        # A folder that is not writable is reported by `saving`; some file systems have no locks.
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
                f"another process has {self.path}: a second {node} controls this loop; end it, or "
                "give this one another record_directory"
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
        path = self.path
        try:
            with path.open("rb") as file:
                text = file.read(_LARGEST + 1)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise _unreadable(path, system_says(error)) from error
        if len(text) > _LARGEST:
            raise _unreadable(path, f"it has more than {_LARGEST} bytes")
        try:
            found = json.loads(text)
            version, loop = found["version"], found["loop"]
            history = _history_of(found)
        except (
            ValueError, KeyError, TypeError, AttributeError, RecursionError,
        ) as error:  # fmt: skip
            raise _unreadable(path, f"{type(error).__name__}: {_short(error)}") from error
        if version != _VERSION:
            raise _unreadable(path, f"it is of version {_short(version)}, expected {_VERSION}")
        if loop != self._loop:
            raise JournalError(
                f"{path} is of the loop {_short(loop)!r}, found {self._loop!r}: remove the file, "
                "which is not where it was made"
            )
        return history

    def saving(self, history: GainsHistory) -> Callable[[], None]:
        """Return what writes a state and waits until it is on the disk; any thread may call it.

        A state is skipped once this was called for a later one. It raises JournalError if it
        cannot be written; the previous state stays on the disk.

        :param history: the state.
        """
        self._newest += 1
        return partial(self._save, history, self._newest)

    def _save(self, history: GainsHistory, ticket: int) -> None:
        document = {"version": _VERSION, "loop": self._loop, **vars(history)}
        text = json.dumps(document, indent=1, allow_nan=False, default=_plain) + "\n"
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
                    f"the gains cannot be kept in {self.path}: {system_says(error)}; make "
                    "the folder writable, or give another record_directory"
                ) from error


def _unreadable(path: Path, why: str) -> JournalError:
    return JournalError(
        f"{path} is not a journal of gains ({why}): remove it to start with the gains of the "
        "parameters"
    )


def _plain(value: GainSet | Entry | Standing | Work) -> Any:
    """Return a part of a history as JSON has it."""
    if isinstance(value, GainSet):
        return value.by_name()
    return vars(value) if isinstance(value, Entry) else value.value


def _history_of(found: dict[str, Any]) -> GainsHistory:
    def gains(value: dict[str, Any]) -> GainSet:
        for name, number in value.items():
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                raise ValueError(f"{name} is no number")
            if abs(number) > LARGEST_GAIN:
                raise ValueError(f"{name} is beyond {LARGEST_GAIN:g}")
        return GainSet.of(value)

    def entry(value: dict[str, Any]) -> Entry:
        return Entry(gains(value["gains"]), Standing(value["standing"]))

    def optional(value: Any, made: Any) -> Any:
        return None if value is None else made(value)

    def several(name: str, made: Any, most: int) -> Any:
        if len(found[name]) > most:
            raise ValueError(f"it has {len(found[name])} sets in {name}, expected at most {most}")
        return tuple(made(each) for each in found[name])

    return GainsHistory(
        given=optional(found["given"], gains),
        in_force=optional(found["in_force"], entry),
        before=several("before", entry, KEPT),
        failed=several("failed", gains, KNOWN),
        doubtful=several("doubtful", gains, KNOWN),
        work=Work(found["work"]),
    )


def _short(text: object) -> str:
    """Return a text of a file in one short line."""
    return visible(str(text)[:_TEXT_LENGTH])


# Time between attempts when the place of the gains does not answer [s].
_ASK_AGAIN = 1.0


class GainsKeeper:
    """Apply gains, revert them, and mark those that are proven or failed.

    The journal is written first: it names the new gains before they are sent. So a change that
    cannot be stored is refused, and if the process is killed, its successor knows what to undo.

    :param node: the node.
    :param place: where the gains act.
    :param journal: where their history is kept.
    :param given: gains of the node's configuration.
    :param require: raises RelayAutotuneError for gains that may not be in force at present.
    :raises RelayAutotuneError: if the journal cannot be read.
    """

    def __init__(
        self,
        node: ServedNode,
        place: Place,
        journal: GainsJournal,
        given: GainSet | None,
        require: Callable[[GainSet], object],
    ) -> None:
        self._node = node
        self._place = place
        self._journal = journal
        self._require = require
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
            goal = found.within(self._is_allowed, present=True).cut_short()
            if goal.work is not found.work:
                self._goal = goal
                self._retry.reset()
        else:
            self.history = found.within(self._is_allowed, present=True).after_restart(given)
        if self._goal is None:
            try:
                journal.saving(self.history)()
            except JournalError as error:
                node.get_logger().error(str(error))

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
            now = await self._seen()
            await self._change(now, now.apply(gains))
            self.history = self.history.settled()
            kept = await self._kept(self.history)
        return f"{self._place.sentence(gains)}{kept}"

    async def revert(self) -> str:
        """Return to the previous whole set, and return a sentence for the user.

        :raises RelayAutotuneError: if there is no previous set, or it is not in force.
        """
        with self._alone():
            now = self._permitted()
            await self._change(now, now.revert())
        return f"{self._place.sentence(self.history.gains)} again"

    def before(self) -> str:
        """Say which gains :meth:`revert` would bring back.

        :raises RelayAutotuneError: if there are none, or another operation is in progress.
        """
        gains = self._permitted().revert().gains
        return controller_text(None if gains is None else self._place.controller_of(gains))

    def edit(self, gains: GainSet | None) -> None:
        """Note gains that are set by hand, before they are in force.

        :raises RelayAutotuneError: if they failed a verification, a change is in progress, or the
            journal cannot be written.
        """
        self._require_idle()
        wanted = self.history.edit(gains)
        if wanted is not self.history:
            # In this thread, since a parameter is set as soon as this returns.
            self._journal.saving(wanted)()
            self.history = wanted

    # Proof.

    async def begin_verification(self, gains: GainSet | None) -> None:
        """Begin the verification of gains, of which :meth:`end_verification` takes every end.

        :param gains: a whole set that is put in force for it; None: the gains in force.
        :raises RelayAutotuneError: as :meth:`apply`, or if no gains are in force.
        """
        with self._alone():
            now = await self._seen()
            wanted = now.verify(gains)
            if gains is None:
                await self._save(wanted)
                self.history = wanted
            else:
                await self._change(now, wanted)

    async def end_verification(self, passed: bool | None) -> str:
        """Take the end of a verification: unless they passed, unproven gains are taken back.

        :param passed: None: it was cut short.
        :return: a sentence for the user, or "".
        """
        if self.history.work is not Work.VERIFY:
            return ""
        left, now = self.history.gains, self._permitted()
        goal = now.passed() if passed else now.cut_short() if passed is None else now.fail()
        if goal.gains == left:
            self.history = goal
            return await self._kept(goal)
        # Gains before journal: the journal already marks these gains as not trusted.
        await self._settle(goal)
        return self._open() or f"; {self._place.sentence(self.history.gains)} again"

    async def abandon(self) -> None:
        """Undo an unfinished change, before the end of the process, if the gains outlive it."""
        goal = self._permitted().cut_short()
        self._abandoned = self._place.outlives and goal.work is not self.history.work
        await self._settle(goal if self._abandoned else None)
        if left := self._open():
            self._node.get_logger().error(f"{left.lstrip('; ')}, once this node runs again")

    # Helpers.

    def _require_idle(self) -> None:
        if self._busy:
            raise HistoryError(Code.GAINS_AT_WORK())

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        self._require_idle()
        if self._goal is not None:
            raise HistoryError(Code.BRINGING_BACK(open=self._open()))
        self._busy = True
        try:
            yield
        finally:
            self._busy = False

    async def _change(self, now: GainsHistory, wanted: GainsHistory) -> None:
        """Put other gains in force.

        :param now: the history before it, which comes back if they cannot be.
        :param wanted: the history with them.
        :raises RelayAutotuneError: if they are not in force.
        """
        await self._save(wanted)
        self.history = wanted
        try:
            await self._place.put(wanted.gains)
        except RelayAutotuneError as error:
            await self._settle(now)
            why = reason_of(error)
            raise type(error)(replace(why, said=f"{why}{self._open()}")) from error
        if self._abandoned:
            raise HistoryError("the node ends: the gains of before are brought back")

    async def _seen(self) -> GainsHistory:
        """Return the history with the gains that the place has, whoever set them."""
        found = await self._place.read()
        return self.history if found is None else self.history.observe(found)

    def _permitted(self) -> GainsHistory:
        """Return the history with those earlier gains that the present limits allow."""
        return self.history.within(self._is_allowed)

    def _is_allowed(self, gains: GainSet) -> bool:
        try:
            self._require(gains)
        except RelayAutotuneError as error:
            self._node.get_logger().warning(
                f"earlier gains are left out: {_short(gains)}: {_short(error)}"
            )
            return False
        return True

    def _open(self) -> str:
        """Return a sentence on gains that are still to be restored, or ""."""
        if self._goal is None:
            return ""
        return (
            f"; {self._place.name} is to get {self._goal.gains} back as soon as it answers"
            f"{f' ({self._reported})' if self._reported else ''}"
        )

    async def _settle(self, wanted: GainsHistory | None = None) -> None:
        """Apply the goal state to the place; if it does not answer, try again later.

        :param wanted: a new goal, of gains that this node has sent itself; None: that of before.
        """
        if wanted is not None:
            self._goal, self._anothers = wanted, False
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
            self._node.get_logger().info(f"{self._place.sentence(self.history.gains)} again")

    # The disk.

    async def _save(self, history: GainsHistory) -> None:
        """Save a state while the callbacks go on; return once it is on the disk.

        :raises JournalError: if it cannot be written.
        """
        await self._node.computed(self._journal.saving(history))

    async def _kept(self, history: GainsHistory) -> str:
        try:
            await self._save(history)
        except RelayAutotuneError as error:
            return f"; {error}"
        return ""
