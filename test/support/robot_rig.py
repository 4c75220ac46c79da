# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A robot under a stand-in for ros2_control as a process, and tune_loop beside it."""

from __future__ import annotations

import sys
from pathlib import Path

from loop_rig import LATCHED, Process, Rig
from robot_interfaces import interfaces
from std_msgs.msg import String

ROBOT = Path(__file__).parent / "robot.py"
WORDS = (
    "--controller", "wheel_controller", "--joint", "left_wheel", "--within", "0", "4", "--yes",
    "--wait", "30",
)  # fmt: skip
GAINS = tuple(f"gains.left_wheel.{name}" for name in "pid")


class Robot:
    """A robot, and tune_loop beside it."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        rig.environment |= interfaces() | {"HOME": str(rig.folder)}
        self.active = rig.listen("/active", String, LATCHED)
        self.process = rig._begin("robot", [sys.executable, str(ROBOT)], None)
        rig.until(lambda: self.active, "the robot")

    def gains(self) -> list[float]:
        return self.rig.values("wheel_controller", *GAINS)

    def history(self) -> list[str]:
        """Return who was active, from the start to now."""
        return [message.data for message in self.active]

    def order(self, trouble: str) -> None:
        mouth = self.rig.node.create_publisher(String, "/trouble", LATCHED)
        self.rig.until(mouth.get_subscription_count, "the robot")
        mouth.publish(String(data=trouble))

    def tune(self, *words: str) -> Process:
        return self.rig.start_command("tune_loop", *WORDS, *words)
