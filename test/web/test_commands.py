# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""`replay --web` and `tune --web` as their users start and end them."""

import json
import re
import shlex
import shutil
import signal
import subprocess
from dataclasses import replace
from typing import Any

import pytest
from analysed import completed
from served import REPOSITORY, conversation

from relay_autotune.cli import replay, tune
from relay_autotune.web import server

COMMANDS = {"replay": replay.main, "tune": tune.main}


@pytest.mark.nightly
@pytest.mark.parametrize(
    "words",
    [
        ("replay", str(REPOSITORY / "bags/biased_relay"), "--pi", "--structure", "fopdt"),
        ("tune", "--gain", "1.65", "--time-constants", "20", "--dead-time", "10", "--pi"),
    ],
    ids=["replay", "tune"],
)
def test_a_page_is_served_until_ctrl_c_and_its_command_gives_the_same_gains(words, capsys):
    process = subprocess.Popen(
        [shutil.which(words[0]), *words[1:], "--web"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        # a slow machine first says how long the model will take
        said = next(line for line in process.stderr if not line.startswith("computing"))
        url = re.search(r"the page is at (http://127\.0\.0\.1:\d+/) until Ctrl-C", said)[1]
        first, answer = conversation(
            url, {"of": 0, "n": 1, "asked": {"ms": 1.6, "controller": "pi"}}
        )
    finally:
        process.send_signal(signal.SIGINT)
        output, said = process.communicate(timeout=60.0)
    assert process.returncode == 0, said
    assert "Traceback" not in said
    assert "ISA form" in output
    assert first["subjects"][0]["first"]["controller"] == "pi"
    shaped = answer["answer"]["shaped"]
    again = shlex.split(shaped["command"])
    assert "--web" not in again
    assert COMMANDS[again[0]]([*again[1:], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    found = found["experiments"][0] if "experiments" in found else found
    gains = found["gains"][found["recommended"]]
    assert f"{gains['kc']:.4f}" == shaped["isa"][0][1]


def test_the_page_of_a_recording_has_its_units_and_the_command_at_which_it_rests(
    tmp_path, monkeypatch
) -> None:
    found = completed()
    recorded = replace(found.record, units={"y": "bar", "u": "%"})
    shown = replace(found, record=recorded)
    monkeypatch.setattr("relay_autotune.cli.jobs.analyse", lambda *_, **__: shown)
    pages: list[Any] = []
    monkeypatch.setattr(server, "run", lambda page, _: pages.append(page))
    assert replay.main([str(REPOSITORY / "bags/biased_relay"), "--web"]) == 0
    (page,) = pages
    page.close()
    (subject,) = page.subjects
    assert page.units == subject.target.units == recorded.units
    assert subject.target.present == recorded.settings.baseline
