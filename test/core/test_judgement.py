# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Each check on records of a known process: right models pass, wrong ones do not."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from analysed import completed

from relay_autotune.analysis import analyse
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.judgement.checks import (
    read_backward,
)
from relay_autotune.identification.judgement.difference import difference
from relay_autotune.identification.judgement.evidence import Evidence, Loop
from relay_autotune.identification.judgement.table import CHECKS
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import Part
from relay_autotune.identification.waveform import posterior
from relay_autotune.loop import analysis
from relay_autotune.process.model_set import ModelSet
from relay_autotune.process.response import response
from relay_autotune.process.structures import UNSTABLE_FOPDT, GivenModel
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Actuator, Disturbances, VirtualProcess
from relay_autotune.record.record import PiecewiseConstant, Record
from relay_autotune.tuning.ensemble import ms_on_each
from relay_autotune.verdict import Result, Verdict, judge

pytestmark = pytest.mark.long

PROCESS = TransferFunction.fopdt(2.0, 10.0, 3.0)


def steps(process, *, noise=0.02, seed=3, until=200.0):
    """Record three steps of the command from rest."""
    time = np.arange(0.0, until, 0.25)
    u = PiecewiseConstant(np.array([20.0, 80.0, 140.0]), np.array([1.0, -0.5, 0.5]), 0.0)
    y = response(process, time, u) + np.random.default_rng(seed).normal(0.0, noise, time.size)
    return Record(time=time, measurement=y, command=u(time), held_input=u)


@functools.lru_cache(maxsize=8)
def identified(record):
    """Return what is identified of a record, once for all tests of it."""
    return identify(record, "waveform")


@functools.lru_cache(maxsize=8)
def in_parts(record):
    return identify(record, "waveform", Known(structure="fopdt"))


def other_model(found, model):
    """Return what was identified with another model in its place."""
    own = found.estimate
    structure = GivenModel.of(model, found.parameters)
    estimate = Estimate(structure, own.values, own.covariance)
    return replace(found, estimate=estimate, draws=(model,), parts=(), fitted=np.empty(0))


def finding(name, record, found, gains):
    """Return what one check finds, None where it does not apply."""
    (check,) = (check for check in CHECKS if check.name == name)
    beside = difference(found, record)
    errors = None if beside is None else beside.draws(100, np.random.default_rng(0))
    models = (found.draws or (found.model,)) * 100
    around = ms_on_each(gains, ModelSet(models[:100], errors=errors))
    loop = Loop(gains, around, gains.ms)
    return next(iter(judge((check,), Evidence(record, found, beside, loop=loop))), None)


@pytest.fixture(scope="module")
def record():
    return steps(PROCESS)


@pytest.fixture(scope="module")
def analysed(record):
    return analyse(record, alone=True)


@pytest.fixture(scope="module")
def gains(analysed):
    return analysed.best_gains


def shown_beside(model, record, w):
    """Return mean and scatter of what a record shows beside a model."""
    found = other_model(in_parts(record), model)
    draws = difference(found, record).draws(200, np.random.default_rng(0))(1j * w)
    return draws.mean(axis=1), draws.std(axis=1)


def test_the_difference_is_that_of_two_processes(record):
    wrong = TransferFunction.fopdt(1.5, 10.0, 3.0)
    w = np.array([0.05, 0.1, 0.2, 0.4])
    mean, scatter = shown_beside(wrong, record, w)
    truth = PROCESS(1j * w) - wrong(1j * w)
    assert np.all(np.abs(mean - truth) < 0.1 * np.abs(truth) + 3.0 * scatter)
    assert np.all(scatter < 0.2 * np.abs(truth))


@pytest.mark.parametrize("pole", [0.0, 0.95])
def test_beside_the_right_model_noise_of_any_colour_shows_next_to_nothing(record, pole):
    rng, noise = np.random.default_rng(5), np.zeros(len(record))
    for k in range(1, noise.size):
        noise[k] = pole * noise[k - 1] + rng.normal(0.0, 0.02)
    noisy = replace(record, measurement=record.measurement + noise)
    w = np.geomspace(0.03, 10.0, 100)
    mean, scatter = shown_beside(PROCESS, noisy, w)
    assert np.max((np.abs(mean) + scatter) / np.abs(PROCESS(1j * w))[0]) < 0.1


@pytest.mark.parametrize(
    ("model", "passes"),
    [
        (PROCESS, True),
        (TransferFunction.fopdt(2.2, 11.0, 3.0), True),
        (TransferFunction.fopdt(-2.0, 10.0, 3.0), False),
        (TransferFunction.fopdt(0.5, 10.0, 3.0), False),
        (TransferFunction.fopdt(2.0, 10.0, 25.0), False),
    ],
)
def test_a_response_that_is_not_the_models_is_a_risk_to_its_gains(record, gains, model, passes):
    """The gains are those of the model, with the same margins on it in each case."""
    scale = PROCESS.gain / model.gain
    own = replace(gains, kc=gains.kc * scale)
    found = finding("risk", record, other_model(identified(record), model), own)
    assert (found.result is Result.PASSED) == passes


def test_few_samples_are_no_evidence_for_gains(record, gains):
    found = identified(record)
    some = replace(found, fitted=np.empty(0))
    risk = finding("risk", record.part(0, 50), some, gains)
    assert (risk.result, math.isnan(risk.value)) == (Result.DOUBTFUL, True)
    assert "could not be checked: 50 samples show too little" in risk.sentence


@pytest.mark.parametrize("seed", [0, 2])
def test_the_steady_answer_to_one_sine_is_no_evidence_for_gains(seed):
    """Two numbers are known of a lag of four orders; it was trusted, with the wrong sign."""
    process = TransferFunction(2.0, time_constants=(1.0, 0.7, 0.5, 0.3), dead_time=0.05)
    time = np.arange(0.0, 30.0, 0.02)
    for before, known in ((40.0, False), (0.0, True)):
        all_time = np.arange(-before, 30.0, 0.02)
        u = PiecewiseConstant(all_time, np.sin(2.0 * (all_time + before)), 0.0)
        noise = np.random.default_rng(seed).normal(0.0, 0.01, time.size)
        y = response(process, time, u) + noise
        found = analyse(Record(time=time, measurement=y, command=u(time)))
        risk = next(f for f in found.judgement.findings if f.name == "risk")
        assert math.isnan(risk.value) != known
        assert risk.remedy.startswith("record steps") != known
        assert (found.verdict is Verdict.TRUSTED) == known


@pytest.mark.parametrize(("slower", "result"), [(1.0, Result.PASSED), (60.0, Result.DOUBTFUL)])
def test_gains_far_slower_than_the_process_are_told(record, gains, slower, result):
    late = replace(gains, ti=slower * gains.ti)
    found = finding("pace", record, other_model(identified(record), PROCESS), late)
    # The integral of the error after a step is ti/(K kc), whatever else the loop does.
    assert found.value == pytest.approx(late.ti / (2.0 * late.kc) / 13.0, rel=1e-3)
    assert found.result is result


def test_a_model_that_would_have_run_away_is_refused(record, gains):
    growing = UNSTABLE_FOPDT.build((2.0, 5.0, 1.0))
    found = finding("growth", record, other_model(identified(record), growing), gains)
    # The command stood still for 60 s.
    assert found.value == pytest.approx(60.0 / 5.0, rel=1e-9)
    assert found.result is Result.FAILED
    found = other_model(identified(record), PROCESS)
    assert finding("growth", record, found, gains) is None


@pytest.mark.parametrize(
    ("bad", "result"), [(0, Result.PASSED), (20, Result.DOUBTFUL), (60, Result.FAILED)]
)
def test_models_on_which_the_loop_is_unstable_are_the_risk(record, gains, bad, result):
    found = identified(record)
    other = TransferFunction.fopdt(20.0, 10.0, 3.0)
    found = replace(found, draws=(PROCESS,) * (100 - bad) + (other,) * bad)
    risk = finding("risk", record, found, gains)
    assert (risk.value, risk.result) == (bad / 100, result)


def test_models_of_the_other_direction_are_the_risk(record, gains):
    """The design leaves them out: 49 of 100 were, and the gains of an oven were trusted."""
    mirrored = replace(PROCESS, gain=-PROCESS.gain)
    found = replace(identified(record), draws=(PROCESS,) * 60 + (mirrored,) * 40)
    (check,) = (check for check in CHECKS if check.name == "risk")
    loop = Loop(gains, np.full(60, gains.ms), gains.ms)
    (risk,) = judge((check,), Evidence(record, found, loop=loop))
    assert (risk.value, risk.result) == (pytest.approx(0.4), Result.DOUBTFUL)


def test_steps_and_relays_of_ordinary_processes_are_trusted(analysed):
    assert analysed.verdict is Verdict.TRUSTED
    assert completed().verdict is Verdict.TRUSTED


@pytest.mark.nightly
def test_a_record_that_is_mostly_another_input_is_doubtful():
    record = steps(PROCESS, noise=0.0)
    other = np.cumsum(np.random.default_rng(8).normal(0.0, 0.35, len(record)))
    found = analyse(replace(record, measurement=record.measurement + other), alone=True)
    assert found.verdict is not Verdict.TRUSTED


# Parts of a record, plain models, long times, and commands without effect.


def joined(first, second, *, noise=0.02):
    """Record a process that becomes another one at 320 s, where all is at rest."""
    u = steps(first).held_input
    late = PiecewiseConstant(u.times + 320.0, u.values, 0.0)
    u = PiecewiseConstant(
        np.concatenate((u.times, [200.0], late.times)),
        np.concatenate((u.values, [0.0], late.values)),
        0.0,
    )
    time = np.arange(0.0, 520.0, 0.25)
    early = np.where(time < 320.0, response(first, time, u), 0.0)
    y = early + response(second, time, late)
    y = y + np.random.default_rng(6).normal(0.0, noise, time.size)
    return Record(time=time, measurement=y, command=u(time), held_input=u)


def fitted_as(model, record):
    """Return what was identified with a FOPDT's parameters in the place of those found."""
    found = in_parts(record)
    values = np.array((model.gain, model.time_constants[0].real, model.dead_time))
    return replace(found, estimate=replace(found.estimate, values=values))


@pytest.mark.parametrize("at", [20.0, 20.2])
def test_a_part_that_begins_at_rest_has_no_free_state(monkeypatch, at):
    """With one, a step at its begin would be explained with a gain of any sign."""
    parts, drawn = [], posterior._allowed

    def noted(problem, *args, **options):
        parts.append(problem)
        return drawn(problem, *args, **options)

    monkeypatch.setattr(posterior, "_allowed", noted)
    time = np.arange(0.0, 300.0, 0.5)
    u = PiecewiseConstant(np.array([at]), np.array([1.0]), 0.0)
    y = response(PROCESS, time, u) + np.random.default_rng(2).normal(0.0, 0.02, time.size)
    in_parts(Record(time, y, u(time), held_input=u))
    begins = [0.0, 20.0 if at == 20.0 else 20.5]
    assert [(p.time[0], p.relaxation) for p in parts[:2]] == [(b, False) for b in begins]


def test_a_part_that_moves_freely_is_asked_for_no_models(monkeypatch):
    """Those of an incubator that cooled after its pulses were of either direction."""
    begins, drawn = [], posterior._allowed

    def noted(problem, *args, **options):
        begins.append(problem.time[0])
        return drawn(problem, *args, **options)

    monkeypatch.setattr(posterior, "_allowed", noted)
    time = np.arange(0.0, 300.0, 0.5)
    u = PiecewiseConstant(np.array([20.0, 30.0]), np.array([1.0, 0.0]), 0.0)
    y = response(PROCESS, time, u) + np.random.default_rng(2).normal(0.0, 0.02, time.size)
    in_parts(Record(time, y, u(time), held_input=u))
    # The pulse, and the whole record.
    assert begins[:2] == [0.0, 0.0]


def test_each_half_of_a_record_tells_its_own_process():
    other = TransferFunction.fopdt(2.0, 10.0, 5.0)
    early, late = in_parts(joined(PROCESS, other)).parts
    for part, process in ((early, PROCESS), (late, other)):
        # About the frequency of the loop, where the command has power.
        away = [abs(m(0.3j) / process(0.3j) - 1.0) for m in part.models]
        assert np.median(away) < 0.15


@pytest.mark.nightly
def test_a_process_that_changed_is_drawn_as_each_half_shows_it():
    found = in_parts(joined(PROCESS, TransferFunction.fopdt(2.0, 10.0, 5.0)))
    late = [m.dead_time for m in found.draws]
    assert min(late) < 3.5
    assert max(late) > 4.5
    assert any("two parts of the record" in text for text in found.warnings)
    same = in_parts(joined(PROCESS, PROCESS))
    assert not any("two parts of the record" in text for text in same.warnings)


@pytest.mark.parametrize("dead_time", [3.063, 3.064, 3.065])
def test_parts_that_differ_as_much_as_their_noise_are_not_told(dead_time):
    found = in_parts(joined(PROCESS, TransferFunction.fopdt(2.0, 10.0, dead_time)))
    assert not any("differ 1 times" in text for text in found.warnings)


@pytest.mark.nightly
def test_gains_hold_on_both_parts_of_a_process_that_changed():
    other = TransferFunction.fopdt(2.0, 10.0, 5.0)
    gains = analyse(joined(PROCESS, other), known=Known(structure="fopdt"), alone=True).best_gains
    assert max(analysis.Loop(gains, PROCESS).ms(), analysis.Loop(gains, other).ms()) < 1.5
    # Those for the first half alone would not.
    alone = analyse(steps(PROCESS), known=Known(structure="fopdt"), alone=True).best_gains
    assert analysis.Loop(alone, other).ms() > 1.7


@pytest.mark.parametrize(
    ("turned", "result"), [(10, Result.PASSED), (30, Result.DOUBTFUL), (40, Result.FAILED)]
)
def test_a_part_that_works_in_the_other_direction_gives_no_gains(record, gains, turned, result):
    other = TransferFunction.fopdt(-2.0, 10.0, 3.0)
    part = Part(0.0, 100.0, (other,) * turned + (PROCESS,) * (40 - turned))
    found = replace(identified(record), parts=(part,))
    assert finding("direction", record, found, gains).result is result


def test_a_static_gain_that_a_part_does_not_show_has_no_direction(record, gains):
    # It turns with a zero that is 40 times as long as the part, and answers there as the process.
    beyond = TransferFunction(-2.0, (-4000.0,), (4000.0, 10.0), dead_time=3.0)
    found = replace(identified(record), parts=(Part(0.0, 100.0, (beyond,) * 40),))
    assert finding("direction", record, found, gains).result is Result.PASSED
    shown = replace(found, parts=(Part(0.0, 20_000.0, (beyond,) * 40),))
    assert finding("direction", record, shown, gains).result is Result.FAILED


def test_a_half_that_shows_nothing_objects_to_nothing():
    # The noise of the first half is twenty times that of the other.
    record = joined(PROCESS, PROCESS)
    noise = np.random.default_rng(9).normal(0.0, 0.4, len(record))
    noisy = replace(record, measurement=record.measurement + np.where(record.time < 260, noise, 0))
    found = analyse(noisy, known=Known(structure="fopdt"), alone=True)
    findings_of = {f.name: f for f in found.judgement.findings}
    assert findings_of["direction"].result is Result.PASSED


def test_no_draw_goes_beyond_what_the_samples_allow():
    """A zero of a hundredth of the lag, of which a first-order covariance says next to nothing."""
    process = TransferFunction.sopdt(0.8, (2.0, 0.4), 0.0)
    record = steps(process, noise=0.05)
    found = identify(record, "waveform", Known(structure="sopdt_zero"))
    assert len(found.draws) > 50
    w = 1j * np.geomspace(0.05, 2.0, 30)
    for model in found.draws:
        assert np.abs(model(w) / process(w) - 1.0).max() < 0.5


@pytest.mark.nightly
def test_a_zero_never_makes_a_fit_worse():
    """Where the zero is 0, dead time and zero cancel to first order, and a search may stay."""
    record = steps(TransferFunction.sopdt(0.8, (2.0, 0.4), 0.0), noise=0.05)
    plain, found = (
        identify(record, "waveform", Known(structure=name)) for name in ("sopdt", "sopdt_zero")
    )
    assert found.fit.residual_rms <= plain.fit.residual_rms


def test_the_draws_have_the_spread_of_the_covariance(record):
    found = in_parts(record)
    for name, of in (("dead_time", "dead_time"), ("gain", "gain")):
        at = found.parameters.index(name)
        drawn = np.std([getattr(m, of) for m in found.draws])
        assert drawn == pytest.approx(found.std[at], rel=0.25)


LEVELS = PiecewiseConstant(
    np.array([20.0, 60.0, 100.0, 140.0, 180.0]), np.array([1.0, 3.0, 0.5, 2.0, 0.0]), 0.0
)


def clipped_steps(end):
    """Record steps on a process whose actuator ends at a level."""
    time = np.arange(0.0, 240.0, 0.25)
    acting = PiecewiseConstant(LEVELS.times, np.minimum(LEVELS.values, end), 0.0)
    y = response(PROCESS, time, acting)
    y = y + np.random.default_rng(1).normal(0.0, 0.02, time.size)
    return Record(time=time, measurement=y, command=LEVELS(time), held_input=LEVELS)


def fed_back(process, gain, *, steps=2000):
    """Record a proportional controller beside noise at the process's input."""
    plant = VirtualProcess(process)
    time = 0.1 * np.arange(steps)
    load = np.random.default_rng(4).normal(0.0, 0.3, steps)
    y, u = np.zeros(steps), np.zeros(steps)
    for k in range(steps):
        y[k] = plant.measure(float(time[k]))
        u[k] = -gain * y[k]
        plant.command(float(u[k] + load[k]))
    return Record(time=time, measurement=y, command=u)


def test_a_controller_that_is_read_backward_gives_no_gains():
    process = TransferFunction.fopdt(2.0, 4.0, 1.0)
    record = fed_back(process, 1.5)

    def share(model):
        return read_backward(record, model, response(model, record.time, record.input()))

    assert share(TransferFunction(-1.0 / 1.5)) == pytest.approx(1.0, abs=0.01)
    assert share(process) < 0.5
    assert analyse(record, alone=True).best_gains is None


def test_a_slow_law_is_read_backward_through_a_rounded_command():
    """From row to row the rounding looks as what comes from outside."""
    interval, n, rng = 0.5, 1200, np.random.default_rng(0)
    plant = VirtualProcess(TransferFunction.sopdt(3.0, (500.0, 25.0), 5.0))
    y, u, drift, integral = np.zeros(n), np.zeros(n), 0.0, 0.0
    for k in range(n):
        drift = 0.998 * drift + 0.06 * rng.standard_normal()
        y[k] = 45.0 + plant.measure(interval * k) + drift + 0.1 * rng.standard_normal()
        integral += 0.01 * interval * (93.0 - y[k])
        u[k] = np.floor(np.clip(2.0 * (93.0 - y[k]) + integral, 0.0, 255.0))
        plant.command(float(u[k]))
    record = Record(time=interval * np.arange(n), measurement=y, command=u)
    # The inverse of the law, -s/(2 s + 0.01), with a zero near 0 and a lag that the rows show.
    model = TransferFunction(-0.02, (5000.0,), (200.0, 4.0))
    left = y - 93.0 - response(model, record.time, replace(record.input(), initial=0.0))
    slow = np.polyval(np.polyfit(record.time, left, 5), record.time)
    assert read_backward(record, model, y - left + slow) > 0.8


def test_a_joint_under_its_controller_is_not_the_law_read_backward():
    """Within the means of a slow pole's response the joint answers, and tells the command."""
    interval, n, rng = 0.004, 8000, np.random.default_rng(0)
    lags = 400.0, 0.15
    plant = VirtualProcess(TransferFunction.sopdt(2000.0, lags, 0.0))
    y, u = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = plant.measure(interval * k) + 1e-3 * rng.standard_normal()
        u[k] = 2.5 * (k // 1000 % 2 - y[k])
        plant.command(float(u[k]))
    record = Record(time=interval * np.arange(n), measurement=y, command=u)
    model = TransferFunction.sopdt(1800.0, lags, 0.0)
    assert read_backward(record, model, response(model, record.time, record.input())) < 0.1


@pytest.mark.parametrize("command", ["slow", "random"])
def test_a_command_from_outside_is_not_fed_back(command):
    """Nor is it where the process follows at once, so that its inverse explains the command."""
    time = np.arange(0.0, 1500.0, 0.5)
    random = np.random.default_rng(12).normal(0.0, 1.0, time.size)
    u = np.sin(time / 40.0) if command == "slow" else random
    process = TransferFunction.fopdt(2.0, 1.0, 0.5)
    record = Record(time=time, measurement=np.zeros(time.size), command=u)
    y = response(process, time, record.input())
    measured = y + np.random.default_rng(13).normal(0.0, 0.01, time.size)
    share = read_backward(replace(record, measurement=measured), process, y)
    assert share is None or share < 0.01


def test_a_command_that_stands_still_while_the_process_answers_is_no_law():
    """Steps that are recorded a row late seem to follow a fast process: 0.97 was read backward."""
    rng, time = np.random.default_rng(0), 0.05 * np.arange(1200)
    levels = rng.uniform(-3.0, 3.0, 40)
    u = PiecewiseConstant(time[::30], levels, 0.0)
    model = TransferFunction.fopdt(1.0, 0.05, 0.0)
    y = response(model, time + 0.05, u) + rng.normal(0.0, 0.05, time.size)
    record = Record(time=time, measurement=y, command=np.repeat(levels, 30))
    assert read_backward(record, model, response(model, time, record.input())) is None


@pytest.mark.parametrize(("tau", "result"), [(8.0, Result.PASSED), (0.2, Result.DOUBTFUL)])
def test_an_answer_between_few_samples_is_not_trusted(record, gains, tau, result):
    found = fitted_as(TransferFunction.fopdt(2.0, tau, 0.1), record)
    assert finding("resolution", record, found, gains).result is result


@pytest.mark.nightly
def test_gains_from_a_clipped_actuator_are_not_trusted_unless_its_end_is_known():
    assert analyse(clipped_steps(9.0), alone=True).verdict is Verdict.TRUSTED
    assert analyse(clipped_steps(1.5), alone=True).verdict is not Verdict.TRUSTED
    # Between this end and 0 there is one move: the end is told, and the process found beside it.
    told = analyse(clipped_steps(0.7), alone=True).model
    assert told is not None
    assert told.ends[1] == pytest.approx(0.7, rel=0.02)
    assert told.model.gain == pytest.approx(PROCESS.gain, rel=0.01)
    assert any("below 0.69" in w and "ends" in w for w in told.warnings)


@pytest.mark.nightly
def test_a_relay_whose_levels_are_clipped_on_one_side_gives_no_trusted_gains():
    process = TransferFunction.fopdt(1.0, 8.0, 3.0)
    plant = VirtualProcess(
        process,
        actuator=Actuator(0.0, minimum=0.0, maximum=5.0),
        disturbances=Disturbances(noise_std=0.02),
        seed=0,
    )
    asked = ExperimentParameters(setpoint=0.0, amplitude=100.0, max_cycles=4)
    tune = RelayExperiment(asked, 0.0)
    for k in range(2000):
        plant.command(tune.step(0.5 * k, plant.measure(0.5 * k)))
        if tune.finished:
            break
    found = analyse(tune.record(), alone=True)
    assert found.verdict is not Verdict.TRUSTED
    clipped = {f.name: f for f in found.judgement.findings}["clipped"]
    assert clipped.result is not Result.PASSED


@pytest.mark.nightly
@pytest.mark.parametrize(("shown", "result"), [(150.0, Result.PASSED), (2.0, Result.DOUBTFUL)])
def test_a_loop_slower_than_what_the_record_shows_is_doubtful(record, gains, shown, result):
    found = fitted_as(PROCESS, record)
    begin = record.input().times[0]
    fitted = np.where(record.time > begin + shown, math.nan, found.fitted)
    beyond = finding("beyond", record, replace(found, fitted=fitted), gains)
    last = record.time[record.time <= begin + shown][-1] - begin
    s = 1j * math.pi / last
    assert beyond.value == pytest.approx(1.0 / abs(found.model(s) * gains(s)), rel=1e-6)
    assert beyond.result is result
    if result is Result.DOUBTFUL:
        needed = float(beyond.sentence.split(", ")[1].removesuffix(" s are needed"))
        for longer, gain in ((0.97, False), (1.03, True)):
            s = 1j * math.pi / (longer * needed)
            assert (abs(found.model(s) * gains(s)) > 1.0) == gain


@pytest.mark.parametrize(("share", "result"), [(0.3, Result.PASSED), (0.7, Result.DOUBTFUL)])
def test_a_model_of_less_than_half_of_the_record_is_doubtful(record, gains, share, result):
    found = fitted_as(PROCESS, record)
    fitted = np.where(np.arange(len(record)) < share * len(record), math.nan, found.fitted)
    of_part = finding("left_out", record, replace(found, fitted=fitted), gains)
    assert of_part.result is result
    assert of_part.value == pytest.approx(share, abs=0.01)
