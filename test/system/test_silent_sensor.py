# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A sensor that publishes only on change, over DDS."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from typing import Any

import numpy as np
import pytest
from loop_rig import LATCHED, RELIABLE, Rig
from rclpy.action import ActionClient
from std_msgs.msg import Float64

from relay_autotune.process.transfer_function import TransferFunction as Process
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import RelayExperiment, TransferFunction, Verification

PLANT: dict[str, Any] = {
    "sample_period": 0.01,
    "structure": "fopdt",
    "gain": 2.0,
    "time_constants": [0.4],
    "dead_time": 0.2,
    "operating_point": [5.0, 1.0],
    "quantisation": 0.01,
    "on_change": True,
}


@pytest.mark.nightly
def test_a_tune_with_a_sensor_that_is_silent_at_rest(rig: Rig) -> None:
    experiments = rig.listen("relay_experiment", RelayExperiment)
    models = rig.listen("transfer_function", TransferFunction)
    commands = rig.listen("command", Float64, RELIABLE)
    values = rig.listen("measurement", Float64)
    plant = rig.plant(**PLANT)
    # The sensor has published its only value at rest before the relay starts.
    rig.until(lambda: values, "the measurement at rest")
    relay = rig.relay(amplitude=0.5, initial_command=1.0, repeat_period=0.02)
    rig.identifier()
    answer = rig.tune()
    rig.until(lambda: "is closed with" in relay.log, "closed bag")
    experiment, model = experiments[-1], models[-1]
    assert experiment.outcome == RelayExperiment.COMPLETED, experiment.reason
    assert "repeat the one before, since the sensor was silent" in experiment.reason
    # A busy machine delays steps of the plant, so that another structure may explain them better,
    # of which the cycles do not show the gain.
    true = ultimate_point(Process.fopdt(2.0, 0.4, 0.2))
    assert true is not None
    assert model.ultimate_gain == pytest.approx(true.gain, rel=0.1)
    # At rest nothing came, and the node repeated the last value every 20 ms.
    time, measurement = np.array(experiment.time), np.array(experiment.measurement)
    assert np.all(measurement[:20] == measurement[0])
    # A busy machine repeats some of them later, and none earlier.
    assert np.quantile(np.diff(time[:20]), 0.25) == pytest.approx(0.02, rel=0.2)
    done = subprocess.run(
        [str(shutil.which("replay")), "--json", "--structure=fopdt", str(rig.bag(answer))],
        capture_output=True,
        text=True,
        timeout=60,
    )
    shown = json.loads(done.stdout)["experiments"][-1]
    again = shown["models"][shown["selected"]]
    assert (again["gain"], again["dead_time"]) == (model.gain, model.dead_time)

    # Silence is no fault, but the end of the sensor's process is.
    said = len(values)
    assert rig.tune().accepted
    rig.until(lambda: len(values) > said + 50, "the oscillation")
    plant.signal(signal.SIGTERM)
    rig.until(lambda: len(experiments) > 1, "the end of the second tune")
    assert experiments[-1].outcome == RelayExperiment.ABORTED
    assert "no measurement on /measurement any more" in experiments[-1].reason
    rig.until(lambda: commands[-1].data == 1.0, "the safe command")


def test_a_number_of_samples_is_no_clock_of_a_silent_sensor(rig: Rig) -> None:
    rig.plant(**PLANT)
    rig.relay(amplitude=0.5, initial_command=1.0, repeat_period=0.02, sample_period=0.01)

    def refused() -> str:
        reason: str = rig.ask_for_tune().reason
        return reason if "repeat_period" in reason else ""

    reason = rig.until(refused, "the refusal")
    assert "repeat_period and sample_period 0.01 s are both given" in reason


def test_gains_are_proven_with_a_sensor_that_is_silent_at_rest(rig: Rig) -> None:
    commands = rig.listen("command", Float64, RELIABLE)
    values = rig.listen("measurement", Float64, RELIABLE)
    # In simulated time, of which more passes.
    rig.plant(**PLANT | {"mode": "clock", "speed": 4.0, "sample_period": 0.02})
    rig.start(
        "controller_node",
        "-r",
        "controller_command:=command",
        use_sim_time=True,
        repeat_period=0.03,
        kc=0.3,
        ti=0.4,
        initial_command=1.0,
        initial_setpoint=5.0,
        verify_step_max=0.5,
    )
    models = rig.node.create_publisher(TransferFunction, "transfer_function", LATCHED)
    models.publish(
        TransferFunction(
            final=True,
            verdict=TransferFunction.VERDICT_TRUSTED,
            numerator=[2.0],
            denominator=[0.4, 1.0],
            dead_time=0.2,
        )
    )
    rig.until(lambda: len(commands) > 60, "a closed loop")
    # The sensor's only message at rest.
    assert len(values) < 10
    steps = rig.listen("verification", Verification)
    client = ActionClient(rig.node, Verify, "controller_node/verify")
    rig.until(client.server_is_ready, "the action")
    sent = client.send_goal_async(Verify.Goal(setpoint_step=0.5))
    rig.until(sent.done, "the goal")
    answer = sent.result().get_result_async()
    rig.until(answer.done, "the result")
    client.destroy()
    result = answer.result().result
    assert result.verdict == result.PASSED, result.reason
    (step,) = rig.until(lambda: steps, "the samples of the step")
    assert step.gain_ratio == pytest.approx(1.0, abs=0.2)
    # No gap, although the sensor is silent once the loop has settled.
    assert np.median(np.diff(step.time)[-20:]) == pytest.approx(0.04, abs=0.021)
    assert np.count_nonzero(np.diff(step.measurement)[-20:]) < 10
