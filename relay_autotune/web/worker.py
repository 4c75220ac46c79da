# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""One thread that computes what pages ask for at once, and in between what they may ask next."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import TypeVar

_Result = TypeVar("_Result")
_Work = Callable[[], object]
# How long to wait for a question where nothing is worth computing ahead [s].
_PAUSE = 0.25
_NICE = 10


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


class Worker:
    """Compute one thing after the other: first what is asked for, then what may be asked.

    :param ahead: returns what to compute while nothing is asked for; None: nothing.
    """

    def __init__(self, ahead: Callable[[], _Work | None]) -> None:
        self._queue: queue.SimpleQueue[_Work] = queue.SimpleQueue()
        self._ahead = ahead
        self._open = True
        # It holds nothing that would have to be put in order, so it may end with the process.
        threading.Thread(target=self._run, name="page", daemon=True).start()

    def ask(self, work: Callable[[], _Result]) -> Future[_Result]:
        """Compute something before all that may wait; it is left out if it is cancelled before.

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

        self._queue.put(done)
        return future

    def close(self) -> None:
        """Compute nothing more; what is computed right now is finished."""
        self._open = False
        self._queue.put(lambda: None)

    def _run(self) -> None:
        yield_to_nodes(_NICE)
        while self._open:
            try:
                work: _Work | None = self._queue.get_nowait()
            except queue.Empty:
                work = self._ahead()
            if work is None:
                try:
                    work = self._queue.get(timeout=_PAUSE)
                except queue.Empty:
                    continue
            if self._open:
                work()
