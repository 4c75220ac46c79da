# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Cycles: their features, their agreement, their averages, and relays of unknown origin."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from fopdt_plant import FopdtPlant, run
from hypothesis import given
from hypothesis import strategies as st

from relay_autotune.errors import RecordError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.cycles import (
    agree,
    cycle_bounds,
    cycle_from_samples,
    cycles_of,
    follow_measurement,
    infer_settings,
    limit_cycle,
)
from relay_autotune.record.record import Cycle, Outcome, PiecewiseConstant, Record, RelaySettings

CYCLE = Cycle(
    index=0,
    start=0.0,
    period=10.0,
    period_high=4.0,
    period_low=6.0,
    peak_max=2.0,
    peak_min=-1.0,
    time_to_peak_max=1.0,
    time_to_peak_min=1.0,
    mean_measurement=0.2,
    mean_command=0.1,
)


def tuned(gain=1.0, ratio=0.7, period=0.01, noise=0.0, baseline=0.0, **parameters):
    tune = RelayExperiment(
        ExperimentParameters(**{"amplitude": 1.0, **parameters}), baseline=baseline
    )
    generator = np.random.default_rng(5)
    run(
        tune,
        FopdtPlant(gain, 1.0, ratio),
        period,
        noise=(lambda: noise * generator.standard_normal()) if noise else None,
        offset=10.0,
    )
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    return tune.record()


def square(levels, stay, lead=(), tail=()):
    """Return a record whose command stays at each of the levels for a number of samples.

    The measurement rises and falls with them, and switches where it comes to its level.
    """
    command = np.concatenate((lead, np.repeat(levels, stay), tail)).astype(float)
    time = 0.5 * np.arange(command.size)
    rate = np.where(command > np.mean(levels), 1.0, -1.0)
    y = np.concatenate(([0.0], np.cumsum(rate[:-1])))
    return Record(time=time, measurement=y, command=command)


# The features of one cycle.


def triangle():
    # Rises by 1 a sample for 3 samples, falls for 5, rises for 2: the peaks come one sample
    # after the switches.
    time = np.arange(9) * 0.5
    y = np.array([1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0])
    u = np.array([5.0, 5.0, 5.0, 5.0, 1.0, 1.0, 1.0, 1.0])
    return time, y, u


def test_features_of_a_direct_acting_relay():
    cycle = cycle_from_samples(3, *triangle(), middle=3.0, reverse_acting=False)
    assert (cycle.index, cycle.start, cycle.period) == (3, 0.0, 4.0)
    assert (cycle.period_high, cycle.period_low) == (2.0, 2.0)
    assert (cycle.peak_max, cycle.peak_min) == (4.0, 0.0)
    assert (cycle.time_to_peak_max, cycle.time_to_peak_min) == (0.5, 0.5)
    assert cycle.mean_command == 3.0
    assert cycle.mean_measurement == pytest.approx(2.0)
    assert not cycle.converged
    assert not cycle.disturbed


def test_features_of_a_reverse_acting_relay():
    time, y, u = triangle()
    cycle = cycle_from_samples(0, time, -y, u, middle=3.0, reverse_acting=True)
    assert (cycle.peak_max, cycle.peak_min) == (0.0, -4.0)
    assert (cycle.time_to_peak_max, cycle.time_to_peak_min) == (0.5, 0.5)


def test_the_mean_of_an_irregularly_sampled_cycle_weighs_with_time():
    time = np.array([0.0, 1.0, 4.0, 5.0])
    u = np.array([2.0, 0.0, 0.0])
    cycle = cycle_from_samples(
        0, time, np.array([0.0, 2.0, 2.0, 0.0]), u, middle=1.0, reverse_acting=False
    )
    assert cycle.mean_command == pytest.approx(0.4)
    assert cycle.mean_measurement == pytest.approx((1.0 + 6.0 + 1.0) / 5.0)
    assert cycle.period_high == 1.0


def test_moments_of_noise_at_a_switch_do_not_move_the_half_periods():
    time, y, u = triangle()
    u = u.copy()
    u[1] = 1.0
    cycle = cycle_from_samples(0, time, y, u, middle=3.0, reverse_acting=False)
    assert cycle.period_high == 1.5
    assert cycle.time_to_peak_max == 0.5


def test_a_gap_marks_a_cycle_as_disturbed():
    time, y, u = triangle()
    time = np.where(time > 1.0, time + 10.0, time)
    cycle = cycle_from_samples(0, time, y, u, middle=3.0, reverse_acting=False)
    assert cycle.disturbed


def test_a_cycle_without_time_or_samples():
    cycle = cycle_from_samples(
        0, np.zeros(3), np.ones(3), np.array([1.0, 0.0]), middle=0.5, reverse_acting=False
    )
    assert (cycle.period, cycle.mean_command, cycle.mean_measurement) == (0.0, 0.5, 1.0)
    with pytest.raises(RecordError, match="at least 2, found 1"):
        cycle_from_samples(
            0, np.zeros(1), np.ones(1), np.empty(0), middle=0.5, reverse_acting=False
        )


# Agreement.


@pytest.mark.parametrize(
    ("change", "allowed"),
    [
        ({}, True),
        ({"period_high": 4.07}, True),
        ({"period_high": 4.09}, False),
        ({"period_low": 6.2}, False),
        ({"peak_max": 2.029}, True),
        ({"peak_max": 2.031}, False),
        ({"peak_min": -1.1}, False),
    ],
)
def test_cycles_agree_within_the_tolerance(change, allowed):
    assert agree([CYCLE, CYCLE, replace(CYCLE, **change)], 0.0, 0.0, 0.02) is allowed


def test_agreement_allows_for_noise_and_for_the_sample_interval():
    late = replace(CYCLE, period_high=4.3)
    assert not agree([CYCLE, late], 0.0, 0.0, 0.02)
    assert agree([CYCLE, late], 0.0, 0.12, 0.02)
    assert agree([CYCLE, late], 0.1, 0.0, 0.02)
    assert agree([CYCLE, CYCLE], math.nan, 0.0, 0.02)


def test_cycles_without_any_swing_do_not_agree():
    flat = replace(CYCLE, peak_max=0.0, peak_min=0.0)
    assert not agree([flat, flat], 0.0, 0.0, 0.02)


# Averages.


def test_the_limit_cycle_is_the_last_run_of_converged_cycles_and_those_they_agree_with():
    flags = [False, True, False, False, True, True, False]
    cycles = [
        replace(CYCLE, index=k, period=10.0 + k, converged=flag) for k, flag in enumerate(flags)
    ]
    found = limit_cycle(cycles)
    assert found.cycles == (2, 3, 4, 5)
    assert found.period == 13.5
    assert found.period_std == pytest.approx(np.std([12, 13, 14, 15], ddof=1))
    assert found.converged


def test_without_convergence_the_last_cycles_count():
    found = limit_cycle([replace(CYCLE, index=k) for k in range(5)])
    assert found.cycles == (2, 3, 4)
    assert not found.converged
    assert limit_cycle([CYCLE]).period_std == 0.0


def test_disturbed_cycles_are_left_out_if_others_remain():
    cycles = [replace(CYCLE, index=k, disturbed=k == 1) for k in range(3)]
    assert limit_cycle(cycles).cycles == (0, 2)
    assert limit_cycle([replace(c, disturbed=True) for c in cycles]).cycles == (0, 1, 2)


def test_no_cycle_is_an_error_with_a_sentence():
    with pytest.raises(RecordError, match="no whole cycle"):
        limit_cycle([])


def test_the_static_gain_is_the_quotient_of_the_means():
    record = tuned(gain=2.0, period=0.002)
    cycle = limit_cycle(record)
    # The cycles of a sampled relay do not end quite where they began.
    assert (cycle.mean_measurement - 10.0) / cycle.mean_command == pytest.approx(2.0, rel=3e-3)


# Relays of unknown origin.


@pytest.mark.parametrize("gain", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("sign", [0, 1])
def test_a_record_stripped_of_its_settings_gives_them_back(gain, noise, sign):
    record = tuned(
        gain=gain, noise=noise, baseline=3.0, hysteresis=0.1, process_gain_sign=int(sign * gain)
    )
    bare = Record(time=record.time, measurement=record.measurement, command=record.command)
    # The last cycle ends with the baseline and not with a switch to the high level.
    assert cycle_bounds(bare) == record.cycle_start[:-1]
    found, truth = infer_settings(bare), record.settings
    assert found.amplitude == pytest.approx(truth.amplitude)
    assert found.bias == pytest.approx(truth.bias)
    assert found.baseline == truth.baseline
    assert found.reverse_acting is truth.reverse_acting
    assert found.setpoint == pytest.approx(truth.setpoint, abs=0.02)
    assert found.hysteresis == pytest.approx(truth.hysteresis, abs=0.02)
    cut = replace(record, cycle_start=(), outcome=Outcome.UNKNOWN)
    strip = [replace(c, converged=False) for c in cycles_of(record)[:-1]]
    assert [replace(c, converged=False) for c in cycles_of(cut)] == strip
    assert len(cycles_of(bare)) == len(strip)


def test_an_experiment_of_ours_without_cycles_has_none():
    record = replace(square([0.0, 1.0] * 4, 5), outcome=Outcome.FAILED)
    assert cycles_of(replace(record, settings=RelaySettings(0.0, 0.5, 0.5))) == ()


def test_levels_before_and_after_the_oscillation_are_no_cycles():
    record = square([8.0, 2.0] * 4, 10, lead=[5.0] * 30 + [0.0] * 7, tail=[5.0] * 9)
    assert cycle_bounds(record) == (57, 77, 97)
    assert infer_settings(record) == replace(
        infer_settings(record), baseline=5.0, amplitude=3.0, bias=0.0
    )


def test_without_a_level_before_it_the_baseline_is_the_middle():
    found = infer_settings(square([8.0, 2.0] * 4, 10))
    assert (found.baseline, found.bias) == (5.0, 0.0)


def test_moments_of_noise_begin_no_cycle():
    stays = [40, 1, 2, 60, 1, 1, 40, 60, 2, 1, 40, 60]
    levels = [1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0]
    # Ends of the long low stays: after 104, 206 and so on.
    command = np.repeat(levels, stays).astype(float)
    time = np.arange(command.size) * 0.1
    # Rises for 42 or 43 samples, falls for 60 to 62.
    turns = [0, 43, 103, 144, 205, 247]
    y = np.interp(np.arange(command.size), turns, [0.0, 1.0] * 3)
    record = Record(time=time, measurement=y, command=command)
    assert cycle_bounds(record) == (103, 205)


def test_a_square_wave_by_the_clock_is_no_relay():
    """The process has come to rest long before each switch."""
    time = np.arange(0.0, 20.0, 0.04)
    u = PiecewiseConstant(np.arange(1.0, 20.0), np.tile([1.0, -1.0], 10)[:19], 0.0)
    y = response(TransferFunction.fopdt(7.2, 0.15, 0.01), time, u)
    y += np.random.default_rng(0).normal(0.0, 0.1, time.size)
    record = Record(time=time, measurement=y, command=u(time))
    # the same switches are a relay's if the measurement had come to its level just before
    late = replace(record, measurement=np.interp(time, u.times, np.tile([-1.0, 1.0], 10)[:19]))
    assert cycle_bounds(late)
    assert cycle_bounds(record) == cycles_of(record) == ()
    assert infer_settings(record) is None


@pytest.mark.parametrize(
    "command",
    [
        np.zeros(50),
        np.repeat([0.0, 1.0], 25),
        np.repeat([0.0, 1.0, 0.0], 20),
        np.linspace(0.0, 1.0, 50),
        np.repeat(np.arange(10.0), 5),
        np.sin(np.arange(500.0)),
        np.array([1.0]),
    ],
)
def test_commands_that_are_no_relay(command):
    record = Record(
        time=np.arange(command.size), measurement=np.zeros(command.size), command=command
    )
    assert cycle_bounds(record) == ()
    assert infer_settings(record) is None
    assert cycles_of(record) == ()


@pytest.mark.long
@given(
    command=st.lists(st.sampled_from([0.0, 1.0, 2.0, 5.0]), min_size=1, max_size=60),
    steps=st.lists(st.sampled_from([0.0, 0.1, 7.0]), min_size=60, max_size=60),
)
def test_any_command_gives_valid_cycles(command, steps):
    time = np.cumsum(steps[: len(command)])
    record = Record(time=time, measurement=np.sin(time), command=np.array(command))
    bounds = cycle_bounds(record)
    assert len(replace(record, cycle_start=bounds).cycle_start) == len(bounds)
    for k in bounds:
        assert record.command[k] > record.command[k - 1]
    for cycle in cycles_of(record):
        assert cycle.period >= 0.0
        assert all(
            math.isfinite(getattr(cycle, name)) for name in ("mean_measurement", "mean_command")
        )


@pytest.mark.parametrize("unit", ["datetime64[ns]", "timedelta64[ms]", "complex128", "str"])
def test_columns_of_dates_or_other_things_than_real_numbers_are_refused(unit):
    """The nanoseconds of a date had passed for seconds."""
    column = np.arange(10).astype(unit)
    with pytest.raises(RecordError, match=re.escape(f"real numbers, found {column.dtype}")):
        Record(time=column, measurement=np.zeros(10), command=np.zeros(10))


def test_two_switches_follow_or_do_not_without_a_warning():
    time = np.arange(0.0, 60.0)
    record = Record(time=time, measurement=np.sin(time / 9.0), command=np.ones(60))
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        for rises in ([False, True], [True, False]):
            follow_measurement(record, np.array([10, 40]), np.array(rises))
