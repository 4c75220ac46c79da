"""Checks that tell a linear model from a process that is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_autotune.identification.checks import disagreeing_point, unequal_gains
from relay_autotune.identification.known import Known
from relay_autotune.identification.waveform import identify_waveform
from relay_autotune.models import TransferFunction
from relay_autotune.record import Outcome, Record, RelaySettings
from relay_autotune.simulation import Plant

MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)
RELAY = RelaySettings(5.0, 40.0, 1.0, 0.2, 0.1)


def _record(cooling: float, noise: float = 0.02, resting: int = 30, seed: int = 0) -> Record:
    """Run a sampled relay on a process whose actuator is weaker below the baseline."""
    rng = np.random.default_rng(seed)
    plant = Plant(MODEL)
    n, period = 1100, 0.2
    y, u, starts = np.empty(n), np.empty(n), []
    command, is_high = RELAY.baseline, True
    for k in range(n):
        push = command - RELAY.baseline
        y[k] = 5.0 + plant.advance(k * period, push if push > 0 else cooling * push)
        y[k] += noise * rng.standard_normal()
        was_high = is_high
        if k < resting:
            command = RELAY.baseline
        else:
            if is_high and y[k] > RELAY.setpoint + RELAY.hysteresis:
                is_high = False
            elif not is_high and y[k] < RELAY.setpoint - RELAY.hysteresis:
                is_high = True
            command = RELAY.high if is_high else RELAY.low
        if is_high and not was_high:
            starts.append(k)
        u[k] = command
    return Record(
        np.arange(n) * period,
        y,
        u,
        settings=RELAY,
        noise_std=noise,
        cycle_start=tuple(starts),
        outcome=Outcome.COMPLETED,
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_linear_process_raises_no_alarm(seed):
    record = _record(1.0, seed=seed)
    assert unequal_gains(record, MODEL) is None
    assert disagreeing_point(record, MODEL, 0.002) is None
    assert identify_waveform(record, Known(structure="fopdt")).warnings == ()


def test_an_actuator_that_pulls_less_than_it_pushes_is_told():
    told = unequal_gains(_record(0.6), MODEL)
    assert told is not None
    assert "act 1.00 times" in told
    assert "below it 0.60 times" in told
    found = identify_waveform(_record(0.6), Known(structure="fopdt"))
    assert any("not linear" in w for w in found.warnings)


def test_a_model_that_misses_the_fourier_point_is_told():
    wrong = TransferFunction.fopdt(1.65, 16.0, 10.0)
    told = disagreeing_point(_record(1.0), wrong, 0.002)
    assert told is not None
    assert "% off" in told
    assert disagreeing_point(_record(1.0), MODEL, math.nan) is None
