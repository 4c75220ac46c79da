# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Long records are averaged before they are analysed, and tell the same model."""

import numpy as np
import pytest

from relay_autotune.analysis import analyse
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings
from relay_autotune.record.thinning import BLOCKS, LEFT_ALONE, thinned

SLOW = TransferFunction.fopdt(2.0, 12.0, 3.0)
NOISE = 0.05


def levels(t, every, rng):
    return rng.choice([-1.0, 0.0, 1.0], 2 + int(t[-1] / every))[(t / every).astype(int)]


def made(model, t, u, rng, noise=NOISE, **fields):
    held = PiecewiseConstant.from_samples(t, u)
    y = response(model, t, held) + noise * rng.standard_normal(t.size)
    return Record(t, y, u, **fields)


def commands(samples, rng):
    t = np.linspace(0.0, 1000.0, samples)
    return t, {
        "sine": np.sin(0.1 * t),
        "noise": rng.standard_normal(samples),
        "steps": levels(t, 50.0, rng),
        "step": (t > 100.0).astype(float),
        "ramp": t / 1000.0,
    }


def test_a_record_that_is_short_enough_is_left_alone():
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 1000.0, LEFT_ALONE)
    record = made(SLOW, t, levels(t, 50.0, rng), rng)
    assert thinned(record) is record


@pytest.mark.long
@pytest.mark.parametrize("samples", [LEFT_ALONE + 1, 150_000])
@pytest.mark.parametrize("shape", ["sine", "noise", "steps", "step", "ramp"])
def test_what_is_analysed_is_bounded_however_long_and_whatever_the_command(shape, samples):
    rng = np.random.default_rng(1)
    t, shapes = commands(samples, rng)
    short = thinned(made(SLOW, t, shapes[shape], rng))
    assert len(short) <= BLOCKS
    assert short.input().times.size <= BLOCKS
    assert f"of {samples} samples {len(short)} are used" in short.unthinned.remark
    # Nothing of the record is left out: the response is slow.
    assert short.duration > 0.99 * 1000.0


@pytest.mark.nightly
@pytest.mark.parametrize("shape", ["steps", "sine", "noise", "step"])
def test_the_model_is_that_of_all_samples_within_its_interval(shape):
    rng = np.random.default_rng(2)
    t, shapes = commands(60_000, rng)
    record = made(SLOW, t, shapes[shape], rng)
    short, known = thinned(record), Known(structure="fopdt")
    found = identify(short, "waveform", known)
    assert np.all(np.abs(found.values - [2.0, 12.0, 3.0]) < 4.0 * found.std)
    if shape in ("steps", "step"):
        # Nothing is lost by the means: neither the model nor how well it is known.
        whole = identify(record, "waveform", known)
        assert np.all(np.abs(found.values - whole.values) < 0.5 * whole.std)
        np.testing.assert_allclose(found.std, whole.std, rtol=0.15)


def test_switches_stay_where_they_were_and_a_mean_has_the_noise_of_a_mean():
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 1000.0, 100_001)
    record = made(SLOW, t, levels(t, 37.0, rng), rng, noise_std=NOISE)
    short = thinned(record)
    np.testing.assert_array_equal(short.input().times, record.input().times)
    np.testing.assert_array_equal(short.input().values, record.input().values)
    size = len(record) / len(short)
    assert short.noise_std == pytest.approx(NOISE / np.sqrt(size), rel=0.1)
    assert short.unthinned.noise == NOISE
    assert short.unthinned.interval == pytest.approx(0.01)


def test_the_mean_of_a_command_that_changes_all_the_time_is_kept():
    rng = np.random.default_rng(4)
    t = np.linspace(0.0, 1000.0, 50_001)
    record = made(SLOW, t, rng.standard_normal(t.size), rng)
    held = thinned(record).input()
    at = np.append(held.times, t[-1])
    area = np.sum(held.values * np.diff(at))
    exact = np.sum(record.command[:-1] * np.diff(t))
    assert area == pytest.approx(exact, abs=1e-9)


@pytest.mark.long
def test_of_a_fast_response_a_part_about_the_first_changes_is_used_and_said():
    rng = np.random.default_rng(5)
    fast = TransferFunction.fopdt(2.0, 0.05, 0.02)
    t = np.arange(100_000) * 0.01
    u = np.where(t < 300.0, 0.0, levels(t, 0.2, rng))
    short = thinned(made(fast, t, u, rng, noise=0.01))
    assert BLOCKS < len(short) <= LEFT_ALONE
    assert short.unthinned.remark.endswith("choose another part with --start and --end")
    assert "10000 are used, from 290 s to 389.99 s alone: " in short.unthinned.remark
    changes = short.input().times
    assert np.sum((changes > short.time[0]) & (changes < short.time[-1])) > 50
    found = identify(short, "waveform", Known(structure="fopdt"))
    np.testing.assert_allclose(found.values, [2.0, 0.05, 0.02], rtol=0.03)


def test_a_fast_answer_to_one_step_in_a_long_record_is_not_averaged_away():
    rng = np.random.default_rng(6)
    fast = TransferFunction.fopdt(2.0, 0.5, 0.2)
    t = np.arange(200_000) * 0.01
    short = thinned(made(fast, t, (t > 1500.0).astype(float), rng))
    found = identify(short, "waveform", Known(structure="fopdt"))
    np.testing.assert_allclose(found.values, [2.0, 0.5, 0.2], rtol=0.05)


def test_spikes_and_slow_noise_do_not_look_like_a_fast_response():
    rng = np.random.default_rng(7)
    t = np.linspace(0.0, 1000.0, 100_000)
    record = made(SLOW, t, levels(t, 50.0, rng), rng)
    wander = np.convolve(rng.standard_normal(t.size), np.exp(-np.arange(200) / 40.0), "same")
    y = record.measurement + 0.05 * wander / np.std(wander)
    y[::5000] += 10.0
    short = thinned(Record(t, y, record.command))
    assert short.duration > 990.0


def test_cycles_begin_where_they_began():
    rng = np.random.default_rng(8)
    t = np.arange(60_000) * 0.01
    u = np.where(np.sin(2.0 * np.pi * t / 50.0) >= 0.0, 1.0, -1.0)
    starts = tuple(int(i) for i in np.flatnonzero(np.diff(u) > 0.0) + 1)
    settings = RelaySettings(0.0, 0.0, 1.0)
    short = thinned(made(SLOW, t, u, rng, settings=settings, cycle_start=starts))
    assert len(short.cycle_start) == len(starts)
    # Each block's time is the middle of it.
    half = 0.5 * short.interval
    begun = short.time[list(short.cycle_start)] - half
    np.testing.assert_allclose(begun, t[list(starts)], atol=0.02)


@pytest.mark.nightly
def test_an_analysis_says_so_and_designs_for_single_samples():
    rng = np.random.default_rng(9)
    t = np.linspace(0.0, 1000.0, 30_000)
    record = made(SLOW, t, levels(t, 50.0, rng), rng)
    found = analyse(record, alone=True)
    assert any(f"of {t.size} samples" in w for w in found.model.warnings)
    assert found.record.unthinned.noise == pytest.approx(NOISE, rel=0.1)
    # The period of a design has three digits: 0.0333 of 0.033334. Rows do not tell when between
    # two of them the command moved, nor do their means.
    assert found.added_delay == pytest.approx(0.5 * 0.0333 + 0.5 * 0.033334, rel=1e-4)


@pytest.mark.nightly
def test_what_a_first_order_leaves_of_means_is_not_taken_for_jitter():
    # It leaves a thousandth of the range, which means of three samples do not hide.
    rng = np.random.default_rng(2)
    t = 0.05 * np.arange(12_000)
    u = np.select([t < 50, t < 200, t < 350, t < 450], [0.0, 1.0, -0.5, 0.5], 0.0)
    process = TransferFunction(2.0, (), (40.0, 1.5), 0, 3.0)
    short = thinned(made(process, t, u, rng, noise=0.002))
    found = identify(short, "waveform")
    assert found.structure == "sopdt"
    assert found.ultimate_gain == pytest.approx(ultimate_point(process).gain, rel=0.02)
