"""How far a long work has come, on a terminal alone."""

from __future__ import annotations

import sys
import time

# A work shorter than this shows nothing [s]; a longer one shows it so often [s].
_PATIENCE = 1.0
_INTERVAL = 0.2


class ProgressLine:
    """A line on standard error that is written again and again, and taken away at the end.

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
        """Take the line away, so that something else can be written."""
        if self._shown:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
            self._shown = False
