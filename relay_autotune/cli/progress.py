# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a command says while something takes long."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import ExitStack, suppress

from relay_autotune.cli.layout import width
from relay_autotune.text import TOLD_EVERY, duration

# Time after which a terminal is first told what is being done [s]: several short works in a row
# must not be silent together.
_SOON = 0.3
# Time before the first share of a work is shown, and between two of them [s].
_PATIENCE = 1.0
_INTERVAL = 0.2


class StatusLine:
    """What is done or waited for, on standard error: in place on a terminal, else line by line."""

    def __init__(self) -> None:
        self.in_place = sys.stderr.isatty()
        self._shown = False

    def __call__(self, status: str) -> None:
        """Show a sentence."""
        text = f"\r\x1b[K{status[: width() - 1]}" if self.in_place else f"{status}\n"
        # The work goes on even if this cannot be written.
        with suppress(OSError):
            sys.stderr.write(text)
            sys.stderr.flush()
        self._shown = True

    def clear(self) -> None:
        """Remove the line of a terminal, so that something else can be written."""
        if self._shown and self.in_place:
            with suppress(OSError):
                sys.stderr.write("\r\x1b[K")
                sys.stderr.flush()
            self._shown = False


class ProgressLine:
    """The share of a work that is done; on a terminal only.

    :param what: what is being done.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._next = time.monotonic() + _PATIENCE
        self._line = StatusLine()

    def __call__(self, done: int, total: int) -> None:
        """Show how much is done of how much."""
        if not self._line.in_place or total <= 0 or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + _INTERVAL
        self._line(f"{self._what}: {100.0 * min(done / total, 1.0):.0f} %")

    def clear(self) -> None:
        """Remove the line, so that something else can be written."""
        self._line.clear()


class Stages:
    """Say each second on a terminal what the computation of a model is at, until the block ends.

    :param before: a line that is shown until then.
    """

    def __init__(self, before: ProgressLine) -> None:
        self._before = before
        self._stack = ExitStack()
        self._working: Working | None = None

    def __call__(self, stage: str) -> None:
        """Note what begins."""
        if not sys.stderr.isatty():
            return
        if self._working is None:
            self._before.clear()
            self._working = self._stack.enter_context(Working("computing the model"))
        self._working.at(stage)

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        self._before.clear()


class Working:
    """Say each second on standard error what is being done, until the block ends.

    :param what: what is being done.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._stage = ""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._tell, name="progress", daemon=True)

    def __enter__(self) -> Working:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def at(self, stage: str) -> None:
        """Note what the work is at; any thread may call it.

        :param stage: such as ``comparing structures``.
        """
        self._stage = f": {stage}"

    def _tell(self) -> None:
        began, line = time.monotonic(), StatusLine()
        wait = min(_SOON, TOLD_EVERY) if line.in_place else TOLD_EVERY
        while not self._over.wait(wait):
            wait = TOLD_EVERY
            line(f"{self._what}, {duration(time.monotonic() - began)}{self._stage}")
        line.clear()
