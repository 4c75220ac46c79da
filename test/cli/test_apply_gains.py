# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What apply_gains shows: gains side by side, and a verdict in few lines."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus

from relay_autotune.cli import apply_gains, tune_loop
from relay_autotune.cli.apply_gains import Entries, found_entries, verified
from relay_autotune.cli.gains_page import GainsPage
from relay_autotune.cli.table import beside
from relay_autotune.cli.terminal import labelled
from relay_autotune.cli.tuned import Proof, Tuned
from relay_autotune.control.controller import Control, PredictedLoop, Step
from relay_autotune.control.step_choice import StepChoice, StepRange
from relay_autotune.control.verification import plan
from relay_autotune.errors import LoopError, TuningError
from relay_autotune.exchange.messages import fill_gains, fill_reason, why_doubtful
from relay_autotune.loop.analysis import performance_beside
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.sampled import Limits
from relay_autotune.nodes import gains_client
from relay_autotune.nodes.gains_client import GainsClient, StepsHere
from relay_autotune.nodes.loop_client import GoneError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import Code
from relay_autotune.record.record import Record, RelaySettings
from relay_autotune.text import duration
from relay_autotune.tuning import design
from relay_autotune.tuning.task import DesignOptions, DesignTask
from relay_autotune.verdict import Verdict
from relay_autotune.web.live import PROVE, VERIFY, Live, PageCommand
from relay_autotune_msgs.action import Tune, Verify
from relay_autotune_msgs.msg import PidGains, Verification
from relay_autotune_msgs.msg import TransferFunction as TransferFunctionMessage

MODEL = TransferFunction.fopdt(1.65, 1.0, 0.5)
GAINS = design(DesignTask(model=MODEL, options=DesignOptions()), "imc")
MESSAGE = PidGains()
fill_gains(MESSAGE, GAINS, experiment_id="x")
MESSAGE.verdict = PidGains.VERDICT_TRUSTED


def nothing_before(service: str) -> str:
    """Answer as a node that has no gains to go back to."""
    raise LoopError(f"~/{service} refuses: there are no gains before these to go back to")


def verdict_entries(
    result: Any, present: Controller | None, ask: Callable[[str], str] = nothing_before
) -> Entries:
    """Return what is told of a verification, after which gains are in force."""
    client: Any = SimpleNamespace(in_force=lambda: present, prove=lambda *words: result, ask=ask)
    return verified(client, 0.5, print, lambda: False, None)[1]


def laid_out(entries: Entries, columns: int) -> list[str]:
    """Return the lines that a terminal of some columns shows."""
    return [line for entry in entries for line in labelled(*entry, columns)]


def step(**values: Any) -> Any:
    known = dict(
        kind=Verification.SETPOINT, step=0.5, passed=True, reason="as predicted",
        overshoot=0.1, overshoot_predicted=0.11, settling_time=3.8, settling_time_predicted=4.2,
        gain_ratio=0.96, ms=1.37, ms_predicted=1.39, time=[0.0, 1.0], measurement=[1.0, 2.0],
        command=[0.0, 0.0], predicted=[1.0, 2.0],
    )  # fmt: skip
    return Verification(**(known | values))


def test_old_and_new_gains_stand_side_by_side_with_what_they_do() -> None:
    slow = Controller(0.1, 3.0)
    lines = beside(slow, GAINS, MODEL)
    text = "\n".join(lines)
    assert f"{GAINS.kc:.4g}"[:5] in text and "0.1000" in text
    # The error after a unit load step is ti/kc where the loop does not overshoot.
    error = next(line for line in lines if "error after a load step" in line)
    assert float(error.split()[5]) == pytest.approx(3.0 / 0.1, rel=1e-3)
    assert float(error.split()[6]) == pytest.approx(GAINS.iae_load, rel=1e-2)


@pytest.mark.long
@pytest.mark.parametrize("law", ["oscat_ft_pid", "control_toolbox_legacy", "simple_pid"])
def test_the_same_gains_do_the_same_by_the_law_of_the_new_ones(law: str) -> None:
    """Continuously their overshoot and Ms were others: the comparison told a change of nothing."""
    options = DesignOptions(law=law, sample_period=0.3, loop_delay=0.1)
    new = design(DesignTask(model=MODEL, options=options), "robust")
    same = Controller(new.kc, new.ti, new.td)
    found = performance_beside(same, new, MODEL, options.added_delay)
    assert found is not None
    assert (found.ms, found.overshoot) == pytest.approx((new.ms, new.overshoot), rel=1e-3)


def test_gains_that_are_missing_or_unstable_are_told_as_such() -> None:
    assert "none" in "\n".join(beside(None, GAINS, MODEL))
    wild = "\n".join(beside(Controller(50.0, 0.1), GAINS, MODEL))
    assert wild.count("unstable") == 5
    assert "the present gains make the loop unstable on the model" in wild
    assert "would not" not in wild


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (Controller(-0.5, 25.0), "kc = 0.5, ti = 25 s would not: is the sign of kc another one?"),
        (Controller(0.5, 0.02), "ti = 1.2 s would not: are ti and td in minutes, not in seconds"),
    ],
)
def test_a_slip_in_the_present_gains_is_asked_about(typed: Controller, meant: str) -> None:
    assert meant in " ".join(" ".join(beside(typed, GAINS, MODEL)).split())


def test_a_verdict_has_five_lines() -> None:
    load = step(kind=Verification.LOAD, step=0.3, gain_ratio=1.01)
    result = Verify.Result(
        verdict=Verify.Result.PASSED, reason="long numbers", steps=[step(), load]
    )
    asked: list[str] = []
    present = Controller(0.6, 0.75, 0.2, 0.02)
    lines = laid_out(verdict_entries(result, present, lambda s: asked.append(s) or "kc 0.3"), 120)
    assert (len(lines), asked) == (5, ["before"])
    assert "passed: the loop does what the model predicts" in lines[0]
    told = "overshoot 10 % (predicted 11 %), settled within 5 % after 3.8 s (predicted 4.2 s)"
    assert f"+0.5 y: {told}" in lines[1]
    assert "+0.3 u" in lines[2]
    assert "gain 0.96 and 1.01 times the model's, Ms 1.37 and 1.37 (predicted 1.39)" in lines[3]
    assert "kc 0.6000, ti 0.7500, td 0.2000; apply_gains --revert" in lines[4]
    # the way back is named only where there is one
    assert laid_out(verdict_entries(result, present), 120)[4].endswith("td 0.2000")


def test_in_noise_a_proof_says_how_far_it_moves_the_overshoot_and_widens_the_band() -> None:
    """A step was said to be within 5 % long before it could be: noise was taken from its error."""
    noisy, load = step(), step(kind=Verification.LOAD, step=0.3)
    wide = Code.AS_PREDICTED(numbers="numbers").plus(settled_band=0.11)
    for each in (noisy, load):
        fill_reason(each.why, wide)
    result = Verify.Result(
        verdict=Verify.Result.PASSED, reason="long", steps=[noisy, load, step()]
    )
    found = dict(enumerate(text for _, text in found_entries(result)))
    told = (
        "overshoot 10 +- 6 % (predicted 11 %), settled within 11 % after 3.8 s (predicted 4.2 s)"
    )
    assert found[1] == f"+0.5 y: {told}"
    assert found[2] == f"+0.3 u: {told}"
    assert "overshoot 10 % (predicted 11 %), settled within 5 % after" in found[3]


def test_the_gain_of_the_process_has_its_uncertainty_where_the_noise_is_known() -> None:
    noisy = step(gain_ratio=1.04)
    fill_reason(noisy.why, Code.AS_PREDICTED(numbers="numbers").plus(gain_uncertainty=0.062))
    result = Verify.Result(verdict=Verify.Result.PASSED, reason="long", steps=[step(), noisy])
    lines = laid_out(found_entries(result), 120)
    assert "gain 0.96 and 1.04 +- 0.06 times the model's" in lines[3]


def test_what_passed_close_to_a_limit_is_called_narrow() -> None:
    close = step()
    narrow = "the gain is 0.66 times the model's, 0.6 to 1.7 passes"
    fill_reason(close.why, Code.NARROWLY(narrow=narrow, numbers="numbers"))
    result = Verify.Result(verdict=Verify.Result.PASSED, reason="long", steps=[step(), close])
    first = laid_out(verdict_entries(result, None), 99)[0]
    assert first.split(maxsplit=1)[1] == (
        "passed, narrowly: the gain is 0.66 times the model's, 0.6 to 1.7 passes"
    )


def test_a_verdict_that_failed_says_why_and_which_gains_are_back() -> None:
    failed = Verify.Result(
        verdict=Verify.Result.FAILED, reason="it settles later; kc 0.1 in force again"
    )
    fill_reason(failed.why, Code.NOT_AS_PREDICTED(problems="it settles later", numbers="numbers"))
    text = "\n".join(laid_out(verdict_entries(failed, Controller(0.1, 3.0)), 60))
    assert "failed: it settles later" in text
    assert "kc 0.1000" in text and "--revert" not in text
    assert "the command is held" in "\n".join(laid_out(verdict_entries(failed, None), 60))


def test_a_proof_that_is_cut_short_is_not_said_to_have_failed() -> None:
    why = Code.INTERFERED(sentence="the set-point was changed to 43 by another node")
    ended = Verify.Result(reason=str(why))
    fill_reason(ended.why, why)
    assert found_entries(ended) == (("verdict", f"none: {why}"),)


@dataclass(frozen=True)
class StepsWithin:
    """Steps that a node allows up to a height; the usual one is higher."""

    high: float

    @property
    def allowed(self) -> StepRange:
        return StepRange(-1.5, self.high)

    @property
    def step(self) -> float:
        return self.allowed.nearest(3.0)

    def plan(self, step: float) -> tuple[tuple[str, str], ...]:
        self.allowed.require(step)
        return (("expected", f"The command goes to {step:g} u."),)


def test_a_step_beyond_the_limits_is_refused_before_anything_changes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []
    client: Any = SimpleNamespace(
        in_force=lambda: None, identified=lambda: (MODEL, 0.01),
        newest=lambda: MESSAGE, has=lambda gains: False, prove=asked.append,
        steps=lambda gains: StepsWithin(2.0 if gains == GAINS else 0.0),
        name="controller_node",
    )  # fmt: skip
    given = apply_gains._parser().parse_args(["--yes", "--step", "2.5"])
    with pytest.raises(TuningError, match=r"is 2.5 y, expected from -1.5 to 2 y"):
        apply_gains.apply_and_verify(client, given)
    # The usual step is made smaller, and another is asked for until it is within.
    given = apply_gains._parser().parse_args([])
    answers = ["-1.6", "n"]
    monkeypatch.setattr("relay_autotune.cli.terminal._await_line", lambda shown: None)
    monkeypatch.setattr("builtins.input", lambda: answers.pop(0))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    assert apply_gains.apply_and_verify(client, given) == (False, "")
    told = capsys.readouterr()
    said = " ".join(told.out.split())
    assert "a step of the set-point by 2 y? The command goes to 2 u." in said
    assert "from -1.5 to 2 y" in told.err
    assert not asked and not answers


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--no-verify", "--step", "1"), "--step and --load are those of the proof"),
        (("--revert", "--load", "0.5"), "--step and --load are those of the proof"),
        (("--load", "0"), "argument --load: expected a step up or down, found 0"),
        (("--wait", "-1"), "--wait is -1, expected at least 0 s"),
    ],
)
def test_what_has_no_effect_is_refused(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        apply_gains.main(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("program", [apply_gains, tune_loop])
def test_a_step_by_nothing_is_refused(program: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """It made the step of the usual height."""
    with pytest.raises(SystemExit) as ended:
        program.main(["--step", "0"])
    assert ended.value.code == 2
    assert "argument --step: expected a step up or down, found 0;" in capsys.readouterr().err


def test_doubtful_gains_say_why_and_so_do_those_without_a_verdict() -> None:
    """A tune took gains without a verdict for trusted."""
    for kind in (PidGains, TransferFunctionMessage, Tune.Result):
        assert why_doubtful(kind(verdict=int(Verdict.TRUSTED))) == ""
        assert why_doubtful(kind()) == "no verdict was given"
        doubtful = kind(verdict=int(Verdict.DOUBTFUL), verdict_reason="the data drift")
        assert why_doubtful(doubtful) == "the data drift"
    unknown: Any = SimpleNamespace(client=None, options=None)
    tune = Tuned(unknown)
    tune.result = Tune.Result(gains=MESSAGE)
    assert tune.doubt == "no verdict was given"


def test_without_a_record_of_a_tune_the_node_alone_refuses_a_step() -> None:
    unknown, given = StepsHere(None, 0.0), StepsHere(None, -0.5)
    with pytest.raises(LoopError, match="the height of the step is not known: give --step"):
        assert unknown.step
    assert given.step == -0.5
    plan = dict(unknown.plan(1e6))
    assert plan["moves"].startswith("The set-point steps by +1e+06 y and back")
    assert "expected" not in plan and "come back" in plan["if it fails"]
    with pytest.raises(TuningError, match="expected other than 0"):
        unknown.plan(0.0)


def test_a_proof_says_what_happens_if_it_fails_and_then_holds_no_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a step that ran away the command stood where it was, for the time of a settling."""
    record = Record(
        time=0.1 * np.arange(401.0), measurement=np.full(401, 40.0), command=np.full(401, 2.0),
        settings=RelaySettings(40.0, 2.0, 1.0), noise_std=0.0, cycle_start=(0, 200, 400),
    )  # fmt: skip
    result = Tune.Result(gains=MESSAGE)
    result.transfer_function = TransferFunctionMessage(
        structure="general", numerator=[1.65], denominator=[1.0, 1.0], dead_time=0.5
    )
    options = SimpleNamespace(
        within=(30.0, 50.0), command_within=(0.0, 5.0), step=0.5, measurement="/level",
        command="/valve",
    )  # fmt: skip
    loop = SimpleNamespace(options=options, client=None)
    tune: Any = SimpleNamespace(result=result, record=record, options=options, loop=loop)
    proof = Proof(tune)
    assert dict(proof.plan(proof.step))["if it fails"] == (
        "If it fails, or /level leaves 30 to 50 y or moves 3 times as far as predicted, it ends "
        "there: /valve goes to 2 u."
    )
    did: list[str] = []
    for verdict in (Verify.Result.FAILED, Verify.Result.PASSED):
        node = SimpleNamespace(
            find=lambda *_: None, steps_of=lambda _: [],
            prove=lambda *_, v=verdict: did.append("proof") or Verify.Result(verdict=v),
            let_settle=lambda *_: did.append("settles"),
        )  # fmt: skip
        monkeypatch.setattr(proof, "_started", lambda _, node=node: nullcontext(node))
        proof.made(proof.step, False, lambda _: None, lambda: False)
    assert did == ["proof", "proof", "settles"]


def test_a_plan_counts_the_time_in_which_the_loop_settles_with_new_gains() -> None:
    """The node waits for 1.5 settling times of new gains, then makes a step; 6 s were left out."""
    record = Record(
        time=0.1 * np.arange(401.0), measurement=np.full(401, 40.0), command=np.full(401, 2.0),
        settings=RelaySettings(40.0, 2.0, 1.0), noise_std=0.0, cycle_start=(0, 200, 400),
    )  # fmt: skip
    limits = Limits(0.0, 80.0), Limits(0.0, 5.0)
    present = Controller(GAINS.kc, GAINS.ti, GAINS.td, GAINS.tf, GAINS.b)
    step = plan(PredictedLoop(Control(GAINS), MODEL), Step(setpoint=1.0), 0.1).duration
    for gains, settling in ((GAINS, 1.5 * GAINS.settling_time), (present, 0.0)):
        choice = StepChoice(record, PredictedLoop(Control(gains), MODEL), *limits, 0.0)
        told = dict(StepsHere(choice, 0.0).plan(0.5))["expected"]
        assert told.endswith(f" u; it takes about {duration(settling + step)}.")


def client_of(prove: Any, in_force: Any) -> Any:
    return SimpleNamespace(
        in_force=in_force, identified=lambda: (MODEL, 0.01),
        newest=lambda: MESSAGE, has=lambda gains: in_force() == gains,
        steps=lambda gains: StepsHere(None, 0.0), name="controller_node", prove=prove,
        allowing=lambda **least: nullcontext(),
    )  # fmt: skip


def test_ctrl_c_in_a_proof_ends_it_and_the_last_line_says_what_is_in_force(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The signal is noted, and obeyed when the node has taken the gains back."""

    def prove(step: float, load: float, wait: float, tell: Any, leave: Any, new: Any) -> None:
        assert new is MESSAGE and not leave()
        os.kill(os.getpid(), signal.SIGINT)
        assert leave()
        raise LoopError("cancelled; kc 0.1 in force again")

    given = apply_gains._parser().parse_args(["--yes", "--step", "0.5"])
    with pytest.raises(KeyboardInterrupt):
        apply_gains.apply_and_verify(client_of(prove, lambda: None), given)
    assert capsys.readouterr().err.endswith("cancelled; kc 0.1 in force again\n")


def test_what_a_node_allows_is_raised_until_the_end_of_a_block() -> None:
    before = {"accept_doubtful": False, "verify_step_max": 0.5}
    there = dict(before)
    client: Any = GainsClient.__new__(GainsClient)
    client.name = "/controller_node"
    client.values = lambda node, names: {name: there[name] for name in names}
    client.set_values = lambda node, values: there.update(values)
    is_ready = [True]
    client._action = SimpleNamespace(server_is_ready=lambda: is_ready[-1])
    with client.allowing(accept_doubtful=True, verify_step_max=0.2):
        assert there == {"accept_doubtful": True, "verify_step_max": 0.5}
    assert there == before
    with pytest.raises(LoopError, match="cancelled"), client.allowing(verify_step_max=2.0):
        assert there == before | {"verify_step_max": 2.0}
        raise LoopError("cancelled")
    assert there == before
    with pytest.raises(GoneError), client.allowing(verify_step_max=2.0):
        raise GoneError("it hangs, and comes back")
    assert there == before
    with pytest.raises(GoneError), client.allowing(verify_step_max=2.0):
        is_ready.append(False)
        # Its answer would be waited for in vain.
        client.set_values = None
        raise GoneError("it has gone")


def test_where_a_node_is_lost_the_gains_go_back_and_it_is_not_waited_for() -> None:
    """Its service is there for a while after its end, and why it was lost ends each wait."""
    places, written = {"kc": "p", "ti": "i", "td": "d"}, []
    there = {"verify_step_max": 0.0, "p": 0.1, "i": 3.0, "d": 0.0}
    client: Any = GainsClient.__new__(GainsClient)
    client.name, client.why_lost, client.left_behind = "/own", lambda: "killed", ""
    client._action = SimpleNamespace(server_is_ready=lambda: True)
    client._there = lambda: ("/other", places)
    client.values = lambda node, names: {name: there[name] for name in names}

    def set_values(node: str, values: Any) -> None:
        there.update(values)
        written.append((node, client.why_lost()))

    def verified(*_: object) -> None:
        there["p"] = 0.2
        raise GoneError(client.why_lost())

    client.set_values, client._verified = set_values, verified
    with pytest.raises(GoneError, match=r"^killed; /other has .*p 0\.1, as before$"):
        client.prove(0.5, 0.0, 60.0, lambda _: None)
    assert written == [("/own", "killed"), ("/other", ""), ("/own", "killed")]


def test_gains_that_are_on_their_way_to_the_node_are_no_reason_to_be_told() -> None:
    reasons = [Code.NONE_WAIT(), Code.NO_CLOCK()]
    client: Any = GainsClient.__new__(GainsClient)
    client.name, client.wait = "/controller_node", lambda *_: None
    client._sent = lambda *_: None

    def ended(*_: object) -> Any:
        result = Verify.Result(verdict=Verify.Result.PASSED)
        if not reasons:
            return SimpleNamespace(status=GoalStatus.STATUS_SUCCEEDED, result=result)
        fill_reason(result.why, why := reasons.pop(0))
        result.reason = str(why)
        return SimpleNamespace(status=GoalStatus.STATUS_ABORTED, result=result)

    client._ended = ended
    told: list[str] = []
    assert client._verified(Verify.Goal(), told.append, lambda: False).verdict
    assert told == [f"waiting: {Code.NO_CLOCK()}"]


def test_a_proof_that_has_made_no_step_is_not_waited_for() -> None:
    client: Any = GainsClient.__new__(GainsClient)
    client.latched = lambda *_: pytest.fail("it would wait for 5 s")
    assert client.steps_of(Verify.Result()) == []


def test_new_gains_that_could_not_be_taken_back_are_told_as_such(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ended = Verify.Result(reason="no measurement for 2 s")
    told_of_it = False, "ended without a verdict: no measurement for 2 s"
    given = apply_gains._parser().parse_args(["--yes", "--step", "0.5"])
    present: list[Any] = [Controller(0.1, 3.0)]
    client = client_of(lambda *words: present.append(GAINS) or ended, lambda: present[-1])
    assert apply_gains.apply_and_verify(client, given) == told_of_it
    told = " ".join(capsys.readouterr().out.split("gains in force")[-1].split())
    assert "these are the new ones, which are not proven" in told
    present[:] = [Controller(0.1, 3.0)]
    client = client_of(lambda *words: present.append(None) or ended, lambda: gone(present))
    assert apply_gains.apply_and_verify(client, given) == told_of_it
    told = " ".join(capsys.readouterr().out.split())
    assert "gains in force not known: it is gone; before the proof: kc 0.1000, ti 3.000" in told


def gone(present: list[Any]) -> Any:
    if present[-1] is None:
        raise LoopError("it is gone")
    return present[-1]


def test_the_page_refuses_a_step_beyond_the_limits_before_anything_changes() -> None:
    changed: list[Any] = []
    controller: Any = SimpleNamespace(
        in_force=lambda: Controller(0.1, 3.0), steps=lambda gains: StepsWithin(2.0),
        prove=lambda *words: changed.append(words),
        name="/controller_node", find=lambda patience: None, steps_of=lambda result: [],
        allowing=lambda **least: nullcontext(), has=lambda gains: False,
        require_new=lambda message: GainsClient.require_new(controller, message),
    )  # fmt: skip
    loop: Any = SimpleNamespace(
        proves=False, client=SimpleNamespace(controllers=lambda: ["/controller_node"])
    )
    live = Live("/relay_node")
    page = GainsPage(loop, live, SimpleNamespace(subjects=[]), 0, lambda: False)  # type: ignore[arg-type]
    page._controller = controller
    page._message = lambda wish: None if wish.what == VERIFY else MESSAGE  # type: ignore[method-assign]
    for what in (VERIFY, PROVE):
        refused = page.plan(PageCommand(what, step=-1.6, dry=1))
        assert "is -1.6 y, expected from -1.5 to 2 y" in refused.refusal
        assert refused.refused == "step"
        page.do(PageCommand(what, step=-1.6))
        assert live.snapshot.status == refused.refusal
        # the usual one is as high as allowed, and stands in the field
        usual = page.plan(PageCommand(what, dry=2))
        assert (usual.refusal, usual.form[0]["values"]) == ("", [2.0])
        assert ("", "expected", "The command goes to 2 u.") in usual.lines
        # not a range of the measurement
        assert ("", "steps", StepRange(-1.5, 2.0).words) in usual.lines
    assert not changed
    # a step with gains that are there would take the chart of the one before away
    controller.has = lambda gains: True
    assert page.plan(PageCommand(PROVE, dry=3)).refusal == "these gains are in force already"
    # what takes them back is a button of the page, not another command
    controller.prove = lambda *words: Verify.Result(verdict=Verify.Result.PASSED, steps=[step()])
    page.do(PageCommand(VERIFY, step=1.0))
    assert live.snapshot.proof[-1] == ("gains in force", "kc 0.1000, ti 3.000, td 0")
    controller.prove = lambda *words: Verify.Result(reason="a tune has begun")
    page.do(PageCommand(VERIFY, step=1.0))
    assert live.snapshot.status == "verification ended without a verdict: a tune has begun"


def test_a_command_line_that_does_not_fit_ends_with_two() -> None:
    with pytest.raises(SystemExit) as end:
        apply_gains.main(["--step", "nan"])
    assert end.value.code == 2


def test_two_wishes_at_once_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        apply_gains.main(["--revert", "--file", "gains.yaml"])
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("apply_gains: argument --file: not allowed with argument --revert;")


@pytest.mark.parametrize("agreed", [True, False])
def test_the_gains_before_are_taken_back_after_a_yes(
    agreed: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []

    def ask(what: str) -> str:
        asked.append(what)
        return "kc 0.1 in force again"

    client = SimpleNamespace(find=lambda patience: None, ask=ask)
    monkeypatch.setattr(gains_client, "GainsClient", lambda *_: nullcontext(client))
    monkeypatch.setattr(apply_gains, "agrees", lambda question, yes: agreed)
    with ExitStack() as graph:
        status = apply_gains._work(apply_gains._parser().parse_args(["--revert"]), graph)
    assert (status, asked) == ((0, ["revert"]) if agreed else (1, []))
    out, err = capsys.readouterr()
    assert (out, err) == (
        ("kc 0.1 in force again\n", "") if agreed else ("", "apply_gains: nothing was changed\n")
    )
