# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The waveform fit: exact without noise, honest with it."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest
from fopdt_plant import FopdtPlant
from hypothesis import given, settings
from hypothesis import strategies as st
from made_experiments import record_of
from relay_runs import RelayRun, simulate_relay
from sampled_relay import simulate_sampled_relay

from relay_autotune.analysis import analyse
from relay_autotune.errors import IdentificationError, ParameterError
from relay_autotune.identification.known import Known
from relay_autotune.identification.waveform.choice import NoResponseError, chosen_fit
from relay_autotune.identification.waveform.method import identify_waveform
from relay_autotune.identification.waveform.problem import problem_of
from relay_autotune.identification.waveform.residuals import ljung_box
from relay_autotune.identification.waveform.separable import TRIAL, evaluate, refine
from relay_autotune.identification.waveform.starts import multistart, start_fopdt, time_scales
from relay_autotune.process.response import response
from relay_autotune.process.structures import TABLE, structure_named
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.moves import (
    answers_soon,
    begins_at_rest,
    first_response,
    is_controlled,
)
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings
from relay_autotune.verdict import Verdict

pytestmark = pytest.mark.long

FOPDT = Known(structure="fopdt")


def _run(gain: float, tau: float, dead: float, bias: float = 0.0, samples: int = 1000) -> RelayRun:
    model = TransferFunction.fopdt(gain, tau, dead)
    relay = RelaySettings(5.0, 40.0, 1.0, bias, 0.0, reverse_acting=gain < 0.0)
    return simulate_relay(model, relay, cycles=5, time=samples)


@settings(deadline=None, max_examples=8)
@given(
    gain=st.floats(0.1, 10.0) | st.floats(-10.0, -0.1),
    tau=st.floats(0.1, 100.0),
    ratio=st.floats(0.05, 8.0),
    bias=st.floats(-0.3, 0.3),
)
def test_noise_free_parameters_are_exact(gain, tau, ratio, bias):
    found = identify_waveform(_run(gain, tau, ratio * tau, bias).record(), FOPDT)
    assert found.values == pytest.approx([gain, tau, ratio * tau], rel=1e-9)
    truth = ultimate_point(TransferFunction.fopdt(gain, tau, ratio * tau))
    assert found.ultimate_gain == pytest.approx(truth.gain, rel=1e-9)
    assert found.ultimate_frequency == pytest.approx(truth.frequency, rel=1e-9)
    assert found.warnings == ()


def _noisy(run: RelayRun, ratio: float, seed: int) -> Record:
    signal = float(np.mean(np.abs(run.measurement - 5.0)))
    std = ratio * signal * math.sqrt(math.pi / 2.0)
    return run.record(noise_std=std, rng=np.random.default_rng(seed))


def _bound(run: RelayRun, process: tuple[float, float, float], std: float) -> tuple[float, float]:
    """Cramer-Rao bound of K_u and w_u, relative, from differences of the exact response."""

    def output(p: np.ndarray) -> np.ndarray:
        return response(TransferFunction.fopdt(*p), run.time, run.command)

    def ultimate(p: np.ndarray) -> np.ndarray:
        point = ultimate_point(TransferFunction.fopdt(*p))
        return np.log([point.gain, point.frequency])

    p = np.array(process)
    steps = np.diag(1e-5 * p)
    by_output = [(output(p + s) - output(p - s)) / (2 * s.max()) for s in steps]
    by_ultimate = np.array([(ultimate(p + s) - ultimate(p - s)) / (2 * s.max()) for s in steps])
    jacobian = np.stack([*by_output, np.ones(run.time.size)])
    covariance = np.linalg.inv(jacobian @ jacobian.T)[:3, :3] * std**2
    variances = np.diag(by_ultimate.T @ covariance @ by_ultimate)
    return float(np.sqrt(variances[0])), float(np.sqrt(variances[1]))


PROCESSES = [(1.65, 20.0, 10.0), (1.0, 2.0, 2.0), (1.0, 1.0, 0.1), (1.0, 1.0, 10.0)]


@pytest.mark.nightly
@pytest.mark.parametrize("process", PROCESSES)
def test_errors_of_the_ultimate_point_meet_the_cramer_rao_bound(process):
    run, truth = _run(*process), ultimate_point(TransferFunction.fopdt(*process))
    records = [_noisy(run, 0.1, seed) for seed in range(40)]
    bounds = _bound(run, process, records[0].noise_std)
    found = [identify_waveform(r, FOPDT) for r in records]
    gain = [f.ultimate_gain / truth.gain - 1.0 for f in found]
    frequency = [f.ultimate_frequency / truth.frequency - 1.0 for f in found]
    for errors, bound in zip((gain, frequency), bounds, strict=True):
        # The rms of 40 draws scatters by 11 %.
        assert 0.75 < math.sqrt(float(np.mean(np.square(errors)))) / bound < 1.3
    stated = float(np.mean([f.ultimate_gain_std for f in found])) / truth.gain
    assert stated == pytest.approx(bounds[0], rel=0.1)


@pytest.mark.nightly
def test_the_intervals_cover_the_truth():
    process = (1.65, 20.0, 10.0)
    run, truth = _run(*process), ultimate_point(TransferFunction.fopdt(*process))
    found = [identify_waveform(_noisy(run, 0.1, seed), FOPDT) for seed in range(200)]
    inside = [
        np.mean([f.ci95_low[k] <= value <= f.ci95_high[k] for f in found])
        for k, value in enumerate(process)
    ]
    for name, value in (("gain", truth.gain), ("frequency", truth.frequency)):
        pulls = [
            abs(getattr(f, f"ultimate_{name}") - value) / getattr(f, f"ultimate_{name}_std")
            for f in found
        ]
        inside.append(np.mean(np.array(pulls) < 1.96))
    # 200 draws of 95 %: five standard errors are 7.7 %.
    assert min(inside) > 0.873


def test_a_relay_that_sees_the_noise_at_its_samples():
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    relay = RelaySettings(5.0, 40.0, 1.0, 0.3, 0.3)
    noise = 0.08 * np.random.default_rng(5).standard_normal(1600)
    record = simulate_sampled_relay(model, relay, period=0.2, noise=noise)
    found = identify_waveform(record, FOPDT)
    assert found.ultimate_gain == pytest.approx(2.3072, rel=0.02)
    assert abs(found.values - [1.65, 20.0, 10.0]).max() < 4.0 * found.std.max()
    assert found.fit.residual_rms == pytest.approx(0.08, rel=0.1)


def _staircase(seed: int = 0) -> tuple[np.ndarray, np.ndarray, Record]:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(2.0, 20.0, 15))
    u = PiecewiseConstant(times, rng.uniform(0.0, 3.0, 15), 1.0)
    # Irregular samples.
    time = np.cumsum(rng.uniform(0.05, 0.7, 500))
    y = 20.0 + response(TransferFunction.fopdt(1.2, 6.0, 2.345), time, u)
    return time, y, Record(time, y, u(time), held_input=u)


@pytest.mark.nightly
def test_any_held_input_and_irregular_samples_will_do():
    _, _, record = _staircase()
    found = identify_waveform(record)
    assert found.values == pytest.approx([1.2, 6.0, 2.345], rel=1e-9)


def test_a_step_test():
    time = np.linspace(0.0, 60.0, 300)
    u = PiecewiseConstant(np.array([5.0]), np.array([2.0]), 0.0)
    y = 20.0 + response(TransferFunction.fopdt(1.2, 6.0, 2.345), time, u)
    found = identify_waveform(Record(time, y, u(time), held_input=u))
    assert found.values == pytest.approx([1.2, 6.0, 2.345], rel=1e-9)


def test_a_drift_is_estimated_and_said():
    time, y, record = _staircase()
    rng = np.random.default_rng(1)
    noisy = y + 0.004 * time + 0.02 * rng.standard_normal(y.size)
    found = identify_waveform(replace(record, measurement=noisy), FOPDT)
    assert found.values == pytest.approx([1.2, 6.0, 2.345], rel=0.02)
    assert any("drift" in w for w in found.warnings)


def test_a_start_away_from_rest_is_estimated():
    time, y, record = _staircase()
    moving = y + 3.0 * np.exp(-(time - time[0]) / 6.0)
    found = identify_waveform(replace(record, measurement=moving), FOPDT)
    assert found.values == pytest.approx([1.2, 6.0, 2.345], rel=1e-6)


# Two phases of the oscillation, of which one shows what the other does.
@pytest.mark.parametrize("start", [pytest.param(600, marks=pytest.mark.nightly), 900])
def test_a_record_cut_out_of_an_oscillation(start):
    record = _run(1.65, 20.0, 10.0, 0.3, 2000).record()
    part = slice(start, 2000)
    inside = record.held_input.times > record.time[start]
    u = PiecewiseConstant(
        record.held_input.times[inside],
        record.held_input.values[inside],
        float(record.command[start]),
    )
    cut = Record(record.time[part], record.measurement[part], record.command[part], held_input=u)
    found = identify_waveform(cut, FOPDT)
    assert found.values == pytest.approx([1.65, 20.0, 10.0], rel=1e-6)


@pytest.mark.nightly
def test_a_second_input_shows_in_the_residual_and_is_said():
    time, y, record = _staircase()
    other = PiecewiseConstant(np.array([40.0, 130.0]), np.array([1.0, 0.0]), 0.0)
    disturbed = y + response(TransferFunction.fopdt(0.6, 9.0, 1.0), time, other)
    noise = 0.01 * np.random.default_rng(2).standard_normal(y.size)
    disturbed = replace(record, measurement=disturbed + noise, noise_std=0.01)
    found = identify_waveform(disturbed, FOPDT)
    assert any("is correlated" in w for w in found.warnings)
    assert any("larger than the noise" in w for w in found.warnings)
    assert found.fit.whiteness_p < 1e-3


def test_a_gain_that_the_data_do_not_tell_is_named():
    found = identify_waveform(_noisy(_run(1.0, 1.0, 0.02), 0.2, 3), FOPDT)
    assert "gain" in found.undetermined
    assert "time_constant" in found.undetermined
    assert abs(found.ultimate_gain_std / found.ultimate_gain) < 0.05


@pytest.mark.nightly
def test_whether_a_slow_process_integrates_is_said_to_be_open():
    found = identify_waveform(_noisy(_run(1.0, 1.0, 0.02), 0.2, 3))
    assert found.structure == "ipdt"
    assert any("whether the process integrates" in w for w in found.warnings)
    assert found.ultimate_gain == pytest.approx(
        ultimate_point(TransferFunction.fopdt(1.0, 1.0, 0.02)).gain, rel=0.03
    )


@pytest.mark.parametrize(
    ("measurement", "command", "said"),
    [
        (np.arange(100.0), np.zeros(100), "command never changes"),
        (np.full(100, 7.0), np.arange(100) // 50 * 1.0, "constant at 7"),
        (np.arange(100) // 20 % 2 * 5.0, np.sin(np.arange(100)), "the wrong way round"),
        (np.arange(8.0), np.arange(8) // 4 * 1.0, "holds 8 samples; a fit"),
        (np.zeros(1), np.zeros(1), "holds 1 sample; a fit"),
    ],
)
def test_data_that_tell_nothing_are_refused_with_the_reason(measurement, command, said):
    time = np.arange(measurement.size, dtype=float)
    with pytest.raises(IdentificationError, match=said):
        identify_waveform(Record(time, measurement, command))


@pytest.mark.parametrize("exchanged", [False, True])
def test_exchanged_columns_of_a_test_by_steps_are_named(exchanged):
    time = np.arange(400.0)
    command = np.array([0.0, 20.0, 50.0, 10.0])[np.arange(400) // 100]
    plant = FopdtPlant(1.65, 20.0, 10.0)
    measurement = np.array([0.0, *map(plant.advance, time[1:], command[:-1])])
    columns = (command, measurement) if exchanged else (measurement, command)
    try:
        told = "; ".join(identify_waveform(Record(time, *columns), FOPDT).warnings)
    except IdentificationError as error:
        told = str(error)
    assert ("moves in 3 of 400 samples and the command in " in told) == exchanged
    assert ("the wrong way round" in told) == exchanged


@pytest.mark.parametrize("seed", [8, 0, 2, 11])
def test_noise_shows_no_response_whichever_fits_to_it_run_off(seed):
    """With 0 that turns on the last digit, in 2 and 8 all do, and 11 has none to begin with."""
    noise = np.random.default_rng(seed).standard_normal(100)
    record = Record(np.arange(100.0), noise, np.arange(100) // 50 * 1.0)
    for known in (Known(), FOPDT):
        with pytest.raises(IdentificationError, match="no response"):
            identify_waveform(record, known)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_a_response_within_one_sample_is_named(seed):
    """Candidates that show dynamics explain nothing of it."""
    rng, time = np.random.default_rng(seed), np.arange(400.0)
    command = np.repeat(rng.choice([0.0, 1.0, 2.0], 20), 20)
    with pytest.raises(IdentificationError, match=r"within one sample, 1\.0 s"):
        identify_waveform(Record(time, 3.0 * command + rng.normal(0.0, 0.05, 400), command))


def test_a_response_between_samples_that_are_left_out_is_not_within_one():
    time = np.arange(8000.0)
    u = PiecewiseConstant(np.array([1000.0, 3000.0, 6000.0]), np.array([1.0, -1.0, 0.5]), 0.0)
    y = response(TransferFunction.fopdt(1.0, 0.8, 0.5), time, u)
    few = problem_of([(time, y, u)], TABLE["fopdt"]).thinned(500)
    with contextlib.suppress(NoResponseError):
        chosen_fit(few, Known(), 0, 1.0, held=False)


def test_an_unknown_structure_is_refused():
    with pytest.raises(ParameterError, match="structure is 'ladder', expected one of fopdt"):
        identify_waveform(_staircase()[2], Known(structure="ladder"))


def test_ljung_box_is_uniform_for_white_noise_and_small_for_coloured():
    rng = np.random.default_rng(11)
    p = [ljung_box(rng.standard_normal(400)) for _ in range(300)]
    assert 0.4 < np.mean(p) < 0.6
    assert np.mean(np.array(p) < 0.05) < 0.1
    coloured = np.convolve(rng.standard_normal(500), [1.0, 0.8, 0.5])
    assert ljung_box(coloured) < 1e-6
    assert math.isnan(ljung_box(np.array([1.0, 2.0])))


@pytest.mark.nightly
@pytest.mark.parametrize(("length", "number"), [(3, 20), (1, 9), (2, 20)])
def test_spikes_of_the_sensor_are_left_out_and_told(length, number):
    process = (1.65, 20.0, 10.0)
    record = _noisy(_run(*process), 0.05, 0)
    rng = np.random.default_rng(8)
    spoiled = record.measurement.copy()
    first = rng.choice(np.arange(10, 990, 7), number, replace=False)
    spoiled[first[:, None] + np.arange(length)] += 5.0
    clean, found = (
        identify_waveform(r, FOPDT) for r in (record, replace(record, measurement=spoiled))
    )
    assert any(f"left out: {length * number} samples" in w for w in found.warnings)
    within = {"rel": 1e-3} if number < 10 else {"abs": 2.0 * clean.ultimate_gain_std}
    assert found.ultimate_gain == pytest.approx(clean.ultimate_gain, **within)
    assert int(np.sum(np.isnan(found.fitted))) == length * number


def test_samples_of_a_step_that_the_model_misses_are_no_spikes():
    """Their neighbours lie on both sides of the step, and no line between these on the model."""
    time = np.arange(0.0, 300.0, 1.0)
    u = PiecewiseConstant(np.array([20.0, 120.0, 220.0]), np.array([1.0, 0.0, 1.0]), 0.0)
    y = response(TransferFunction.fopdt(1.0, 0.2, 2.5), time, u)
    late = y + np.random.default_rng(3).normal(0.0, 0.01, time.size)
    # The last step comes a sample late.
    late[201:] = late[200:-1].copy()
    found = identify_waveform(Record(time, late, u(time), held_input=u), FOPDT)
    assert not any("spikes" in w for w in found.warnings)


@pytest.mark.parametrize("seed", range(8))
def test_clean_records_have_no_outliers(seed):
    found = identify_waveform(_noisy(_run(1.65, 20.0, 10.0), 0.1, seed), FOPDT)
    assert not any("left out" in w for w in found.warnings)


def test_a_step_of_a_coarse_sensor_is_no_spike():
    """At rest nearly all samples are equal, so that the others look far off."""
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 900.0, 0.5)
    u = PiecewiseConstant(np.array([300.0, 600.0]), np.array([1.0, 0.0]), 0.0)
    y = 40.0 + response(TransferFunction.sopdt(23.0, (60.0, 10.0), 6.0), time, u)
    y = np.round((y + rng.normal(0.0, 0.08, time.size)) / 0.25) * 0.25
    found = identify_waveform(Record(time, y, u(time), held_input=u), Known(structure="sopdt"))
    assert not any("spikes" in w for w in found.warnings)


def test_a_record_that_begins_in_a_movement_and_ends_as_its_command_does():
    # What is left once the movement is over holds no change of the command that a sample follows,
    # so that the model is that of the whole record.
    time = np.arange(400) * 0.1
    command = np.where(time >= 0.5, 1.0, 0.0)
    command[-1] = 0.0
    step = PiecewiseConstant(np.array([0.5]), np.array([1.0]), 0.0)
    measurement = response(TransferFunction.fopdt(2.0, 1.0, 0.2), time, step)
    measurement += 3.0 * np.exp(-time / 0.7)
    measurement += 0.05 * np.random.default_rng(1).standard_normal(400)
    found = identify_waveform(Record(time=time, measurement=measurement, command=command), FOPDT)
    assert len(found.fitted) == 400
    assert found.fit.residual_rms < 0.1


@given(
    dead_time=st.floats(0.0, 60.0),
    tau=st.floats(1.0, 100.0),
    drift=st.floats(-0.02, 0.02),
    seed=st.integers(0, 100),
)
@settings(max_examples=60, deadline=None)
def test_neither_noise_nor_drift_counts_as_a_first_response(dead_time, tau, drift, seed):
    time = np.arange(0.0, 400.0)
    step = PiecewiseConstant(np.array([100.0]), np.ones(1), 0.0)
    y = response(TransferFunction.fopdt(1.0, tau, dead_time), time, step)
    y += drift * time + 0.02 * np.random.default_rng(seed).standard_normal(time.size)
    assert first_response(time, y, step)[1] >= 2.0 * dead_time


def rested_and_moved(process, edges, levels):
    """Return a measurement that falls by 0.2 in 20 s, and answers the command."""
    time = np.arange(0.0, 300.0)
    command = PiecewiseConstant(np.array(edges), np.array(levels), 0.0)
    noise = 0.01 * np.random.default_rng(2).standard_normal(time.size)
    return time, response(process, time, command) - 0.01 * time + noise, command


@pytest.mark.parametrize("gain", [-30.0, 30.0])
def test_a_first_response_that_never_turns_rules_out_the_other_direction(gain):
    process = TransferFunction.fopdt(gain, 30.0, 4.0)
    for edges, levels in (([20.0], [1.0]), ([20.0, 21.0], [1.0, 0.0])):
        below, above = first_response(*rested_and_moved(process, edges, levels))
        ruled_out, latest = (below, above) if gain > 0.0 else (above, below)
        assert ruled_out == -np.inf
        assert 4.0 <= latest < 40.0


def test_an_inverse_response_rules_out_no_direction():
    process = structure_named("sopdt_zero").of_fields(
        gain=30.0, time_constants=[10.0, 8.0], zeros=[-16.0], dead_time=2.0
    )
    below, above = first_response(*rested_and_moved(process, [20.0], [1.0]))
    assert 2.0 <= below < np.inf
    assert above > below


def test_a_rest_of_rows_that_share_one_stamp_tells_no_direction(recwarn):
    time = np.concatenate((np.zeros(20), np.arange(1.0, 50.0)))
    command = PiecewiseConstant(np.array([0.5]), np.ones(1), 0.0)
    y = response(TransferFunction.fopdt(1.0, 5.0, 2.0), time, command)
    assert first_response(time, y, command) == (np.inf, np.inf)
    assert not recwarn.list


def test_where_the_command_crosses_its_rest_a_later_response_tells_nothing():
    process = TransferFunction.fopdt(30.0, 10.0, 4.0)
    time, y, u = rested_and_moved(process, [20.0, 22.0, 30.0], [0.01, -1.0, 0.0])
    assert first_response(time, y, u) == (np.inf, np.inf)


def test_a_process_before_a_staircase_was_at_rest():
    """No relay or controller changes its command in one direction alone."""
    edges, levels = 20.0 + 30.0 * np.arange(8), 0.1 * np.arange(1.0, 9.0)
    process = TransferFunction.fopdt(30.0, 10.0, 4.0)
    assert answers_soon(*rested_and_moved(process, edges, levels))
    assert not answers_soon(*rested_and_moved(process, [], []))


@pytest.mark.parametrize(("dead_time", "at_rest"), [(15.0, True), (2.0, False)])
def test_a_process_that_has_not_answered_yet_was_at_rest(dead_time, at_rest):
    process = TransferFunction.fopdt(30.0, 10.0, dead_time)
    assert begins_at_rest(*rested_and_moved(process, [4.0, 60.0], [1.0, 0.0])) is at_rest


def test_a_free_motion_does_not_stand_for_the_first_response():
    """A heater pulsed for two minutes, which cools down by more modes than any structure has."""
    rng = np.random.default_rng(0)
    time, edges = np.arange(0.0, 4500.0, 3.0), 33.0 + np.cumsum(rng.uniform(6.0, 25.0, 9))
    pulses = PiecewiseConstant(edges, np.tile([1.0, 0.0], 5)[:9] * (edges < edges[-1]), 0.0)
    y = 25.0 + 0.01 * rng.standard_normal(time.size)
    for share, lag in ((0.85, 540.0), (0.15, 150.0)):
        heats = structure_named("sopdt").of_fields(
            gain=100.0 * share, time_constants=[lag, 40.0], dead_time=3.0
        )
        y += response(heats, time, pulses) + 8.0 * share * np.exp(-time / lag)
    assert identify_waveform(Record(time, y, pulses(time))).model.process_sign == 1


def test_a_step_just_before_the_record_is_found_where_no_model_shows_a_response_without_it():
    time = np.linspace(0.0, 1020.0, 1500)
    heater = structure_named("sopdt").of_fields(
        gain=0.6, time_constants=[510.0, 25.5], dead_time=153.0
    )
    y = 20.0 + response(heater, time, PiecewiseConstant(np.array([0.0, 510.0]), [50.0, 0.0], 0.0))
    y += 0.02 * np.random.default_rng(5).standard_normal(time.size)
    model = identify_waveform(Record(time, y, np.where(time < 510.0, 50.0, 0.0))).model
    assert model.gain == pytest.approx(0.6, rel=0.2)
    assert model.dead_time == pytest.approx(153.0, rel=0.2)


def test_a_ramp_by_the_clock_is_no_controller():
    """Only what a controller held may grow."""
    rng = np.random.default_rng(1)
    time = np.arange(400.0)
    ramp = 50.0 - np.abs(time - 200.0) / 4.0 + 0.01 * rng.standard_normal(time.size)
    by_the_clock = PiecewiseConstant.from_samples(time, ramp)
    y = response(TransferFunction.fopdt(1.0, 20.0, 2.0), time, by_the_clock)
    y += 0.5 * rng.standard_normal(time.size)
    by_the_measurement = PiecewiseConstant.from_samples(time, ramp + 0.3 * (40.0 - y))
    assert not is_controlled(time, y, by_the_clock)
    assert is_controlled(time, y, by_the_measurement)


def test_a_command_of_straight_lines_is_no_controller():
    time = np.arange(600.0)
    dense = np.arange(0.0, 600.0, 0.05)
    command, drive = (np.sin(0.03 * t) + np.sin(0.11 * t) for t in (time, dense))
    held = PiecewiseConstant.from_samples(dense, drive)
    y = response(TransferFunction.fopdt(2.0, 20.0, 4.0), time, held)
    y += 0.02 * np.random.default_rng(1).standard_normal(time.size)
    record = Record(time, y, command, continuous_command=True)
    assert not is_controlled(time, y, record.drive())
    assert identify_waveform(record).model.gain == pytest.approx(2.0, rel=0.02)


@pytest.mark.nightly
def test_a_dead_time_that_hides_the_first_response_is_no_explanation():
    """Steps of one length, unequal in their effect, look like each other one step later."""
    time = np.arange(0.0, 4900.0, 4.0)
    edges = 700.0 * np.arange(1.0, 7.0)
    effects = np.cumsum([2.0, 7.0, 0.5, 10.0, 8.0, 2.0])
    felt = PiecewiseConstant(edges, effects, 0.0)
    process = TransferFunction.fopdt(1.0, 40.0, 6.0)
    noise = 0.1 * np.random.default_rng(3).standard_normal(time.size)
    command = PiecewiseConstant(edges, np.arange(1.0, 7.0), 0.0)(time)
    record = Record(time, response(process, time, felt) + noise, command)
    model = identify_waveform(record, FOPDT).model
    assert model.dead_time < 20.0
    assert 20.0 < model.time_constants[0].real < 80.0


def test_a_structure_of_which_no_fit_can_begin_is_left_out():
    """As where commands of 1e-9 u came within 1e-300 s, by a record from the network."""
    record = record_of(TransferFunction.fopdt(2.0, 0.8, 0.4), "", cycles=3)
    told = record.time, record.measurement, record.input()
    # One of those that are fitted whatever others promise.
    problem = problem_of([told], TABLE["fopdt"])
    assert multistart(problem, []) is None


def test_few_samples_do_not_meet_a_periodic_command_at_one_instant_each_time():
    """Each 17th sample, of which the few would be taken, comes half a period after the last."""
    rng = np.random.default_rng(1)
    time = 0.003 * np.arange(4000)
    switches = np.arange(0.0, 12.0, 17 * 0.003)
    u = PiecewiseConstant(switches, np.resize([1.0, -1.0], switches.size), 0.0)
    y = response(TransferFunction.fopdt(1.0, 0.005, 0.0014), time, u)
    y += rng.normal(0.0, 0.02, time.size)
    log_tau, _ = start_fopdt(problem_of([(time, y, u)], TABLE["fopdt"]))[0]
    assert 0.003 < math.exp(log_tau) < 0.008


def test_a_command_that_changes_after_the_last_of_a_few_samples_has_time_scales():
    time = np.arange(0.0, 20.0, 0.1)
    late = problem_of([(time, time, PiecewiseConstant([19.85], [1.0], 0.0))], TABLE["fopdt"])
    assert time_scales(late) == pytest.approx((0.1, 0.05))
    assert time_scales(late.thinned(20)) == pytest.approx((1.0, 19.0))


def test_a_fit_ends_where_lags_far_below_the_period_explain_nothing_more():
    """Its steps promise gains of 1e-150, and rounding of the cost is a gain all the same."""
    rng = np.random.default_rng(4)
    u = PiecewiseConstant(np.arange(0.0, 20.0, 0.004), rng.normal(size=5000), 0.0)
    time = np.arange(0.0015, 20.0, 0.088)
    y = rng.normal(0.0, 0.1, time.size)
    problem = problem_of([(time, y, u)], TABLE["sopdt"])
    for log_tau in np.linspace(-14.5, -12.5, 20):
        for log_damping in (0.0, 0.589):
            start = np.array((log_tau, log_damping, 0.0))
            found = refine(problem, start, tolerance=TRIAL, damping=0.134)
            assert found.cost <= evaluate(problem, start).cost


def test_a_jump_in_the_last_samples_is_left_out():
    time = np.arange(0.0, 300.0, 0.5)
    command = np.array([0.0, 1.0, -1.0, 1.0, 0.0, 1.0])[(time // 50.0).astype(int)]
    process = TransferFunction.fopdt(1.0, 12.0, 3.0)
    u = PiecewiseConstant.from_samples(time, command)
    noise = 0.02 * np.random.default_rng(2).standard_normal(time.size)
    y = response(process, time, u) + noise
    y[time > 292.0] += 4.0
    found = identify_waveform(Record(time, y, command), FOPDT)
    assert found.ultimate_gain == pytest.approx(ultimate_point(process).gain, rel=0.03)
    assert found.fit.residual_rms < 0.03
    assert any(
        "left out: 15 samples beyond a jump that no process makes, the first at 292.5 s" in w
        for w in found.warnings
    )


@pytest.mark.nightly
def test_a_sensor_that_drops_out_is_left_out():
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 435.0, 0.5)
    command = 10.0 * np.array([0, 0, 1, 2, 1, 0, -1, 0])[(time // 55.0).astype(int)]
    process = TransferFunction.sopdt(1.0, (10.0, 4.0), 3.0)
    u = PiecewiseConstant.from_samples(time, command)
    y = 40.0 + response(process, time, u) + rng.normal(0.0, 0.1, time.size)
    known = Known(structure="sopdt")
    clean = identify_waveform(Record(time, y, command), known)
    for dropped in ([(0, 12)], [(500, 540)], [(90, 93), (400, 411), (690, 700)]):
        away = np.concatenate([np.arange(*each) for each in dropped])
        seen = y.copy()
        seen[away] = 0.0
        found = identify_waveform(Record(time, seen, command), known)
        assert found.ultimate_gain == pytest.approx(clean.ultimate_gain, rel=0.005)
        assert any(f"left out: {away.size} samples beyond a jump" in w for w in found.warnings)


@pytest.mark.nightly
def test_a_first_row_of_nothing_is_left_out():
    """A past and a free state that cancel each other by millions of ranges had explained it."""
    rng, n = np.random.default_rng(1), 420
    time = 2.0 * np.arange(n)
    u = PiecewiseConstant(
        np.array([40.0, 300.0, 480.0, 600.0, 720.0]), np.array([50.0, 20, 70, 0, 40]), 0.0
    )
    noise = 0.4 * rng.standard_normal(n)
    for k in range(1, n):
        noise[k] += 0.97 * noise[k - 1]
    y = 29.0 + response(TransferFunction.sopdt(0.8, (170.0, 30.0), 2.0), time, u) + noise
    y[0] = 0.0
    found = identify_waveform(Record(time, y, u(time), held_input=u))
    assert any(
        "1 sample beyond a jump that no process makes, the first at 0 s" in w
        for w in found.warnings
    )
    assert found.model.gain == pytest.approx(0.8, rel=0.05)


@pytest.mark.nightly
def test_a_first_row_from_before_the_sensor_was_ready_is_left_out():
    """A random walk had explained the row and the response."""
    rng = np.random.default_rng(5)
    time = 0.5 * np.arange(1440.0)
    u = PiecewiseConstant(np.array([30.0]), np.array([30.0]), 0.0)
    walk = np.cumsum(0.4 * rng.standard_normal(time.size))
    y = 27.0 + response(TransferFunction.sopdt(5.0, (175.0, 170.0), 1.0), time, u) + walk
    y = np.round(y / 0.25) * 0.25
    y[0] = 3.75
    found = identify_waveform(Record(time, y, u(time), held_input=u))
    assert any(
        "1 sample beyond a jump that no process makes, the first at 0 s" in w
        for w in found.warnings
    )
    assert found.model.gain == pytest.approx(5.0, rel=0.3)


@pytest.mark.nightly
def test_a_process_that_falls_is_found_in_a_record_far_longer_than_its_fall():
    """A record of 20 s had been searched for growth in 8 s and more."""
    rng, period, late = np.random.default_rng(1), 0.002, 2
    time = period * np.arange(10_000)
    command, y = np.zeros(time.size), np.zeros(time.size)
    angle = speed = rate = before = 0.0
    for k in range(time.size):
        y[k] = angle + 0.01 * rng.standard_normal()
        rate += 0.2 * ((y[k] - before) / period - rate)
        before = y[k]
        frequency = (1.0, 1.4, 2.0)[3 * k // time.size]
        command[k] = 6.0 * (2.0 * np.sin(2.0 * np.pi * frequency * time[k]) - y[k]) - 0.6 * rate
        push = 58.0 * command[k - late] * (k >= late) + 30.0 * rng.standard_normal()
        for _ in range(4):
            angle += period / 4.0 * speed
            speed += period / 4.0 * (100.0 * angle + push)
    found = analyse(Record(time, y, command), alone=True)
    assert found.verdict is Verdict.TRUSTED
    assert found.model.structure == "unstable_sopdt"
    model = found.model.model
    assert np.sort(np.real(model.time_constants)) == pytest.approx([-0.1, 0.1], rel=0.05)
    assert model.gain == pytest.approx(-0.58, rel=0.05)


@pytest.mark.nightly
def test_where_a_coarse_sensor_drops_out_nothing_is_fitted():
    """What the model leaves there would count as what it does not explain."""
    rng = np.random.default_rng(2)
    time = np.arange(0.0, 400.0, 0.5)
    u = PiecewiseConstant(np.array([50.0, 150.0, 250.0]), np.array([10.0, 20.0, 5.0]), 0.0)
    process = TransferFunction.sopdt(1.0, (20.0, 4.0), 3.0)
    y = 60.0 + response(process, time, u) + rng.normal(0.0, 0.02, time.size)
    y = np.round(y)
    y[400:410] = 0.0
    found = identify_waveform(Record(time, y, u(time), held_input=u), FOPDT)
    assert any("autoregression" in w for w in found.warnings)
    left_out = np.flatnonzero(np.isnan(found.fitted))
    assert set(range(400, 410)) <= set(left_out)
    assert left_out.size < 20


def test_a_fast_process_that_answers_a_pulse_is_no_sensor_that_drops_out():
    time = np.arange(0.0, 100.0, 0.5)
    u = PiecewiseConstant(np.array([40.0, 45.0]), np.array([1.0, 0.0]), 0.0)
    process = TransferFunction.fopdt(30.0, 0.2, 2.0)
    y = response(process, time, u) + np.random.default_rng(4).normal(0.0, 0.05, time.size)
    found = identify_waveform(Record(time, y, u(time), held_input=u), FOPDT)
    assert found.model.gain == pytest.approx(30.0, rel=0.01)
    assert not any("left out" in w for w in found.warnings)


@pytest.mark.nightly
@pytest.mark.parametrize(("late", "hides"), [(4.5, True), (1.0, False)])
def test_a_command_that_is_recorded_late_hides_the_dead_time(late, hides):
    time = np.arange(0.0, 400.0, 0.5)
    process = TransferFunction.fopdt(1.5, 15.0, 3.0)
    u = PiecewiseConstant(np.array([50.0, 120.0, 190.0, 260.0]), np.array([1.0, 0, 1, 0]), 0.0)
    y = response(process, time, u) + 0.01 * np.random.default_rng(1).standard_normal(time.size)
    record = Record(time, y, replace(u, times=u.times + late)(time))
    if hides:
        with pytest.raises(
            IdentificationError, match=r"moves 1\.\d s before the recorded command"
        ):
            identify_waveform(record)
    else:
        assert identify_waveform(record).model.dead_time == pytest.approx(2.0, abs=0.1)


@pytest.mark.nightly
def test_an_ultimate_point_beyond_the_rate_of_the_samples_is_not_determined():
    time = np.arange(0.0, 20.0, 0.1)
    u = PiecewiseConstant(np.array([2.0, 9.0]), np.array([1.0, 0.0]), 0.0)
    rng = np.random.default_rng(5)
    model = TransferFunction.fopdt(1.0, 2.0, 0.01)
    y = response(model, time, u) + rng.normal(0.0, 0.003, time.size)
    found = identify_waveform(Record(time=time, measurement=y, command=u(time), held_input=u))
    assert found.ultimate_frequency > math.pi / 0.1
    assert math.isnan(found.ultimate_gain_std)
    assert math.isnan(found.ultimate_frequency_std)
    assert any("beyond half the rate" in warning for warning in found.warnings)
    assert "ultimate_gain" not in [c.name for c in found.combinations]
