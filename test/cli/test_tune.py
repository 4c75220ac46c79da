# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The command `tune`: a model in, gains out, and one line where there are none."""

from __future__ import annotations

import io
import json
import math
import re
from pathlib import Path

import pytest
import yaml

from relay_autotune.cli import tune
from relay_autotune.cli.tune import model_of
from relay_autotune.exchange.models import model_fields
from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    INTEGRATOR_LAG,
    IPDT,
    LAG_N_ZERO,
    THREE_LAGS,
    UNSTABLE_FOPDT,
    UNSTABLE_SOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning import RULES, design
from relay_autotune.tuning.compensators import COMPENSATORS
from relay_autotune.tuning.task import DesignOptions, DesignTask

FOPDT = "--gain 1.65 --time-constants 20 --dead-time 10"


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    words = [word for part in arguments for word in part.split(" ")]
    try:
        status = tune.main(words)
    except SystemExit as end:
        status = int(end.code or 0)
    said = capsys.readouterr()
    return status, said.out, said.err


def document(capsys, *arguments: str) -> dict:
    status, out, err = run(capsys, *arguments, "--json")
    assert (status, err) == (0, "")
    return json.loads(out)


def test_gains_of_one_rule(capsys):
    status, out, err = run(capsys, FOPDT, "--rule imc")
    assert (status, err) == (0, "")
    assert "kc 0.8913 u/y   ti 25.00 s" in out
    assert "IMC with lambda = 17 s" in out
    (found,) = document(capsys, FOPDT, "--rule imc")["gains"]
    wanted = design(DesignTask(model=TransferFunction.fopdt(1.65, 20.0, 10.0)), "imc")
    assert found["kc"] == wanted.kc
    assert found["ms"] == wanted.ms
    assert found["i"] == wanted.kc / wanted.ti
    assert found["reason"] == wanted.reason


@pytest.mark.long
def test_all_rules_side_by_side(capsys):
    _, out, _ = run(capsys, FOPDT, "--table")
    for name in RULES:
        assert re.search(rf"^[ *]*{name} ", out, re.MULTILINE), name
    assert max(len(line) for line in out.splitlines()) <= 99
    found = document(capsys, FOPDT, "--table --rule simc")
    assert found["gains"][found["recommended"]]["rule"] == "simc"
    named = {g["rule"] for g in found["gains"]} | set(found["refused"])
    assert named - set(COMPENSATORS) == set(RULES)
    assert "lag" in found["refused"]["lcmax"]
    assert all(math.isfinite(g[name]) for g in found["gains"] for name in ("kc", "ti", "ms"))


def test_what_is_asked_for_reaches_the_rules(capsys):
    flags = (
        "--pid --ms 1.7 --mt 1.3 --sample-period 0.5 --loop-delay 0.25 --noise-std 0.01 "
        "--amplitude 2 --noise-share 0.2 --filter-ratio 8 --lambda 7 --phase-peak -130 "
        "--resonance 3"
    )
    asked = DesignOptions(
        controller="pid",
        ms=1.7,
        mt=1.3,
        sample_period=0.5,
        loop_delay=0.25,
        noise_std=0.01,
        amplitude=2.0,
        noise_share=0.2,
        filter_ratio=8.0,
        closed_loop_time=7.0,
        phase_peak=math.radians(-130.0),
        resonance=3.0,
    )
    (found,) = document(capsys, FOPDT, flags, "--rule imc")["gains"]
    wanted = design(
        DesignTask(model=TransferFunction.fopdt(1.65, 20.0, 10.0), options=asked), "imc"
    )
    assert (found["kc"], found["td"], found["tf"]) == (wanted.kc, wanted.td, wanted.tf)
    drum = (
        "--structure integrator_inverse --gain 0.5 --zeros -0.4 --time-constants 1 --dead-time 1"
    )
    flags = "--phase-peak -130 --resonance 3"
    (found,) = document(capsys, drum, flags, "--rule luyben2003")["gains"]
    asked = DesignOptions(phase_peak=math.radians(-130.0), resonance=3.0)
    model = INTEGRATOR_INVERSE.build((0.5, 0.4, 1.0, 1.0))
    wanted = design(DesignTask(model=model, options=asked), "luyben2003")
    assert (found["kc"], found["ti"]) == (wanted.kc, wanted.ti)


@pytest.mark.parametrize(
    ("flags", "model"),
    [
        (FOPDT, TransferFunction.fopdt(1.65, 20.0, 10.0)),
        ("--gain -2 --time-constants 5 --order 4", TransferFunction.lag_n(-2.0, 5.0, 4, 0.0)),
        (
            "--gain 1 --time-constants 5 5 --zeros -1e-1 --dead-time 1",
            LAG_N_ZERO.of_order(2).build((1.0, 5.0, -0.1, 1.0)),
        ),
        ("--gain 1 --time-constants 5 2", TransferFunction.sopdt(1.0, (5.0, 2.0), 0.0)),
        (
            "--gain 1 --natural-frequency 2 --damping 0.5 --dead-time 1",
            TransferFunction.oscillator(1.0, 2.0, 0.5, 1.0),
        ),
        ("--gain 1 --integrators 1 --dead-time 2", IPDT.build((1.0, 2.0))),
        (
            "--gain 1 --integrators 1 --time-constants 3",
            INTEGRATOR_LAG.build((1.0, 3.0, 0.0)),
        ),
        (
            "--gain 1 --integrators 1 --time-constants 3 --zeros -2 --dead-time 1",
            INTEGRATOR_INVERSE.build((1.0, 2.0, 3.0, 1.0)),
        ),
        (
            "--structure unstable_fopdt --gain 2 --time-constants 3 --dead-time 1",
            UNSTABLE_FOPDT.build((2.0, 3.0, 1.0)),
        ),
        (
            "--numerator 2 --denominator 3 -1 --dead-time 1",
            UNSTABLE_FOPDT.build((2.0, 3.0, 1.0)),
        ),
        (
            "--gain 1 --time-constants 3 2 1 --dead-time 1",
            THREE_LAGS.build((1.0, 3.0, 2.0, 1.0, 1.0)),
        ),
    ],
)
def test_models_by_flags(flags, model):
    given = [f" {word}" if word.startswith("-") and word[1].isdigit() else word
             for word in flags.split(" ")]  # fmt: skip
    found = model_of(tune._parser().parse_args(given))
    assert found.structure == model.structure
    s = [0.1j, 0.3 + 0.5j, 2j]
    assert found(s) == pytest.approx(model(s), rel=1e-9)


@pytest.mark.parametrize(
    "model",
    [
        TransferFunction.fopdt(-1.65, 20.0, 10.0),
        TransferFunction.lag_n(1.0, 1.0, 20, 0.001),
        TransferFunction.oscillator(1.0, 1.0, 0.4, 0.5),
        INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
        UNSTABLE_SOPDT.build((1.0, 2.0, 0.2, 0.2)),
    ],
)
@pytest.mark.parametrize("how", ["replay", "identify", "tune", "stdin"])
def test_models_by_document(model, how, tmp_path, monkeypatch):
    """A model comes back exactly, many equal lags included."""
    fields = model_fields(model)
    found = {
        "replay": {"bag": "b", "experiments": [{"models": [{}, fields], "selected": 1}]},
        "identify": {"method": "chang", **fields},
        "tune": {"model": fields, "gains": []},
        "stdin": fields,
    }[how]
    path = tmp_path / "model.json"
    path.write_text(json.dumps(found))
    monkeypatch.setattr("sys.stdin", io.StringIO(path.read_text()))
    options = tune._parser().parse_args(["-" if how == "stdin" else str(path)])
    assert model_of(options) == model


def test_people_may_write_a_document_too(tmp_path):
    path = tmp_path / "model.json"
    for text, model in (
        (
            '{"gain": 2, "time_constants": 3, "dead_time": 1}',
            TransferFunction.fopdt(2.0, 3.0, 1.0),
        ),
        (
            '{"structure": "unstable_fopdt", "gain": 2, "time_constants": [3], "dead_time": 1}',
            UNSTABLE_FOPDT.build((2.0, 3.0, 1.0)),
        ),
        ('{"numerator": [2], "denominator": [3, 1]}', TransferFunction.fopdt(2.0, 3.0, 0.0)),
    ):
        path.write_text(text)
        assert model_of(tune._parser().parse_args([str(path)])) == model


@pytest.mark.long
def test_forms(capsys):
    flags = "--gain 1 --time-constants 10 3 --dead-time 1 --rule simc --pid"
    _, out, _ = run(capsys, flags, "--form series")
    (found,) = document(capsys, flags, "--form series")["gains"]
    # SIMC is made in the series form: td is the second lag.
    assert found["series"]["td"] == pytest.approx(3.0)
    assert found["series"]["kc"] == pytest.approx(5.0)
    assert "series form    kc 5.000 u/y   ti 8.000 s   td 3.000 s" in out
    complex_zeros = "--gain 1 --time-constants 10 10 10 --rule robust --pid"
    status, out, err = run(capsys, complex_zeros, "--form series")
    assert (status, out) == (1, "")
    assert "complex zeros" in err
    for form in ("parallel", "series"):
        status, out, _ = run(capsys, FOPDT, "--table --form", form)
        assert status == 0


@pytest.mark.long
def test_of_all_rules_one_without_the_form_is_told_as_such(capsys, tmp_path):
    # (1 + 0.5 s)/((1 - s)(1 + 0.1 s)) with a dead time of 0.1 s
    path = tmp_path / "model.json"
    path.write_text('{"numerator": [0.5, 1], "denominator": [-0.1, -0.9, 1], "dead_time": 0.1}')
    (found,) = document(capsys, f"{path} --pid --ms 3.5", "--table --form series")["gains"]
    assert found["rule"] == "robust"
    assert "complex zeros" in found["series"]["reason"]


def test_exports(capsys, tmp_path):
    asked = "--rule imc --export"
    to_heater = "pid_controller --dof heater --command-max 100"
    status, out, err = run(capsys, FOPDT, asked, to_heater)
    assert (status, out) == (2, "") and "give it with --sample-period S" in err
    _, out, _ = run(capsys, FOPDT, asked, to_heater, "--sample-period 0.5")
    (section,) = yaml.safe_load(out).values()
    # The rule's formula with a dead time of 10 s and half a period.
    p = section["ros__parameters"]["gains"]["heater"]["p"]
    assert p == pytest.approx(25.125 / (1.65 * 1.7 * 10.25))
    _, out, _ = run(capsys, FOPDT, asked, "yaml")
    assert yaml.safe_load(out)["ti"] == 25.0
    path = str(tmp_path / "gains.yaml")
    status, out, err = run(capsys, FOPDT, asked, "yaml --output", path)
    assert (status, out) == (0, "")
    # What the user must know stands in the file and beside it.
    assert err.startswith("tune: Ms is 1.95, above the 1.4 asked for; choose another rule, or a ")
    assert f"# {err.removeprefix('tune: ')}" in Path(path).read_text()
    status, _, err = run(capsys, FOPDT, asked, "yaml --output", path)
    assert status == 2
    assert "not overwriting" in err


REFUSED = [
    ("", 2, "no model: give --gain"),
    ("--gain 0 --time-constants 1", 2, "gain of a transfer function must not be zero"),
    ("--gain nan --time-constants 1", 2, "expected a finite number, found nan"),
    ("--gain 1 --time-constants -20", 2, "time constant must be > 0 s, found -20"),
    ("--gain 1 --time-constants 0", 2, "time constant must be > 0 s, found 0"),
    ("--structure fopdt --gain 1 --time-constants -20", 2, "must be > 0 s, found -20"),
    ("--gain 1 --time-constants 1 --dead-time -1", 2, "dead time must be >= 0 s, found -1"),
    ("--gain 1 --command-min 5 --command-max 5", 2, "--command-min 5 is not below --command-max"),
    ("--gain 1", 2, "no dynamics"),
    ("--time-constants 1", 2, "lacks its gain"),
    ("--gain 1 --time-constants 1 2 --order 3", 2, "--order 3"),
    ("--structure blob --gain 1", 2, "unknown structure 'blob'"),
    ("--structure fopdt --gain 1 --time-constants 1 2", 2, "time_constants of length 1, found 2"),
    ("--numerator 1", 2, "give both"),
    ("--numerator 1 1 1 --denominator 1 1", 2, "at least as many poles as zeros"),
    (FOPDT + " --rule thumb", 2, "unknown rule 'thumb'; known: "),
    (FOPDT + " --ms 1.1", 2, "--ms is 1.1, expected from 1.2 to 4"),
    (FOPDT + " --ms inf", 2, "expected a finite number"),
    (FOPDT + " --mt 0.9", 2, "--mt is 0.9, expected above 1"),
    (FOPDT + " --sample-period -1", 2, "--sample-period is -1, expected at least 0 s"),
    (FOPDT + " --lambda 0", 2, "--lambda is 0, expected above 0 s"),
    (FOPDT + " --pid --controller pi", 2, "not allowed with argument"),
    (FOPDT + " --phase-peak -30", 2, "between -180 and -90"),
    (FOPDT + " --output there", 2, "--output is for --export"),
    (FOPDT + " --table --export yaml", 2, "leave out --table"),
    (FOPDT + " --sample-period 1 --export pid_controller --dof 2nd/", 2, "'2nd/' is not a name"),
    ("--gain 1 --time-constants 1e-300", 2, "time_constants is 1e-300, expected a time from"),
    ("--gain 1 --time-constants 1 --dead-time 1e300", 2, "dead_time is 1e+300, expected a time"),
    (FOPDT + " --experiment 3", 2, "--experiment is of a document, and the model is given by"),
    (FOPDT + " there.json", 2, "given twice"),
    ("there.json", 2, "there.json cannot be read: No such file"),
    (FOPDT + " --rule lcmax", 1, "3 or more equal lags, found fopdt"),
    (FOPDT + " --rule imc --lambda 1", 1, "unstable loop"),
    (
        "--structure unstable_fopdt --gain 1 --time-constants 1 --dead-time 2.5 --rule unstable",
        1,
        "2 is the limit",
    ),
]


@pytest.mark.parametrize(("flags", "status", "said"), REFUSED)
def test_refusals_are_one_line_and_no_gains(flags, status, said, capsys):
    found = run(capsys, *([flags] if flags else []))
    assert found[0] == status
    assert found[1] == ""
    assert said in found[2]
    assert found[2].startswith("tune: ")
    assert found[2].count("\n") == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is not a JSON document"),
        ("[1]", "holds a JSON list"),
        ("{}", "holds no model"),
        ('{"gain": NaN, "time_constants": [1]}', "must be finite, found NaN"),
        ('{"gain": "2", "time_constants": [1]}', "gain must be a number, found '2'"),
        ('{"gain": 2, "time_constants": [true]}', "time_constants must be a number"),
        ('{"gain": null, "time_constants": [1]}', "gain must be a number, found None"),
        (
            '{"gain": 1, "time_constants": [1], "order": "two"}',
            "order is 'two', expected from 0 to 1000",
        ),
        (
            '{"gain": 1, "time_constants": [1], "order": 2.7}',
            "order is 2.7, expected a whole number",
        ),
        (
            '{"gain": 1, "time_constants": [1], "integrators": 1e400}',
            "integrators is inf, expected a finite number",
        ),
        ('{"gain": 1, "time_constants": [1], "integrators": -1}', "integrators is -1, expected"),
        ('{"numerator": 1, "denominator": [1, 1]}', "numerator must be a list"),
        (
            '{"gain": 1, "time_constants": [20], "deadtime": 10}',
            "unknown 'deadtime'; known: gain, time_constants, zeros, dead_time, ",
        ),
        ('{"experiments": []}', "no experiment with a model"),
        ('{"experiments": [{"selected": null, "models": []}]}', "no experiment with a model"),
    ],
)
def test_documents_that_hold_no_model(text, said, tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text(text)
    status, out, err = run(capsys, str(path))
    assert (status, out) == (2, "")
    assert said in err
    assert err.count("\n") == 1


def test_a_document_without_experiments_has_none_to_choose(tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text('{"gain": 1, "time_constants": [20]}')
    status, _, err = run(capsys, str(path), "--experiment", "1")
    assert (status, err) == (2, f"tune: {path} holds no experiments: leave out --experiment\n")


def test_of_several_experiments_one_is_chosen(tmp_path, capsys):
    fields = [model_fields(TransferFunction.fopdt(k, 20.0, 10.0)) for k in (1, 2)]
    path = tmp_path / "two.json"
    path.write_text(
        json.dumps({"experiments": [{"models": [each], "selected": 0} for each in fields]})
    )
    status, _, err = run(capsys, str(path))
    assert status == 2
    assert "--experiment" in err
    found = document(capsys, str(path), "--experiment 2 --rule imc")
    assert found["model"]["gain"] == 2.0
    status, _, err = run(capsys, str(path), "--experiment 3")
    assert (status, "has 2 experiments" in err) == (2, True)


def test_help_names_every_option_and_fits(capsys):
    status, out, _ = run(capsys, "--help")
    assert status == 0
    assert "Examples:" in out
    for flag in ("--rule", "--table", "--pid", "--form", "--export", "--lambda", "--loop-delay"):
        assert flag in out


@pytest.mark.long
def test_compensators_stand_beside_the_rules(capsys):
    _, out, _ = run(capsys, "--gain 1.5 --time-constants 10 --order 5 --table")
    assert re.search(r"high_order_compensator +4\.500 +26\.3", out)
    found = document(capsys, FOPDT, "--table --lambda 30")["compensators"]
    assert [c["name"] for c in found] == ["dead_time_compensator"]
    assert found[0]["closed_loop_time"] == 30.0
    assert found[0]["mt"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    "text",
    [
        '{"experiments": 3}',
        '{"experiments": [{"selected": 0}]}',
        '{"experiments": [{"selected": 5, "models": [{}]}]}',
        '{"experiments": [{"selected": "a", "models": [{}]}]}',
        '{"experiments": [{"selected": 0, "models": [3]}]}',
        '{"gain": 1' + "0" * 400 + "}",
        '{"gain": 1' + "0" * 5000 + "}",
        "[" * 200_000,
    ],
)
def test_a_document_that_nobody_wrote_is_refused_in_a_line(tmp_path, capsys, text):
    path = tmp_path / "model.json"
    path.write_text(text)
    assert tune.main([str(path)]) == 2
    assert "defect" not in capsys.readouterr().err
