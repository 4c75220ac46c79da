# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A relay whose actuator sticks, which goes on with the noise of the sensor alone."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.faults import why_noise_alone
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.process.structures import structure_named
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.reasons import Code
from relay_autotune.record.record import Outcome

PROCESS = structure_named("lag_n").of_fields(
    gain=-1.0, time_constants=[1.7], order=3, dead_time=0.1
)
PERIOD = 0.09


# With these seeds noise made few cycles, and the tune went on for more than 15,000 samples.
@pytest.mark.long
@pytest.mark.parametrize("seed", [5, 7, 15, 26, 49])
def test_an_actuator_that_sticks_while_the_amplitude_is_found_ends_the_tune(seed):
    plant = VirtualProcess(PROCESS, disturbances=Disturbances(noise_std=0.004), seed=seed)
    tune = RelayExperiment(ExperimentParameters(command_min=-3.0, command_max=3.0), 0.0)
    for k in range(15_000):
        command = tune.step(k * PERIOD, plant.measure(k * PERIOD))
        if tune.finished:
            break
        if k < 160:
            plant.command(command)
    assert tune.outcome is Outcome.FAILED
    assert "no oscillation after" in tune.reason


def test_noise_and_an_oscillation_are_told_apart():
    rng = np.random.default_rng(0)
    noise = 0.1 * rng.standard_normal(60)
    why = why_noise_alone(noise, 0.1, 2)
    assert why is not None and why.code is Code.NOISE_ALONE
    # What a relay with a band of three standard deviations lets pass at the least.
    ramp = np.linspace(-0.3, 0.3, 60) + noise
    assert not why_noise_alone(ramp, 0.1, 2)
    assert not why_noise_alone(np.zeros(60), 0.0, 2)
