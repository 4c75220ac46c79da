# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Steps a second of a tune in lockstep: `python3 benchmarks/lockstep.py [--runs 5] [--quick]`.

Each run starts the three installed executables, plant_node, relay_node and identifier_node, in a
ROS domain of its own and tunes 1.65 e^(-10 s)/(20 s + 1) with noise. A step is one measurement
and the command that answers it; the time is from the accepted service call to the record, the
fits of the cycles included. The runs must give the same numbers to the last bit; the exit status
is 1 if they do not.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from markdown import table, three
from reference import clocked, workload

# isort: split
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from loop_rig import Rig
from ros_domain import free_domain

from relay_autotune_msgs.msg import PidGains, RelayExperiment

TARGET = 2000
SAMPLE_PERIOD = 0.02
QUICK_PERIOD = 0.5


@dataclass(frozen=True)
class Run:
    """One tune.

    :param steps: their number.
    :param seconds: how long they took.
    :param reference: how long the reference workload took around them [s].
    :param numbers: every sample and the gains, as bytes.
    """

    steps: int
    seconds: float
    reference: float
    numbers: bytes


def tune(period: float) -> Run:
    """Tune once.

    :param period: of the samples [s]; the shorter, the more steps.
    """
    reference = [clocked(workload) for _ in range(5)]
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain:
        rig = Rig(domain, Path(folder))
        try:
            experiments = rig.listen("relay_experiment", RelayExperiment)
            gains = rig.listen("pi_gains", PidGains)
            rig.plant(
                mode="lockstep",
                sample_period=period,
                structure="fopdt",
                gain=1.65,
                time_constants=[20.0],
                dead_time=10.0,
                noise_std=0.01,
                seed=7,
            )
            rig.relay(amplitude=1.0, baseline=0.0, sample_period=period)
            rig.identifier()
            rig.tune()
            start = time.monotonic()
            rig.until(lambda: experiments, "the record", 120.0)
            seconds = time.monotonic() - start
            rig.until(lambda: gains, "the gains")
        finally:
            rig.close()
    reference += [clocked(workload) for _ in range(5)]
    record, found = experiments[-1], gains[-1]
    numbers = b"".join(
        column.tobytes() for column in (record.time, record.measurement, record.command)
    )
    numbers += repr((list(record.cycle_start), found.kc, found.ti, found.ms)).encode()
    return Run(len(record.time), seconds, statistics.median(reference), numbers)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5, help="tunes, at least 2")
    parser.add_argument("--quick", action="store_true", help="one short tune: does it run?")
    options = parser.parse_args()
    period = QUICK_PERIOD if options.quick else SAMPLE_PERIOD
    runs = [tune(period) for _ in range(1 if options.quick else max(options.runs, 2))]
    rows: list[tuple[object, ...]] = [
        (
            index,
            run.steps,
            three(run.seconds),
            round(run.steps / run.seconds),
            three(1e3 * run.reference),
            three(run.seconds / run.steps / run.reference * 1e3),
        )
        for index, run in enumerate(runs, 1)
    ]
    rates = [run.steps / run.seconds for run in runs]
    rows.append(("median", "", "", round(statistics.median(rates)), "", ""))
    rows.append(("target", "", "", f">= {TARGET}", "", ""))
    headings = ("run", "steps", "s", "steps/s", "reference [ms]", "1,000 steps x reference")
    print(table(headings, rows))
    if len(runs) == 1:
        return 0
    same = all(run.numbers == runs[0].numbers for run in runs)
    print(f"\nthe same numbers in every run, to the last bit: {'yes' if same else 'NO'}")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
