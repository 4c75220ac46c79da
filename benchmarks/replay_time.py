# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time of `replay` beside that of its imports: `python3 benchmarks/replay_time.py [--quick]`.

Whole processes in turns: Python alone; numpy and those parts of scipy that `replay` uses; `replay`
of each bag in bags/, and of the demo's where `make demo` left one, with every method and rule.
The difference of the last two is our own.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from markdown import table, three
from reference import take_turns

ROOT = Path(__file__).resolve().parents[1]
BAGS, DEMO = ROOT / "bags", ROOT / "demo_output/bag"
TURNS = 10
TARGET = 0.7

# The public parts of scipy that are loaded once a bag was replayed.
_PARTS = """
import sys
from relay_autotune.cli.replay import main
main([sys.argv[1]])
parts = {".".join(name.split(".")[:2]) for name in sys.modules if name.startswith("scipy.")}
print(*sorted(p for p in parts if not p.split(".")[1].startswith("_")), file=sys.stderr)
"""


def run(command: Sequence[str]) -> str:
    """Run a process to its end; return what it said on standard error."""
    # An installed package has its bytecode; the first turn, which is not timed, writes it here.
    given = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(command, capture_output=True, text=True, env=given, check=True)
    return done.stderr


def scipy_parts(bag: Path) -> list[str]:
    """Return the modules of scipy that `replay` of a bag imports."""
    said = run([sys.executable, "-c", _PARTS, str(bag)])
    wanted = ("optimize", "special", "linalg", "signal", "integrate", "stats", "interpolate")
    return [name for name in said.split() if name.split(".")[-1] in wanted]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one turn of one bag: does it run?")
    options = parser.parse_args()
    replay = shutil.which("replay")
    if replay is None:
        print("replay_time: replay is not on the PATH: source env.sh", file=sys.stderr)
        return 1
    bags = sorted(path for path in BAGS.iterdir() if (path / "metadata.yaml").exists())
    if DEMO.is_dir():
        bags.insert(0, DEMO)
    parts = scipy_parts(bags[0])
    imports = f"import numpy, {', '.join(parts)}"
    works = {
        "python3 -c pass": partial(run, [sys.executable, "-c", "pass"]),
        f"python3 -c '{imports}'": partial(run, [sys.executable, "-c", imports]),
    }
    importing = list(works)[1]
    for bag in bags[:1] if options.quick else bags:
        works[f"replay {bag.relative_to(ROOT)}"] = partial(run, [replay, str(bag)])
    timings = take_turns(works, 1 if options.quick else TURNS, warm_up=not options.quick)
    base = timings[importing].seconds
    rows = [
        (
            f"`{name}`" if name != "reference" else "reference workload",
            three(1e3 * timing.seconds),
            three(timing.multiple),
            three(1e3 * (timing.seconds - base)) if name.startswith("replay ") else "",
        )
        for name, timing in timings.items()
    ]
    ours = f"beyond the imports [ms] (target <= {1e3 * TARGET:.0f})"
    print(table(("process", "median [ms]", "x reference", ours), rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
