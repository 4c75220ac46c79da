# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A relay of the wrong direction, which oscillates on the first answer of an inverse response."""

from __future__ import annotations

import numpy as np
import pytest
from virtual_tune import tuned

from relay_autotune.analysis import analyse
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.known import Known
from relay_autotune.identification.waveform.method import identify_waveform
from relay_autotune.process.response import response
from relay_autotune.process.structures import structure_named
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Plant
from relay_autotune.record.record import Outcome, PiecewiseConstant, Record
from relay_autotune.verdict import Result, Verdict

pytestmark = pytest.mark.long

SECOND_ORDER = structure_named("sopdt_zero").of_fields(
    gain=0.38, time_constants=[1.3, 0.32], zeros=[-1.2], dead_time=0.09
)
SLOWER = structure_named("sopdt_zero").of_fields(
    gain=-2.1, time_constants=[1.1, 0.28], zeros=[-2.9], dead_time=0.47
)
INTEGRATOR = structure_named("integrator_inverse").of_fields(
    gain=0.4, time_constants=[0.38], zeros=[-1.4], dead_time=0.1
)


def run(model, *, sign, period, **acting):
    parameters = ExperimentParameters(amplitude=1.0, process_gain_sign=sign)
    return tuned(model, parameters, period=period, seed=11, **acting)


@pytest.mark.parametrize(
    ("model", "period", "noise_std"),
    [
        pytest.param(SECOND_ORDER, 0.015, 0.0, marks=pytest.mark.nightly),
        pytest.param(SECOND_ORDER, 0.015, 0.03, marks=pytest.mark.nightly),
        pytest.param(SLOWER, 0.04, 0.0, marks=pytest.mark.nightly),
        pytest.param(SLOWER, 0.04, 0.5, marks=pytest.mark.nightly),
        (INTEGRATOR, 0.015, 0.03),
    ],
)
def test_a_record_that_speaks_for_the_other_direction_yields_no_gains(model, period, noise_std):
    tune = run(model, sign=-model.process_sign, period=period, noise_std=noise_std)
    assert tune.outcome is Outcome.COMPLETED
    found = analyse(tune.record(), alone=True)
    assert found.best_gains is None
    assert f"process_gain_sign {model.process_sign} " in found.reason
    # What the relay's own direction would have given is a model of the wrong sign.
    assert found.model.model.process_sign == -model.process_sign


@pytest.mark.parametrize(
    ("model", "period"),
    [(SECOND_ORDER, 0.05), pytest.param(SLOWER, 0.1, marks=pytest.mark.nightly)],
)
def test_the_right_direction_of_an_inverse_response_yields_gains(model, period):
    noise = {"noise_std": 0.01 * abs(model.gain)}
    tune = run(model, sign=model.process_sign, period=period, **noise)
    found = analyse(tune.record(), alone=True)
    assert found.best_gains is not None
    assert np.sign(found.best_gains.kc) == model.process_sign


@pytest.mark.nightly
@pytest.mark.parametrize(
    "acting",
    [
        {"drift": 0.003, "noise_std": 0.01},
        {"load_time": 9.0, "load_size": 0.3, "noise_std": 0.01},
        {"quantisation": 0.1},
        {"noise_std": 0.1},
    ],
)
def test_what_a_disturbance_leaves_does_not_speak_for_the_other_direction(acting):
    model = TransferFunction.fopdt(1.0, 1.0, 0.7)
    tune = run(model, sign=1, period=0.03, **acting)
    assert tune.outcome is Outcome.COMPLETED
    found = analyse(tune.record(), alone=True)
    assert all(m.process_sign == 1 for m in found.model.draws)
    assert found.best_gains is not None


@pytest.mark.nightly
@pytest.mark.parametrize(("zero", "before"), [(-8.0, 4), (6.0, 2)])
def test_a_step_that_begins_with_the_record_keeps_its_direction(zero, before):
    """A command or a movement just before the record had stood for the zero, 30 times as large."""
    rng, n, interval = np.random.default_rng(1), 450, 0.3
    time = interval * np.arange(n)
    process = TransferFunction(1.0, (zero,), (11.0, 8.0), 0, 0.6)
    u = PiecewiseConstant(time[[before]], np.array([60.0]), 50.0)
    y = 40.0 + response(process, time, u) + 0.03 * rng.standard_normal(n)
    command = np.where(np.arange(n) < before, 50.0, 60.0)
    found = analyse(Record(time=time, measurement=y, command=command), alone=True)
    assert found.verdict is Verdict.TRUSTED
    assert found.model.model.gain == pytest.approx(1.0, rel=0.02)
    assert found.model.ultimate_gain == pytest.approx(ultimate_point(process).gain, rel=0.1)


@pytest.mark.parametrize(("up", "down"), [(0.12, 0.4), (0.1, 0.6)])
def test_a_process_of_two_speeds_keeps_its_direction_under_a_square_wave(up, down):
    """Half a period later the other direction has the speeds as they are, and each was refused."""
    step, half = 0.01, 2.93
    time = step * np.arange(2400)
    command = np.where(np.floor(time / half) % 2.0 == 1.0, 80.0, 0.0)
    y = np.zeros(time.size)
    for i, u in enumerate(command[:-1]):
        y[i + 1] = y[i] + step / (up if u else down) * (-0.16 * u - y[i])
    y = 0.09 * np.round((y + 0.02 * np.random.default_rng(0).standard_normal(y.size)) / 0.09)
    found = analyse(Record(time, y, command))
    assert found.model is not None and found.model.model.process_sign == -1
    assert found.verdict is Verdict.TRUSTED


@pytest.mark.nightly
def test_an_inverse_response_beside_a_drift_may_be_an_answer_of_the_other_direction():
    """A drift against the answer makes an inverse response of it, which never turns."""
    time = 0.2 * np.arange(72.0)
    command = np.where((time < 1.9) | (time >= 7.0), 0.0, 1.0)
    u = PiecewiseConstant.from_samples(time, command)
    y = response(TransferFunction.sopdt(1.0, (1.0, 0.14), 0.0), time, u)
    y -= 3.0 * (1.0 - np.exp(-np.maximum(time - 2.0, 0.0) / 10.0))
    y += 0.006 * np.random.default_rng(0).standard_normal(time.size)
    found = analyse(Record(time, y, command), alone=True)
    assert found.model.model.process_sign == 1 or found.model.opposed > 0.5


@pytest.mark.nightly
def test_half_a_period_more_of_dead_time_is_no_other_direction():
    """The first answers came late, for which a model of the wrong sign had been trusted."""
    rng = np.random.default_rng(3)
    time = 0.0234 * np.arange(630.0)
    command = np.round(5.0 * np.sin(2.0 * np.pi * time), 2)
    felt = np.where(time < 0.3, 0.0, command)
    u = PiecewiseConstant.from_samples(time, felt)
    y = response(TransferFunction.fopdt(1.15, 0.035, 0.0), time, u)
    y += 5.3 * np.exp(-np.maximum(time - 0.3, 0.0) / 0.035)
    y += 0.12 * rng.standard_normal(time.size)
    whole, later = (
        analyse(Record(time[at], y[at], command[at]), alone=True)
        for at in (slice(None), slice(20, None))
    )
    # Of the first samples, the other direction explains more.
    assert whole.model.model.process_sign == -1
    results = {f.name: f.result for f in whole.judgement.findings}
    assert results["direction"] is not Result.PASSED
    assert later.model.model.gain == pytest.approx(1.15, rel=0.03)
    assert later.model.opposed == 0.0


@pytest.mark.nightly
def test_a_structure_that_cannot_grow_gets_no_gains_for_a_pendulum_that_is_held_upright():
    """A stable model of the wrong sign had been trusted: it left 6 % of the measurement."""
    rng, interval, rows = np.random.default_rng(1), 0.006, []
    pendulum = Plant(TransferFunction(-1.0, (), (0.15, -0.15, 0.01), 0, 0.015))
    command = push = total = smooth = 0.0
    for time in interval * np.arange(1000):
        angle = pendulum.advance(time, command + push) + 0.01 * rng.standard_normal()
        push = 0.99 * push + 0.0028 * rng.standard_normal()
        total += 0.4 * interval * angle
        rate = 0.5 * (angle - smooth) / interval
        smooth += rate * interval
        command = -2.2 * (angle + total + 0.13 * rate)
        rows.append((time, angle, command))
    record = Record(*np.array(rows).T)
    found = analyse(record, alone=True, known=Known(structure="sopdt"))
    assert found.verdict is Verdict.NONE
    results = {f.name: f.result for f in found.judgement.findings}
    assert results["direction"] is Result.FAILED


@pytest.mark.nightly
def test_a_step_from_a_known_command_begins_from_rest():
    """The movement before it had stood for all of the answer, and a later sag for the response."""
    rng, n = np.random.default_rng(61), 290
    time = 0.00216 * np.arange(n)
    u = PiecewiseConstant(np.zeros(1), np.array([15.0]), 0.0)
    y = response(TransferFunction.fopdt(3.1, 0.034, 0.002), time, u)
    y = y - 3.0 * np.maximum(1.0 - np.exp((0.15 - time) / 0.12), 0.0)
    noise = np.zeros(n)
    for k in range(1, n):
        noise[k] = 0.6 * noise[k - 1] + 0.8 * rng.standard_normal()
    # A sensor of coarse steps, whose noise grows with the speed.
    y = 0.767 * np.round((y + noise * y / 42.0) / 0.767)
    found = identify_waveform(
        Record(time=time, measurement=y, command=np.full(n, 15.0), held_input=u)
    )
    assert found.model.gain == pytest.approx(3.1, rel=0.05)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_position_under_one_step_is_no_lag_beside_a_drift(seed):
    """A lag of the other sign and a drift together answer as it does."""
    time = 0.01 * np.arange(1500)
    u = PiecewiseConstant(np.zeros(1), np.array([15.0]), 0.0)
    motor = TransferFunction(15.2, time_constants=(1.42,), integrators=1)
    noise = 0.35 * np.random.default_rng(seed).standard_normal(time.size)
    y = 0.5 * np.round((response(motor, time, u) + noise) / 0.5)
    found = analyse(Record(time=time, measurement=y, command=np.full(1500, 15.0), held_input=u))
    assert found.verdict is Verdict.TRUSTED
    assert (found.model.structure, found.best_gains.kc > 0.0) == ("integrator_lag", True)
    assert found.model.model.gain == pytest.approx(15.2, rel=0.01)
