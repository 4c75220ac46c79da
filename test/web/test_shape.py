# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The page's numbers are those of `replay`, and its curves those of an exact simulation."""

import argparse
import json
import shlex
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from analysed import analysed_once
from served import REPOSITORY, analysed, subject_of

from relay_autotune import tuning
from relay_autotune.cli import arguments, replay
from relay_autotune.cli.arguments import as_typed
from relay_autotune.control.controller import simulate_closed_loop
from relay_autotune.errors import TuningError
from relay_autotune.loop.laws import OWN_LAW
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome
from relay_autotune.report.case import Case, given_model
from relay_autotune.report.frequency import shown_load
from relay_autotune.result import Shaping
from relay_autotune.tuning import Designed, designed, judged, task_of_model
from relay_autotune.tuning.task import DesignOptions
from relay_autotune.verdict import NOT_JUDGED, Verdict
from relay_autotune.web import wire
from relay_autotune.web.shape import DesignRequest, PageModel, asked_of


@pytest.fixture(scope="module")
def analysis():
    return analysed()


@pytest.fixture(scope="module")
def subject(analysis):
    return subject_of(analysis)


@pytest.mark.long
@pytest.mark.parametrize(
    "asked",
    [
        DesignRequest("simc", setpoint_weight=0.25),
        DesignRequest(
            controller="pi", law="pid_controller", sample_period=0.5, setpoint_weight=0.5
        ),
        DesignRequest(controller="pid", ms=1.7, noise_share=0.02),
    ],
)
def test_gains_and_verdict_are_those_of_an_analysis_with_the_same_options(
    analysis, subject, asked
):
    options = asked.options(DesignOptions())
    expected = analysed_once(analysis.record, rule=asked.rule, options=options, alone=True)
    found = subject.shaped(asked)
    assert found.gains == expected.best_gains
    assert found.judgement == expected.judgement


def given(model: TransferFunction) -> PageModel:
    given = given_model(model)
    case = Case("a model", models=(given,), model=given)
    return PageModel(case, Shaping(task_of_model(model)), DesignRequest(), lambda _: "tune")


@pytest.mark.long
@pytest.mark.parametrize(
    "model",
    [
        TransferFunction.fopdt(1.65, 20.0, 10.0),
        TransferFunction.fopdt(-0.4, 3.0, 6.0),
        TransferFunction(0.05, time_constants=(4.0,), integrators=1, dead_time=2.0),
    ],
    ids=["lag", "negative", "integrating"],
)
def test_the_steps_are_those_of_an_exact_simulation(model):
    found = given(model).shaped(DesignRequest(ms=1.6))
    steps, gains = found.steps, found.gains
    period = steps.load_time / 2000.0
    exact = simulate_closed_loop(
        gains, model, period=period, duration=2.0 * steps.load_time, setpoint=1.0,
        load=steps.load, load_time=steps.load_time,
    )  # fmt: skip
    assert steps.load == shown_load(gains, model)
    expected = np.interp(steps.time, exact.time, exact.measurement)
    assert np.max(np.abs(steps.measurement - expected)) < 0.02
    later = steps.time > 0.02 * steps.load_time
    expected = np.interp(steps.time, exact.time, exact.command)
    assert np.median(np.abs(steps.command - expected)[later]) < 0.01 * np.ptp(exact.command)
    assert steps.low.size == 0


@pytest.mark.long
def test_the_band_holds_most_models_and_the_model_itself(subject):
    found = subject.shaped(DesignRequest())
    steps = found.steps
    assert np.all(steps.low <= steps.high)
    inside = (steps.low <= steps.measurement) & (steps.measurement <= steps.high)
    assert np.mean(inside) > 0.9
    assert 0.0 < np.max(steps.high - steps.low) < 0.1


@pytest.mark.long
def test_calmer_gains_are_slower_and_all_positions_are_asked_once(subject):
    calm, fast = subject.shaped(DesignRequest(ms=1.2)), subject.shaped(DesignRequest(ms=2.0))
    assert calm.gains.ms < fast.gains.ms
    assert calm.gains.iae_load > fast.gains.iae_load
    positions = list(subject.positions(DesignRequest(ms=1.6)))
    assert len(set(positions)) == len(positions) == 3 * 41
    # from end to end first, then what is near
    assert {p.ms for p in positions[:6]} == {1.2, 1.36, 1.52, 1.68, 1.84, 2.0}
    assert positions[6].ms == 1.6
    assert {p.ms for p in positions[7:9]} == {1.58, 1.62}
    known = subject.trade_off(DesignRequest())
    assert {calm.gains.ms, fast.gains.ms} <= {gains.ms for gains in known}
    assert subject.trade_off(DesignRequest(law="px4_rate")) == []


def test_a_sketch_comes_near_to_the_gains_that_are_then_found(analysis):
    subject = subject_of(analysis)
    asked = [DesignRequest(controller="pi", ms=ms) for ms in (1.3, 1.46, 1.38)]
    assert subject.sketched(asked[2]) is None
    ends = [subject.shaped(each).gains.kc for each in asked[:2]]
    sketch = subject.sketched(asked[2])
    assert sketch.judgement == NOT_JUDGED
    assert ends[0] < sketch.gains.kc < ends[1]
    exact = subject.shaped(asked[2]).gains
    known = subject.sketched(asked[2]).gains
    assert (known.kc, known.ti, known.ms) == pytest.approx((exact.kc, exact.ti, exact.ms))
    assert sketch.gains.kc == pytest.approx(exact.kc, rel=0.03)
    assert sketch.gains.ti == pytest.approx(exact.ti, rel=0.03)
    assert subject.sketched(replace(asked[2], law="pid_controller", sample_period=0.5)) is None
    assert subject.sketched(replace(asked[2], rule="simc", ms=1.4)) is None


def test_our_own_law_is_compared_with_the_weight_that_is_asked_for(analysis):
    task = analysis.shaping.task
    options = replace(task.options, law="pid_controller", controller="pi", setpoint_weight=0.3)
    task = replace(task, options=options, models=())
    found = designed(task, "robust")
    own = judged(replace(task, options=replace(options, law=OWN_LAW)), Designed(
        "robust", found.own, "", None))  # fmt: skip
    seen = []

    def look(law, performance, attained):
        seen.append(attained)
        return ()

    tuning.cost_of, before = look, tuning.cost_of
    try:
        judged(task, found)
    finally:
        tuning.cost_of = before
    assert seen[0].overshoot == own.overshoot
    assert own.b == 0.3


def test_an_aborted_experiment_gives_no_gains(analysis):
    aborted = analysed_once(replace(analysis.record, outcome=Outcome.ABORTED, reason="a button"))
    assert aborted.shaping is None
    shown = subject_of(aborted)
    with pytest.raises(TuningError, match="aborted"):
        shown.shaped(DesignRequest())
    assert wire.of_subject(shown)["may_shape"] is False
    assert wire.of_subject(shown)["verdict"]["tone"] == "bad"


def test_what_goes_to_the_browser_is_json_with_the_words_of_the_report(subject):
    shaped = subject.shaped(DesignRequest())
    document = json.loads(wire.to_text(wire.of_shaped(subject, shaped)))
    assert float(document["steps"]["load"]) == pytest.approx(shaped.steps.load, rel=5e-3)
    assert document["isa"][0][:3] == ["kc", f"{shaped.gains.kc:.4f}", "u/y"]
    assert document["verdict"]["text"] == "gains ready to use"
    assert len(document["checks"]) == len(shaped.judgement.findings)
    assert len(wire.to_text(document)) < 100_000
    assert shaped.judgement.verdict is Verdict.TRUSTED


def test_no_number_that_json_does_not_know_goes_out():
    found = given(TransferFunction(0.05, integrators=1, dead_time=2.0))
    text = wire.to_text(wire.of_shaped(found, found.shaped(DesignRequest(controller="pi"))))
    assert not {"NaN", "Infinity"} & set(text.replace(":", " ").replace(",", " ").split())
    assert wire.to_text(wire.of_subject(found))


@pytest.mark.parametrize(
    "fields",
    [None, [], {"rule": "none"}, {"rule": ["simc"]}, {"controller": {}}, {"ms": "1"},
     {"ms": True}, {"ms": float("nan")}, {"ms": 9}, {"setpoint_weight": -1}, {"law": "none"},
     {"law": 3}, {"sample_period": -1}, {"noise_share": "1"}, {"noise_share": float("nan")}],
)  # fmt: skip
def test_what_cannot_be_asked_is_refused(fields):
    with pytest.raises(TuningError):
        asked_of(fields)


def test_the_command_line_that_is_shown_gives_the_same_again(tmp_path):
    parser = replay._parser()
    bag = str(REPOSITORY / "bags" / "biased_relay")
    joints = ["--joint", "left", "--joint", "right"]
    options = parser.parse_args(["--web", "--pi", "--present", "0.4", "20", "0", *joints, bag])
    asked = vars(DesignRequest("robust", "pid", 1.62, 0.3))
    typed = as_typed(options, web=None, web_address=None, **asked)
    words = shlex.split(typed)
    assert words[0] == "replay"
    again = parser.parse_args(words[1:])
    assert (again.controller, again.ms, again.setpoint_weight) == ("pid", 1.62, 0.3)
    assert again.present == [0.4, 20.0, 0.0]
    assert again.bags == [bag]
    # The second one had stood alone, where it is another recording.
    assert again.joint == ["left", "right"]
    assert not again.web


@pytest.mark.long
def test_a_command_without_the_page_loads_nothing_of_it():
    code = (
        "import sys; from relay_autotune.cli import replay, tune; "
        "tune.main(['--gain', '1.65', '--time-constants', '20', '--dead-time', '10']); "
        "replay.main(['no_such_bag']); "
        "sys.exit(any(n.split('.')[0] == 'tornado' or n.startswith('relay_autotune.web') "
        "for n in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_a_missing_package_is_named_before_any_work(monkeypatch, capsys):
    monkeypatch.setattr(arguments.importlib.util, "find_spec", lambda name: None)
    assert replay.main(["--web", "no_such_bag"]) == 1
    assert "pip install tornado" in capsys.readouterr().err


def test_the_page_of_many_processes_is_refused(capsys):
    assert replay.main(["--web", "--jobs", "2", "bags/biased_relay"]) == 2
    assert "--web cannot be combined" in capsys.readouterr().err
    assert isinstance(replay._parser(), argparse.ArgumentParser)
