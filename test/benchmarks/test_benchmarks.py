# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Each benchmark runs and prints its table; what it measures is not judged here.

The runs are nightly ones: they take minutes and prove the benchmarks, not the package.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "benchmarks").glob("[!_]*.py"))
sys.path.insert(0, str(ROOT / "benchmarks"))
markdown = importlib.import_module("markdown")
PAGE = (ROOT / "docs" / "benchmarks.md").read_text()
RESULTS = ROOT / "benchmarks" / "results"
# It prints what it found, no table.
WITHOUT_TABLE = "fuzz_coverage"
QUICK = [
    path.stem for path in FILES if '"--quick"' in path.read_text() and path.stem != WITHOUT_TABLE
]
# What starts a browser.
IN_A_BROWSER = ("page_latency", "page_load")


@pytest.mark.long
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_it_finds_what_it_imports(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(path.parent)
    importlib.import_module(path.stem)


def test_each_benchmark_is_in_one_group_of_the_list() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks")], capture_output=True, text=True, timeout=60
    )
    listed = re.findall(r"^  (\w+) +\S", done.stdout, re.MULTILINE)
    runnable = [path.stem for path in FILES if "def main" in path.read_text()]
    assert sorted(listed) == sorted(runnable)


# How many times worse than in the file of results a figure may be, for the machine has other work.
MOST_LOSS = 2.0


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.browser] * (n in IN_A_BROWSER)) for n in QUICK],
)
def test_its_short_form_prints_tables_and_its_results_are_still_true(name: str) -> None:
    """Half of the speed of a program goes without anybody seeing it."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / f"{name}.py"), "--quick"],
        capture_output=True,
        text=True,
        timeout=600.0,
    )
    printed = done.stdout
    assert done.returncode == 0, done.stderr
    lines = printed.splitlines()
    rules = [k for k, line in enumerate(lines) if re.fullmatch(r"\|(-+\|)+", line)]
    assert rules, printed
    for k in rules:
        columns = lines[k].count("|")
        assert lines[k - 1].count("|") - lines[k - 1].count(r"\|") == columns
        assert lines[k + 1].count("|") - lines[k + 1].count(r"\|") == columns
        assert "nan" not in lines[k + 1]
    page = (RESULTS / f"{name}.md").read_text()
    naming = markdown.naming(page)
    stated, found = markdown.figures(page, naming), markdown.figures(printed, naming)
    common = found.keys() & stated.keys()
    assert common or not stated, printed
    worse = {key: loss for key in common if (loss := found[key].loss(stated[key])) > MOST_LOSS}
    assert not worse, printed


@pytest.mark.parametrize("file", sorted(RESULTS.glob("*.md")), ids=lambda f: f.stem)
def test_a_file_of_results_has_its_command_and_the_page_links_it(file: Path) -> None:
    text = file.read_text()
    assert f"python3 benchmarks/{file.stem}.py" in text
    assert text.count("<!-- results -->\n") == text.count("<!-- end -->") == 1
    assert f"benchmarks/results/{file.name})" in PAGE


@pytest.mark.parametrize("name", QUICK)
def test_a_benchmark_has_a_file_of_results(name: str) -> None:
    assert (RESULTS / f"{name}.md").is_file()


def test_what_is_kept_takes_the_place_of_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT)
    runner = importlib.import_module("benchmarks.__main__")
    monkeypatch.setattr(runner, "HERE", tmp_path)
    (tmp_path / "results").mkdir()
    file = tmp_path / "results" / "some.md"
    file.write_text("# Some\n\n<!-- results -->\n\nold\n\n<!-- end -->\n\nWhat they show.\n")
    assert runner.keep("some", r"| \1 |")
    assert file.read_text() == (
        "# Some\n\n<!-- results -->\n\n| \\1 |\n\n<!-- end -->\n\nWhat they show.\n"
    )
    assert not runner.keep("other", "new")


def test_a_table_that_is_no_longer_true_is_noticed() -> None:
    page = "| pair | faster | target | x |\n|---|---|---|---|\n| a | 53 x rosbags | >= 40 | 9 |"
    stated = markdown.figures(page, 1)["a", "faster"]
    found = markdown.figures(page.replace("53", "15"), 1)["a", "faster"]
    assert stated.is_met
    assert not found.is_met
    assert found.loss(stated) == pytest.approx(53 / 15)
    assert found.loss(stated) > MOST_LOSS
    heads = "| d | [ms] | target [ms] | x reference |\n|-|-|-|-|\n"
    (time,) = markdown.figures(f"{heads}| b | 1,071 | <= 10,000 | 20 |", 1).values()
    assert (time.value, time.target, time.is_met) == (1071.0, 10_000.0, True)
    (slower,) = markdown.figures(f"{heads}| b | 4,000 | <= 10,000 | 30 |", 1).values()
    assert slower.loss(time) == 1.5


def test_as_many_columns_name_a_row_as_tell_rows_apart() -> None:
    heads = "| d | n | [ms] | target |\n|-|-|-|-|\n"
    assert markdown.naming(f"{heads}| a | 1 | 5 | <= 9 |\n| b | 1 | 5 | <= 9 |") == 1
    assert markdown.naming(f"{heads}| a | 1 | 5 | <= 9 |\n| a | 2 | 5 | <= 9 |") == 2


def test_rounding_and_nothing_are_not_worse_than_less_of_it() -> None:
    page = "| d | error | target |\n|-|-|-|\n| a | 4.4e-16 | <= 1e-9 |\n| b | 0 | <= 0 |"
    stated = markdown.figures(page, 1)
    found = markdown.figures(page.replace("4.4e-16", "9.0e-15").replace("| 0 |", "| 3 |"), 1)
    tiny, lost = ("a", "error"), ("b", "error")
    assert stated[tiny].value == 4.4e-16
    assert found[tiny].loss(stated[tiny]) == 1.0
    assert found[lost].loss(stated[lost]) == math.inf
    assert stated[lost].loss(stated[lost]) == 1.0


def test_a_target_may_stand_in_the_heading_or_in_a_row_below() -> None:
    heads = "| jobs | [s] | faster (target >= 1.8) |\n|--|--|--|\n"
    (found,) = markdown.figures(f"{heads}| 2 | 47.9 | 1.95 |", 1).items()
    assert found[0] == ("2", "faster (target >= 1.8)")
    assert (found[1].value, found[1].target, found[1].is_least) == (1.95, 1.8, True)
    rows = "| median | | 1853 |\n| target | 0 | >= 2000 |"
    (below,) = markdown.figures(f"| run | lost | rate |\n|--|--|--|\n{rows}", 1).items()
    assert below[0] == ("median", "rate")
    assert not below[1].is_met


JUDGE = """
import json, subprocess, sys


def one(name, reference):
    done = subprocess.run(["replay"], capture_output=True, text=True)
    found = json.loads(done.stdout)["experiments"][0]
    assert reference["gain"] == 2.0
    return ("good" if found["gains"] else "refused"), "", 0.0
"""


@pytest.mark.nightly
def test_recordings_in_a_folder_are_judged_by_the_judge_in_it(tmp_path: Path) -> None:
    time = np.arange(0.0, 60.0, 0.25)
    command = np.where(time < 5.0, 0.0, np.where(time < 30.0, 1.0, -1.0))
    record = Record(time=time, measurement=np.zeros(time.size), command=command)
    y = response(TransferFunction.fopdt(2.0, 5.0, 2.0), time, record.input())
    y = y + np.random.default_rng(0).normal(0.0, 0.01, time.size)
    columns = np.stack((time, command, y), axis=1)
    np.savetxt(tmp_path / "made.csv", columns, delimiter=",", header="time,u,y", comments="")
    reference = {"made": {"verdict": "identifiable", "gain": 2.0}}
    (tmp_path / "reference.json").write_text(json.dumps(reference))
    (tmp_path / "judge.py").write_text(JUDGE)
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "real_recordings.py"), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    cells = [[c.strip() for c in line.split("|")[1:-1]] for line in done.stdout.splitlines()]
    assert ["made", "identifiable", "good", "trusted", "fopdt", "-"] in [c[:6] for c in cells]
    assert ["good, of the identifiable", "1 of 1"] in cells
    assert ["all gains of a half, Ms at most 2 on the other half's model", "2 of 2"] in cells


def test_the_truth_of_first_tries_is_that_of_the_exact_loop() -> None:
    first_tries = importlib.import_module("first_tries")
    gain, slow, fast = 2.0, 8.0, 3.0

    def flow(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([(gain * u - x[0]) / slow, (x[0] - x[1]) / fast])

    loop = first_tries.Loop(flow, 0.5, (0.0, 1.0), 0.5, (1.0, 1.0), delay=1.0)
    (truth,) = loop.truths()
    late = loop.delay + (0.5 + first_tries.ANSWER) * loop.period
    model = TransferFunction.sopdt(gain, (slow, fast), late)
    for kc, ti in ((0.8, 10.0), (1.6, 6.0)):
        gains = Controller(kc, ti)
        assert truth.ms(gains) == pytest.approx(Loop(gains, model).ms(), rel=1e-3)
    assert math.isinf(truth.ms(Controller(20.0, 2.0)))
    assert 0.02 < truth.best_integral() < 0.2


def test_a_limit_is_noticed_where_its_half_or_double_decides() -> None:
    limits = importlib.import_module("limits")
    source = "_MOST = 4.0\n\ndef beyond(x):\n    return abs(x) > _MOST\n"
    tree = limits.Instrument({"_MOST": "here:_MOST"}).visit(ast.parse(source).body[1])
    reached = limits.Reached(record=7)
    room = {"_MOST": 4.0, limits._USE: reached.use, limits._DECIDE: reached.decide}
    module = ast.fix_missing_locations(ast.Module([tree], []))
    exec(compile(module, "made", "exec"), room)
    assert [room["beyond"](x) for x in (-9.0, 1.0)] == [True, False]
    assert reached.used["here:_MOST"] == {7}
    assert not reached.open["here:_MOST"]
    assert not room["beyond"](3.0)
    assert reached.open["here:_MOST"] == {7}


def test_the_limits_of_checks_are_found_and_moved() -> None:
    limits = importlib.import_module("limits")
    found = {each.name: each for each in limits.limits()}
    limit = found["risk.doubtful"]
    assert float(limit.value) > 0.0
    spec = limits.moved(limit, 2.0).find_spec(limit.module)
    assert spec is not None
    table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(table)
    (risk,) = [check for check in table.CHECKS if check.name == "risk"]
    assert risk.doubtful == 2.0 * float(limit.value)
