"""How often 95 % intervals hold the truth: `python3 benchmarks/coverage.py [--records N]`.

The true structure is given, at a noise-to-signal ratio of 0.1; what becomes of the intervals
after a choice of structure is in structure_choice.py.
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

from relay_autotune.identification import Identification, Known, identify

RECORDS = 2_000
RATIO = 0.1
NORMAL = 1.96
# An interval wider than this share of the value tells that the data do not hold the parameter.
DETERMINED = 0.2
TARGET = (93.0, 97.0)
# One of first order, of equal and of unequal lags, with an integrator.
CHOSEN = (0, 7, 10, 16)


def known(process: Process) -> Known:
    """Return the structure of a process as a fact."""
    equal = process.model.structure.startswith("lag_n")
    return Known(structure=process.model.structure, order=process.model.order if equal else 0)


def covers(found: Identification, truth: Identification) -> NDArray[np.bool_]:
    """Return whether the intervals of the parameters, K_u and w_u hold the truth."""
    if found.parameters != truth.parameters:
        # Two lags read as an oscillating pair, or the reverse: none of them was found.
        same = np.zeros(truth.values.size, dtype=np.bool_)
    else:
        same = (found.ci95_low <= truth.values) & (truth.values <= found.ci95_high)
    gain = abs(found.ultimate_gain - truth.ultimate_gain) <= NORMAL * found.ultimate_gain_std
    change = abs(found.ultimate_frequency - truth.ultimate_frequency)
    return np.append(same, (gain, change <= NORMAL * found.ultimate_frequency_std))


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
        NORMAL * np.median([m.ultimate_gain_std / m.ultimate_gain for m in models]),
        NORMAL * np.median([m.ultimate_frequency_std / m.ultimate_frequency for m in models]),
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


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=RECORDS, help="for each process")
    parser.add_argument("--all", action="store_true", help="every process, not only four")
    parser.add_argument("--quick", action="store_true", help="few records: does it run?")
    options = parser.parse_args()
    chosen = tuple(range(len(PROCESSES))) if options.all else CHOSEN
    records = options.records
    if options.quick:
        chosen, records = CHOSEN[:1], 10
    found = [row for k in chosen for row in rows(PROCESSES[k], records)]
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
