# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the commands print fits the terminal, and no word is broken."""

from __future__ import annotations

import importlib
import io
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from analysed import completed

from relay_autotune.cli import arguments, terminal, tune
from relay_autotune.cli.table import identification_lines, table
from relay_autotune.cli.terminal import Working, labelled, with_units
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.result import identified
from relay_autotune.process.structures import LAG_COMPLEX

COMMANDS = ("replay", "report", "tune", "identify", "csv_to_bag", "tune_loop", "apply_gains")


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_fits_80_columns(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        importlib.import_module(f"relay_autotune.cli.{name}").main(["--help"])
    assert max(capsys.readouterr().out.splitlines(), key=len)[80:] == ""


def check_widths(printed):
    """See that text for 80 and for 99 columns has these widths, and the same words."""
    for columns, text in printed.items():
        assert max(text.splitlines(), key=len)[columns:] == ""
    assert printed[80] != printed[99]
    assert printed[80].split() == printed[99].split()


@pytest.mark.long
def test_the_result_of_a_recording_fits_the_terminal_and_no_word_is_broken():
    found = replace(completed(), reason="the file /home/somebody/of-a-tank.csv says so " * 3)
    check_widths({columns: table("bag", [found], columns) for columns in (80, 99)})


def test_numbers_stand_below_one_another_beside_long_labels_and_units():
    numbers = {"gain": -0.0003191, "natural_frequency": 0.01234, "damping": 0.5}
    values = np.array([numbers.get(name, 5.0) for name in LAG_COMPLEX.names])
    found = identified("waveform", Estimate.of(LAG_COMPLEX, values, np.diag(0.01 * values**2)))
    with with_units({"y": "degree Celsius", "u": "%"}):
        lines = identification_lines(found, 99)
    assert len({line.index("95 %") for line in lines if "95 %" in line}) == 1
    assert {line[27:28] for line in lines if "95 %" in line or "±" in line} <= set("0123456789")


def test_the_rules_side_by_side_fit_the_terminal(monkeypatch, capsys):
    printed = {}
    for columns in (80, 99):
        monkeypatch.setenv("COLUMNS", str(columns))
        assert tune.main(["--gain", "1.65", "--time-constants", "20", "--table"]) == 0
        printed[columns] = capsys.readouterr().out
    check_widths(printed)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_message_is_one_line_in_a_pipe_and_is_broken_between_words_on_a_terminal(
    monkeypatch, capsys
):
    monkeypatch.setenv("COLUMNS", "60")
    text = "the file /home/somebody/recordings/of-a-tank/2026-11-20/level.csv has no column 'u'"
    arguments.say("replay", text)
    assert capsys.readouterr().err == f"replay: {text}\n"
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    arguments.say("replay", text)
    lines = terminal.getvalue().splitlines()
    assert len(lines) == 3
    assert " ".join(lines) == f"replay: {text}"


def test_quantities_on_a_line_stay_with_their_units():
    text = "kc 0.6488 u/y   ti 14.99 s   td 4.140 s   tf 0.4140 s"
    assert terminal.broken(text, 99) == [text]
    assert terminal.broken(text, 30) == ["kc 0.6488 u/y   ti 14.99 s", "td 4.140 s   tf 0.4140 s"]


def test_a_label_that_fills_its_column_has_a_space_after_it():
    for label in ("gain", "experiment 1 of 12"):
        assert labelled(label, "2.067e+04 s", 80)[0].split(label)[1].startswith(" ")


@pytest.mark.parametrize(
    ("expected", "first"),
    [(0.02, "0.2 s, about 1 s were expected"), (20.0, "about 20 s")],
)
def test_a_log_has_a_line_each_ten_seconds_and_at_once_what_takes_longer(
    expected, first, capsys, monkeypatch
):
    # ten seconds and less than one, two hundred times faster
    monkeypatch.setattr(terminal, "LOGGED_EVERY", 0.2)
    monkeypatch.setattr(terminal, "PROGRESS_EVERY", 0.004)
    # Its thread may speak before anything that follows.
    work = Working("the work", expected)
    work.at("comparing")
    with work:
        for _ in range(1000):
            lines = capsys.readouterr().err.splitlines()
            if lines:
                break
            time.sleep(0.01)
    assert first in lines[0]
    assert lines[0].endswith(": comparing")
