# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How often 95 % intervals hold the truth: `python3 benchmarks/coverage.py [--records N]`.

At a noise-to-signal ratio of 0.1, with the true structure given; and, in a table of its own, those
of K_u and w_u after a choice of structure, by the chosen structure alone and with the spread
between all structures that have support.
"""

from __future__ import annotations

import argparse
import math
import sys

from markdown import table
from processes import PROCESSES, Process

# isort: split
import numpy as np
from numpy.typing import NDArray

from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import Identification
from relay_autotune.process.structures import TABLE
from relay_autotune.quantities import NORMAL_95

RECORDS = 2_000
RATIO = 0.1
# An interval wider than this share of the value tells that the data do not hold the parameter.
DETERMINED = 0.2
TARGET = (93.0, 97.0)
AFTER_CHOICE = 100


def known(process: Process) -> Known:
    """Return the structure of a process as a fact."""
    row = TABLE[process.model.structure]
    return Known(structure=row.name, order=process.model.order if row.any_order else 0)


def covers(found: Identification, truth: Identification) -> NDArray[np.bool_]:
    """Return whether the intervals of the parameters, K_u and w_u hold the truth."""
    if found.parameters != truth.parameters:
        # Two real lags were identified as an oscillating pair, or the reverse: no interval holds.
        same = np.zeros(truth.values.size, dtype=np.bool_)
    else:
        same = (found.ci95_low <= truth.values) & (truth.values <= found.ci95_high)
    gain = abs(found.ultimate_gain - truth.ultimate_gain) <= NORMAL_95 * found.ultimate_gain_std
    change = abs(found.ultimate_frequency - truth.ultimate_frequency)
    return np.append(same, (gain, change <= NORMAL_95 * found.ultimate_frequency_std))


def rows(process: Process, records: int) -> list[tuple[object, ...]]:
    """Return a row for each parameter of a process, K_u and w_u."""
    truth = identify(process.record(0.0, 0), "waveform", known(process))
    models = [
        identify(process.record(RATIO, seed), "waveform", known(process))
        for seed in range(records)
    ]
    shares = 100.0 * np.mean([covers(m, truth) for m in models], axis=0)
    alike = [m for m in models if m.parameters == truth.parameters]
    half = np.median([(m.ci95_high - m.ci95_low) / 2.0 for m in alike], axis=0)
    widths = half / np.abs(truth.values)
    point = [
        NORMAL_95 * np.median([m.ultimate_gain_std / m.ultimate_gain for m in models]),
        NORMAL_95 * np.median([m.ultimate_frequency_std / m.ultimate_frequency for m in models]),
    ]
    found: list[tuple[object, ...]] = []
    for name, share, width in zip(
        (*truth.parameters, "K_u", "w_u"), shares, (*widths, *point), strict=True
    ):
        error = 100.0 * math.sqrt(share / 100.0 * (1.0 - share / 100.0) / records)
        determined = abs(width) <= DETERMINED
        verdict = (
            ("yes" if TARGET[0] <= share <= TARGET[1] else "no")
            if determined
            else "not determined"
        )
        cells = (f"{100.0 * abs(width):.2f}", f"{share:.1f} ± {error:.1f}", verdict)
        found.append((process.title, name, *cells))
    return found


def after_choice(process: Process, records: int) -> tuple[int, ...]:
    """Return how many intervals of K_u and w_u hold the truth after a choice of structure.

    :return: by the chosen structure alone, K_u and w_u; over all structures, K_u and w_u.
    """
    truth = process.truth
    found = np.zeros(4, dtype=int)
    for seed in range(records):
        model = identify(process.record(RATIO, seed))
        point = (model.ultimate_gain, model.ultimate_frequency)
        alone = model.estimate.ultimate_std(*point)
        averaged = (model.ultimate_gain_std, model.ultimate_frequency_std)
        errors = np.abs(np.array((point[0] - truth.gain, point[1] - truth.frequency) * 2))
        found += errors <= NORMAL_95 * np.array((*alone, *averaged))
    return tuple(int(k) for k in found)


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=RECORDS, help="for each process")
    parser.add_argument(
        "--after-choice", type=int, default=AFTER_CHOICE, help="records with the structure open"
    )
    parser.add_argument("--quick", action="store_true", help="few records: does it run?")
    options = parser.parse_args()
    processes, records, chosen = PROCESSES, options.records, options.after_choice
    if options.quick:
        processes, records, chosen = PROCESSES[:1], 10, 2
    found = []
    for process in processes:
        print(process.title, file=sys.stderr, flush=True)
        found += rows(process, records)
    print(f"{records} records of each process, NSR {RATIO:g}, the structure given:\n")
    print(
        table(
            (
                *("process", "parameter", "half the interval [% of the value]"),
                *("held [%] (± standard error)", "93 to 97 %"),
            ),
            found,
        )
    )
    verdicts = [row[-1] for row in found]
    print(
        f"\n{verdicts.count('yes')} of {len(verdicts) - verdicts.count('not determined')} "
        "intervals of what the data determine hold the truth in 93 to 97 % of the records"
    )
    print(f"\n{chosen} records of each process, the structure chosen; intervals that hold [%]:\n")
    held = {process.title: np.array(after_choice(process, chosen)) for process in processes}
    total = chosen * len(processes)
    everything = np.sum(list(held.values()), axis=0)
    print(
        table(
            (
                *("process", "K_u, chosen structure alone", "w_u"),
                *("K_u, with the spread between structures", "w_u"),
            ),
            [
                *(
                    (title, *(f"{100.0 * k / chosen:.0f}" for k in counts))
                    for title, counts in held.items()
                ),
                ("all", *(f"{100.0 * k / total:.1f}" for k in everything)),
            ],
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
