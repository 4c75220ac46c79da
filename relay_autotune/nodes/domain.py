# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A free ROS domain, so that a demo or a test does not meet another loop."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from relay_autotune.errors import RelayAutotuneError


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
