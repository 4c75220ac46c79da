# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which structure the fit chooses: `python3 benchmarks/structure_choice.py [--records N]`.

Processes of every structure, in noise that the relay does not see; beside the choice, how good
the ultimate point is, and how often its interval covers the true one.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, field

from markdown import table
from processes import PROCESSES, Process, same_structure

# isort: split
import numpy as np

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.methods import identify
from relay_autotune.quantities import NORMAL_95

RECORDS = 30
RATIO = 0.1
EQUIVALENT = 0.02


@dataclass
class Choices:
    """What was chosen for one process.

    :param records: number of records tried.
    :param true: those that gave the true structure.
    :param good: those that gave it, or another one with K_u within 2 %.
    :param errors: relative errors of K_u and w_u, a pair for each model.
    :param covered: how many of their 95 % intervals hold the truth.
    :param others: the structures chosen in place of the true one.
    """

    records: int = 0
    true: int = 0
    good: int = 0
    errors: list[tuple[float, float]] = field(default_factory=list)
    covered: list[tuple[bool, bool]] = field(default_factory=list)
    others: Counter[str] = field(default_factory=Counter)


def choices(process: Process, records: int) -> Choices:
    """Return what is chosen for a number of records of a process."""
    tally, truth = Choices(records), process.truth
    for seed in range(records):
        try:
            found = identify(process.record(RATIO, seed))
        except IdentificationError:
            tally.others["none"] += 1
            continue
        gain = found.ultimate_gain - truth.gain
        frequency = found.ultimate_frequency - truth.frequency
        tally.errors.append((gain / truth.gain, frequency / truth.frequency))
        tally.covered.append(
            (
                abs(gain) <= NORMAL_95 * found.ultimate_gain_std,
                abs(frequency) <= NORMAL_95 * found.ultimate_frequency_std,
            )
        )
        if same_structure(found.model, process.model):
            tally.true += 1
            tally.good += 1
            continue
        tally.good += abs(tally.errors[-1][0]) <= EQUIVALENT
        lags = f" {order}" if (order := found.estimate.structure.given_order) else ""
        tally.others[found.structure + lags] += 1
    return tally


def row(title: str, tally: Choices) -> tuple[object, ...]:
    """Return the row of one process."""
    size = 100.0 * np.abs(tally.errors)
    errors = [f"{np.median(e):.2f} / {e.max():.2f}" for e in size.T]
    covered = [f"{100.0 * share:.0f}" for share in np.mean(tally.covered, axis=0)]
    others = ", ".join(f"{name}: {count}" for name, count in tally.others.most_common())
    parts = [f"{100.0 * part / tally.records:.0f}" for part in (tally.true, tally.good)]
    return (title, *parts, *errors, *covered, others)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=RECORDS, help="for each process")
    parser.add_argument("--quick", action="store_true", help="one record: does it run?")
    options = parser.parse_args()
    processes, records = (PROCESSES[:1], 1) if options.quick else (PROCESSES, options.records)
    tallies = {p.title: choices(p, records) for p in processes}
    print(f"{records} records of each process, NSR {RATIO:g}:\n")
    print(
        table(
            (
                *("process", "true structure [%]", "true, or K_u within 2 % [%]"),
                *("error of K_u: median / largest [%]", "of w_u"),
                *("K_u in its 95 % interval [%]", "w_u", "chosen instead"),
            ),
            (row(title, tally) for title, tally in tallies.items()),
        )
    )
    good = [100.0 * tally.good / records for tally in tallies.values()]
    covered = 100.0 * np.mean([c for tally in tallies.values() for c in tally.covered], axis=0)
    print(
        f"\ntrue, or K_u within 2 %: {np.mean(good):.1f} % of all records, {min(good):.0f} % of "
        "those of the worst process (target 90 %)"
    )
    print(
        f"after the choice of structure, {covered[0]:.1f} % of the 95 % intervals of K_u and "
        f"{covered[1]:.1f} % of those of w_u hold the truth"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
