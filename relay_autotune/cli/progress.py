# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a command says while something takes long."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress
from types import TracebackType

from relay_autotune.text import duration

# Time before the first line, and between two of them [s].
_PATIENCE = 1.0
_INTERVAL = 0.2
# Interval at which work is told that has no measure of its progress [s].
_TOLD_EVERY = 0.8


class ProgressLine:
    """A line on standard error that is updated in place and removed at the end.

    :param what: what is being done.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._next = time.monotonic() + _PATIENCE
        self._shown = False
        self._terminal = sys.stderr.isatty()

    def __call__(self, done: int, total: int) -> None:
        """Show how much is done of how much."""
        if not self._terminal or total <= 0 or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + _INTERVAL
        self._shown = True
        share = 100.0 * min(done / total, 1.0)
        sys.stderr.write(f"\r\x1b[K{self._what}: {share:.0f} %")
        sys.stderr.flush()

    def clear(self) -> None:
        """Remove the line, so that something else can be written."""
        if self._shown:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
            self._shown = False


class Working:
    """Say each second on standard error what is being done, until the block ends.

    On a terminal the line is updated in place and removed at the end.

    :param what: what is being done.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._tell, name="progress", daemon=True)
        self._terminal = sys.stderr.isatty()

    def __enter__(self) -> Working:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()

    def _tell(self) -> None:
        began, shown = time.monotonic(), False
        # The work goes on even if this cannot be written.
        with suppress(OSError):
            while not self._over.wait(_TOLD_EVERY):
                told = f"{self._what}, {duration(time.monotonic() - began)}"
                sys.stderr.write(f"\r\x1b[K{told}" if self._terminal else f"{told}\n")
                sys.stderr.flush()
                shown = True
            if shown and self._terminal:
                sys.stderr.write("\r\x1b[K")
                sys.stderr.flush()
