# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Verdicts on recordings of real processes, judged by models that others fitted to them.

    . ./env.sh && python3 benchmarks/real_recordings.py FOLDER

FOLDER holds a ``NAME.csv`` for each recording (columns time, u and y), ``reference.json`` with
what an independent analysis found of each, and ``judge.py``, whose ``one(name, reference)`` runs
``replay`` by ``subprocess.run`` and returns the class of its gains, the reason and the seconds.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table, three

from relay_autotune.analysis import analyse
from relay_autotune.errors import RelayAutotuneError
from relay_autotune.loop.analysis import Loop
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record
from relay_autotune.recordings import read_records
from relay_autotune.result import Analysis

_MOST_SECONDS = 300.0
_HOLDS = 2.0
_UNUSABLE = ("dangerous", "crash", "hangs")


@dataclass(frozen=True)
class Row:
    """One recording.

    :param name: of the recording.
    :param expected: what the reference asks for: identifiable, either or refuse.
    :param kind: class of the gains by the folder's judge.
    :param verdict: of the worst experiment with gains, or none.
    :param model: chosen structure.
    :param why: first check that did not pass, or what was said instead of a result.
    :param seconds: of the processor that replay took.
    """

    name: str
    expected: str
    kind: str
    verdict: str
    model: str
    why: str
    seconds: float


def judge_of(folder: Path) -> Any:
    """Return the folder's judge as a module."""
    spec = importlib.util.spec_from_file_location("judge_of_recordings", folder / "judge.py")
    if spec is None or spec.loader is None:
        raise SystemExit(f"real_recordings: {folder} holds no judge.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def judged(judge: Any, folder: Path, name: str, reference: dict[str, Any]) -> Row:
    """Replay one recording, and have the judge say what its gains are."""
    command = ["replay", str(folder / f"{name}.csv"), "--measurement", "y", "--command", "u"]
    begin = os.times()
    done = subprocess.run(
        [*command, "--json"], capture_output=True, text=True, timeout=_MOST_SECONDS, check=False
    )
    end = os.times()
    # Processor time, which other programs on the machine hardly change.
    seconds = end.children_user - begin.children_user + end.children_system - begin.children_system
    # The judge runs the same command: it gets the output that is there already.
    judge.subprocess = SimpleNamespace(
        run=lambda *_, **__: done, TimeoutExpired=subprocess.TimeoutExpired
    )
    kind, _, _ = judge.one(name, reference)
    expected = reference.get("verdict", "either")
    try:
        found = json.loads(done.stdout).get("experiments", [])
    except ValueError:
        found = []
    given = [e for e in found if e.get("gains")] or found
    if not given:
        return Row(name, expected, kind, "none", "-", "nothing identified", seconds)
    first = given[0]
    chosen = first.get("selected")
    model = "-" if chosen is None else first["models"][chosen]["structure"]
    spoke = [c for c in first["checks"] if c["result"] != "passed"]
    spoke.sort(key=lambda c: c["result"] != "failed")
    why = ", ".join(c["name"] for c in spoke)
    return Row(name, expected, kind, first["verdict"], model, why or "-", seconds)


@dataclass(frozen=True)
class Half:
    """The analysis of one half of a record.

    :param found: the analysis.
    """

    found: Analysis

    def interval(self, name: str) -> tuple[float, float] | None:
        """Return the 95 % interval of K_u or of the first parameter of a name."""
        model = self.found.model
        assert model is not None
        if name == "K_u":
            half = NORMAL_95 * model.ultimate_gain_std
            at = model.ultimate_gain
            return (at - half, at + half) if math.isfinite(at) and math.isfinite(half) else None
        bounds = zip(model.parameters, model.ci95_low, model.ci95_high, strict=True)
        return next(((low, high) for p, low, high in bounds if p.startswith(name)), None)


def halves_of(path: Path) -> list[Half] | None:
    """Return both halves of a recording that is one experiment; None: a half gives no gains."""
    try:
        records = read_records(path, measurement="y", command="u")
    except RelayAutotuneError:
        return None
    if len(records) != 1:
        return None
    record: Record = records[0]
    n = len(record)
    halves = [Half(analyse(record.part(a, b), alone=True)) for a, b in pairwise((0, n // 2, n))]
    return None if any(h.found.best_gains is None for h in halves) else halves


def shares(pairs: Sequence[list[Half]]) -> Iterable[tuple[str, str]]:
    """Return what the halves say of each other, as rows of the table."""
    for trusted in (True, False):
        held = []
        for pair in pairs:
            for one, other in (pair, pair[::-1]):
                gains, model = one.found.best_gains, other.found.model
                assert gains is not None
                assert model is not None
                if trusted and one.found.verdict.name != "TRUSTED":
                    continue
                process = model.model
                process = replace(process, dead_time=process.dead_time + one.found.added_delay)
                held.append(Loop(gains, process).ms() <= _HOLDS)
        which = "trusted gains" if trusted else "all gains"
        yield f"{which} of a half, Ms at most 2 on the other half's model", _share(held)
    for title, name in (("K_u", "K_u"), ("tau", "time_constant"), ("D", "dead_time")):
        overlaps = []
        for pair in pairs:
            first, second = (half.interval(name) for half in pair)
            if first is None or second is None:
                continue
            if name != "K_u" and len({h.found.models[0].structure for h in pair}) > 1:
                # Time constants of different structures are different things.
                continue
            overlaps.append(first[0] <= second[1] and second[0] <= first[1])
        yield f"intervals of {title} of the halves overlap", _share(overlaps)


def _share(held: Sequence[bool]) -> str:
    return f"{sum(held)} of {len(held)}"


def summary(rows: Sequence[Row]) -> Iterable[tuple[str, str]]:
    """Return the figures of all recordings, as rows of the table."""
    kinds = Counter(r.kind for r in rows)
    asked = [r for r in rows if r.expected == "identifiable"]
    refuse = [r for r in rows if r.expected == "refuse"]
    yield "good, of the identifiable", _share([r.kind == "good" for r in asked])
    yield (
        "good and trusted, of these",
        _share([r.kind == "good" and r.verdict == "trusted" for r in asked]),
    )
    yield "dangerous, crashed or hung", str(sum(kinds[k] for k in _UNUSABLE))
    yield "risky", str(kinds["risky"])
    yield "trusted, of those that tell nothing", _share([r.verdict == "trusted" for r in refuse])
    yield (
        "trusted and dangerous or risky",
        _share([r.verdict == "trusted" for r in rows if r.kind in ("dangerous", "risky")]),
    )
    seconds = [r.seconds for r in rows]
    yield "median processor time", f"{three(float(np.median(seconds)))} s"
    yield "longest processor time", f"{three(max(seconds))} s"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of the recordings")
    parser.add_argument("names", nargs="*", metavar="NAME", help="recordings; default: all")
    parser.add_argument("--without-halves", action="store_true", help="leave out the halves")
    asked = parser.parse_args()
    judge = judge_of(asked.folder)
    references = json.loads((asked.folder / "reference.json").read_text())
    rows, pairs = [], []
    for name in asked.names or sorted(references):
        row = judged(judge, asked.folder, name, references[name])
        print(row, file=sys.stderr, flush=True)
        rows.append(row)
        pair = None if asked.without_halves else halves_of(asked.folder / f"{name}.csv")
        if pair is not None:
            pairs.append(pair)
    head = (
        "recording",
        "asked for",
        "gains are",
        "verdict",
        "model",
        "checks that spoke",
        "processor",
    )
    cells = [
        (r.name, r.expected, r.kind, r.verdict, r.model, r.why, f"{r.seconds:.1f} s") for r in rows
    ]
    print(table(head, cells), end="\n\n")
    figures = [*summary(rows), *(() if asked.without_halves else shares(pairs))]
    print(table(("figure", "value"), figures))


if __name__ == "__main__":
    main()
