# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What real plants do during an experiment, and what comes out of it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.judgement.disturbance import without_disturbance
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.process.structures import structure_named
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Actuator, Disturbances, VirtualProcess
from relay_autotune.record.record import Outcome

pytestmark = pytest.mark.long

PROCESS = structure_named("fopdt").of_fields(gain=1.65, time_constants=[20.0], dead_time=10.0)
# A slow heater: 2.5 degrees for a percent.
HEATER = structure_named("fopdt").of_fields(gain=2.5, time_constants=[600.0], dead_time=40.0)
PERIOD = 0.2
# At the root w of 10 w + atan(20 w) = pi.
ULTIMATE_GAIN = math.hypot(1.0, 20.0 * 0.183659720315) / 1.65


def run(model=PROCESS, *, actuator=None, keep=None, period=PERIOD, samples=60_000, **given):
    """Run an experiment; ``keep(k, y, last)`` says whether sample k is published."""
    acting = {k: given.pop(k) for k in list(given) if k in Disturbances.__annotations__}
    plant = VirtualProcess(model, actuator=actuator, disturbances=Disturbances(**acting), seed=4)
    tune = RelayExperiment(ExperimentParameters(**{"amplitude": 1.0, **given}), 0.0)
    last = None
    for k in range(samples):
        y = plant.measure(k * period)
        if keep is not None and not keep(k, y, last):
            continue
        last = y
        plant.command(tune.step(k * period, y))
        if tune.finished:
            break
    return tune


def gain_of(tune, structure="fopdt"):
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    record, known = tune.record(), Known(structure=structure)

    def fit(part):
        return identify(part, "waveform", known)

    found = without_disturbance(record, fit)
    return found.ultimate_gain


def check(tune, rel=0.05):
    assert gain_of(tune) == pytest.approx(ULTIMATE_GAIN, rel=rel)


@pytest.mark.parametrize(("load_time", "load_size"), [(60.0, -0.4), (110.0, 0.3)])
def test_a_load_at_the_begin_of_the_test_is_left_out(load_time, load_size):
    check(run(load_time=load_time, load_size=load_size, noise_std=0.01), rel=0.03)


@pytest.mark.nightly
def test_a_load_that_comes_later_is_borne():
    tune = run(load_time=180.0, load_size=0.3, noise_std=0.01, min_cycles=4, max_cycles=20)
    assert "a load came during the test" in tune.reason
    assert any(cycle.disturbed for cycle in tune.cycles)
    check(tune, rel=0.03)
    # In the end the half periods are what they were before it.
    first, last = tune.cycles[1], tune.cycles[-1]
    share = first.period_high / first.period
    assert last.period_high / last.period == pytest.approx(share, abs=0.05)


def test_a_load_that_stops_the_oscillation_is_borne():
    tune = run(load_time=150.0, load_size=1.5, noise_std=0.01, max_cycles=20)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert "a load came during the test" in tune.reason
    check(tune, rel=0.03)


@pytest.mark.nightly
@pytest.mark.parametrize(("load_time", "load_size"), [(90.0, 0.8), (110.0, 1.5)])
def test_a_load_that_stops_the_first_cycle_is_borne(load_time, load_size):
    tune = run(load_time=load_time, load_size=load_size, noise_std=0.01, max_cycles=20)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert "a load came during the test" in tune.reason
    check(tune, rel=0.03)


def test_a_load_beyond_the_command_limits_fails():
    tune = run(load_time=150.0, load_size=5.0, command_min=-1.0, command_max=1.5)
    assert tune.outcome is Outcome.FAILED
    assert "against the relay's push" in tune.reason
    assert "a load came during the test" in tune.reason
    assert tune.record().command.min() >= -1.0


def test_drift():
    check(run(drift=0.002, noise_std=0.02, settle_time=20.0))


def test_a_coarse_sensor():
    check(run(quantisation=0.15, noise_std=0.05))


def test_a_sensor_that_speaks_only_on_change():
    check(run(quantisation=0.02, noise_std=0.02, keep=lambda k, y, last: y != last))


@pytest.mark.parametrize("noise_std", [0.05, 0.0])
def test_a_slow_heater_with_steps_of_three_tenths_of_a_degree(noise_std):
    tune = run(HEATER, period=2.0, amplitude=20.0, quantisation=0.3, noise_std=noise_std)
    assert tune.elapsed < 1500.0
    assert gain_of(tune) == pytest.approx(ultimate_point(HEATER).gain, rel=0.02)


@pytest.mark.nightly
def test_a_slow_heater_finds_its_amplitude():
    limits = {"command_min": -30.0, "command_max": 50.0}
    tune = run(HEATER, period=2.0, amplitude=0.0, quantisation=0.3, **limits)
    assert gain_of(tune) == pytest.approx(ultimate_point(HEATER).gain, rel=0.02)


def test_samples_that_come_when_they_like():
    rng = np.random.default_rng(3)
    plant = VirtualProcess(PROCESS, disturbances=Disturbances(noise_std=0.02), seed=4)
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0), 0.0)
    for k in range(20_000):
        t = (k + rng.uniform(0.0, 0.9)) * PERIOD
        plant.command(tune.step(t, plant.measure(t)))
        if tune.finished:
            break
    check(tune, rel=0.02)


def test_lost_samples():
    rng = np.random.default_rng(6)
    check(run(noise_std=0.02, keep=lambda k, y, last: rng.uniform() > 0.3))


def test_a_sticking_valve_with_play():
    check(run(actuator=Actuator(0.0, stiction=0.1, dead_band=0.1), noise_std=0.02), rel=0.25)


def test_cooling_slower_than_heating():
    tune = run(actuator=Actuator(0.0, falling_gain=0.6), noise_std=0.02)
    check(tune, rel=0.3)


def test_a_set_point_next_to_a_command_limit():
    tune = run(amplitude=0.0, command_min=-0.2, command_max=3.0, noise_std=0.02)
    check(tune)
    steps = tune.settings.high, -tune.settings.low
    assert steps[0] > 2.0 * steps[1] > 0.0


@pytest.mark.parametrize("scale", [50.0, 0.005])
def test_from_a_tenth_of_a_hertz_to_a_kilohertz(scale):
    model = structure_named("fopdt").of_fields(
        gain=1.65, time_constants=[20.0 * scale], dead_time=10.0 * scale
    )
    check(run(model, period=PERIOD * scale, noise_std=0.02))


@pytest.mark.parametrize(
    ("structure", "shape", "truth"),
    [
        ("ipdt", {"gain": 0.3, "dead_time": 2.0}, math.pi / 2 / 0.6),
        ("unstable_fopdt", {"gain": 1.0, "time_constants": [8.0], "dead_time": 2.0}, None),
        ("fopdt", {"gain": -1.65, "time_constants": [20.0], "dead_time": 10.0}, -ULTIMATE_GAIN),
    ],
)
def test_integrating_unstable_and_reverse_acting(structure, shape, truth):
    model = structure_named(structure).of_fields(**shape)
    sign = 1 if structure == "unstable_fopdt" else 0
    tune = run(model, noise_std=0.01, process_gain_sign=sign, bias_ratio=0.0, max_cycles=20)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    if truth is not None:
        assert gain_of(tune, structure) == pytest.approx(truth, rel=0.05)


@pytest.mark.nightly
def test_a_process_that_comes_to_rest_only_after_the_start():
    plant = VirtualProcess(PROCESS, disturbances=Disturbances(noise_std=0.01), seed=2)
    # It still moves from a command of before.
    for k in range(40):
        plant.measure(k * PERIOD)
        plant.command(3.0)
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0), 0.0)
    for k in range(40, 20_000):
        plant.command(tune.step(k * PERIOD, plant.measure(k * PERIOD)))
        if tune.finished:
            break
    check(tune)
