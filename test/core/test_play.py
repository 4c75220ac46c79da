# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Play and unequal effects between command and process, which are estimated with the model."""

import math

import numpy as np
import pytest

from relay_autotune import Record, TransferFunction, identify
from relay_autotune.analysis import analyse
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.waveform.problem import problem_of
from relay_autotune.process.structures import FOPDT
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Actuator, Disturbances, VirtualProcess
from relay_autotune.quantities import NORMAL_95

pytestmark = pytest.mark.long

PROCESS = TransferFunction.fopdt(1.0, 1.0, 0.3)
PERIOD, HOLD, NOISE = 0.05, 16, 0.02
UP_AND_DOWN = [
    0,
    0.6,
    0,
    -0.6,
    0,
    0.6,
    -0.6,
    0,
    -0.6,
    0.6,
    0,
    -0.6,
    0,
    0.6,
    0,
    0.6,
    -0.6,
    0,
    0.6,
    0,
]


def record_of(levels, **actuator):
    """Return a test that holds each of some levels, with white noise."""
    rng, plant, acting = (
        np.random.default_rng(5),
        VirtualProcess(PROCESS),
        Actuator(0.0, **actuator),
    )
    commands = np.repeat(np.array(levels, dtype=float), HOLD)
    time = PERIOD * np.arange(commands.size)
    y = []
    for t, u in zip(time.tolist(), commands.tolist(), strict=True):
        y.append(plant.measure(t))
        plant.command(acting.move(u))
    measured = np.array(y) + NOISE * rng.standard_normal(time.size)
    return Record(time=time, measurement=measured, command=commands)


def test_play_is_estimated_where_a_level_is_reached_from_both_sides():
    found = identify(record_of(UP_AND_DOWN, dead_band=0.2))
    assert found.play == pytest.approx(0.2, abs=0.02)
    assert found.model.gain == pytest.approx(1.0, rel=0.03)
    assert found.ultimate_gain == pytest.approx(ultimate_point(PROCESS).gain, rel=0.05)
    assert any(f"play of {found.play:.3g} u" in text for text in found.warnings)


@pytest.mark.nightly
def test_no_play_is_found_where_there_is_none():
    assert identify(record_of(UP_AND_DOWN)).play == 0.0


@pytest.mark.parametrize(
    ("levels", "shown"),
    [
        (UP_AND_DOWN, True),
        # Two levels, with a rest before or a kick: the play makes the moves smaller, no more.
        ([0, 0.6, -0.4, 0.6, -0.4, 0.6, -0.4, 0], False),
        ([0, 0.6, 0, -0.4, 0.6, -0.4, 0.6, -0.4, 0], False),
        ([0, 0.3, 0.6, 0.9], False),
    ],
)
def test_play_is_no_term_where_the_command_cannot_show_it(levels, shown):
    record = record_of(levels)
    problem = problem_of([(record.time, record.measurement, record.drive())], FOPDT)
    assert all((problem.most_play(held=held) > 0.0) is shown for held in (False, True))


@pytest.mark.nightly
@pytest.mark.parametrize(("band", "noise"), [(0.04, 0.01), (0.0, 0.005), (0.04, 0.005)])
def test_a_relay_whose_first_cycle_is_smaller_shows_its_play(band, noise):
    """K_u was 2 % off for a play of 2 % of the swing, and nothing was said of it."""
    plant = VirtualProcess(PROCESS, disturbances=Disturbances(noise_std=noise * 0.52), seed=7)
    acting = Actuator(0.0, dead_band=band)
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0), 0.0, from_small=True)
    for k in range(2000):
        plant.command(acting.move(tune.step(PERIOD * k, plant.measure(PERIOD * k))))
        if tune.finished:
            break
    found = identify(tune.record())
    assert found.play == pytest.approx(band, abs=0.01)
    assert found.ultimate_gain == pytest.approx(ultimate_point(PROCESS).gain, rel=0.01)


@pytest.mark.nightly
def test_a_joint_that_rings_is_not_taken_for_lags_with_a_play():
    """Of its own structure no play is left, which is no reason to leave that structure out."""
    ringing = complex(0.2 / 30.0, math.sqrt(1.0 - 0.2**2) / 30.0)
    joint = TransferFunction(1.0, (), (ringing, ringing.conjugate(), 0.03), 1, 0.015)
    plant = VirtualProcess(joint, disturbances=Disturbances(quantisation=4e-4), seed=1)
    tune = RelayExperiment(ExperimentParameters(command_min=-2.0, command_max=2.0), 0.0)
    for k in range(2000):
        plant.command(tune.step(0.005 * k, plant.measure(0.005 * k)))
        if tune.finished:
            break
    found = identify(tune.record())
    assert found.play == 0.0
    assert found.ultimate_gain == pytest.approx(ultimate_point(joint).gain, rel=0.03)


@pytest.mark.nightly
def test_the_interval_of_the_ultimate_gain_holds_both_sides():
    found = analyse(record_of(UP_AND_DOWN, falling_gain=0.7), alone=True).model
    above, below = found.effects
    assert below / above == pytest.approx(0.7, abs=0.05)
    for true in (ultimate_point(PROCESS).gain, ultimate_point(PROCESS).gain / 0.7):
        assert math.isclose(found.ultimate_gain, true, abs_tol=NORMAL_95 * found.ultimate_gain_std)
