# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the executables say where a package, or room for what they write, is lacking."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from relay_autotune.cli import demo

ROOT = Path(__file__).resolve().parents[2]
BAG = str(ROOT / "bags/biased_relay")
WITHOUT = """
import sys
sys.modules.update(dict.fromkeys({0!r}))
from relay_autotune.start import {1}
sys.exit({1}())
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "words", "absent", "told"),
    [
        ("report", [BAG, "--structure", "fopdt", "-o", "tune.html"], ["jinja2"], "[report]"),
        ("csv_to_bag", [str(ROOT / "bags/heater.csv"), "bag"], ["yaml"], "pip install '.[bags]'"),
        ("relay_node", [], ["rclpy"], "make setup"),
        ("apply_gains", [], ["rclpy"], "make setup"),
        ("simulated_loop", [], ["rclpy"], "make setup"),
        ("tune_loop", ["--measurement", "/a", "--command", "/b"], ["rclpy"], "make setup"),
    ],
)
def test_a_missing_package_is_told_in_one_line(name, words, absent, told, tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.format(absent, name), *words],
        cwd=tmp_path, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert absent[0] in done.stderr and told in done.stderr
    assert "defect" not in done.stderr


@pytest.mark.long
def test_the_help_of_csv_to_bag_needs_nothing_of_its_extra() -> None:
    code = WITHOUT.format(["yaml"], "csv_to_bag")
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--measurement-topic" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize("name", ["identify", "tune_loop", "plant_node"])
def test_a_help_that_cannot_be_written_is_told_and_is_no_success(name) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", WITHOUT.format([], name), "--help"],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=60,
        )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.endswith("standard output cannot be written: No space left on device")


def test_the_demo_tells_that_it_cannot_write_its_folder(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("demo_output").write_text("a file, which is no folder to be emptied")
    assert demo.main() == 1
    assert capsys.readouterr().err == (
        "demo: demo_output cannot be written: Not a directory; run the demo where you may write\n"
    )
