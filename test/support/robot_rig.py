# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A robot under a stand-in for ros2_control as a process, and tune_loop beside it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from loop_rig import LATCHED, Process, Rig
from robot_interfaces import interfaces
from std_msgs.msg import String

ROBOT = Path(__file__).parent / "robot.py"
# Controller, joint and further words for each robot.
TUNED = {
    "base": ("wheel_controller", "left_wheel", "--within", "0", "4"),
    "chain": ("wheel_controller", "left_wheel", "--within", "0", "4"),
    "arm": ("arm_controller", "arm_2"),
    "followed": ("arm_controller", "arm_2"),
    "trajectory": ("arm_controller", "arm_2"),
}


class Robot:
    """A robot, and tune_loop beside it."""

    def __init__(self, rig: Rig, kind: str = "base", **parameters: Any) -> None:
        self.rig = rig
        self.controller, self.joint, *self.words = TUNED[kind]
        rig.environment |= interfaces() | {"HOME": str(rig.folder)}
        self.active = rig.listen("/active", String, LATCHED)
        given = [f"{self.controller}:{name}:={value}" for name, value in parameters.items()]
        words = [word for each in given for word in ("-p", each)]
        command = [sys.executable, str(ROBOT), kind, "--ros-args", *words]
        self.process = rig._begin("robot", command, None)
        rig.until(lambda: self.active, "the robot")

    def gains(self) -> list[float]:
        names = (f"gains.{self.joint}.{name}" for name in "pid")
        return self.rig.values(self.controller, *names)

    def history(self) -> list[str]:
        """Return who was active, from the start to now."""
        return [message.data for message in self.active]

    def order(self, trouble: str) -> None:
        mouth = self.rig.node.create_publisher(String, "/trouble", LATCHED)
        self.rig.until(mouth.get_subscription_count, "the robot")
        mouth.publish(String(data=trouble))

    def tune(self, *words: str) -> Process:
        given = ("--controller", self.controller, "--joint", self.joint, *self.words, *words)
        return self.rig.start_command("tune_loop", "--yes", "--wait", "30", *given)
