# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Removal of the shared memory that killed processes leave in a test run's domain, and beyond."""

from __future__ import annotations

import re
import sys
import time
from contextlib import suppress
from pathlib import Path

from relay_autotune.cli.own_nodes import free_domain, ports

__all__ = [
    "free_domain",
    "mapped_segments",
    "release_unfinished",
    "remove_leftovers",
    "remove_unmapped",
]

SHARED_MEMORY = Path("/dev/shm")
# A port is created, sized and made ready in one go, of which a busy machine may make seconds [s].
_UNFINISHED_AFTER = 5.0
# How its first word says that it is ready, and that it never will be.
_READY, _CORRUPTED = 2, 3


def mapped_segments(pid: int) -> set[Path]:
    """Return the shared memory of Fast DDS that a process maps."""
    try:
        maps = Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return set()
    return {Path(name) for name in re.findall(r"/dev/shm/(?:sem\.)?fastrtps_\w+", maps)}


def remove_leftovers(domain: int, segments: set[Path]) -> None:
    """Remove the leftovers of killed processes, once no process of the domain is alive.

    :param domain: the domain of this run.
    :param segments: segments that the killed processes had mapped, their own and their peers'.
    """
    for path in segments:
        # Segments belong to participants of the domain, which have all ended. But all domains
        # share the ports from 7000 on, and a running process may use a killed one's port.
        port = "_port" in path.name
        if not (port and any(path in mapped_segments(pid) for pid in _processes())):
            _remove(path)
    # A process that only sends does not map the semaphore of a port.
    for path in SHARED_MEMORY.glob("*fastrtps_port*"):
        number = re.search(r"fastrtps_port(\d+)", path.name)
        if number and int(number.group(1)) in ports(domain):
            _remove(path)


def remove_unmapped(segments: set[Path]) -> None:
    """Remove those segments of a killed process that no other process maps.

    A process may be killed while it holds the lock of a port, and the port's next user would wait.
    """
    for path in segments.difference(*map(mapped_segments, _processes())):
        _remove(path)


def release_unfinished() -> None:
    """Mark the ports as corrupted whose creator was killed before they were ready.

    Whoever opens such a port waits for ever, and all domains share those from 7000 on: one process
    that was ended in its start stopped every node of the machine. A marked one is made anew.
    """
    for path in SHARED_MEMORY.glob("fastrtps_port*[0-9]"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime < _UNFINISHED_AFTER:
                continue
            with path.open("r+b", buffering=0) as file:
                word = file.read(4)
                if not word:
                    file.truncate(1)
                elif len(word) == 4 and int.from_bytes(word, sys.byteorder) < _READY:
                    file.seek(0)
                    file.write(_CORRUPTED.to_bytes(4, sys.byteorder))


def _processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def _remove(path: Path) -> None:
    name = path.name.removeprefix("sem.").removesuffix("_mutex").removesuffix("_el")
    for belonging in (name, f"{name}_el", f"sem.{name}_mutex"):
        with suppress(OSError):
            (SHARED_MEMORY / belonging).unlink()
