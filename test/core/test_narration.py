# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a running experiment says, held against what happens next and against the truth."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import State, how_long
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import VirtualProcess

PERIOD, BASELINE, REST, NOISE = 0.02, 2.0, 40.0, 0.01
FOPDT = TransferFunction.fopdt(1.65, 1.0, 0.5)
NUMBER = r"-?\d+\.?\d*(?:e-?\d+)?"


def told(model=FOPDT, transient=lambda t: 0.0, samples=4000, **parameters):
    """Return a finished tune with a row for each sample: time, state, measurement, sentence."""
    tune = RelayExperiment(ExperimentParameters(**{"amplitude": 1.0, **parameters}), BASELINE)
    plant, noise = VirtualProcess(model, seed=1), np.random.default_rng(2)
    rows, command = [], BASELINE
    for k in range(samples):
        plant.command(command - BASELINE)
        y = REST + plant.measure(k * PERIOD) + NOISE * noise.standard_normal()
        y += transient(k * PERIOD)
        command = tune.step(k * PERIOD, y)
        rows.append((k * PERIOD, tune.state, y, tune.status))
        if tune.finished:
            break
    return tune, rows


def numbers(pattern: str, text: str) -> list[float]:
    found = re.search(pattern.replace("#", f"({NUMBER})"), text)
    return [float(number) for number in found.groups()] if found else []


@pytest.mark.parametrize("gain", [1.65, -1.65])
def test_the_relay_switches_where_it_is_said_to(gain):
    tune, rows = told(TransferFunction.fopdt(gain, 1.0, 0.5))
    assert tune.state is State.COMPLETED
    record, checked = tune.record(), 0
    for k, (_, state, _, sentence) in enumerate(rows[:-1]):
        if state is not State.RELAY or rows[k + 1][1] is not State.RELAY:
            continue
        level, _ = numbers("at # u for # s", sentence)
        assert level == pytest.approx(record.command[k], abs=1e-5)
        (target,) = numbers("is to (?:rise|fall) to # y", sentence)
        beyond = rows[k + 1][2] - target if "rise" in sentence else target - rows[k + 1][2]
        if abs(beyond) > 1e-3:
            assert (record.command[k + 1] != record.command[k]) == (beyond > 0.0)
            checked += record.command[k + 1] != record.command[k]
    assert checked >= 6


def test_the_step_is_told_with_its_level_and_the_band_that_must_be_left():
    tune, rows = told()
    waiting = [row for row in rows if row[1] is State.KICK]
    began = waiting[0][0]
    for t, _, y, sentence in waiting:
        since, measurement, rest, band = numbers(
            "no response after # s: the measurement # y is to leave # -/\\+ # y", sentence
        )
        assert since == pytest.approx(t - began, abs=0.051)
        assert sentence.startswith("stepped to 3.3 u, ")
        assert measurement == pytest.approx(y, abs=1e-3)
        assert rest == pytest.approx(REST, abs=NOISE)
        assert band == pytest.approx(3.0 * NOISE, rel=0.4)
    (after,) = numbers("went up after # s", next(r[3] for r in rows if r[1] is State.PROBE))
    assert after == pytest.approx(0.5, abs=0.2)
    assert tune.status.startswith("completed: 3 cycles agree")


@pytest.mark.parametrize("size", [3.0, -3.0])
def test_a_transient_is_told_with_its_slope_and_about_when_it_ends(size):
    fades_in = 4.0
    _, rows = told(transient=lambda t: size * math.exp(-t / fades_in))
    settling = [row for row in rows if row[1] is State.SETTLING]
    end, estimates = settling[-1][0], []
    for t, _, _, sentence in settling[100:]:
        assert ("falling" if size > 0.0 else "rising") in sentence
        (slope,) = numbers("(?:rising|falling) # y/s", sentence)
        # The last look is up to a fifth of the time ago, and its window half of that time long.
        assert abs(size) / fades_in * math.exp(-t / fades_in) * 0.7 < slope
        assert slope < abs(size) / fades_in * math.exp(-0.35 * t / fades_in)
        estimates += numbers("of about # s", sentence)
    assert len(estimates) > len(settling) / 2
    assert all(0.5 * end < estimate < 2.5 * end for estimate in estimates[-100:])


def test_a_drift_that_does_not_end_is_said_to_last():
    _, rows = told(transient=lambda t: 0.2 * t, samples=1000)
    (slope,) = numbers("still rising # y/s, not slower than before", rows[-1][3])
    assert slope == pytest.approx(0.2, rel=0.05)


def test_a_new_experiment_waits_for_a_measurement():
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0), BASELINE)
    assert tune.status == "waiting for the first measurement"
    tune.step(0.0, REST)
    assert tune.status.startswith("settling, ")
    tune.abort("aborted on request")
    assert tune.status.startswith("aborted: aborted on request (at 0 s, while settling)")


def test_a_settle_time_is_told_with_its_end():
    _, rows = told(settle_time=10.0, samples=200)
    assert rows[-1][3] == "settling, 4.0 s of 10 s"


def test_how_long_a_tune_takes_is_told_before_it():
    given = ExperimentParameters(amplitude=1.0, min_cycles=4)
    assert how_long(given, 0.02) == (
        "it takes 1.0 s or more until the measurement is steady, 10 min at most, then one step "
        "and about 6 oscillations of the loop"
    )
    assert "about 8 oscillations" in how_long(given, 0.02, from_small=True)
    limited = ExperimentParameters(amplitude=1.0, settle_time=5.0, max_duration=100.0)
    assert how_long(limited, 0.0).startswith("it takes 5.0 s at rest, then")
    assert how_long(limited, 0.0).endswith(", 1 min 40 s at most in all")
