# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A robot under a stand-in for ros2_control: manager, controllers, and two wheels or an arm.

It does what the sources of ros2_control and ros2_controllers (branch jazzy) do, and shares no code
with them or with the package: strict switches, references that NaN leaves as they are, a state
that may miss a message. Cycles are 10 ms apart by their stamps; a busy machine makes up for late
ones, so that the joints and the law are the same on any machine.

    python3 robot.py [base|arm]

What happens is ordered on the topic /trouble: `refuse`, `die NAME`; who is active is told on
/active.
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass

import rclpy
from control_msgs.msg import MultiDOFCommand, MultiDOFStateStamped, SingleDOFState
from controller_manager_msgs.msg import ControllerState, HardwareInterface
from controller_manager_msgs.srv import ListControllers, ListHardwareInterfaces, SwitchController
from fopdt_plant import FopdtPlant
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

RATE = 100
PERIOD = 1.0 / RATE
# Late cycles that are made up for at a time.
MADE_UP = 20
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
DESCRIPTION = """<robot name="base">
  <joint name="left_wheel" type="continuous"><limit effort="20" velocity="6"/></joint>
  <joint name="arm_2" type="revolute">
    <limit lower="-1.3" upper="0.7" effort="20" velocity="6"/>
  </joint>
  <ros2_control name="base" type="system">
    <joint name="left_wheel">
      <command_interface name="effort">
        <param name="min">-4</param><param name="max">4</param>
      </command_interface>
    </joint>
  </ros2_control>
</robot>"""


class Wheel:
    """A wheel whose velocity follows the effort: an ultimate period of 0.5 s.

    :param velocity: at which it turns now.
    """

    GAIN, TAU, DEAD, NOISE = 2.0, 0.5, 0.14, 0.01

    def __init__(self, velocity: float) -> None:
        self.effort = velocity / self.GAIN
        self._plant = FopdtPlant(self.GAIN, self.TAU, self.DEAD)
        self._plant.command = self._plant.arrived = self.effort
        self._plant.output = velocity

    def measure(self, at: float, effort: float) -> float:
        return self._plant.advance(at, effort) + random.gauss(0.0, self.NOISE)


class Link:
    """A link of an arm whose position integrates a velocity that lags the effort.

    :param position: where it rests.
    """

    TAU, DELAY, NOISE = 0.3, 3, 0.0005

    def __init__(self, position: float) -> None:
        self.effort, self._velocity, self._position = 0.0, 0.0, position
        self._on_the_way = deque([0.0] * self.DELAY)

    def measure(self, at: float, effort: float) -> float:
        self._on_the_way.append(effort)
        held = self._on_the_way.popleft()
        left = math.exp(-PERIOD / self.TAU)
        away = self._velocity - held
        self._position += held * PERIOD + away * self.TAU * (1.0 - left)
        self._velocity = held + away * left
        return self._position + random.gauss(0.0, self.NOISE)


@dataclass(frozen=True)
class Kind:
    """What a robot has.

    :param controller: name of its pid_controller.
    :param measured: the state interface.
    :param joints: its joints, each at its reference.
    :param gains: p and i that it begins with.
    :param forward: the forwarding controllers, with the joints that they command.
    """

    controller: str
    measured: str
    joints: dict[str, float]
    gains: tuple[float, float]
    forward: dict[str, tuple[str, ...]]

    def joint(self, value: float) -> Wheel | Link:
        return Wheel(value) if self.measured == "velocity" else Link(value)


KINDS = {
    "base": Kind(
        "wheel_controller",
        "velocity",
        {"left_wheel": 2.0, "right_wheel": 2.0},
        (0.3, 0.6),
        {"forward_left": ("left_wheel",)},
    ),
    "arm": Kind(
        "arm_controller",
        "position",
        {"arm_1": 0.5, "arm_2": -0.3},
        (6.0, 0.0),
        {"forward_arm": ("arm_2", "arm_1")},
    ),
}


class PidController:
    """pid_controller with one state interface."""

    type_name = "pid_controller/PidController"

    def __init__(self, kind: Kind) -> None:
        self.name, self.joints = kind.controller, tuple(kind.joints)
        name, joints = self.name, self.joints
        self.needs = tuple(f"{joint}/effort" for joint in joints)
        self.node = Node(name)
        declare = self.node.declare_parameter
        declare("dof_names", list(joints))
        declare("reference_and_state_dof_names", list(joints))
        declare("command_interface", "effort")
        declare("reference_and_state_interfaces", [kind.measured])
        declare("enable_feedforward", False)
        for joint in joints:
            for key, value in (
                ("p", kind.gains[0]), ("i", kind.gains[1]), ("d", 0.0),
                ("u_clamp_max", 4.0), ("u_clamp_min", -4.0),
                ("antiwindup_strategy", "back_calculation"), ("tracking_time_constant", 0.0),
                ("save_i_term", True), ("feedforward_gain", 0.0), ("angle_wraparound", False),
            ):  # fmt: skip
                declare(f"gains.{joint}.{key}", value)
        self.read_gains()
        self.node.add_post_set_parameters_callback(lambda _: self.read_gains())
        count = len(joints)
        self.reference, self.error = list(kind.joints.values()), [0.0] * count
        self.integral = [kind.joint(value).effort for value in kind.joints.values()]
        self.told: MultiDOFCommand | None = None
        self.states = self.node.create_publisher(MultiDOFStateStamped, "~/controller_state", 100)
        self.node.create_subscription(MultiDOFCommand, "~/reference", self.hear, BEST_EFFORT)

    def read_gains(self) -> None:
        self.gains = [
            [
                self.node.get_parameter(f"gains.{joint}.{key}").value
                for key in ("p", "i", "d", "u_clamp_min", "u_clamp_max")
            ]
            for joint in self.joints
        ]

    def hear(self, message: MultiDOFCommand) -> None:
        # The values are taken by their place, whatever the names say.
        if len(message.dof_names) == len(message.values) == len(self.joints):
            message.values_dot[len(self.joints) - 1]
            self.told = message

    def activate(self, measured: dict[str, float]) -> None:
        self.told = None
        self.reference = [measured[joint] for joint in self.joints]
        for k, joint in enumerate(self.joints):
            if not self.node.get_parameter(f"gains.{joint}.save_i_term").value:
                self.integral[k] = 0.0
            self.error[k] = 0.0

    def update(self, stamp: float, measured: dict[str, float], commands: dict[str, float]) -> None:
        if self.told is not None:
            for k, value in enumerate(self.told.values):
                if not math.isnan(value):
                    self.reference[k] = value
            self.told = None
        state = MultiDOFStateStamped()
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(round(stamp * 1e9), 10**9)
        for k, joint in enumerate(self.joints):
            p, i, d, low, high = self.gains[k]
            error = self.reference[k] - measured[joint]
            wanted = p * error + self.integral[k] + d * (error - self.error[k]) / PERIOD
            output = min(max(wanted, low), high)
            if i:
                tracking = math.sqrt(d / i) if d else p / i
                self.integral[k] += PERIOD * (i * error + (output - wanted) / tracking)
            self.error[k] = error
            commands[f"{joint}/effort"] = output
            state.dof_states.append(
                SingleDOFState(
                    name=joint, reference=self.reference[k], feedback=measured[joint],
                    error=error, time_step=PERIOD, output=output,
                )
            )  # fmt: skip
        # The real-time publisher leaves a message out where it cannot have its lock.
        if random.random() > 0.005:
            self.states.publish(state)


class ForwardController:
    """forward_command_controller."""

    type_name = "forward_command_controller/ForwardCommandController"

    def __init__(self, name: str, needs: tuple[str, ...]) -> None:
        self.name, self.needs = name, needs
        self.node = Node(name)
        self.told: list[float] | None = None
        self.node.create_subscription(Float64MultiArray, "~/commands", self.hear, 10)

    def hear(self, message: Float64MultiArray) -> None:
        if all(map(math.isfinite, message.data)):
            self.told = list(message.data)

    def activate(self, measured: dict[str, float]) -> None:
        self.told = None

    def update(self, stamp: float, measured: dict[str, float], commands: dict[str, float]) -> None:
        if self.told is not None and len(self.told) == len(self.needs):
            commands.update(zip(self.needs, self.told, strict=True))


class Manager:
    """controller_manager, its hardware and its control loop."""

    def __init__(self, kind: Kind) -> None:
        self.measured = kind.measured
        self.controllers = [
            PidController(kind),
            *(
                ForwardController(name, tuple(f"{joint}/effort" for joint in joints))
                for name, joints in kind.forward.items()
            ),
        ]
        self.active = {kind.controller}
        self.refuses = False
        self.joints = {name: kind.joint(value) for name, value in kind.joints.items()}
        self.commands = {f"{name}/effort": joint.effort for name, joint in self.joints.items()}
        self.now = dict(kind.joints)
        self.start, self.count = time.time(), 0
        self.node = Node("controller_manager")
        node = self.node
        node.declare_parameter("update_rate", RATE)
        node.create_service(ListControllers, "~/list_controllers", self.list)
        node.create_service(ListHardwareInterfaces, "~/list_hardware_interfaces", self.hardware)
        node.create_service(SwitchController, "~/switch_controller", self.switch)
        self.joint_states = node.create_publisher(JointState, "joint_states", 100)
        self.told = node.create_publisher(
            String, "active", QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        self.description = node.create_publisher(String, "robot_description", LATCHED)
        self.description.publish(String(data=DESCRIPTION))
        node.create_subscription(String, "trouble", self.trouble, 10)
        node.create_timer(PERIOD, self.update)
        self.tell()

    def tell(self) -> None:
        self.told.publish(String(data=" ".join(sorted(self.active))))

    def trouble(self, message: String) -> None:
        what, _, name = message.data.partition(" ")
        if what == "refuse":
            self.refuses = True
        elif what == "die":
            self.active.discard(name)
            self.tell()

    def update(self) -> None:
        # A few at a time, so that nobody's queue overflows.
        for _ in range(MADE_UP):
            if PERIOD * (self.count + 1) > time.time() - self.start:
                return
            self.count += 1
            self.cycle(PERIOD * self.count)

    def cycle(self, at: float) -> None:
        self.now = measured = {
            name: joint.measure(at, self.commands[f"{name}/effort"])
            for name, joint in self.joints.items()
        }
        stamp = self.start + at
        for controller in self.controllers:
            if controller.name in self.active:
                controller.update(stamp, measured, self.commands)
        names = random.sample(list(measured), len(measured))
        state = JointState(name=names)
        setattr(state, self.measured, [measured[name] for name in names])
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(round(stamp * 1e9), 10**9)
        self.joint_states.publish(state)

    def list(
        self, _request: object, response: ListControllers.Response
    ) -> ListControllers.Response:
        for each in self.controllers:
            active = each.name in self.active
            response.controller.append(
                ControllerState(
                    name=each.name,
                    type=each.type_name,
                    state="active" if active else "inactive",
                    update_rate=RATE,
                    required_command_interfaces=each.needs,
                    claimed_interfaces=each.needs if active else [],
                )
            )
        return response

    def hardware(
        self, _request: object, response: ListHardwareInterfaces.Response
    ) -> ListHardwareInterfaces.Response:
        response.command_interfaces = [
            HardwareInterface(name=name, data_type="double", is_available=True)
            for name in self.commands
        ]
        return response

    def switch(
        self, request: SwitchController.Request, response: SwitchController.Response
    ) -> SwitchController.Response:
        response.message = self.why_not(request)
        response.ok = not response.message
        if response.ok:
            self.active -= set(request.deactivate_controllers)
            for each in self.controllers:
                if each.name in request.activate_controllers:
                    each.activate(self.now)
                    self.active.add(each.name)
            self.tell()
        return response

    def why_not(self, request: SwitchController.Request) -> str:
        """Return why a strict switch is refused; empty: it is not."""
        on, off = set(request.activate_controllers), set(request.deactivate_controllers)
        if request.strictness != SwitchController.Request.STRICT:
            return "this stand-in knows strict switches alone"
        if self.refuses:
            self.refuses = False
            return "the hardware does not allow that"
        if unknown := (on | off) - {each.name for each in self.controllers}:
            return f"{unknown} not loaded"
        if on & self.active:
            return f"{on & self.active} is active already"
        if off - self.active:
            return f"{off - self.active} is not active"
        after = self.active - off | on
        claimed = [n for each in self.controllers if each.name in after for n in each.needs]
        return (
            "two controllers would own one interface" if len(claimed) > len(set(claimed)) else ""
        )


def main() -> None:
    rclpy.init()
    manager = Manager(KINDS[sys.argv[1] if len(sys.argv) > 1 else "base"])
    executor = SingleThreadedExecutor()
    for node in (manager.node, *(each.node for each in manager.controllers)):
        executor.add_node(node)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    main()
