# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Run benchmarks, one by its name or a whole group, and put their tables into the guide.

    . ./env.sh && python3 benchmarks [NAME or GROUP ...] [--page] [-- FLAGS]

Without names it lists the groups. With --page the tables go to their places in docs/benchmarks.md.
What follows -- goes to each benchmark, such as --quick.
"""

from __future__ import annotations

import argparse
import ast
import os
import platform
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs" / "benchmarks.md"
GROUPS = {
    "identification": (
        *("accuracy", "target_spread", "structure_choice", "coverage", "coloured_noise"),
        *("unmodelled", "ah_batch", "confident"),
    ),
    "design": ("design_known", "design_identified", "laws"),
    "time": (
        *(
            "fit_time",
            "design_time",
            "replay_time",
            "replay_shapes",
            "bag_reading",
            "joint_reading",
        ),
        *("fleet_time", "lockstep", "latency", "joint_tune", "endurance", "back_to_back"),
        *("page_latency", "page_load"),
    ),
    "papers": ("chang_studies", "thyagarajan_studies", "paper_designs"),
    "faults": (
        *("fault_table", "controller_kills", "random_histories", "simulated_experiments"),
        *("fuzz_bags", "fuzz_coverage", "fuzz_framing", "fuzz_requests"),
    ),
    "recordings": ("real_recordings", "verdicts"),
}

_PLACE = re.compile(r"<!-- results of (?P<name>\w+) -->\n.*?<!-- end -->", re.DOTALL)


def machine() -> str:
    """Return a sentence on where a run takes place."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    return (
        f"{os.cpu_count()} cores ({platform.machine()}), {platform.system()}, "
        f"Python {platform.python_version()}, {packages}; "
        f"load average before the run: {os.getloadavg()[0]:.1f}."
    )


def listing() -> str:
    """Return the groups with their benchmarks, and what each one measures."""
    lines = []
    for group, names in GROUPS.items():
        lines.append(group)
        for name in names:
            text = ast.get_docstring(ast.parse((HERE / f"{name}.py").read_text())) or ""
            lines.append(f"  {name:<22} {text.split(': `')[0].splitlines()[0]}")
    return "\n".join(lines)


def put_into_page(name: str, block: str) -> bool:
    """Put the results of a benchmark into its place of the page; return whether it has one."""
    page = PAGE.read_text()
    old = next((m[0] for m in _PLACE.finditer(page) if m["name"] == name), None)
    if old is None:
        return False
    PAGE.write_text(page.replace(old, f"<!-- results of {name} -->\n\n{block}\n\n<!-- end -->"))
    return True


def main() -> int:
    """Run what is asked for."""
    own, flags = sys.argv[1:], []
    if "--" in own:
        own, flags = own[: own.index("--")], own[own.index("--") + 1 :]
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks or groups of them")
    parser.add_argument("--page", action="store_true", help="put the tables into the guide")
    options = parser.parse_args(own)
    if not options.names:
        print(listing())
        return 0
    names = [name for asked in options.names for name in GROUPS.get(asked, (asked,))]
    known = [name for group in GROUPS.values() for name in group]
    if unknown := sorted(set(names) - set(known)):
        parser.error(f"no benchmark or group {', '.join(unknown)}; there are {', '.join(known)}")
    status = 0
    for name in names:
        print(name, file=sys.stderr)
        where = machine()
        command = [sys.executable, str(HERE / f"{name}.py"), *flags]
        # A missed target is a result, too.
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        print(done.stdout)
        status = status or done.returncode
        if not options.page:
            continue
        found = done.stdout.strip()
        if not found or not put_into_page(name, f"{where}\n\n{found}"):
            why = "the page has no place for it" if found else f"no table, exit {done.returncode}"
            print(f"benchmarks: {name}: {why}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
