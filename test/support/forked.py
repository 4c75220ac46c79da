# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Nodes as processes that start at once: forked from one that has loaded their modules.

Loading takes two thirds of a second of a processor, some five hundred times in the tests. In all
else such a fork is the process that it stands for: its arguments, its environment, its signals,
its exit status and its place in the ROS graph. Commands and the demo start as users start them.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

_NODES = ("relay", "identifier", "plant", "controller")
# What Python and the loader read at the start of a process alone.
_AT_START = ("PYTHONPATH", "LD_LIBRARY_PATH")


def can_fork(words: list[str], environment: dict[str, str]) -> bool:
    """Return whether a fork would be what the command is: a node, or code instead of one."""
    same = all(environment.get(name) == os.environ.get(name) for name in _AT_START)
    is_node = Path(words[0]).name.removesuffix("_node") in _NODES
    return same and (is_node or words[:2] == [sys.executable, "-c"])


class Forked:
    """A process as :class:`subprocess.Popen` gives it.

    :param words: a node, or Python with `-c` and code, and its arguments.
    :param environment: all of it.
    :param log: file of its output.
    """

    def __init__(self, words: list[str], environment: dict[str, str], log: Path) -> None:
        self.returncode: int | None = None
        self._status = log.with_suffix(".status")
        # as with any other start, what this process ignores is ignored
        ignored = [
            n for n in (signal.SIGHUP, signal.SIGINT) if signal.getsignal(n) == signal.SIG_IGN
        ]
        asked = {"words": words, "environment": environment, "log": str(log), "ignored": ignored}
        server = _server()
        server.stdin.write(json.dumps(asked | {"status": str(self._status)}) + "\n")
        server.stdin.flush()
        self.pid = int(server.stdout.readline())

    def poll(self) -> int | None:
        if self.returncode is None and self._status.exists():
            self.returncode = int(self._status.read_text())
        return self.returncode

    def wait(self, timeout: float) -> int:
        deadline = time.monotonic() + timeout
        while (status := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(0.005)
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            # it may have ended just now
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)


@functools.cache
def _server() -> Any:
    server = subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    # its end, too, so that the processor's time of all is counted
    atexit.register(server.communicate)
    return server


def _serve() -> dict[str, Any]:
    """Fork as asked until the input ends; in each new process return what it is asked to be."""
    for line in sys.stdin:
        asked: dict[str, Any] = json.loads(line)
        if os.fork() == 0:
            pid = os.fork()
            if pid == 0:
                return asked
            print(pid, flush=True)
            ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            made = Path(asked["status"] + ".new")
            made.write_text(str(ended))
            made.rename(asked["status"])
            os._exit(0)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
    with suppress(ChildProcessError):
        while os.wait():
            pass
    os._exit(0)


def _become(asked: dict[str, Any]) -> int:
    """Take the place of a node, and return its exit status."""
    for number, path, flags in (
        (0, os.devnull, os.O_RDONLY),
        (1, asked["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND),
    ):
        opened = os.open(path, flags)
        os.dup2(opened, number)
        os.close(opened)
    os.dup2(1, 2)
    os.environ.clear()
    os.environ.update(asked["environment"])
    for number in asked["ignored"]:
        signal.signal(number, signal.SIG_IGN)

    sys.argv = asked["words"]
    if sys.argv[1:2] == ["-c"]:
        del sys.argv[0]
        code = sys.argv.pop(1)
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
        return 0
    return int(getattr(import_module("relay_autotune.start"), Path(sys.argv[0]).name)())


if __name__ == "__main__":
    sys.path.pop(0)
    for name in _NODES:
        import_module(f"relay_autotune.nodes.{name}")
    sys.exit(_become(_serve()))
