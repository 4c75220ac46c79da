# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Signals that end a process, and output that is not read.

A closed terminal sends SIGHUP and then refuses output. A terminal paused by Ctrl-S, or a pipe
without a reader, blocks a write for any time. Neither may end or delay a process whose last
command is in force.
"""

from __future__ import annotations

import os
import signal
import stat
from collections.abc import Callable
from contextlib import suppress

# The first two cannot be caught. The next four report a defect of the process itself; a handler
# would return to the same instruction for ever. The next four end nothing. The last two stop a
# background process that uses its terminal.
_OTHERS = {
    signal.SIGKILL, signal.SIGSTOP,
    signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL,
    signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH,
    signal.SIGTTIN, signal.SIGTTOU,
}  # fmt: skip
# These are obeyed even if the process was started with them ignored: a shell ignores the first two
# for the background jobs of a script. An ignored SIGHUP stays ignored, for nohup.
_ALWAYS = {signal.SIGINT, signal.SIGQUIT, signal.SIGTERM}


def ending_signals() -> set[int]:
    """Return the signals that would end or stop this process, and can be caught."""
    others = signal.valid_signals() - _OTHERS
    return {n for n in others if n in _ALWAYS or signal.getsignal(n) is not signal.SIG_IGN}


def signal_name(number: int) -> str:
    """Return the name of a signal, such as SIGHUP."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"SIGRTMIN+{number - signal.SIGRTMIN}"


def never_wait_for(output: int) -> Callable[[], None]:
    """Drop writes to a terminal or a pipe when they would block.

    The blocking mode belongs to the open file, which the process shares with its shell and others.
    So the file is opened once more, for this process alone. A regular file never blocks and is
    left unchanged.

    :param output: file descriptor, 1 or 2.
    :return: the function that undoes this.
    """
    try:
        if stat.S_ISREG(os.fstat(output).st_mode):
            return lambda: None
        before, waited = os.dup(output), os.get_blocking(output)
    except OSError:
        # The descriptor is not open.
        return lambda: None
    try:
        own = os.open(f"/proc/self/fd/{output}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError:
        # A socket (systemd's journal) or a file of another user cannot be opened again.
        os.set_blocking(output, False)
    else:
        os.dup2(own, output)
        os.close(own)

    def undo() -> None:
        with suppress(OSError):
            os.dup2(before, output)
            os.set_blocking(output, waited)
            os.close(before)

    return undo
