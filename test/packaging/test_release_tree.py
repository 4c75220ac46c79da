# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The release tree: both packages side by side, as the ecosystem's tools look for them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOL = ROOT / "tools/release_tree.py"
PACKAGES = {"relay_autotune": "ros.ament_python", "relay_autotune_msgs": "ros.ament_cmake"}


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("release")
    subprocess.run([sys.executable, TOOL, folder], check=True, stdout=subprocess.DEVNULL)
    return folder


def test_two_packages_are_found_each_with_its_papers(tree):
    packages = pytest.importorskip("catkin_pkg.packages")
    warnings: list[str] = []
    found = packages.find_packages(str(tree), warnings=warnings)
    assert warnings == []
    assert set(found) == set(PACKAGES)
    for name in PACKAGES:
        for paper in ("package.xml", "LICENSE", "CHANGELOG.rst"):
            assert (tree / name / paper).is_file(), (name, paper)
            assert not (tree / name / paper).is_symlink(), (name, paper)


def test_changelogs_are_what_release_tools_read(tree):
    changelog = pytest.importorskip("catkin_pkg.changelog")
    for name in PACKAGES:
        assert changelog.get_changelog_from_path(str(tree / name), name) is not None


@pytest.mark.long
def test_colcon_lists_both_without_flags(tree):
    listed = subprocess.run(
        [sys.executable, "-m", "colcon", "list"],
        cwd=tree, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert {
        line.split("\t")[0]: line.split("(")[1].rstrip(")") for line in listed.splitlines()
    } == (PACKAGES)


def test_a_folder_that_is_not_empty_is_left_alone(tree):
    done = subprocess.run([sys.executable, TOOL, tree], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"release_tree: {tree} is not empty: name another folder\n"


@pytest.mark.nightly
def test_a_plain_colcon_build_installs_both(tree):
    environment = {**os.environ, "MAKEFLAGS": f"-j{os.cpu_count()}"}
    subprocess.run(
        [sys.executable, "-m", "colcon", "build", "--event-handlers", "console_direct-"],
        cwd=tree, check=True, env=environment,
    )  # fmt: skip
    assert (tree / "install/relay_autotune/lib/relay_autotune/relay_node").is_file()
    assert list((tree / "install/relay_autotune_msgs").rglob("PidGains.msg"))
