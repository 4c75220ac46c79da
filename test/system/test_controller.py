# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The whole way over DDS: controller, tune, apply, verify, revert."""

from __future__ import annotations

import math
import re
import shutil
import signal
import subprocess
from itertools import pairwise
from statistics import median
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from loop_rig import LATCHED, RELIABLE, Rig
from made_experiments import experiment_of
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from relay_autotune.process.transfer_function import TransferFunction as Process
from relay_autotune.recordings import read_experiments
from relay_autotune.text import digits
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, RelayExperiment, TransferFunction, Verification

PLANT = {
    "mode": "clock",
    "speed": 4.0,
    "sample_period": 0.04,
    "structure": "fopdt",
    "gain": 2.0,
    "time_constants": [0.8],
    "dead_time": 0.4,
    "operating_point": [5.0, 1.0],
    "noise_std": 0.002,
    "seed": 5,
}
PROCESS = Process.fopdt(2.0, 0.8, 0.4)
CONTROLLER = {
    "use_sim_time": True,
    "kc": 0.3,
    "ti": 0.8,
    "initial_command": 1.0,
    "initial_setpoint": 5.0,
}


def trigger(rig: Rig, name: str) -> Any:
    return rig.call(Trigger, f"controller_node/{name}", Trigger.Request())


def parameters_of(rig: Rig) -> list[float]:
    return rig.values("controller_node", "kc", "ti")


def verify(rig: Rig, **request: float) -> tuple[int, Any]:
    client = ActionClient(rig.node, Verify, "controller_node/verify")
    rig.until(client.server_is_ready, "the action")
    sent = client.send_goal_async(Verify.Goal(**request))
    rig.until(sent.done, "the goal")
    answer = sent.result().get_result_async()
    rig.until(answer.done, "the result")
    client.destroy()
    return answer.result().status, answer.result().result


def test_a_loop_is_tuned_through_its_controller_and_proves_the_gains(rig: Rig) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    wanted = rig.listen("controller_command", Float64, RELIABLE)
    measured = rig.listen("measurement", Float64, RELIABLE)
    gains = rig.listen("pi_gains", PidGains)
    experiments = rig.listen("relay_experiment", RelayExperiment)
    rig.plant(**PLANT)
    relay = rig.relay(
        use_sim_time=True,
        amplitude=0.5,
        settle_time=1.0,
        measurement_timeout=10.0,
        controller_timeout=10.0,
    )
    controller = rig.start(
        "controller_node", **CONTROLLER, verify_load_max=0.1, verify_step_max=0.2
    )
    rig.identifier(use_sim_time=True)
    # The commands are passed through unchanged, and the loop is closed.
    rig.until(lambda: len(wanted) > 300 and len(commands) > 300, "a closed loop")
    tail = len(wanted) - 5
    assert {m.data for m in wanted[tail - 50 : tail]} <= {m.data for m in commands}
    # The samples may arrive here later than the commands that answer them.
    rig.until(lambda: abs(sum(m.data for m in measured[-50:]) / 50 - 5.0) < 0.02, "the set-point")
    assert not trigger(rig, "apply").success
    answer = rig.tune()
    # The mean of the controller's commands is the baseline.
    assert float(answer.reason.split("baseline ")[1].split(";")[0]) == pytest.approx(1.0, abs=0.02)
    rig.until(lambda: gains, "gains")
    ended = experiments[-1]
    assert ended.outcome == RelayExperiment.COMPLETED, ended.reason
    # The command returns to the controller without a bump: no step of the relay's size.
    before = len(commands)
    rig.until(lambda: len(commands) > before + 200, "the controller's commands")
    assert max(abs(m.data - 1.0) for m in commands[before:]) < 0.25
    for change in ("a tune has begun", "the tune has ended"):
        assert controller.log.count(change) == 1
    # Gains are applied only on request.
    assert "wait: kc" in controller.log
    process = subprocess.Popen(
        [shutil.which("apply_gains"), "--yes", "--step", "0.2", "--load", "0.1"],
        env=rig.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    # Taking messages meanwhile, so that none wait in the queue afterwards.
    rig.until(lambda: process.poll() is not None, "the verdict", timeout=90.0)
    output, said = process.communicate()
    assert process.returncode == 0, output + said
    shown, _, verdict = output.rpartition("  verdict ")
    told = " ".join(verdict.split())
    assert told.startswith("passed")
    assert "+0.2 y: overshoot" in told and "+0.1 u: overshoot" in told
    assert f"kc {digits(gains[-1].kc)}" in told
    for part in ("0.3000", digits(gains[-1].kc), digits(gains[-1].ti)):
        assert part in shown
    assert "step 1 of 2, set-point +0.2 y, " in said
    assert re.search(r"the measurement is \S+ y\b", said)
    assert "step 2 of 2, load +0.1 u, " in controller.log
    tuned = [gains[-1].kc, gains[-1].ti]
    assert parameters_of(rig) == tuned
    full = rig.listen("verification", Verification)
    rig.until(lambda: len(full) == 2, "the samples of both steps")
    assert [s.kind for s in full] == [1, 2]
    for step in full:
        assert len(step.time) == len(step.measurement) == len(step.predicted) > 20
        assert step.gain_ratio == pytest.approx(1.0, abs=0.3)
    # A load that is larger than allowed is refused.
    status, result = verify(rig, load_step=5.0)
    assert status == GoalStatus.STATUS_ABORTED
    assert "verify_load_max allows 0.1" in result.reason
    reverted = trigger(rig, "revert")
    assert "kc 0.3" in reverted.message
    assert parameters_of(rig) == [0.3, 0.8]
    # The gains that are shown are applied again, and no others that a page has offered since.
    offer = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
    other = PidGains(final=True, verdict=PidGains.VERDICT_TRUSTED, kc=0.31, ti=0.8, b=1.0)
    other.experiment_id = "page"
    offer.publish(other)
    rig.until(lambda: "gains of page wait" in controller.log, "the gains of a page")
    rig.node.destroy_publisher(offer)
    again = rig.start_command("apply_gains", "--yes", "--no-verify")
    rig.until(lambda: not again.running, "the command", timeout=90.0)
    assert again.wait() == 0, again.log
    assert parameters_of(rig) == tuned
    assert trigger(rig, "revert").success
    # While the predictions were computed, each measurement was answered.
    assert "has been silent" not in relay.log
    # Manual mode.
    answer = rig.call(SetBool, "controller_node/automatic", SetBool.Request(data=False))
    assert answer.success
    count = len(wanted)
    rig.until(lambda: len(wanted) > count + 100, "held commands")
    assert len({m.data for m in wanted[-20:]}) == 1
    (record,) = read_experiments(rig.bag(ended)).experiments
    assert record.settings is not None


def test_commands_that_nobody_takes_are_held_and_begin_without_a_bump(rig: Rig) -> None:
    heard = rig.listen("measurement", Float64, RELIABLE)
    rig.plant(**PLANT | {"mode": "realtime", "speed": 1.0, "sample_period": 0.005})
    # Its error would move an integral that went on, by 0.3 u each second.
    waiting = CONTROLLER | {"use_sim_time": False, "initial_setpoint": 5.8}
    controller = rig.start("controller_node", **waiting)
    rig.until(lambda: "held until somebody subscribes" in controller.log, "the controller")
    before = len(heard)
    rig.until(lambda: len(heard) > before + 300, "measurements")
    commands = rig.listen("controller_command", Float64, RELIABLE)
    rig.until(lambda: len(commands) > 200, "commands")
    assert commands[0].data == pytest.approx(1.0, abs=0.05)
    assert commands[-1].data > 1.1
    assert controller.log.count("has a subscriber: it begins from 1\n") == 1


def test_a_relay_node_that_passes_commands_on_begins_and_ends_at_known_ones(rig: Rig) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    relay = rig.relay(initial_command=2.0, return_time=30.0, safe_command=1.5)
    sender = rig.node.create_publisher(Float64, "controller_command", RELIABLE)

    def passed() -> bool:
        sender.publish(Float64(data=0.0))
        return len(commands) > 20

    rig.until(passed, "commands that are passed on")
    # The controller is at 0, the actuator was at 2.
    assert commands[0].data == pytest.approx(2.0, abs=1e-9)
    assert 1.0 < commands[20].data < 2.0
    relay.signal(signal.SIGTERM)
    relay.wait()
    rig.until(lambda: commands[-1].data == 1.5, "the safe command")


def test_a_controller_that_answers_samples_may_be_silent_between_them(rig: Rig) -> None:
    """One that answers a slow sensor was taken for dead, and its commands replaced."""
    commands = rig.listen("command", Float64, RELIABLE)
    sensor = rig.node.create_publisher(Float64, "measurement", RELIABLE)
    controller = rig.node.create_publisher(Float64, "controller_command", RELIABLE)
    rig.relay(safe_command=0.5, controller_timeout=0.05)
    rig.until(
        lambda: sensor.get_subscription_count() and controller.get_subscription_count(),
        "the relay",
    )

    def sample(*answer: Float64) -> float:
        """Return the command after a sample and its answer; NaN: there was none yet."""
        sensor.publish(Float64(data=5.0))
        for command in answer:
            controller.publish(command)
        rig.run_for(0.2)
        return commands[-1].data if commands else math.nan

    sample()
    sample()
    for _ in range(10):
        sample(Float64(data=0.7))
    assert [m.data for m in commands] == [0.7] * 10
    # It falls silent while the samples go on.
    rig.until(lambda: sample() == 0.5, "the safe command")


def test_gains_that_do_not_do_what_was_predicted_go_back(rig: Rig) -> None:
    """The published model has half the gain of the process."""
    commands = rig.listen("command", Float64, RELIABLE)
    rig.plant(**PLANT)
    rig.start(
        "controller_node",
        "-r",
        "controller_command:=command",
        **CONTROLLER,
        verify_step=0.3,
        auto_apply=True,
    )
    experiments = rig.node.create_publisher(RelayExperiment, "relay_experiment", LATCHED)
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
    experiments.publish(experiment_of(PROCESS, "wrong"))
    model = TransferFunction(
        final=True,
        verdict=TransferFunction.VERDICT_TRUSTED,
        numerator=[0.9],
        denominator=[0.8, 1.0],
        dead_time=0.4,
    )
    model.experiment_id = "wrong"
    models.publish(model)
    gains.publish(
        PidGains(
            final=True,
            verdict=PidGains.VERDICT_TRUSTED,
            kc=0.9,
            ti=0.8,
            b=1.0,
            experiment_id="wrong",
        )
    )
    rig.until(lambda: len(commands) > 400, "a closed loop")
    status, result = verify(rig)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert result.verdict == result.FAILED
    assert "kc 0.3, ti 0.8 s, td 0 s in force again" in result.reason
    assert parameters_of(rig) == [0.3, 0.8]
    # Only one earlier set exists, so there is one revert at most.
    assert len(result.steps) <= 1


def test_gains_for_another_law_are_proven_by_a_node_that_runs_it(rig: Rig) -> None:
    rig.plant(**PLANT | {"sample_period": 0.02})
    commands = rig.listen("command", Float64, RELIABLE)
    law = {"law": "pid_controller", "law_period": 0.1}
    controller = rig.start(
        "controller_node", "-r", "controller_command:=command",
        **CONTROLLER, **law, verify_step=0.3, auto_apply=True,
    )  # fmt: skip
    experiments = rig.node.create_publisher(RelayExperiment, "relay_experiment", LATCHED)
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)
    experiments.publish(experiment_of(PROCESS, "of a law"))
    model = TransferFunction(final=True, numerator=[2.0], denominator=[0.8, 1.0], dead_time=0.4)
    model.experiment_id, model.verdict = "of a law", TransferFunction.VERDICT_TRUSTED
    models.publish(model)
    sent = PidGains(final=True, kc=0.4, ti=0.8, td=0.12, b=1.0, experiment_id="of a law")
    sent.verdict = PidGains.VERDICT_TRUSTED
    sent.law, sent.law_period = "pid_controller", 0.2
    gains.publish(sent)
    rig.until(lambda: "and this node runs it every 0.1 s" in controller.log, "the refusal")
    sent.law_period = 0.1
    gains.publish(sent)
    rig.until(lambda: rig.values("controller_node", "kc", "td") == [0.4, 0.12], "the gains")
    rig.until(lambda: len(commands) > 400, "a closed loop")
    status, result = verify(rig)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.reason
    assert result.verdict == result.PASSED, result.reason
    # The law takes the derivative of the error, so that a step of the set-point jumps through it,
    # and it runs at every fifth sample: most of its commands stand for five of them. On a busy
    # machine, which loses samples or delays them, some stand for other numbers.
    values = [message.data for message in commands]
    assert max(values) > 1.0 + 0.9 * (0.4 + 0.4 * 0.12 / 0.1) * 0.3
    changed = [k for k, (a, b) in enumerate(pairwise(values)) if a != b]
    assert 4 <= median(b - a for a, b in pairwise(changed)) <= 6


def test_a_verification_waits_for_the_samples_of_a_slow_sensor(rig: Rig) -> None:
    """It was refused while they were fewer than ten, which a slow sensor does not give in time."""
    controller = rig.start(
        "controller_node", initial_setpoint=5.0, kc=0.3, ti=0.8, verify_step=0.2
    )
    rig.listen("controller_command", Float64, RELIABLE)
    sensor = rig.node.create_publisher(Float64, "measurement", RELIABLE)
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    model = TransferFunction(final=True, numerator=[2.0], denominator=[0.8, 1.0], dead_time=0.4)
    model.experiment_id, model.verdict = "of a test", TransferFunction.VERDICT_TRUSTED
    models.publish(model)
    client = ActionClient(rig.node, Verify, "controller_node/verify")
    rig.until(lambda: client.server_is_ready() and sensor.get_subscription_count(), "the node")
    said = [""]

    def sampled(expected: str) -> bool:
        sensor.publish(Float64(data=5.0))
        rig.run_for(0.3)
        return expected in controller.log + said[-1]

    rig.until(lambda: sampled("has a subscriber"), "the ear of the command")
    client.send_goal_async(
        Verify.Goal(patience=60.0), lambda message: said.append(message.feedback.status)
    )
    rig.until(lambda: "samples have come with a command" in said[-1], "the wait")
    rig.until(lambda: sampled("step 1 of 1"), "the step")
    client.destroy()


def test_doubtful_gains_are_never_applied_by_themselves(rig: Rig) -> None:
    controller = rig.start("controller_node", **CONTROLLER, auto_apply=True)
    experiments = rig.node.create_publisher(RelayExperiment, "relay_experiment", LATCHED)
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)

    def publish(name: str, verdict: int, kc: float) -> None:
        experiments.publish(experiment_of(PROCESS, name))
        model = TransferFunction(
            final=True, numerator=[0.9], denominator=[0.8, 1.0], dead_time=0.4
        )
        model.experiment_id, model.verdict = name, verdict
        models.publish(model)
        found = PidGains(final=True, kc=kc, ti=0.8, b=1.0, experiment_id=name)
        found.verdict, found.verdict_reason = verdict, "the cycles differ: look at the valve"
        gains.publish(found)

    publish("doubtful", PidGains.VERDICT_DOUBTFUL, 0.5)
    rig.until(lambda: "gains of doubtful wait" in controller.log, "the doubtful gains")
    refused = trigger(rig, "apply")
    assert not refused.success
    assert "the cycles differ: look at the valve" in refused.message
    assert "accept_doubtful" in refused.message
    # Trusted gains are applied; so only the verdict kept the doubtful ones back.
    publish("trusted", PidGains.VERDICT_TRUSTED, 0.6)
    rig.until(lambda: parameters_of(rig) == [0.6, 0.8], "the trusted gains")
    publish("again", PidGains.VERDICT_DOUBTFUL, 0.5)
    rig.until(lambda: "gains of again wait" in controller.log, "the doubtful gains")
    assert parameters_of(rig) == [0.6, 0.8]
    # The command takes them, and leaves the node as it was.
    by_command = rig.start_command("apply_gains", "--yes", "--no-verify", "--accept-doubtful")
    by_command.wait()
    assert parameters_of(rig) == [0.5, 0.8]
    assert rig.values("controller_node", "accept_doubtful") == [False]
    publish("at last", PidGains.VERDICT_DOUBTFUL, 0.55)
    rig.until(lambda: "gains of at last wait" in controller.log, "the doubtful gains")
    told = Parameter("accept_doubtful", value=True).to_parameter_msg()
    request = SetParameters.Request(parameters=[told])
    assert rig.call(SetParameters, "controller_node/set_parameters", request).results[0].successful
    assert trigger(rig, "apply").success
    assert parameters_of(rig) == [0.55, 0.8]


def test_gains_go_to_another_node_all_or_none(rig: Rig) -> None:
    rig.start_python(
        "pid_controller",
        """
import rclpy
from rclpy.node import Node
from rcl_interfaces.msg import SetParametersResult
rclpy.init()
node = Node("pid_controller")
for name in "pid":
    node.declare_parameter(f"gains.heater.{name}", 1.0)
def judge(changes):
    fine = all(c.value < 100.0 for c in changes)
    return SetParametersResult(successful=fine, reason="" if fine else "too large for this one")
node.add_on_set_parameters_callback(judge)
rclpy.spin(node)
""",
    )
    names = ",".join(f"{name}:gains.heater.{name}" for name in "pid")
    controller = rig.start("controller_node", apply_to="/pid_controller", apply_parameters=names)
    gains = rig.node.create_publisher(PidGains, "pi_gains", LATCHED)

    def values() -> list[float]:
        found = rig.values("pid_controller", *(f"gains.heater.{name}" for name in "pid"))
        assert {type(value) for value in found} == {float}
        return found

    assert values() == [1.0, 1.0, 1.0]
    gains.publish(
        PidGains(
            final=True,
            verdict=PidGains.VERDICT_TRUSTED,
            kc=2.0,
            ti=4.0,
            td=0.125,
            p=2.0,
            i=0.5,
            d=0.25,
            experiment_id="one",
        )
    )
    rig.until(lambda: "gains of one wait" in controller.log, "the gains")
    applied = rig.until(
        lambda: ((a := trigger(rig, "apply")).success and a) or None, "the other node"
    )
    assert "gains of one: /pid_controller has" in applied.message
    assert values() == [2.0, 0.5, 0.25]
    gains.publish(
        PidGains(
            final=True,
            verdict=PidGains.VERDICT_TRUSTED,
            kc=200.0,
            ti=4.0,
            p=200.0,
            i=50.0,
            d=0.0,
            experiment_id="two",
        )
    )
    rig.until(lambda: "gains of two wait" in controller.log, "the gains")
    refused = trigger(rig, "apply")
    assert not refused.success
    assert "too large for this one" in refused.message
    assert values() == [2.0, 0.5, 0.25]
    assert trigger(rig, "revert").success
    assert values() == [1.0, 1.0, 1.0]


def set_point_relay(rig: Rig, **relay: Any) -> None:
    rig.plant(**PLANT)
    rig.relay(
        use_sim_time=True,
        relay_on="setpoint",
        setpoint=5.0,
        amplitude=0.4,
        settle_time=1.0,
        measurement_timeout=3.0,
        controller_timeout=3.0,
        **relay,
    )
    rig.start("controller_node", **CONTROLLER)
    rig.identifier(use_sim_time=True)


def test_a_relay_on_the_set_point_keeps_the_loop_closed(rig: Rig) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    wanted = rig.listen("controller_command", Float64, RELIABLE)
    setpoints = rig.listen("setpoint", Float64, RELIABLE)
    models = rig.listen("transfer_function", TransferFunction)
    experiments = rig.listen("relay_experiment", RelayExperiment)
    set_point_relay(rig)
    rig.until(lambda: len(wanted) > 300 and len(commands) > 300, "a closed loop")
    rig.tune()
    rig.until(lambda: models and models[-1].final, "the model")
    (ended,) = experiments
    assert ended.outcome == RelayExperiment.COMPLETED, ended.reason
    # The relay moved the set-point, within its amplitude and bias, and restored it.
    levels = {round(m.data, 9) for m in setpoints}
    assert levels == {4.72, 5.0, 5.52}
    rig.until(lambda: setpoints[-1].data == 5.0, "the restored set-point")
    # Meanwhile the controller's commands were passed through and recorded.
    assert set(ended.command) <= {m.data for m in wanted}
    assert ended.settings.setpoint == 5.0
    assert ended.settings.baseline == pytest.approx(1.0, abs=0.03)
    # So the model is that of the process, not of the closed loop.
    assert models[-1].gain == pytest.approx(2.0, rel=0.1)
    assert models[-1].dead_time == pytest.approx(0.4, abs=0.06)


@pytest.mark.nightly
def test_a_relay_on_the_set_point_ends_when_it_knows_enough(rig: Rig) -> None:
    wanted = rig.listen("controller_command", Float64, RELIABLE)
    models = rig.listen("transfer_function", TransferFunction)
    experiments = rig.listen("relay_experiment", RelayExperiment)
    set_point_relay(rig, stop_when="confident", confidence=0.05, max_cycles=40)
    rig.until(lambda: len(wanted) > 300, "a closed loop")
    rig.tune()
    rig.until(lambda: models and models[-1].final, "the model")
    (ended,) = experiments
    assert ended.outcome == RelayExperiment.COMPLETED, ended.reason
    assert "as narrow as asked, 0.05" in ended.reason
    # While it ran, the process was identified from the controller's commands.
    judged = next(m for m in reversed(models) if not m.final)
    assert 1.96 * judged.ultimate_gain_std <= 0.05 * judged.ultimate_gain
    assert judged.ultimate_gain == pytest.approx(models[-1].ultimate_gain, rel=0.1)
    assert models[-1].gain == pytest.approx(2.0, rel=0.15)
    assert models[-1].dead_time == pytest.approx(0.4, abs=0.06)


@pytest.mark.long
@pytest.mark.parametrize("given", [math.nan, 0.7])
def test_its_end_leaves_no_load_of_a_verification(rig: Rig, given: float) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    rig.plant(**PLANT)
    controller = rig.start(
        "controller_node", "-r", "controller_command:=command",
        **CONTROLLER, verify_load_max=0.6, safe_command=given,
    )  # fmt: skip
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    models.publish(
        TransferFunction(
            final=True,
            verdict=TransferFunction.VERDICT_TRUSTED,
            numerator=[2.0],
            denominator=[0.8, 1.0],
            dead_time=0.4,
        )
    )
    rig.until(lambda: len(commands) > 400, "a closed loop")
    client = ActionClient(rig.node, Verify, "controller_node/verify")
    rig.until(client.server_is_ready, "the action")

    def has_begun() -> bool:
        """Ask until the loop is at rest."""
        sent = client.send_goal_async(Verify.Goal(load_step=0.6))
        rig.until(sent.done, "the goal")
        answer = sent.result().get_result_async()
        rig.until(lambda: answer.done() or commands[-1].data > 1.4, "the load")
        return not answer.done()

    rig.until(has_begun, "a verification")
    controller.signal(signal.SIGHUP)
    assert controller.wait() == 0
    rig.until(
        lambda: commands[-1].data == pytest.approx(1.0 if math.isnan(given) else given, abs=0.03),
        "the safe command",
    )
    assert "was stopped by SIGHUP; the command is left at" in controller.log
    assert "Traceback" not in controller.log
    assert "never awaited" not in controller.log
    client.destroy()
