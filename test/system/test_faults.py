# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Every fault of docs/safety.md over real DDS: safe command first, then reason, record, no gains.

One relay_node serves all that do not end it; the loop about it is played by the test itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from random import Random

import pytest
from faults import FAULTS, abort, have_relay
from faulty_loop import BASELINE, DEFAULTS, SAFE, Loop
from loop_rig import RELIABLE, Rig
from rclpy.node import Node
from ros_domain import free_domain
from std_msgs.msg import Float32, Float64

from relay_autotune.reasons import Code
from relay_autotune_msgs.msg import RelayExperiment

# Moments of a fault; `benchmarks/fault_table.py` tries two hundred.
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))]
# On a busy machine the tune of this one may reach max_cycles first: it then ends at the baseline.
BUSY = "fast switching"
NAMES = [pytest.param(n, marks=[pytest.mark.nightly] if n == BUSY else []) for n in FAULTS]


@pytest.fixture(scope="module")
def loop_of(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Loop]]:
    """Return a loop of a kind, created once."""
    made: dict[str, Loop] = {}
    with ExitStack() as stack:

        def loop_of(kind: str) -> Loop:
            if kind not in made:
                domain = stack.enter_context(free_domain())
                rig = Rig(domain, tmp_path_factory.mktemp(kind))
                stack.callback(rig.close)
                made[kind] = Loop(rig, kind)
                if kind == "plain":
                    # No gains come of any method; the quickest leaves the processor to the loop.
                    rig.identifier(method="atv")
            return made[kind]

        yield loop_of


@pytest.fixture
def loop(loop_of: Callable[[str], Loop]) -> Loop:
    loop = loop_of("plain")
    have_relay(loop)
    loop.set(**DEFAULTS)
    return loop


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_fault_ends_in_the_safe_command(
    loop_of: Callable[[str], Loop], name: str, seed: int
) -> None:
    FAULTS[name].course(loop_of(FAULTS[name].kind), Random(f"{name} {seed}"))


@pytest.mark.parametrize("seed", SEEDS)
def test_an_actuator_that_sticks_for_a_moment_is_no_end_of_all_cycles(
    loop: Loop, seed: int
) -> None:
    # One stay of 0.8 s between stays of 0.06 s.
    sticks = Random(seed).uniform(0.75, 0.85)
    loop.set(min_cycles=3, max_cycles=12)
    loop.tune()
    loop.rig.until(lambda: loop.switches >= 2, "the first switches")
    loop.stick()
    loop.rig.run_for(sticks)
    loop.release()
    ended = loop.ended()
    assert ended.reason
    loop.rig.until(lambda: loop.commands[-1] in (BASELINE, SAFE), "the end")
    commands = list(ended.command)
    switches = sum(a != b for a, b in itertools.pairwise(commands))
    # Each of the twelve cycles takes three of the long stays, 40 switches, if none is clear.
    assert switches < 12 * 40
    if ended.outcome == RelayExperiment.COMPLETED:
        assert len(ended.cycle_start) > 3
    loop.check_that_it_stays(commands[-1])


@pytest.mark.parametrize(
    ("topic", "said"),
    [
        ("command", "/command is also published by /onlooker"),
        ("measurement", "/measurement is published by 2 publishers, /left_over and /onlooker"),
        ("controller_command", "/controller_command is published by 2 publishers"),
        ("", "2 nodes have the name /relay_node"),
    ],
)
def test_what_there_are_two_of_refuses_the_next_tune(loop: Loop, topic: str, said: str) -> None:
    loop.rig.until(lambda: loop.rig.ask_for_tune(dry_run=True).accepted, "a loop that is ready")
    name = "left_over" if topic else "relay_node"
    left_over = Node(name, context=loop.rig.context, start_parameter_services=False)
    own = loop.rig.node.create_publisher(Float64, topic, 10) if "command" in topic else None
    if topic in ("measurement", "controller_command"):
        left_over.create_publisher(Float64, topic, 10)

    def is_refused() -> bool:
        answer = loop.rig.ask_for_tune(dry_run=True)
        return not answer.accepted and said in answer.reason

    try:
        loop.rig.until(is_refused, "the refusal")
        assert not loop.rig.ask_for_tune().accepted
    finally:
        left_over.destroy_node()
        if own is not None:
            loop.rig.node.destroy_publisher(own)
    loop.rig.until(lambda: loop.rig.ask_for_tune(dry_run=True).accepted, "a loop that is ready")


@pytest.mark.parametrize("seed", SEEDS)
def test_commands_stay_within_their_limits_and_rate(loop: Loop, seed: int) -> None:
    random = Random(seed)
    top, rate = random.uniform(1.3, 1.5), random.uniform(20.0, 60.0)
    limits = {"command_min": 0.7, "command_max": top, "command_rate": rate}
    # Beyond the limits.
    loop.set(amplitude=0.0, target_amplitude=10.0, **limits)
    loop.tune()
    loop.rig.until(lambda: loop.experiments or loop.commands.count(top) > 60, "the upper limit")
    abort(loop, random)
    record = loop.check_the_end(Code.REQUESTED)
    command = list(record.command)[:-1]
    assert 0.7 <= min(command) < max(command) == top
    for k in range(1, len(command)):
        allowed = rate * (record.time[k] - record.time[k - 1])
        assert abs(command[k] - command[k - 1]) <= allowed + 1e-9


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


# What is rounded on its way comes back as it is, too.
@pytest.mark.parametrize("kind", [pytest.param(Float64, marks=pytest.mark.nightly), Float32])
def test_in_takeover_the_node_is_silent_but_for_its_tune(
    rig: Rig, kind: type[Float64 | Float32]
) -> None:
    from_relay = rig.listen("command", kind, RELIABLE)
    experiments = rig.listen("relay_experiment", RelayExperiment)
    controller = rig.node.create_publisher(kind, "command", 10)
    sensor = rig.node.create_publisher(Float64, "measurement", 100)
    rig.relay(
        path="takeover",
        command_type=f"std_msgs/msg/{kind.__name__}",
        amplitude=0.5,
        settle_time=0.3,
        controller_timeout=0.3,
        measurement_timeout=5.0,
    )
    rig.node.create_timer(0.01, lambda: sensor.publish(Float64(data=math.sin(len(from_relay)))))
    rig.until(lambda: controller.get_subscription_count() == 2, "the relay")
    rig.until(sensor.get_subscription_count, "the relay's ear")
    controller.publish(kind(data=BASELINE))
    # Before the tune only the controller publishes the command.
    rig.run_for(0.4)
    assert {m.data for m in from_relay} <= {BASELINE}

    def refused() -> bool:
        controller.publish(kind(data=BASELINE))
        rig.run_for(0.05)
        return "is being commanded by another node" in rig.ask_for_tune(dry_run=True).reason

    rig.until(refused, "a refusal")
    rig.run_for(0.4)
    # Its last command is the baseline.
    started = rig.tune()
    assert f"about the baseline {BASELINE:g}" in started.reason
    # Its own commands come back to it, those of 32 bits rounded.
    kicked = pytest.approx(BASELINE + 0.65, rel=1e-6)
    rig.until(lambda: any(m.data == kicked for m in from_relay), "the kick")
    controller.publish(kind(data=0.123))
    ended = rig.until(lambda: experiments, "the record")[-1]
    assert "another node commanded 0.123 on /command" in ended.reason
    # The controller commands the loop again, so the node is silent.
    rig.run_for(0.2)
    count = len(from_relay)
    rig.run_for(0.3)
    assert len(from_relay) == count
