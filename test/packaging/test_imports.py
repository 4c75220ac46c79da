# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which package of the code may import which: downwards only."""

import ast
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# From the ground up. A package imports itself and those on floors below; two on one floor do not
# know each other.
FLOORS = (
    {"errors", "threads", "arrays"},
    {"expected_time", "scalar", "text"},
    {"quantities", "reasons"},
    {"record", "verdict"},
    {"process"},
    {"experiment"},
    {"identification"},
    {"loop"},
    {"control", "tuning"},
    {"result"},
    {"analysis"},
    {"exchange"},
    {"bag"},
    {"recordings"},
    {"report"},
    {"nodes"},
    {"web"},
    {"cli"},
)
FLOOR_OF = {name: number for number, names in enumerate(FLOORS) for name in sorted(names)}
# What brings ROS in; all else runs without it.
NUMERIC = ("errors", "reasons", "quantities", "scalar", "record", "process", "experiment",
           "identification", "loop", "control", "tuning", "result", "analysis",
           "exchange")  # fmt: skip
FOREIGN = {"numpy", "scipy"}


def package_of(module: str) -> str:
    return module.split(".")[1] if "." in module else "__init__"


@cache
def imports_of(file: Path) -> list[tuple[str, bool]]:
    """Return the modules that a file imports, with whether that happens when it is loaded."""
    tree = ast.parse(file.read_text())
    later = set()
    for node in ast.walk(tree):
        checking = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if checking or isinstance(node, ast.FunctionDef):
            later |= set(ast.walk(node))
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, node not in later) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append((node.module, node not in later))
            if (ROOT / node.module.replace(".", "/")).is_dir():
                found += [(f"{node.module}.{a.name}", node not in later) for a in node.names]
    return found


def files_of(package: str) -> list[Path]:
    folder = ROOT / "relay_autotune" / package
    return sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]


def test_every_package_has_its_floor():
    found = {
        path.stem
        for path in (ROOT / "relay_autotune").iterdir()
        if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    assert found - {"__init__", "start"} == set(FLOOR_OF)


@pytest.mark.long
@pytest.mark.parametrize("package", FLOOR_OF)
def test_a_package_imports_downwards_only(package):
    upwards = [
        f"{file.relative_to(ROOT)} imports {module}"
        for file in files_of(package)
        for module, at_load in imports_of(file)
        if at_load
        and module.startswith("relay_autotune.")
        and package_of(module) != package
        and FLOOR_OF[package_of(module)] >= FLOOR_OF[package]
    ]
    assert upwards == []


def test_the_reader_of_bags_could_leave_the_house():
    own = {
        module
        for file in files_of("bag")
        for module, _ in imports_of(file)
        if module.startswith("relay_autotune.")
    }
    others = {module for module in own if package_of(module) != "bag"}
    assert others == {"relay_autotune.errors"}


@pytest.mark.parametrize("package", NUMERIC)
def test_the_numeric_core_knows_no_ros_and_no_files(package):
    foreign = {
        module.partition(".")[0]
        for file in files_of(package)
        for module, at_load in imports_of(file)
        if at_load
    }
    assert foreign - {"relay_autotune", *sys.stdlib_module_names} <= FOREIGN


def test_no_modules_import_one_another():
    """A circle also counts if one of its imports is made late, or for type checkers alone."""
    files = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts): file
        for package in FLOOR_OF
        for file in files_of(package)
        if file.name != "__init__.py"
    }
    below = {name: {m for m, _ in imports_of(file)} & set(files) for name, file in files.items()}
    while leaves := {name for name in below if not below[name]}:
        below = {name: used - leaves for name, used in below.items() if name not in leaves}
    assert sorted(below) == [], "these import one another, or what does"
