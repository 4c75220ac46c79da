"""The shared memory that killed processes leave, and the domain that a test run takes."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from relay_autotune.nodes.domain import free_domain, ports

__all__ = ["free_domain", "mapped_segments", "remove_leftovers"]

SHARED_MEMORY = Path("/dev/shm")


def mapped_segments(pid: int) -> set[Path]:
    """Return the shared memory of Fast DDS that a process maps."""
    try:
        maps = Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return set()
    return {Path(name) for name in re.findall(r"/dev/shm/(?:sem\.)?fastrtps_\w+", maps)}


def remove_leftovers(domain: int, segments: set[Path]) -> None:
    """Remove what killed processes have left, once no process of the domain lives.

    :param domain: the domain that this run holds.
    :param segments: what the killed processes had mapped, their own and those of their peers.
    """
    for path in segments:
        # Segments belong to participants of the domain, which have ended; but the ports from 7000
        # on are those of all domains, and a living process may use the one of a killed one.
        port = "_port" in path.name
        if not (port and any(path in mapped_segments(pid) for pid in _processes())):
            _remove(path)
    # A port's semaphore is mapped by nobody who merely sends.
    for path in SHARED_MEMORY.glob("*fastrtps_port*"):
        number = re.search(r"fastrtps_port(\d+)", path.name)
        if number and int(number.group(1)) in ports(domain):
            _remove(path)


def _processes() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def _remove(path: Path) -> None:
    name = path.name.removeprefix("sem.").removesuffix("_mutex").removesuffix("_el")
    for belonging in (name, f"{name}_el", f"sem.{name}_mutex"):
        with suppress(OSError):
            (SHARED_MEMORY / belonging).unlink()
