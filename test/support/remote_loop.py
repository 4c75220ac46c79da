# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A loop controlled by a node of the test, whose gains controller_node manages.

That node shares no code with the package.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from loop_rig import LATCHED, RELIABLE, Rig
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from relay_autotune.reasons import Code
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, TransferFunction

VERDICT = PidGains.VERDICT_TRUSTED
PERIOD = 0.02
PLANT = {
    "sample_period": PERIOD,
    "structure": "fopdt",
    "gain": 2.0,
    "time_constants": [0.3],
    "dead_time": 0.1,
    "operating_point": [5.0, 1.0],
    "noise_std": 0.002,
    "seed": 5,
}
OTHER = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import Float64
rclpy.init()
node = Node("pid_controller")
for name, value in (("p", 0.3), ("i", 1.0), ("d", 0.0)):
    node.declare_parameter(f"gains.heater.{name}", value)
commands = node.create_publisher(Float64, "command", 10)
integral, wanted = 1.0, 5.0
def gain(name):
    return node.get_parameter(f"gains.heater.{name}").value
def on_setpoint(message):
    global wanted
    wanted = message.data
def on_measurement(message):
    global integral
    error = wanted - message.data
    before, integral = integral, integral + gain("i") * PERIOD * error
    commands.publish(Float64(data=gain("p") * error + before))
node.create_subscription(Float64, "setpoint", on_setpoint, 10)
node.create_subscription(Float64, "measurement", on_measurement, 10)
rclpy.spin(node)
"""
# The same loop in one node that tells feedback and command in one message, as ros2_control does.
REPORTING = """
import math, random
from collections import deque
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
rclpy.init()
node = Node("pid_controller")
for name, value in (("p", 0.3), ("i", 1.0), ("d", 0.0)):
    node.declare_parameter(f"gains.heater.{name}", value)
states = node.create_publisher(JointState, "measurement", 10)
integral, wanted, away, count = 1.0, 5.0, 0.0, 0
on_the_way = deque([1.0] * 5)
def gain(name):
    return node.get_parameter(f"gains.heater.{name}").value
def on_setpoint(message):
    global wanted
    wanted = message.velocity[list(message.name).index("left")]
def step():
    global integral, away, count
    count += 1
    away += (2.0 * (on_the_way.popleft() - 1.0) - away) * -math.expm1(-PERIOD / 0.3)
    y = 5.0 + away + random.gauss(0.0, 0.002)
    before, integral = integral, integral + gain("i") * PERIOD * (wanted - y)
    on_the_way.append(gain("p") * (wanted - y) + before)
    names = random.sample(["left", "right", "arm"], 3)
    state = JointState(name=names)
    state.velocity = [y if name == "left" else -1.0 for name in names]
    state.effort = [on_the_way[-1] if name == "left" else -2.0 for name in names]
    ns = 10**18 + round(1e9 * PERIOD * count)
    state.header.stamp.sec, state.header.stamp.nanosec = divmod(ns, 10**9)
    states.publish(state)
node.create_subscription(JointState, "setpoint", on_setpoint, 10)
node.create_timer(PERIOD, step)
rclpy.spin(node)
"""
REPORTED = {
    "measurement_type": "sensor_msgs/msg/JointState",
    "measurement_field": "velocity[left]",
    "controller_command_field": "effort[left]",
    "command_type": "sensor_msgs/msg/JointState",
    "command_field": "velocity[left]",
    "command_message": "'{name: [arm, left], velocity: [0.25, 0.0]}'",
    "initial_setpoint": 5.0,
}


class Loop:
    """The other node's loop, and a controller_node that manages its gains."""

    parameters: dict[str, Any]

    def __init__(self, rig: Rig) -> None:
        self.rig, self.parameters = rig, {}
        self.commands = rig.listen("command", Float64, RELIABLE)
        self.setpoints = rig.listen("setpoint", Float64, RELIABLE)
        self.models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
        self.gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
        rig.start_python("pid_controller", OTHER.replace("PERIOD", str(PERIOD)))
        rig.plant(**PLANT)
        self.start()
        rig.until(lambda: len(self.commands) > 60, "a closed loop")
        # Discovery of the processes takes time.
        rig.until(self.is_watched, "the controller_node")

    def start(self) -> None:
        """Start the controller_node, and wait until it says that it is ready."""
        names = ",".join(f"{name}:gains.heater.{name}" for name in "pid")
        self.controller = self.rig.start(
            "controller_node",
            apply_to="/pid_controller",
            apply_parameters=names,
            verify_step_max=0.5,
            **self.parameters,
        )
        self.rig.until(lambda: "ready:" in self.controller.log, "the controller_node", 60.0)
        self.rig.be_known_to("controller_node")

    def is_watched(self) -> bool:
        reason = self.verify()[1].reason
        return "no model has come" in reason

    def apply(self, p: float, i: float, gain: float) -> None:
        """Publish gains and a model, and apply the gains."""
        model = TransferFunction(
            final=True, verdict=VERDICT, denominator=[0.3, 1.0], dead_time=0.1
        )
        model.numerator = [gain]
        self.models.publish(model)
        self.gains.publish(
            PidGains(
                final=True, verdict=VERDICT, kc=p, ti=p / i, b=1.0, experiment_id=f"with {p:g}"
            )
        )
        said = f"gains of with {p:g} wait"
        self.rig.until(lambda: said in self.controller.log, "the gains")
        applied = self.rig.until(
            lambda: ((a := self.trigger("apply")).success and a) or None, "the other node"
        )
        assert f"gains of with {p:g}: /pid_controller has" in applied.message

    def trigger(self, name: str) -> Any:
        return self.rig.call(Trigger, f"controller_node/{name}", Trigger.Request())

    def verify(
        self, during: Callable[[], None] | None = None, **request: float
    ) -> tuple[int, Any]:
        """Verify a loop at rest; call ``during`` once the set-point has moved."""

        def at_rest() -> tuple[int, Any] | None:
            status, result = self.ask_for_proof(during, request)
            # How soon the loop is heard, runs and has settled depends on the load of the machine;
            # what is left of a swing counts as noise.
            early = result.why.code in (Code.NOT_HEARD, Code.NOT_AT_REST, Code.FEW_SAMPLES)
            return None if early or "cannot be judged" in result.reason else (status, result)

        return self.rig.until(at_rest, "a loop at rest")

    def ask_for_proof(
        self, during: Callable[[], None] | None, request: dict[str, float]
    ) -> tuple[int, Any]:
        moved = len(self.setpoints)
        client = ActionClient(self.rig.node, Verify, "controller_node/verify")
        self.rig.until(client.server_is_ready, "the action")
        sent = client.send_goal_async(Verify.Goal(**request))
        self.rig.until(sent.done, "the goal")
        answer = sent.result().get_result_async()
        if during is not None:
            self.rig.until(lambda: len(self.setpoints) > moved or answer.done(), "the step")
            if len(self.setpoints) > moved:
                during()
        self.rig.until(answer.done, "the result")
        client.destroy()
        return answer.result().status, answer.result().result

    def until_setpoints(self, *wanted: float) -> None:
        """Wait until these are the set-points so far; the last may come after its action ends."""
        self.rig.until(
            lambda: [self.setpoint_in(m) for m in self.setpoints] == list(wanted),
            f"the set-points {wanted}",
        )

    def setpoint_in(self, message: Any) -> float:
        return float(message.data)

    def values(self) -> list[float]:
        return self.rig.values("pid_controller", *(f"gains.heater.{name}" for name in "pid"))


class ReportingLoop(Loop):
    """The same, where the other node tells its command in the messages of the measurement."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.parameters = rig, dict(REPORTED)
        self.setpoints = rig.listen("setpoint", JointState, RELIABLE)
        self.models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
        self.gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
        rig.start_python("pid_controller", REPORTING.replace("PERIOD", str(PERIOD)))
        self.start()
        rig.until(self.is_watched, "the controller_node")

    def setpoint_in(self, message: Any) -> float:
        return float(message.velocity[1])
