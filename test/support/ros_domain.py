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
    :param segments: what the killed processes had mapped.
    """
    numbers = ports(domain)
    for path in segments:
        if "_port" not in path.name:
            _remove(path)
    for path in SHARED_MEMORY.glob("*fastrtps_port*"):
        number = re.search(r"fastrtps_port(\d+)", path.name)
        if number and int(number.group(1)) in numbers:
            _remove(path)


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
        path.with_name(f"{path.name}_el").unlink()
