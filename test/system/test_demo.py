# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The demo, as `make demo` runs it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from relay_autotune.recordings import read_experiments


def test_the_demo_tunes_and_leaves_bag_result_and_picture(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "relay_autotune.cli.demo"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the same gains to the last digit" in done.stdout
    assert re.search(r"\n  K_u u/y +[\d.]+ +[\d.]+ +[\d.]+ to [\d.]+ ", done.stdout), done.stdout
    output = tmp_path / "demo_output"
    assert {p.name for p in output.iterdir()} == {
        "bag",
        "result.json",
        "figure.png",
        "report.html",
    }
    result = json.loads((output / "result.json").read_text())
    truth, experiment = result["truth"], result["experiments"][0]
    model = experiment["models"][experiment["selected"]]
    assert experiment["outcome"] == "completed"
    assert model["structure"] == "fopdt"
    for name in ("gain", "dead_time"):
        assert model[name] == pytest.approx(truth[name], rel=0.03)
    assert model["time_constants"] == pytest.approx(truth["time_constants"], rel=0.03)
    gains = experiment["gains"][experiment["recommended"]]
    assert gains["kc"] > 0.0
    assert 1.0 < gains["ms"] <= gains["ms_95"] < 2.0
    assert len(read_experiments(output / "bag").experiments) == 1
    assert (output / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert (output / "report.html").read_text().startswith("<!DOCTYPE html>")
