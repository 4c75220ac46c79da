# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A robot under a stand-in for ros2_control: manager, controllers, and two wheels or an arm.

It does what the sources of ros2_control and ros2_controllers (branch jazzy) do, and shares no code
with them or with the package: strict switches, chains, references that NaN leaves as they are, a
state that may miss a message. Cycles are 10 ms apart by their stamps; a busy machine makes up for
late ones, so that the joints and the law are the same on any machine.

    python3 robot.py [base|chain|arm|followed|trajectory]

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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import rclpy
from control_msgs.msg import (
    JointTrajectoryControllerState,
    MultiDOFCommand,
    MultiDOFStateStamped,
    SingleDOFState,
)
from controller_manager_msgs.msg import ControllerState, HardwareInterface
from controller_manager_msgs.srv import ListControllers, ListHardwareInterfaces, SwitchController
from fopdt_plant import FopdtPlant
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from toolbox_pid import ToolboxPid
from trajectory_msgs.msg import JointTrajectory

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

    velocity = math.nan

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
        self.effort, self.velocity, self._position = 0.0, 0.0, position
        self._on_the_way = deque([0.0] * self.DELAY)

    def measure(self, at: float, effort: float) -> float:
        self._on_the_way.append(effort)
        held = self._on_the_way.popleft()
        left = math.exp(-PERIOD / self.TAU)
        away = self.velocity - held
        self._position += held * PERIOD + away * self.TAU * (1.0 - left)
        self.velocity = held + away * left
        return self._position + random.gauss(0.0, self.NOISE)


@dataclass(frozen=True)
class Kind:
    """What a robot has.

    :param controller: name of the controller of its joints.
    :param measured: the state interface.
    :param joints: its joints, each at its reference.
    :param gains: p and i that it begins with.
    :param forward: the forwarding controllers, with the joints that they command.
    :param above: name of the controller that writes the references; empty: none does.
    :param follows: True if the controller follows trajectories.
    """

    controller: str
    measured: str
    joints: dict[str, float]
    gains: tuple[float, float]
    forward: dict[str, tuple[str, ...]]
    above: str = ""
    follows: bool = False

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
KINDS["chain"] = replace(KINDS["base"], above="base_controller")
KINDS["followed"] = replace(KINDS["arm"], above="path_controller")
KINDS["trajectory"] = replace(
    KINDS["arm"],
    follows=True,
    forward={"forward_arm": ("arm_2", "arm_1"), "forward_one": ("arm_2",)},
)

# What both types of controllers declare of each joint.
GAINS = {
    "i": 0.0, "d": 0.0, "i_clamp_max": math.inf, "i_clamp_min": -math.inf,
    "u_clamp_max": 4.0, "u_clamp_min": -4.0, "tracking_time_constant": 0.0,
}  # fmt: skip


def toolbox_pid(node: Node, joint: str) -> ToolboxPid:
    """Return the law with the gains that a node has for a joint."""
    values = node.get_parameters_by_prefix(f"gains.{joint}")
    names = ("p", *GAINS, "antiwindup_strategy")
    return ToolboxPid(**{name: values[name].value for name in names})


class Controller:
    """What every controller has.

    :param name: its name.
    :param needs: the command interfaces that it writes.
    """

    type_name = ""
    references: tuple[str, ...] = ()
    is_chained = False

    def __init__(self, name: str, needs: tuple[str, ...]) -> None:
        self.name, self.needs = name, needs
        self.node = Node(name)

    def activate(self, measured: dict[str, float]) -> None: ...

    def deactivate(self, commands: dict[str, float]) -> None: ...


class ToolboxController(Controller):
    """What has a control_toolbox::Pid for each joint, with parameters that may change.

    :param kind: the robot.
    """

    def __init__(self, kind: Kind, defaults: dict[str, object]) -> None:
        joints = tuple(kind.joints)
        super().__init__(kind.controller, tuple(f"{joint}/effort" for joint in joints))
        self.joints = joints
        for joint in joints:
            given = GAINS | {"p": kind.gains[0], "i": kind.gains[1]} | defaults
            for key, value in given.items():
                self.node.declare_parameter(f"gains.{joint}.{key}", value)
        self.laws = [toolbox_pid(self.node, joint) for joint in joints]
        self.node.add_post_set_parameters_callback(lambda _: self.read_gains())

    def read_gains(self) -> None:
        for k, joint in enumerate(self.joints):
            self.laws[k] = replace(toolbox_pid(self.node, joint), **self.laws[k].memory)

    def publish(self, publisher: Publisher, state: Any, stamp: float) -> None:
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(round(stamp * 1e9), 10**9)
        # The real-time publisher leaves a message out where it cannot have its lock.
        if random.random() > 0.005:
            publisher.publish(state)


class PidController(ToolboxController):
    """pid_controller, of a position with the velocity as its second state interface."""

    type_name = "pid_controller/PidController"

    def __init__(self, kind: Kind) -> None:
        own = {"save_i_term": True, "feedforward_gain": 0.0, "angle_wraparound": False}
        super().__init__(kind, {"antiwindup_strategy": "back_calculation", **own})
        declare = self.node.declare_parameter
        declare("dof_names", list(self.joints))
        declare("reference_and_state_dof_names", list(self.joints))
        declare("command_interface", "effort")
        self.interfaces = ["position", "velocity"] if kind.measured == "position" else ["velocity"]
        declare("reference_and_state_interfaces", self.interfaces)
        declare("enable_feedforward", False)
        self.references = tuple(f"{self.name}/{joint}/{kind.measured}" for joint in self.joints)
        self.reference = list(kind.joints.values())
        self.speeds = [math.nan for _ in self.joints]
        for law, (joint, value) in zip(self.laws, kind.joints.items(), strict=True):
            law.integral = kind.joint(value).effort - self.fed(joint, value)
        self.told: MultiDOFCommand | None = None
        self.states = self.node.create_publisher(MultiDOFStateStamped, "~/controller_state", 100)
        self.node.create_subscription(MultiDOFCommand, "~/reference", self.hear, BEST_EFFORT)

    def fed(self, joint: str, reference: float) -> float:
        names = ("enable_feedforward", f"gains.{joint}.feedforward_gain")
        feeds, gain = (self.node.get_parameter(name).value for name in names)
        return feeds * gain * reference

    def hear(self, message: MultiDOFCommand) -> None:
        # The values are taken by their place, whatever the names say.
        if len(message.dof_names) == len(message.values) == len(self.joints):
            message.values_dot[len(self.joints) - 1]
            self.told = message

    def activate(self, measured: dict[str, float]) -> None:
        self.told = None
        self.reference = [measured[joint] for joint in self.joints]
        self.speeds = [math.nan for _ in self.joints]
        for k, joint in enumerate(self.joints):
            kept = self.node.get_parameter(f"gains.{joint}.save_i_term").value
            self.laws[k].reset(save_integral=kept)

    def update(self, stamp: float, measured: dict[str, float], commands: dict[str, float]) -> None:
        if self.is_chained:
            self.reference = [commands[name] for name in self.references]
        elif self.told is not None:
            for k, value in enumerate(self.told.values):
                if not math.isnan(value):
                    self.reference[k] = value
                    if not math.isnan(self.told.values_dot[k]):
                        self.speeds[k] = self.told.values_dot[k]
        self.told = None
        state = MultiDOFStateStamped()
        for k, joint in enumerate(self.joints):
            error = self.reference[k] - measured[joint]
            # Without a reference of the velocity the derivative is the difference of the error.
            rate = self.speeds[k] - measured[f"{joint}/velocity"]
            has_rate = len(self.interfaces) > 1 and not math.isnan(rate)
            output = self.laws[k].step(error, PERIOD, rate if has_rate else None)
            output += self.fed(joint, self.reference[k])
            commands[f"{joint}/effort"] = output
            state.dof_states.append(
                SingleDOFState(
                    name=joint, reference=self.reference[k], feedback=measured[joint],
                    error=error, time_step=PERIOD, output=output,
                )
            )  # fmt: skip
        self.publish(self.states, state, stamp)


class Path:
    """The trajectory of some joints: straight lines between its points, and then its end.

    :param node: of the controller.
    :param joints: each at its position.
    """

    def __init__(self, node: Node, joints: dict[str, float]) -> None:
        self.joints = tuple(joints)
        self.begun, self.now = 0.0, list(joints.values())
        self.times, self.points = [0.0], [self.now]
        node.create_subscription(JointTrajectory, "~/joint_trajectory", self.hear, 10)

    def hold(self, positions: list[float]) -> None:
        self.begun, self.times, self.points, self.now = 0.0, [0.0], [positions], positions

    def hear(self, message: JointTrajectory) -> None:
        # A goal has to name all joints, in any order, with their positions.
        if sorted(message.joint_names) != sorted(self.joints):
            return
        places = [message.joint_names.index(joint) for joint in self.joints]
        ends = [point.time_from_start for point in message.points]
        self.begun, self.times = 0.0, [0.0, *(end.sec + 1e-9 * end.nanosec for end in ends)]
        self.points = [self.now, *([p.positions[k] for k in places] for p in message.points)]

    def move(self, stamp: float) -> tuple[list[float], list[float]]:
        """Return positions and velocities at a time; the first one is that of the start."""
        self.begun = self.begun or stamp
        since, before = stamp - self.begun, self.now
        columns = zip(*self.points, strict=True)
        self.now = [float(np.interp(since, self.times, column)) for column in columns]
        return self.now, [(new - old) / PERIOD for new, old in zip(self.now, before, strict=True)]


class PathController(Controller):
    """joint_trajectory_controller that writes the references of another controller."""

    type_name = "joint_trajectory_controller/JointTrajectoryController"

    def __init__(self, kind: Kind, needs: tuple[str, ...]) -> None:
        super().__init__(kind.above, needs)
        self.path = Path(self.node, kind.joints)

    def activate(self, measured: dict[str, float]) -> None:
        self.path.hold([measured[joint] for joint in self.path.joints])

    def update(self, stamp: float, measured: dict[str, float], commands: dict[str, float]) -> None:
        commands.update(zip(self.needs, self.path.move(stamp)[0], strict=True))


class TrajectoryController(ToolboxController):
    """joint_trajectory_controller that commands effort alone."""

    type_name = PathController.type_name

    def __init__(self, kind: Kind) -> None:
        super().__init__(kind, {"antiwindup_strategy": "legacy", "ff_velocity_scale": 0.0})
        declare = self.node.declare_parameter
        declare("joints", list(self.joints))
        declare("command_joints", list(self.joints))
        declare("command_interfaces", ["effort"])
        declare("state_interfaces", ["position", "velocity"])
        declare("open_loop_control", False)
        self.path = Path(self.node, kind.joints)
        kind_of_state = JointTrajectoryControllerState
        self.states = self.node.create_publisher(kind_of_state, "~/controller_state", 10)

    def activate(self, measured: dict[str, float]) -> None:
        self.path.hold([measured[joint] for joint in self.joints])
        for law in self.laws:
            law.reset(save_integral=False)

    def deactivate(self, commands: dict[str, float]) -> None:
        commands.update(dict.fromkeys(self.needs, 0.0))

    def update(self, stamp: float, measured: dict[str, float], commands: dict[str, float]) -> None:
        now = [measured[joint] for joint in self.joints]
        rates = [measured[f"{joint}/velocity"] for joint in self.joints]
        wanted, speeds = self.path.move(stamp)
        for k, name in enumerate(self.needs):
            error = wanted[k] - now[k]
            commands[name] = self.laws[k].step(error, PERIOD, speeds[k] - rates[k])
        state = JointTrajectoryControllerState(joint_names=list(self.joints))
        state.reference.positions, state.feedback.positions = wanted, now
        state.feedback.velocities = rates
        state.output.effort = [commands[name] for name in self.needs]
        self.publish(self.states, state, stamp)


class BaseController(Controller):
    """diff_drive_controller, which drives straight on."""

    type_name = "diff_drive_controller/DiffDriveController"

    def __init__(self, kind: Kind, needs: tuple[str, ...]) -> None:
        super().__init__(kind.above, needs)
        self.speeds = list(kind.joints.values())

    def update(self, stamp: float, measured: dict[str, float], commands: dict[str, float]) -> None:
        commands.update(zip(self.needs, self.speeds, strict=True))


class ForwardController(Controller):
    """forward_command_controller."""

    type_name = "forward_command_controller/ForwardCommandController"

    def __init__(self, name: str, needs: tuple[str, ...]) -> None:
        super().__init__(name, needs)
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
        joints = TrajectoryController(kind) if kind.follows else PidController(kind)
        above = BaseController if kind.measured == "velocity" else PathController
        # Who writes references is before who reads them.
        self.controllers: list[Any] = [
            *([above(kind, joints.references)] if kind.above else []),
            joints,
            *(
                ForwardController(name, tuple(f"{joint}/effort" for joint in joints))
                for name, joints in kind.forward.items()
            ),
        ]
        self.active = set[str]()
        self.refuses = False
        self.joints = {name: kind.joint(value) for name, value in kind.joints.items()}
        self.commands = {f"{name}/effort": joint.effort for name, joint in self.joints.items()}
        self.now = self.measure(PERIOD)
        first = {kind.controller, kind.above} - {""}
        self.active |= first
        joints.is_chained = bool(kind.above)
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

    def measure(self, at: float) -> dict[str, float]:
        found = {}
        for name, joint in self.joints.items():
            found[name] = joint.measure(at, self.commands[f"{name}/effort"])
            found[f"{name}/velocity"] = joint.velocity
        return found

    def cycle(self, at: float) -> None:
        self.now = measured = self.measure(at)
        stamp = self.start + at
        for controller in self.controllers:
            if controller.name in self.active:
                controller.update(stamp, measured, self.commands)
        names = random.sample(list(self.joints), len(self.joints))
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
                    is_chainable=bool(each.references),
                    is_chained=each.is_chained,
                    reference_interfaces=each.references,
                )
            )
        return response

    def hardware(
        self, _request: object, response: ListHardwareInterfaces.Response
    ) -> ListHardwareInterfaces.Response:
        response.command_interfaces = [
            HardwareInterface(name=name, data_type="double", is_available=True)
            for name in self.commands
            if name.count("/") == 1
        ]
        return response

    def switch(
        self, request: SwitchController.Request, response: SwitchController.Response
    ) -> SwitchController.Response:
        response.message = self.why_not(request)
        response.ok = not response.message
        if response.ok:
            on, off = set(request.activate_controllers), set(request.deactivate_controllers)
            after = self.active - off | on
            writes = {n for each in self.controllers if each.name in after for n in each.needs}
            for each in self.controllers:
                chained = bool(writes & set(each.references))
                # Who gets its references from others, or no longer does, is begun again.
                if each.name in self.active & after and chained != each.is_chained:
                    off, on = off | {each.name}, on | {each.name}
                each.is_chained = chained and each.name in after
            for each in self.controllers:
                if each.name in off:
                    each.deactivate(self.commands)
            for each in reversed(self.controllers):
                if each.name in on:
                    each.activate(self.now)
            self.active = after
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
        for each in self.controllers:
            if each.name not in after and set(each.references) & set(claimed):
                return f"{each.name} is inactive, and another controller writes its references"
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
