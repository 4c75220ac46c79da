# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""One thread that computes what pages ask for at once, and in between what they may ask next."""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

_Result = TypeVar("_Result")
_Entry = tuple[int, int, Callable[[], object]]
_NOW, _LATER = 0, 1


class Worker:
    """Compute one thing after the other: first what is asked for, then what may be asked."""

    def __init__(self) -> None:
        self._queue: queue.PriorityQueue[_Entry] = queue.PriorityQueue()
        self._order = itertools.count()
        self._open = True
        # It holds nothing that would have to be put in order, so it may end with the process.
        threading.Thread(target=self._run, name="page", daemon=True).start()

    def ask(self, work: Callable[[], _Result]) -> Future[_Result]:
        """Compute something before all that may wait.

        :param work: computes it.
        """
        future: Future[_Result] = Future()

        def done() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(work())
            except BaseException as error:  # noqa: BLE001  it belongs to whoever asked
                future.set_exception(error)

        self._queue.put((_NOW, next(self._order), done))
        return future

    def later(self, work: Callable[[], object]) -> None:
        """Compute something once nothing is asked for.

        :param work: computes it, and keeps it.
        """
        self._queue.put((_LATER, next(self._order), work))

    def close(self) -> None:
        """Compute nothing more; what is computed right now is finished."""
        self._open = False
        self._queue.put((_NOW, -1, lambda: None))

    def _run(self) -> None:
        while True:
            work = self._queue.get()[2]
            if not self._open:
                return
            work()
