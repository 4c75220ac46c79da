# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The verdict of a table of checks, and how it travels with the gains of an experiment."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from report_cases import completed

from relay_autotune.analysis import model_so_far
from relay_autotune.cli.arguments import DONE, DOUBTFUL, NOTHING_FOUND, USAGE, worst
from relay_autotune.cli.replay_bag import status_of
from relay_autotune.cli.table import table
from relay_autotune.errors import ParameterError
from relay_autotune.exchange.document import document
from relay_autotune.exchange.messages import fill_gains
from relay_autotune.identification.judgement.table import CHECKS
from relay_autotune.report.case import case_of
from relay_autotune.report.findings import checks_of, verdict_of
from relay_autotune.report.from_document import cases_of_document
from relay_autotune.report.page import page
from relay_autotune.verdict import (
    NOT_JUDGED,
    Check,
    Judgement,
    Measured,
    Result,
    Verdict,
    judge,
    verdict_named,
)


def row(value, *, doubtful=1.0, failed=2.0):
    measured = None if value is None else Measured(value, "in the cycles")
    return Check(
        name="swing",
        title="Swing",
        what="height of the swing",
        unit="m",
        doubtful=doubtful,
        failed=failed,
        sentence="the swing is {value} m {detail}, more than {limit} m",
        remedy="hold it",
        measure=lambda _: measured,
    )


@pytest.mark.parametrize(
    ("value", "result", "verdict"),
    [
        (0.5, Result.PASSED, Verdict.TRUSTED),
        (1.0, Result.PASSED, Verdict.TRUSTED),
        (1.5, Result.DOUBTFUL, Verdict.DOUBTFUL),
        (2.5, Result.FAILED, Verdict.NONE),
        (math.inf, Result.FAILED, Verdict.NONE),
        (math.nan, Result.FAILED, Verdict.NONE),
    ],
)
def test_the_verdict_is_that_of_the_worst_check(value, result, verdict):
    findings = judge((row(0.0), row(value), row(0.3)), None)
    assert findings[1].result is result
    assert Judgement(findings).verdict is verdict


def test_a_finding_says_what_was_measured_and_what_to_do():
    (found,) = judge((row(1.5),), None)
    assert found.said == "the swing is 1.50 m in the cycles, more than 1.00 m: hold it"
    assert Judgement((found,)).reason == found.said
    (failed,) = judge((row(2.5),), None)
    assert failed.limit == 2.0
    (passed,) = judge((row(0.5),), None)
    assert (passed.sentence, passed.remedy) == ("", "")


def test_a_check_that_does_not_apply_is_left_out():
    assert judge((row(None),), None) == ()
    assert Judgement(()).verdict is Verdict.TRUSTED


def test_what_is_refused_gives_no_gains_whatever_the_checks_say():
    judgement = Judgement(judge((row(0.0),), None), refused="it was aborted")
    assert (judgement.verdict, judgement.reason) == (Verdict.NONE, "it was aborted")
    assert not judgement.contradicted
    assert NOT_JUDGED.verdict is Verdict.UNKNOWN


def test_names_of_verdicts():
    assert verdict_named("doubtful") is Verdict.DOUBTFUL
    with pytest.raises(ParameterError, match="unknown, trusted, doubtful, none"):
        verdict_named("perhaps")


def test_the_worst_exit_status_is_not_the_largest_number():
    assert worst(DONE, DOUBTFUL) == DOUBTFUL
    assert worst(DOUBTFUL, NOTHING_FOUND, DONE) == NOTHING_FOUND
    assert worst(USAGE, NOTHING_FOUND, DOUBTFUL) == USAGE


def test_rows_have_names_of_their_own_and_a_limit():
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names)
    assert all(min(c.doubtful, c.failed) < math.inf for c in CHECKS)


# An ordinary tune, and the same with a row that does not pass.


def doubted():
    found = completed()
    judgement = Judgement((*found.judgement.findings, *judge((row(1.5),), None)))
    return replace(found, judgement=judgement)


def test_an_ordinary_tune_is_trusted_everywhere():
    found = completed()
    assert found.verdict is Verdict.TRUSTED
    assert status_of([found]) == DONE
    assert "verdict          trusted" in table("tank", [found])
    (experiment,) = json.loads(json.dumps(document("tank", [found])))["experiments"]
    assert experiment["verdict"] == "trusted"
    assert {c["result"] for c in experiment["checks"]} == {"passed"}
    assert verdict_of(case_of(found, "tank")).tone == "good"


def test_a_doubt_marks_the_gains_in_table_document_page_and_message():
    found = doubted()
    said = "the swing is 1.50 m in the cycles, more than 1.00 m: hold it"
    assert status_of([found]) == DOUBTFUL
    text = table("tank", [found])
    assert "verdict          doubtful" in text
    assert "gains            robust   DOUBTFUL" in text
    case = case_of(found, "tank")
    assert verdict_of(case).text.startswith("doubtful gains")
    assert checks_of(case)[-1].mark == "!"
    assert said in page([replace(case, record=None, cycles=(), models_around=())])
    message = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace()))
    fill_gains(message, found.best_gains, judgement=found.judgement)
    assert (message.verdict, message.verdict_reason) == (Verdict.DOUBTFUL, said)


def test_a_document_gives_the_judgement_back():
    for found in (completed(), doubted()):
        (read,) = cases_of_document(json.loads(json.dumps(document("t", [found]))), "t")
        assert read.judgement == found.judgement
    refused = replace(doubted(), judgement=replace(doubted().judgement, refused="aborted"))
    (read,) = cases_of_document(json.loads(json.dumps(document("t", [refused]))), "t")
    assert read.judgement == refused.judgement
    old = json.loads(json.dumps(document("t", [completed()])))
    for name in ("verdict", "verdict_reason", "checks"):
        del old["experiments"][0][name]
    (read,) = cases_of_document(old, "t")
    assert read.judgement is NOT_JUDGED


def test_a_running_experiment_is_not_judged():
    assert model_so_far(completed().record).verdict is Verdict.UNKNOWN
