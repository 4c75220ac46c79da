# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The structure chosen from what the relay experiment records, its settling and kick with it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.waveform.method import identify_waveform
from relay_autotune.process.structures import LAG_COMPLEX, structure_named
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint, ultimate_point
from relay_autotune.process.virtual_process import Plant
from relay_autotune.record.record import Record

pytestmark = pytest.mark.long


def _point(model: TransferFunction) -> UltimatePoint:
    point = ultimate_point(model)
    assert point is not None
    return point


def _record(model: TransferFunction, noise_std: float, seed: int) -> Record:
    period = 2.0 * math.pi / _point(model).frequency / 100.0
    rng = np.random.default_rng(seed)
    experiment = RelayExperiment(ExperimentParameters(amplitude=1.0), 0.0)
    plant, command = Plant(model), 0.0
    for k in range(10_000):
        y = plant.advance(k * period, command) + noise_std * rng.standard_normal()
        command = experiment.step(k * period, y)
        if experiment.finished:
            break
    return experiment.record()


@pytest.mark.nightly
def test_a_first_swing_much_longer_than_the_cycles_does_not_turn_the_gain():
    model = TransferFunction.sopdt(2.0, (2.0, 0.99), 0.01)
    record = _record(model, 5e-4, 0)
    swing = np.diff(record.input().times)
    assert swing.max() > 3.0 * np.median(swing)
    found = identify_waveform(record)
    assert found.structure == "sopdt"
    assert found.ultimate_gain == pytest.approx(_point(model).gain, rel=0.04)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(3))
def test_a_pair_faster_than_its_lag_is_no_drift(seed):
    model = LAG_COMPLEX.build((1.0, 1.0, 10.0, 0.7, 0.0))
    found = identify_waveform(_record(model, 0.005, seed))
    assert found.structure == "lag_complex"
    assert found.model.gain == pytest.approx(1.0, rel=0.03)
    assert found.ultimate_frequency == pytest.approx(_point(model).frequency, rel=0.01)
    assert not any("drift" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("noise_std", "within"),
    [pytest.param(0.0, 1e-9, marks=pytest.mark.nightly), (0.002, 3e-3)],
)
@pytest.mark.parametrize(
    "model",
    [
        structure_named("sopdt_zero").of_fields(
            gain=0.186,
            zeros=[-0.771],
            time_constants=[1.248, 0.183],
            dead_time=0.071,
        ),
        pytest.param(
            structure_named("sopdt_zero").of_fields(
                gain=-0.271,
                zeros=[-0.702],
                time_constants=[1.968, 0.318],
                dead_time=0.05,
            ),
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_an_inverse_response_is_found_that_a_fopdt_does_not_show(model, noise_std, within):
    # Two equal lags and a zero were chosen, with a K_u up to 5 % off.
    found = identify_waveform(_record(model, noise_std * abs(model.gain), 1))
    assert found.structure == "sopdt_zero"
    assert found.ultimate_gain == pytest.approx(_point(model).gain, rel=within)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [3, 15])
def test_a_first_swing_that_a_fopdt_lacks_is_not_left_out(seed):
    model = TransferFunction(1.0, (), (1.0, 0.2, 0.04, 0.008), 0, 0.0)
    record = _record(model, 0.0018, seed)
    found = identify_waveform(record)
    assert found.fit.residual_rms < 3.0 * 0.0018
    # All of it is explained but the first samples, if those.
    assert np.mean(np.isfinite(found.fitted)) > 0.9
    assert found.ultimate_gain == pytest.approx(_point(model).gain, rel=0.03)
    assert found.model.gain == pytest.approx(1.0, rel=0.02)
