# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The page opens without a network, holds every figure, and takes nothing from a bag for HTML."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from analysed import MODEL, completed
from report_cases import aborted, fruitless, only

from relay_autotune.exchange.models import document, model_fields, to_json
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.result import Combination, Rival, identified
from relay_autotune.loop.analysis import Loop, analyse_loop, difference
from relay_autotune.loop.gains import Controller
from relay_autotune.process.structures import (
    FOPDT,
    INTEGRATOR_INVERSE,
    INTEGRATOR_LAG,
    IPDT,
    LAG_COMPLEX,
    LAG_N_ZERO,
    THREE_LAGS,
    TWO_EQUAL_ONE,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
    GivenModel,
    structure_of,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.report.case import (
    Case,
    case_of,
    cases_of_document,
    in_loop,
    read_documents,
    true_value,
)
from relay_autotune.report.figures import PLATES
from relay_autotune.report.findings import (
    Compared,
    compared,
    remarks_of,
    warnings_of,
)
from relay_autotune.report.page import page
from relay_autotune.report.style import COLOURS
from relay_autotune.tuning import tune
from relay_autotune.verdict import Verdict

VOID = {"meta", "br", "link", "img", "input", "hr"}
HOSTILE = "<script>alert(1)</script>\"' onload=x <img src=q>"


class Reader(HTMLParser):
    """Check that elements close in order, and note what a browser would load or address."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.elements: list[str] = []
        self.references: list[str] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        for name, value in attrs:
            assert not name.startswith("on"), f"{tag} has {name}"
            if name == "id":
                self.ids.append(value or "")
            if name in ("href", "src", "xlink:href", "data", "action", "srcset"):
                self.references.append(value or "")
            if value:
                self.references += re.findall(r"url\(([^)]*)\)", value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open and "script" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def read(text: str) -> Reader:
    found = Reader()
    found.feed(text)
    found.close()
    assert found.open == []
    return found


def beside(case: Case) -> list[Compared]:
    return compared(case.present, case.present_does, case.best_gains)


def from_json(analysis) -> Case:
    written = to_json(document("bag", [analysis]))
    (case,) = cases_of_document(json.loads(written), "result.json")
    return case


@pytest.fixture(scope="module")
def whole() -> str:
    """Return the page of an experiment that went well, beside one that gave nothing."""
    return page([case_of(completed(), "tank"), case_of(fruitless(), HOSTILE)])


@pytest.mark.long
def test_it_is_one_well_formed_file_that_loads_nothing(whole: str) -> None:
    found = read(whole)
    assert found.elements.count("html") == 1
    assert all(reference.startswith("#") for reference in found.references)
    assert not re.search(r"https?:|//[a-z]|@import|file:", whole)


def test_ids_are_unique_and_every_reference_has_one(whole: str) -> None:
    found = read(whole)
    assert len(set(found.ids)) == len(found.ids)
    assert {reference[1:] for reference in found.references} <= set(found.ids)


def test_every_figure_is_there_for_broad_and_narrow_screens(whole: str) -> None:
    ids = set(read(whole).ids)
    assert {f"e1-{plate.key}" for plate in PLATES} <= ids
    for plate in PLATES:
        assert any(i.startswith(f"e1-{plate.key}-broad-") for i in ids)
        assert any(i.startswith(f"e1-{plate.key}-narrow-") for i in ids)


def test_the_figure_that_shows_a_load_says_how_to_leave_it_out(whole: str) -> None:
    # A recording cannot be repeated: the verdict alone says to keep other inputs constant.
    assert "a load came: end the record before it with --end" in read(whole).text


def test_colours_are_variables_with_a_value_for_light_and_dark(whole: str) -> None:
    drawings = "".join(re.findall(r"<svg.*?</svg>", whole, re.DOTALL))
    assert not re.search(r"#[0-9a-fA-F]{6}\b", drawings)
    for name, (light, dark) in COLOURS.items():
        assert f"--{name}: {light};" in whole
        assert f"--{name}: {dark};" in whole
    assert set(re.findall(r"var\(--([a-z]+)\)", drawings)) <= set(COLOURS)


def test_the_summary_has_the_gains_the_model_and_how_sure_they_are(whole: str) -> None:
    text, gains = read(whole).text, completed().best_gains
    assert f"kc {gains.kc:#.4g}" in text
    assert f"ti {gains.ti:#.4g}" in text
    assert f"Ms {gains.ms:.2f}" in text
    assert "y stands for the unit of your measurement, u for that of your command" in text
    order = ("What to do", "stands for the unit", "u/y", "Why", "Figures", "How to repeat it")
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    for analysis_model in completed().models:
        assert analysis_model.method in text
    for each in completed().gains:
        assert each.rule in text


@pytest.mark.long
def test_names_and_reasons_from_a_bag_are_text_and_never_html() -> None:
    hostile = replace(aborted(HOSTILE), record=replace(
        aborted(HOSTILE).record, experiment_id=HOSTILE
    ))  # fmt: skip
    model = replace(
        hostile.models[0],
        warnings=(HOSTILE,),
        method=HOSTILE,
        advice=(HOSTILE,),
        combinations=(Combination(HOSTILE, HOSTILE, 1.0, 0.1, 0.8, 1.2),),
    )
    case = case_of(replace(hostile, models=(model, *hostile.models[1:])), HOSTILE)
    text = page([replace(case, record=None, models_around=())], title=HOSTILE)
    found = read(text)
    assert found.elements.count("script") == 1
    assert "img" not in found.elements
    assert found.text.count("alert(1)") >= 8
    assert "&lt;script&gt;" in text


@pytest.mark.parametrize("verdict", list(Verdict))
def test_what_does_not_shake_the_verdict_does_not_head_the_page(
    verdict: Verdict, monkeypatch: pytest.MonkeyPatch
) -> None:
    only(monkeypatch)
    found = completed()
    models = (replace(found.models[0], warnings=("a load step of -0.211 u",)), *found.models[1:])
    case = replace(case_of(replace(found, models=models), "tank"), record=None)
    monkeypatch.setattr(type(case.judgement), "verdict", verdict)
    heads, remarks = warnings_of(case), remarks_of(case)
    assert ("a load step of -0.211 u" in remarks) is (verdict is Verdict.TRUSTED)
    assert ("a load step of -0.211 u" in heads) is (verdict is not Verdict.TRUSTED)
    assert "a load step of -0.211 u" in read(page([case])).text


@pytest.mark.nightly
def test_without_gains_the_reason_stands_in_their_place() -> None:
    case = replace(case_of(aborted(), "tank"), record=None, models_around=())
    found = read(page([case]))
    assert "No gains" in found.text
    assert "the operator pressed the button" in found.text
    assert "model, but no gains" in found.text
    assert "Gains to type in" not in found.text
    assert "e1-closed_loop" not in found.ids
    assert "Closed loop, predicted: there are no gains" in found.text


def test_where_nothing_was_identified_the_experiment_is_drawn_all_the_same(whole: str) -> None:
    found = read(whole)
    assert "e2-experiment" in found.ids
    assert "e2-fit" not in found.ids
    assert "found no response to the command" in found.text
    assert "Model over the data: nothing was identified" in found.text


@pytest.mark.long
def test_a_document_gives_the_same_report_without_what_needs_samples(monkeypatch) -> None:
    case = from_json(completed())
    direct = case_of(completed(), "bag")
    for ours, theirs in zip(case.gains, direct.gains, strict=True):
        assert (ours.rule, ours.reason, ours.form) == (theirs.rule, theirs.reason, theirs.form)
        for name in ("kc", "ti", "td", "tf", "b", "ms", "ms_95", "gain_margin", "iae_load"):
            assert getattr(ours, name) == getattr(theirs, name)
    assert case.best_gains is case.gains[0]
    assert case.model.model == direct.model.model
    for ours, theirs in zip(case.parameters, direct.parameters, strict=True):
        assert (ours.name, ours.unit, ours.low) == (theirs.name, theirs.unit, theirs.low)
        assert ours.value == theirs.value
    assert case.ultimate == direct.ultimate
    assert case.limit_cycle.period == direct.limit_cycle.period
    assert case.models_around == direct.models_around
    assert len(case.models_around) == 100
    assert case.points == direct.points
    assert case.settings == direct.settings
    assert case.samples == len(completed().record)
    there = {plate.key for plate in PLATES if not plate.missing(case)}
    assert there == {"nyquist", "bode", "closed_loop", "rules", "uncertainty"}
    only(monkeypatch, "experiment", "uncertainty")
    found = read(page([case]))
    assert [i for i in found.ids if i.count("-") == 1] == ["e1-uncertainty"]
    assert "The experiment: it needs the samples" in found.text


@pytest.mark.parametrize(
    ("build", "parameters"),
    [
        (lambda v: TransferFunction.fopdt(*v), {"gain": -2.0, "time_constant": 3.0}),
        (
            lambda v: TransferFunction.lag_n(v[0], v[1], 4, v[2]),
            {"gain": 2.0, "time_constant": 3.0},
        ),
        (
            LAG_N_ZERO.of_order(3).build,
            {"gain": 2.0, "time_constant": 3.0, "zero": -0.7},
        ),
        (
            lambda v: TransferFunction.sopdt(v[0], v[1:3], v[4], v[3]),
            {"gain": 2.0, "time_constant_1": 3.0, "time_constant_2": 0.5, "zero": 0.3},
        ),
        (
            lambda v: TransferFunction.oscillator(v[0], v[1], v[2], v[3]),
            {"gain": 2.0, "natural_frequency": 3.0, "damping": 0.3},
        ),
        (
            TWO_EQUAL_ONE.build,
            {"gain": 2.0, "time_constant_1": 3.0, "time_constant_2": 0.5},
        ),
        (
            THREE_LAGS.build,
            {"gain": 2.0, "time_constant_1": 3.0, "time_constant_2": 2.0, "time_constant_3": 1.0},
        ),
        (
            LAG_COMPLEX.build,
            {"gain": 2.0, "time_constant": 3.0, "natural_frequency": 4.0, "damping": 0.3},
        ),
        (IPDT.build, {"gain": 2.0}),
        (INTEGRATOR_LAG.build, {"gain": 2.0, "time_constant": 3.0}),
        (
            INTEGRATOR_INVERSE.build,
            {"gain": 2.0, "inverse_time_constant": 0.4, "time_constant": 3.0},
        ),
        (UNSTABLE_FOPDT.build, {"gain": 2.0, "time_constant": 3.0}),
        (
            UNSTABLE_SOPDT.build,
            {"gain": 2.0, "time_constant_1": 3.0, "time_constant_2": 0.5},
        ),
    ],
    ids=lambda p: "" if callable(p) else "-".join(p),
)
def test_the_models_within_the_uncertainty_are_those_of_the_document(build, parameters) -> None:
    """Whatever the structure: the band of a report is drawn from these models."""
    parameters = parameters | {"dead_time": 0.2}
    values = np.array([*parameters.values()])
    rng = np.random.default_rng(1)
    root = 0.1 * rng.standard_normal((values.size, values.size)) * values[:, None]
    structure = structure_of(build(values), tuple(parameters))
    assert structure.build(values) == build(values)
    other = np.array((math.copysign(1.0, values[0]), 2.0, 1.0))
    found = replace(
        identified("waveform", Estimate.of_root(structure, values, root)),
        rivals=(Rival(Estimate.of(FOPDT, other), 0.1),),
    )
    analysis = replace(fruitless(), models=(found,))
    direct = case_of(analysis, "bag").models_around
    assert len(set(direct)) > 80
    assert from_json(analysis).models_around == direct
    assert {e.value for e in from_json(analysis).parameters} == set(values)


def test_the_band_shows_the_models_on_which_the_gains_were_judged() -> None:
    analysis = completed()
    assert case_of(analysis, "bag").models_around == analysis.shaping.task.models
    assert from_json(analysis).models_around == analysis.shaping.task.models


def test_without_a_covariance_a_document_gives_no_models_around() -> None:
    known = identified("atv", Estimate.of(FOPDT, np.array((2.0, 3.0, 0.2))))
    # A method may tie the dead time to the lags, and only the method knows how.
    structure = GivenModel.of(TransferFunction.lag_n(2.0, 3.0, 2, 0.3), ("gain", "time_constant"))
    tied = identified(
        "thyagarajan", Estimate.of(structure, np.array((2.0, 3.0)), np.eye(2) * 1e-4)
    )
    for found in (known, tied):
        case = from_json(replace(fruitless(), models=(found,)))
        assert case.models_around == ()
        assert [e.value for e in case.parameters] == list(found.values)


def test_a_simulated_process_is_compared_with_the_truth(tmp_path) -> None:
    written = document("bag", [completed()]) | {"truth": model_fields(MODEL)}
    (tmp_path / "result.json").write_text(to_json(written))
    (case,) = read_documents(tmp_path / "result.json")
    truths = {e.name: e.truth for e in (*case.parameters, *case.ultimate)}
    assert truths["gain"] == 1.65
    assert truths["time_constant"] == 20.0
    assert truths["dead_time"] == 10.0
    assert truths["ultimate_frequency"] == pytest.approx(0.1837, abs=1e-4)


def test_the_truth_is_in_the_terms_of_the_structure() -> None:
    unstable = UNSTABLE_FOPDT.build((2.0, 5.0, 0.5))
    names = ("gain", "time_constant", "dead_time", "damping")
    found = [true_value(name, unstable, unstable) for name in names]
    assert found[:3] == [2.0, 5.0, 0.5]
    assert np.isnan(found[3])
    assert np.isnan(true_value("gain", unstable, MODEL))


def test_what_a_controller_may_lack_may_be_left_out(monkeypatch) -> None:
    only(monkeypatch)
    found = completed()
    gains = replace(found.best_gains, kc=-2.814e-05, tf=0.01234, b=0.5)
    text = read(page([case_of(replace(found, gains=(gains,)), "tank")])).text
    for told in ("kc -2.814e-05 u/y", "tf 0.01234 s", "b 0.5000"):
        assert told in text
    assert text.count("leave out where your controller has none") == 2
    plain = replace(gains, tf=0.0, b=1.0)
    text = read(page([case_of(replace(found, gains=(plain,)), "tank")])).text
    assert "leave out" not in text


def test_a_proof_that_was_made_is_told(monkeypatch) -> None:
    only(monkeypatch)
    case = case_of(completed(), "tank")
    assert "Proof by a step" not in read(page([case])).text
    proof = (("gains", "kc 0.5861 u/y, at 13:14"), ("verdict", f"passed {HOSTILE}"))
    found = read(page([replace(case, proof=proof)]))
    assert "Proof by a step of the set-point" in found.text
    assert "kc 0.5861 u/y, at 13:14" in found.text and f"passed {HOSTILE}" in found.text


def test_the_present_gains_stand_beside_the_new_ones_with_what_both_do(monkeypatch) -> None:
    only(monkeypatch)
    case = case_of(completed(), "tank")
    assert "Beside the present gains" not in read(page([case])).text
    weak = Controller(0.5 * case.best_gains.kc, case.best_gains.ti)
    rows = {r.name: (r.present, r.new) for r in beside(replace(case, present=weak))}
    assert float(rows["kc"][0]) == pytest.approx(weak.kc, rel=1e-3)
    expected = analyse_loop(weak, in_loop(case, case.model.model))
    assert float(rows["Ms"][0]) == pytest.approx(expected.ms, rel=1e-2)
    assert float(rows["Ms"][1]) == pytest.approx(case.best_gains.ms, rel=1e-2)
    assert "Beside the present gains" in read(page([replace(case, present=weak)])).text
    wild = replace(case, present=Controller(10.0 * case.best_gains.kc, 1.0))
    assert {r.name: r.present for r in beside(wild)}["overshoot"] == "unstable"
    assert "loop unstable" in read(page([wild])).text
    assert rows["overshoot"][0] == f"{100.0 * expected.overshoot:.0f} %"
    new = case.best_gains
    jumps = [float(text) for text in rows["jump of the command"]]
    assert jumps == pytest.approx([weak.kc, new.kc * new.b], rel=0.01)
    assert float(rows["settling time (2 %)"][1]) == pytest.approx(
        case.best_gains.settling_time, 0.01
    )


def test_what_new_gains_change_is_said_in_words() -> None:
    new = completed().best_gains
    for ms, iae, words in (
        (1.5, 0.5, "calmer but slower"),
        (1.5, 2.0, "calmer and faster"),
        (0.9, 2.0, "less calm but faster"),
        (1.0, 1.0, "as calm and as fast"),
    ):
        present = replace(new, ms=ms * new.ms, iae_load=iae * new.iae_load)
        told = difference(present, present, new, MODEL)
        assert told.startswith(f"the new gains are {words}: Ms {new.ms:.3g} instead of ")
        assert f", {1.0 / iae:.2f} times the error" in told
        assert ("ask for faster ones" in told) == (words == "calmer but slower")
        assert "overshoot" not in told
    told = difference(
        present, replace(present, overshoot=0.02), replace(new, overshoot=0.2), MODEL
    )
    assert told.endswith("of the set-point is 20 instead of 2.0 %: a smaller mt lowers it")


@pytest.mark.parametrize("model", [MODEL, TransferFunction(0.2, (), (), 1, 1.0)], ids=str)
def test_an_error_that_stays_is_not_compared_with_one_that_vanishes(model) -> None:
    kc, duration = 0.3, 2000.0
    alone, new = Controller(kc, 0.0), tune(model, "simc")
    (_, load) = Loop(alone, model).step_responses(duration)
    left = f"{load.measurement[-100]:#.3g}"
    told = difference(alone, analyse_loop(alone, model), new, model)
    assert f"more exact: Ms {new.ms:.3g} instead of " in told
    assert f"a lasting error of 0 instead of {left} y/u after a step of the load" in told
    back = difference(new, new, replace(new, kc=kc, ti=0.0), model)
    assert (
        f"less exact: Ms {new.ms:.3g} instead of {new.ms:.3g}, a lasting error of {left} " in back
    )


def test_it_says_how_to_repeat_the_report_and_the_test(monkeypatch) -> None:
    only(monkeypatch)
    case = replace(case_of(completed(), "tank"), command="report 'my bag' -o tune.html")
    text = read(page([case])).text
    assert "report 'my bag' -o tune.html" in text
    relay = completed().record.settings
    assert f"-p amplitude:={relay.amplitude!r} -p baseline:={relay.baseline!r}" in text
