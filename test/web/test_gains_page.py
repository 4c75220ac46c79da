# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which gains of the page are sent to a running controller."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import pytest
from analysed import analysed_once
from served import analysed, subject_of

from relay_autotune.cli import gains_page
from relay_autotune.cli.apply_gains import found_entries
from relay_autotune.cli.gains_page import GainsPage
from relay_autotune.cli.tuned import Proof
from relay_autotune.control.step_choice import StepRange
from relay_autotune.errors import LoopError, TuningError
from relay_autotune.exchange.messages import gains_from_message
from relay_autotune.record.record import Outcome
from relay_autotune.verdict import Judgement
from relay_autotune.web.live import Live, PageCommand
from relay_autotune.web.shape import DesignRequest
from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, Verification

CALM = PageCommand("apply", 0, DesignRequest(controller="pi", ms=1.3), 0.0)


def sent(subject, wish):
    """Return the message with the gains that a wish means."""
    # What a worker would compute.
    worker = SimpleNamespace(ask=lambda work: ThreadPoolExecutor(1).submit(work))
    client = SimpleNamespace(computed=lambda work, leave: work.result())
    page = SimpleNamespace(subjects=[subject], worker=worker)
    loop = SimpleNamespace(client=client)
    return GainsPage(loop, Live("/relay_node"), page, 0, lambda: False)._message(wish)


def test_the_gains_are_those_that_the_page_shows():
    subject = subject_of(analysed())
    message = sent(subject, CALM)
    assert gains_from_message(message) == subject.shaped(CALM.asked).gains
    assert message.experiment_id == subject.case.experiment_id
    assert message.final
    assert message.verdict == PidGains.VERDICT_TRUSTED


def test_gains_for_another_loop_are_not_sent():
    subject = subject_of(analysed())
    subject.loop = 1
    with pytest.raises(TuningError, match="another loop than /relay_node"):
        sent(subject, CALM)


def test_doubtful_gains_are_sent_only_when_they_are_accepted_and_say_so(monkeypatch):
    subject = subject_of(analysed())
    finding = replace(subject.shaping.findings[0], result=1, sentence="the data drift", remedy="x")
    monkeypatch.setattr(
        type(subject.shaping), "judgement", lambda self, gains: Judgement((finding,))
    )
    with pytest.raises(TuningError, match="the data drift"):
        sent(subject, CALM)
    message = sent(subject, replace(CALM, doubtful=True))
    assert message.verdict == PidGains.VERDICT_DOUBTFUL
    assert "the data drift" in message.verdict_reason


def test_an_experiment_that_was_aborted_has_no_gains_to_send():
    aborted = replace(analysed().record, outcome=Outcome.ABORTED, reason="a button")
    with pytest.raises(TuningError, match="aborted"):
        sent(subject_of(analysed_once(aborted)), replace(CALM, doubtful=True))


@pytest.mark.parametrize("wish", [replace(CALM, of=1), PageCommand("apply")])
def test_gains_that_are_not_there_are_not_sent(wish):
    with pytest.raises(TuningError, match="no such gains"):
        sent(subject_of(analysed()), wish)


def test_a_plan_to_return_names_the_gains_that_come_back_or_says_that_there_are_none():
    answers = ["kc 0.3, ti 1 s, td 0 s", LoopError("refuses: there are no gains before these")]

    def ask(service):
        assert service == "before"
        if isinstance(answer := answers.pop(0), str):
            return answer
        raise answer

    page = GainsPage(SimpleNamespace(proves=False), Live("/tank"), None, 0, lambda: False)
    page._controller = SimpleNamespace(find=lambda patience: None, ask=ask)
    plan = page.plan(PageCommand("revert", dry=1))
    assert plan.lines[-1][2].startswith("those before: kc 0.3, ti 1 s, td 0 s; at once")
    assert "no gains before these" in page.plan(PageCommand("revert", dry=2)).refusal


def test_a_proof_that_is_refused_leaves_the_one_that_has_passed():
    subject, live = subject_of(analysed()), Live("/relay_node")
    worker = SimpleNamespace(ask=lambda work: ThreadPoolExecutor(1).submit(work))
    client = SimpleNamespace(computed=lambda work, leave: work.result())
    loop = SimpleNamespace(client=client, proves=True)
    page = SimpleNamespace(subjects=[subject], worker=worker)
    passed = (("verdict", "passed"),)
    live.tell(proof=passed, status="proof passed")
    live.show("proof", [1])
    gains = GainsPage(loop, live, page, 0, lambda: False)
    # no tune has left a model on which the step could be predicted
    plan = gains.plan(replace(CALM, what="prove", dry=1))
    assert "no gains of a tune" in plan.refusal and not plan.refused
    assert live.snapshot.status == "proof passed"
    gains.do(replace(CALM, what="prove"))
    assert "no gains of a tune" in live.snapshot.status
    assert live.snapshot.proof == passed and live.everything()["shown"] == {"proof": [1]}


def test_a_proof_is_in_the_report_of_its_gains_and_is_computed_once(monkeypatch):
    subject, live = subject_of(analysed()), Live("/relay_node")
    worker = SimpleNamespace(ask=lambda work: ThreadPoolExecutor(1).submit(work))
    client = SimpleNamespace(computed=lambda work, leave: work.result())
    options = SimpleNamespace(at=2.0)
    loop = SimpleNamespace(client=client, proves=True, options=options)
    page = SimpleNamespace(subjects=[subject], worker=worker)
    gains = GainsPage(loop, live, page, 0, lambda: False)
    asked, computed = list[float](), []
    made = Verification(step=0.5, overshoot=0.1, settling_time=3.8)

    class Made(Proof):
        step = 0.5
        allowed = StepRange(-1.0, 1.0)

        def __init__(self, tune, message):
            computed.append(message)

        def plan(self, step):
            self.allowed.require(step)
            return (("moves", f"by {step:+g} y"),)

        def made(self, step, doubtful, tell, leave):
            asked.append(step)
            result = Verify.Result(verdict=Verify.Result.PASSED, reason="numbers", steps=[made])
            return result, (("gains", "kc 0.5"), *found_entries(result)), []

    monkeypatch.setattr(gains_page, "Proof", Made)
    gains._tuned = object()
    wish = replace(CALM, what="prove")
    plan = gains.plan(replace(wish, dry=1))
    assert ("", "moves", "by +0.5 y") in plan.lines and plan.form[0]["values"] == [0.5]
    refused = gains.plan(replace(wish, dry=2, step=3.0))
    assert "expected from -1 to 1 y" in refused.refusal and refused.refused == "step"
    gains.do(replace(wish, step=-0.7))
    # computed once, for two plans and the proof itself
    assert (asked, len(computed)) == ([-0.7], 1)
    assert live.snapshot.status.startswith("proof passed")
    names = dict(subject.case.proof)
    assert names["gains"] == "kc 0.5"
    assert names["verdict"].startswith("passed") and subject.case.proof == live.snapshot.proof
