# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A sensor that speaks only when its value changes, in a simulated experiment."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.faults import Repetition, SilenceWatch
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.process.structures import structure_named
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.record.record import Outcome

PROCESS = structure_named("fopdt").of_fields(gain=1.65, time_constants=[20.0], dead_time=10.0)
PERIOD = 0.2


def run(*, repeat_period, dies=math.inf, noise_std=0.0, quantisation=0.02, **given):
    """Run an experiment on a sensor that is sampled but speaks on change; it dies at a time."""
    acting = Disturbances(noise_std=noise_std, quantisation=quantisation)
    plant = VirtualProcess(PROCESS, disturbances=acting, seed=4)
    tune = RelayExperiment(ExperimentParameters(**{"amplitude": 1.0, **given}), 0.0)
    repetition = Repetition(repeat_period)
    now, said, came = 0.0, math.nan, []
    for k in range(20_000):
        sampled = k * PERIOD
        while repetition.is_heard and now + repetition.wait(now) < sampled - 1e-9:
            now += repetition.wait(now)
            plant.command(tune.repeat(now, repetition.repeat(now)), now)
        now = sampled
        y = plant.measure(now)
        if y != said and now < dies:
            said = y
            repetition.hear(now, y)
            came.append(tune.sample_count)
            plant.command(tune.step(now, y), now)
        if tune.finished:
            break
    return tune, [k for k in came if k < tune.sample_count]


@pytest.mark.long
@pytest.mark.parametrize(
    ("quantisation", "noise_std", "repeat_period", "within"),
    [(0.02, 0.0, 0.3, 0.01), (0.05, 0.0, 1.0, 0.03), (0.05, 0.01, 0.3, 0.01)],
)
def test_a_sensor_that_is_silent_at_rest(quantisation, noise_std, repeat_period, within):
    tune, _ = run(quantisation=quantisation, noise_std=noise_std, repeat_period=repeat_period)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    found = identify(tune.record(), "waveform", Known(structure="fopdt"))
    assert found.ultimate_gain == pytest.approx(ultimate_point(PROCESS).gain, rel=within)


def test_the_record_tells_what_was_repeated():
    tune, came = run(repeat_period=0.3)
    record = tune.record()
    same = np.flatnonzero(np.diff(record.measurement) == 0.0) + 1
    assert set(same) == set(range(len(record))) - set(came)
    assert f"{len(same)} samples repeat the one before" in tune.reason


@pytest.mark.parametrize(
    ("dies", "says"),
    [
        (1.0, "no response to the kick"),
        (20.0, "it does not respond"),
        (100.0, "it does not respond"),
        (150.0, "does not respond any more"),
    ],
)
def test_a_sensor_that_dies_in_its_silence(dies, says):
    tune, _ = run(repeat_period=0.3, dies=dies)
    assert tune.outcome is Outcome.FAILED
    assert says in tune.reason
    # What moves nothing any more is no reason to take the gain for one of the other sign.
    assert "taken as negative" not in tune.reason
    assert re.search(r"silent, at the end for [\d.]+ s: check it first", tune.reason)
    assert tune.after_end(math.nan) == 0.0


def test_a_value_is_repeated_after_each_period_of_silence():
    repetition = Repetition(0.5)
    assert not repetition.is_heard
    assert repetition.wait(7.0) == 0.5
    repetition.hear(7.0, 3.0)
    assert repetition.wait(7.2) == pytest.approx(0.3)
    assert repetition.wait(9.0) == 0.0
    assert repetition.repeat(9.0) == 3.0
    assert repetition.wait(9.1) == pytest.approx(0.4)
    repetition.hear(9.2, 4.0)
    assert repetition.repeat(9.8) == 4.0
    # A clock that has gone back.
    assert repetition.wait(2.0) == 0.0
    assert repetition.repeat(2.0) == 4.0
    assert repetition.wait(2.1) == pytest.approx(0.4)


def test_a_silence_is_measured_by_those_since_the_relay_began():
    watch = SilenceWatch()
    watch.hear(0.0, relaying=False)
    assert not any(watch.repeat(float(t), longest_cycle=math.inf) for t in range(1, 100))
    for time in (100.0, 104.0, 110.0):
        watch.hear(time, relaying=True)
    times = [110.0 + 0.5 * k for k in range(1, 100)]
    first = next(t for t in times if watch.repeat(t, longest_cycle=15.0))
    assert first == 110.0 + 3.0 * 6.0 + 0.5
    assert watch.silence == 18.5
    assert watch.repeated == 99 + 37
