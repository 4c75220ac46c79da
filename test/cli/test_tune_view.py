# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What tune_loop shows, from messages alone."""

from __future__ import annotations

import html
import json
import math
import shlex
from argparse import ArgumentParser
from types import SimpleNamespace
from typing import Any

import pytest
from analysed import completed as analysed
from report_cases import only

from relay_autotune.analysis import PARAMETERS, Task, known_from, options_from
from relay_autotune.cli import tune_loop
from relay_autotune.cli.after_tune import AfterTune
from relay_autotune.cli.jobs import add_analysis, add_details, jobs_of
from relay_autotune.cli.report import flags_of
from relay_autotune.cli.tune_view import (
    OUTCOMES,
    STATES,
    Paint,
    check_lines,
    document,
    estimate,
    live_lines,
    log_line,
    next_commands,
    result_lines,
    wants_colour,
)
from relay_autotune.loop.gains import Controller
from relay_autotune.reasons import Code
from relay_autotune.text import duration
from relay_autotune_msgs.action import Tune
from relay_autotune_msgs.msg import PidGains, RelayExperiment, TransferFunction
from relay_autotune_msgs.msg import Reason as ReasonMessage

NAN = math.nan
DEFAULTS = {entry.name: entry.default for entry in PARAMETERS}


def feedback(**values: Any) -> Any:
    """Return a feedback before the first cycle, with other values where given."""
    unknown = dict.fromkeys(
        ("remaining", "period", "amplitude", "ultimate_gain", "ultimate_gain_std"), NAN
    )
    return Tune.Feedback(**(unknown | values))


def cycle(**values: Any) -> Any:
    known = dict(
        state=Tune.Feedback.STATE_RELAY,
        cycle=2,
        progress=0.5,
        elapsed=61.0,
        remaining=35.4,
        period=38.43,
        amplitude=0.7031,
        ultimate_gain=2.3,
        ultimate_gain_std=0.01,
    )
    return feedback(**(known | values))


def model() -> Any:
    return TransferFunction(
        experiment_id="x",
        method="waveform",
        structure="fopdt",
        numerator=[2.0],
        denominator=[4.0, 1.0],
        dead_time=1.5,
        parameters=["gain", "time_constant"],
        std=[0.05, 0.5],
        covariance=[0.0025, 0.0, 0.0, 0.25],
        ci95_low=[1.9, 3.0],
        ci95_high=[2.1, 5.0],
        undetermined=["time_constant"],
        ultimate_gain=2.5,
        ultimate_frequency=1.2,
        fit=0.987,
        warnings=["look twice"],
    )


def result(**values: Any) -> Any:
    return Tune.Result(**(dict(experiment=RelayExperiment(experiment_id="x")) | values))


def completed() -> Any:
    return result(
        outcome=Tune.Result.COMPLETED,
        reason="3 cycles agree",
        transfer_function=model(),
        gains=PidGains(
            experiment_id="x", rule="robust", kc=0.5, ti=4.0, p=0.5, i=0.125, ms_95=NAN
        ),
        bag="/records/x y",
        verdict=Tune.Result.VERDICT_TRUSTED,
    )


def doubtful() -> Any:
    found = completed()
    found.verdict = Tune.Result.VERDICT_DOUBTFUL
    found.verdict_reason = "the cycles differ: look at the valve"
    return found


def test_doubtful_gains_are_marked_and_need_a_parameter_to_be_applied() -> None:
    text = "\n".join(result_lines(doubtful(), False, Paint()))
    assert "verdict          doubtful" in text
    assert "the cycles differ: look at the valve" in text
    assert "DOUBTFUL: see the verdict" in text
    commands = [c for _, c in next_commands(doubtful(), ["/controller_node"])]
    assert commands[-1] == "apply_gains --accept-doubtful"
    assert document(doubtful(), "/relay_node", False)["verdict"] == "doubtful"
    trusted = "\n".join(result_lines(completed(), False, Paint()))
    assert "verdict          trusted" in trusted
    assert "DOUBTFUL" not in trusted
    assert not any("accept" in c for _, c in next_commands(completed(), ["/controller_node"]))


def test_trusted_gains_of_a_model_with_doubts_say_why() -> None:
    found = completed()
    found.gains.ms_95 = 1.47
    text = "\n".join(result_lines(found, False, Paint(), 200))
    assert "not determined" in text and "look twice" in text
    assert "with these gains Ms stays below 1.47 on 95 % of the models" in text
    found.transfer_function.undetermined, found.transfer_function.warnings = [], []
    assert "all the same" not in "\n".join(result_lines(found, False, Paint()))


def test_states_and_outcomes_have_the_names_of_the_constants() -> None:
    for number, name in enumerate(STATES):
        assert getattr(Tune.Feedback, f"STATE_{name.upper()}") == number
    for number, name in enumerate(OUTCOMES):
        assert getattr(Tune.Result, name.upper()) == number


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.26, "0.3 s"),
        (9.94, "9.9 s"),
        (35.4, "35 s"),
        (260.0, "4 min 20 s"),
        (6600, "1 h 50 min"),
    ],
)
def test_a_duration_is_said_in_two_units_at_most(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_an_interval_is_that_of_two_standard_deviations() -> None:
    assert estimate(cycle()) == "K_u 2.300 u/y (95 %: 2.280 to 2.320)"
    assert estimate(cycle(ultimate_gain_std=NAN)) == "K_u 2.300 u/y"
    assert estimate(feedback()) == ""


def test_a_log_has_a_line_for_each_feedback() -> None:
    first = feedback(state=1, elapsed=0.5, status="settling, 0.5 s of about 10 s")
    assert log_line(first) == "     0.5 s  settling, 0.5 s of about 10 s"
    assert log_line(feedback(state=1, elapsed=0.5)) == "     0.5 s  settling"
    told = (
        "    61.0 s  cycle 2, period 38.43 s, amplitude 0.7031 y, "
        "K_u 2.300 u/y (95 %: 2.280 to 2.320), about 35 s left"
    )
    assert log_line(cycle()) == told
    assert log_line(cycle(status="at 3.3"), cycle(cycle=1)) == told
    assert log_line(cycle(status="at 3.3"), cycle()) == "    61.0 s  at 3.3"
    ended = dict(state=Tune.Feedback.STATE_COMPLETED, remaining=0.0)
    for before in (cycle(), cycle(cycle=1)):
        told = log_line(cycle(**ended), before)
        assert told.startswith("    61.0 s  completed, period 38.43 s")
    computing = cycle(**ended, status="computing the model, 1.6 s so far")
    assert log_line(computing, cycle(**ended)) == "    61.0 s  computing the model, 1.6 s so far"


def test_a_terminal_shows_the_same_number_of_lines_at_any_time() -> None:
    """Else what is written again would leave something behind."""
    long = feedback(state=2, status="stepped to 3.3, no response after 6.0 s: " * 9)
    all_states = (feedback(state=1), long, cycle(status="at 3.3"), feedback(state=6))
    shown = [live_lines(f, Paint()) for f in all_states]
    assert {len(lines) for lines in shown} == {6}
    assert "[" not in "".join(shown[2]).replace("\x1b[", "")
    assert "#" * 8 + "-" * 8 in shown[2][0]
    assert "61 s so far, about 35 s left" in shown[2][0]
    assert shown[1][1].strip().startswith("stepped to 3.3, no response after 6.0 s")
    assert shown[1][2].endswith(" ...")
    assert shown[2][1].strip() == "at 3.3"


def test_a_checklist_is_as_wide_as_the_terminal_and_breaks_no_word() -> None:
    check = "NO    limits        " + "a-word " * 20 + "/a/very/long/path" * 4
    lines = check_lines([check, "ok    time          10 s"], 60)
    assert lines[0].startswith("NO    limits        a-word")
    assert all(line.startswith(" " * 20 + "a-word") for line in lines[1:-2])
    assert max(map(len, lines[:-2])) < 60
    assert lines[-2].strip() == "/a/very/long/path" * 4
    assert lines[-1] == "ok    time          10 s"


def test_times_advance_between_feedbacks() -> None:
    line = live_lines(cycle(), Paint(), since=5.0)[0]
    assert "66 s so far, about 30 s left" in line
    assert "left" not in live_lines(cycle(), Paint(), since=50.0)[0]
    # While the model is computed, the time of the tune stands still.
    over = cycle(state=Tune.Feedback.STATE_COMPLETED)
    assert live_lines(over, Paint(), since=0.9) == live_lines(over, Paint())


def test_no_line_is_wider_than_the_terminal() -> None:
    many = model()
    many.denominator = [float(30 - k) for k in range(30)]
    widest = feedback(
        state=5, cycle=12, progress=1.0, elapsed=86399.0, remaining=86399.0, period=1.234e-5,
        amplitude=1.234e-5, ultimate_gain=-1.234e-5, ultimate_gain_std=1e-6,
        transfer_function=many, status="word " * 60,
    )  # fmt: skip
    for shown in (widest, cycle()):
        assert max(map(len, live_lines(shown, Paint(), width=80))) <= 80


def test_the_newest_model_is_shown() -> None:
    assert "2.000 e^(-1.500 s)" in live_lines(cycle(transfer_function=model()), Paint())[5]


def test_colours_are_for_a_terminal_that_wants_them() -> None:
    assert wants_colour(True, {"TERM": "xterm"})
    assert not wants_colour(False, {"TERM": "xterm"})
    assert not wants_colour(True, {"NO_COLOR": "1"})
    assert not wants_colour(True, {"TERM": "dumb"})
    plain = live_lines(cycle(), Paint()) + result_lines(completed(), False, Paint())
    assert "\x1b" not in "".join(plain)
    painted = live_lines(cycle(), Paint(colour=True))
    assert painted[0].count("\x1b[") == 2 * painted[0].count("\x1b[0m") > 0


def test_a_result_has_model_gains_recording_and_what_to_type_next() -> None:
    text = "\n".join(result_lines(completed(), False, Paint()))
    for part in (
        "completed: 3 cycles agree",
        "2.000 e^(-1.500 s) / (1 + 4.000 s)   (fopdt, waveform)",
        "95 %: 1.900 to 2.100",
        "95 %: 3.000 to 5.000   not determined",
        "look twice",
        "kc 0.5000 u/y   ti 4.000 s",
        "/records/x y",
    ):
        assert part in text
    controllers = ("apply_gains --namespace /a", "apply_gains --namespace /b --node pid")
    named = ["/a/controller_node", "/b/pid"]
    commands = [c for _, c in next_commands(completed(), named)]
    assert commands == [
        "report '/records/x y' -o report.html",
        "replay '/records/x y'",
        *controllers,
    ]
    told = {"flags": "--rule imc", "report": "my page.html"}
    commands = [c for _, c in next_commands(completed(), named, **told)]
    assert commands == [
        "xdg-open 'my page.html'",
        "replay '/records/x y' --rule imc",
        *controllers,
    ]


def test_the_flags_of_the_next_command_give_what_the_identifier_was_asked_for() -> None:
    assert flags_of(DEFAULTS) == ""
    told = {
        "method": "chang", "rule": "imc", "known_gain": 1.65, "known_dead_time": 0.5,
        "structure": "lag_n", "order": 3, "loss": "squares", "controller": "pi", "ms": 1.6,
        "mt": 1.5, "law": "pid_controller", "setpoint_weight": 0.5,
        "sample_period": 0.01, "loop_delay": 0.02, "noise_share": 0.2, "filter_ratio": 8.0,
        "closed_loop_time": 2.0, "phase_peak": math.radians(-130.0), "resonance": 3.0,
    }  # fmt: skip
    assert set(told) == set(DEFAULTS)
    values = DEFAULTS | told
    parser = ArgumentParser()
    add_analysis(parser)
    add_details(parser)
    (job,) = jobs_of(parser.parse_args(shlex.split(flags_of(values))), ["bag"])
    assert job.task == Task("chang", "imc", known_from(values), options_from(values))


@pytest.mark.nightly
def test_a_report_of_a_tune_is_what_the_identifier_would_say(monkeypatch, tmp_path) -> None:
    only(monkeypatch, "uncertainty")
    page = str(tmp_path / "page.html")
    tune = completed()
    tune.gains.kc = analysed().best_gains.kc
    present: list[Controller | None] = [None]
    ended: Any = SimpleNamespace(
        result=tune, options=SimpleNamespace(report=page), analysed=analysed,
        loop=SimpleNamespace(present=lambda: present[0], title="x"),
    )  # fmt: skip
    assert AfterTune._write_report(ended, "") == ""
    told = (tmp_path / "page.html").read_text()
    assert "Gains to type in" in told
    assert f"report '{tune.bag}' -o {page}" in html.unescape(told)
    assert "Beside the present gains" not in told
    tune.gains.kc *= 1.1
    present[0] = Controller(0.1, 3.0)
    assert "identifier_node gave" in AfterTune._write_report(ended, "")
    told = html.unescape((tmp_path / "page.html").read_text())
    assert f"report '{tune.bag}' --present 0.1 3 0 -o {page}" in told
    assert "Beside the present gains" in told


def test_a_tune_without_gains_offers_none() -> None:
    why = ReasonMessage(code=Code.CANCELLED)
    stopped = result(outcome=Tune.Result.ABORTED, reason="cancelled", why=why, bag="/records/x")
    left = "the plant is left at the safe command"
    text = "\n".join(result_lines(stopped, True, Paint(), left=left))
    assert "cancelled" in text and "cancelled: cancelled" not in text
    assert "safe command; no gains are given" in text
    assert next_commands(stopped, ["/c"]) == []
    assert document(stopped, "/relay_node", True)["gains"] is None


def test_a_tune_that_was_cancelled_while_its_model_is_computed_says_where_it_was() -> None:
    reason = "the last 3 of 5 cycles agree within 2 %; no pi_gains: cancelled"
    found = result(outcome=Tune.Result.COMPLETED, reason=reason, bag="/records/x")
    first, left, *_ = result_lines(found, True, Paint(), 200, "pid is active")
    assert first.split(maxsplit=1)[1].startswith("cancelled after the relay had ended, before")
    assert left.strip() == "pid is active; no gains are given"


def test_a_reason_that_begins_with_the_outcome_does_not_repeat_it() -> None:
    reason = "cancelled; 3 samples repeat the one before, since the sensor was silent"
    why = ReasonMessage(code=Code.CANCELLED)
    stopped = result(outcome=Tune.Result.ABORTED, reason=reason, why=why, bag="/records/x")
    assert result_lines(stopped, True, Paint())[0].split(maxsplit=1) == ["tune", reason]


def test_a_result_fits_80_columns_and_no_word_is_broken() -> None:
    tune = completed()
    tune.reason = "3 cycles agree within 2 %, allowing for noise; 1 cycle was disturbed " * 2
    tune.transfer_function.warnings = ["look at /home/somebody/records/2026-11-20/of_a_tank " * 3]
    narrow, broad = (result_lines(tune, False, Paint(), columns) for columns in (80, 99))
    assert max(map(len, narrow)) <= 80 < max(map(len, broad)) <= 99
    assert " ".join(narrow).split() == " ".join(broad).split()


def test_the_document_is_json_with_null_for_what_is_not_estimated() -> None:
    found = json.loads(json.dumps(document(completed(), "/tank/relay_node", False)))
    assert found["outcome"] == "completed"
    assert found["gains"]["kc"] == 0.5
    assert found["gains"]["ms_95"] is None
    assert found["transfer_function"]["denominator"] == [4.0, 1.0]
    assert found["transfer_function"]["header"]["frame_id"] == ""


@pytest.mark.parametrize(
    "arguments", [["--amplitude", "-1"], ["--amplitude", "nan"], ["--wait", "-1"], ["--bogus"]]
)
def test_a_command_line_that_does_not_fit_ends_with_two(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        tune_loop.main(arguments)
    assert end.value.code == 2
