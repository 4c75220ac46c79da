# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The command `replay` as its users meet it."""

from __future__ import annotations

import json
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from analysed import analysed_anew, analysed_once, relay_record
from made_bags import (
    REPOSITORY,
    START,
    definition,
    experiment_message,
    serialize,
    write_pair,
    write_samples,
)
from pages import PROGRESS
from report_cases import only

from relay_autotune.analysis import analyse
from relay_autotune.bag.csv_file import read_csv
from relay_autotune.bag.definitions import CYCLE, EXPERIMENT, Definition
from relay_autotune.bag.signals import Selection
from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.cli import csv_to_bag, replay, terminal, tune
from relay_autotune.errors import BagError, NotThereError, SelectionError
from relay_autotune.exchange.export import EXPORTS
from relay_autotune.record.record import Outcome, Record
from relay_autotune.recordings import read_experiments
from relay_autotune.report.case import case_of, cases_of_document
from relay_autotune.report.page import page


def write_bag(path, folder, *records):
    text = definition(EXPERIMENT, folder).text
    topics = [
        Topic("/measurement"),
        Topic("/command"),
        Topic("/relay_experiment", EXPERIMENT, definition=Definition(text)),
    ]
    with BagWriter(path, topics, start_ns=START) as bag:
        for record in records:
            write_samples(bag, record)
            data = serialize(EXPERIMENT, text, experiment_message(record))
            bag.write("/relay_experiment", START, START, data)
    return path


# The choice among structures takes seconds, and so does the default rule.
FOPDT = ("--structure", "fopdt")
QUICK = (*FOPDT, "--rule", "imc")


def run(capsys, *arguments) -> tuple[int, str, str]:
    status = replay.main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return status, out, PROGRESS.sub("", err)


def documents(text):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


@pytest.mark.long
def test_the_table_says_what_a_person_needs(tmp_path, capsys, monkeypatch):
    # On a terminal it says meanwhile what the computation is at, so that it has to be one.
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", analysed_anew)
    monkeypatch.setattr(terminal, "PROGRESS_EVERY", 0.02)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    write_bag(tmp_path / "bag", tmp_path, relay_record())
    status, out, err = run(capsys, tmp_path / "bag")
    assert status == 0
    *lines, left = err.split("\r\x1b[K")
    assert left == ""
    assert any(re.fullmatch(r"computing the model, .* s: comparing structures", x) for x in lines)
    for word in (
        "completed  (run-1)",
        "700 samples",
        "limit cycle",
        "converged",
        "process ",
        "time constant",
        "95 %:",
        "ultimate gain",
        "thyagarajan",
        "ISA form",
        "parallel form",
        "Ms ",
        "gain margin",
    ):
        assert word in out, word
    assert max(map(len, out.splitlines()[1:])) < 100


@pytest.mark.long
def test_the_document_has_the_numbers_of_the_core_to_the_last_digit(tmp_path, capsys):
    record = relay_record()
    write_bag(tmp_path / "bag", tmp_path, record)
    status, out, err = run(capsys, "--json", tmp_path / "bag")
    assert (status, err) == (0, "")
    (found,) = documents(out)
    assert found["bag"] == str(tmp_path / "bag")
    (experiment,) = found["experiments"]
    expected = analysed_once(record)
    model, gains = expected.model, expected.best_gains
    selected = experiment["models"][experiment["selected"]]
    assert selected["method"] == "waveform"
    assert selected["structure"] == "fopdt"
    assert selected["gain"] == model.model.gain
    assert selected["time_constants"] == [float(t.real) for t in model.model.time_constants]
    assert selected["dead_time"] == model.model.dead_time
    assert selected["numerator"] == list(model.model.numerator)
    assert selected["denominator"] == list(model.model.denominator)
    assert list(selected["std"].values()) == [float(s) for s in model.std]
    assert selected["ci95"]["gain"] == [model.ci95_low[0], model.ci95_high[0]]
    assert selected["ultimate_gain"] == model.ultimate_gain
    assert selected["ultimate_frequency"] == model.ultimate_frequency
    assert set(selected["fit"]) == {
        "residual_rms",
        "noise_std",
        "fit",
        "whiteness_p",
        "prediction",
        "noise_to_signal",
        "noise_to_signal_power",
    }
    best = experiment["gains"][experiment["recommended"]]
    for name in ("kc", "ti", "td", "tf", "b", "p", "i", "d", "ms", "mt", "iae_load"):
        assert best[name] == getattr(gains, name)
    for name in ("gain_margin", "phase_margin", "delay_margin"):
        assert best[name] == getattr(gains, name)
    assert experiment["outcome"] == "completed"
    assert experiment["start"] == record.start
    assert experiment["duration"] == record.duration
    cycle = experiment["limit_cycle"]
    assert cycle["converged"] is True
    assert cycle["period"] == pytest.approx(cycle["period_high"] + cycle["period_low"])
    assert cycle["cycles"] >= 3


@pytest.mark.nightly
def test_two_experiments_are_two_entries_of_one_document(tmp_path, capsys):
    write_bag(tmp_path / "bag", tmp_path, relay_record(name="a"), relay_record(name="b"))
    _, out, _ = run(capsys, "--json", *QUICK, tmp_path / "bag")
    (found,) = documents(out)
    assert [e["experiment_id"] for e in found["experiments"]] == ["a", "b"]
    _, out, _ = run(capsys, *QUICK, tmp_path / "bag")
    assert "experiment 1 of 2" in out
    assert "experiment 2 of 2" in out


@pytest.mark.long
@pytest.mark.parametrize(
    "outcome", [Outcome.ABORTED, pytest.param(Outcome.FAILED, marks=pytest.mark.nightly)]
)
def test_an_experiment_that_did_not_end_well_has_a_model_but_no_gains(tmp_path, capsys, outcome):
    write_bag(
        tmp_path / "bag",
        tmp_path,
        relay_record(outcome=outcome, reason="the operator pressed the button"),
    )
    status, out, _ = run(capsys, "--json", *QUICK, tmp_path / "bag")
    (experiment,) = documents(out)[0]["experiments"]
    assert status == 1
    assert experiment["models"]
    assert experiment["gains"] == []
    assert experiment["recommended"] is None
    assert experiment["outcome"] == outcome.name.lower()
    assert experiment["reason"] == "the operator pressed the button"
    status, out, err = run(capsys, *QUICK, tmp_path / "bag")
    assert status == 1
    # A line may end within it.
    assert " ".join((out + err).split()).count("the operator pressed the button") == 1
    assert re.search(r"^  verdict +none$", out, re.M)
    assert "ISA form" not in out


@pytest.mark.long
def test_a_bag_of_a_killed_node_gives_a_model_and_no_gains(tmp_path, capsys):
    record = relay_record()
    text = definition(CYCLE, tmp_path).text
    topics = [
        Topic("/measurement"),
        Topic("/command"),
        Topic("/relay_cycle", CYCLE, definition=Definition(text)),
    ]
    facts = {"experiment_id": "run-1", "measurement": "/measurement", "command": "/command"}
    bag = BagWriter(tmp_path / "bag", topics, start_ns=START, custom=facts)
    write_samples(bag, record)
    bag.flush()
    status, out, err = run(capsys, "--json", *QUICK, tmp_path / "bag")
    (experiment,) = documents(out)[0]["experiments"]
    assert status == 1
    assert "unfinished recording" in err
    assert experiment["outcome"] == "aborted"
    assert experiment["reason"].startswith("the recording ends without the experiment's end")
    assert experiment["gains"] == []
    assert experiment["models"][0]["gain"] == pytest.approx(1.65, rel=0.03)


@pytest.mark.long
def test_a_foreign_recording_of_a_relay(tmp_path, capsys):
    record = relay_record()
    write_pair(
        tmp_path / "bag",
        list(zip(record.time, record.measurement, strict=True)),
        list(zip(record.time, record.command, strict=True)),
        ("/tank/level", "/tank/valve"),
    )
    status, out, err = run(capsys, "--json", *QUICK, tmp_path / "bag")
    (experiment,) = documents(out)[0]["experiments"]
    assert status == 0
    assert "using --measurement /tank/level --command /tank/valve" in err
    assert experiment["outcome"] == "unknown"
    assert experiment["models"][0]["gain"] == pytest.approx(1.65, rel=0.03)
    assert experiment["gains"]


@pytest.mark.nightly
def test_other_methods_and_rules(tmp_path, capsys):
    write_bag(tmp_path / "bag", tmp_path, relay_record())
    _, out, _ = run(capsys, "--json", "--method", "wang_biased", "--rule", "imc", tmp_path / "bag")
    (experiment,) = documents(out)[0]["experiments"]
    assert experiment["models"][experiment["selected"]]["method"] == "wang_biased"
    assert experiment["gains"][experiment["recommended"]]["rule"] == "imc"


@pytest.mark.long
def test_one_bad_bag_does_not_stop_the_others(tmp_path, capsys):
    good = write_bag(tmp_path / "good", tmp_path, relay_record())
    status, out, err = run(capsys, "--json", *QUICK, tmp_path / "none", good)
    bad, fine = documents(out)
    assert status == 1
    assert bad["experiments"] == []
    assert "does not exist" in bad["error"]
    assert fine["experiments"][0]["models"]
    assert err.count("\n") == 1


def stepped(count=400):
    t = np.arange(count) * 0.5
    y = 1.65 * np.where(t > 30.0, 1.0 - np.exp(-(t - 30.0) / 20.0), 0.0)
    return y + np.random.default_rng(1).normal(0.0, 0.005, count), np.where(t >= 20.0, 1.0, 0.0)


def step_csv(path, count=400, interval=0.5):
    t, (y, u) = np.round(np.arange(count) * interval, 6), stepped(count)
    rows = zip(t, y, u, t, strict=True)
    text = "Time (s),Level [m],Valve (%),Extra\n" + "".join(
        ",".join(map(repr, map(float, row))) + "\n" for row in rows
    )
    path.write_text(text)
    return path


@pytest.mark.nightly
def test_a_csv_and_the_bag_made_of_it_give_equal_numbers(tmp_path, capsys):
    path = step_csv(tmp_path / "step.csv")
    columns = ("--time", "Time (s)", "--measurement", "Level [m]", "--command", "Valve (%)")
    status, from_csv, _ = run(capsys, "--json", *QUICK, path, *columns)
    assert status == 0
    assert csv_to_bag.main([str(path), str(tmp_path / "bag"), *columns]) == 0
    assert "400 messages on /level, 400 on /valve" in capsys.readouterr().err
    topics = ("--measurement", "/level", "--command", "/valve")
    status, from_bag, _ = run(capsys, "--json", *QUICK, tmp_path / "bag", *topics)
    assert status == 0
    (a,), (b,) = documents(from_csv), documents(from_bag)
    # Float64 tells of no unit.
    assert [e.pop("units") for d in (a, b) for e in d["experiments"]] == [
        {"y": "m", "u": "%"},
        {},
    ]
    assert a["experiments"] == b["experiments"]
    model = a["experiments"][0]["models"][0]
    assert model["gain"] == pytest.approx(1.65, rel=0.02)
    assert model["dead_time"] == pytest.approx(10.0, abs=0.3)


@pytest.mark.long
def test_the_interval_of_a_csv_is_that_period_however_its_times_are_rounded(tmp_path, capsys):
    path = step_csv(tmp_path / "step.csv", interval=0.1)
    status, out, _ = run(capsys, "--json", *FOPDT, "--rule", "imc", "--sample-period", "0.1", path)
    assert status == 0
    (found,) = documents(out)[0]["experiments"]
    (model,) = found["models"]
    # 0.3 - 0.2 is 2.8e-17 less than 0.1: nothing happened before its row.
    assert not any("before its row" in warning for warning in model["warnings"])
    assert "the interval of the recording" in found["gains"][0]["reason"]


@pytest.mark.long
def test_gains_for_a_period_in_milliseconds_do_not_blame_the_recording(tmp_path, capsys):
    path = step_csv(tmp_path / "step.csv")
    asked = ("--export", "oscat_ft_pid", "--sample-period", "500")
    status, _, err = run(capsys, *FOPDT, *asked, path)
    assert status == 3
    assert "the controller runs every 500 s, the recording has a sample every 0.5 s" in err
    assert "is the sampling period in seconds?" in err and "record for longer" not in err


@pytest.mark.long
def test_a_csv_with_more_columns_gives_the_lines_to_copy(tmp_path, capsys):
    rows = step_csv(tmp_path / "step.csv").read_text().splitlines()
    path = tmp_path / "of five.csv"
    # Without the column that says that it is the command.
    rows[0] = "Time (s),Level [m],Signal (%),Extra"
    path.write_text("".join(f"{row},{'Level SP' if not k else 1}\n" for k, row in enumerate(rows)))
    assert replay.main([str(path)]) == 2
    first, *lines = capsys.readouterr().err.splitlines()
    assert "has 5 columns" in first
    words = shlex.split(lines[0], comments=True)
    assert words == [
        *("replay", str(path), "--measurement", "Level [m]", "--command", "Signal (%)")
    ]  # fmt: skip
    assert len(lines) == 2
    assert replay.main([*words[1:], "--rule", "imc"]) == 0


def test_columns_whose_names_tell_what_they_are_need_no_flags(tmp_path):
    t, (y, u) = np.arange(400) * 0.5, stepped()
    path = tmp_path / "FIC101.csv"
    rows = zip(t, np.full(t.size, 60.0), y, u, strict=True)
    path.write_text(
        "Time,FIC101.SP,FIC101.PV,FIC101.OP\n"
        + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows)
    )
    (log,) = read_csv(path, Selection())
    assert (log.measurement.name, log.command.name) == ("FIC101.PV", "FIC101.OP")
    (note,) = [n for n in log.notes if "as their names say" in n]
    assert "--measurement and --command name others" in note
    (log,) = read_csv(path, Selection(command="FIC101.SP"))
    assert (log.measurement.name, log.command.name) == ("FIC101.PV", "FIC101.SP")


def test_columns_of_two_loops_are_paired_by_their_tag(tmp_path):
    path = tmp_path / "plant.csv"
    head = "t,TIC-101.PV,TIC-101.OUT,TIC-102.PV,TIC-102.OUT"
    rows = [f"{k},{k % 7},{k // 9 % 2},{k % 5},{k // 8 % 2}" for k in range(40)]
    path.write_text("\n".join([head, *rows]))
    with pytest.raises(SelectionError) as caught:
        read_csv(path, Selection())
    assert [line.strip() for line in str(caught.value).splitlines()[1:]] == [
        f"--measurement TIC-{k}.PV --command TIC-{k}.OUT  # as their names say" for k in (101, 102)
    ]
    (log,) = read_csv(path, Selection(measurement="TIC-102.PV"))
    assert log.command.name == "TIC-102.OUT"
    path.write_text("\n".join([head.replace("TIC-102.PV", "alarm"), *rows]))
    (log,) = read_csv(path, Selection())
    assert (log.measurement.name, log.command.name) == ("TIC-101.PV", "TIC-101.OUT")


@pytest.mark.long
def test_everything_is_told_in_the_units_of_the_recording(tmp_path, capsys, monkeypatch):
    rows = step_csv(tmp_path / "step.csv").read_text().splitlines()
    rows[0] = "Time (s),PV [°C],OP [%],Extra"
    path = tmp_path / "oven.csv"
    path.write_text("\n".join(rows))
    (record,) = read_experiments(path).experiments
    assert record.units == {"y": "°C", "u": "%"}
    found = analyse(record, rule="imc", alone=True)
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", lambda *_, **__: found)
    # Of that the names of the columns alone tell nothing.
    foreign = re.compile(r"(?<![\w/])[yu]/[yu]|\d [yu]\b|u s/y|\[[yu]\]")
    status, table, _ = run(capsys, path)
    assert status == 0 and not foreign.search(table)
    for told in (r"gain +[\d.]+ °C/%", r"kc [\d.]+ %/°C", r"i [\d.]+ %/\(°C s\)", r"\d °C s/%"):
        assert re.search(told, table)
    assert "%/°C" in repr(found) and "%/°C" in found._repr_html_()
    _, out, _ = run(capsys, "--json", path)
    (experiment,) = documents(out)[0]["experiments"]
    assert experiment["units"] == {"y": "°C", "u": "%"}
    _, sketch, _ = run(capsys, "--export", "yaml", path)
    assert "# %/°C" in sketch and not foreign.search(sketch)
    # The page is made of the document, as well as of the samples.
    (case,) = cases_of_document(json.loads(out), "oven")
    only(monkeypatch)
    shown = page([case, case_of(found, "oven")])
    sections = shown[shown.index("<main>") : shown.index("</main>")]
    assert sections.count("IAE, load [°C s/%]") == 2 and not foreign.search(sections)
    # What is no unit stays out.
    path.write_text("\n".join([rows[0].replace("°C", "left side, raw"), *rows[1:]]))
    (record,) = read_experiments(path).experiments
    assert record.units == {"u": "%"}


def test_a_table_of_a_folder_has_the_units_of_its_recordings(tmp_path, capsys):
    rows = step_csv(tmp_path / "a.csv").read_text().splitlines()
    (tmp_path / "b.csv").write_text("\n".join(["Time (s),Level,Valve,Extra", *rows[1:]]))
    _, out, _ = run(capsys, *FOPDT, "--rule", "imc", tmp_path)
    head, units, a, again, bare, b = out.splitlines()
    assert head == again and a.startswith("a.csv") and b.startswith("b.csv")
    assert units.split()[:3] == ["%/m", "rad/s", "%/m"]
    assert bare.split()[:3] == ["u/y", "rad/s", "u/y"]


def test_names_given_for_several_apply_to_those_that_have_them(tmp_path, capsys, monkeypatch):
    asked = []

    def read(paths, selection, progress=None):
        asked.append((Path(paths[0]).name, selection.measurement, selection.command))
        if paths[0].endswith("oven.csv") and selection.measurement == "PV":
            raise NotThereError("oven.csv has no column 'PV'", "its columns are a, b")
        raise BagError("no more")

    monkeypatch.setattr("relay_autotune.cli.jobs.read_experiments", read)
    for name in ("oven.csv", "fan.csv"):
        (tmp_path / name).write_text("t,a,b\n")
    given = ["--measurement", "PV", "--command", "OP"]
    assert replay.main([str(tmp_path), *given]) == 1
    assert asked == [("fan.csv", "PV", "OP"), ("oven.csv", "PV", "OP"), ("oven.csv", None, None)]
    assert "oven.csv has no column 'PV': it is read by its own names" in capsys.readouterr().err
    # A single recording is expected to have them.
    assert replay.main([str(tmp_path / "oven.csv"), *given]) == 2
    assert "its columns are a, b" in capsys.readouterr().err


@pytest.mark.parametrize("command", [replay, tune])
def test_an_unknown_program_is_told_in_one_line_which_there_are(capsys, command):
    given = ["--gain", "1", "--time-constants", "2"] if command is tune else ["bags/step_test"]
    assert command.main([*given, "--export", "foo"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(name in line for name in EXPORTS)
    for flag in ("--export", "--law"):
        assert command.main([*given, flag, "simplepid"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{flag} is 'simplepid' (did you mean simple_pid?), expected one of" in line


def test_csv_to_bag_refuses_what_it_cannot_do(tmp_path, capsys):
    path = step_csv(tmp_path / "step.csv")
    columns = ("--measurement", "Level [m]", "--command", "Valve (%)")
    unclear = tmp_path / "unclear.csv"
    unclear.write_text("t,a,b,c\n0,1,2,3\n1,1,2,3\n")
    assert csv_to_bag.main([str(unclear), str(tmp_path / "bag")]) == 2
    assert "name two of them" in capsys.readouterr().err
    for name in ("no topic", "level", "/tank/", "/füllstand"):
        bad = ("--measurement-topic", name)
        assert csv_to_bag.main([str(path), str(tmp_path / "bag"), *columns, *bad]) == 2
        assert f"{name!r} is not a topic name" in capsys.readouterr().err
    assert csv_to_bag.main([str(path), str(tmp_path / "bag"), *columns, "--epoch", "-9"]) == 1
    assert "no time before 1970" in capsys.readouterr().err
    assert csv_to_bag.main([str(path), str(tmp_path), *columns]) == 1
    assert "exists already, not overwriting" in capsys.readouterr().err


BAD_FILES = {
    "empty.mcap": b"",
    "text.mcap": b"this is not a recording at all",
    "short.mcap": b"\x89MCAP0\r\n\x01",
    "empty.csv": b"",
    "constant.csv": b"t,y,u\n0,1,0\n1,1,1\n2,1,0\n",
    "still.csv": b"t,y,u\n0,1,4\n1,2,4\n2,1,4\n",
    "nan.csv": b"t,y,u\n0,1,0\n1,nan,1\n2,1,0\n",
    "short.csv": b"t,y,u\n0,1,0\n1,2,1\n",
}


@pytest.mark.parametrize("name", [*BAD_FILES, "missing", "missing.csv", "folder"])
def test_bad_recordings_end_with_one_line_and_status_1(tmp_path, capsys, name):
    path = tmp_path / name
    if name in BAD_FILES:
        path.write_bytes(BAD_FILES[name])
    if name == "folder":
        path.mkdir()
    status, _, err = run(capsys, path)
    assert status == 1
    assert err.startswith("replay: ")
    assert str(path) in err
    # What has an experiment is told in the table, and can be looked at.
    figures = f"replay: figures show why: report {path} -o report.html\n"
    assert (err == figures) is (name == "short.csv")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--measurement", "/x", "--command", "/command"], "no topic '/x' for the measurement"),
        (["--command", "/nothing"], "no topic '/nothing' for the command"),
        (["--method", "guess"], "unknown method 'guess'; known: waveform"),
        (["--rule", "thumb"], "unknown rule 'thumb'; known: robust"),
        (["--start", "5", "--end", "5"], "--start 5 is not before --end 5"),
        (["--command-min", "5", "--command-max", "1"], "--command-min 5 is not below --command"),
        (["--start", "1e9"], "no sample lies between"),
        (["--time", "t"], "--time, --time-unit and --period are for CSV files"),
    ],
)
def test_choices_that_do_not_fit_end_with_status_2(tmp_path, capsys, options, sentence):
    write_bag(tmp_path / "bag", tmp_path, relay_record())
    status, out, err = run(capsys, tmp_path / "bag", *options)
    assert (status, out) == (2, "")
    assert sentence in err
    assert err.count("\n") == 1


def test_several_pairs_are_listed_with_status_2(tmp_path, capsys):
    names = ("/level", "/valve", "/pump")
    with BagWriter(tmp_path / "bag", [Topic(n) for n in names], start_ns=START) as bag:
        for k in range(50):
            for name, value in zip(names, (k % 23, k // 10 % 2, k // 7 % 2), strict=True):
                bag.write(name, START + k, START + k, encode_float64(float(value)))
    status, out, err = run(capsys, tmp_path / "bag")
    assert (status, out) == (2, "")
    assert "--measurement /level --command /pump" in err
    assert "--measurement /level --command /valve" in err
    assert "two levels, 4 switches in 50 messages" in err


@pytest.mark.parametrize("arguments", [[], ["--start", "nan", "x"], ["--start", "soon", "x"]])
def test_wrong_usage_has_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        replay.main(arguments)
    assert caught.value.code == 2
    assert "replay --help shows what it takes" in capsys.readouterr().err


def test_a_constant_measurement_in_an_experiment_is_said(tmp_path, capsys):
    record = relay_record()
    flat = Record(
        time=record.time,
        measurement=np.full(len(record), 3.0),
        command=record.command,
        settings=record.settings,
        outcome=Outcome.FAILED,
        reason="no response to the kick",
        experiment_id="flat",
    )
    write_bag(tmp_path / "bag", tmp_path, flat)
    status, out, err = run(capsys, "--json", tmp_path / "bag")
    assert status == 1
    assert "nothing identified" in err
    assert documents(out)[0]["experiments"][0]["models"] == []
    status, out, err = run(capsys, tmp_path / "bag")
    assert (status, " ".join(out.split()).count("no response to the kick")) == (1, 1)
    assert "no response to the kick" not in err


_REPLAY = "from relay_autotune.start import replay; raise SystemExit(replay())"


def process(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-c", _REPLAY, *map(str, arguments)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=120,
        **options,
    )


@pytest.mark.nightly
def test_two_processes_print_the_same_bytes(tmp_path, capsys):
    bag = write_bag(tmp_path / "bag", tmp_path, relay_record())
    asked = ("--json", *FOPDT, bag)
    other = process(*asked)
    said = PROGRESS.sub("", other.stderr)
    assert (other.returncode, other.stdout, said) == run(capsys, *asked)


# All that is read or written otherwise: live, as a figure, by others, in IDL, to a bag.
UNWANTED = {
    *("rclpy", "std_msgs", "matplotlib", "jinja2", "rosbags", "yaml"),
    *("zstandard", "lz4", "concurrent.futures.process", "distributed"),
    *("scipy.signal", "scipy.stats", "scipy.integrate", "scipy.interpolate"),
    *(f"relay_autotune.bag.{name}" for name in ("csv_file", "foreign", "pairing", "writer")),
    *(f"relay_autotune.report.{name}" for name in ("case", "figures", "page", "picture")),
    *(f"relay_autotune.{name}" for name in ("exchange.models", "experiment.experiment")),
}


@pytest.mark.long
def test_nothing_is_imported_that_a_bag_of_ours_does_not_need(tmp_path):
    write_bag(tmp_path / "bag", tmp_path, relay_record())
    code = (
        "import sys; from relay_autotune.cli.replay import main; "
        f"status = main([{str(tmp_path / 'bag')!r}]); "
        "import os; assert os.environ['OPENBLAS_NUM_THREADS'] == '1'; "
        f"unwanted = {UNWANTED} & set(sys.modules); "
        "sys.exit(f'{status} {unwanted}' if status or unwanted else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.nightly
def test_a_reader_that_leaves_early_gets_no_traceback(tmp_path):
    write_bag(tmp_path / "bag", tmp_path, relay_record())
    command = f"{sys.executable} -c '{_REPLAY}' {' '.join(QUICK)} {tmp_path}/bag | true"
    done = subprocess.run(
        ["bash", "-c", command], cwd=REPOSITORY, capture_output=True, text=True, timeout=120
    )
    assert PROGRESS.sub("", done.stderr) == ""


def test_numbers_that_json_lacks_are_null():
    from relay_autotune.exchange.fields import json_number

    assert json_number(math.nan) is None
    assert json_number(math.inf) is None
    assert json_number(1.0 + 0.0j) == 1.0
    assert json_number(1.0 - 2.0j) == [1.0, -2.0]
    assert json_number(np.float64(0.1)) == 0.1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--jobs -1", "argument --jobs: expected a number from 1 to 1024, found '-1';"),
        ("--start -1e-3 --end -2", "--start -0.001 is not before --end -2\n"),
        ("--end -inf", "argument --end: expected a finite number, found -inf;"),
    ],
)
def test_a_number_below_zero_is_no_option_and_shown_as_it_was_given(words, told, capsys):
    with pytest.raises(SystemExit) as ended:
        sys.exit(replay.main([*words.split(), "bags/step_test"]))
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith(f"replay: {told}")
