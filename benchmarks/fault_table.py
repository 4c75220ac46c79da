"""The faults of docs/safety.md over real DDS, again and again at random moments.

Usage, after `. ./env.sh`:

    python3 benchmarks/fault_table.py [--runs 200] [--quick]

One relay_node serves all runs, as in test/system/test_faults.py, from which the faults come. A
run has passed if the tune ended with the expected reason and outcome, the safe command is the
last one and stays, and no gains came. The time is from the cause to the safe command's arrival
here; it holds what a fault takes to show, such as the watchdog's time. Exit status 1 if one fails.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

from markdown import table

# The rig and the faults are those of the tests.
TEST = Path(__file__).resolve().parents[1] / "test"
sys.path[:0] = [str(TEST / "support"), str(TEST / "system")]

import numpy as np  # noqa: E402
from loop_rig import Rig  # noqa: E402
from ros_domain import free_domain  # noqa: E402
from test_faults import DEFAULTS, FAULTS, RELAY, SAFE, Loop  # noqa: E402

RUNS = 200


def one_run(loop: Loop, fault: str) -> float:
    """Make a fault once and return the time to the safe command [s].

    :raises AssertionError: if anything is not as it must be.
    """
    cause, moment, parameters, said = FAULTS[fault]
    loop.set(**{**DEFAULTS, **parameters})
    loop.tune()
    if moment == "oscillating":
        loop.until_it_oscillates()
        loop.rig.run_for(random.uniform(0.0, 0.4))
    began = time.monotonic()
    cause(loop)
    if moment == "start":
        # The command is still the safe one of the run before.
        loop.ended()
    loop.rig.until(lambda: loop.commands[-1].data == SAFE, "the safe command")
    taken = time.monotonic() - began
    ended = loop.ended()
    assert said in ended.reason, ended.reason
    assert not loop.gains
    loop.reset()
    count = len(loop.commands)
    loop.rig.until(lambda: len(loop.commands) > count + 5, "commands after the tune")
    assert {m.data for m in loop.commands[count:]} == {SAFE}
    return taken


def main() -> int:
    """Run the faults and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=RUNS, help="runs for each fault")
    parser.add_argument("--quick", action="store_true", help="one fault, once")
    asked = parser.parse_args()
    random.seed(1)
    rows, failures = [], 0
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        rig = Rig(domain, Path(folder))
        try:
            loop = Loop(rig)
            rig.relay(**RELAY)
            rig.identifier()
            for fault in list(FAULTS)[:1] if asked.quick else FAULTS:
                taken, failed = [], 0
                for _ in range(1 if asked.quick else asked.runs):
                    try:
                        taken.append(one_run(loop, fault))
                    except AssertionError as error:
                        failed += 1
                        print(f"{fault}: {str(error).splitlines()[0]}", file=sys.stderr)
                failures += failed
                times = np.array(taken or [float("inf")])
                rows.append(
                    (
                        fault,
                        len(taken) + failed,
                        len(taken),
                        f"{np.median(times):.2f}",
                        f"{times.max():.2f}",
                    )
                )
        finally:
            rig.close()
    headings = ("fault", "runs", "passed", "cause to safe command, median [s]", "longest [s]")
    print(table(headings, rows))
    return 1 if failures and not asked.quick else 0


if __name__ == "__main__":
    sys.exit(main())
