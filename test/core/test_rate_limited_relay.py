# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Commands that take time from level to level."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lsim, tf2ss

from relay_autotune.errors import IdentificationError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.process.structures import INTEGRATOR_LAG
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant
from relay_autotune.record.record import Record


@cache
def _record(rate: float) -> Record:
    parameters = ExperimentParameters(amplitude=1.0, command_rate=rate, bias_ratio=0.0)
    loop = RelayExperiment(parameters, 0.0)
    plant, command = Plant(TransferFunction.fopdt(1.65, 20.0, 10.0)), 0.0
    for k in range(5_000):
        command = loop.step(0.2 * k, plant.advance(0.2 * k, command))
        if loop.finished:
            break
    return loop.record()


@pytest.mark.long
def test_the_command_as_it_was_gives_the_exact_process():
    found = identify(_record(0.5), known=Known(structure="fopdt"))
    assert found.values == pytest.approx((1.65, 20.0, 10.0), rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("method", ["wang_unbiased", "chang", "atv", "thyagarajan"])
def test_methods_for_an_ideal_relay_step_aside(method):
    with pytest.raises(IdentificationError, match="between its two levels"):
        identify(_record(0.5), method)
    assert identify(_record(0.0), method).model.gain > 0.0


@pytest.mark.nightly
@pytest.mark.parametrize(
    "model",
    [TransferFunction.fopdt(1.65, 20.0, 10.0), INTEGRATOR_LAG.build((0.5, 2.0, 1.0))],
)
def test_a_command_that_moves_between_its_samples(model):
    # Straight lines of the command, and the process by an independent solver.
    slowest = max(t.real for t in model.time_constants)
    time = np.linspace(0.0, 12.0 * slowest, 500)
    knots = slowest * np.array((0.5, 1.5, 4.0, 5.0, 8.0))
    levels = np.array((0.0, 1.0, 1.0, -1.0, -0.5))
    command = np.interp(time, knots, levels)
    a, b, c, d = tf2ss(model.numerator, model.denominator)
    fine = np.linspace(0.0, time[-1], 12_001)
    delayed = np.interp(fine - model.dead_time, knots, levels)
    # Exact for a linear input between fine samples, which hold the knots nearly.
    _, y, _ = lsim((a, b, c, d), delayed, fine, interp=True)
    record = Record(time, np.interp(time, fine, y), command)
    known = Known(structure=model.structure)
    ramps = identify(replace(record, continuous_command=True), "waveform", known)
    held = identify(record, "waveform", known)
    assert ramps.model.gain == pytest.approx(model.gain, rel=2e-4)
    assert ramps.model.dead_time == pytest.approx(model.dead_time, abs=2e-4 * slowest)
    # A staircase lags by half an interval, which the dead time makes up for.
    assert held.model.dead_time == pytest.approx(
        model.dead_time - 0.5 * time[1], abs=0.1 * time[1]
    )
