# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The relay experiment on processes whose answer is known, and on everything that goes wrong."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from fopdt_plant import FopdtPlant, run, wang_limit_cycle
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from relay_autotune.errors import ParameterError, RecordError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import State
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant
from relay_autotune.record.cycles import cycles_of, limit_cycle
from relay_autotune.record.record import Outcome


def experiment(baseline=0.0, **parameters):
    return RelayExperiment(
        ExperimentParameters(**{"amplitude": 1.0, **parameters}), baseline, "an id"
    )


def gaussian(std, seed=1):
    generator = np.random.default_rng(seed)
    return lambda: std * generator.standard_normal()


class Still:
    """A process that does nothing, or drifts, whatever the command."""

    def __init__(self, slope=0.0):
        self.slope = slope

    def advance(self, time, command):
        return self.slope * time


def feed(tune, measurements, period=0.1):
    return [tune.step(k * period, y) for k, y in enumerate(measurements)]


# On known processes.


@pytest.mark.long
@pytest.mark.parametrize("ratio", [0.1, 0.3, 1.0, 4.0])
@pytest.mark.parametrize("gain", [1.7, -0.6])
@pytest.mark.parametrize("sign_given", [False, True])
def test_periods_and_peaks_meet_the_closed_forms(ratio, gain, sign_given):
    tau, period = 2.0, 2.0 * ratio / 400
    eps = 0.1 * abs(gain)
    tune = experiment(
        baseline=20.0, hysteresis=eps, process_gain_sign=int(math.copysign(sign_given, gain))
    )
    run(tune, FopdtPlant(gain, tau, ratio * tau), period, offset=5.0)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.facts.sign == math.copysign(1, gain)
    cycle = limit_cycle(tune.record())
    high, low, up, down = wang_limit_cycle(abs(gain), tau, ratio * tau, 1.0, 0.3, eps)
    # Each switch is late by up to one sample, which also adds to each peak.
    late = abs(gain) * 1.3 * period / tau
    assert cycle.period_high == pytest.approx(high, abs=2.1 * period)
    assert cycle.period_low == pytest.approx(low, abs=2.1 * period)
    highest, lowest = (up, down) if gain > 0 else (-down, -up)
    assert cycle.peak_max - 5.0 == pytest.approx(highest, abs=2.1 * late)
    assert cycle.peak_min - 5.0 == pytest.approx(lowest, abs=2.1 * late)
    assert cycle.time_to_peak_max == pytest.approx(ratio * tau, abs=1.1 * period)
    assert cycle.time_to_peak_min == pytest.approx(ratio * tau, abs=1.1 * period)


@pytest.mark.parametrize("gain", [1.0, -1.0])
def test_periods_converge_to_the_closed_forms_with_the_sample_period(gain):
    errors = []
    for period in (0.04, 0.02, 0.01, 0.005):
        tune = experiment(hysteresis=0.1, min_cycles=4)
        run(tune, FopdtPlant(gain, 2.0, 2.0), period)
        cycle = limit_cycle(tune.record())
        truth = wang_limit_cycle(1.0, 2.0, 2.0, 1.0, 0.3, 0.1)
        errors.append(abs(cycle.period - truth[0] - truth[1]) / period)
    assert max(errors) < 2.1


def test_the_dead_time_is_seen_to_a_sample():
    tune = experiment()
    run(tune, FopdtPlant(2.0, 5.0, 0.735), 0.01)
    assert 0.0 < tune.facts.response_time - 0.735 <= 0.01


def test_the_command_takes_the_levels_of_the_relay_only():
    tune = experiment(baseline=40.0, amplitude=5.0, bias_ratio=0.2)
    run(tune, FopdtPlant(1.0, 1.0, 1.0), 0.05, offset=300.0)
    record = tune.record()
    assert set(record.command) == {36.0, 40.0, 46.0}
    assert record.settings.high == 46.0
    assert record.settings.low == 36.0
    assert record.command[-1] == 40.0


def test_a_bias_given_replaces_the_ratio():
    tune = experiment(amplitude=2.0, bias=-0.5)
    run(tune, FopdtPlant(1.0, 1.0, 1.0), 0.05)
    assert (tune.settings.high, tune.settings.low) == (1.5, -2.5)
    assert tune.outcome is Outcome.COMPLETED


def test_an_unbiased_relay_gives_equal_half_periods():
    tune = experiment(bias_ratio=0.0, hysteresis=0.1)
    run(tune, FopdtPlant(1.0, 2.0, 2.0), 0.005)
    cycle = limit_cycle(tune.record())
    assert cycle.period_high == pytest.approx(cycle.period_low, abs=0.011)


def test_the_relay_switches_as_its_settings_say():
    for gain in (1.0, -1.0):
        tune = experiment(hysteresis=0.2, setpoint=3.1)
        run(tune, FopdtPlant(gain, 1.0, 0.5), 0.01, offset=3.0, noise=gaussian(0.01))
        record = tune.record()
        relay = record.settings
        upper, lower = relay.setpoint + relay.hysteresis, relay.setpoint - relay.hysteresis
        for_fall, for_rise = (relay.high, relay.low) if gain < 0 else (relay.low, relay.high)
        first = record.cycle_start[0]
        for k in range(first, len(record) - 1):
            if record.measurement[k] >= upper:
                assert record.command[k] == for_fall
            elif record.measurement[k] <= lower:
                assert record.command[k] == for_rise
            else:
                assert record.command[k] == record.command[k - 1]


def test_a_measurement_on_the_edge_of_the_band_switches():
    tune = experiment(process_gain_sign=1, hysteresis=0.5, settle_time=0.5)
    assert feed(tune, [0.0] * 6)[-1] == tune.settings.high
    times = itertools.count(6)
    assert tune.step(0.1 * next(times), 0.25) == tune.settings.high
    assert tune.step(0.1 * next(times), 0.5) == tune.settings.low
    assert tune.step(0.1 * next(times), 0.0) == tune.settings.low
    assert tune.step(0.1 * next(times), -0.5) == tune.settings.high


def test_a_quantised_measurement_on_the_set_point_does_not_switch():
    tune = experiment(process_gain_sign=1)
    feed(tune, [2.0] * 20)
    assert tune.settings.hysteresis == 0.0
    answers = [tune.step(2.0 + 0.1 * k, y) for k, y in enumerate([2, 3, 2, 2, 1, 2, 2, 3])]
    high, low = tune.settings.high, tune.settings.low
    assert answers == [high, low, low, low, high, high, high, low]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("ratio", [0.1, 0.5, 5.0])
@pytest.mark.parametrize("level", [0.1, 0.2])
def test_noise(ratio, level, seed):
    # Noise-to-signal ratio: mean |noise| over mean |signal|, the signal without noise.
    clean = experiment()
    plant = FopdtPlant(1.0, 1.0, ratio)
    run(clean, plant, ratio / 60)
    steady = clean.record().measurement[clean.cycle_start[0] :]
    std = level * float(np.mean(np.abs(steady))) * math.sqrt(math.pi / 2)
    tune = experiment()
    run(tune, FopdtPlant(1.0, 1.0, ratio), ratio / 60, noise=gaussian(std, seed))
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.facts.sign == 1
    assert tune.cycles[-1].converged
    assert tune.noise_std == pytest.approx(std, rel=0.4)
    assert tune.settings.hysteresis == 3.0 * tune.noise_std
    high, low, _, _ = wang_limit_cycle(1.0, 1.0, ratio, 1.0, 0.3, tune.settings.hysteresis)
    # Noise makes each switch early, by up to what the measurement needs for 3 sigma.
    assert 0.7 * (high + low) < limit_cycle(tune.record()).period < 1.1 * (high + low)


@pytest.mark.nightly
def test_dense_noisy_samples_make_no_false_cycles():
    # Dense samples: noise reaches across the band many times while the measurement passes it.
    tune = experiment(process_gain_sign=1)
    run(tune, FopdtPlant(1.0, 1.0, 0.5), 2e-5, noise=gaussian(0.05), samples=400_000)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    switches = np.count_nonzero(np.diff(tune.record().command))
    assert switches > 2 * len(tune.cycles) + 4
    ideal = sum(wang_limit_cycle(1.0, 1.0, 0.5, 1.0, 0.3, 0.0)[:2])
    assert all(0.8 * ideal < c.period < 1.3 * ideal for c in tune.cycles)


@pytest.mark.long
@pytest.mark.parametrize("gain", [1.0, -2.0])
@pytest.mark.parametrize("sign_given", [False, True])
@pytest.mark.parametrize(
    "model",
    [
        pytest.param(lambda k: TransferFunction(k, (), (), 1, 0.5), id="integrator"),
        pytest.param(lambda k: TransferFunction(k, (), (3.0,), 1, 0.5), id="integrator-lag"),
        pytest.param(
            lambda k: TransferFunction(0.547 * k, (-0.418,), (1.06,), 1, 0.1),
            id="integrator-inverse",
        ),
        pytest.param(
            lambda k: TransferFunction(k, (-1.0,), (1.0,) * 5, 0, 1.0), id="inverse-fifth-order"
        ),
        pytest.param(lambda k: TransferFunction(k, (-1.0,), (1.0,) * 3), id="inverse-no-delay"),
        pytest.param(lambda k: TransferFunction(k, (), (1.0,) * 8), id="eighth-order"),
        pytest.param(
            lambda k: TransferFunction(k, (), (0.5 + 1.5j, 0.5 - 1.5j), 0, 1.0), id="underdamped"
        ),
    ],
)
def test_other_processes_oscillate_and_their_sign_is_found(model, gain, sign_given):
    tune = experiment(process_gain_sign=int(math.copysign(sign_given, gain)))
    run(tune, Plant(model(gain)), 0.05, samples=20_000)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.facts.sign == math.copysign(1, gain)
    assert tune.cycles[-1].converged


def test_what_the_wrong_sign_drove_away_is_given_time_to_come_back():
    """Rounding of one sample looks like a first answer, so that the inverse one counts."""
    rounding = iter([*[0.0] * 21, 7e-17, *[0.0] * 30_000])
    tune = experiment()
    model = TransferFunction(0.547, (-0.418,), (1.06,), 1, 0.1 + 1e-12)
    run(tune, Plant(model), 0.05, noise=lambda: next(rounding), samples=20_000)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.facts.sign == 1
    assert max(tune.record().measurement) > 5.0


def test_an_unstable_process_oscillates_if_its_sign_is_given():
    tune = experiment(process_gain_sign=1)
    run(tune, FopdtPlant(-1.0, -1.0, 0.3), 0.005)
    assert tune.outcome is Outcome.COMPLETED, tune.reason


@pytest.mark.parametrize("period", [0.5, 1.0])
def test_few_samples_for_each_half_period(period):
    tune = experiment()
    run(tune, FopdtPlant(1.0, 1.0, 1.0), period)
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.cycles[-1].converged


def test_a_set_point_away_from_the_rest_is_reached():
    for setpoint in (0.4, -0.3):
        for sign in (0, 1):
            tune = experiment(setpoint=setpoint, process_gain_sign=sign)
            run(tune, FopdtPlant(1.0, 20.0, 0.5), 0.02)
            assert tune.outcome is Outcome.COMPLETED, tune.reason
            assert limit_cycle(tune.record()).mean_measurement == pytest.approx(setpoint, abs=0.02)


def test_it_ends_at_max_cycles_if_the_cycles_do_not_agree():
    class Wandering(FopdtPlant):
        def advance(self, time, command):
            return super().advance(time, command) + 0.25 * math.sin(0.05 * time**1.3)

    tune = experiment(max_cycles=4, settle_time=1.0)
    run(tune, Wandering(1.0, 1.0, 1.0), 0.01)
    assert tune.outcome is Outcome.COMPLETED
    assert len(tune.cycles) == 4
    assert not any(c.converged for c in tune.cycles)
    assert "max_cycles" in tune.reason


def test_min_cycles_must_agree():
    tune = experiment(min_cycles=6)
    run(tune, FopdtPlant(1.0, 1.0, 1.0), 0.01)
    assert len(tune.cycles) == 6
    assert [c.converged for c in tune.cycles] == [False] * 5 + [True]


def test_steps_and_times_of_any_origin_give_the_same_cycles():
    runs = []
    for origin in (0.0, 1024.0):
        tune, plant, command = experiment(), FopdtPlant(1.0, 1.0, 1.0), 0.0
        for k in range(5000):
            command = tune.step(origin + k / 64, plant.advance(k / 64, command))
        runs.append(tune)
    assert runs[0].cycles == runs[1].cycles
    assert runs[1].record().time[0] == 0.0


def test_live_cycles_and_those_of_the_record_are_equal_bit_for_bit():
    tune = experiment()
    run(tune, FopdtPlant(1.0, 1.0, 0.7), 0.01, noise=gaussian(0.03))
    record = tune.record()
    assert len(tune.cycles) >= 3
    assert cycles_of(record) == tune.cycles
    assert len(record.cycle_start) == len(tune.cycles) + 1
    for start in record.cycle_start[:-1]:
        assert record.command[start] == record.settings.high
        assert record.command[start - 1] == record.settings.low


def test_the_time_that_is_left_runs_down_within_a_cycle():
    """It stood still until the end of each cycle."""
    tune, plant, command = experiment(), FopdtPlant(1.0, 1.0, 1.0), 0.0
    k, ends = 0, {}
    while not tune.finished:
        command = tune.step(0.02 * k, plant.advance(0.02 * k, command))
        ends.setdefault(tune.cycle_count, []).append(0.02 * k + tune.remaining)
        k += 1
    assert tune.remaining == 0.0
    assert np.isnan(ends.pop(0)).all()
    # The end that is expected stays, until the next cycle tells more.
    assert len(ends) > 2 and all(np.ptp(told) < 1e-9 for told in list(ends.values())[:-1])


def test_progress_grows_from_0_to_1():
    tune, plant, command, progress = experiment(), FopdtPlant(1.0, 1.0, 1.0), 0.0, []
    k = 0
    while not tune.finished:
        command = tune.step(0.02 * k, plant.advance(0.02 * k, command))
        progress.append(tune.progress)
        k += 1
    assert progress[0] == 0.0
    assert progress[-1] == 1.0
    assert all(a <= b for a, b in itertools.pairwise(progress))


def test_states_come_in_order():
    tune, plant, command, states = experiment(), FopdtPlant(1.0, 1.0, 1.0), 0.0, []
    for k in range(5000):
        command = tune.step(0.02 * k, plant.advance(0.02 * k, command))
        if not states or states[-1] is not tune.state:
            states.append(tune.state)
    assert states == [State.SETTLING, State.KICK, State.PROBE, State.RELAY, State.COMPLETED]


# Settling.


def test_it_waits_for_a_transient_to_end():
    tune, plant, command = experiment(), FopdtPlant(1.0, 2.0, 0.5), 0.0
    plant.output = 3.0
    noise = gaussian(0.01)
    k = 0
    while tune.state is State.SETTLING:
        command = tune.step(0.05 * k, plant.advance(0.05 * k, command) + noise())
        k += 1
    assert tune.facts.rest.mean == pytest.approx(0.0, abs=0.02)
    assert tune.noise_std == pytest.approx(0.01, rel=0.4)


def test_settle_time_is_kept_and_drift_is_told():
    tune = experiment(settle_time=2.0)
    answers = feed(tune, [0.1 * k for k in range(30)])
    assert answers[:20] == [0.0] * 20
    assert answers[20] == tune.settings.high
    tune.abort("enough")
    assert "not steady after settle_time" in tune.reason
    assert "slope 1 y/s" in tune.reason


def test_a_drifting_measurement_fails_with_its_slope():
    tune = experiment()
    run(tune, Still(slope=0.01), 1.0, noise=gaussian(0.1))
    assert tune.outcome is Outcome.FAILED
    assert "not steady" in tune.reason
    assert "slope 0.0099" in tune.reason
    assert set(tune.record().command) == {0.0}


# What goes wrong.


@pytest.mark.parametrize("std", [0.0, 0.1])
def test_a_constant_measurement_ends_with_a_sentence(std):
    tune = experiment(baseline=7.0)
    run(tune, Still(), 0.1, noise=gaussian(std), offset=3.0)
    assert tune.outcome is Outcome.FAILED
    assert "no response to the kick" in tune.reason
    assert "larger amplitude" in tune.reason
    assert tune.elapsed < 700.0


def test_max_duration_says_where_it_was():
    tune = experiment(max_duration=5.0)
    run(tune, Still(), 0.1, offset=3.0)
    assert tune.outcome is Outcome.FAILED
    assert tune.elapsed == pytest.approx(5.1)
    assert "max_duration 5 s" in tune.reason
    assert "to leave its rest 3" in tune.reason


def test_a_hysteresis_that_cannot_be_reached_fails():
    tune = experiment(hysteresis=0.9, process_gain_sign=1)
    run(tune, FopdtPlant(1.0, 1.0, 0.5), 0.05)
    assert tune.outcome is Outcome.FAILED
    assert "no oscillation" in tune.reason


def test_a_wrong_sign_fails():
    tune = experiment(process_gain_sign=-1)
    run(tune, FopdtPlant(1.0, 1.0, 0.5), 0.05)
    assert tune.outcome is Outcome.FAILED
    assert "it moved away, against the relay's push: process_gain_sign may be wrong" in tune.reason


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("when", [0, 5, 60, 300])
def test_a_measurement_that_is_no_number_ends_it(bad, when):
    tune, plant, command = experiment(baseline=2.0), FopdtPlant(1.0, 1.0, 1.0), 2.0
    for k in range(when):
        command = tune.step(0.02 * k, plant.advance(0.02 * k, command - 2.0))
    assert tune.step(0.02 * when, bad) == 2.0
    assert tune.outcome is Outcome.FAILED
    assert f"after {when} samples is" in tune.reason
    assert tune.sample_count == when
    if when == 0:
        with pytest.raises(RecordError, match="at least one sample"):
            tune.record()
    else:
        assert len(tune.record()) == when


def test_time_going_backwards_ends_it():
    tune = experiment()
    feed(tune, [1.0] * 5)
    assert tune.step(0.2, 1.0) == 0.0
    assert tune.outcome is Outcome.FAILED
    assert "time went backwards" in tune.reason
    assert len(tune.record()) == 5


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_time_that_is_no_number_ends_it(bad):
    tune = experiment()
    assert tune.step(bad, 1.0) == 0.0
    assert tune.outcome is Outcome.FAILED


def test_equal_times_are_allowed_but_a_clock_that_stands_still_is_not():
    tune = experiment()
    run(tune, FopdtPlant(1.0, 1.0, 1.0), 0.0)
    assert tune.outcome is Outcome.FAILED
    assert "the same time" in tune.reason
    doubled, plant, command = experiment(), FopdtPlant(1.0, 1.0, 1.0), 0.0
    for k in range(4000):
        t = 0.02 * (k // 2)
        command = doubled.step(t, plant.advance(t, command))
    assert doubled.outcome is Outcome.COMPLETED, doubled.reason


def test_a_measurement_outside_its_limits_aborts_at_once():
    tune = experiment(measurement_max=0.5)
    run(tune, FopdtPlant(1.0, 1.0, 1.0), 0.02)
    assert tune.outcome is Outcome.ABORTED
    assert "outside its limits, -inf to 0.5" in tune.reason
    record = tune.record()
    assert record.measurement[-1] > 0.5
    assert record.command[-1] == 0.0
    assert all(record.measurement[:-1] <= 0.5)


def test_a_long_gap_marks_its_cycle_and_is_told():
    tune, plant, command, t = experiment(min_cycles=5), FopdtPlant(1.0, 1.0, 1.0), 0.0, 0.0
    while not tune.finished:
        command = tune.step(t, plant.advance(t, command))
        t += 0.01
        if len(tune.cycles) == 1 and 0.2 < t - tune.cycles[0].start - tune.cycles[0].period < 0.3:
            t += 0.3
    assert tune.outcome is Outcome.COMPLETED
    assert [c.disturbed for c in tune.cycles][:3] == [False, True, False]
    assert f"1 of {len(tune.cycles)} cycles disturbed: a long gap" in tune.reason


def test_abort_keeps_everything_and_holds_the_baseline():
    tune = experiment(baseline=4.0)
    run(tune, FopdtPlant(1.0, 1.0, 1.0), 0.02, samples=400)
    assert tune.abort("the user asked for it") == 4.0
    assert tune.outcome is Outcome.ABORTED
    assert tune.reason.startswith("the user asked for it (at 7.98 s, after")
    assert tune.step(100.0, 0.0) == 4.0
    assert tune.abort("again") == 4.0
    record = tune.record()
    assert len(record) == 400
    assert record.reason == tune.reason
    assert record.experiment_id == "an id"


def test_stamps_of_samples_after_the_end_are_left_out():
    tune = experiment()
    feed(tune, [1.0] * 10)
    tune.abort("enough")
    stamps = np.arange(12.0)
    record = tune.record(
        receive_time=stamps + 0.1, command_time=stamps + 0.2, start=1e9, lost_samples=3
    )
    assert record.receive_time[-1] == 9.1
    assert record.command_time[-1] == 9.2
    assert (record.start, record.lost_samples) == (1e9, 3)


def test_parameters_are_checked_against_the_baseline():
    with pytest.raises(ParameterError, match=r"the high level of the relay is 10\.3"):
        experiment(baseline=9.0, command_max=10.0)


# Whatever happens.


@pytest.mark.long
@settings(max_examples=60)
@given(
    gain=st.floats(0.1, 10.0),
    negative=st.booleans(),
    ratio=st.floats(0.05, 5.0),
    samples_per_dead_time=st.floats(0.7, 60.0),
    noise=st.sampled_from([0.0, 0.01, 0.05, 0.15]),
    bias_ratio=st.floats(-0.6, 0.6),
    sign_given=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_any_fopdt_process_completes(
    gain, negative, ratio, samples_per_dead_time, noise, bias_ratio, sign_given, seed
):
    gain = -gain if negative else gain
    swing = abs(gain) * (1.0 - math.exp(-ratio))
    # There is a limit cycle only if both levels lead out of the band, noise not counted.
    assume(3.0 * noise * swing < 0.7 * abs(gain) * (1.0 - abs(bias_ratio)))
    tune = experiment(
        baseline=1.0,
        bias_ratio=bias_ratio,
        process_gain_sign=int(math.copysign(sign_given, gain)),
    )
    count = run(
        tune,
        FopdtPlant(gain, 1.0, ratio),
        ratio / samples_per_dead_time,
        noise=gaussian(noise * swing, seed) if noise else None,
        offset=-3.0,
        samples=60_000,
    )
    assert tune.outcome is Outcome.COMPLETED, tune.reason
    assert tune.facts.sign == math.copysign(1, gain)
    record = tune.record()
    assert len(record) == count
    assert set(record.command) <= {1.0, record.settings.high, record.settings.low}
    assert record.outcome is Outcome.COMPLETED
    assert cycles_of(record) == tune.cycles


@pytest.mark.long
@settings(max_examples=30)
@given(
    values=st.lists(
        st.one_of(
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(-1.0, 1.0),
            st.sampled_from([0.0, 1.0]),
        ),
        max_size=300,
    ),
    steps=st.lists(st.sampled_from([0.0, 0.1, 0.1, 0.1, 5.0, 1e-9, 1e6]), min_size=300),
    abort_at=st.integers(0, 400),
    settle_time=st.sampled_from([0.0, 0.5]),
    sign=st.sampled_from([-1, 0, 1]),
)
def test_no_data_raise_and_every_sample_is_kept(values, steps, abort_at, settle_time, sign):
    tune = experiment(baseline=2.0, settle_time=settle_time, process_gain_sign=sign)
    t, answers = 0.0, []
    for k, value in enumerate(values):
        t += steps[k]
        if k == abort_at:
            tune.abort("now")
        finished = tune.finished
        answers.append(tune.step(t, value))
        if finished or tune.finished:
            assert answers[-1] == 2.0
    kept = tune.sample_count
    assert set(answers) <= {2.0, 2.0 + 0.3 - 1.0, 2.0 + 0.3 + 1.0}
    assert bool(tune.reason) == tune.finished
    if kept:
        record = tune.record()
        assert list(record.measurement) == values[:kept]
        assert list(record.command) == answers[:kept]
        assert cycles_of(record) == tune.cycles
    if not tune.finished:
        assert kept == len(values)
