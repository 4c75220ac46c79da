# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A port of the shared memory whose creator was killed does not stop the nodes that open it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from ros_domain import SHARED_MEMORY, free_domain, release_unfinished

from relay_autotune.cli.own_nodes import ports

NODE = "import rclpy; rclpy.init(); rclpy.create_node('any'); rclpy.shutdown()"


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def opens(pid: int, path: Path) -> bool:
    for link in Path(f"/proc/{pid}/fd").iterdir():
        # A file may be closed meanwhile.
        with suppress(FileNotFoundError):
            if link.readlink() == path:
                return True
    return False


@pytest.mark.parametrize("left", [b"", bytes(52400)], ids=["not sized", "not made ready"])
def test_a_node_that_waits_for_a_port_of_a_killed_process_goes_on(left: bytes) -> None:
    with free_domain() as domain:
        # That of the user's messages of the first node.
        port = SHARED_MEMORY / f"fastrtps_port{ports(domain)[11]}"
        port.write_bytes(left)
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }  # fmt: skip
        with subprocess.Popen([sys.executable, "-c", NODE], env=environment) as node:
            try:
                until(lambda: opens(node.pid, port), "the node opens the port")
                # Young ones may still be made.
                release_unfinished()
                assert port.read_bytes() == left
                os.utime(port, (0.0, 0.0))
                release_unfinished()
                assert node.wait(60.0) == 0
            finally:
                node.kill()
