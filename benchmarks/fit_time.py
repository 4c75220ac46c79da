"""Time and memory of the FOPDT waveform fit: `python3 benchmarks/fit_time.py [--quick]`."""

from __future__ import annotations

import argparse
import sys
import tracemalloc
from functools import partial

from markdown import table, three
from reference import take_turns

# isort: split
import numpy as np
from cases import CASES

from relay_autotune.identification import Known, identify
from relay_autotune.record import Record
from relay_autotune.simulation import simulate_relay

TARGET = 0.060
RATIOS = (0.0, 0.1)
FOPDT = Known(structure="fopdt")
TURNS = {1_000: 41, 10_000: 15, 100_000: 7, 1_000_000: 3}
QUICK = {1_000: 3, 10_000: 1}


def record(samples: int, ratio: float) -> Record:
    """Return five cycles of 1.65 e^(-10 s)/(20 s + 1) in so many samples.

    :param samples: their number.
    :param ratio: noise-to-signal ratio.
    """
    case = CASES[0]
    end = float(case.run.time[-1])
    time = np.linspace(0.0, end, samples)
    run = simulate_relay(case.model, case.settings(0.0), cycles=7, time=time)
    return run.record(noise_std=case.noise_std(ratio), rng=np.random.default_rng(1))


def peak_memory(of: Record) -> float:
    """Return the peak of what a fit allocates [MB]."""
    tracemalloc.start()
    try:
        identify(of, "waveform", FOPDT)
        return tracemalloc.get_traced_memory()[1] * 1e-6
    finally:
        tracemalloc.stop()


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few and small fits: does it run?")
    options = parser.parse_args()
    rows, reference = [], []
    for samples, turns in (QUICK if options.quick else TURNS).items():
        records = {ratio: record(samples, ratio) for ratio in RATIOS}
        works = {f"{r:g}": partial(identify, records[r], "waveform", FOPDT) for r in RATIOS}
        timings = take_turns(works, turns)
        reference.append(timings["reference"].seconds)
        for ratio in RATIOS:
            timing = timings[f"{ratio:g}"]
            rows.append(
                (
                    f"{samples:,}",
                    f"{ratio:g}",
                    turns,
                    three(1e3 * timing.seconds),
                    three(timing.multiple),
                    three(1e6 * timing.seconds / samples),
                    three(peak_memory(records[ratio])),
                    f"<= {1e3 * TARGET:g}" if samples == 1_000 else "",
                )
            )
    headings = ("samples", "NSR", "runs", "median [ms]", "x reference", "us/sample", "peak [MB]")
    print(table((*headings, "target [ms]"), rows))
    print(f"\nreference workload: {three(1e3 * float(np.median(reference)))} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())
