# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A controller_node in a loop that the test steps sample by sample, with its own stamps."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

from fopdt_plant import FopdtPlant
from loop_rig import LATCHED, RELIABLE, Rig
from loop_rig import Process as Running
from made_experiments import experiment_of
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from sensor_msgs.msg import Temperature
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from relay_autotune.process.transfer_function import TransferFunction as Process
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, RelayExperiment, TransferFunction

VERDICT = PidGains.VERDICT_TRUSTED
PERIOD = 0.05
SETPOINT, COMMAND = 5.0, 1.0


class HandLoop:
    """The process 2 e^(-0.2 s)/(0.5 s + 1) about its operating point, and its controller_node.

    :param rig: the rig.
    :param gain: static gain of the process [y/u].
    :param noise_std: standard deviation of the measurement's noise [y].
    :param parameters: further parameters of controller_node.
    """

    def __init__(
        self, rig: Rig, gain: float = 2.0, noise_std: float = 0.0, **parameters: Any
    ) -> None:
        self.rig = rig
        self.noise, self.random = noise_std, Random(1)
        self.time = 1e8
        self.parameters = {
            "measurement_type": "sensor_msgs/msg/Temperature",
            "measurement_field": "temperature",
            "initial_setpoint": SETPOINT,
            "initial_command": COMMAND,
            "command_min": 0.0,
            "command_max": 5.0,
            "verify_step_max": 1.0,
        } | parameters
        self.process = FopdtPlant(gain, 0.5, 0.2)
        self.elapsed = 0.0
        self.command = COMMAND
        self.commands = rig.listen("controller_command", Float64, RELIABLE)
        self.sensor = rig.node.create_publisher(Temperature, "measurement", RELIABLE)
        self.experiments = rig.node.create_publisher(RelayExperiment, "relay_experiment", LATCHED)
        self.gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
        self.models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
        self.node: Running
        self.start()

    def start(self, **parameters: Any) -> None:
        """Start the node, with other parameters if given, and wait until it answers."""
        self.parameters |= parameters
        self.node = self.rig.start("controller_node", **self.parameters)
        self.rig.until(lambda: "ready:" in self.node.log, "the controller", 60.0)
        self.rig.be_known_to("controller_node")
        before = len(self.commands)

        def answered() -> bool:
            self.say(SETPOINT)
            self.rig.executor.spin_once(timeout_sec=0.05)
            return len(self.commands) > before

        self.rig.until(answered, "an answer of the controller")
        self.command = self.commands[-1].data

    def say(self, value: float, later: float = PERIOD) -> None:
        """Publish a measurement, ``later`` seconds after the last one."""
        self.time += later
        message = Temperature(temperature=value)
        message.header.stamp.sec = int(self.time)
        message.header.stamp.nanosec = round((self.time - int(self.time)) * 1e9)
        self.sensor.publish(message)

    def answer_to(self, value: float, later: float = PERIOD) -> float:
        """Publish a measurement and return the command that answers it."""
        before = len(self.commands)
        self.say(value, later)
        self.rig.until(lambda: len(self.commands) > before, "a command")
        return float(self.commands[-1].data)

    def step(self, count: int = 1, later: float = PERIOD) -> None:
        """Advance by samples, whose stamps may differ from the process's time."""
        for _ in range(count):
            self.elapsed += PERIOD
            away = self.process.advance(self.elapsed, self.command - COMMAND)
            seen = SETPOINT + away + self.random.gauss(0.0, self.noise)
            self.command = self.answer_to(seen, later)

    def publish(self, kc: float, ti: float, name: str, gain: float = 2.0) -> None:
        """Publish a record, a model and gains of an experiment."""
        self.experiments.publish(experiment_of(Process.fopdt(gain, 0.5, 0.2), name))
        model = TransferFunction(
            final=True, verdict=VERDICT, denominator=[0.5, 1.0], dead_time=0.2
        )
        model.numerator, model.experiment_id = [gain], name
        self.models.publish(model)
        gains = PidGains(final=True, verdict=VERDICT, kc=kc, ti=ti, b=1.0, experiment_id=name)
        self.gains.publish(gains)

    def offer(self, kc: float, ti: float, name: str, gain: float = 2.0) -> None:
        """Publish them and wait until the node has received them."""
        self.publish(kc, ti, name, gain)
        self.rig.until(lambda: f"gains of {name}" in self.node.log, "the gains")

    def apply(self, kc: float, ti: float, name: str, gain: float = 2.0) -> Any:
        """Publish gains and a model, and put the gains in force."""
        self.offer(kc, ti, name, gain)
        applied = self.trigger("apply")
        assert applied.success, applied.message
        return applied

    def trigger(self, name: str) -> Any:
        return self.rig.call(Trigger, f"controller_node/{name}", Trigger.Request())

    def set_automatic(self, automatic: bool) -> None:
        request = SetBool.Request(data=automatic)
        self.rig.call(SetBool, "controller_node/automatic", request)

    def set(self, **values: float) -> Any:
        parameters = [Parameter(k, value=v).to_parameter_msg() for k, v in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        name = "controller_node/set_parameters_atomically"
        return self.rig.call(SetParametersAtomically, name, request).result

    def gains_shown(self) -> tuple[float, float]:
        kc, ti = self.rig.values("controller_node", "kc", "ti")
        return kc, ti

    def verify(
        self, during: Callable[[], None] | None = None, after: int = 3, **request: Any
    ) -> Any:
        """Verify a loop at rest and return the result; do something once the step has begun."""
        self.step(160)
        client = ActionClient(self.rig.node, Verify, "controller_node/verify")
        self.rig.until(client.server_is_ready, "the action")
        begun: list[Any] = []
        sent = client.send_goal_async(Verify.Goal(**request), feedback_callback=begun.append)
        self.rig.until(sent.done, "the goal")
        answer = sent.result().get_result_async()
        left = after

        def over() -> bool:
            nonlocal left
            # Before the step is planned, no time remains.
            if during is not None and begun and begun[-1].feedback.remaining > 0.0:
                left -= 1
                if left <= 0:
                    during()
                    return answer.done()
            self.step()
            return answer.done()

        try:
            self.rig.until(over, "the result", timeout=60.0)
        finally:
            client.destroy()
        return answer.result().result
