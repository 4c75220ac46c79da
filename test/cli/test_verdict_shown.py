# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How the verdict travels with the gains of an experiment: table, document, page, message."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

from analysed import completed, doubted
from report_cases import only

from relay_autotune.cli.arguments import DONE, DOUBTFUL, NOTHING_FOUND, USAGE, worst
from relay_autotune.cli.jobs import status_of
from relay_autotune.cli.table import table
from relay_autotune.exchange.messages import fill_gains
from relay_autotune.exchange.models import document
from relay_autotune.report.case import case_of, cases_of_document
from relay_autotune.report.findings import checks_of, verdict_of
from relay_autotune.report.page import page
from relay_autotune.verdict import NOT_JUDGED, Verdict


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
    assert said in page([replace(case, record=None, cycles=(), models_around=())])
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace()), verdict_why=SimpleNamespace()
    )
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
