# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The faults of docs/safety.md over real DDS, again and again at random moments.

Usage, after `. ./env.sh`:

    python3 benchmarks/fault_table.py [--runs 200] [--minutes 60] [--workers 2] \
        [--only TEXT,TEXT] [--quick]

The faults and the loop are those of test/system/test_faults.py, see test/support/faults.py: a run
has passed if the tune ended with the expected reason and outcome, the safe command is the last one
and stays, and no gains came. One relay_node serves all runs of a worker but for those that end it.
The time is from the cause to the safe command's arrival here; it holds what a fault takes to show,
such as the watchdog's time. Exit status 1 if a run fails.
"""

from __future__ import annotations

import argparse
import multiprocessing
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np
from markdown import table

# The rig and the faults are those of the tests.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from faults import FAULTS
from faulty_loop import Loop
from loop_rig import Rig
from ros_domain import free_domain

RUNS = 200
# Messages of an ended process may arrive for this time [s].
_LAST_WORDS = 1.0
# Faults in one process, one loop for all.
_TOGETHER = 4


@dataclass(frozen=True)
class Run:
    """The result of a fault.

    :param fault: its name.
    :param seconds: from the cause to the safe command.
    :param problem: what was wrong; empty: nothing.
    """

    fault: str
    seconds: float
    problem: str = ""


def work(names: list[str], runs: int, deadline: float) -> list[Run]:
    """Make faults of one loop in turn, each so often, or until a deadline on the steady clock."""
    found: list[Run] = []
    with ExitStack() as stack:
        rig = Rig(
            stack.enter_context(free_domain()),
            Path(stack.enter_context(tempfile.TemporaryDirectory())),
        )
        stack.callback(rig.close)
        loop = Loop(rig, FAULTS[names[0]].kind)
        rig.identifier()
        for count in range(runs):
            for name in names:
                if time.monotonic() > deadline:
                    return found
                try:
                    taken = FAULTS[name].course(loop, Random(f"{name} {count}"))
                except AssertionError as error:
                    problem = str(error).partition("\n")[0] or "not as it must be"
                    found.append(Run(name, np.nan, problem))
                    print(f"{name}, run {count}: {error}", file=sys.stderr, flush=True)
                    # The next one begins with a relay of its own.
                    if loop.process is not None:
                        loop.process.end()
                        loop.process = None
                        # Its last messages do not belong to the next fault.
                        loop.rig.run_for(_LAST_WORDS)
                else:
                    found.append(Run(name, taken))
    return found


def shares(names: list[str]) -> list[list[str]]:
    """Return the faults of each process, which has one kind of loop.

    Fast DDS sizes the samples of a topic once in a process, whatever their type and domain: after
    a loop with a Float32, one with a Float64 on the same topic would hear nothing.
    """
    found = []
    for kind in dict.fromkeys(FAULTS[name].kind for name in names):
        of_kind = [name for name in names if FAULTS[name].kind == kind]
        found += [of_kind[k : k + _TOGETHER] for k in range(0, len(of_kind), _TOGETHER)]
    return found


def end_in_order() -> None:
    """Let a worker that is ended end the processes that it has started."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))


def row(name: str, runs: list[Run]) -> tuple[object, ...]:
    """Return a fault's row of the table."""
    times = [run.seconds for run in runs if not run.problem]
    shown = (f"{np.median(times):.2f}", f"{max(times):.2f}") if times else ("", "")
    return (name, len(runs), len(times), *shown)


def main() -> int:
    """Run the faults and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=RUNS, help="runs for each fault")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after so long")
    parser.add_argument("--workers", type=int, default=2, help="loops at a time")
    parser.add_argument("--only", default="", help="faults with one of these in their names, A,B")
    parser.add_argument("--quick", action="store_true", help="one fault, once")
    asked = parser.parse_args()
    deadline = time.monotonic() + 60.0 * asked.minutes
    names = [name for name in FAULTS if any(text in name for text in asked.only.split(","))]
    if asked.quick:
        found = work(names[:3][-1:], 1, deadline)
    else:
        with multiprocessing.get_context("spawn").Pool(
            asked.workers, end_in_order, maxtasksperchild=1
        ) as pool:
            tasks = [(share, asked.runs, deadline) for share in shares(names)]
            parts = pool.starmap(work, tasks, chunksize=1)
        found = [run for part in parts for run in part]
    by_name = {name: [run for run in found if run.fault == name] for name in names}
    headings = ("fault", "runs", "passed", "cause to safe command, median [s]", "longest [s]")
    print(table(headings, [row(name, runs) for name, runs in by_name.items() if runs]))
    return 1 if any(run.problem for run in found) else 0


if __name__ == "__main__":
    sys.exit(main())
