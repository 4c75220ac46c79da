# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Errors of every method: `python3 benchmarks/accuracy.py [--seeds N] [--fits N] [--quick]`.

The waveform fit on each process of cases.py: without noise; with noise that the relay sees or
not, beside the Cramer-Rao bound and the targets. Then every method on every process of
processes.py, at each noise-to-signal ratio and in both settings.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field

from cases import CASES, QUANTITIES, TARGETS, Case
from markdown import table, three
from method_errors import RATIOS as ALL
from method_errors import method_table
from processes import PROCESSES

# isort: split
import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import Identification

FloatArray = NDArray[np.float64]

RATIOS = (0.05, 0.1, 0.2)
MAIN_RATIO = 0.1
FITS, SEEDS = 500, 10
# If the interval is wider than this share of the value, the data do not determine the parameter.
DETERMINED = 0.2
MOST_OVER_BOUND = 1.1
FOPDT = Known(structure="fopdt")
# Median and 95th percentile of |x| for a standard normal x.
NORMAL = (0.6745, 1.9600)


@dataclass
class Tally:
    """Errors of one method over many records.

    :param errors: relative errors of ``QUANTITIES``, a row for each record.
    :param bounds: their Cramer-Rao bounds, as standard deviations.
    :param failed: number of records that gave no model.
    """

    errors: list[FloatArray] = field(default_factory=list)
    bounds: list[FloatArray] = field(default_factory=list)
    failed: int = 0

    def magnitudes(self) -> FloatArray:
        """Return median and 95th percentile of |error| [%], shape (2, 5)."""
        return 100.0 * np.percentile(np.abs(self.errors), (50.0, 95.0), axis=0)

    def over_bound(self) -> FloatArray:
        """Return the rms of error/bound, shape (5,)."""
        ratio = np.array(self.errors) / np.array(self.bounds)
        return np.asarray(np.sqrt(np.mean(ratio**2, axis=0)))


def found(model: Identification) -> FloatArray:
    """Return the identified ``QUANTITIES``, shape (5,)."""
    return np.array((*model.values, model.ultimate_gain, model.ultimate_frequency))


def tallied(case: Case, ratio: float, seen: bool, records: int) -> Tally:
    """Return the errors of the waveform fit over records of different noise.

    :param case: the process.
    :param ratio: noise-to-signal ratio.
    :param seen: True: the relay sees the noise.
    :param records: number of records.
    """
    tally = Tally()
    std = case.noise_std(ratio)
    unseen_bound = std * np.sqrt(np.diag(case.bound(case.run.time, case.run.command)))
    for seed in range(records):
        record = case.record(ratio, seed, relay_sees_noise=seen)
        try:
            model = identify(record, "waveform", FOPDT)
        except IdentificationError:
            tally.failed += 1
            continue
        bound = unseen_bound
        if seen:
            # The information in this record, with these commands and this noise.
            bound = std * np.sqrt(np.diag(case.bound(record.time, record.input())))
        tally.errors.append(found(model) / case.truth - 1.0)
        tally.bounds.append(bound)
    return tally


def noise_free() -> str:
    """Return the table of errors without noise."""
    rows = []
    for case in CASES:
        errors = np.abs(found(identify(case.record(0.0, 0), "waveform", FOPDT)) / case.truth - 1.0)
        rows.append((case.title, *(f"{e:.1e}" for e in errors), "<= 1e-9"))
    return table(("process", *QUANTITIES, "target"), rows)


def pairs(figures: FloatArray) -> list[str]:
    """Return "median / 95th" of each quantity of an array of shape (2, 5)."""
    return [f"{three(a)} / {three(b)}" for a, b in figures.T]


def verdict(tally: Tally) -> list[str]:
    """Return the rms of error/bound of each quantity, and whether it is as it should be."""
    cells = []
    widths = NORMAL[1] * np.median(tally.bounds, axis=0)
    for ratio, width in zip(tally.over_bound(), widths, strict=True):
        judged = "" if width > DETERMINED else " ok" if ratio <= MOST_OVER_BOUND else " above"
        cells.append(three(ratio) + judged)
    return cells


def noisy_rows(index: int, ratio: float, seen: bool, fit: Tally) -> list[tuple[object, ...]]:
    """Return the rows of one process, noise and setting."""
    where = (CASES[index].title, f"{ratio:g}", "yes" if seen else "no")
    failed = f", {fit.failed} failed" if fit.failed else ""
    bound = 100.0 * np.outer(NORMAL, np.median(fit.bounds, axis=0))
    rows: list[tuple[object, ...]] = [
        (*where, f"waveform, {len(fit.errors)} records{failed}", *pairs(fit.magnitudes())),
        (*where, "rms error / bound", *verdict(fit)),
        (*where, "Cramer-Rao bound", *pairs(bound)),
    ]
    if not seen and (index, ratio) in TARGETS:
        target = np.array(TARGETS[index, ratio]).T
        rows.append((*where, "target", *pairs(target)))
        rows.append((*where, "median / target", *map(three, fit.magnitudes()[0] / target[0])))
    return rows


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fits", type=int, default=FITS, help="records of the waveform fit")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="records of the other methods")
    parser.add_argument("--quick", action="store_true", help="few records: does it run?")
    options = parser.parse_args()
    fits, seeds = (3, 2) if options.quick else (options.fits, options.seeds)
    print("Largest |relative error| of the waveform fit without noise:\n")
    print(noise_free(), flush=True)
    rows: list[tuple[object, ...]] = []
    for index, case in enumerate(CASES[:1] if options.quick else CASES):
        for ratio in RATIOS:
            for seen in (False, True):
                if ratio == MAIN_RATIO or (index, ratio) in TARGETS:
                    rows += noisy_rows(index, ratio, seen, tallied(case, ratio, seen, fits))
    print("\nWaveform fit: |relative error| in %, median / 95th percentile:\n")
    print(table(("process", "NSR", "relay sees noise", "", *QUANTITIES), rows), flush=True)
    print(
        f"\nEvery method: |relative error| of K_u and w_u in %, median / 95th percentile over "
        f"{seeds} records:\n"
    )
    processes, ratios = (PROCESSES[:1], (0.0, MAIN_RATIO)) if options.quick else (PROCESSES, ALL)
    print(method_table(processes, ratios, seeds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
