# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Experiments found in long records."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from sampled_relay import simulate_sampled_relay

from relay_autotune.analysis import analyse
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.excitation import LEAST_SAMPLES, find_experiments, frozen, gaps_of
from relay_autotune.record.moves import resting_command
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)
TIME = np.arange(0.0, 3000.0, 0.25)


def commanded(times, levels, *, noise=0.02, time=TIME) -> Record:
    """Record the process under a command that changes at some times."""
    u = PiecewiseConstant(np.array(times, float), np.array(levels[1:], float), float(levels[0]))
    y = 50.0 + response(MODEL, time, u) + np.random.default_rng(3).normal(0.0, noise, time.size)
    return Record(time=time, measurement=y, command=u(time), held_input=u)


def spans(record):
    return [
        (s.kind, float(record.time[s.first]), float(record.time[s.last]))
        for s in find_experiments(record)
    ]


def test_the_command_at_which_a_process_rests_before_its_test():
    assert resting_command(commanded([1000.0], [30, 40])) == 30.0
    # The rest of a part is that before its own steps.
    whole = commanded([100.0, 1500.0], [30, 40, 35])
    assert resting_command(whole.part(4000, len(whole))) == 40.0
    relay = RelaySettings(setpoint=50.0, baseline=2.0, amplitude=1.0)
    assert resting_command(replace(whole, settings=relay)) == 2.0
    # It moves from a step before, or begins with its step.
    assert math.isnan(resting_command(whole.part(400, len(whole))))
    assert math.isnan(resting_command(commanded([0.0], [30, 40])))
    # A clock in coarse steps stamps many samples with one time: that is no rest.
    coarse = commanded([3.0], [30, 40], time=np.repeat(np.arange(0.0, 50.0, 15.0), 30))
    assert math.isnan(resting_command(coarse))


def test_a_step_with_rest_ten_times_as_long_as_itself_around_it():
    ((kind, begin, end),) = spans(commanded([1000.0], [0, 1]))
    assert kind == "steps"
    # The response takes the dead time and three to five time constants.
    moved = (end - begin) / 21.0
    assert 65.0 < moved < 120.0
    assert begin == pytest.approx(1000.0 - 10.0 * moved, abs=10.0)


def test_what_moves_before_the_first_change_is_no_rest():
    """An answer to a move before the recording was cut off as if it were one."""
    record = commanded([2500.0], [0, 1])
    moved = 30.0 * np.exp(-record.time / 300.0)
    (found,) = find_experiments(replace(record, measurement=record.measurement - moved))
    assert found.first == 0
    assert find_experiments(record)[0].first > 0


def test_a_pulse_is_one_experiment_and_far_steps_are_two():
    (pulse,) = spans(commanded([1000.0, 1030.0], [0, 1, 0]))
    assert pulse[0] == "pulses"
    assert pulse[1] < 1000.0 < 1100.0 < pulse[2] < 2400.0
    first, second = spans(commanded([200.0, 2500.0], [0, 1, 0]))
    assert first[1] < 200.0 < first[2] < 1300.0
    assert 1500.0 < second[1] < 2500.0 < second[2]


def test_steps_without_rest_between_them_are_one():
    (found,) = find_experiments(commanded([500.0, 560.0, 600.0], [0, 1, 2, 1.5]))
    assert found.reason == "steps of the command from 0 to 1 to 2 to 1.5"


SETTINGS = RelaySettings(setpoint=50.0, baseline=30.0, amplitude=3.0, bias=0.9, hysteresis=0.1)


def relay(samples=900, seed=5) -> Record:
    noise = np.random.default_rng(seed).normal(0.0, 0.02, samples)
    return simulate_sampled_relay(MODEL, SETTINGS, period=0.25, noise=noise)


def test_relay_phases_apart_are_two_experiments_and_rest_is_none():
    part = relay()
    rest, n = 2000, len(part)
    noise = np.random.default_rng(1).normal(0.0, 0.02, rest)
    y = np.concatenate((50.0 + noise, part.measurement, 50.0 + noise, part.measurement))
    u = np.concatenate((np.full(rest, 30.0), part.command) * 2)
    record = Record(time=np.arange(y.size) * 0.25, measurement=y, command=u)
    found = find_experiments(record)
    assert [s.kind for s in found] == ["relay", "relay"]
    assert "between 27.9 and 33.9 that follow the measurement" in found[0].reason
    for stretch, begin in zip(found, (rest, 2 * rest + n), strict=True):
        assert begin - 1.1 * n < stretch.first < begin + 200
        assert begin + 0.8 * n < stretch.last < begin + 2.3 * n
    # The rest between them may belong to both.
    assert found[0].last < 2 * rest + n + 200
    assert found[1].first > rest + 0.8 * n


def test_pulses_by_the_clock_are_no_relay():
    times = 500.0 + 200.0 * np.arange(8)
    (found,) = find_experiments(commanded(times, [0, 1] * 4 + [0]))
    assert found.kind == "sequence"
    assert "whatever the measurement does" in found.reason


def controlled(setpoint, samples=4000, noise=0.02) -> Record:
    """Record a PI loop of 1.65 e^(-10 s)/(20 s + 1), sampled each 0.5 s."""
    pole, rng = math.exp(-0.5 / 20.0), np.random.default_rng(1)
    late, y, integral = [0.0] * 20, 0.0, 0.0
    columns = []
    for k in range(samples):
        seen = y + rng.normal(0.0, noise)
        error = setpoint(0.5 * k) - seen
        integral += error * 0.5 * 0.6 / 20.0
        late.append(0.6 * error + integral)
        columns.append((0.5 * k, seen, late[-1]))
        y = pole * y + (1.0 - pole) * 1.65 * late[-21]
    time, measurement, command = np.array(columns).T
    return Record(time=time, measurement=measurement, command=command)


def test_a_staircase_under_a_controller():
    record = controlled(lambda t: (t > 500.0) + (t > 700.0) - 2.0 * (t > 900.0))
    ((kind, begin, end),) = spans(record)
    assert kind == "closed loop"
    assert begin < 500.0
    assert 950.0 < end < 1500.0


def test_a_loop_at_rest_is_no_experiment():
    assert spans(controlled(lambda t: 0.0)) == []


def test_a_closed_loop_moves_though_its_answers_from_row_to_row_look_like_noise():
    """A servo whose controller jumps from end to end at each row was told that nothing moves."""
    rng, k = np.random.default_rng(4), np.arange(400)
    chatter = rng.normal(0.0, 0.3, k.size)
    step = 1.4 * (k > 200)
    record = Record(time=0.1 * k, measurement=step + chatter, command=4.0 * step + 9.0 * chatter)
    assert [found.kind for found in find_experiments(record)] == ["closed loop"]


@pytest.mark.nightly
def test_a_loop_at_rest_gives_no_gains_even_where_it_is_asked_to():
    """Its command follows the noise: read as its cause, that is a model of the controller."""
    found = analyse(controlled(lambda t: 0.0, samples=800))
    assert not found.gains
    assert found.reason


def test_a_command_that_moves_nothing_is_no_experiment():
    record = commanded([500.0, 900.0], [0, 1e-6, 0])
    assert spans(record) == []
    still = Record(time=TIME, measurement=np.full(TIME.size, 4.0), command=record.command)
    assert spans(still) == []


def test_where_nothing_was_recorded_an_experiment_ends():
    record = commanded([200.0, 2000.0], [0, 1, 0])
    kept = (record.time < 600.0) | (record.time > 1900.0)
    broken = Record(
        time=record.time[kept],
        measurement=record.measurement[kept],
        command=record.command[kept],
        held_input=record.held_input,
    )
    (first, second) = spans(broken)
    assert first[2] < 600.0
    assert second[1] > 1900.0


def without(record: Record, low: float, high: float) -> Record:
    """Return a table without the rows between two times [s]."""
    kept = (record.time <= low) | (record.time >= high)
    return Record(record.time[kept], record.measurement[kept], record.command[kept])


def test_a_change_of_the_command_in_a_gap_of_a_table_ends_an_experiment():
    """The row after the gap came up to its length late, and the model got too little dead time."""
    whole = commanded([50.0, 150.0], [0.0, 1.0, 0.0])
    assert gaps_of(without(whole, 100.0, 110.0)).hidden.size == 0
    assert len(find_experiments(without(whole, 100.0, 110.0))) == 1
    hit = without(whole, 145.0, 155.0)
    gaps = gaps_of(hit)
    assert hit.time[gaps.hidden].tolist() == [155.0]
    assert gaps.longest == pytest.approx(10.0)
    (first,) = find_experiments(hit)
    assert hit.time[first.last] == 145.0
    # Both changes are unknown.
    assert not find_experiments(without(hit, 40.0, 52.0))


def test_the_jitter_of_a_measured_command_is_no_experiment():
    time = np.concatenate((np.arange(0.0, 1000.0, 0.25), np.arange(5000.0, 6000.0, 0.25)))
    jitter = np.random.default_rng(1).integers(-2, 3, 100)
    for size, parts in ((0.1, 1), (1.0, 2)):
        levels = [0.0, 100.0, *(100.0 + size * jitter)]
        moves = [500.0, *np.linspace(5200.0, 5800.0, jitter.size)]
        assert len(spans(commanded(moves, levels, time=time))) == parts
    # A step after which it jitters is one.
    levels = [0.0, 100.0, *(100.0 + 0.1 * jitter)]
    (whole,) = spans(commanded([500.0, *np.linspace(520.0, 900.0, 100)], levels, time=TIME))
    assert whole[1] < 500.0


def test_rows_that_were_written_when_something_changed_have_no_gaps():
    whole = commanded([50.0, 150.0], [0.0, 1.0, 0.0], noise=0.0)
    changed = np.abs(np.diff(np.round(whole.measurement, 2), prepend=-1.0)) > 0.0
    kept = changed | (np.diff(whole.command, prepend=0.0) != 0.0)
    record = Record(whole.time[kept], whole.measurement[kept], whole.command[kept])
    assert np.max(np.diff(record.time)) > 20.0 * np.median(np.diff(record.time))
    assert gaps_of(record).before.size == 0


def test_a_saturated_stretch_is_left_out():
    record = commanded([500.0, 1500.0], [0, 1, 0.1])
    clipped = Record(
        time=record.time,
        measurement=np.minimum(record.measurement, 51.2),
        command=record.command,
        held_input=record.held_input,
    )
    for _, begin, end in spans(clipped):
        inside = (record.time >= begin) & (record.time <= end)
        assert np.count_nonzero(clipped.measurement[inside] == 51.2) < 20


@pytest.mark.parametrize("resolution", [1e-6, 0.001])
def test_an_experiment_ends_where_the_sensor_freezes(resolution):
    record = controlled(lambda t: 50.0 + 10.0 * (t > 200.0) - 5.0 * (t > 1000.0))
    y = np.round(record.measurement / resolution) * resolution
    assert frozen(y) == []
    at = int(np.searchsorted(record.time, 230.0))
    y[at:] = y[at] + 0.3 * resolution
    assert frozen(y) == [(at, y.size)]
    (found,) = find_experiments(replace(record, measurement=y))
    assert found.last == at


def test_a_process_that_rests_in_a_sensor_without_noise_is_not_frozen():
    record = commanded([500.0, 1500.0, 1600.0], [0, 1, 0.1, 1], noise=0.0)
    for digits in (0, 1, 2, 4, 12):
        assert frozen(np.round(record.measurement, digits)) == []


def test_a_position_that_rests_in_a_dead_zone_is_not_frozen():
    """A saw of the command moves it by steps of an encoder, to another level each time."""
    time = np.arange(0.0, 60.0, 0.02)
    saw = 4.0 * np.abs((time / 12.0) % 1.0 - 0.5) - 1.0
    speed = np.where(np.abs(saw) > 0.6, 2000.0 * saw + 300.0, 0.0)
    assert frozen(np.round(np.cumsum(0.02 * speed))) == []


@pytest.mark.parametrize("tau", [0.1, 0.5])
def test_a_motor_at_standstill_is_no_saturated_sensor(tau):
    # An encoder shows 0 before the step, for some samples after it, and after the motor stopped.
    time = np.arange(0.0, 6.0, 0.02)
    u = PiecewiseConstant(np.array([1.0, 3.0]), np.array([0.5, 0.0]), 0.0)
    speed = response(TransferFunction.fopdt(400.0, tau, 0.04), time, u)
    record = Record(time=time, measurement=np.round(speed / 2.0) * 2.0 + 0.0, command=u(time))
    record = replace(record, measurement=record.measurement + (speed > 1.0) * 1e-3 * time)
    (found,) = find_experiments(record)
    assert (found.first, found.last) == (0, time.size - 1)


def test_a_spike_that_is_all_of_the_range_is_no_error():
    time = np.arange(0.0, 3000.0, 0.25)
    u = PiecewiseConstant(np.array([1000.0]), np.array([1.0]), 0.0)
    y = np.maximum(response(MODEL, time, u), 0.0)
    y += 0.001 * np.random.default_rng(2).standard_normal(time.size) * (y > 0.0)
    y[:3900] = 0.0
    y[8001] = 1e4
    record = Record(time=time, measurement=np.maximum(y, 0.0), command=u(time), held_input=u)
    assert isinstance(find_experiments(record), tuple)


@pytest.mark.parametrize("samples", [1, 2, 12])
def test_a_sensor_that_drops_out_hides_no_closed_loop(samples):
    time = np.arange(0.0, 600.0, 0.5)
    rng = np.random.default_rng(6)
    levels = 1.0 + np.sin(0.05 * time) + 0.01 * rng.standard_normal(time.size)
    u = PiecewiseConstant(time, levels, 1.0)
    y = response(MODEL, time, u) + rng.normal(0.0, 0.01, time.size)
    record = Record(time=time, measurement=y, command=u(time), held_input=u)
    away = (time >= 300.0) & (time < 300.0 + 0.5 * samples)
    spiked = replace(record, measurement=np.where(away, 100.0, y))
    assert find_experiments(spiked)[0].kind == "closed loop"
    assert spans(spiked) == spans(record)


def test_a_closed_loop_keeps_as_many_samples_as_show_what_a_model_lacks():
    """The measurement follows within a few samples, while the command moves on for long."""
    time = np.arange(0.0, 9000.0, 30.0)
    rng = np.random.default_rng(1)
    levels = 5.0 + 3.0 * np.exp(-np.maximum(time - 600.0, 0.0) / 60.0) * (time >= 600.0)
    levels += 0.01 * rng.standard_normal(time.size)
    u = PiecewiseConstant(time, levels, 5.0)
    y = 50.0 + (time >= 600.0) * (1.0 - np.exp(-np.maximum(time - 600.0, 0.0) / 60.0))
    y += 0.01 * rng.standard_normal(time.size)
    (found,) = find_experiments(Record(time, y, u(time), held_input=u))
    assert found.kind == "closed loop"
    assert found.last - found.first >= LEAST_SAMPLES


def test_all_of_a_short_test_is_one_experiment():
    record = commanded([20.0, 75.0], [0, 1, 0.5], time=np.arange(0.0, 120.0, 0.1))
    (found,) = find_experiments(record)
    assert (found.first, found.last) == (0, len(record) - 1)


def test_a_pseudo_random_sequence_is_one_experiment_and_no_relay():
    """By chance it switches now and then where a relay would have."""
    rng = np.random.default_rng(4)
    for _ in range(4):
        times = 50.0 + np.cumsum(rng.integers(1, 9, 150) * 10.0)
        (found,) = find_experiments(
            commanded(times[times < 2900.0], [k % 2 for k in range(1 + (times < 2900.0).sum())])
        )
        assert found.kind == "sequence"
        assert "whatever the measurement does" in found.reason


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("stay", [80.0, 200.0, 800.0])
def test_a_square_wave_whose_process_rests_before_each_switch_is_by_a_timer(stay, noise):
    """It switches at the same measurements each time, as a relay does, but long after it came."""
    lag = TransferFunction(1.65, (), (20.0,), 0, 0.0)
    times = 100.0 + stay * np.arange(8)
    u = PiecewiseConstant(times, np.arange(1.0, 9.0) % 2.0, 0.0)
    time = np.arange(0.0, times[-1] + stay, 0.25)
    y = response(lag, time, u) + np.random.default_rng(3).normal(0.0, noise, time.size)
    record = Record(time=time, measurement=y, command=u(time), held_input=u)
    (found,) = find_experiments(record)
    assert found.kind == "sequence"
    assert (
        found.reason == "8 switches of the command between 0 and 1 whatever the measurement does"
    )


@pytest.mark.parametrize("late", [0, 1, 10])
def test_a_relay_is_known_by_its_switches_also_where_its_command_is_late(late):
    part = relay()
    u = np.concatenate((np.full(late, 30.0), part.command[: len(part) - late]))
    (found,) = find_experiments(Record(time=part.time, measurement=part.measurement, command=u))
    assert found.kind == "relay"


def test_a_sequence_of_two_levels_that_changes_at_half_of_the_samples_is_an_experiment():
    """Its process answers within a sample or two, which is no noise."""
    rng = np.random.default_rng(8)
    time = 0.05 * np.arange(200)
    u = PiecewiseConstant(time, rng.choice([-2.5, 0.5], time.size), 0.5)
    fast = TransferFunction(3.0, (), (0.04,), 0, 0.0)
    y = response(fast, time, u) + rng.normal(0.0, 0.05, time.size)
    for part in (slice(None), slice(None, 60)):
        record = Record(time=time[part], measurement=y[part], command=u(time)[part])
        (found,) = find_experiments(record)
        assert (found.kind, found.first) == ("sequence", 0)
        assert found.last >= len(record) - 2


def test_a_slow_profile_under_a_controller_is_one_experiment_to_its_end():
    """An oven follows a solder profile: it moves slowly, and fastest where the heater is off."""
    rng = np.random.default_rng(9)
    profile = np.array([[0, 25], [30, 25], [150, 150], [270, 180], [330, 235], [370, 235]])
    y = integral = 0.0
    rows = []
    for t in np.arange(0.0, 720.0, 1.0):
        seen = 25.0 + y + rng.normal(0.0, 0.1)
        error = float(np.interp(t, *profile.T)) - seen if t < 370.0 else -200.0
        integral = min(max(integral + error / 40.0, 0.0), 50.0)
        duty = min(max(2.0 * error + integral, 0.0), 100.0)
        y += (4.0 * duty - y) / (100.0 if t < 600.0 else 15.0)
        rows.append((t, seen, duty))
    time, measurement, command = np.array(rows).T
    (found,) = find_experiments(Record(time=time, measurement=measurement, command=command))
    assert found.kind == "closed loop"
    assert time[found.first] <= 30.0
    assert time[found.last] >= 650.0


def test_a_change_at_the_last_sample_is_left_out():
    record = commanded([2500.0, 2600.0, TIME[-1]], [0, 1, 0.5, 0])
    (found,) = find_experiments(record)
    assert found.reason == "step of the command from 0 to 1 to 0.5"
    assert found.last == len(record) - 2
    assert find_experiments(commanded([TIME[-1]], [0, 1])) == ()


@pytest.mark.parametrize("samples", [200, 1900])
def test_a_record_that_ends_within_a_ramp_of_the_command_is_an_experiment(samples):
    times = TIME[-samples:]
    (found,) = find_experiments(commanded(times, np.linspace(0.0, 50.0, samples + 1), noise=0.001))
    assert found.kind == "steps"
    assert TIME[found.first] < times[0]
    assert found.last == TIME.size - 2


def test_an_even_ramp_under_a_command_that_varies_all_the_time_is_an_experiment():
    rng = np.random.default_rng(7)
    u = 1.0 + rng.normal(0.0, 0.02, TIME.size)
    integrator = TransferFunction(0.01, integrators=1, dead_time=1.0)
    y = response(integrator, TIME, PiecewiseConstant(TIME, u, 0.0))
    record = Record(time=TIME, measurement=y + rng.normal(0.0, 0.01, TIME.size), command=u)
    ((kind, begin, end),) = spans(record)
    assert (kind, begin, end) == ("closed loop", TIME[0], TIME[-1])


def test_rows_that_share_a_time_are_one_instant_of_the_command():
    fine = controlled(lambda t: 50.0 + 5.0 * (t > 300.0))
    shared = replace(fine, time=np.floor(fine.time / 4.0) * 4.0)
    assert {stretch.kind for stretch in find_experiments(shared)} == {"closed loop"}


def test_a_closed_loop_lasts_as_long_as_its_command_moves_far():
    """A command that got no answer speaks against a response: it is of another loop."""
    rng = np.random.default_rng(5)
    settled = 50.0 + 10.0 * np.exp(-np.maximum(TIME - 500.0, 0.0) / 20.0)
    command = 30.0 * (TIME > 500.0) + 40.0 * ((TIME > 2200.0) & (TIME < 2300.0))
    noise = rng.normal(0.0, 0.02, (2, TIME.size))
    loop = Record(time=TIME, measurement=settled + noise[0], command=command + noise[1])
    ((kind, _, end),) = spans(loop)
    assert kind == "closed loop"
    assert end > 2300.0
    creeping = Record(
        time=TIME,
        measurement=settled + noise[0],
        command=30.0 * (TIME > 500.0) + 2.0 * (TIME > 2200.0) + noise[1],
    )
    ((_, _, end),) = spans(creeping)
    assert end < 2200.0
