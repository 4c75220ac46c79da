# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A process whose middleware never lets it go ends by itself, with the status that was due."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

# What Fast DDS does now and then: all signals blocked, and the interpreter held.
STUCK = """
import ctypes, os, signal, sys
from relay_autotune.nodes import lifetime
def stuck(node):
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    ctypes.PyDLL(None).sleep(600)
lifetime.Node.destroy_node = stuck
lifetime.LEAVE_WITHIN = 0.1
class Node(lifetime.ServedNode):
    def work(self, *, idle):
        if {fails}:
            raise ZeroDivisionError("a defect")
        os.kill(os.getpid(), signal.SIGTERM)
    def end(self, reason):
        print("the safe command is out")
def create():
    node = Node("stuck")
    node.defer(lambda: None)
    node.create_timer(0.01, lambda: None)
    return node
sys.exit(lifetime.run(create, "stuck", []))
"""


@pytest.mark.long
@pytest.mark.parametrize(("fails", "status"), [(False, 0), (True, 1)])
def test_a_node_that_cannot_leave_the_graph_ends_all_the_same(fails: bool, status: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", STUCK.format(fails=fails)],
        env=os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
        capture_output=True, text=True, timeout=60.0, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGTERM, signal.SIG_DFL),
    )  # fmt: skip
    assert done.returncode == status, done.stderr
    # A pipe is written in blocks, and the last one has to come out, too.
    assert done.stdout == "the safe command is out\n"
    assert ("ZeroDivisionError: a defect" in done.stderr) == fails
