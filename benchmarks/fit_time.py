# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time and memory of the waveform fit: `python3 benchmarks/fit_time.py [--quick]`."""

from __future__ import annotations

import argparse
import sys
import tracemalloc
from functools import partial

from markdown import table, three
from reference import Timing, take_turns

# isort: split
import numpy as np
from cases import CASES
from relay_runs import simulate_relay

from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.record.record import Record

# By structure and number of samples [ms].
TARGETS = {
    ("FOPDT", 1_000): 60,
    ("FOPDT", 1_000_000): 10_000,
    ("any", 1_000): 500,
    ("any", 1_000_000): 20_000,
}
RATIOS = (0.0, 0.1)
# A fit that takes longer than this is not repeated.
WARMED_UP = 1_000_000
STRUCTURES = {"FOPDT": Known(structure="fopdt"), "any": Known()}
# Turns of each number of samples.
TURNS = {
    "FOPDT": {1_000: 41, 10_000: 15, 100_000: 7, 1_000_000: 3},
    "any": {1_000: 7, 10_000: 5, 100_000: 3, 1_000_000: 3, 10_000_000: 1},
}
QUICK = {"FOPDT": {1_000: 3, 10_000: 1}}


def record(samples: int, ratio: float) -> Record:
    """Return five cycles of 1.65 e^(-10 s)/(20 s + 1) in a number of samples.

    :param samples: their number.
    :param ratio: noise-to-signal ratio.
    """
    case = CASES[0]
    end = float(case.run.time[-1])
    time = np.linspace(0.0, end, samples)
    run = simulate_relay(case.model, case.settings(0.0), cycles=7, time=time)
    return run.record(noise_std=case.noise_std(ratio), rng=np.random.default_rng(1))


def peak_memory(of: Record, known: Known) -> float:
    """Return the peak of what a fit allocates [MB]."""
    tracemalloc.start()
    try:
        identify(of, "waveform", known)
        return tracemalloc.get_traced_memory()[1] * 1e-6
    finally:
        tracemalloc.stop()


def rows(structure: str, samples: int, turns: int) -> tuple[list[tuple[object, ...]], Timing]:
    """Return a row for each of ``RATIOS``, and how long the reference took beside them."""
    known = STRUCTURES[structure]
    records = {ratio: record(samples, ratio) for ratio in RATIOS}
    works = {f"{r:g}": partial(identify, records[r], "waveform", known) for r in RATIOS}
    timings = take_turns(works, turns, warm_up=samples <= WARMED_UP)
    target = TARGETS.get((structure, samples))
    found: list[tuple[object, ...]] = []
    for ratio in RATIOS:
        timing = timings[f"{ratio:g}"]
        found.append(
            (
                structure,
                f"{samples:,}",
                f"{ratio:g}",
                turns,
                three(1e3 * timing.seconds),
                "" if target is None else f"<= {target:,}",
                three(timing.multiple),
                three(1e6 * timing.seconds / samples),
                three(peak_memory(records[ratio], known)),
            )
        )
    return found, timings["reference"]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few and small fits: does it run?")
    options = parser.parse_args()
    found, reference = [], []
    for structure, turns_of in (QUICK if options.quick else TURNS).items():
        for samples, turns in turns_of.items():
            some, beside = rows(structure, samples, turns)
            found += some
            reference.append(beside.seconds)
    headings = ("structure", "samples", "NSR", "runs", "median [ms]", "target [ms]")
    print(table((*headings, "x reference", "us/sample", "peak [MB]"), found))
    print(f"\nreference workload: {three(1e3 * float(np.median(reference)))} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())
