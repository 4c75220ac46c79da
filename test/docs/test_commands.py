# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Every command of README and guide is one that there is, wherever it stands."""

from __future__ import annotations

import importlib
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from pages import PAGES, ROOT, Block, blocks, commands, every_command, parts_of, rows

from relay_autotune import start

SCRIPTS = {
    name: getattr(start, name).args[0]
    for name in re.findall(r'"\w+ = relay_autotune.start:(\w+)"', (ROOT / "setup.py").read_text())
}
# Each with the options that the pages use, as ros2cli of Jazzy has them.
VERBS = {
    "run": {"--ros-args"},
    "launch": {"--show-args"},
    "node list": set(),
    "service call": set(),
    "action send_goal": {"--feedback"},
    "topic echo": {
        *("--once", "--field", "--no-arr", "--qos-durability", "--qos-reliability"),
    },
    "topic info": {"--verbose"},
    "topic pub": {"--once"},
    "param dump": set(),
    "param describe": set(),
    "param set": set(),
    "param load": set(),
    "interface show": set(),
    "bag convert": set(),
    "bag play": {"--rate"},
    "pkg prefix": {"--share"},
    "control switch_controllers": {"--strict", "--activate", "--deactivate"},
}
OTHERS = {
    *(".", "cd", "colcon", "echo", "export", "kill", "make", "pip", "python3", "rosdep", "sed"),
    *("tank.json", "tune.json"),  # what follows the arrow of a line, a file
}
# Single words, and what only looks like a command.
NO_COMMANDS = re.compile(r"tune \.\.\.|\w+ \d|[a-z]+ [^-].* is ")


def commands_of(page: Path) -> list[list[str]]:
    known = {*SCRIPTS, "ros2", *OTHERS}
    return [w for w in every_command(page) if w[0] in known and not NO_COMMANDS.match(" ".join(w))]


def kind(name: str, package: str) -> Any:
    module, _, interface = name.removeprefix(f"{package}/").partition("/")
    return getattr(importlib.import_module(f"{package}.{module}"), interface)


def test_every_page_that_shows_how_has_commands() -> None:
    for name in ("docs/quick_start.md", "docs/tutorial.md", "docs/live.md"):
        assert len(commands_of(ROOT / name)) >= 10, name
    listed = [words for words in commands_of(ROOT / "docs/quick_start.md") if "--dry-run" in words]
    assert listed, "a command within a numbered list is not seen"


@pytest.mark.parametrize("block", blocks("sh"), ids=str)
def test_every_line_of_a_block_is_a_command_that_is_known(block: Block) -> None:
    for words in parts_of(commands(block.text)):
        assert words[0] in {*SCRIPTS, "ros2", *OTHERS}, words


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_verb_of_ros2_and_its_options_are_known(page: Path) -> None:
    for words in commands_of(page):
        if words[0] != "ros2":
            continue
        verbs = [v for v in VERBS if words[1 : 1 + len(v.split())] == v.split()]
        # "`ros2 bag`", as the text names a group of verbs.
        if not verbs and len(words) == 2:
            assert any(verb.startswith(words[1]) for verb in VERBS), words
            continue
        (verb,) = verbs
        rest = words[1 + len(verb.split()) :]
        if verb == "run" and "--ros-args" not in rest and rest[1:] and rest[1] in SCRIPTS:
            check_own(rest[1:])
        elif verb not in ("run", "pkg prefix") or rest[:1] == ["relay_autotune"]:
            options = {w for w in rest if w.startswith("--")} - {"--params-file"}
            assert options <= VERBS[verb], words
        check_arguments(verb, rest)


@pytest.mark.parametrize("page", ["README.md", "docs/quick_start.md", "docs/tutorial.md"])
def test_the_first_pages_need_no_ros2_command(page: str) -> None:
    """The text may name it beside what does the same; a block would be a dead end without ROS."""
    shown = every_command_of_blocks(ROOT / page)
    assert shown and not [words for words in shown if words[0] == "ros2"]


def every_command_of_blocks(page: Path) -> list[list[str]]:
    return parts_of([w for b in blocks("sh", pages=(page,)) for w in commands(b.text)])


def check_arguments(verb: str, rest: list[str]) -> None:
    """See that what a verb is about exists, where it is one of our own names."""
    topics = {name_of(row[2]): row[3].strip("`") for row in rows("docs/messages.md", "node")}
    nodes = {row[0].strip("`") for row in rows("docs/messages.md", "node")}
    if verb == "topic pub":
        topic, message, value = (w for w in rest if not w.startswith("--"))
        assert topics[topic.rpartition("/")[2]] == message
        fields = kind(message, "std_msgs").get_fields_and_field_types()
        assert set(yaml.safe_load(value)) <= set(fields)
    elif verb == "topic echo" and rest:
        (topic,) = (w for w in rest if w.startswith("/"))
        message = topics[topic.rpartition("/")[2]]
        if "--once" in rest:
            # Without the type it ends where no publisher was discovered yet, and without the QoS
            # it may miss what was latched.
            assert rest[-1] == message, rest
            given = dict(pairwise(rest))
            assert given.get("--qos-durability") == "transient_local", rest
            assert given.get("--qos-reliability") == "reliable", rest
        for flag, field in pairwise(rest):
            if flag == "--field":
                assert (
                    field in kind(message, message.partition("/")[0]).get_fields_and_field_types()
                )
    elif verb.startswith("param") and rest:
        assert rest[0].rpartition("/")[2] in nodes
    elif verb == "interface show" and rest:
        assert (ROOT / rest[0]).with_suffix(f".{rest[0].split('/')[1]}").is_file()


def name_of(cell: str) -> str:
    return cell.strip("`").removeprefix("~/").removeprefix("/")


def check_own(words: list[str]) -> None:
    """See that the parser of an executable takes a command as it is written."""
    module = importlib.import_module(SCRIPTS[words[0]])
    parser = getattr(module, "_parser", None)
    if parser is None:
        return
    given = [w for w in words[1:] if w != "..."]
    if given and given[-1] in ("--lambda", "--export", "--output"):
        # The text names a flag alone.
        assert given[-1] in parser().format_help()
        return
    try:
        parser().parse_args(given)
    except SystemExit as end:
        assert end.code == 0, words  # --help


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_our_own_commands_are_taken_as_they_are_written(page: Path) -> None:
    for words in commands_of(page):
        # Without a recording it is a flag that the text speaks of.
        named = (
            len(words) == 2 and words[1].startswith("--") and words[0] in ("replay", "identify")
        )
        if words[0] in SCRIPTS and len(words) > 1 and not named:
            check_own(words)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_scripts_and_targets_of_commands_exist(page: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for words in commands_of(page):
        if words[0] == "python3" and len(words) > 1 and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file(), words
        if words[0] == "make":
            assert words[-1] in targets, words
        if words[0] == ".":
            made = [f"{w[3]}/bin/activate" for w in commands_of(page) if w[1:3] == ["-m", "venv"]]
            assert words[1] in ("./env.sh", *made) or (ROOT / words[1]).is_file(), words
