# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Each benchmark runs and prints its table; what it measures is not judged here."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "benchmarks.md").read_text()
QUICK = {
    "fit_time": ("--quick",),
    "accuracy": ("--quick",),
    "target_spread": ("--quick",),
    "replay_shapes": ("--quick",),
    "replay_time": ("--quick",),
    "lockstep": ("--quick",),
    "latency": ("--quick",),
    "fault_table": ("--quick",),
    "controller_kills": ("--quick",),
    "simulated_experiments": ("--quick",),
    "random_histories": ("--quick",),
    "endurance": ("--quick",),
    "back_to_back": ("--quick",),
    "confident": ("--quick",),
    "chang_studies": ("--quick",),
    "structure_choice": ("--quick",),
    "coverage": ("--quick",),
    "ah_batch": ("--quick",),
    "design_known": ("--quick",),
    "design_identified": ("--quick",),
    "design_time": ("--quick",),
    "bag_reading": ("--quick",),
    "fuzz_bags": ("--quick",),
    "fleet_time": ("--quick",),
    "paper_designs": ("--quick",),
}


@pytest.mark.parametrize("name", QUICK)
def test_it_prints_its_table(name: str) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / f"{name}.py"), *QUICK[name]],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    rules = [k for k, line in enumerate(lines) if re.fullmatch(r"\|(-+\|)+", line)]
    assert rules, done.stdout
    for k in rules:
        columns = lines[k].count("|")
        assert lines[k - 1].count("|") - lines[k - 1].count(r"\|") == columns
        assert lines[k + 1].count("|") - lines[k + 1].count(r"\|") == columns
        assert "nan" not in lines[k + 1]


@pytest.mark.parametrize("name", QUICK)
def test_the_page_has_its_command_and_its_place(name: str) -> None:
    assert f"python3 benchmarks/{name}.py" in PAGE
    assert f"<!-- results of {name} -->" in PAGE
