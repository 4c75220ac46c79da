# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A shell that sources env.sh has the messages and the executables."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SHELLS = [shell for shell in ("bash", "dash", "sh", "zsh") if shutil.which(shell)]

pytestmark = pytest.mark.skipif(
    not (ROOT / "install/relay_autotune/.prepared").is_file(), reason="`make setup` has not run"
)


def run(shell: str, script: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run a script in a shell that knows nothing of ROS."""
    environment = {"HOME": os.environ.get("HOME", "/"), "PATH": os.defpath}
    return subprocess.run(
        [shell, "-c", script],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60.0,
    )


@pytest.mark.parametrize("shell", SHELLS)
def test_messages_import_in_the_repository(shell: str):
    """The folder relay_autotune_msgs/ there must not hide the built package."""
    code = "from relay_autotune_msgs.msg import RelayCycle; import relay_autotune, rclpy"
    done = run(shell, f'. ./env.sh && . ./env.sh && python3 -c "{code}"')
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("shell", SHELLS)
def test_executables_are_on_the_path(shell: str):
    done = run(shell, ". ./env.sh && command -v relay_node identifier_node plant_node replay")
    found = done.stdout.split()
    assert [Path(p).name for p in found] in (
        ["relay_node", "identifier_node", "plant_node", "replay"],
        ["relay_node"],  # dash looks at the first word alone
    )
    assert all(os.access(p, os.X_OK) for p in found)


def test_works_from_any_folder_in_bash(tmp_path: Path):
    done = run("bash", f". {ROOT}/env.sh && python3 -c 'import relay_autotune'", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("shell", SHELLS)
def test_adds_each_folder_once_and_no_empty_one(shell: str):
    """An empty entry of a search path would mean the folder that the user happens to be in."""
    names = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH")
    echo = "; ".join(f'echo "${name}"' for name in names)
    done = run(shell, f". ./env.sh; . ./env.sh; {echo}")
    for line in done.stdout.splitlines():
        folders = line.split(os.pathsep)
        assert "" not in folders
        ours = [f for f in folders if f.startswith(str(ROOT))]
        assert len(set(ours)) == len(ours)


def test_says_what_to_do_before_the_setup(tmp_path: Path):
    shutil.copy(ROOT / "env.sh", tmp_path)
    done = run("sh", ". ./env.sh", tmp_path)
    assert done.returncode != 0
    assert done.stderr.count("\n") == 1
    assert "make setup" in done.stderr
