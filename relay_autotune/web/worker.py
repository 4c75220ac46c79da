# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A thread that computes what pages ask for, such that no question can hold up another one.

How long a design takes is known only afterwards: a law that runs a thousand times in a dead time
takes a hundred times as long as others. So what computes for longer makes way for what is new,
and begins again later, with more time; and there is a limit.
"""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

from relay_autotune.errors import TuningError

_Result = TypeVar("_Result")
_Work = Callable[[], object]
# How long to wait for a question where nothing is worth computing ahead [s].
_PAUSE = 0.25
_COMPUTING_NICE = 10
# Time after which a computation makes way for another one [s]: most designs take less.
_TURN = 0.5
# Time after which a computation is given up [s].
_LONGEST = 20.0


# No code on the way may take these for errors of its own.
class _MakeWay(BaseException):
    """Something else is to be computed first."""


class _GiveUp(BaseException):
    """The computation takes too long."""


def yield_to_nodes(nice: int) -> None:
    """Let the nodes of a loop, which may need the same processor, go before this thread.

    Linux has a priority for each thread, and a policy under which one that wakes up interrupts
    no other.

    :param nice: how far to step back, 1 to 19.
    """
    this = threading.get_native_id()
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, this, nice)
        os.sched_setscheduler(this, os.SCHED_BATCH, os.sched_param(0))


@dataclass(eq=False)
class _Item:
    """Something to compute.

    :param work: computes it; it may be called again.
    :param turn: how long it may keep others waiting [s].
    :param future: gets the result.
    """

    work: _Work
    turn: float
    future: Future[Any] = field(default_factory=Future)


class Worker:
    """Compute one thing at a time: what is asked for, and in between what may be asked.

    :param ahead: returns what to compute while nothing is asked for; None: nothing.
    :param turn: time after which a computation makes way for another one [s].
    :param longest: time after which a computation is given up [s].
    """

    def __init__(
        self,
        ahead: Callable[[], _Work | None] = lambda: None,
        turn: float = _TURN,
        longest: float = _LONGEST,
    ) -> None:
        self._ahead = ahead
        self._turn = turn
        self._longest = longest
        self._items: list[_Item] = []
        self._current: _Item | None = None
        self._stopping = threading.Lock()
        self._since = 0.0
        self._open = True
        self._asked = threading.Event()
        # It holds nothing that would have to be put in order, so it may end with the process.
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    def ask(self, work: Callable[[], _Result]) -> Future[_Result]:
        """Compute something; it is left out if it is cancelled before.

        :param work: computes it; it may be stopped anywhere, and called again.
        """
        item = _Item(work, self._turn)
        self._items.append(item)
        self._asked.set()
        return item.future

    def tend(self) -> None:
        """Stop what computes for too long; to be called now and then by another thread."""
        with self._stopping:
            item = self._current
            if item is None:
                return
            ran = time.monotonic() - self._since
            others = [i.turn for i in self._items if i is not item and not i.future.cancelled()]
            # What is asked for the first time waits for no more than one turn.
            allowed = self._turn if others and min(others) < item.turn else item.turn
            if ran > self._longest:
                self._stop(_GiveUp)
            elif others and (item.future.cancelled() or ran > allowed):
                self._stop(_MakeWay)

    def _stop(self, why: type[BaseException] | None) -> None:
        # Raised in that thread after the function of C that it is in; None takes it back.
        number, given = ctypes.c_ulong(self._thread.ident or 0), ctypes.py_object(why)
        raises = ctypes.pythonapi.PyThreadState_SetAsyncExc
        raises(number, given if why is not None else None)

    def close(self) -> None:
        """Compute nothing more; what is computed right now is finished."""
        self._open = False
        self._asked.set()

    def _run(self) -> None:
        yield_to_nodes(_COMPUTING_NICE)
        while self._open:
            # One that comes at the very end: the item is still there, and is computed again.
            with suppress(_MakeWay, _GiveUp):
                item = self._next()
                if item is not None:
                    self._compute(item)

    def _next(self) -> _Item | None:
        self._asked.clear()
        for item in list(self._items):
            if item.future.cancelled():
                self._items.remove(item)
        if self._items:
            # Those that took longer stand behind; among equals the first one comes first.
            return min(self._items, key=lambda item: item.turn)
        work = self._ahead()
        if work is not None:
            return _Item(work, self._turn)
        self._asked.wait(_PAUSE)
        return None

    def _compute(self, item: _Item) -> None:
        self._since, self._current = time.monotonic(), item
        found: object = None
        error: BaseException | None = None
        try:
            found = item.work()
        except _MakeWay:
            if time.monotonic() - self._since > item.turn:
                item.turn *= 2.0
            return
        except _GiveUp:
            error = TuningError(
                f"this takes more than {self._longest:g} s to compute; gains for a law that runs "
                f"less often take less"
            )
        except BaseException as why:  # noqa: BLE001  it belongs to whoever asked
            error = why
        finally:
            with self._stopping:
                self._current = None
                self._stop(None)
        # Only now, so that it can be cancelled until the end.
        if item.future.set_running_or_notify_cancel():
            if error is None:
                item.future.set_result(found)
            else:
                item.future.set_exception(error)
        if item in self._items:
            self._items.remove(item)
