# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Whatever README and guide name exists in the code, and the guide names what there is."""

from __future__ import annotations

import importlib
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from analysed import analysed_once
from pages import GUIDE, PAGES, ROOT, block_noted, blocks, commands, rows, spans
from parameter_values import check_parameter_file, check_value

from relay_autotune.exchange.models import document
from relay_autotune.identification.methods import METHODS
from relay_autotune.loop.laws import LAWS
from relay_autotune.nodes.plant import MODES
from relay_autotune.process.structures import STRUCTURES
from relay_autotune.recordings import read_experiments
from relay_autotune.tuning import RULES
from tools.fill_docs import REASON_FILE, TABLES, filled, reason_file

EXECUTABLES = set(re.findall(r'"(\w+) = relay_autotune', (ROOT / "setup.py").read_text()))
PLAIN = {"use_sim_time"}  # what every node has
OVERRIDABLE = {"/measurement.subscription", "/command.publisher"}


def names_of(kind: str) -> set[str]:
    """Return the names that messages.md gives for topics or services."""
    kinds = {"topic": ("subscribes", "publishes"), "service": ("serves",)}[kind]
    return {row[2].strip("`") for row in rows("docs/messages.md", "node") if row[1] in kinds}


def shell_commands(*start: str) -> list[list[str]]:
    """Return the commands of all shell blocks that begin with some words."""
    found = [words for block in blocks("sh") for words in commands(block.text)]
    return [words for words in found if words[: len(start)] == list(start)]


def in_code(word: str) -> bool:
    if word.isidentifier():
        return word in WORDS
    # The word first, and what stands before it last: so it is found by its letters, in no time.
    letters = re.escape(word)
    return re.search(rf"{letters}(?<!\w{letters})(?!\w)", CODE) is not None


def code_text() -> str:
    files = [ROOT / name for name in ("setup.py", "Makefile", "package.xml", "env.sh")]
    for folder in ("relay_autotune", "relay_autotune_msgs", "tools", "bags", "benchmarks"):
        for pattern in ("*.py", "*.msg", "*.srv", "*.action"):
            files += (ROOT / folder).rglob(pattern)
    return "\n".join(file.read_text() for file in files)


CODE = code_text()
# The names of laws are put together in the code.
WORDS = frozenset((*re.findall(r"\w+", CODE), *LAWS))


@pytest.mark.long
@pytest.mark.parametrize("page", GUIDE, ids=lambda p: str(p.relative_to(ROOT)))
def test_what_the_code_says_is_written_in_the_page(page: Path) -> None:
    assert page.read_text() == filled(page.read_text()), "run `python3 -m tools.fill_docs`"


def test_the_constants_of_the_message_are_the_table():
    assert REASON_FILE.read_text() == reason_file(), "run `python3 -m tools.fill_docs`"


def test_every_node_has_its_table() -> None:
    text = "\n".join(page.read_text() for page in GUIDE)
    assert set(re.findall(r"<!-- parameters of (\w+) -->", text)) == set(TABLES)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_names_in_the_text_are_in_the_code(page: Path) -> None:
    for span in spans(page):
        if re.fullmatch(r"~?[a-z][a-z0-9]*(_[a-z0-9]+)+", span) or re.fullmatch("[a-z]+", span):
            assert in_code(span), f"{page.name} names {span}, which is not in the code"
        if re.fullmatch(r"[\w./]+/[\w.]*", span) and not span.startswith(("/", "~")):
            there = [span, f"relay_autotune/{span}", span.replace("docs/", "")]
            known = any((ROOT / path).exists() for path in there) or in_code(span)
            made = span.startswith((".venv", "install", "demo_output", "src"))
            assert known or made or is_interface(span), f"{page.name} names the path {span}"


def is_interface(name: str) -> bool:
    package, _, rest = name.partition("/")
    kind, _, interface = rest.partition("/")
    try:
        return hasattr(importlib.import_module(f"{package}.{kind}"), interface)
    except ImportError:
        return False


def test_executables_in_commands_exist() -> None:
    runs = shell_commands("ros2", "run")
    assert len(runs) >= 5
    for words in runs:
        assert words[2] == "relay_autotune"
        assert words[3] in EXECUTABLES


def test_every_executable_is_named_in_the_guide() -> None:
    text = "\n".join(page.read_text() for page in GUIDE)
    missing = {name for name in EXECUTABLES if f"`{name}`" not in text}
    assert not missing, f"the guide does not say what {missing} is for"


def test_parameters_in_commands_exist_and_may_have_these_values() -> None:
    runs = shell_commands("ros2", "run")
    # In the shell of env.sh they are called by their names.
    runs += [["ros2", "run", "", *words] for name in TABLES for words in shell_commands(name)]
    for words in runs:
        known = {entry.name: entry for entry in TABLES.get(words[3], ())}
        for flag, assignment in pairwise(words):
            if flag != "-p" or assignment.endswith(":=..."):
                continue
            name, _, value = assignment.partition(":=")
            if name.startswith("qos_overrides."):
                assert name.removeprefix("qos_overrides.").rpartition(".")[0] in OVERRIDABLE
                continue
            assert name in known.keys() | PLAIN, f"{words[3]} has no parameter {name}"
            if name in known:
                check_value(known[name], yaml.safe_load(value))


def test_the_parameter_file_is_one_for_relay_node() -> None:
    content = yaml.safe_load(block_noted("docs/live.md", "a parameter file").text)
    assert list(content) == ["/tank/relay_node"]
    check_parameter_file(content, TABLES)


def test_services_and_topics_in_commands_exist() -> None:
    served = {
        (node.strip("`"), name.strip("`")): kind.strip("`")
        for node, what, name, kind in rows("docs/messages.md", "node")
        if what == "serves"
    }
    services = {name.removeprefix("~/") for _, name in served}
    calls = shell_commands("ros2", "service", "call")
    assert len(calls) >= 3
    for words in calls:
        address, _, service = words[3].rpartition("/")
        assert served[address.rpartition("/")[2], f"~/{service}"] == words[4]
        package, _, kind = words[4].split("/")
        request = getattr(importlib.import_module(f"{package}.srv"), kind).Request
        given = yaml.safe_load(words[5]) if len(words) > 5 else {}
        assert set(given or {}) <= set(request.get_fields_and_field_types())
    topics = {name.removeprefix("/") for name in names_of("topic")}
    for words in shell_commands("ros2", "topic", "echo"):
        (topic,) = (word for word in words[3:] if word.startswith("/"))
        assert topic.rpartition("/")[2] in topics
    for page in GUIDE:
        for service in re.findall(r"`~/(\w+)`", page.read_text()):
            assert service in services, f"{page.name} names ~/{service}"


def test_actions_in_commands_exist() -> None:
    sent = shell_commands("ros2", "action", "send_goal")
    assert sent
    for words in sent:
        assert words[3].rpartition("/")[2] in (ROOT / "docs/messages.md").read_text()
        package, _, kind = words[4].split("/")
        goal = getattr(importlib.import_module(f"{package}.action"), kind).Goal
        assert set(yaml.safe_load(words[5]) or {}) <= set(goal.get_fields_and_field_types())


def test_launch_files_in_commands_exist_and_take_these_arguments() -> None:
    launched = shell_commands("ros2", "launch")
    assert len(launched) >= 4
    for words in launched:
        assert words[2] == "relay_autotune"
        file = ROOT / "launch" / words[3]
        for word in words[4:]:
            name, assigned, _ = word.partition(":=")
            known = re.search(
                rf"""(<arg name=|name: |DeclareLaunchArgument\(\s*)"?{name}\b""", file.read_text()
            )
            assert known or not assigned, f"{file.name} has no argument {name}"


def test_remapped_names_are_those_of_the_loop() -> None:
    for page in GUIDE:
        for name in re.findall(r"-r (\w+):=", page.read_text()):
            assert name in {"measurement", "command", "other_commands", "setpoint", "__ns"}


def test_every_flag_in_the_text_is_one_of_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    known = {"--ros-args", "--params-file"}
    for name in sorted(EXECUTABLES):
        if name.endswith("_node"):
            continue
        with pytest.raises(SystemExit):
            importlib.import_module(f"relay_autotune.cli.{name}").main(["--help"])
        known |= set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
    # Those of the benchmarks are in a folder of their own, and Dask's in the page on security.
    others = {ROOT / "docs/benchmarks.md", ROOT / "docs/security.md"}
    for page in set(GUIDE) - others:
        for span in re.findall(r"`(--[a-z][^`]*)`", page.read_text()):
            assert span.split()[0] in known, f"{page.name}: {span}"


def test_methods_rules_structures_and_modes_each_have_their_place() -> None:
    def titles(page: str, level: str = "##") -> set[str]:
        found = re.findall(rf"^{level} ([a-z0-9_]+)$", (ROOT / page).read_text(), re.MULTILINE)
        return set(found)

    for page, known in (("docs/methods.md", METHODS), ("docs/rules.md", RULES)):
        assert not set(known) - titles(page), f"{page} lacks a section named for each of these"
        assert not titles(page) - set(known), f"{page} has sections on what does not exist"
    structures = [row[0].strip("`") for row in rows("docs/plant.md", "structure")]
    assert structures == list(STRUCTURES[:-1])
    assert [row[0].strip("`") for row in rows("docs/plant.md", "mode")] == list(MODES)


def test_every_interface_is_in_the_guide() -> None:
    shown = {row[0].strip("`") for row in rows("docs/messages.md", "definition")}
    there = (ROOT / "relay_autotune_msgs").glob("*/*.*")
    files = {str(f.relative_to(ROOT)) for f in there if f.suffix in (".msg", ".srv", ".action")}
    assert shown == files


@pytest.mark.long
def test_the_guide_has_the_fields_of_the_document() -> None:
    bag = ROOT / "bags/biased_relay"
    found = document(str(bag), [analysed_once(read_experiments(bag).experiments[0])])
    (experiment,) = found["experiments"]
    model = experiment["models"][0]
    page = (ROOT / "docs/replay.md").read_text()
    for what, fields in {
        "an experiment": experiment,
        "`relay`": experiment["relay"],
        "`limit_cycle`": experiment["limit_cycle"],
        "a model": model,
        "`fit`": model["fit"],
        "gains": experiment["gains"][0],
    }.items():
        listed = page.partition(f"\nFields of {what}:\n\n")[2].partition("\n\n")[0]
        assert re.findall(r"^- `(\w+)`:", listed, re.MULTILINE) == list(fields)


@pytest.mark.parametrize(
    ("page", "known"),
    [("docs/methods.md", METHODS), ("docs/rules.md", RULES)],
    ids=["methods", "rules"],
)
def test_each_method_and_rule_has_a_source_and_says_when_it_fails(page: str, known: Any) -> None:
    text = (ROOT / page).read_text()
    for name in known:
        section = re.search(rf"^## {name}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)[1]
        sourced = r"\b(18|19|20)\d\d\b|the same paper|the paper's|Thyagarajan and Yu's"
        same_as = r"[Tt]he same with|as for `"
        assert re.search(f"{sourced}|{same_as}", section, re.IGNORECASE), f"{name} has no source"
        equations = r"```|^\| |" + same_as + r"|kc of \+2 dB"
        assert re.search(equations, section, re.MULTILINE), f"{name} has no equation"
        limits = r"fails|misleads|is refused|It is for|for a stable|needs|is slow|matters|unstable"
        assert re.search(limits, section), f"{name} does not say when it fails"
