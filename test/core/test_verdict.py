# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The verdict of a table of checks."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from analysed import completed, swing_check
from sampled_relay import simulate_sampled_relay

from relay_autotune.analysis import Task, model_so_far
from relay_autotune.errors import ParameterError
from relay_autotune.identification.judgement.table import CHECKS, MODEL_CHECKS
from relay_autotune.identification.known import Known
from relay_autotune.identification.result import Validation
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings
from relay_autotune.verdict import NOT_JUDGED, Judgement, Result, Verdict, judge, verdict_named


@pytest.mark.parametrize(
    ("value", "result", "verdict"),
    [
        (0.5, Result.PASSED, Verdict.TRUSTED),
        (1.0, Result.PASSED, Verdict.TRUSTED),
        (1.5, Result.DOUBTFUL, Verdict.DOUBTFUL),
        (2.5, Result.FAILED, Verdict.NONE),
        (math.inf, Result.FAILED, Verdict.NONE),
        (math.nan, Result.DOUBTFUL, Verdict.DOUBTFUL),
    ],
)
def test_the_verdict_is_that_of_the_worst_check(value, result, verdict):
    findings = judge((swing_check(0.0), swing_check(value), swing_check(0.3)), None)
    assert findings[1].result is result
    assert Judgement(findings).verdict is verdict


def test_a_finding_says_what_was_measured_and_what_to_do():
    (found,) = judge((swing_check(1.5),), None)
    assert found.said == "the swing is 1.50 m in the cycles, more than 1.00 m: hold it"
    assert Judgement((found,)).reason == found.said
    (failed,) = judge((swing_check(2.5),), None)
    assert failed.limit == 2.0
    (passed,) = judge((swing_check(0.5),), None)
    assert (passed.sentence, passed.remedy) == ("", "")


def test_a_check_that_does_not_apply_is_left_out():
    assert judge((swing_check(None),), None) == ()
    assert Judgement(()).verdict is Verdict.TRUSTED


def test_what_is_refused_gives_no_gains_whatever_the_checks_say():
    judgement = Judgement(judge((swing_check(0.0),), None), refused="it was aborted")
    assert (judgement.verdict, judgement.reason) == (Verdict.NONE, "it was aborted")
    assert not judgement.contradicted
    assert NOT_JUDGED.verdict is Verdict.UNKNOWN


def test_names_of_verdicts():
    assert verdict_named("doubtful") is Verdict.DOUBTFUL
    with pytest.raises(ParameterError, match="unknown, trusted, doubtful, none"):
        verdict_named("perhaps")


def test_rows_have_names_of_their_own_and_a_limit():
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names)
    assert all(min(c.doubtful, c.failed) < math.inf for c in CHECKS)


@pytest.mark.long
def test_a_running_experiment_is_not_judged():
    task = Task(known=Known(structure="fopdt"))
    assert model_so_far(completed().record, task).verdict is Verdict.UNKNOWN


def limit_cycle_evidence(
    validation: Validation, *, away: bool = False, period: float = 0.01, noise_std: float = 0.0
) -> SimpleNamespace:
    """Return what the check of the limit cycle looks at, with a relay that sees samples alone."""
    relay = RelaySettings(0.0, 0.0, 1.0, 0.0, 0.1)
    noise = noise_std * np.random.default_rng(3).standard_normal(int(15.0 / period))
    process = TransferFunction.fopdt(1.0, 1.0, 0.5)
    record = simulate_sampled_relay(process, relay, period=period, noise=noise)
    found = SimpleNamespace(validation=validation, began_away=away, friction=0.0)
    return SimpleNamespace(found=found, settled=True, record=record)


def test_a_model_without_limit_cycle_is_said_in_words_and_a_start_away_from_rest_comes_first():
    check = next(check for check in MODEL_CHECKS if check.name == "limit_cycle")

    def said(validation: Validation, *, away: bool = False) -> str:
        return check(limit_cycle_evidence(validation, away=away)).sentence

    none = Validation(reason="the measurement never reaches 6: there is no limit cycle")
    told = "the same relay on the model does not oscillate as recorded: the measurement never"
    assert said(none).startswith(told)
    assert "inf" not in said(none)
    assert said(none, away=True).startswith("the test did not begin at rest")
    other = "the same relay on the model oscillates with a period 25.0 % shorter than the recorded"
    assert said(Validation(period=-0.25)) == f"{other} one"


def test_a_period_that_scatters_does_not_speak_against_a_model():
    """A relay that sees few samples switches late by chance."""
    check = next(check for check in MODEL_CHECKS if check.name == "limit_cycle")
    away = Validation(period=-0.12)
    assert check(limit_cycle_evidence(away)).result is Result.DOUBTFUL
    scattered = limit_cycle_evidence(away, period=0.25, noise_std=0.1)
    assert check(scattered).result is Result.PASSED
