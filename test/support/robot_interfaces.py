# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The messages of ros2_control for the tests: those that are installed, else stand-ins.

ros2_control does not come as wheels. The stand-ins have the same names, fields and order; they are
built once, into build/. A command that needs them begins with

    python3 test/support/robot_interfaces.py COMMAND
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

SOURCES = Path(__file__).parent / "interfaces"
PACKAGES = ("control_msgs", "controller_manager_msgs")
BUILT = Path(__file__).parents[2] / "build" / "test_interfaces"


def interfaces() -> dict[str, str]:
    """Return the variables with which a process finds the messages."""
    if all(map(find_spec, PACKAGES)):
        return {}
    place = BUILT / _digest()
    BUILT.mkdir(parents=True, exist_ok=True)
    with (BUILT / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "done").exists():
            _build(place)
            (place / "done").touch()
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    added = {
        "AMENT_PREFIX_PATH": place,
        "PYTHONPATH": place / "lib" / version / "site-packages",
        "LD_LIBRARY_PATH": place / "lib",
    }
    return {
        name: os.pathsep.join(filter(None, (str(path), os.environ.get(name, ""))))
        for name, path in added.items()
    }


def _digest() -> str:
    found = hashlib.sha256(f"{sys.version} {os.environ.get('AMENT_PREFIX_PATH')}".encode())
    for file in sorted(SOURCES.rglob("*")):
        if file.is_file():
            found.update(str(file.relative_to(SOURCES)).encode() + file.read_bytes())
    return found.hexdigest()[:16]


def _build(place: Path) -> None:
    for package in PACKAGES:
        work = place / "work" / package
        options = {
            "CMAKE_INSTALL_PREFIX": place,
            "CMAKE_BUILD_TYPE": "",
            "CMAKE_CXX_FLAGS": "-O0",
            "CMAKE_C_FLAGS": "-O0",
            "Python3_EXECUTABLE": sys.executable,
        }
        given = [f"-D{name}={value}" for name, value in options.items()]
        make = ["cmake", "--build", str(work), "--target", "install", f"-j{os.cpu_count() or 1}"]
        folders = ["-S", str(SOURCES / package), "-B", str(work)]
        for command in (["cmake", "-Wno-dev", *folders, *given], make):
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"


if __name__ == "__main__":
    os.execvpe(sys.argv[1], sys.argv[1:], os.environ | interfaces())
