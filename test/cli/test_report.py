# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The command `report` as its users meet it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analysed import completed
from report_cases import fruitless, only

from relay_autotune.cli import replay, report
from relay_autotune.exchange.models import document, to_json
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.loop.gains import Controller
from relay_autotune.report import figures


def run(capsys, *arguments) -> tuple[int, str, str]:
    status = report.main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return status, out, err


@pytest.fixture
def result(tmp_path):
    """Return a file with the results of two recordings, a line for each."""
    path = tmp_path / "result.json"
    lines = [to_json(document("good", [completed()])), to_json(document("bad", [fruitless()]))]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_csv(path) -> None:
    record = completed().record
    rows = [
        f"{t:.6g},{y:.6g},{u:g}"
        for t, y, u in zip(record.time, record.measurement, record.command, strict=True)
    ]
    path.write_text("time,measurement,command\n" + "\n".join(rows) + "\n")


@pytest.mark.long
def test_a_recording_becomes_a_page_and_figures(capsys, tmp_path, monkeypatch) -> None:
    only(monkeypatch, "experiment", "fit")
    asked = []

    def analyse(record, **how):
        # What it would take seconds to find again.
        facts, wanted = how["known"], how["options"]
        asked.append((len(record), how["method"], how["rule"], facts.structure, facts.loss))
        asked.append((wanted.controller, wanted.ms, wanted.loop_delay))
        return completed()

    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", analyse)
    write_csv(tmp_path / "log.csv")
    page, folder = tmp_path / "page.html", tmp_path / "figures"
    facts = ("--structure", "fopdt", "--loss", "huber", "--rule", "imc", "--title", "Tank 7")
    wanted = ("--pi", "--ms", "1.6", "--loop-delay", "0.5", "--end", "200")
    outputs = ("-o", page, "--figures", folder, "--format", "svg")
    arguments = (tmp_path / "log.csv", *outputs, *facts, *wanted)
    status, out, err = run(capsys, *arguments)
    assert (status, err) == (0, "")
    samples = np.count_nonzero(completed().record.time <= 200.0)
    assert asked == [(samples, "waveform", "imc", "fopdt", "huber"), ("pi", 1.6, 0.5)]
    assert out.splitlines()[0] == str(page)
    assert out.splitlines()[1:] == [str(folder / f"{plate.key}.svg") for plate in figures.PLATES]
    assert all(file.read_text().startswith("<?xml") for file in folder.iterdir())
    assert "<title>Tank 7</title>" in page.read_text()


@pytest.mark.long
def test_several_recordings_of_one_process_have_one_model(capsys, tmp_path, monkeypatch) -> None:
    only(monkeypatch, "uncertainty")
    asked = []

    def analyse_jointly(records, **how):
        asked.append((len(records), how["method"]))
        return completed()

    monkeypatch.setattr("relay_autotune.cli.jobs.analyse_jointly", analyse_jointly)
    names = (tmp_path / "a.csv", tmp_path / "b.csv")
    for name in names:
        write_csv(name)
    status, _, err = run(capsys, *names, "--method", "li", "-o", tmp_path / "page.html")
    assert (status, err) == (0, "")
    assert asked == [(2, "li")]


@pytest.mark.long
def test_results_of_several_recordings_share_a_page(capsys, tmp_path, result, monkeypatch) -> None:
    only(monkeypatch, "uncertainty")
    status, _, err = run(capsys, result, "-o", tmp_path / "page.html")
    assert status == 1
    assert err == "report: bad: nothing identified: found no response to the command\n"
    text = (tmp_path / "page.html").read_text()
    assert '<a href="#e2">bad, run-1</a>' in text


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "is not JSON"),
        ("{", "is not JSON"),
        ("[1]", "is not a result of an experiment"),
        ('{"bag": "b", "experiments": [{}]}', "no field 'limit_cycle'"),
        ('{"bag": "b"}', "no field 'experiments'"),
    ],
)
def test_what_is_no_result_is_refused_in_a_line(capsys, tmp_path, content, complaint) -> None:
    (tmp_path / "r.json").write_text(content)
    status, out, err = run(capsys, tmp_path / "r.json", "-o", tmp_path / "page.html")
    assert (status, out) == (1, "")
    assert complaint in err
    assert err.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def test_a_recording_that_was_not_read_has_its_place(capsys, tmp_path) -> None:
    (tmp_path / "r.json").write_text(to_json(document("b", error="b is empty")))
    status, _, _ = run(capsys, tmp_path / "r.json", "-o", tmp_path / "page.html")
    assert status == 1
    assert "b is empty" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "complaint", "status"),
    [
        (("x.json", "-o", "page.doc"), ".html, .png, .svg, .pdf", 2),
        (("x.json", "-o", "no/page.html"), "there is no folder no", 2),
        (("x.json", "-o", "folder.html"), "folder.html exists and is no file", 2),
        (("x.json", "-o", "/proc/page.html"), "/proc/page.html cannot be written", 2),
        (("x.json", "-o", "a" * 300 + ".png"), "cannot be written: File name too long", 2),
        (("x.json",), "does not exist", 1),
        (("no_such_bag",), "does not exist", 1),
        (("no_such_bag", "--method", "guess"), "unknown method 'guess'", 2),
    ],
)
def test_what_does_not_fit_is_said_in_a_line(
    capsys, tmp_path, monkeypatch, arguments, complaint, status
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.html").mkdir()
    found, out, err = run(capsys, *arguments)
    assert (found, out) == (status, "")
    assert complaint in err
    assert err.count("\n") == 1


@pytest.mark.long
def test_replay_writes_the_report_beside_its_table(capsys, tmp_path, monkeypatch) -> None:
    only(monkeypatch, "uncertainty")
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", lambda record, **_: completed())
    write_csv(tmp_path / "log.csv")
    page = tmp_path / "page.html"
    assert replay.main([str(tmp_path / "log.csv"), "--report", str(page)]) == 0
    assert "Gains to type in" in page.read_text()
    assert f"the report is {page}" in capsys.readouterr().err
    assert replay.main([str(tmp_path / "log.csv"), "--report", str(tmp_path / "page.doc")]) == 2
    assert "does not say what the report is to be" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("command", [replay, report])
def test_a_recording_that_gave_nothing_stands_in_the_report_of_several(
    tmp_path, monkeypatch, command
) -> None:
    only(monkeypatch, "uncertainty")
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", lambda record, **_: completed())
    write_csv(tmp_path / "good.csv")
    (tmp_path / "unclear.csv").write_text("t,a,b,c\n0,1,2,3\n1,1,2,3\n")
    page = tmp_path / "page.html"
    logs = [str(tmp_path / name) for name in ("good.csv", "unclear.csv", "none.csv")]
    flag = "--report" if command is replay else "-o"
    assert command.main([*logs, flag, str(page)]) == 2
    text = page.read_text()
    assert "Gains to type in" in text
    assert "name two of them with --measurement NAME --command NAME" in text
    assert "none.csv does not exist" in text


def test_an_earlier_report_is_replaced_with_a_word_and_the_page_of_another_never(
    capsys, tmp_path, result, monkeypatch
) -> None:
    only(monkeypatch, "experiment")
    page, other = tmp_path / "page.html", tmp_path / "index.html"
    other.write_text("<!DOCTYPE html><title>My tank</title>")
    _, _, err = run(capsys, result, "-o", page)
    assert "replaced" not in err
    first = page.read_bytes()
    _, _, err = run(capsys, result, "-o", page, "--title", "Again")
    assert f"{page} exists and will be replaced" in err
    assert page.read_bytes() != first
    status, _, err = run(capsys, tmp_path / "none.csv", "-o", page)
    assert (status, err.count("\n"), "does not exist" in err) == (1, 1, True)
    status, _, err = run(capsys, result, "-o", other)
    assert (status, "name another file" in err) == (2, True)
    assert "My tank" in other.read_text()


def test_present_gains_and_the_command_are_in_the_report(
    capsys, tmp_path, result, monkeypatch
) -> None:
    only(monkeypatch, "experiment")
    page = tmp_path / "page.html"
    run(capsys, result, "-o", page, "--present", "0.3", "20", "0")
    text = page.read_text()
    assert "Beside the present gains" in text
    assert f"report {result} -o {page} --present 0.3 20 0" in text
    status, _, err = run(capsys, result, "-o", page, "--figures", page)
    assert (status, f"cannot be written to {page}: File exists\n" in err) == (1, True)
    drawn: list[Any] = []
    monkeypatch.setattr(report, "write_figures", lambda cases, *_: drawn.extend(cases) or [])
    given = ("--present", "0.3", "20", "0")
    run(capsys, result, "-o", page, "--figures", tmp_path / "figures", *given)
    assert drawn[0].present == Controller(0.3, 20.0)
    status, _, err = run(capsys, result, "-o", page, "--present", "0", "20", "0")
    assert (status, "--present" in err) == (2, True)


def test_the_table_has_the_present_gains_beside_the_new_ones(
    capsys, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", lambda record, **_: completed())
    logs = [str(tmp_path / name) for name in ("a.csv", "b.csv")]
    for log in logs:
        write_csv(Path(log))
    present = ("--present", "0.3", "20", "0")
    assert replay.main([logs[0], *present]) == 0
    told = capsys.readouterr().out
    found, model = completed(), completed().model.model
    slower = replace(model, dead_time=model.dead_time + found.added_delay)
    expected = analyse_loop(Controller(0.3, 20.0), slower)
    row = next(line.split() for line in told.splitlines() if line.startswith("  Ms  "))
    assert [float(n) for n in row[1:]] == pytest.approx(
        [expected.ms, found.best_gains.ms], rel=0.01
    )
    assert "the new gains are " in told
    # A file of gains on standard output leaves the comparison to standard error.
    assert replay.main([logs[0], *present, "--export", "controller_node"]) == 0
    file, beside = capsys.readouterr()
    assert row in [line.split() for line in beside.splitlines()] and "  Ms  " not in file
    assert replay.main([*logs, *present]) == 2
    assert "--present is of one loop, and 2 are given" in capsys.readouterr().err
