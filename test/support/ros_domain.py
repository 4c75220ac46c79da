"""A ROS domain that no other test run uses, and the shared memory that a killed process leaves."""

from __future__ import annotations

import fcntl
import os
import random
import re
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")


@contextmanager
def free_domain() -> Iterator[int]:
    """Take a domain from 1 to 101 whose lock nobody holds and whose ports nobody uses."""
    folder = Path(tempfile.gettempdir()) / "relay_autotune_domains"
    folder.mkdir(exist_ok=True)
    with suppress(OSError):
        folder.chmod(0o777)
    candidates = list(range(1, 102))
    random.SystemRandom().shuffle(candidates)
    for domain in candidates:
        lock = os.open(folder / f"{domain}.lock", os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        if _is_used(domain):
            os.close(lock)
            continue
        try:
            yield domain
        finally:
            os.close(lock)
        return
    raise RuntimeError("no free ROS domain between 1 and 101")


def _ports(domain: int) -> range:
    return range(7400 + 250 * domain, 7400 + 250 * (domain + 1))


def _is_used(domain: int) -> bool:
    # The first participants of a domain listen at these ports, whoever started them.
    for offset in (10, 12):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", _ports(domain)[offset]))
            except OSError:
                return True
    return False


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
    ports = _ports(domain)
    for path in segments:
        if "_port" not in path.name:
            _remove(path)
    for path in SHARED_MEMORY.glob("*fastrtps_port*"):
        number = re.search(r"fastrtps_port(\d+)", path.name)
        if number and int(number.group(1)) in ports:
            _remove(path)


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
        path.with_name(f"{path.name}_el").unlink()
