# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How the verdict travels with the gains of an experiment: table, document, page, message."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
from analysed import completed, doubted
from report_cases import only

from relay_autotune.analysis import analyse
from relay_autotune.cli import jobs, replay
from relay_autotune.cli.arguments import DONE, DOUBTFUL, NOTHING_FOUND, USAGE, worst
from relay_autotune.cli.jobs import status_of
from relay_autotune.cli.table import table
from relay_autotune.exchange.messages import fill_gains
from relay_autotune.exchange.models import document
from relay_autotune.identification.known import Known
from relay_autotune.identification.result import Rival
from relay_autotune.report.case import case_of, cases_of_document
from relay_autotune.report.findings import checks_of, verdict_of
from relay_autotune.report.page import page
from relay_autotune.tuning.task import DesignOptions
from relay_autotune.verdict import NOT_JUDGED, Result, Verdict


def test_the_worst_exit_status_is_not_the_largest_number():
    assert worst(DONE, DOUBTFUL) == DOUBTFUL
    assert worst(DOUBTFUL, NOTHING_FOUND, DONE) == NOTHING_FOUND
    assert worst(USAGE, NOTHING_FOUND, DOUBTFUL) == USAGE


def test_an_ordinary_tune_is_trusted_everywhere():
    found = completed()
    assert found.verdict is Verdict.TRUSTED
    assert status_of([found]) == DONE
    assert "verdict          trusted" in table("tank", [found])
    (experiment,) = json.loads(json.dumps(document("tank", [found])))["experiments"]
    assert experiment["verdict"] == "trusted"
    assert {c["result"] for c in experiment["checks"]} == {"passed"}
    assert verdict_of(case_of(found, "tank")).tone == "good"


def test_a_doubt_marks_the_gains_in_table_document_page_and_message(monkeypatch):
    only(monkeypatch)
    found = doubted()
    said = "the swing is 1.50 m in the cycles, more than 1.00 m: hold it"
    assert status_of([found]) == DOUBTFUL
    text = table("tank", [found])
    assert "verdict          doubtful" in text
    assert "gains            robust   DOUBTFUL" in text
    case = case_of(found, "tank")
    assert verdict_of(case).text.startswith("doubtful gains")
    assert checks_of(case)[-1].mark == "!"
    assert said in page([replace(case, record=None, models_around=())])
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace()), verdict_why=SimpleNamespace()
    )
    fill_gains(message, found.best_gains, judgement=found.judgement)
    assert (message.verdict, message.verdict_reason) == (Verdict.DOUBTFUL, said)


def test_doubtful_gains_that_are_not_exported_have_the_status_of_doubtful_gains(
    monkeypatch, capsys
):
    monkeypatch.setattr(jobs, "analysed", lambda *_, **__: (doubted(),))
    asked = ["--export", "yaml", "bags/biased_relay"]
    assert replay.main(asked) == DOUBTFUL
    told = capsys.readouterr()
    assert not told.out
    assert "gains are doubtful: the swing is" in told.err
    assert replay.main([*asked, "--accept-doubtful"]) == DOUBTFUL
    assert "# DOUBTFUL: the swing is" in capsys.readouterr().out


def test_a_failed_check_is_named_beside_the_verdict():
    found = doubted()
    (worst,) = [f for f in found.judgement.findings if f.result is not Result.PASSED]
    failed = [
        replace(f, result=Result.FAILED) if f is worst else f for f in found.judgement.findings
    ]
    judgement = replace(found.judgement, findings=tuple(failed))
    text = table("tank", [replace(found, judgement=judgement, gains=())])
    count = len(failed)
    said = f"none, {count - 1} of {count} checks passed; failed: {worst.title.lower()}"
    assert said in " ".join(text.split())


def test_it_is_said_why_a_rival_of_more_support_is_not_taken(monkeypatch):
    only(monkeypatch)
    found = completed()
    (model, *others) = found.models
    rivals = (Rival(model.estimate, 0.82), Rival(model.estimate, 0.05))
    for support, told in ((0.13, True), (0.9, False)):
        chosen = replace(model, support=support, rivals=rivals)
        shown = replace(found, models=(chosen, *others))
        said = "the structure of the best score is taken, which in coloured noise has 13 % of"
        assert (said in " ".join(table("tank", [shown]).split())) == told
        case = replace(case_of(shown, "tank"), record=None, models_around=())
        assert (said.capitalize() in page([case])) == told


@pytest.mark.long
def test_the_period_of_the_controller_is_said_with_the_gains():
    record = completed().record
    own = completed().best_gains.reason
    period = f"{record.interval:.3g}"
    assert own.endswith(
        f"; for a controller that runs every {period} s, the interval of the recording; "
        "--sample-period names another"
    )
    given = analyse(
        record,
        known=Known(structure="fopdt"),
        options=DesignOptions(sample_period=0.5 * record.interval),
        alone=True,
    )
    told = given.best_gains.reason
    assert told.endswith(f"; for a controller that runs every {0.5 * record.interval:g} s")


def test_gains_are_shown_in_the_series_form_where_they_have_one():
    found = completed()
    best = replace(found.best_gains, kc=2.0, ti=10.0, td=1.6, tf=0.0)
    for td, told in (
        (1.6, "kc 1.600 u/y ti 8.000 s td 2.000 s"),
        (3.0, "none: ti = 10 s is less"),
    ):
        shown = replace(found, gains=(replace(best, td=td),))
        assert f"series form {told}" in " ".join(table("tank", [shown], form="series").split())
    assert "series form" not in table("tank", [found])


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
