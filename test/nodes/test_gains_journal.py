# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The journal of gains: what is read is what was written, whole, whenever the process ends."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from relay_autotune.control.gains_history import GainSet, GainsHistory, Work
from relay_autotune.nodes.gains_keeper import GainsJournal, JournalError

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
journal = GainsJournal(Path(sys.argv[1]), "/c", 0, "y")
print("ready", flush=True)
for k in range(10**9):
    journal.save(GainsHistory.begun(GainSet.of({"kc": k + 1.0, "ti": k + 1.0})), journal.ticket())
"""


def journal_in(
    folder: Path, node: str = "/tank/c", domain: int = 0, loop: str = "y"
) -> GainsJournal:
    return GainsJournal(folder, node, domain, loop)


def test_what_is_read_is_what_was_written(tmp_path):
    journal = journal_in(tmp_path / "made" / "folder")
    assert journal.load() is None
    journal.save(HISTORY, journal.ticket())
    assert HISTORY.work is Work.VERIFY
    assert HISTORY.failed == (OTHER,)
    assert journal.load() == HISTORY
    assert journal.path.name == "gains.tank.c.json"
    assert not list(journal.path.parent.glob("*.tmp"))


def test_each_node_has_its_own(tmp_path):
    paths = {
        journal_in(tmp_path, node, domain).path
        for node in ("/a/b", "/a_b", "/b")
        for domain in (0, 7)
    }
    assert len(paths) == 6


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
            while not (tmp_path / "gains.c.json").exists():
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
    early, late = journal.ticket(), journal.ticket()
    journal.save(HISTORY, late)
    journal.save(replace(HISTORY, given=None), early)
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
    ],
)
def test_a_file_that_is_no_journal_is_refused(tmp_path, text):
    journal = journal_in(tmp_path)
    journal.path.write_text(text)
    with pytest.raises(JournalError, match=r"is not a journal of gains .*remove it"):
        journal.load()


def test_the_journal_of_another_loop_is_refused(tmp_path):
    journal = journal_in(tmp_path)
    journal.save(HISTORY, journal.ticket())
    other = GainsJournal.__new__(GainsJournal)
    other.__dict__.update(journal.__dict__, _loop="/z")
    with pytest.raises(JournalError, match="of the loop 'y', found '/z'"):
        other.load()


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    journal = journal_in(tmp_path / "file")
    with pytest.raises(JournalError, match="cannot be kept in"):
        journal.save(HISTORY, journal.ticket())
