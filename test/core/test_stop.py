# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A measurement that runs into a stop, or into the end of its sensor, in noise."""

import numpy as np
import pytest

from relay_autotune import Known, Record, identify
from relay_autotune.analysis import analyse
from relay_autotune.loop.analysis import Loop
from relay_autotune.process.response import response
from relay_autotune.process.structures import INTEGRATOR_LAG
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import PiecewiseConstant

AXIS = INTEGRATOR_LAG.build((10.0, 0.8, 0.15))
LAG = TransferFunction.fopdt(10.0, 0.8, 0.15)
TIME = np.arange(0.0, 12.0, 0.05)


def recorded(model, changes, levels, *, end=np.inf, noise=0.01):
    u = PiecewiseConstant(np.array(changes), np.array(levels), 0.0)
    y = np.minimum(response(model, TIME, u), end)
    y += noise * np.ptp(y) * np.random.default_rng(7).standard_normal(TIME.size)
    return Record(time=TIME, measurement=y, command=u(TIME), held_input=u)


def told_of_a_stop(found):
    return any("stays at an end of its range" in warning for warning in found.warnings)


@pytest.mark.nightly
@pytest.mark.parametrize("noise", [0.002, 0.02, 0.01])
def test_a_stop_is_no_rest(noise):
    # Gains of a process that would come to rest at the stop made this one grow.
    found = analyse(recorded(AXIS, [3.0], [1.0], end=30.0, noise=noise), alone=True)
    assert told_of_a_stop(found.model)
    assert found.best_gains is None or Loop(found.best_gains, AXIS).ms() < 1.75


@pytest.mark.long
def test_what_lies_at_the_end_of_a_sensor_is_left_out():
    found = identify(recorded(LAG, [3.0], [1.0], end=6.0), known=Known(structure="fopdt"))
    assert told_of_a_stop(found)
    # At the stop lies nothing that was fitted.
    assert np.isnan(found.fitted[TIME > 6.0]).all()
    assert found.ultimate_gain == pytest.approx(ultimate_point(LAG).gain, rel=0.3)


@pytest.mark.long
def test_what_comes_after_the_end_of_a_sensor_counts_where_the_command_moves_more_often():
    time, rng = np.arange(0.0, 60.0, 0.05), np.random.default_rng(3)
    later = np.arange(9.0, 60.0, 3.0)
    levels = np.array([1.0, 0.0, *rng.uniform(0.0, 0.55, later.size)])
    u = PiecewiseConstant(np.array([3.0, 6.0, *later]), levels, 0.0)
    y = np.minimum(response(LAG, time, u), 6.0) + 0.05 * rng.standard_normal(time.size)
    found = identify(Record(time, y, u(time)), known=Known(structure="fopdt"))
    assert told_of_a_stop(found)
    assert np.isnan(found.fitted[time < 6.0]).all()
    assert np.isfinite(found.fitted[time > 7.0]).all()
    assert found.ultimate_gain == pytest.approx(ultimate_point(LAG).gain, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("model", "changes", "levels"),
    [
        (AXIS, [3.0, 4.5], [1.0, 0.0]),
        (AXIS, [3.0, 4.0, 8.0, 9.0], [1.0, 0.0, -1.0, 0.0]),
        (LAG, [3.0, 8.0], [1.0, 0.0]),
    ],
)
def test_a_process_that_comes_to_rest_stands_at_no_stop(model, changes, levels):
    known = Known(structure=model.structure)
    assert not told_of_a_stop(identify(recorded(model, changes, levels), known=known))


@pytest.mark.long
@pytest.mark.parametrize(
    ("tau", "dead_time"), [(1.63, 4.76), (0.44, 1.34), (1.12, 4.94), (1.32, 3.64)]
)
def test_a_process_as_fast_as_its_samples_stands_at_no_stop(tau, dead_time):
    """Of its movement there are too few samples to tell how far it would go."""
    time = np.arange(0.0, 300.0)
    u = PiecewiseConstant(np.array([20.0, 120.0, 220.0]), np.array([1.0, 0.0, 1.0]), 0.0)
    y = response(TransferFunction.fopdt(1.0, tau, dead_time), time, u)
    y += 0.003 * np.random.default_rng(1).standard_normal(time.size)
    found = identify(Record(time, y, u(time)), known=Known(structure="fopdt"))
    assert not told_of_a_stop(found)
    assert found.model.gain == pytest.approx(1.0, rel=0.01)


@pytest.mark.long
def test_a_motor_that_is_back_at_a_speed_which_it_had_stands_at_no_stop():
    """It turns around sooner than it brakes, of which the model of what came before is."""
    time, rng = 0.02 * np.arange(1000), np.random.default_rng(1)
    u, y, speed = np.empty(1000), np.empty(1000), 1250.0
    parts = [
        *((0, 250.0, 1250.0, 0.07), (160, -150.0, -900.0, 0.12), (480, -200.0, -1050.0, 0.12)),
        *((640, 250.0, 1250.0, 0.02), (820, -150.0, -900.0, 0.12)),
    ]
    for begin, level, goal, tau in parts:
        u[begin:] = level
        y[begin:] = goal + (speed - goal) * np.exp(-(time[begin:] - time[begin]) / tau)
        speed = goal
    y += rng.normal(0.0, 10.0, time.size)
    found = identify(Record(time, y, u), known=Known(structure="fopdt"))
    assert not told_of_a_stop(found)


def test_a_process_that_came_to_rest_in_a_gap_of_the_rows_stands_at_no_stop():
    whole = recorded(LAG, [3.0, 8.0], [1.0, 0.0])
    kept = (TIME < 3.8) | (TIME > 6.5)
    record = Record(TIME[kept], whole.measurement[kept], whole.command[kept])
    assert not told_of_a_stop(identify(record, known=Known(structure="fopdt")))
