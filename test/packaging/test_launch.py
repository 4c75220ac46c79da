# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Launch files, parameter files and layouts name only what there is.

`ros2 launch` itself is no requirement of the tests, so the files are read as what they are: XML,
YAML and Python.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import pytest
import yaml
from pages import ROOT, rows
from parameter_values import check_parameter_file

from relay_autotune.quantities import Quantity
from tools.fill_docs import PARAMETER_FILE, TABLES, parameter_file

SHARE = "$(find-pkg-share relay_autotune)/"
EXECUTABLES = set(re.findall(r'"(\w+) = relay_autotune', (ROOT / "setup.py").read_text()))
DECLARATIVE = sorted((ROOT / "launch").glob("*.launch.xml")) + sorted(
    (ROOT / "launch").glob("*.launch.yaml")
)
# That which checks arguments is started by the others alone.
CHECK = ROOT / "launch/arguments.launch.py"
PYTHON = sorted(set((ROOT / "launch").glob("*.launch.py")) - {CHECK})
SEVERAL = ROOT / "config/several_loops.yaml"
PARAMETER_FILES = [f for f in sorted((ROOT / "config").glob("*.yaml")) if f != SEVERAL]

Action = tuple[str, dict[str, Any]]


def by_file(files: list[Path]) -> Any:
    return pytest.mark.parametrize("file", files, ids=lambda f: f.name)


def actions(file: Path) -> list[Action]:
    """Return every action of a launch file, with its attributes and what is within it."""
    if file.suffix == ".xml":
        return list(from_xml(ElementTree.parse(file).getroot()))
    return list(from_yaml(yaml.safe_load(file.read_text())["launch"]))


def from_xml(element: ElementTree.Element) -> Iterator[Action]:
    for child in element:
        inner: dict[str, Any] = dict(child.attrib)
        for part in child:
            inner.setdefault(part.tag, []).append(dict(part.attrib))
        yield child.tag, inner
        if child.tag == "group":
            yield from from_xml(child)


def from_yaml(entries: list[dict[str, Any]]) -> Iterator[Action]:
    for entry in entries:
        ((tag, inner),) = entry.items()
        if tag == "group":
            yield from from_yaml(inner)
        else:
            yield tag, inner


def declared_arguments(file: Path) -> set[str]:
    if file.suffix == ".py":
        return set(re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', file.read_text()))
    return {inner["name"] for tag, inner in actions(file) if tag == "arg"}


def names_of(node: str) -> set[str]:
    """Return the names of a node's topics."""
    return {name.strip("`") for n, _, name, _ in rows("docs/messages.md", "node") if node in n}


def entries_of(node: str) -> dict[str, Quantity]:
    return {entry.name: entry for entry in TABLES[node]}


def test_there_are_launch_files_in_all_formats() -> None:
    assert {f.suffix for f in DECLARATIVE} == {".xml", ".yaml"}
    assert PYTHON


@by_file(DECLARATIVE)
def test_a_launch_file_starts_what_there_is(file: Path) -> None:
    started = [inner for tag, inner in actions(file) if tag == "node"]
    for node in started:
        assert node["pkg"] == "relay_autotune"
        assert node["exec"] in EXECUTABLES
        for parameter in node.get("param", []):
            known = {*entries_of(node["exec"]), "use_sim_time"}
            assert set(parameter) == {"from"} or parameter["name"] in known
        for remap in node.get("remap", []):
            assert remap["from"] in names_of(node["exec"])
    assert started or [inner for tag, inner in actions(file) if tag == "include"]


@by_file(DECLARATIVE)
def test_a_launch_file_refers_to_what_there_is(file: Path) -> None:
    text = file.read_text()
    arguments = declared_arguments(file)
    assert set(re.findall(r"\$\(var (\w+)\)", text)) <= arguments
    for path in re.findall(re.escape(SHARE) + r"([\w./]+)", text):
        assert (ROOT / path).is_file(), f"{file.name} names {path}"
    for tag, inner in actions(file):
        if tag == "arg":
            assert inner.get("description"), f"{inner['name']} has no description"
        if tag == "include":
            included = ROOT / inner["file"].removeprefix(SHARE)
            assert {arg["name"] for arg in inner.get("arg", [])} <= declared_arguments(included)


@by_file(DECLARATIVE + PYTHON)
def test_the_commands_in_a_launch_file_are_for_it(file: Path) -> None:
    """The comment at its top shows how to use it."""
    text = file.read_text()
    (called,) = re.findall(r"ros2 launch relay_autotune (\S+)(.*)$", text, re.MULTILINE)
    assert called[0] == file.name
    arguments = set(re.findall(r" (\w+):=", called[1]))
    known = {"loops"} if file.suffix == ".py" else declared_arguments(file)
    assert arguments <= known


@by_file(PYTHON)
def test_a_python_launch_file_starts_what_there_is(file: Path) -> None:
    calls = [n for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.Call)]
    found = {
        keyword.arg: ast.literal_eval(keyword.value)
        for call in calls
        for keyword in call.keywords
        if keyword.arg in ("package", "executable")
    }
    assert found["package"] == "relay_autotune"
    assert found["executable"] in EXECUTABLES
    paths = [
        "/".join(ast.literal_eval(part) for part in call.args[0].elts[1:])
        for call in calls
        if getattr(call.func, "id", "") == "PathJoinSubstitution"
    ]
    assert paths
    assert all((ROOT / path).is_file() for path in paths)


def test_the_loops_of_the_example_are_such_as_the_launch_file_takes() -> None:
    text = (ROOT / "launch/several_loops.launch.py").read_text()
    keys = ast.literal_eval(re.search(r"^KEYS = (\{.*\})$", text, re.MULTILINE)[1])
    assert keys - {"simulate"} == declared_arguments(ROOT / "launch/tune.launch.xml")
    loops = yaml.safe_load(SEVERAL.read_text())["loops"]
    assert len({loop["namespace"] for loop in loops}) == len(loops) >= 2
    for loop in loops:
        assert set(loop) <= keys
        assert (SEVERAL.parent / loop["params"]).is_file()
    for key in keys:
        assert f"#   {key} " in SEVERAL.read_text(), f"the example does not say what {key} is"


@by_file(PARAMETER_FILES)
def test_a_parameter_file_gives_what_the_nodes_take(file: Path) -> None:
    content = yaml.safe_load(file.read_text())
    assert content
    check_parameter_file(content, TABLES)


def test_the_file_of_all_parameters_holds_the_defaults() -> None:
    assert PARAMETER_FILE.read_text() == parameter_file(), "run `python3 -m tools.fill_docs`"


# Layouts.


def type_of(topic: str) -> Any:
    """Return the message type of a topic in the root namespace, by the page that lists them."""
    types = {
        "/" + name.strip("`").lstrip("/"): kind.strip("`")
        for _, what, name, kind in rows("docs/messages.md", "node")
        if what in ("publishes", "subscribes")
    }
    package, _, name = types[topic].split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def check_field(topic: str, path: list[str]) -> None:
    """See that a message has a field, by its path, and that it holds numbers."""
    kind: Any = type_of(topic)
    for depth, part in enumerate(path):
        name, _, index = part.partition("[")
        fields = kind.get_fields_and_field_types()
        assert name in fields, f"{topic} has no field {'.'.join(path[: depth + 1])}"
        field = fields[name]
        assert field.startswith("sequence") == bool(index), f"{topic}.{name} is {field}"
        if depth < len(path) - 1:
            package, _, inner = field.partition("/")
            kind = getattr(importlib.import_module(f"{package}.msg"), inner)
    assert re.search(r"double|float|int", field), f"{topic}.{name} is {field}, which has no curve"


def panels() -> dict[str, dict[str, Any]]:
    return json.loads((ROOT / "config/foxglove.json").read_text())["configById"]


def test_the_foxglove_layout_shows_each_of_its_panels_once() -> None:
    layout = json.loads((ROOT / "config/foxglove.json").read_text())["layout"]

    def leaves(part: Any) -> list[str]:
        if isinstance(part, str):
            return [part]
        assert part["direction"] in ("row", "column")
        assert 0 < part["splitPercentage"] < 100
        return leaves(part["first"]) + leaves(part["second"])

    assert sorted(leaves(layout)) == sorted(panels())


# What each panel knows, from the sources of Lichtblick, whose panels are those of Foxglove Studio.
TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}
PANEL_KEYS = {
    "Plot": {
        *("paths", "showLegend", "legendDisplay", "showPlotValuesInLegend", "showXAxisLabels"),
        *("showYAxisLabels", "isSynced", "xAxisVal", "xAxisPath", "sidebarDimension"),
    },
    "RawMessages": {
        *("topicPath", "diffEnabled", "diffMethod", "diffTopicPath", "showFullMessageForDiff"),
        "expansion",
    },
    "DiagnosticSummary": {
        *("minLevel", "pinnedIds", "hardwareIdFilter", "topicToRender", "sortByLevel"),
    },
    "RosOut": {"searchTerms", "minLogLevel"},
    "CallService": {
        *("serviceName", "requestPayload", "layout", "buttonText", "buttonTooltip"),
        "buttonColor",
    },
}
PATH_KEYS = {"value", "label", "enabled", "color", "timestampMethod", "showLine"}


def test_the_foxglove_layout_has_what_its_program_demands() -> None:
    layout = json.loads((ROOT / "config/foxglove.json").read_text())
    # An import without one of these is refused.
    assert {"configById", "globalVariables", "playbackConfig", "layout"} <= set(layout)
    for name, panel in panels().items():
        assert set(panel) - TITLES <= PANEL_KEYS[name.partition("!")[0]], name
        assert len({panel.get(title) for title in TITLES}) == 1, name
        for path in panel.get("paths", []):
            assert set(path) == PATH_KEYS
        if panel.get("xAxisVal") == "currentCustom":
            assert panel["xAxisPath"]["enabled"]


def test_topics_and_fields_of_the_foxglove_layout_exist() -> None:
    plotted = 0
    for name, panel in panels().items():
        for path in [*panel.get("paths", []), *filter(None, [panel.get("xAxisPath")])]:
            topic, *fields = path["value"].split(".")
            check_field(topic, fields)
            plotted += 1
        for key in ("topicPath", "topicToRender"):
            if key in panel:
                type_of(panel[key])
        if name.startswith("CallService!"):
            check_service(panel["serviceName"], json.loads(panel["requestPayload"]))
    assert plotted > 5


def check_service(name: str, request: dict[str, Any]) -> None:
    services = {
        called.replace("~", f"/{node.strip('`')}").strip("`"): kind.strip("`")
        for node, what, called, kind in rows("docs/messages.md", "node")
        if what == "serves"
    }
    package, _, kind = services[name].split("/")
    fields = getattr(importlib.import_module(f"{package}.srv"), kind).Request
    assert set(request) <= set(fields.get_fields_and_field_types())


def test_topics_and_fields_of_the_plotjuggler_layout_exist() -> None:
    root = ElementTree.parse(ROOT / "config/plotjuggler.xml").getroot()
    curves = [curve.attrib["name"] for curve in root.iter("curve")]
    topics = set()
    for curve in curves:
        _, topic, *fields = curve.split("/")
        check_field(f"/{topic}", fields)
        topics.add(f"/{topic}")
    for selected in root.iter("selected_topics"):
        assert set(selected.attrib["value"].split(";")) == topics
    # Others than these are passed over in silence, and a plot without its element is empty.
    for plot in root.iter("plot"):
        assert plot.attrib["mode"] in ("TimeSeries", "XYPlot")
        assert plot.attrib["style"] in ("Lines", "LinesAndDots", "Dots", "Sticks", "Steps")
    assert all(area.find("plot") is not None for area in root.iter("DockArea"))
    # What streams in is kept so long [s]; a tune takes minutes, and the default is 30 s.
    assert 300 <= int(root.find("streaming_buffer_size").attrib["value"]) < 999
    for splitter in root.iter("DockSplitter"):
        assert splitter.attrib["orientation"] in ("-", "|")
        parts = [part for part in splitter if part.tag in ("DockArea", "DockSplitter")]
        assert int(splitter.attrib["count"]) == len(parts)
        assert len(splitter.attrib["sizes"].split(";")) == len(parts)


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the file that looks for misspelt arguments; its function needs no `ros2 launch`."""
    for name in ("launch", "launch.actions", "launch.substitutions", "launch_ros.substitutions"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    spec = importlib.util.spec_from_file_location("arguments", CHECK)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@by_file(DECLARATIVE)
def test_a_launch_file_has_its_own_arguments_checked_first(file: Path) -> None:
    others = [action for action in actions(file) if action[0] != "arg"]
    tag, inner = others[0]
    assert (tag, inner["file"]) == ("include", f"{SHARE}launch/{CHECK.name}")
    (known,) = inner["arg"]
    assert set(known["value"].split()) == declared_arguments(file)


def test_a_misspelt_launch_argument_is_refused(check: ModuleType) -> None:
    known = sorted(declared_arguments(ROOT / "launch/tune.launch.xml"))
    parameters = entries_of("relay_node")
    assert check.problems([*known, "known"], known, parameters) == []
    (told,) = check.problems(["measurment", "command"], known, parameters)
    assert told == "there is no launch argument measurment; did you mean measurement?"
    (told,) = check.problems(["amplitude"], known, parameters)
    assert "amplitude is a parameter of a node" in told and "params:=FILE" in told
    # of a launch file that includes ours
    assert check.problems(["robot_name", "loops", "simulate"], known, parameters) == []
