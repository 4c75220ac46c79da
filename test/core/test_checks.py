# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Checks whether a process is linear."""

from __future__ import annotations

import numpy as np
import pytest
from sampled_relay import simulate_sampled_relay

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.judgement.assessment import assess
from relay_autotune.identification.judgement.checks import unequal_amplitudes
from relay_autotune.identification.known import Known
from relay_autotune.identification.waveform.method import identify_waveform
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Disturbances, Plant, VirtualProcess
from relay_autotune.record.record import Outcome, PiecewiseConstant, Record, RelaySettings

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


def _steps(size: float, power: float, seed: int) -> Record:
    """Return steps up and down, to which a process answers with a power of their size."""
    time = np.arange(0.0, 200.0, 0.2)
    u = np.where((time // 25.0) % 2 == 1, size, -size) * (time > 25.0)
    held = PiecewiseConstant(*_held(time, u))
    y = response(MODEL, time, held) * size ** (power - 1.0)
    noise = 0.02 * np.random.default_rng(seed).standard_normal(time.size)
    return Record(time, y + noise, u, noise_std=0.02)


def _held(time, u):
    at = np.flatnonzero(np.diff(u)) + 1
    return time[at], u[at], float(u[0])


@pytest.mark.parametrize("seed", range(3))
def test_two_amplitudes_tell_a_gain_that_hangs_on_them(seed):
    linear = [_steps(size, 1.0, seed + 10 * k) for k, size in enumerate((0.5, 1.0))]
    assert unequal_amplitudes(linear, MODEL) is None
    root = [_steps(size, 0.5, seed + 10 * k) for k, size in enumerate((0.5, 1.0))]
    told = unequal_amplitudes(root, MODEL)
    # The gain of half the amplitude is 2**0.5 times as large.
    assert "moves by 0.5 to either side acts 1.41 times" in told
    alike = [_steps(size, 0.5, seed) for size in (0.95, 1.0)]
    assert unequal_amplitudes(alike, MODEL) is None


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
def test_a_linear_process_raises_no_alarm(seed):
    record = _record(1.0, seed=seed)
    found = identify_waveform(record, Known(structure="fopdt"))
    assert (found.warnings, found.began_away) == ((), False)


@pytest.mark.long
@pytest.mark.parametrize(
    ("baseline", "before"), [(3.0, ()), (2.0, ((3.3, 15.0), (0.7, 12.0), (3.3, 9.0)))],
    ids=["wrong baseline", "restarted"],
)  # fmt: skip
def test_a_start_away_from_rest_is_named_and_is_no_other_gain(baseline, before):
    """Such linear processes were said not to be linear."""
    noise = Disturbances(noise_std=0.02)
    process = VirtualProcess(MODEL, rest_command=2.0, disturbances=noise, seed=1)
    t = 0.0
    for command, lasting in before:
        process.command(command)
        t += lasting
        process.measure(t)
    test = RelayExperiment(ExperimentParameters(amplitude=1.0, sample_period=0.2), baseline)
    while not test.finished:
        process.command(test.step(t, process.measure(t)))
        t += 0.2
    found = identify_waveform(test.record(), Known(structure="fopdt"))
    assert found.model.gain == pytest.approx(1.65, rel=0.02)
    assert found.began_away
    assert not any("not linear" in told for told in found.warnings)


@pytest.mark.long
def test_a_record_that_begins_within_the_relay_raises_no_alarm():
    settings = RelaySettings(setpoint=0.0, baseline=0.0, amplitude=1.0, bias=0.2, hysteresis=0.05)
    noise = 0.01 * np.random.default_rng(0).standard_normal(1000)
    record = simulate_sampled_relay(MODEL, settings, period=0.2, noise=noise)
    assert record.input().initial != settings.baseline
    found = identify_waveform(record, Known(structure="fopdt"))
    assert (found.warnings, found.began_away) == ((), False)


@pytest.mark.long
def test_an_actuator_that_pulls_less_than_it_pushes_is_told():
    found = identify_waveform(_record(0.6), Known(structure="fopdt"))
    above, below = found.effects
    assert below / above == pytest.approx(0.6, rel=0.05)
    assert found.model.gain * above == pytest.approx(MODEL.gain, rel=0.05)
    (told,) = (text for text in found.warnings if "not linear" in text)
    assert f"those below it {below:.2f} times" in told
    # Gains have to hold on both sides.
    gains = [model.gain for model in found.draws]
    assert min(gains) < 0.7 * MODEL.gain
    assert max(gains) > 0.95 * MODEL.gain


@pytest.mark.long
def test_unequal_effects_that_are_shown_as_equal_are_no_news():
    found = identify_waveform(_record(0.995, noise=1e-4), Known(structure="fopdt"))
    above, below = found.effects
    assert above - below == pytest.approx(0.005, rel=0.2)
    assert found.ci95_high[0] < 1.001 * found.model.gain
    assert not any("not linear" in told for told in found.warnings)


@pytest.mark.long
def test_unequal_effects_within_the_interval_of_the_gain_are_no_news():
    found = identify_waveform(_record(0.95, noise=0.05), Known(structure="fopdt"))
    above, below = found.effects
    assert 0.0 < above - below < 0.06
    assert found.ci95_high[0] > 1.03 * found.model.gain
    assert not any("not linear" in told for told in found.warnings)


@pytest.mark.long
def test_the_same_relay_on_a_model_acts_unequally_as_the_record_does():
    """The period of two equal effects is 8 % shorter, which spoke against the right model."""
    record = _record(0.6)
    (found,) = assess((identify_waveform(record, Known(structure="fopdt")),), record)
    assert abs(found.validation.period) < 0.01
