# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time of many bags, one job and two: `python3 benchmarks/fleet_time.py [--count N] [--quick]`.

The bags are step tests of 60 s at 10 Hz, each with noise of its own; `replay` writes their results
to a file. The whole processes are timed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from markdown import table, three

from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant

BAGS, QUICK_BAGS = 1000, 1
START = 1_790_000_000_000_000_000


def make(folder: Path, count: int) -> list[str]:
    """Make bags and return their names."""
    model = TransferFunction.fopdt(0.8, 6.0, 1.7)
    at = np.arange(0.0, 60.0, 0.1)
    step = PiecewiseConstant(np.array([5.0]), np.array([40.0]), 30.0)
    clean = 20.0 + response(model, at, step)
    command = step(at)
    topics = [Topic("/measurement"), Topic("/command")]
    names = []
    for number in range(count):
        noise = np.random.default_rng(number).normal(0.0, 0.02, at.size)
        names.append(f"bag_{number:04d}")
        with BagWriter(folder / names[-1], topics, start_ns=START) as bag:
            for t, y, u in zip(at, clean + noise, command, strict=True):
                stamp = START + round(t * 1e9)
                bag.write("/measurement", stamp, stamp, encode_float64(y))
                bag.write("/command", stamp, stamp, encode_float64(u))
    return names


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one bag: does it run?")
    parser.add_argument("--count", type=int, default=BAGS, help="bags (%(default)s)")
    options = parser.parse_args()
    replay = shutil.which("replay")
    if replay is None:
        print("fleet_time: replay is not on the PATH: source env.sh", file=sys.stderr)
        return 1
    count = QUICK_BAGS if options.quick else options.count
    times: dict[int, float] = {}
    with tempfile.TemporaryDirectory(prefix="fleet_time_") as name:
        folder = Path(name)
        bags = make(folder, count)
        for jobs in (1, 2):
            begin = time.perf_counter()
            # Choice of structure and PID would only take longer, in one process as in two.
            flags = ["--structure", "fopdt", "--controller", "pi"]
            flags += ["--jobs", str(jobs), "--output", f"{jobs}.jsonl"]
            subprocess.run(
                [replay, *flags, *bags],
                cwd=folder, env=os.environ, check=True, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            times[jobs] = time.perf_counter() - begin
        one, two = (sorted((folder / f"{jobs}.jsonl").read_text().splitlines()) for jobs in (1, 2))
        assert one == two
        assert len(one) == count
    rows = [
        (jobs, three(seconds), three(1e3 * seconds / count), three(times[1] / seconds))
        for jobs, seconds in times.items()
    ]
    print(f"{count} bags; both give the same documents to the last digit.\n")
    print(table(("jobs", "[s]", "[ms] a bag", "faster (target >= 1.8)"), rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
