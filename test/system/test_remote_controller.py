"""The gains of another node's controller: set by its parameters, proved by its set-point."""

from __future__ import annotations

import pytest
from action_msgs.msg import GoalStatus
from loop_rig import Rig
from remote_loop import Loop
from std_msgs.msg import Float64
<<<<<<< HEAD
from std_srvs.srv import Trigger

from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, TransferFunction

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


class Loop:
    """The other node's loop, and a controller_node that looks after its gains."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.commands = rig.listen("command", Float64, RELIABLE)
        self.setpoints = rig.listen("setpoint", Float64, RELIABLE)
        self.models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
        self.gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
        rig.start_python("pid_controller", OTHER.replace("PERIOD", str(PERIOD)))
        rig.plant(**PLANT)
        names = ",".join(f"{name}:gains.heater.{name}" for name in "pid")
        self.controller = rig.start(
            "controller_node", apply_to="/pid_controller", apply_parameters=names
        )
        rig.until(lambda: len(self.commands) > 60, "a closed loop")
        # The processes find each other one by one.
        rig.until(self.is_watched, "the controller_node")

    def is_watched(self) -> bool:
        reason = self.verify()[1].reason
        return "no model has come" in reason

    def apply(self, p: float, i: float, gain: float) -> None:
        """Let gains and a model come, and put them in force."""
        model = TransferFunction(
            final=True,
            verdict=TransferFunction.VERDICT_TRUSTED,
            denominator=[0.3, 1.0],
            dead_time=0.1,
        )
        model.numerator = [gain]
        self.models.publish(model)
        self.gains.publish(
            PidGains(
                final=True,
                verdict=PidGains.VERDICT_TRUSTED,
                kc=p,
                ti=p / i,
                p=p,
                i=i,
                b=1.0,
                experiment_id=f"with {p:g}",
            )
        )
        said = f"gains of with {p:g} wait"
        self.rig.until(lambda: said in self.controller.log, "the gains")
        applied = self.rig.until(
            lambda: ((a := self.trigger("apply")).success and a) or None, "the other node"
        )
        assert "/pid_controller has the gains" in applied.message

    def trigger(self, name: str) -> Any:
        return self.rig.call(Trigger, f"controller_node/{name}", Trigger.Request())

    def verify(
        self, during: Callable[[], None] | None = None, **request: float
    ) -> tuple[int, Any]:
        """Ask for a proof of a loop at rest; once the set-point has moved, do something."""

        def at_rest() -> tuple[int, Any] | None:
            status, result = self.ask_for_proof(during, request)
            # How long a loop takes to settle, a busy machine decides.
            return None if "the loop is not at rest" in result.reason else (status, result)

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

    def values(self) -> list[float]:
        request = GetParameters.Request(names=[f"gains.heater.{name}" for name in "pid"])
        answer = self.rig.call(GetParameters, "pid_controller/get_parameters", request)
        return [v.double_value for v in answer.values]
=======
>>>>>>> e68e680 (Start controller_node with proven gains, and keep failed ones out for good)


def test_the_gains_of_another_node_are_proved_or_taken_back(rig: Rig) -> None:
    loop = Loop(rig)
    loop.apply(0.5, 1.6, 2.0)
    assert loop.values() == [0.5, 1.6, 0.0]
    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_ABORTED
    assert "the set-point of /pid_controller is not known" in result.reason
    setpoint = rig.node.create_publisher(Float64, "setpoint", 10)
    rig.until(lambda: setpoint.get_subscription_count() == 3, "both controllers")
    setpoint.publish(Float64(data=5.0))
    rig.run_for(0.3)
    status, result = loop.verify(setpoint_step=0.5, load_step=0.1)
    assert status == GoalStatus.STATUS_ABORTED
    assert "no load step can be added" in result.reason

    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert result.passed, result.reason
    (step,) = result.steps
    assert step.gain_ratio == pytest.approx(1.0, abs=0.2)
    assert [m.data for m in loop.setpoints] == [5.0, 5.5, 5.0]
    assert loop.values() == [0.5, 1.6, 0.0]

    # Somebody else's set-point ends a proof and stays; nothing was found out about the gains.
    rig.run_for(2.0)
    other = [m.data for m in loop.setpoints]
    status, result = loop.verify(lambda: setpoint.publish(Float64(data=4.8)), setpoint_step=0.5)
    assert not result.passed
    assert "another node set the set-point to 4.8" in result.reason
    rig.run_for(2.0)
    assert [m.data for m in loop.setpoints] == [*other, 5.5, 4.8]
    assert loop.values() == [0.5, 1.6, 0.0]

    # Gains for a process with a third of the gain that it has.
    loop.apply(0.8, 2.6, 0.6)
    status, result = loop.verify(setpoint_step=0.5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert not result.passed
    assert "/pid_controller has gains.heater.d 0, gains.heater.i 1.6" in result.reason
    assert loop.values() == [0.5, 1.6, 0.0]
    assert [m.data for m in loop.setpoints[-2:]] == [5.3, 4.8]
