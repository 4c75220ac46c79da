# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Dry friction of a position, which is estimated with the model and named."""

import math
from dataclasses import replace

import numpy as np
import pytest

from relay_autotune import ExperimentParameters, Known, RelayExperiment, identify
from relay_autotune.identification.waveform.candidates import FitContext
from relay_autotune.identification.waveform.problem import motions_of, problem_of
from relay_autotune.identification.waveform.separable import evaluate
from relay_autotune.process.structures import FOPDT, structure_named
from relay_autotune.record.record import Outcome

# rad/s for a volt, and seconds to reach it.
GAIN, LAG, PERIOD = 20.0, 0.06, 0.005
ENCODER = 2.0 * math.pi / 8000.0


def servo_record(friction, noise=0.0):
    """Return an automatic test of a servo whose friction takes some volts."""
    tune = RelayExperiment(ExperimentParameters(command_min=-12.0, command_max=12.0), 0.0)
    rng, step = np.random.default_rng(1), PERIOD / 10
    position = speed = acting = 0.0
    for k in range(2000):
        seen = position + noise * rng.standard_normal()
        command = tune.step(k * PERIOD, ENCODER * round(seen / ENCODER))
        if tune.finished:
            break
        for part in range(10):
            # The command acts half a period late.
            acting = command if part >= 5 else acting
            if abs(speed) < 0.05 and abs(acting) <= friction:
                speed = 0.0
                continue
            against = friction * math.copysign(1.0, speed or acting)
            speed += step * (GAIN * (acting - against) - speed) / LAG
            position += step * speed
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    return tune.record()


@pytest.mark.nightly
def test_an_integrator_in_dry_friction_is_not_taken_for_one_that_regulates_itself():
    # The first amplitude that the sensor shows clearly is 0.48 V, three times the friction.
    found = identify(servo_record(0.15))
    assert found.structure == "integrator_lag"
    assert found.friction == pytest.approx(0.15, rel=0.2)
    assert any(f"dry friction of {found.friction:.3g} u" in text for text in found.warnings)
    assert found.model.gain == pytest.approx(GAIN, rel=0.2)


@pytest.mark.long
def test_no_friction_is_found_where_there_is_none():
    found = identify(servo_record(0.0), known=Known(structure="integrator_lag"))
    assert found.friction == 0.0
    assert found.model.gain == pytest.approx(GAIN, rel=0.02)


@pytest.mark.parametrize(("times", "is_one"), [(1.0, True), (40.0, False)])
def test_friction_beyond_all_commands_is_none(times, is_one):
    """Nothing would move; a fan was trusted as an integrator with three times its range."""
    record = servo_record(0.15)
    u = record.drive()
    problem = replace(
        problem_of([(record.time, record.measurement, u)], structure_named("integrator_lag")),
        motions=motions_of(record.time, record.measurement, u),
        friction=True,
    )
    fit = evaluate(problem, np.array([math.log(LAG), 0.5 * PERIOD]))
    fit.coefficients[problem.places("friction")] *= times
    assert 0.1 * times < problem.dry_friction(fit.coefficients) < 0.3 * times
    context = FitContext.of(replace(problem, structure=FOPDT, friction=False), 0, held=True)
    assert (context.candidate(problem, fit) is not None) is is_one


@pytest.mark.parametrize(("noise", "seen"), [(0.0, True), (20.0 * ENCODER, False)])
def test_motion_is_seen_only_where_a_rest_stands_still(noise, seen):
    record = servo_record(0.15, noise)
    found = motions_of(record.time, record.measurement, record.drive())
    assert bool(found) is seen


def test_samples_may_share_a_stamp():
    record = servo_record(0.15)
    coarse = np.round(record.time / (2.0 * PERIOD)) * 2.0 * PERIOD
    (direction, _) = motions_of(coarse, record.measurement, record.drive())
    assert np.all(np.diff(direction.times) > 0.0)
    assert set(direction.values) == {-1.0, 0.0, 1.0}
