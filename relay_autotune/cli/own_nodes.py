# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Nodes that a command starts for itself; they end with the command, however that ends."""

from __future__ import annotations

import ctypes
import fcntl
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from relay_autotune.cli.terminal import Working
from relay_autotune.errors import RelayAutotuneError

PROGRAM = "tune_loop"
# How long nodes may take to start on a busy machine [s]; one that has ended is not waited for.
START_WITHIN = 240.0
# How long a node may take to end: relay_node sends its last command first [s].
_END_WITHIN = 8.0
# prctl's request that a process gets a signal when its parent ends.
_PR_SET_PDEATHSIG = 1
# What stands before the text in a line of a node's log, and in the one of its program.
_PREFIX = re.compile(r"\[[A-Z]+\] \[[0-9.]+\] \[\S+\]: |\w+_node: ")


def namespace_of_joint(controller: str, joint: str) -> str:
    """Return the namespace of the nodes that tune a joint, which no other joint has.

    It is the same each time, so that the next tune puts right what a loss of power has left of a
    verification.

    :param controller: full name of the controller's node.
    :param joint: name of the joint, any text.
    """
    # Characters that a name cannot have, as two underscores in a row, stand as _x, their number
    # and z. So does an underscore that would begin such a text.
    escaped = re.sub(
        r"[^0-9A-Za-z_]|_(?![0-9A-Za-z])|_(?=x[0-9a-f]+z)",
        lambda found: f"_x{ord(found[0]):x}z",
        f"_{joint}",
    )
    return f"{controller}/tune{escaped}"


class OwnNodes:
    """Start nodes as processes of the command, and end all of them with the block.

    They are not in the terminal's group, so that Ctrl-C reaches the command alone, which ends the
    tune in order. If the command itself is killed, each of them gets SIGTERM from the system, and
    `relay_node` sends the safe command. They end in the order in which they were started.
    """

    def __init__(self) -> None:
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._logs: dict[str, IO[bytes]] = {}

    def __enter__(self) -> OwnNodes:
        return self

    def start(self, name: str, arguments: Sequence[str]) -> int:
        """Start a node, and return the id of its process.

        :param name: of its executable.
        :param arguments: its arguments for ROS.
        """
        # Loaded before the fork: after it only few calls are allowed.
        prctl = ctypes.CDLL(None).prctl
        run = f"from relay_autotune.start import {name}; raise SystemExit({name}())"
        log = tempfile.TemporaryFile()  # noqa: SIM115  it is closed at the end of the block
        self._logs[name] = log
        self._running[name] = subprocess.Popen(
            [sys.executable, "-c", run, "--ros-args", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=lambda: prctl(_PR_SET_PDEATHSIG, signal.SIGTERM),
        )
        return self._running[name].pid

    def log(self, name: str) -> str:
        """Return what a node has logged.

        :param name: of its executable.
        """
        file = self._logs[name].fileno()
        # A plain read would move the place at which the node writes.
        return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")

    def end(self, name: str) -> None:
        """End one node before the others, if it was started.

        :param name: of its executable.
        """
        if (process := self._running.pop(name, None)) is not None:
            with Working(f"ending {name}"):
                _end([process])

    def why_lost(self, only: str = "") -> str:
        """Return which of them has ended by itself, with its last line; empty: none has.

        :param only: the one that is looked at; empty: all.
        """
        for name, process in self._running.items():
            if only in ("", name) and (status := process.poll()) is not None:
                lines = [_PREFIX.sub("", line) for line in self.log(name).strip().splitlines()]
                if status >= 0:
                    return f"{name} has ended: {lines[-1] if lines else f'status {status}'}"
                by = f"{name} was ended by signal {-status} ({signal.strsignal(-status)})"
                return f'{by}, after its line "{lines[-1]}"' if lines else by
        return ""

    def __exit__(self, *_: object) -> None:
        with Working("ending the nodes"):
            _end(self._running.values())
        for log in self._logs.values():
            log.close()


def _end(processes: Collection[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + _END_WITHIN
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def free_domain() -> Iterator[int]:
    """Take a domain from 1 to 101 whose lock is free and whose ports are unused.

    :raises RelayAutotuneError: if there is none.
    """
    folder = Path(tempfile.gettempdir()) / "relay_autotune_domains"
    folder.mkdir(exist_ok=True)
    with suppress(OSError):
        folder.chmod(0o777)
    candidates = list(range(1, 102))
    random.SystemRandom().shuffle(candidates)
    for domain in candidates:
        with (folder / f"{domain}.lock").open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if not _is_used(domain):
                yield domain
                return
    raise RelayAutotuneError("no free ROS domain between 1 and 101: end what uses them")


def ports(domain: int) -> range:
    """Return the UDP ports of a domain, by the rule of the DDS standard."""
    return range(7400 + 250 * domain, 7400 + 250 * (domain + 1))


def _is_used(domain: int) -> bool:
    # The first participants of a domain listen at these ports, whoever started them.
    for offset in (10, 12):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", ports(domain)[offset]))
            except OSError:
                return True
    return False
