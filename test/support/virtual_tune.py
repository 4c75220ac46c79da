# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A relay experiment on a simulated process, without ROS."""

from __future__ import annotations

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess

SAMPLES = 20_000


def tuned(
    model: TransferFunction,
    parameters: ExperimentParameters,
    *,
    period: float,
    seed: int,
    **acting: float,
) -> RelayExperiment:
    """Run an experiment about baseline 0 to its end, or to the largest number of samples.

    :param model: the process.
    :param parameters: parameters of the experiment.
    :param period: period of the samples [s].
    :param seed: seed of the sensor's noise.
    :param acting: disturbances.
    """
    plant = VirtualProcess(model, disturbances=Disturbances(**acting), seed=seed)
    tune = RelayExperiment(parameters, 0.0)
    for k in range(SAMPLES):
        plant.command(tune.step(k * period, plant.measure(k * period)))
        if tune.finished:
            break
    return tune
