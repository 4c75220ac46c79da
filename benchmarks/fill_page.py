# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Run benchmarks and put their tables into docs/benchmarks.md.

    . ./env.sh && python3 benchmarks/fill_page.py [NAME ...]

A NAME is that of a file here without its suffix; by default all that the page has a place for.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs" / "benchmarks.md"

_PLACE = re.compile(r"<!-- results of (?P<name>\w+) -->\n.*?<!-- end -->", re.DOTALL)


def places(page: str) -> list[str]:
    """Return the names of the benchmarks that a page has a place for."""
    return [match["name"] for match in _PLACE.finditer(page)]


def machine() -> str:
    """Return a sentence on where a run takes place."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    return (
        f"{os.cpu_count()} cores ({platform.machine()}), {platform.system()}, "
        f"Python {platform.python_version()}, {packages}; "
        f"load average before the run: {os.getloadavg()[0]:.1f}."
    )


def results(name: str) -> str:
    """Run one benchmark and return what it printed.

    :raises CalledProcessError: if it printed nothing; a missed target is a result.
    """
    where = machine()
    done = subprocess.run(
        [sys.executable, str(HERE / f"{name}.py")], stdout=subprocess.PIPE, text=True, check=False
    )
    if not done.stdout.strip():
        raise subprocess.CalledProcessError(done.returncode, name)
    return f"{where}\n\n{done.stdout.strip()}"


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks; default: all")
    asked = parser.parse_args().names
    known = places(PAGE.read_text())
    unknown = sorted(set(asked) - set(known))
    if unknown:
        print(f"fill_page: no place for {unknown}; there is one for {known}", file=sys.stderr)
        return 2
    for name in asked or known:
        print(name, file=sys.stderr)
        try:
            block = f"<!-- results of {name} -->\n\n{results(name)}\n\n<!-- end -->"
        except subprocess.CalledProcessError as error:
            print(f"fill_page: {name} gave no table, exit {error.returncode}", file=sys.stderr)
            return 1
        page = PAGE.read_text()
        old = next(m[0] for m in _PLACE.finditer(page) if m["name"] == name)
        PAGE.write_text(page.replace(old, block))
    return 0


if __name__ == "__main__":
    sys.exit(main())
