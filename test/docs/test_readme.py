# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What README and guide show is what happens."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pages import PAGES, PROGRESS, ROOT, Block, block_noted, blocks, commands, matches, sessions

from relay_autotune import start
from relay_autotune.cli import demo
from relay_autotune.report.case import case_of
from tools.report_images import tune_as_the_demo


def run(words: list[str], capfd: pytest.CaptureFixture[str]) -> tuple[str, int]:
    """Run an executable of the package in this process; return what it says and its status."""
    module = importlib.import_module(getattr(start, words[0]).args[0])
    capfd.readouterr()
    try:
        status = module.main(words[1:])
    except SystemExit as end:
        status = int(end.code or 0)
    said = capfd.readouterr()
    return PROGRESS.sub("", said.err) + said.out, status


@pytest.mark.long
@pytest.mark.parametrize("block", blocks("console"), ids=str)
def test_a_console_shows_what_the_command_prints(
    block: Block, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("COLUMNS", "100")
    for words, shown in sessions(block.text):
        output, status = run(words, capfd)
        if status:
            output += f"[exit status {status}]\n"
        assert matches(shown, output), output


@pytest.mark.long
def test_logs_of_other_tools_are_read_by_the_commands_shown(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bags").symlink_to(ROOT / "bags")
    monkeypatch.chdir(tmp_path)
    direct = block_noted("docs/replay.md", "a log of another tool")
    by_bag = block_noted("docs/replay.md", "a log becomes a bag")
    said = [run(words, capfd) for b in (direct, by_bag) for words in commands(b.text)]
    assert [status for _, status in said] == [0, 0, 0, 0]
    models = [re.findall(r"process +(.*)", output) for output, _ in said]
    assert models[0] == models[1] == models[3] != []


@pytest.mark.long
def test_the_lines_of_python_go_from_a_log_to_gains_and_a_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("control")
    # The figures of the report take seconds, and have tests of their own.
    monkeypatch.setattr("relay_autotune.report.page.PLATES", ())
    monkeypatch.chdir(tmp_path)
    Path("bags").symlink_to(ROOT / "bags")
    code = block_noted("docs/install.md", "in Python").text
    assert len([line for line in code.splitlines() if line]) == 10
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["model"].model.dead_time == pytest.approx(16.0, abs=0.3)
    assert capsys.readouterr().out.splitlines()[0] in code
    w, loop = 0.02, names["gains"].loop(names["model"].model)
    assert names["loop"](1j * w) == pytest.approx(complex(loop(1j * w)), rel=1e-3)
    assert Path("figure.png").read_bytes().startswith(b"\x89PNG")
    assert "Heater" in Path("report.html").read_text()


@pytest.mark.long
def test_the_demo_shown_is_the_one_computed(capsys: pytest.CaptureFixture[str]) -> None:
    demo._compare(case_of(tune_as_the_demo(), "demo", truth=demo.TRUTH))
    assert capsys.readouterr().out == block_noted("docs/quick_start.md", "made by the demo").text


def test_the_readme_is_one_screen_and_its_session_is_that_of_the_tutorial() -> None:
    assert len((ROOT / "README.md").read_text().split()) <= 900
    lines = block_noted("README.md", "tested: lines of the session").text.splitlines()
    assert set(lines) <= set(
        block_noted("docs/tutorial.md", "tested: a session").text.splitlines()
    )


def test_the_picture_is_small() -> None:
    picture = ROOT / "docs/images/demo.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size < 200_000


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{page.name} links to {target}"
        if anchor:
            titles = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)
            anchors = {re.sub(r"[^\w -]", "", t.lower()).replace(" ", "-") for t in titles}
            assert anchor in anchors, f"{page.name} links to {target}"


def test_make_has_every_target_named() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in (*PAGES, ROOT / "env.sh"):
        named = re.findall(r"(?:^|`)make ([a-z][\w-]*)(?:`|$| +#)", page.read_text(), re.MULTILINE)
        assert set(named) <= targets, page


@pytest.mark.long
def test_colcon_finds_both_packages_in_both_layouts(tmp_path: Path) -> None:
    if not shutil.which("colcon"):
        pytest.skip("colcon is not installed")
    builds = [
        words for b in blocks("sh") if b.page == "docs/install.md" for words in commands(b.text)
    ]
    builds = [words for words in builds if words[:2] == ["colcon", "build"]]
    assert len(builds) == 2
    (tmp_path / "src").mkdir()
    (tmp_path / "src/relay_autotune").symlink_to(ROOT)
    for folder, words in zip((ROOT, tmp_path), builds, strict=True):
        listed = subprocess.run(
            [sys.executable, "-m", "colcon", "list", "--names-only", *words[2:]],
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        assert set(listed.stdout.split()) == {"relay_autotune", "relay_autotune_msgs"}
