"""Signals that end a process, and output that nobody takes.

A terminal that is closed sends SIGHUP and then refuses what is written to it; one that is paused
by Ctrl-S, or a pipe that nobody reads, makes a write wait for as long as it likes. Nothing of that
may end or hold up a process whose last command is in force.
"""

from __future__ import annotations

import os
import signal
import stat
from collections.abc import Callable
from contextlib import suppress

# Nobody can catch the first two. The next four come from a defect in the process itself, at an
# instruction that would be tried again for ever. The next four end nothing. The last two stop a
# process in the background that uses its terminal.
_OTHERS = {
    signal.SIGKILL, signal.SIGSTOP,
    signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL,
    signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH,
    signal.SIGTTIN, signal.SIGTTOU,
}  # fmt: skip
# These are obeyed even where the process was started with them ignored, as a shell does with the
# first two in the background of a script; SIGHUP then is not, which is what nohup is for.
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
    """Let writes to a terminal or a pipe be dropped where they would wait.

    Whether a write waits belongs to the open file, which the process shares with the shell that
    started it and whatever else writes there. So it is opened once more, for this process alone.
    What is written to a file is left as it is: nobody has to read it.

    :param output: number of the file, 1 or 2.
    :return: what undoes it.
    """
    try:
        if stat.S_ISREG(os.fstat(output).st_mode):
            return lambda: None
        before, waited = os.dup(output), os.get_blocking(output)
    except OSError:
        # It is not open at all.
        return lambda: None
    try:
        own = os.open(f"/proc/self/fd/{output}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError:
        # A socket, such as that of systemd, cannot be opened again, nor what belongs to another
        # user.
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
