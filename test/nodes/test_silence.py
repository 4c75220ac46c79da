# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A sensor that speaks only when its value changes, as the nodes hear its silence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from relay_autotune.bag.definitions import FLOAT64
from relay_autotune.cli.own_nodes import free_domain
from relay_autotune.errors import ParameterError
from relay_autotune.exchange.messages import set_stamp
from relay_autotune.nodes import quality
from relay_autotune.nodes.controller import ControllerNode
from relay_autotune.nodes.live_types import reader_of
from relay_autotune.nodes.watch import Repeater, require_own_time
from relay_autotune.reasons import Code

PERIOD = 0.4
# Turns of the executor, more than there is to do: nothing happens in the last ones.
TURNS = 20
PATIENCE = 1500


class Simulated:
    """A clock and a sensor that do what a test says, and the node that hears them."""

    def __init__(self, create: Callable[[], Node]) -> None:
        self.world = Node("world", use_global_arguments=False)
        self.clock = self.world.create_publisher(Clock, "/clock", 10)
        self.sensor = self.world.create_publisher(Float64, "measurement", quality.RESULT)
        self.node = create()
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.world)
        self.executor.add_node(self.node)

    def until(self, condition: Callable[[], Any]) -> None:
        for _ in range(PATIENCE):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.02)
        raise AssertionError("it did not come")

    def rest(self) -> None:
        for _ in range(TURNS):
            self.executor.spin_once(timeout_sec=0.01)

    def at(self, time: float) -> None:
        """Let it be a time [s], and all be done that is to be done then."""
        message = Clock()
        set_stamp(message.clock, round(time * 1e9))

        def is_known() -> bool:
            self.clock.publish(message)
            self.executor.spin_once(timeout_sec=0.02)
            return self.node.get_clock().now().nanoseconds == round(time * 1e9)

        self.until(is_known)
        self.rest()

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.world.destroy_node()


def now(loop: Simulated) -> float:
    return float(loop.node.get_clock().now().nanoseconds) * 1e-9


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Simulated]]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    made: list[Simulated] = []
    with free_domain() as domain:

        def make(create: Callable[[], Node], **parameters: Any) -> Simulated:
            words = [f"{name}:={value}" for name, value in parameters.items()]
            given = [word for pair in words for word in ("-p", pair)]
            rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true", *given], domain_id=domain)
            made.append(Simulated(create))
            return made[-1]

        yield make
        for each in made:
            each.close()
        rclpy.try_shutdown()


def test_with_simulated_time_a_silence_is_as_long_as_that_clock_says(
    simulated: Callable[..., Simulated],
) -> None:
    repeated: list[tuple[float, float]] = []
    reader = reader_of(FLOAT64, "data")
    loop = simulated(lambda: Node("hearer"))
    repeater = Repeater(
        loop.node, PERIOD, reader, lambda y, ago: repeated.append((y, now(loop) - ago))
    )
    loop.at(10.0)
    assert not repeated
    assert not repeater.why_dead()
    # Said once, and kept for late subscribers.
    loop.sensor.publish(Float64(data=5.0))
    loop.until(lambda: repeater.age(0.0) == 0.0)
    # While that clock stands still, no time passes for the process either.
    loop.rest()
    assert not repeated
    for k in range(1, 7):
        loop.at(10.0 + 0.25 * k)
    # Each period, rounded up to what the clock shows: it was silent then, too.
    assert repeated == [(5.0, 10.5), (5.0, 11.0)]
    # What was said at a step is no silence, however late it comes.
    repeater.hear(6.0)
    for time in (11.75, 12.0):
        loop.at(time)
    assert len(repeated) == 2
    loop.at(12.25)
    assert repeated[2:] == [(6.0, 12.0)]
    # A clock that goes back is told by a sample with that time, not by none for nine seconds.
    for time in (3.0, 3.5, 4.0):
        loop.at(time)
    value, at = repeated[3]
    assert value == 6.0
    assert at in (3.0, 3.5)
    loop.world.destroy_publisher(loop.sensor)
    loop.until(lambda: repeater.why_dead() is not None)
    assert repeater.why_dead().code is Code.SENSOR_GONE


def test_the_controller_integrates_while_the_sensor_stands_by_its_value(
    simulated: Callable[..., Simulated], capfd: pytest.CaptureFixture[str]
) -> None:
    loop = simulated(
        ControllerNode,
        kc=2.0,
        ti=4.0,
        initial_setpoint=3.0,
        initial_command=1.0,
        repeat_period=PERIOD,
    )
    commands: list[float] = []
    loop.world.create_subscription(
        Float64, "controller_command", lambda m: commands.append(m.data), quality.COMMAND
    )
    loop.until(lambda: loop.node.count_subscribers("controller_command"))
    loop.at(10.0)
    # By two subscriptions: one for what was said before.
    loop.until(lambda: loop.sensor.get_subscription_count() == 2)
    loop.sensor.publish(Float64(data=2.0))
    loop.until(lambda: commands)
    loop.rest()
    del commands[:]
    loop.at(10.5)
    for k in range(1, 6):
        loop.at(10.5 + 0.5 * k)
        loop.until(lambda k=k: len(commands) >= k)
    # kc/ti e dt for each half second; the first sample makes no bump.
    assert commands == pytest.approx([1.0 + 2.0 / 4.0 * 1.0 * 0.5 * k for k in range(1, 6)])
    # On the word of a sensor that has left nothing runs away.
    loop.world.destroy_publisher(loop.sensor)
    loop.until(lambda: loop.node.count_publishers("measurement") == 0)
    for k in range(6, 9):
        loop.at(10.5 + 0.5 * k)
    assert len(commands) == 5
    loop.sensor = loop.world.create_publisher(Float64, "measurement", quality.RESULT)
    loop.sensor.publish(Float64(data=2.0))
    loop.until(lambda: len(commands) > 5)
    said = capfd.readouterr().err
    assert said.count("its publisher has left: the command is held") == 1
    assert said.count("the sensor is back") == 1


def test_a_number_of_samples_is_no_clock_of_what_is_repeated() -> None:
    require_own_time(0.0, 0.1)
    require_own_time(0.1, 0.0)
    with pytest.raises(ParameterError, match=r"repeat_period and sample_period 0.1 s are both"):
        require_own_time(0.1, 0.2)
