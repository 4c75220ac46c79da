# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Signals that end a process, and output that nobody takes."""

from __future__ import annotations

import os
import pty
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from relay_autotune.nodes.lifetime import ending_signals, never_wait_for, signal_name


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reader, writer = os.pipe()
    yield reader, writer
    os.close(reader)
    os.close(writer)


def test_all_that_would_end_a_process_are_among_them() -> None:
    found = ending_signals()
    ends = {"HUP", "INT", "QUIT", "ABRT", "ALRM", "TERM", "USR1", "USR2", "IO", "TSTP", "RTMAX"}
    assert {signal.Signals[f"SIG{name}"] for name in ends} <= found
    # Nobody can catch these; a defect would come again for ever; the others end nothing.
    never = {"KILL", "STOP", "SEGV", "BUS", "FPE", "ILL", "CHLD", "CONT", "WINCH", "TTOU"}
    assert not {signal.Signals[f"SIG{name}"] for name in never} & found
    # Python itself ignores it, so that a write to a pipe that is gone is an error and no end.
    assert signal.SIGPIPE not in found


def test_what_was_ignored_from_the_start_stays_so_but_for_those_of_a_shell() -> None:
    numbers = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT)
    before = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    try:
        found = ending_signals()
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
    assert signal.SIGHUP not in found
    assert {signal.SIGINT, signal.SIGQUIT} <= found


def test_every_signal_has_a_name() -> None:
    assert signal_name(signal.SIGHUP) == "SIGHUP"
    assert signal_name(signal.SIGRTMIN + 3) == "SIGRTMIN+3"
    assert all(signal_name(number) for number in ending_signals())


def fill(output: int) -> int:
    """Write until nothing more is taken; return how much was."""
    taken = 0
    with pytest.raises(BlockingIOError):
        while True:
            taken += os.write(output, b"x" * 512)
    return taken


def test_a_full_pipe_holds_up_nobody_and_only_this_process(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    shared = os.dup(writer)
    undo = never_wait_for(writer)
    assert fill(writer) >= 4096
    # Whoever shares the pipe goes on as before.
    assert os.get_blocking(shared)
    os.read(reader, 65536)
    assert os.write(writer, b"again") == 5
    undo()
    assert os.get_blocking(writer)
    os.close(shared)


def test_a_paused_terminal_holds_up_nobody() -> None:
    window, inside = pty.openpty()
    never_wait_for(inside)
    assert os.isatty(inside)
    os.write(window, b"\x13")
    fill(inside)
    os.write(window, b"\x11")
    while select.select([window], [], [], 0.1)[0]:
        os.read(window, 4096)
    assert select.select([], [inside], [], 30.0)[1], "it takes no more"
    assert os.write(inside, b"again") == 5
    os.close(window)
    with pytest.raises(OSError, match="Input/output error"):
        os.write(inside, b"gone")
    os.close(inside)


def test_a_socket_holds_up_nobody() -> None:
    """Such as the one that systemd gives to a service; it cannot be opened again."""
    ours, theirs = socket.socketpair()
    undo = never_wait_for(ours.fileno())
    assert fill(ours.fileno()) > 0
    undo()
    assert os.get_blocking(ours.fileno())
    ours.close()
    theirs.close()


def test_a_file_and_what_is_not_open_are_left_alone(tmp_path) -> None:
    with (tmp_path / "log").open("wb") as log:
        never_wait_for(log.fileno())
        assert os.get_blocking(log.fileno())
        number = log.fileno()
    never_wait_for(number)()


@pytest.mark.long
def test_what_is_opened_later_takes_no_place_of_a_closed_output() -> None:
    """Else what is logged would go into a socket, or into the recording."""
    code = (
        "import sys, os; sys.argv[1:] = ['--help']\n"
        "from relay_autotune.start import csv_to_bag\n"
        "try:\n"
        "    csv_to_bag()\n"
        "finally:\n"
        "    print('said', file=sys.stderr)\n"
        "    file = os.open('/dev/zero', os.O_RDONLY)\n"
        "    os._exit(10 if file > 2 else 20)\n"
    )
    done = subprocess.run(["sh", "-c", 'exec "$0" -c "$1" >&- 2>&-', sys.executable, code])
    assert done.returncode == 10
