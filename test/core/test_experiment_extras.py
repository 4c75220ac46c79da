# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""An amplitude that is found, delays, rates, limits, faults of the sensor, and what follows."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from fopdt_plant import FopdtPlant, run, wang_limit_cycle

from relay_autotune.analysis import analyse
from relay_autotune.errors import ParameterError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.faults import (
    ClockWatch,
    FrozenWatch,
    RunawayWatch,
    SafePolicy,
    is_growing,
)
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.relay_law import Levels, Swing
from relay_autotune.identification.known import Known
from relay_autotune.loop.analysis import Loop
from relay_autotune.process.structures import UNSTABLE_FOPDT, structure_named
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant
from relay_autotune.reasons import Code
from relay_autotune.record.cycles import limit_cycle
from relay_autotune.record.record import Outcome
from relay_autotune.verdict import Verdict


def experiment(baseline=0.0, policy=None, until_converged=True, **parameters):
    return RelayExperiment(
        ExperimentParameters(**{"amplitude": 1.0, **parameters}),
        baseline,
        policy=policy or SafePolicy(),
        until_converged=until_converged,
    )


def gaussian(std, seed=1):
    generator = np.random.default_rng(seed)
    return lambda: std * generator.standard_normal()


def searching(**parameters):
    return experiment(amplitude=0.0, command_min=-10.0, command_max=10.0, **parameters)


# The amplitude found by itself.


@pytest.mark.parametrize("dead_time", [0.3, 5.0])
@pytest.mark.parametrize("gain", [2.0, -0.5])
def test_an_amplitude_that_is_found_stands_clear_of_the_noise(gain, dead_time):
    std = 0.02
    tune = searching()
    run(tune, FopdtPlant(gain, 2.0, dead_time), 0.05, noise=gaussian(std))
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    record, cycle = tune.record(), limit_cycle(tune.record())
    half_swing = 0.5 * (cycle.peak_max - cycle.peak_min)
    # The noise itself adds to the swing by which it was judged.
    assert 7.5 * std < half_swing
    # Far from what the limits would have allowed.
    assert half_swing < 0.4 * 10.0 * abs(gain)
    # It grew, and never passed a limit.
    sizes = np.abs(record.command[: record.cycle_start[0]])
    assert np.unique(sizes).size > 3
    assert np.abs(record.command).max() <= 10.0


def test_a_target_in_units_of_the_measurement_is_met():
    tune = searching(target_amplitude=1.5)
    run(tune, FopdtPlant(2.0, 2.0, 1.0), 0.05, noise=gaussian(0.01))
    cycle = limit_cycle(tune.record())
    assert 1.5 <= 0.5 * (cycle.peak_max - cycle.peak_min) < 3.0


def test_a_first_swing_that_is_just_short_of_the_target_is_given_another_cycle():
    """It is smaller than those after it: the amplitude grew by half where it was large enough."""
    lags = TransferFunction(1.0, (), (10.0, 10.0), dead_time=1.0)

    def half_swings(target):
        tune = searching(target_amplitude=target)
        run(tune, Plant(lags), 0.05)
        return tune.settings.amplitude, [0.5 * (c.peak_max - c.peak_min) for c in tune.cycles]

    amplitude, (first, *_, settled) = half_swings(0.02)
    assert 1.05 * first < settled
    grown, (least, *_) = half_swings(1.05 * first)
    assert grown == amplitude and least >= 1.05 * first


def test_a_target_out_of_reach_is_said_and_the_limits_hold():
    tune = experiment(amplitude=0.0, target_amplitude=50.0, command_min=-1.0, command_max=3.0)
    run(tune, FopdtPlant(2.0, 2.0, 1.0), 0.05)
    record = tune.record()
    assert tune.outcome is Outcome.COMPLETED
    assert "all that the command limits allow" in tune.reason
    assert record.command.min() >= -1.0
    assert record.command.max() <= 3.0
    # Next to a limit the two steps differ.
    assert (record.settings.low, record.settings.high) == (-1.0, 3.0)
    assert record.settings.amplitude == 2.0
    assert record.settings.bias == 1.0


@pytest.mark.parametrize("end", [0.2, 0.5])
def test_a_clipped_actuator_shows_in_a_response_that_does_not_grow(end):
    tune = searching(target_amplitude=5.0)
    plant, command = FopdtPlant(2.0, 2.0, 1.0), 0.0
    noise = gaussian(0.001)
    for k in range(40_000):
        y = plant.advance(0.05 * k, min(max(command, -end), end)) + noise()
        command = tune.step(0.05 * k, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.FAILED
    assert "the actuator is clipped: the amplitude grew from" in tune.reason
    assert np.abs(tune.record().command).max() < 10.0
    assert command == 0.0


@pytest.mark.long
@pytest.mark.parametrize("amplitude", [20.0, 100.0])
@pytest.mark.parametrize("baseline", [0.0, 0.5, 1.0, 2.5, 4.5, 5.0])
@pytest.mark.parametrize("std", [0.0, 0.05])
def test_a_given_amplitude_beyond_the_ends_of_the_actuator_never_completes(
    amplitude, baseline, std
):
    tune = RelayExperiment(ExperimentParameters(amplitude=amplitude), baseline, from_small=True)
    plant, command, noise = FopdtPlant(1.65, 20.0, 10.0), baseline, gaussian(std)
    for k in range(40_000):
        y = plant.advance(0.2 * k, min(max(command, 0.0), 5.0) - baseline) + noise()
        command = tune.step(0.2 * k, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.FAILED, tune.reason
    if 0.0 < baseline < 5.0:
        assert "the actuator is clipped: the amplitude grew from" in tune.reason
        assert len(tune.cycles) <= 3
    assert command == baseline


@pytest.mark.nightly
@pytest.mark.parametrize("share", [0.1, 0.6, 0.2, 0.4])
@pytest.mark.parametrize("std", [0.002, 0.02])
@pytest.mark.parametrize("known", [Known(structure="fopdt"), Known()], ids=["fopdt", "chosen"])
def test_of_both_levels_clipped_alike_only_gains_that_hold_are_trusted(known, share, std):
    """True Ms of its gains: 1.8 to 1.9 at six tenths of the amplitude, unstable at two tenths."""
    limits = {"command_min": -5.0, "command_max": 5.0}
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0, **limits), 0.0, from_small=True)
    plant, command, noise = FopdtPlant(1.65, 20.0, 10.0), 0.0, gaussian(std)
    for k in range(40_000):
        y = plant.advance(0.2 * k, min(max(command, -0.7 * share), 1.3 * share)) + noise()
        command = tune.step(0.2 * k, y)
        if tune.finished:
            break
    if tune.outcome is Outcome.COMPLETED:
        found = analyse(tune.record(), known=known, alone=True)
        # In the larger noise nothing tells six tenths of the effect from a smaller gain.
        gains, process = found.best_gains, TransferFunction.fopdt(1.65, 20.0, 10.0)
        hold = gains is not None and Loop(gains, process).ms() < 1.8
        assert hold or found.verdict is not Verdict.TRUSTED


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [1, 2])
def test_levels_that_the_actuator_does_not_reach_show_beside_the_smaller_ones(seed):
    """The gains have to hold before and after the last growth: their Ms had been up to 1.49."""
    process, end = TransferFunction.fopdt(2.0, 0.5, 0.16), 0.3
    tune = experiment(amplitude=0.0, command_min=-3.0, command_max=3.0)
    plant, noise, command = Plant(process), gaussian(0.009, seed), 0.0
    for k in range(20_000):
        y = plant.advance(0.02 * k, min(max(command, -end), end)) + noise()
        command = tune.step(0.02 * k, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.settings.high > 1.2 * end
    found = analyse(tune.record(), alone=True)
    assert any("two parts of the record" in told for told in found.model.warnings)
    assert Loop(found.best_gains, process).ms() < 1.42


def test_a_first_amplitude_that_cannot_leave_the_band_is_made_larger_soon():
    """The loop still moves while it settles, so that its noise is taken for too large."""
    given = ExperimentParameters(amplitude=0.5, settle_time=0.1, process_gain_sign=1)
    tune = RelayExperiment(given, 0.0, from_small=True)
    before = [0.15, -0.15, 0.15, -0.15, 0.15]
    rest = gaussian(0.001)
    noise = itertools.chain(before, (rest() for _ in itertools.count()))
    # A quarter of the amplitude moves it by 0.25, less than the band.
    run(tune, FopdtPlant(2.0, 0.1, 0.05), 0.025, noise=lambda: next(noise))
    assert tune.outcome is Outcome.COMPLETED and tune.settings.hysteresis > 0.25
    # Until a level is answered it waits 5 s; ten times that was waited for at each level then.
    assert tune.elapsed < 60.0


def test_a_kick_that_noise_seemed_to_answer_is_made_larger():
    """At a quarter of the amplitude the response is smaller than the noise."""
    limits = {"command_min": -5.0, "command_max": 5.0}
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0, **limits), 0.0, from_small=True)
    model = TransferFunction(1.0, (), (4.0, 1.0), 0, 0.5)
    plant, noise, command = Plant(model), gaussian(0.2, seed=0), 0.0
    for k in range(20_000):
        command = tune.step(0.1 * k, plant.advance(0.1 * k, command) + noise())
        if tune.finished:
            break
    assert tune.outcome is Outcome.COMPLETED, tune.reason


@pytest.mark.long
@pytest.mark.parametrize("bias", [{}, {"bias": -0.3}, {"bias_ratio": 0.0}])
@pytest.mark.parametrize("dead_time", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("std", [0.0, 0.005, 0.02])
def test_an_amplitude_that_begins_small_ends_as_it_was_given(bias, dead_time, std):
    given = ExperimentParameters(amplitude=0.7, **bias)
    tune = RelayExperiment(given, 0.0, from_small=True)
    run(tune, FopdtPlant(2.0, 2.0, dead_time), 0.02, noise=gaussian(std))
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    plain = RelayExperiment(given, 0.0)
    run(plain, FopdtPlant(2.0, 2.0, dead_time), 0.02, noise=gaussian(std))
    assert tune.settings.amplitude == plain.settings.amplitude == 0.7
    assert tune.settings.bias == plain.settings.bias
    small = tune.record().command[tune.record().command != 0.0][0]
    assert small == pytest.approx(0.25 * (0.7 + tune.settings.bias))
    before, now = limit_cycle(plain.record()), limit_cycle(tune.record())
    assert now.period == pytest.approx(before.period, rel=0.15)
    # What could not be told is said, where the noise is as large as a quarter of the swing.
    if std == 0.0:
        assert "could not be told" not in tune.reason


def test_a_swing_that_noise_and_band_hold_grows_in_its_rate():
    """Swings of an oven with steps of 0.25 K: the relay's band and the rounding set their size."""
    levels = Levels(ExperimentParameters(command_min=0.0, command_max=1.0), 0.4)
    levels.note_small(Swing(1.25, 86.9), clear=1.25)
    levels.grow(4.0)
    assert levels.why_clipped(Swing(1.375, 47.5), settled=False) is None
    clipped = levels.why_clipped(Swing(1.375, 80.0), settled=False)
    assert clipped is not None
    assert clipped.code == Code.CLIPPED


@pytest.mark.parametrize("dead_time", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("std", [0.0, 0.01])
def test_a_response_that_grows_is_not_taken_for_a_clipped_one(dead_time, std):
    tune = searching(target_amplitude=0.5)
    run(tune, FopdtPlant(2.0, 2.0, dead_time), 0.02, noise=gaussian(std))
    assert tune.outcome is Outcome.COMPLETED, tune.reason


def test_a_coarse_sensor_needs_several_steps():
    plant, step = FopdtPlant(2.0, 2.0, 1.0), 0.3
    tune = searching()
    command = 0.0
    for k in range(40_000):
        y = round(plant.advance(0.05 * k, command) / step) * step
        command = tune.step(0.05 * k, y)
        if tune.finished:
            break
    cycle = limit_cycle(tune.record())
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert 0.5 * (cycle.peak_max - cycle.peak_min) >= 4.9 * step


@pytest.mark.parametrize(
    ("limits", "low", "high"),
    [({}, 1.9, 4.0), ({"max_deviation": 3.0}, 0.95, 2.0), ({"measurement_max": 3.0}, 0.95, 2.0)],
)
def test_a_swing_of_twenty_steps_is_aimed_at_where_the_limits_allow_it(limits, low, high):
    plant, step, noise = FopdtPlant(2.0, 2.0, 1.0), 0.1, gaussian(0.03)
    tune, command = searching(**limits), 0.0
    for k in range(40_000):
        y = round((plant.advance(0.05 * k, command) + noise()) / step) * step
        command = tune.step(0.05 * k, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    cycle = limit_cycle(tune.record())
    assert low <= 0.5 * (cycle.peak_max - cycle.peak_min) < high


# Delay and rate.


def test_an_extra_delay_acts_as_a_longer_dead_time():
    period, extra = 0.005, 0.4
    tune = experiment(hysteresis=0.1, extra_delay=extra)
    run(tune, FopdtPlant(1.0, 2.0, 0.6), period)
    cycle = limit_cycle(tune.record())
    high, low, *_ = wang_limit_cycle(1.0, 2.0, 0.6 + extra, 1.0, 0.3, 0.1)
    assert cycle.period_high == pytest.approx(high, abs=2.1 * period)
    assert cycle.period_low == pytest.approx(low, abs=2.1 * period)
    assert tune.settings.extra_delay == extra


def test_the_command_changes_no_faster_than_its_rate():
    rate, period = 4.0, 0.05
    tune = experiment(command_rate=rate)
    run(tune, FopdtPlant(1.0, 2.0, 1.0), period)
    record = tune.record()
    assert tune.outcome is Outcome.COMPLETED
    steps = np.abs(np.diff(record.command))[:-1]
    assert steps.max() == pytest.approx(rate * period)
    assert {record.command.min(), record.command.max()} == {-0.7, 1.3}


# Limits and faults.


def test_the_largest_deviation_from_the_set_point_ends_it():
    tune = experiment(max_deviation=0.5)
    run(tune, FopdtPlant(2.0, 2.0, 1.0), 0.05, offset=7.0)
    assert tune.outcome is Outcome.ABORTED
    assert "more than max_deviation, 0.5" in tune.reason
    record = tune.record()
    assert abs(record.measurement[-2] - 7.0) <= 0.5
    assert record.command[-1] == 0.0


def test_a_half_cycle_that_is_too_long_ends_it():
    tune = experiment(max_half_cycle=0.8, process_gain_sign=1)
    run(tune, FopdtPlant(1.0, 2.0, 2.0), 0.05)
    assert tune.outcome is Outcome.FAILED
    assert "no oscillation" in tune.reason


def test_a_frozen_sensor_is_recognised_in_a_second():
    plant, noise = FopdtPlant(1.0, 2.0, 1.0), gaussian(0.01)
    tune, command, y = experiment(), 0.0, 0.0
    for k in range(4000):
        if k < 300:
            y = plant.advance(0.05 * k, command) + noise()
        command = tune.step(0.05 * k, y)
        if tune.finished:
            break
    assert k - 300 <= 21
    assert tune.outcome is Outcome.FAILED
    assert "the sensor is frozen: its last 21 samples are all" in tune.reason
    assert command == 0.0


@pytest.mark.parametrize("step", [0.05, 0.3])
@pytest.mark.parametrize("dead_time", [0.2, 10.0])
def test_a_coarse_sensor_is_not_taken_for_a_frozen_one(step, dead_time):
    plant, noise = FopdtPlant(1.0, 1.0, dead_time), gaussian(0.02)
    tune, command = experiment(hysteresis=step), 0.0
    for k in range(8000):
        y = round((plant.advance(0.05 * k, command) + noise()) / step) * step
        command = tune.step(0.05 * k, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.COMPLETED, tune.reason


def test_a_coarse_sensor_that_freezes_is_recognised_after_a_cycle():
    watch = FrozenWatch()
    for k in range(400):
        value = round(3.0 * math.sin(0.05 * k))
        assert not watch.add(value, at_rest=k < 100, in_cycles=k > 200)
    frozen = [watch.add(3.0, at_rest=False, in_cycles=True) for _ in range(200)]
    assert 20 < frozen.index(True) < 120


def test_a_step_of_a_clock_is_told_from_late_samples():
    rng = np.random.default_rng(2)
    watch = ClockWatch()
    latency = 1e-4 + rng.exponential(1e-3, 1000)
    latency[500] = 0.7
    # A machine that was busy for 0.6 s, and then takes all at once.
    latency[700:760] = 0.6 - 0.01 * np.arange(60)
    for k in range(1000):
        assert not watch.add(0.01 * k, 0.01 * k + latency[k] + 1e-5 * k)
    # The drift of 10 ms is followed, slowly.
    assert 0.002 < watch.drift < 0.012
    # The source's clock goes forward: nothing arrives before it was sent.
    said = watch.add(10.0 + 0.3, 10.0 + 0.011)
    assert said is not None and said.code is Code.CLOCK_STEPPED


def test_a_step_of_the_receiving_clock_shows_when_it_lasts():
    watch = ClockWatch()
    for k in range(50):
        assert not watch.add(0.01 * k, 0.01 * k + 0.001)
    said = [watch.add(0.01 * k, 0.01 * k + 0.2) for k in range(50, 200)]
    assert [bool(s) for s in said].index(True) == pytest.approx(101, abs=1)


def test_a_sensor_out_of_order_is_no_runaway_but_an_instability_is():
    assert is_growing([1.0, 2.0, 4.0, 8.0])
    assert not is_growing([1.0, 5.0, 7.0, 8.0])
    assert not is_growing([1.0, 1.5, 2.0, 2.5])
    assert not is_growing([2.0, 4.0, 8.0])


def test_an_unstable_process_that_the_relay_cannot_hold_fails():
    # A dead time of 0.75 time constants: no limit cycle exists from ln 2 on.
    tune = experiment(process_gain_sign=1, hysteresis=0.02, measurement_max=1e6)
    run(tune, FopdtPlant(-1.0, -1.0, 0.75), 0.01)
    assert tune.outcome is Outcome.FAILED
    assert "faster and faster" in tune.reason
    assert tune.record().command[-1] == 0.0


@pytest.mark.parametrize("found", [False, True])
def test_cycles_of_a_relay_on_noise_alone_do_not_complete_it(found):
    tune = searching() if found else experiment(process_gain_sign=1)
    rng = np.random.default_rng(3)
    model = TransferFunction.fopdt(1.0, 1.0, 0.5)
    plant, period, command = Plant(model), 0.05, 0.0
    for k in range(200_000):
        # The actuator sticks, once the kick was answered.
        acting = command if tune.switches == 0 else 0.0
        y = plant.advance(period * k, acting) + 0.02 * rng.standard_normal()
        command = tune.step(period * k, y)
        if tune.finished:
            break
    assert tune.outcome is Outcome.FAILED, tune.reason
    assert "noise" in tune.reason or "did not come back" in tune.reason
    assert tune.cycle_count <= 1


def test_what_runs_away_is_given_up_long_before_the_patience_is_over():
    model = UNSTABLE_FOPDT.build((1.0, 1.0, 0.2))
    tune = experiment(process_gain_sign=1)
    plant, period, command = Plant(model), 0.02, 0.0
    stuck = None
    for k in range(20_000):
        y = plant.advance(period * k, command if stuck is None else stuck)
        command = tune.step(period * k, y)
        if tune.cycle_count == 2 and stuck is None:
            stuck = command
            # A sensor's spike is no runaway.
            tune.step(period * (k + 0.5), 1e3)
            assert not tune.finished
        if tune.finished:
            break
    assert tune.outcome is Outcome.FAILED
    swing = max(c.peak_max - c.peak_min for c in tune.cycles)
    assert abs(y - tune.settings.setpoint) < 20.0 * swing
    assert "moved away" in tune.reason


def test_exponential_growth_is_told_from_that_of_any_stable_process():
    def gives_up(answer, floor=0.0, samples=4000):
        watch = RunawayWatch(floor)
        return next((t for t in range(samples) if watch.add(t, answer(t))), None)

    for floor in (0.0, 0.01):
        far = gives_up(lambda t: -0.02 * math.exp(t / 8.0), floor)
        # From the fifth step by eight on.
        assert 8.0 * math.log(8.0**4) < far < 8.0 * math.log(8.0**7)
        for power in (1, 2, 8, 20):
            assert gives_up(lambda t, power=power: (t / 100.0) ** power, floor) is None
        # Heat that reaches a sensor through a wall.
        assert gives_up(lambda t: math.exp(-900.0 / (t + 1.0)), floor) is None
        assert gives_up(lambda t: 1e9 if t % 50 == 0 else 0.0, floor) is None


def test_an_unstable_process_is_given_up_before_the_first_cycle():
    # A quarter of the gain that the relay would need.
    tune = experiment(process_gain_sign=1, hysteresis=1.0)
    run(tune, FopdtPlant(-1.0, -1.0, 0.2), 0.02)
    assert tune.outcome is Outcome.FAILED
    assert "faster and faster" in tune.reason
    assert np.abs(tune.record().measurement).max() < 8.0**6


# What is commanded after the end.


def test_a_given_safe_command_follows_an_abort_but_not_a_completed_tune():
    policy = SafePolicy(command=-0.25)
    tune = experiment(policy=policy)
    run(tune, FopdtPlant(1.0, 1.0, 1.0), 0.05)
    assert tune.record().command[-1] == 0.0
    assert tune.step(1e3, 5.0) == 0.0
    tune = experiment(policy=policy)
    tune.step(0.0, 0.0)
    assert tune.abort("enough") == -0.25
    assert tune.step(1.0, 0.0) == -0.25


def test_an_integrating_process_is_held_after_the_end():
    model = structure_named("ipdt").of_fields(gain=0.5, dead_time=1.0)
    for stop in (False, True):
        plant, period = Plant(model), 0.05
        tune = experiment(policy=SafePolicy(hold=True), hysteresis=0.1)
        load, command = 0.1, 0.0
        for k in range(40_000):
            y = plant.advance(period * k, command + load * (k > 800))
            command = tune.step(period * k, y)
            if stop and tune.cycle_count == 2:
                command = tune.abort("enough")
            if tune.finished:
                break
        assert tune.outcome is (Outcome.ABORTED if stop else Outcome.COMPLETED), tune.reason
        setpoint = tune.settings.setpoint
        # It would go on drifting at a constant command; held, it stays near the set-point.
        last = []
        for n in range(k + 1, k + 2001):
            y = plant.advance(period * n, command + load)
            command = tune.step(period * n, y)
            assert tune.settings.low <= command <= tune.settings.high
            last.append(y)
        assert max(abs(v - setpoint) for v in last[-200:]) < 0.3
        assert np.ptp(last[-200:]) < 0.01


# Ended from outside.


def test_a_tune_can_be_concluded_before_its_cycles_agree():
    tune = experiment(until_converged=False, max_cycles=50)
    plant, command = FopdtPlant(1.0, 1.0, 1.0), 0.0
    with pytest.raises(ParameterError, match="before its first half cycle"):
        tune.conclude("K_u is known")
    for k in range(1000):
        command = tune.step(0.05 * k, plant.advance(0.05 * k, command))
        if tune.cycle_count == 8:
            break
    # Long settled, and still at it.
    assert not tune.finished
    assert tune.conclude("K_u is known well enough") == 0.0
    assert tune.outcome is Outcome.COMPLETED
    assert tune.record().reason == "K_u is known well enough"
    assert tune.conclude("again") == 0.0
    assert tune.reason == "K_u is known well enough"


def test_many_lags_that_turn_back_through_the_set_point_do_not_run_away():
    # Without noise the relay switches at the first sample that moved, long before the lags show
    # what was asked of them; their answer then passes zero and grows as t^8.
    process = TransferFunction.lag_n(1.0, 6.0, 8, 0.6)
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0, process_gain_sign=1), 0.0)
    plant, interval = Plant(process), 0.46
    u = 0.0
    for k in range(3000):
        u = tune.step(k * interval, plant.advance(k * interval, u))
        if tune.finished:
            break
    assert tune.outcome is Outcome.COMPLETED, tune.reason
