# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The page for a PLC: its tests by hand give good gains, and its table types them in right."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pages import ROOT, blocks, commands, rows
from report_cases import only

from relay_autotune.cli import replay
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.loop.gains import Controller
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant

PAGE = ROOT / "docs/plc.md"
OVEN = TransferFunction(gain=0.9, time_constants=(40.0, 8.0), dead_time=4.0)
COMMANDS = [words for block in blocks("sh", pages=(PAGE,)) for words in commands(block.text)]


def by_steps() -> PiecewiseConstant:
    at = np.array([200.0, 400.0, 600.0, 800.0])
    return PiecewiseConstant(at, np.array([57.0, 45.0, 33.0, 45.0]), 45.0)


def by_relay() -> PiecewiseConstant:
    """Switch as the page says, half a second late, as a hand does."""
    at, to = [100.0], [61.0]
    for second in range(101, 600):
        u = PiecewiseConstant(np.array(at), np.array(to), 45.0)
        before, now = response(OVEN, np.array([0.0, second - 1.0, second]), u)[1:]
        if (before <= 0.0 < now) if to[-1] > 45.0 else (before >= 0.0 > now):
            at.append(second + 0.5)
            to.append(45.0 if len(at) > 8 else 33.0 if to[-1] > 45.0 else 61.0)
        if len(at) > 8:
            break
    assert len(at) == 9
    return PiecewiseConstant(np.array(at), np.array(to), 45.0)


def write_log(u: PiecewiseConstant) -> None:
    """Write what a PLC logs of a test: each second, a row at each change, tenths of a degree."""
    time = np.union1d(np.arange(0.0, u.times[-1] + 100.0), u.times)
    noise = np.random.default_rng(5).normal(0.0, 0.1, time.size)
    y = np.round(150.0 + response(OVEN, time, u) + noise, 1)
    rows = [f"{t:g},150,{v:.1f},{c:g}" for t, v, c in zip(time, y, u(time), strict=True)]
    Path("log.csv").write_text("Time (s),SP,PV (°C),OP (%)\n" + "\n".join(rows))


@pytest.mark.long
@pytest.mark.parametrize("by_hand", [by_steps, by_relay])
def test_a_test_by_hand_gives_gains_that_hold(by_hand, tmp_path, monkeypatch, capsys):
    only(monkeypatch, "experiment")
    monkeypatch.chdir(tmp_path)
    # The gains are read off one line, whatever the terminal.
    monkeypatch.setenv("COLUMNS", "100")
    write_log(by_hand())
    report, export = (words[1:] for words in COMMANDS)
    assert replay.main(report) == 0
    text = capsys.readouterr().out
    assert "jump of the command" in text
    kc, ti, td, tf, b = (
        float(re.search(rf"ISA form .*{name} ([\d.]+)", text)[1])  # type: ignore[index]
        for name in ("kc", "ti", "td", "tf", "b")
    )
    assert analyse_loop(Controller(kc, ti, td, tf, b), OVEN).ms < 1.45
    assert Path("log.html").stat().st_size > 10_000
    if by_hand is by_relay:
        return
    assert replay.main(export) == 0
    shown = capsys.readouterr()
    assert "CYCLE := T#100ms;" in shown.out and "jump of the command" in shown.err


def cell(text: str, known: dict[str, float]) -> float:
    """Return the number that a cell of the table gives, which reads `name: formula`."""
    formula = re.sub(r", (in minutes|per minute)", "", text.rpartition(": ")[2])
    formula = formula.replace("size of ", "").replace(" %", "").replace(" ", "*")
    return float(eval(formula, dict(known)))


SPAN = 150.0
# What each system makes of the three numbers that are typed in: p, i [1/s] and d [s], in output
# per unit of the measurement, by its manual.
SYSTEMS: dict[str, Callable[[float, float, float], tuple[float, float, float]]] = {
    "Siemens PID_Compact": lambda g, i, d: (g, g / i, g * d),
    "Siemens CONT_C (FB 41)": lambda g, i, d: (g, g / i, g * d),
    "Rockwell PIDE, dependent": lambda g, i, d: tuple(
        100.0 / SPAN * each for each in (g, g / (60.0 * i), g * 60.0 * d)
    ),
    "Rockwell PIDE, independent": lambda g, i, d: tuple(
        100.0 / SPAN * each for each in (g, i / 60.0, d * 60.0)
    ),
    "ABB Harmony, function code 19 with K = 1": lambda g, i, d: (g, i / 60.0, d * 60.0),
    "Emerson DeltaV": lambda g, i, d: tuple(100.0 / SPAN * e for e in (g, g / i, g * d)),
    "Beckhoff FB_BasicPID": lambda g, i, d: (g, g / i, g * d),
}


def test_gains_are_typed_in_as_each_system_takes_them():
    table = {row[0]: row[1:] for row in rows("docs/plc.md", "system")}
    assert set(table) == {*SYSTEMS, "others"}
    wanted = Controller(1.5, 130.0, 28.0, 3.0)
    known = {n: getattr(wanted, n) for n in ("kc", "ti", "td", "tf")}
    known["k"] = wanted.kc * SPAN / 100.0
    gains: list[str] = []
    for name, made_of in SYSTEMS.items():
        gains = [gains[0] if c == "the same" else c for c in table[name][:3]]
        gains[0] = gains[0].partition(";")[0]
        typed = [cell(text, known) for text in gains]
        assert made_of(*typed) == pytest.approx((wanted.p, wanted.i, wanted.d)), name
    band, repeats = (cell(text, known) for text in table["others"][:2])
    # A deviation over the whole band moves the output over its whole range.
    assert 100.0 / (band / 100.0 * SPAN) == pytest.approx(wanted.kc)
    assert repeats == pytest.approx(60.0 * wanted.i / wanted.p)
    assert math.isclose(wanted.p, wanted.kc)
