# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""After any end of a tune, the last command is the baseline and the record is kept."""

from __future__ import annotations

import signal
import time
from typing import Any

import pytest
from loop_rig import RELIABLE, Process, Rig
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from relay_autotune.record.record import Outcome
from relay_autotune.recordings import read_experiments
from relay_autotune_msgs.msg import PidGains, RelayExperiment

BASELINE = 1.0


class RunningTune:
    """A slow process in real time, tuned by a relay that has made its first step."""

    def __init__(self, rig: Rig, relay: Process | None = None) -> None:
        self.commands = rig.listen("command", Float64, RELIABLE)
        self.experiments = rig.listen("relay_experiment", RelayExperiment)
        self.gains = rig.listen("pi_gains", PidGains)
        self.plant = rig.plant(
            sample_period=0.02,
            structure="fopdt",
            gain=2.0,
            time_constants=[20.0],
            dead_time=2.0,
            operating_point=[5.0, BASELINE],
        )
        self.relay = relay or rig.relay(amplitude=0.5, baseline=BASELINE, settle_time=0.4)
        self.rig = rig
        self.answer = rig.tune()
        rig.until(self.is_moving, "a first step of the relay")

    def is_moving(self) -> bool:
        return any(m.data != BASELINE for m in self.commands)

    def ended(self) -> Any:
        return self.rig.until(lambda: self.experiments, "the record")[-1]


# The safe command after each of them is one of the faults of test_faults.py.
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGTERM,
        pytest.param(signal.SIGINT, marks=pytest.mark.nightly),
        pytest.param(signal.SIGHUP, marks=pytest.mark.nightly),
    ],
)
def test_a_signal_leaves_the_safe_command_and_a_whole_bag(rig: Rig, number: int) -> None:
    tune = RunningTune(rig)
    rig.run_for(0.7)
    assert tune.commands[-1].data != BASELINE
    asked = time.monotonic()
    tune.relay.signal(number)
    assert tune.relay.wait() == 0
    assert time.monotonic() - asked < 5.0
    rig.until(lambda: tune.commands[-1].data == BASELINE, "the safe command")
    rig.run_for(0.3)
    assert tune.commands[-1].data == BASELINE
    name = signal.Signals(number).name
    ended = tune.ended()
    assert ended.outcome == RelayExperiment.ABORTED
    assert name in ended.reason
    (record,) = read_experiments(rig.bag(tune.answer)).experiments
    assert record.outcome == Outcome.ABORTED
    assert len(record) == len(ended.time) >= 30
    assert not tune.gains


def test_a_second_signal_changes_nothing(rig: Rig) -> None:
    tune = RunningTune(rig)
    tune.relay.signal(signal.SIGINT)
    tune.relay.signal(signal.SIGTERM)
    tune.relay.signal(signal.SIGINT)
    assert tune.relay.wait() == 0
    rig.until(lambda: tune.commands[-1].data == BASELINE, "the safe command")
    assert tune.ended().outcome == RelayExperiment.ABORTED


def test_signals_to_the_very_end_change_nothing(rig: Rig) -> None:
    """`ros2 launch` sends its own SIGINT besides the terminal's."""
    node = rig.identifier()
    rig.until(lambda: "ready" in node.log, "start of the node")
    while node.running:
        node.signal(signal.SIGINT)
        rig.run_for(0.002)
    assert node.wait() == 0
    assert "Traceback" not in node.log


def test_a_killed_node_leaves_all_but_the_last_half_second(rig: Rig) -> None:
    tune = RunningTune(rig)
    rig.run_for(1.5)
    answered = len(tune.commands)
    tune.relay.signal(signal.SIGKILL)
    tune.relay.wait()
    recording = read_experiments(rig.bag(tune.answer))
    (record,) = recording.experiments
    # At 50 samples a second; the last flush may be a little more than half a second old.
    assert len(record) >= answered - 50 * 0.5 - 15
    assert record.outcome != Outcome.COMPLETED
    assert record.experiment_id == tune.answer.experiment_id
    assert any("unfinished" in note for note in recording.notes)


def test_abort_answers_after_the_safe_command_has_arrived(rig: Rig) -> None:
    tune = RunningTune(rig)
    answer = rig.call(Trigger, "relay_node/abort", Trigger.Request())
    assert answer.success
    assert "safe command 1 is out" in answer.message
    assert "not acknowledged" not in answer.message
    rig.until(lambda: tune.commands[-1].data == BASELINE, "the safe command")
    ended = tune.ended()
    assert ended.outcome == RelayExperiment.ABORTED
    assert "aborted on request" in ended.reason
    # From here on each measurement is answered with the baseline.
    before = len(tune.commands)
    rig.until(lambda: len(tune.commands) > before + 20, "commands after the tune")
    assert {m.data for m in tune.commands[before:]} == {BASELINE}
    again = rig.call(Trigger, "relay_node/abort", Trigger.Request())
    assert not again.success
    assert again.message == "no tune is running"
    assert not tune.gains


def test_a_silent_sensor_ends_the_tune(rig: Rig) -> None:
    tune = RunningTune(rig)
    tune.plant.signal(signal.SIGSTOP)
    stopped = time.monotonic()
    rig.until(lambda: tune.commands[-1].data == BASELINE, "the safe command")
    assert time.monotonic() - stopped < 2.0
    ended = tune.ended()
    assert ended.outcome == RelayExperiment.ABORTED
    assert "no measurement on /measurement for" in ended.reason
    tune.plant.signal(signal.SIGCONT)


def test_an_exception_in_a_callback_ends_in_the_safe_command(rig: Rig) -> None:
    # The installed node, with a defect in the experiment after a hundred samples.
    relay = rig.start_python(
        "broken_relay",
        """
import sys
from relay_autotune.nodes import relay
step = relay.RelayExperiment.step
def broken(self, time, measurement):
    if self.sample_count == 100:
        raise ZeroDivisionError("a defect")
    return step(self, time, measurement)
relay.RelayExperiment.step = broken
sys.exit(relay.main())
""",
        amplitude=0.5,
        baseline=BASELINE,
        settle_time=0.4,
        record_directory=str(rig.records),
    )
    tune = RunningTune(rig, relay)
    assert relay.wait() == 1
    rig.until(lambda: tune.commands[-1].data == BASELINE, "the safe command")
    ended = tune.ended()
    assert ended.outcome == RelayExperiment.ABORTED
    assert "ZeroDivisionError: a defect" in ended.reason
    assert len(ended.time) == 100
    assert "Traceback" not in relay.log
    assert relay.log.count("[FATAL]") == 1
    (record,) = read_experiments(rig.bag(tune.answer)).experiments
    assert len(record) == 100


# All nodes have the handler with which test_faults.py ends relay_node by each signal.
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGHUP,
        pytest.param(signal.SIGQUIT, marks=pytest.mark.nightly),
        pytest.param(signal.SIGUSR1, marks=pytest.mark.nightly),
    ],
)
def test_nodes_that_command_nothing_end_in_order_too(rig: Rig, number: int) -> None:
    plant = rig.plant(sample_period=0.02, structure="fopdt", time_constants=[1.0])
    nodes = [rig.identifier(), plant]
    for node in nodes:
        rig.until(lambda node=node: "sample period" in node.log or "ready" in node.log, "a node")
        node.signal(number)
        assert node.wait() == 0
        assert "Traceback" not in node.log


def test_nohup_is_heeded(rig: Rig) -> None:
    """A node that was started with SIGHUP ignored must go on without the terminal."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        node = rig.identifier()
    finally:
        signal.signal(signal.SIGHUP, before)
    rig.until(lambda: "ready" in node.log, "the node")
    node.signal(signal.SIGHUP)
    rig.run_for(0.5)
    assert node.running


def test_an_idle_node_is_silent_to_its_end(rig: Rig) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    rig.plant(sample_period=0.02, structure="fopdt", time_constants=[1.0])
    relay = rig.relay(amplitude=0.5, baseline=BASELINE)
    rig.until(lambda: rig.ask_for_tune(dry_run=True).accepted, "measurements at the relay")
    relay.signal(signal.SIGINT)
    assert relay.wait() == 0
    rig.run_for(0.2)
    assert not commands


def test_the_initial_command_answers_before_the_first_tune(rig: Rig) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    rig.plant(sample_period=0.02, structure="fopdt", time_constants=[1.0])
    rig.relay(initial_command=0.25)
    rig.until(lambda: len(commands) > 5, "commands before a tune")
    assert {m.data for m in commands} == {0.25}


def test_samples_that_the_middleware_lost_are_counted(rig: Rig) -> None:
    experiments = rig.listen("relay_experiment", RelayExperiment)
    rig.listen("command", Float64, RELIABLE)
    publisher = rig.node.create_publisher(Float64, "measurement", 10)
    relay = rig.relay(
        amplitude=0.5, baseline=BASELINE, settle_time=600.0, measurement_timeout=60.0
    )
    rig.until(publisher.get_subscription_count, "the relay")
    timer = rig.node.create_timer(0.01, lambda: publisher.publish(Float64()))
    rig.tune()
    rig.run_for(0.3)
    rig.node.destroy_timer(timer)
    relay.signal(signal.SIGSTOP)
    # More messages than the queue of the stopped relay keeps.
    for _ in range(400):
        publisher.publish(Float64())
    relay.signal(signal.SIGCONT)
    rig.run_for(0.5)
    publisher.publish(Float64())
    rig.run_for(0.2)
    rig.call(Trigger, "relay_node/abort", Trigger.Request())
    ended = rig.until(lambda: experiments, "the record")[-1]
    assert ended.lost_samples >= 100
    assert ended.lost_samples + len(ended.time) >= 400


def test_a_plant_in_lockstep_waits_for_the_next_relay(rig: Rig) -> None:
    experiments = rig.listen("relay_experiment", RelayExperiment)
    rig.plant(
        mode="lockstep",
        sample_period=0.1,
        structure="fopdt",
        time_constants=[2.0],
        dead_time=1.0,
    )
    for count in (1, 2):
        relay = rig.relay(amplitude=1.0, baseline=0.0, sample_period=0.1, model_timeout=0.0)
        rig.tune()
        rig.until(lambda count=count: len(experiments) == count, "the record")
        assert experiments[-1].outcome == RelayExperiment.COMPLETED
        relay.signal(signal.SIGTERM)
        assert relay.wait() == 0
