# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The tests run in a shell with a sourced ROS, which brings plugins of its own for pytest."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# As in Jazzy: the argument `path` is gone from pytest 9, and the second plugin implements a hook
# that the first one declares.
PLUGINS = {
    "launch_testing": "def pytest_pycollect_makemodule(path, parent): ...",
    "launch_ros": "def pytest_launch_collect_makemodule(path, parent, entrypoint): ...",
}


@pytest.fixture
def site_packages(tmp_path: Path) -> Path:
    """Return a folder with what Jazzy's launch_testing and launch_testing_ros install there."""
    for name, hooks in PLUGINS.items():
        (tmp_path / f"{name}_hooks.py").write_text(f"{hooks}\n")
        info = tmp_path / f"{name}-3.4.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 3.4.2\n")
        (info / "entry_points.txt").write_text(f"[pytest11]\n{name} = {name}_hooks\n")
    return tmp_path


def run_a_test(site_packages: Path, *options: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(site_packages), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *options, "-k", "versions_agree",
         "test/packaging/test_metadata.py"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60.0,
    )  # fmt: skip


@pytest.mark.long
def test_the_plugins_of_a_sourced_ros_do_not_end_the_tests(site_packages: Path):
    # without our settings they do, or this would prove nothing
    bare = run_a_test(site_packages, "-c", os.devnull, "--rootdir", str(ROOT))
    assert "PluginValidationError" in bare.stdout + bare.stderr
    done = run_a_test(site_packages)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout
