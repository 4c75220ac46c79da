# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Progress of a long computation, shown only on a terminal."""

from __future__ import annotations

import sys
import time

# Time before the first line, and between two of them [s].
_PATIENCE = 1.0
_INTERVAL = 0.2


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
