# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The journal of gains: what is read is what was written, whole, whenever the process ends."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from copy import copy
from dataclasses import replace
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest

from relay_autotune.control.controller import GainBounds
from relay_autotune.control.gains_history import GainSet, GainsHistory, Work
from relay_autotune.nodes.gains_keeper import GainsJournal, GainsKeeper, JournalError
from relay_autotune.nodes.gains_place import OwnGains

GIVEN = GainSet.of({"kc": 0.1 + 0.2, "ti": 1e-9, "b": 1.0})
OTHER = GainSet.of({"kc": -1e12, "ti": 2.0, "b": 0.0})
HISTORY = (
    GainsHistory.begun(GIVEN).apply(OTHER).settled().verify().passed().verify().fail().verify()
)

WRITER = """
import sys
from pathlib import Path
from relay_autotune.control.gains_history import GainSet, GainsHistory
from relay_autotune.nodes.gains_keeper import GainsJournal
journal = GainsJournal(Path(sys.argv[1]), "/c", 0, "y", "u")
print("ready", flush=True)
for k in range(10**9):
    journal.saving(GainsHistory.begun(GainSet.of({"kc": k + 1.0, "ti": k + 1.0})))()
"""


def written(**others: Any) -> dict[str, Any]:
    """Return an empty journal as the file has it."""
    lists: dict[str, Any] = {"before": [], "failed": [], "doubtful": []}
    whole = {"version": 1, "loop": "y", "given": None, "in_force": None, "work": "nothing"}
    return whole | lists | others


def own(kc: float, ti: float = 1.0, **others: float) -> dict[str, float]:
    return {"kc": kc, "ti": ti, "td": 0.0, "tf": 0.0, "b": 1.0} | others


class Elsewhere(OwnGains):
    """A place whose gains outlive this process, and which is never asked here."""

    outlives = True


def keeper_of(
    journal: GainsJournal, given: GainSet | None, bounds: GainBounds, kind: type[OwnGains]
) -> GainsKeeper:
    """Return a keeper as controller_node makes it, beside a node that does nothing."""
    place = kind(lambda gains: None, None)
    nothing = lambda *words, **named: None  # noqa: E731
    log = SimpleNamespace(warning=nothing, error=nothing, info=nothing)
    timer = SimpleNamespace(reset=nothing, cancel=nothing)
    node: Any = SimpleNamespace(create_timer=lambda *w, **n: timer, get_logger=lambda: log)
    return GainsKeeper(
        node, place, journal, given, lambda gains: bounds.require(place.controller_of(gains))
    )


def journal_in(
    folder: Path, node: str = "/tank/c", domain: int = 0, loop: str = "y", command: str = "u"
) -> GainsJournal:
    return GainsJournal(folder, node, domain, loop, command)


def test_what_is_read_is_what_was_written(tmp_path):
    journal = journal_in(tmp_path / "made" / "folder")
    assert journal.load() is None
    journal.saving(HISTORY)()
    assert HISTORY.work is Work.VERIFY
    assert HISTORY.failed == (OTHER,)
    assert journal.load() == HISTORY
    assert journal.path.name.startswith("gains.tank.c.")
    assert not list(journal.path.parent.glob("*.tmp"))


def test_each_node_and_each_loop_has_its_own(tmp_path):
    paths = {
        journal_in(tmp_path, node, domain, loop, command).path
        for node in ("/a/b", "/a_b", "/b")
        for domain in (0, 7)
        for loop in ("/tank/level", "/belt/speed", "/belt/speed simple_pid 0.05 s")
        for command in ("/tank/valve", "/belt/power")
    }
    assert len(paths) == 36


@pytest.mark.nightly
def test_a_second_process_is_refused_and_a_killed_one_leaves_a_whole_file(tmp_path):
    rng = Random(1)
    for _ in range(5):
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE
        )
        try:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"ready\n"
            with pytest.raises(JournalError, match="another process has"):
                journal_in(tmp_path, "/c")
            deadline = time.monotonic() + 20.0
            while not list(tmp_path.glob("gains.c.*.json")):
                assert time.monotonic() < deadline
            time.sleep(rng.uniform(0.0, 0.05))
        finally:
            writer.kill()
            writer.communicate()
        journal = journal_in(tmp_path, "/c")
        history = journal.load()
        journal.close()
        assert history is not None
        values = history.gains.by_name()
        assert values["kc"] == values["ti"] >= 1.0


def test_a_state_that_was_overtaken_is_left_out(tmp_path):
    journal = journal_in(tmp_path)
    early, late = journal.saving(replace(HISTORY, given=None)), journal.saving(HISTORY)
    late()
    early()
    assert journal.load() == HISTORY


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"version": 1, "loop": "y"}',
        '{"version": 9, "loop": "y", "given": null, "in_force": null, "before": [], "failed": [],'
        ' "doubtful": [], "work": "nothing"}',
        '{"version": 1, "loop": "y", "given": {"kc": NaN}, "in_force": null, "before": [],'
        ' "failed": [], "doubtful": [], "work": "nothing"}',
        "[" * 100_000,
        json.dumps(written() | {"given": {"ti": 1.0, "kc": 10**400}}),
        json.dumps(written() | {"given": {"ti": 1.0, "kc": 1e300}}),
        json.dumps(written() | {"given": {"ti": 1.0, "kc": True}}),
        json.dumps(written() | {"in_force": {"gains": {"kc": "5"}, "standing": "proven"}}),
        json.dumps(
            written() | {"before": [{"gains": {"kc": 1.0}, "standing": "given"}] * 200_000}
        ),
        json.dumps(written() | {"loop": "y" * 3_000_000}),
    ],
)
def test_a_file_that_is_no_journal_is_refused(tmp_path, text):
    journal = journal_in(tmp_path)
    journal.path.write_text(text)
    with pytest.raises(JournalError, match=r"is not a journal of gains .*remove it"):
        journal.load()


def test_the_journal_of_another_loop_is_refused(tmp_path):
    journal = journal_in(tmp_path)
    journal.saving(HISTORY)()
    other = GainsJournal.__new__(GainsJournal)
    other.__dict__.update(journal.__dict__, _loop="/z")
    with pytest.raises(JournalError, match="of the loop 'y', found '/z'"):
        other.load()


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    journal = journal_in(tmp_path / "file")
    with pytest.raises(JournalError, match="cannot be kept in"):
        journal.saving(HISTORY)()


def test_the_present_limits_hold_for_gains_that_were_proven_before(tmp_path):
    journal, given = journal_in(tmp_path), GainSet.of(own(0.3))
    proven = GainsHistory.begun(given).verify(GainSet.of(own(5.0, 0.5))).passed()
    for bounds, kept in (
        (GainBounds(), own(5.0, 0.5)),
        (GainBounds(kc_max=2.0), own(0.3)),
        (GainBounds(ti_min=0.6), own(0.3)),
    ):
        journal.saving(proven)()
        history = keeper_of(journal, given, bounds, OwnGains).history
        assert history.gains == GainSet.of(kept)


HOSTILE = [
    None, True, "5", "proven", "given", "verify", [], {}, 0, -1, 1e300, -1e12, 10**400, math.nan,
    math.inf, [[]], {"kc": 1.0}, own(1.0, b=1e300), own(1.5, ti=-1.0), own(0.0), "\x1b[2K",
]  # fmt: skip


def damaged(value: Any, rng: Random) -> Any:
    """Return a document with something else at some place in it."""
    if not isinstance(value, (dict, list)) or not value or rng.random() < 0.15:
        return rng.choice(HOSTILE)
    value = copy(value)
    key = rng.choice(list(value) if isinstance(value, dict) else range(len(value)))
    if rng.random() < 0.15:
        del value[key]
    else:
        value[key] = damaged(value[key], rng)
    return value


def random_document(rng: Random) -> dict[str, Any]:
    def gains() -> dict[str, float]:
        return own(rng.choice([0.3, 0.5, 1.5, 1.9, 5.0, 1e9]), rng.choice([0.0, 0.01, 0.5, 2.0]))

    def entries(most: int) -> list[Any]:
        standing = ["given", "edited", "applied", "proven"]
        return [
            {"gains": gains(), "standing": rng.choice(standing)}
            for _ in range(rng.randint(0, most))
        ]

    return written(
        given=rng.choice([None, own(0.3)]),
        in_force=(entries(1) or [None])[0],
        before=entries(rng.choice([3, 20, 25])),
        failed=[gains() for _ in range(rng.randint(0, 3))],
        doubtful=[gains() for _ in range(rng.randint(0, 2))],
        work=rng.choice(["nothing", "apply", "verify"]),
    )


@pytest.mark.long
@pytest.mark.parametrize("kind", [OwnGains, Elsewhere])
def test_no_journal_puts_gains_in_force_that_are_neither_proven_nor_asked_for(
    tmp_path, monkeypatch, kind
):
    """1,000 journals of each kind, of which most are damaged."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    rng, bounds, given = Random(26), GainBounds(kc_max=2.0, ti_min=0.1), GainSet.of(own(0.3))
    read = 0
    for number in range(1000):
        journal = journal_in(tmp_path, f"/{number}")
        document = random_document(rng)
        for _ in range(rng.choice([0, 0, 1, 1, 2, 3])):
            document = damaged(document, rng)
        text = json.dumps(document).encode()
        if rng.random() < 0.15:
            at = rng.randrange(len(text))
            text = text[:at] + rng.randbytes(rng.randint(0, 4)) + text[at + rng.randint(1, 9) :]
        journal.path.write_bytes(text)
        try:
            keeper = keeper_of(journal, given, bounds, kind)
        except JournalError as error:
            assert str(error).isprintable() and len(str(error)) < 400
            continue
        finally:
            journal.close()
        read += 1
        history = keeper._goal or keeper.history
        if kind is Elsewhere and keeper._goal is None:
            # Nothing is sent to the other node.
            continue
        if history.gains in (None, given):
            continue
        document = json.loads(text)
        values, trusted = history.gains.by_name(), ("given", "proven")
        # Another node may go back to what was only applied.
        others = () if kind is OwnGains else ("applied", "edited")
        known = [e["gains"] for e in document["before"] if e["standing"] in (*trusted, *others)]
        if (last := document["in_force"]) is not None and last["standing"] in trusted:
            known.append(last["gains"])
        assert values in known
        assert values not in list(document["failed"])
        assert abs(values["kc"]) <= 2.0 and (values["ti"] == 0.0 or values["ti"] >= 0.1)
    assert read > 200
