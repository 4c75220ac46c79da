# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Run benchmarks, one by its name or a whole group, and keep what they print.

    . ./env.sh && python3 benchmarks [NAME or GROUP ...] [--keep] [-- FLAGS]

Without names it lists the groups. With --keep the tables go to benchmarks/results/NAME.md.
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
GROUPS = {
    "identification": (
        *("accuracy", "target_spread", "structure_choice", "coverage", "coloured_noise"),
        *("unmodelled", "ah_batch", "confident", "first_tries", "limits"),
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

_PLACE = re.compile(r"(?<=<!-- results -->\n).*?(?=<!-- end -->)", re.DOTALL)


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


def keep(name: str, block: str) -> bool:
    """Put what a benchmark printed into its file; return whether it has one."""
    file = HERE / "results" / f"{name}.md"
    if not file.is_file():
        return False
    file.write_text(_PLACE.sub(lambda _: f"\n{block}\n\n", file.read_text()))
    return True


def main() -> int:
    """Run what is asked for."""
    own, flags = sys.argv[1:], []
    if "--" in own:
        own, flags = own[: own.index("--")], own[own.index("--") + 1 :]
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks or groups of them")
    parser.add_argument("--keep", action="store_true", help="write to benchmarks/results")
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
        if not options.keep:
            continue
        found = done.stdout.strip()
        if not found or not keep(name, f"{where}\n\n{found}"):
            why = (
                "benchmarks/results has no file for it"
                if found
                else f"no table, exit {done.returncode}"
            )
            print(f"benchmarks: {name}: {why}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
