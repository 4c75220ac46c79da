# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The faults of a tune, each with the loop that makes it and the expected reason."""

from __future__ import annotations

import fcntl
import itertools
import math
import os
import pty
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any

from action_msgs.msg import GoalStatus
from faulty_loop import BASELINE, DEFAULTS, PERIOD, REST, SAFE, Loop
from rclpy.action import ActionClient
from rclpy.node import Node
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from relay_autotune.reasons import Code
from relay_autotune_msgs.action import Tune

BROKEN = """
import sys
from relay_autotune.nodes import relay
step = relay.RelayExperiment.step
def broken(self, time, measurement):
    if self.sample_count == {count}:
        raise ZeroDivisionError("a defect")
    return step(self, time, measurement)
relay.RelayExperiment.step = broken
sys.exit(relay.main())
"""


OTHER_SIGNALS = (
    signal.SIGQUIT, signal.SIGABRT, signal.SIGALRM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGPWR,
    signal.SIGTSTP, signal.SIGXCPU, signal.SIGIO, signal.SIGRTMIN, signal.SIGRTMIN + 5,
)  # fmt: skip

Why = Code | tuple[Code, ...]
AWAY = Code.MOVED_AWAY_LOAD, Code.MOVED_AWAY_UNSTABLE
LOST = Code.NO_ANSWER, *AWAY, Code.SATURATED, Code.TOO_SLOW, Code.TOO_FEW_SAMPLES
FAST = Code.FAST_CYCLES, Code.FAST_IN_CYCLE, Code.FAST_STAYS

Undo = Callable[[], object]
Cause = Callable[[Loop, Random], "Undo | None"]

# Parameters with which the tune finds the amplitude itself.
FINDS = {"amplitude": 0.0, "command_min": 0.0, "command_max": 10.0}


@dataclass(frozen=True)
class Fault:
    """A fault.

    :param course: causes the fault once, checks the end, and returns the time from the cause to
        the arrival of the safe command [s]; raises AssertionError if a check fails.
    :param kind: kind of the loop that it needs.
    """

    course: Callable[[Loop, Random], float]
    kind: str = "plain"


def in_a_tune(
    cause: Cause, why: Why, *, kind: str = "plain", at_start: bool = False, **parameters: Any
) -> Fault:
    """Return a fault that ends a tune with a reason.

    :param cause: causes the fault; returns the function that undoes it, None: the loop's reset.
    :param why: the code of the reason, or one of several.
    :param kind: kind of the loop.
    :param at_start: True: the fault exists from the start; False: from a random moment on.
    :param parameters: parameters of the relay, besides the usual ones.
    """

    def course(loop: Loop, random: Random) -> float:
        have_relay(loop)
        loop.set(**{**DEFAULTS, **parameters})
        loop.tune()
        if not at_start:
            wait_for_a_moment(loop, random)
        began = time.monotonic()
        undo = cause(loop, random)
        try:
            taken = until_safe(loop, began)
            loop.check_the_end(why)
            loop.check_that_it_stays()
        finally:
            if undo is not None:
                undo()
        return taken

    return Fault(course, kind)


def with_the_node(code: str, number: int, why: Why, status: int) -> Fault:
    """Return a fault with which the process of relay_node ends.

    :param code: Python code instead of the executable; "": the executable.
    :param number: signal that ends it; 0: it ends by itself.
    :param why: the code of the reason, or one of several.
    :param status: its exit status.
    """

    def course(loop: Loop, random: Random) -> float:
        replace_relay(loop, code.format(count=random.randint(60, 200)))
        loop.tune()
        process = loop.process
        assert process is not None
        if number:
            wait_for_a_moment(loop, random)
            began = time.monotonic()
            process.signal(number)
        else:
            loop.rig.until(lambda: loop.commands[-1] != BASELINE, "a first step")
            began = time.monotonic()
        return ended_by_itself(loop, began, why, status)

    return Fault(course)


def any_other_signal(loop: Loop, random: Random) -> float:
    """Send a signal that ends a process without a handler."""
    number = random.choice(OTHER_SIGNALS)
    return with_the_node("", number, Code.SIGNAL, 0).course(loop, random)


def ended_by_itself(loop: Loop, began: float, why: Why, status: int) -> float:
    """Check that relay_node ends its tune and itself; return the time since the cause [s].

    :param began: time of the cause.
    :param why: the code of the reason, or one of several.
    :param status: its exit status.
    """
    taken = until_safe(loop, began)
    loop.check_the_end(why)
    assert loop.process is not None
    left = loop.process.wait()
    assert left == status, f"exit status {left}: {loop.process.log[-500:]}"
    assert "Traceback" not in loop.process.log
    loop.process = None
    loop.rig.run_for(0.05)
    assert loop.commands[-1] == SAFE
    return taken


# Outputs for a node: each function returns the node's end and the other end.


def terminal() -> tuple[int, int]:
    """Return a terminal for a node, and its controlling end."""
    window, inside = pty.openpty()
    return inside, window


def small_pipe() -> tuple[int, int]:
    """Return a pipe that fills up soon."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    return writer, reader


def terminal_closed(loop: Loop, random: Random) -> float:
    """Close the terminal in which relay_node runs."""
    output, window = terminal()
    replace_relay(loop, output=output)
    os.close(output)
    loop.tune()
    wait_for_a_moment(loop, random)
    began = time.monotonic()
    os.close(window)
    return ended_by_itself(loop, began, Code.SIGNAL, 0)


def output_not_taken(
    loop: Loop,
    random: Random,
    make: Callable[[], tuple[int, int]],
    stop: Callable[[int], object] = lambda _: None,
) -> float:
    """Stop reading relay_node's output: the tune must go on and end as usual.

    :param make: makes the two ends of its output.
    :param stop: stops the other end from reading.
    """
    output, other = make()
    replace_relay(loop, output=output)
    os.close(output)
    try:
        loop.tune()
        wait_for_a_moment(loop, random)
        stop(other)
        # Each refusal is a line of the log; together they are more than a pipe holds.
        for _ in range(40):
            assert not loop.rig.ask_for_tune().accepted
        count = loop.switches
        loop.rig.until(lambda: loop.switches > count + 2, "a tune that goes on")
        began = time.monotonic()
        abort(loop, random)
        taken = until_safe(loop, began)
        loop.check_the_end(Code.REQUESTED)
        loop.check_that_it_stays()
        assert loop.process is not None
        loop.process.signal(signal.SIGTERM)
        assert loop.process.wait() == 0
        loop.process = None
    finally:
        with suppress(OSError):
            os.close(other)
    return taken


def have_relay(loop: Loop) -> None:
    """Start a relay_node if there is none."""
    if loop.process is None:
        replace_relay(loop)


def replace_relay(loop: Loop, code: str = "", output: int | None = None) -> None:
    """Start a relay_node, or Python code instead, after the previous one has gone."""
    if loop.process is not None:
        loop.process.end()
    node = loop.rig.node
    loop.rig.until(
        lambda: node.count_publishers("relay_experiment") == 0, "the end of the relay before"
    )
    loop.start(code, output)


def wait_for_a_moment(loop: Loop, random: Random) -> None:
    """Let the relay oscillate for a random time."""
    loop.until_it_oscillates(random.randint(4, 9))
    loop.rig.run_for(random.uniform(0.0, 0.1))


def until_safe(loop: Loop, began: float) -> float:
    """Wait for the safe command to end the tune; return the time since the cause [s]."""
    # A command from before the start may have the same value.
    loop.rig.until(
        lambda: loop.commands[-1] == SAFE and len(loop.commands) > 5, "the safe command"
    )
    return time.monotonic() - began


def altered(change: Callable[[Loop, float], float | None]) -> Callable[[Loop, Random], None]:
    """Return a cause that changes the sensor's values."""

    def cause(loop: Loop, _: Random) -> None:
        loop.alter = lambda y: change(loop, y)

    return cause


def frozen(loop: Loop, random: Random) -> None:
    value = random.uniform(4.9, 5.1)
    loop.alter = lambda _: value


def jittering(loop: Loop, random: Random) -> None:
    """Let the sensor jump over the relay's band with each sample, after a whole cycle."""
    loop.rig.until(lambda: loop.cycles, "a whole cycle")
    size = random.uniform(0.2, 0.4)
    loop.alter = lambda _: REST + (size if loop.count % 2 else -size)


def wrong_sign(loop: Loop, _: Random) -> None:
    loop.gain = -2.0


def before_a_cycle(loop: Loop, random: Random) -> None:
    """Silence the sensor after the process has followed the relay, before a whole cycle."""
    # Within the dead time no further switch can come.
    samples = random.randint(0, 9)

    def silent(y: float) -> float | None:
        nonlocal samples
        if loop.switches < 3:
            return y
        samples -= 1
        return None if samples < 0 else y

    loop.alter = silent


def silent_in_a_cycle(loop: Loop, _: Random) -> None:
    """Silence the sensor after a whole cycle, from which on its silence is judged."""
    loop.rig.until(lambda: loop.cycles, "a whole cycle")
    loop.alter = lambda _: None


def sensor_leaves(loop: Loop, _: Random) -> Callable[[], None]:
    loop.sensor_leaves()
    return loop.sensor_comes


def growing(loop: Loop, random: Random) -> None:
    """Make each swing larger than the one before, by the same factor."""
    factor, seen, scale = random.uniform(1.2, 1.4), len(loop.commands), 1.0

    def grown(y: float) -> float:
        nonlocal seen, scale
        switches = sum(a != b for a, b in itertools.pairwise(loop.commands[seen - 1 :]))
        scale, seen = scale * factor**switches, len(loop.commands)
        return REST + (y - REST) * scale

    loop.alter = grown


def clock_step(size: float) -> Callable[[Loop, Random], None]:
    def cause(loop: Loop, random: Random) -> None:
        loop.clock_error = size * random.uniform(1.0, 3.0)

    return cause


def second_publisher(topic: str) -> Cause:
    """Return a cause that adds a publisher to a topic."""

    def cause(loop: Loop, _: Random) -> Callable[[], None]:
        other = loop.rig.node.create_publisher(Float64, topic, 10)
        return lambda: loop.rig.node.destroy_publisher(other)

    return cause


def joints(*names: str) -> Cause:
    """Return a cause that changes the joints that the sensor names."""

    def cause(loop: Loop, _: Random) -> None:
        loop.joints = names

    return cause


def second_node(loop: Loop, _: Random) -> Callable[[], None]:
    """Add a second node with the relay's name."""
    other = Node("relay_node", context=loop.rig.context, start_parameter_services=False)
    return other.destroy_node


def clock_stands(loop: Loop, _: Random) -> None:
    loop.clock_stands = True


def abort(loop: Loop, _: Random) -> None:
    answer = loop.rig.call(Trigger, "relay_node/abort", Trigger.Request())
    # A busy listener may acknowledge too late for relay_node; the end of the test checks whether
    # the command has arrived.
    assert answer.success
    assert "the safe command" in answer.message


def actuator(loop: Loop, random: Random) -> float:
    """Publish the position of an actuator, which then stops moving.

    The amplitude is given or not, and the first position may come during the tune.
    """
    stuck, node = False, loop.rig.node
    ends: list[Any] = []

    def feed() -> None:
        for end in ends:
            if loop.commands:
                end.publish(Float64(data=BASELINE - 0.35 if stuck else loop.commands[-1]))

    def speak() -> None:
        ends.append(node.create_publisher(Float64, "command_feedback", 10))
        loop.rig.until(ends[0].get_subscription_count, "the relay")
        loop.rig.run_for(0.05)

    timer = node.create_timer(0.01, feed)
    late, finds = random.random() < 0.5, random.random() < 0.5
    try:
        have_relay(loop)
        loop.set(**{**DEFAULTS, **(FINDS if finds else {})})
        if not late:
            speak()
        loop.tune()
        wait_for_a_moment(loop, random)
        loop.rig.until(lambda: loop.cycles, "a whole cycle")
        if late:
            speak()
        stuck, began = True, time.monotonic()
        taken = until_safe(loop, began)
        loop.check_the_end(Code.NOT_FOLLOWING)
        loop.check_that_it_stays()
    finally:
        node.destroy_timer(timer)
        for end in ends:
            node.destroy_publisher(end)
    loop.rig.run_for(0.9)
    return taken


def controller(loop: Loop, random: Random, *, in_tune: bool) -> float:
    """Play a controller that becomes silent, in a tune or while it is passed through."""
    wanted, speaking = random.uniform(1.2, 1.3), True
    publisher = loop.rig.node.create_publisher(Float64, "controller_command", 10)
    timer = loop.rig.node.create_timer(
        PERIOD, lambda: publisher.publish(Float64(data=wanted)) if speaking else None
    )
    try:
        have_relay(loop)
        loop.set(**DEFAULTS)
        # Without a tune, its commands are passed through unchanged.
        loop.rig.until(lambda: loop.commands and loop.commands[-1] == wanted, "the controller")
        if in_tune:
            loop.tune()
            wait_for_a_moment(loop, random)
            speaking, began = False, time.monotonic()
            taken = until_safe(loop, began)
            loop.check_the_end(Code.SILENT_CONTROLLER)
        else:
            loop.begin()
            loop.rig.run_for(random.uniform(0.05, 0.2))
            speaking, began = False, time.monotonic()
            taken = until_safe(loop, began)
            loop.rig.until(lambda: loop.is_said("has been silent"), "the diagnostics")
        loop.check_that_it_stays()
    finally:
        loop.rig.node.destroy_timer(timer)
        loop.rig.node.destroy_publisher(publisher)
    return taken


def cancelled(loop: Loop, random: Random) -> float:
    """Cancel a goal of the action ~/tune."""
    have_relay(loop)
    loop.set(**DEFAULTS)
    loop.begin()
    client = ActionClient(loop.rig.node, Tune, "relay_node/tune")
    loop.rig.until(client.server_is_ready, "the action")
    loop.rig.until(lambda: loop.rig.ask_for_tune(dry_run=True).accepted, "a loop that is ready")
    sent = client.send_goal_async(Tune.Goal())
    loop.rig.until(sent.done, "the goal")
    answer = sent.result().get_result_async()
    wait_for_a_moment(loop, random)
    began = time.monotonic()
    sent.result().cancel_goal_async()
    taken = until_safe(loop, began)
    loop.check_the_end(Code.CANCELLED)
    loop.rig.until(answer.done, "the result")
    assert answer.result().status == GoalStatus.STATUS_CANCELED
    assert not answer.result().result.gains.experiment_id
    loop.check_that_it_stays()
    client.destroy()
    return taken


FAULTS = {
    "silent sensor": in_a_tune(
        altered(lambda _, y: None), Code.SILENT_SENSOR, measurement_timeout=1.2
    ),
    "frozen sensor": in_a_tune(frozen, Code.FROZEN_SENSOR),
    "NaN from the sensor": in_a_tune(altered(lambda _, y: math.nan), Code.BAD_MEASUREMENT),
    "infinity from the sensor": in_a_tune(altered(lambda _, y: -math.inf), Code.BAD_MEASUREMENT),
    "measurement limits": in_a_tune(
        altered(lambda _, y: y + 100.0), Code.OUTSIDE_LIMITS, measurement_max=50.0
    ),
    "largest deviation": in_a_tune(
        altered(lambda _, y: y + 100.0), Code.TOO_FAR, max_deviation=10.0
    ),
    "longest half cycle": in_a_tune(
        altered(lambda loop, y: 4.9 + loop.noise()), LOST, max_half_cycle=0.7
    ),
    "longest experiment": in_a_tune(
        lambda loop, random: None, Code.MAX_DURATION, at_start=True, max_duration=1.0
    ),
    "no response": in_a_tune(
        altered(lambda loop, y: 5.0 + loop.noise()),
        Code.MAX_DURATION,
        at_start=True,
        max_duration=0.5,
    ),
    "response that saturates": in_a_tune(
        altered(lambda loop, y: min(y, 4.9) + 1e-2 * loop.noise()), Code.SATURATED
    ),
    "gain of the wrong sign": in_a_tune(wrong_sign, AWAY, at_start=True),
    "unstable growth": in_a_tune(growing, Code.GROWING),
    "fast switching": in_a_tune(jittering, FAST),
    "step of the source's clock": in_a_tune(clock_step(0.2), Code.CLOCK_STEPPED, kind="stamped"),
    "source time that goes back": in_a_tune(clock_step(-1.0), Code.TIME_BACKWARDS, kind="stamped"),
    "/clock that goes back": in_a_tune(clock_step(-1.0), Code.TIME_BACKWARDS, kind="clock"),
    "/clock that stands still": in_a_tune(
        clock_stands, Code.TIME_STANDS, kind="clock", measurement_timeout=2.5
    ),
    "sensor on change that has left": in_a_tune(sensor_leaves, Code.SENSOR_GONE, kind="on change"),
    "sensor on change, silent in a cycle": in_a_tune(
        silent_in_a_cycle, Code.SILENT_TOO_LONG, kind="on change"
    ),
    "sensor on change, silent before a cycle": in_a_tune(
        before_a_cycle, Code.NO_ANSWER, kind="on change", at_start=True, max_half_cycle=0.6
    ),
    "joint that is missing": in_a_tune(joints("right", "arm"), Code.MISREAD, kind="joint"),
    "joint that is there twice": in_a_tune(
        joints("left", "arm", "left"), Code.MISREAD, kind="joint"
    ),
    "silent sensor under a Twist": in_a_tune(
        altered(lambda _, y: None),
        Code.SILENT_SENSOR,
        kind="joint",
        measurement_timeout=1.2,
    ),
    "limits under a Twist": in_a_tune(
        altered(lambda _, y: y + 100.0),
        Code.OUTSIDE_LIMITS,
        kind="joint",
        measurement_max=50.0,
    ),
    "abort under a Twist": in_a_tune(abort, Code.REQUESTED, kind="joint"),
    "second publisher of command": in_a_tune(second_publisher("command"), Code.SECOND_PUBLISHER),
    "second publisher of measurement": in_a_tune(
        second_publisher("measurement"), Code.SECOND_SOURCE
    ),
    "second node of the name": in_a_tune(second_node, Code.NAMESAKE),
    "controller silent in a tune": Fault(partial(controller, in_tune=True)),
    "controller silent when idle": Fault(partial(controller, in_tune=False)),
    "actuator that does not follow": Fault(actuator),
    "abort": in_a_tune(abort, Code.REQUESTED),
    "cancelled action": Fault(cancelled),
    "SIGINT": with_the_node("", signal.SIGINT, Code.SIGNAL, 0),
    "SIGTERM": with_the_node("", signal.SIGTERM, Code.SIGNAL, 0),
    "SIGHUP": with_the_node("", signal.SIGHUP, Code.SIGNAL, 0),
    "any other signal": Fault(any_other_signal),
    "terminal that is closed": Fault(terminal_closed),
    "terminal that is paused": Fault(
        partial(output_not_taken, make=terminal, stop=lambda window: os.write(window, b"\x13"))
    ),
    "output that is full": Fault(partial(output_not_taken, make=small_pipe)),
    "output that is gone": Fault(partial(output_not_taken, make=small_pipe, stop=os.close)),
    "exception in a callback": with_the_node(BROKEN, 0, Code.NODE_FAILED, 1),
}
