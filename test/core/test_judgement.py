"""Each check on records of a known process: right models pass, wrong ones do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from report_cases import completed

from relay_autotune.analysis import analyse, analyse_alone
from relay_autotune.identification import Estimate, identify
from relay_autotune.identification.judgement.evidence import Evidence, Loop
from relay_autotune.identification.judgement.table import CHECKS
from relay_autotune.identification.judgement.visible import visible_error
from relay_autotune.loop.analysis import ms_on
from relay_autotune.process.response import response
from relay_autotune.process.structures import GivenModel
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record
from relay_autotune.verdict import Result, Verdict, judge

PROCESS = TransferFunction.fopdt(2.0, 10.0, 3.0)


def steps(process, *, noise=0.02, seed=3, until=200.0):
    """Record three steps of the command from rest."""
    time = np.arange(0.0, until, 0.25)
    u = PiecewiseConstant(np.array([20.0, 80.0, 140.0]), np.array([1.0, -0.5, 0.5]), 0.0)
    y = response(process, time, u) + np.random.default_rng(seed).normal(0.0, noise, time.size)
    return Record(time=time, measurement=y, command=u(time), held_input=u)


def other_model(found, model):
    """Return what was identified with another model in its place."""
    own = found.estimate
    structure = GivenModel.of(model, found.parameters)
    return replace(found, estimate=Estimate(structure, own.values, own.covariance))


def findings(record, model, gains, **more):
    found = other_model(identify(record, "waveform"), model)
    loop = Loop(gains, lambda m: ms_on(gains, m), gains.ms, gains.ms_95)
    evidence = Evidence(record, found, loop=loop, **more)
    return {f.name: f for f in judge(CHECKS, evidence)}


@pytest.fixture(scope="module")
def record():
    return steps(PROCESS)


@pytest.fixture(scope="module")
def gains(record):
    return analyse_alone(record).best_gains


def test_the_visible_error_is_the_difference_of_two_processes(record):
    wrong = TransferFunction.fopdt(1.5, 10.0, 3.0)
    w = np.array([0.05, 0.1, 0.2])
    error = visible_error(wrong, record)
    truth = PROCESS(1j * w) - wrong(1j * w)
    np.testing.assert_allclose(np.abs(error.at(w) - truth) / np.abs(truth), 0.0, atol=0.15)
    assert np.all(error.sure(w) > 0.5 * np.abs(truth))


def test_the_right_model_has_no_visible_error(record):
    w = np.geomspace(0.03, 10.0, 100)
    error = visible_error(PROCESS, record)
    assert np.max(error.sure(w) / np.abs(PROCESS(1j * w))) < 0.2


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
def test_a_response_that_is_not_the_models_makes_its_gains_doubtful(record, gains, model, passes):
    found = findings(record, model, gains)["visible_response"]
    assert (found.result is Result.PASSED) == passes
    assert passes or "what the loop bears" in found.sentence


def test_a_model_that_would_have_run_away_is_refused(record, gains):
    growing = TransferFunction.unstable_fopdt(2.0, 5.0, 1.0)
    found = findings(record, growing, gains)["growth"]
    # The command stood still for 60 s.
    assert found.value == pytest.approx(60.0 / 5.0, rel=1e-9)
    assert found.result is Result.FAILED
    assert "growth" not in findings(record, PROCESS, gains)


def test_a_rival_on_which_the_loop_is_unstable_makes_gains_doubtful(record, gains):
    own = identify(record, "waveform")
    same = findings(record, own.model, gains, others=(own,))["rivals"]
    assert same.value == pytest.approx(1.0, abs=0.1)
    other = other_model(own, TransferFunction.fopdt(-2.0, 10.0, 3.0))
    found = findings(record, own.model, gains, others=(other,))["rivals"]
    assert found.value == np.inf
    assert found.result is Result.DOUBTFUL
    # What explains the record less well is no rival.
    worse = replace(other, fit=replace(own.fit, residual_rms=2.0 * own.fit.residual_rms))
    assert findings(record, own.model, gains, others=(worse,))["rivals"].result is Result.PASSED


def test_steps_and_relays_of_ordinary_processes_are_trusted(record):
    assert analyse(record).verdict is Verdict.TRUSTED
    assert completed().verdict is Verdict.TRUSTED


def test_a_record_that_is_mostly_another_input_is_doubtful():
    record = steps(PROCESS, noise=0.0)
    other = np.cumsum(np.random.default_rng(8).normal(0.0, 0.35, len(record)))
    found = analyse_alone(replace(record, measurement=record.measurement + other))
    assert found.verdict is not Verdict.TRUSTED
