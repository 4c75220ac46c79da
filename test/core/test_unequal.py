# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Processes that are not what a step test is made for: unstable, with a curve, or with ends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import odeint

from relay_autotune import Known
from relay_autotune.control.controller import PidController
from relay_autotune.identification.methods import identify
from relay_autotune.identification.waveform.candidates import FitContext
from relay_autotune.identification.waveform.problem import middle_of, problem_of
from relay_autotune.loop.gains import Controller
from relay_autotune.process.response import response
from relay_autotune.process.structures import FOPDT, SOPDT, UNSTABLE_FOPDT, UNSTABLE_SOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.record.record import PiecewiseConstant, Record

pytestmark = pytest.mark.long


def _held(process, gains, setpoint, time, noise, seed, ends=(-np.inf, np.inf)):
    """Return time, measurement and command of a process under its controller.

    Its actuator follows commands between two ends.
    """
    plant = VirtualProcess(process, disturbances=Disturbances(noise_std=noise), seed=seed)
    controller, rows = PidController(gains, 0.0), []
    for t in time:
        y = plant.measure(t)
        rows.append((t, y, controller.step(t, setpoint(t), y)))
        plant.command(float(np.clip(rows[-1][-1], *ends)))
    return np.array(rows).T


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("gains", "moves"),
    [
        (Controller(4.0, 20.0), {5.0: 2.0, 40.0: 0.0}),
        (Controller(3.0, 30.0), {5.0: 2.0, 60.0: -1.0}),
    ],
)
def test_what_a_controller_keeps_from_running_away_is_no_integrator(gains, moves):
    """It was given an integrator with a zero, and gains that make the loop unstable."""
    process = UNSTABLE_FOPDT.build((1.0, 10.0, 1.0))

    def setpoint(t):
        return next((y for at, y in reversed(moves.items()) if t >= at), 0.0)

    found = identify(Record(*_held(process, gains, setpoint, np.arange(0.0, 80.0, 0.2), 0.02, 7)))
    assert found.model.structure == "unstable_fopdt"
    assert found.model.gain == pytest.approx(process.gain, rel=0.02)


def test_a_proportional_controller_read_backward_makes_no_other_model_hopeless():
    """The measurement "follows the command within one sample" was said of each such record."""
    process = UNSTABLE_SOPDT.build((1.0, 10.0, 1.5, 1.0))
    levels = np.random.default_rng(0).uniform(-1.0, 1.0, 6)
    # The integral time is long enough for a controller without one.
    time, measured, sent = _held(
        process,
        Controller(1.7, 1e6),
        lambda t: 0.0 if t < 30.0 else levels[int(t - 30.0) // 60],
        np.arange(0.0, 300.0, 1.0),
        0.02,
        0,
    )
    found = identify(Record(time, measured, sent))
    assert found.model.structure == "unstable_sopdt"
    assert found.model.gain == pytest.approx(process.gain, rel=0.02)
    assert found.model.time_constants[0].real == pytest.approx(-10.0, rel=0.02)


def test_ends_of_an_actuator_do_not_stand_for_two_lags_of_which_one_grows():
    """A pendulum was given ends in place of its growth, and gains with which it falls."""
    process = UNSTABLE_SOPDT.build((1.0, 7.1, 5.4, 1.3))
    time, measured, sent = _held(
        process,
        Controller(4.5, 80.0, 4.0, 0.4),
        lambda t: 1.0 if 18.0 < t < 45.0 else -0.5 if t > 45.0 else 0.0,
        np.arange(0.0, 74.0, 0.125),
        0.05,
        2,
    )
    record = Record(time, measured, sent)
    problem = problem_of([(time, measured / np.ptp(measured), record.drive())], FOPDT)
    context = FitContext.of(problem, 0, held=False)
    (simple,) = context.fit(["sopdt"])
    assert context.ends is not None and not context.with_terms(simple, ("ends",))


@pytest.mark.nightly
def test_a_staircase_over_a_gain_that_grows_is_no_integrator():
    """Each step answers more than the one before, as an integrator's would."""
    rng = np.random.default_rng(5)
    time = np.arange(900) * 1.0
    command = np.clip(np.floor(time / 150.0), 0.0, 5.0)

    def slope(y, t):
        u = command[min(int(t), time.size - 1)]
        return [(0.4 * u + 0.15 * u**2 - y[0]) / 12.0, (y[0] - y[1]) / 12.0]

    y = odeint(slope, [0.0, 0.0], time, hmax=0.5)[:, 1] + 0.02 * rng.standard_normal(time.size)
    found = identify(Record(time, y, command))
    above, below = found.effects
    assert found.middle == pytest.approx(2.5)
    # The mean slopes of the curve on either side.
    assert found.model.gain * above == pytest.approx(1.525, rel=0.1)
    assert found.model.gain * below == pytest.approx(0.775, rel=0.15)
    assert sum(t.real for t in found.model.time_constants) < 40.0


@pytest.mark.nightly
@pytest.mark.parametrize("ends", [(-3.0, 8.0), (-100.0, 100.0), (-5.0, 12.0), (-100.0, 8.0)])
def test_an_actuator_that_ends_is_found_in_what_its_controller_sent(ends):
    """Without the ends the model was trusted with half of the gain, and a true Ms of 3.5."""
    process = SOPDT.of_fields(gain=1.5, time_constants=[20.0, 5.0], dead_time=6.0)
    time, measured, sent = _held(
        process,
        Controller(1.5, 25.0),
        lambda t: 10.0 if 20.0 <= t < 150.0 else 0.0,
        np.arange(0.0, 450.0, 1.0),
        0.1,
        3,
        ends,
    )
    found = identify(Record(time, measured, sent))
    assert found.model.gain == pytest.approx(process.gain, rel=0.02)
    assert found.ultimate_gain == pytest.approx(ultimate_point(process).gain, rel=0.05)
    for end, beyond, at in zip(ends, (sent < ends[0], sent > ends[1]), found.ends, strict=True):
        # An end that no command reached is not known.
        if np.count_nonzero(beyond) > 10:
            assert at == pytest.approx(end, abs=0.3)
    assert ("an actuator with ends" in " ".join(found.warnings)) == bool(
        np.isfinite(found.ends).any()
    )
    assert np.isfinite(found.ends).any() == (ends != (-100.0, 100.0))


@pytest.mark.nightly
def test_ends_are_found_where_the_controller_is_beyond_them_most_of_the_time():
    """They were not, and the gains were trusted with three times the ultimate gain."""
    process = SOPDT.of_fields(gain=2.5, time_constants=[34.0, 12.0], dead_time=7.3)
    time, measured, sent = _held(
        process,
        Controller(0.89, 36.6),
        lambda t: 9.3 if 34.0 < t < 465.0 else 0.0,
        np.arange(0.0, 820.0, 1.7),
        0.1,
        5,
        (-0.34, 4.22),
    )
    assert np.mean((sent < -0.34) | (sent > 4.22)) > 0.6
    found = identify(Record(time, measured, sent))
    assert found.ends == pytest.approx((-0.34, 4.22), abs=0.1)
    assert found.ultimate_gain == pytest.approx(ultimate_point(process).gain, rel=0.05)


@pytest.mark.nightly
def test_a_dead_zone_is_the_lower_end_of_what_is_answered():
    """It was trusted with four fifths of the gain."""
    time = np.arange(400) * 1.0
    command = 1.5 * np.floor(time / 80.0)
    process = SOPDT.of_fields(gain=1.5, time_constants=[20.0, 5.0], dead_time=6.0)
    felt = PiecewiseConstant.from_samples(time, np.maximum(command, 2.0))
    noise = 0.1 * np.random.default_rng(1).standard_normal(time.size)
    found = identify(Record(time, response(process, time, felt) + noise, command))
    assert found.model.gain == pytest.approx(process.gain, rel=0.03)
    assert found.ends[0] == pytest.approx(2.0, abs=0.15)


@pytest.mark.nightly
def test_effects_are_told_apart_where_there_are_levels_on_both_sides():
    """The first of a hundred levels is near their end: all others are on one side of it."""
    rng, time = np.random.default_rng(0), np.arange(2000.0)
    levels = np.append(0.02, rng.uniform(0.0, 2.4, 99))
    curve = levels - 0.1 * levels**2
    u, felt = (
        PiecewiseConstant(20.0 * np.arange(1, 100), of[1:], float(of[0])) for of in (levels, curve)
    )
    y = response(TransferFunction.fopdt(4.0, 30.0, 2.0), time, felt)
    y = y + rng.normal(0.0, 0.05, time.size)
    found = identify(Record(time, y, u(time)), known=Known(structure="fopdt"))
    assert found.middle == pytest.approx(1.2, abs=0.1)
    assert found.model.gain == pytest.approx(4.0 * (1.0 - 0.2 * found.middle), rel=0.03)


def test_a_level_that_is_held_for_long_counts_as_many_short_ones():
    """One level of thirty is below the first one, and is held as long as ten others."""
    levels = np.append(1.0 + np.arange(29) % 2, -1.0)
    u = PiecewiseConstant(np.append(20.0 * np.arange(1, 30), 1000.0), levels, 0.0)
    assert middle_of(u) == 0.5
    held = PiecewiseConstant(np.append(u.times, 1200.0), np.append(levels, 0.0), 0.0)
    assert middle_of(held) == 0.0


def test_the_middle_of_commands_about_zero_is_zero():
    u = PiecewiseConstant(np.array([1.0, 2.0]), np.array([0.1 + 0.2, -0.3]), -0.3)
    assert middle_of(u) == 0.0


def test_a_command_that_is_hardly_ever_followed_shows_no_end():
    """A balancing robot was trusted with three samples as all that its motor had answered."""
    rng, time = np.random.default_rng(0), 0.03 * np.arange(400.0)
    command = np.where(time < 0.24, 8.0, np.repeat(rng.standard_normal(80), 5))
    process = FOPDT.of_fields(gain=1.5, time_constants=[0.3], dead_time=0.06)
    felt = PiecewiseConstant.from_samples(time, np.maximum(command, 6.4))
    measured = response(process, time, felt) + 0.01 * rng.standard_normal(time.size)
    u = Record(time, measured, command).drive()
    context = FitContext.of(problem_of([(time, measured, u)], FOPDT), 0, held=False)
    assert context.problem.time_within(6.4, np.inf) < 0.03
    (simple,) = context.fit(["fopdt"])
    assert context.ends is not None and not context.with_terms(simple, ("ends",))


def test_ends_that_are_too_near_to_be_sought_are_none():
    """A vehicle's depth under its controller came out as that of a switch, with an Ms of 4."""
    rng, time = np.random.default_rng(0), 0.1 * np.arange(1500.0)
    levels = rng.uniform(-1.0, 1.0, 150)
    levels[::6] *= 0.03
    command = np.repeat(levels, 10)
    process = FOPDT.of_fields(gain=30.0, time_constants=[1.0], dead_time=0.1)
    felt = PiecewiseConstant.from_samples(time, np.clip(command, -0.03, 0.03))
    measured = response(process, time, felt) + 0.01 * rng.standard_normal(time.size)
    u = Record(time, measured, command).drive()
    context = FitContext.of(problem_of([(time, measured, u)], FOPDT), 0, held=False)
    (simple,) = context.fit(["fopdt"])
    assert context.ends is not None and not context.with_terms(simple, ("ends",))
