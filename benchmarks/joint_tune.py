# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time from `tune_loop --controller NAME --joint NAME` to verified gains, on a simulated robot.

Usage, after `. ./env.sh`:

    python3 benchmarks/joint_tune.py [--runs 5]

The robot is the stand-in of the tests (test/support/robot.py): two wheels of 0.5 s ultimate period
under a controller at 100 Hz. No file is edited. Exit status 1 if gains are not verified.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

from markdown import table

# The rig and the robot are those of the tests.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from loop_rig import Rig
from robot_rig import Robot
from ros_domain import free_domain

from relay_autotune import analyse, read_records

# Of the simulated wheels, in closed form: w D + atan(w T) = pi.
TRUE_ULTIMATE_GAIN = 3.13
WAYS = {"stays active": (), "`--open`": ("--open",)}


def run(words: tuple[str, ...]) -> tuple[float, float] | None:
    """Return the time [s] and the relative error of K_u of one tune; None: not verified."""
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        rig = Rig(domain, Path(folder))
        try:
            robot = Robot(rig)
            begun = time.monotonic()
            done = robot.tune(*words)
            status = done.wait(300.0)
            seconds = time.monotonic() - begun
            if status != 0:
                print(done.log, file=sys.stderr)
                return None
            (tuned,) = (rig.folder / ".ros" / "relay_autotune").glob("*/")
            (record,) = read_records(tuned)
            model = analyse(record).model
            return seconds, model.ultimate_gain / TRUE_ULTIMATE_GAIN - 1.0
        finally:
            rig.close()


def main() -> int:
    """Print the table; return 1 if gains are not verified."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one run each: does it run?")
    options = parser.parse_args()
    count = 1 if options.quick else options.runs
    rows, failed = [], False
    for way, words in WAYS.items():
        found = [done for _ in range(count) if (done := run(words))]
        failed |= len(found) < count
        seconds, errors = zip(*found, strict=True) if found else ((float("nan"),), (0.0,))
        rows.append(
            (
                way,
                f"{len(found)} of {count}",
                f"{statistics.median(seconds):.0f} s",
                f"{max(seconds):.0f} s",
                f"{100.0 * max(errors, key=abs):+.1f} %",
            )
        )
    print(table(("the controller", "verified", "median", "longest", "largest error of K_u"), rows))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
