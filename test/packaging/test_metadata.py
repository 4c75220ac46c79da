# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the package says of itself agrees with itself."""

import ast
import configparser
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from relay_autotune import start

ROOT = Path(__file__).resolve().parents[2]
MANIFESTS = [ROOT / "package.xml", ROOT / "relay_autotune_msgs/package.xml"]


def setup_arguments() -> dict[str, ast.expr]:
    """Return the arguments of the call of setup() in setup.py, as syntax."""
    tree = ast.parse((ROOT / "setup.py").read_text())
    (call,) = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and name_of(n) == "setup"]
    return {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg}


def name_of(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else ""


def console_scripts() -> list[str]:
    return ast.literal_eval(setup_arguments()["entry_points"])["console_scripts"]


def test_versions_agree():
    """One release, one version, wherever it is written."""
    changelog = (ROOT / "CHANGELOG.rst").read_text()
    package = (ROOT / "relay_autotune/__init__.py").read_text()
    versions = {
        "setup.py": ast.literal_eval(setup_arguments()["version"]),
        "CHANGELOG.rst": re.search(r"^(\d+\.\d+\.\d+) \(.*\)$", changelog, re.MULTILINE)[1],
        "relay_autotune/__init__.py": re.search(r'__version__ = "(.*)"', package)[1],
    }
    for manifest in MANIFESTS:
        versions[str(manifest.relative_to(ROOT))] = ElementTree.parse(manifest).findtext("version")
    assert len(set(versions.values())) == 1, versions


@pytest.mark.parametrize("script", console_scripts())
def test_executable_has_a_main(script: str):
    """An installed executable must not be one that cannot start."""
    name, begun = re.fullmatch(r"(\w+) = relay_autotune\.start:(\w+)", script).groups()
    assert name == begun
    module = getattr(start, name).args[0]
    file = ROOT / (module.replace(".", "/") + ".py")
    assert file.is_file(), f"{name} names {module}, which does not exist"
    defined = [n.name for n in ast.parse(file.read_text()).body if isinstance(n, ast.FunctionDef)]
    assert "main" in defined, f"{name} names {module}, which does not define main"


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda path: path.parent.name)
def test_manifest_is_valid(manifest: Path):
    """Without a valid manifest colcon takes the folder for something else, in silence."""
    package_parser = pytest.importorskip("catkin_pkg.package")
    warnings: list[str] = []
    package = package_parser.parse_package(str(manifest), warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.licenses == ["Apache-2.0"]


@pytest.mark.long
def test_manifest_names_what_is_imported():
    """Every distribution that the package imports is a dependency that rosdep can install."""
    keys = {
        "jinja2": "python3-jinja2",
        "lz4": "mcap-ros2-support",
        "zstandard": "mcap-ros2-support",
        "markupsafe": "python3-jinja2",
        "matplotlib": "python3-matplotlib",
        "mcap": "mcap-ros2-support",
        "numpy": "python3-numpy",
        "scipy": "python3-scipy",
        "tornado": "python3-tornado",
        "yaml": "python3-yaml",
    }
    manifest = ElementTree.parse(MANIFESTS[0])
    declared = {d.text for tag in ("depend", "exec_depend") for d in manifest.iter(tag)}
    needed = set()
    for file in (ROOT / "relay_autotune").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            needed |= {name.partition(".")[0] for name in names}
    needed -= {"relay_autotune", *sys.stdlib_module_names}
    # Only replay on a cluster or into a Parquet file needs these; it says so without them.
    optional = set(ast.literal_eval(setup_arguments()["extras_require"])["fleet"])
    assert optional <= needed
    needed -= optional
    assert {keys.get(name, name) for name in needed} <= declared


def test_executables_go_where_ros_looks():
    """`ros2 run` looks in lib/<package> alone."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    expected = "$base/lib/relay_autotune"
    assert config["develop"]["script_dir"] == config["install"]["install_scripts"] == expected


@pytest.mark.parametrize("page", ["README.md", "docs/install.md"])
def test_the_line_for_a_laptop_installs_all_that_a_recording_may_need(page: str) -> None:
    """Its page, its report and bags that are written need more than what is always there."""
    (asked,) = re.findall(r"^pip install '\.\[(.*)\]'$", (ROOT / page).read_text(), re.MULTILINE)
    optional = ast.literal_eval(setup_arguments()["extras_require"])
    assert set(asked.split(",")) == optional.keys() - {"fleet", "test"}
