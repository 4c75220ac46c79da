"""Every fault of docs/safety.md over real DDS: safe command first, then reason, record, no gains.

One relay_node serves them all; the loop about it is played by the test itself.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from loop_rig import RELIABLE, Rig
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import QoSProfile
from ros_domain import free_domain
from std_msgs.msg import Float64, Float64MultiArray

from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment

BASELINE = 1.0
SAFE = 0.75
PERIOD = 0.005
RELAY = {
    "amplitude": 0.5,
    "baseline": BASELINE,
    "safe_command": SAFE,
    "settle_time": 0.15,
    "measurement_timeout": 0.8,
    "controller_timeout": 0.6,
    "feedback_timeout": 0.3,
    "max_cycles": 100,
    "min_cycles": 100,
    "process_gain_sign": 1,
}


class Loop:
    """A first-order process with dead time on the topics, and what the relay does to it."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.commands = rig.listen("command", Float64, RELIABLE)
        self.experiments = rig.listen("relay_experiment", RelayExperiment)
        self.gains = rig.listen("pi_gains", PidGains)
        self.status = rig.listen("/diagnostics", DiagnosticArray, QoSProfile(depth=50))
        self.publisher = rig.node.create_publisher(Float64, "measurement", 100)
        self.timer = rig.node.create_timer(PERIOD, self.step)
        self.reset()

    def reset(self) -> None:
        self.running = True
        self.state = 0.0
        self.gain = 2.0
        self.rate = PERIOD / 0.1
        self.count = 0
        self.alter: Callable[[float], float | None] = lambda y: y
        self.on_the_way = [0.0] * 10

    def step(self) -> None:
        if not self.running:
            return
        self.count += 1
        command = self.commands[-1].data if self.commands else BASELINE
        if command == SAFE:
            # The next tune begins at rest at the baseline.
            command = BASELINE
        self.on_the_way.append(command - BASELINE)
        self.state += self.rate * (self.gain * self.on_the_way.pop(0) - self.state)
        y = self.alter(5.0 + self.state + 1e-4 * math.sin(7.0 * self.count**2))
        if y is not None:
            self.publisher.publish(Float64(data=float(y)))

    def set(self, **values: Any) -> None:
        kinds = {
            float: (ParameterType.PARAMETER_DOUBLE, "double_value"),
            int: (ParameterType.PARAMETER_INTEGER, "integer_value"),
            str: (ParameterType.PARAMETER_STRING, "string_value"),
            bool: (ParameterType.PARAMETER_BOOL, "bool_value"),
        }
        parameters = []
        for name, value in values.items():
            kind, field = kinds[type(value)]
            parameters.append(
                Parameter(name=name, value=ParameterValue(type=kind, **{field: value}))
            )
        request = SetParameters.Request(parameters=parameters)
        for result in self.rig.call(SetParameters, "relay_node/set_parameters", request).results:
            assert result.successful, result.reason

    def tune(self) -> Any:
        self.reset()
        self.before = len(self.experiments)
        answer = self.rig.tune()
        self.started = len(self.commands)
        return answer

    def until_it_oscillates(self) -> None:
        def switched() -> bool:
            levels = [m.data for m in self.commands[self.started :]]
            changes = sum(a != b for a, b in itertools.pairwise(levels))
            return changes >= 5

        self.rig.until(switched, "an oscillation")

    def ended(self) -> Any:
        return self.rig.until(lambda: self.experiments[self.before :], "the record")[-1]


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Loop]:
    with free_domain() as domain:
        rig = Rig(domain, tmp_path_factory.mktemp("faults"))
        try:
            made = Loop(rig)
            rig.relay(**RELAY)
            rig.identifier()
            yield made
        finally:
            rig.close()


def frozen(loop: Loop) -> None:
    value = 5.1
    loop.alter = lambda _: value


def silent(loop: Loop) -> None:
    loop.alter = lambda _: None


def not_finite(loop: Loop) -> None:
    loop.alter = lambda _: math.nan


def out_of_limits(loop: Loop) -> None:
    loop.alter = lambda y: y + 100.0


def no_response(loop: Loop) -> None:
    loop.alter = lambda _: 5.0 + 1e-4 * math.sin(7.0 * loop.count**2)


def saturating(loop: Loop) -> None:
    loop.alter = lambda y: min(y, 4.9) + 1e-6 * math.sin(7.0 * loop.count**2)


def wrong_sign(loop: Loop) -> None:
    loop.gain = -2.0


# What goes wrong, from which moment on, with which parameters, and what is said.
FAULTS = {
    "silent sensor": (silent, "oscillating", {}, "no measurement on /measurement for"),
    "frozen sensor": (frozen, "oscillating", {}, "the sensor is frozen"),
    "non-finite sensor": (not_finite, "oscillating", {}, "is nan, expected a finite number"),
    "measurement limits": (
        out_of_limits,
        "oscillating",
        {"measurement_max": 50.0},
        "is outside its limits",
    ),
    "deviation": (out_of_limits, "oscillating", {"max_deviation": 10.0}, "max_deviation, 10"),
    "no response": (no_response, "start", {"max_duration": 1.0}, "was over while waiting"),
    "saturating response": (saturating, "oscillating", {}, "the response saturates"),
    "wrong sign": (wrong_sign, "start", {}, "process_gain_sign may be wrong"),
    "longest experiment": (
        lambda loop: None,
        "oscillating",
        {"max_duration": 1.5},
        "max_duration 1.5 s was over",
    ),
}
DEFAULTS = {"measurement_max": math.inf, "max_deviation": 0.0, "max_duration": 0.0}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_ends_in_the_safe_command(loop: Loop, fault: str) -> None:
    cause, moment, parameters, said = FAULTS[fault]
    loop.set(**{**DEFAULTS, **parameters})
    loop.tune()
    if moment == "oscillating":
        loop.until_it_oscillates()
    cause(loop)
    check_the_end(loop, said)


def check_the_end(loop: Loop, said: str, safe: float = SAFE) -> None:
    ended = loop.ended()
    assert said in ended.reason
    assert ended.outcome in (RelayExperiment.ABORTED, RelayExperiment.FAILED)
    loop.rig.until(lambda: loop.commands[-1].data == safe, "the safe command")
    loop.rig.until(
        lambda: any(said in s.message for m in loop.status[-3:] for s in m.status),
        "the diagnostics",
    )
    assert not loop.gains
    # It stays: each further measurement is answered with it.
    loop.reset()
    count = len(loop.commands)
    loop.rig.until(lambda: len(loop.commands) > count + 5, "commands after the tune")
    assert {m.data for m in loop.commands[count:]} == {safe}


def test_a_second_publisher_ends_the_tune_and_refuses_the_next(loop: Loop) -> None:
    loop.set(**DEFAULTS)
    loop.tune()
    loop.until_it_oscillates()
    other = loop.rig.node.create_publisher(Float64, "command", 10)
    ended = loop.ended()
    assert "/command is also published by /onlooker" in ended.reason
    answer = loop.rig.ask_for_tune()
    assert not answer.accepted
    assert "is also published by /onlooker" in answer.reason
    loop.rig.node.destroy_publisher(other)
    loop.rig.until(lambda: loop.commands[-1].data == SAFE, "the safe command")


def test_an_actuator_that_does_not_follow_ends_the_tune(loop: Loop) -> None:
    stuck = False
    publisher = loop.rig.node.create_publisher(Float64, "command_feedback", 10)

    def feed() -> None:
        if loop.commands:
            publisher.publish(Float64(data=BASELINE - 0.35 if stuck else loop.commands[-1].data))

    timer = loop.rig.node.create_timer(0.01, feed)
    loop.rig.run_for(0.1)
    loop.tune()
    loop.until_it_oscillates()
    stuck = True
    check_the_end(loop, "the actuator does not follow")
    loop.rig.node.destroy_timer(timer)
    loop.rig.node.destroy_publisher(publisher)


def test_a_controller_that_falls_silent(loop: Loop) -> None:
    publisher = loop.rig.node.create_publisher(Float64, "controller_command", 10)
    speaking = True
    timer = loop.rig.node.create_timer(
        PERIOD, lambda: publisher.publish(Float64(data=1.25)) if speaking else None
    )
    # Idle, it is passed through untouched.
    loop.rig.until(lambda: loop.commands and loop.commands[-1].data == 1.25, "the controller")
    speaking = False
    fell = time.monotonic()
    loop.rig.until(lambda: loop.commands[-1].data == SAFE, "the safe command")
    assert time.monotonic() - fell < 1.0
    loop.rig.until(
        lambda: any("has been silent" in s.message for m in loop.status[-3:] for s in m.status),
        "the diagnostics",
    )
    speaking = True
    loop.rig.until(lambda: loop.commands[-1].data == 1.25, "the controller")
    # During a tune its silence ends it.
    loop.tune()
    loop.until_it_oscillates()
    speaking = False
    ended = loop.ended()
    assert "no command on /controller_command for" in ended.reason
    loop.rig.until(lambda: loop.commands[-1].data == SAFE, "the safe command")
    loop.rig.node.destroy_timer(timer)
    loop.rig.node.destroy_publisher(publisher)


def test_a_process_that_does_not_settle_by_itself_is_refused_without_a_hold(loop: Loop) -> None:
    loop.set(process_type="integrating", **DEFAULTS)
    answer = loop.rig.ask_for_tune(dry_run=True)
    assert not answer.accepted
    assert "connect controller_command, or give hold_gain" in answer.reason
    loop.set(start_without_hold=True)
    answer = loop.rig.ask_for_tune(dry_run=True)
    assert answer.accepted
    assert "then proportional control holds the process" in answer.reason
    loop.set(process_type="self_regulating", start_without_hold=False)


def test_stamped_sensors_steps_of_their_clock_and_arrays_of_commands(rig: Rig) -> None:
    """A numeric field of a stamped message in, an array of ros2_control out."""
    commands = rig.listen("command", Float64MultiArray, RELIABLE)
    experiments = rig.listen("relay_experiment", RelayExperiment)
    rig.relay(
        amplitude=0.5,
        baseline=BASELINE,
        settle_time=0.3,
        measurement_type="relay_autotune_msgs/msg/RelayCycle",
        measurement_field="settings.setpoint",
        command_type="std_msgs/msg/Float64MultiArray",
    )
    publisher = rig.node.create_publisher(RelayCycle, "measurement", 100)
    offset, count = 0.0, 0

    def publish() -> None:
        nonlocal count
        count += 1
        message = RelayCycle()
        message.settings.setpoint = 7.0 + 0.01 * math.sin(7.0 * count**2)
        ns = time.time_ns() + round(1e9 * offset)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns, 1_000_000_000)
        publisher.publish(message)

    rig.node.create_timer(PERIOD, publish)
    rig.tune()
    rig.until(lambda: any(list(m.data) == [BASELINE + 0.65] for m in commands), "the kick")
    offset = 0.2
    ended = rig.until(lambda: experiments, "the record")[-1]
    assert "a clock has stepped" in ended.reason
    assert ended.outcome == RelayExperiment.ABORTED
    assert max(ended.measurement) == pytest.approx(7.0, abs=0.02)
    rig.until(lambda: list(commands[-1].data) == [BASELINE], "the safe command")
    # A clock that goes back.
    rig.tune()
    offset = -5.0
    ended = rig.until(lambda: len(experiments) > 1 and experiments[-1], "the record")
    assert "time went backwards" in ended.reason


def test_in_takeover_the_node_is_silent_but_for_its_tune(rig: Rig) -> None:
    from_relay = rig.listen("command", Float64, RELIABLE)
    experiments = rig.listen("relay_experiment", RelayExperiment)
    controller = rig.node.create_publisher(Float64, "command", 10)
    sensor = rig.node.create_publisher(Float64, "measurement", 100)
    rig.relay(path="takeover", amplitude=0.5, settle_time=0.3, controller_timeout=0.3)
    rig.node.create_timer(PERIOD, lambda: sensor.publish(Float64(data=math.sin(len(from_relay)))))
    rig.until(lambda: controller.get_subscription_count() == 2, "the relay")
    controller.publish(Float64(data=BASELINE))
    # Before the tune only the controller is heard.
    rig.run_for(0.4)
    assert {m.data for m in from_relay} <= {BASELINE}
    controller.publish(Float64(data=BASELINE))
    rig.run_for(0.05)
    assert "is being commanded by another node" in rig.ask_for_tune(dry_run=True).reason
    rig.run_for(0.4)
    # Its last command is the baseline.
    started = rig.tune()
    assert f"about the baseline {BASELINE:g}" in started.reason
    rig.until(lambda: any(m.data == BASELINE + 0.65 for m in from_relay), "the kick")
    controller.publish(Float64(data=0.123))
    ended = rig.until(lambda: experiments, "the record")[-1]
    assert "another node commanded 0.123 on /command" in ended.reason
    # The controller has the loop again, so the node is silent.
    rig.run_for(0.2)
    count = len(from_relay)
    rig.run_for(0.3)
    assert len(from_relay) == count
