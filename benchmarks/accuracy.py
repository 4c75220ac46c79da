"""Errors of every FOPDT method: `python3 benchmarks/accuracy.py [--seeds N] [--quick]`.

Each method on each process of cases.py: without noise; with noise that the relay sees or not,
beside the Cramer-Rao bound and the targets; and how often 95 % intervals cover the truth.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, field

from cases import CASES, QUANTITIES, TARGETS, Case
from markdown import table, three

# isort: split
import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import IdentificationError
from relay_autotune.identification import Identification, Known, identify
from relay_autotune.record import Record

FloatArray = NDArray[np.float64]

RATIOS = (0.05, 0.1, 0.2)
COVERED_RATIO = 0.1
SEEDS, COVERAGE = 200, 500
FOPDT = Known(structure="fopdt")
# Median and 95th percentile of |x| for a standard normal x.
NORMAL = (0.6745, 1.9600)


@dataclass
class Tally:
    """Errors of one method over many records.

    :param errors: relative errors of ``QUANTITIES``, a row for each record.
    :param bounds: their Cramer-Rao bounds, as standard deviations.
    :param covered: whether the 95 % intervals hold the truth.
    :param failed: number of records that gave no model.
    """

    errors: list[FloatArray] = field(default_factory=list)
    bounds: list[FloatArray] = field(default_factory=list)
    covered: list[NDArray[np.bool_]] = field(default_factory=list)
    failed: int = 0

    def first(self, count: int) -> Tally:
        """Return the tally of the first records."""
        return Tally(self.errors[:count], self.bounds[:count], self.covered[:count], self.failed)

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


def covers(model: Identification, truth: FloatArray) -> NDArray[np.bool_]:
    """Return for each of ``QUANTITIES`` whether its 95 % interval holds the truth."""
    deviation = NORMAL[1] * np.array((model.ultimate_gain_std, model.ultimate_frequency_std))
    point = np.array((model.ultimate_gain, model.ultimate_frequency))
    low = np.concatenate((model.ci95_low, point - deviation))
    high = np.concatenate((model.ci95_high, point + deviation))
    return np.asarray((low <= truth) & (truth <= high))


def methods(case: Case) -> tuple[str, ...]:
    """Return the methods that apply to the relay of a case."""
    return ("waveform", "wang_biased" if case.bias else "wang_unbiased")


def run(record: Record, method: str) -> Identification:
    """Identify a FOPDT model."""
    return identify(record, method, FOPDT) if method == "waveform" else identify(record, method)


def tallies(case: Case, ratio: float, seen: bool, fits: int, others: int) -> dict[str, Tally]:
    """Return each method's errors over records of different noise.

    :param case: the process.
    :param ratio: noise-to-signal ratio.
    :param seen: True: the relay sees the noise.
    :param fits: records for the waveform fit.
    :param others: records for the other methods, not more.
    """
    result = {method: Tally() for method in methods(case)}
    std = case.noise_std(ratio)
    unseen_bound = std * np.sqrt(np.diag(case.bound(case.run.time, case.run.command)))
    for seed in range(fits):
        record = case.record(ratio, seed, relay_sees_noise=seen)
        for method, tally in result.items():
            if method != "waveform" and seed >= others:
                continue
            try:
                model = run(record, method)
            except IdentificationError:
                tally.failed += 1
                continue
            error = found(model) / case.truth - 1.0
            if not np.all(np.isfinite(error)):
                tally.failed += 1
                continue
            tally.errors.append(error)
            if method == "waveform":
                bound = unseen_bound
                if seen:
                    # What this relay did with this noise tells this much.
                    bound = std * np.sqrt(np.diag(case.bound(record.time, record.input())))
                tally.bounds.append(bound)
                tally.covered.append(covers(model, case.truth))
    return result


def noise_free() -> str:
    """Return the table of errors without noise."""
    rows = []
    for case in CASES:
        for method in methods(case):
            errors = np.abs(found(run(case.record(0.0, 0), method)) / case.truth - 1.0)
            target = "<= 1e-9" if method == "waveform" else ""
            rows.append((case.title, method, *(f"{e:.1e}" for e in errors), target))
    return table(("process", "method", *QUANTITIES, "target"), rows)


def pairs(figures: FloatArray) -> list[str]:
    """Return "median / 95th" of each quantity of an array of shape (2, 5)."""
    return [f"{three(a)} / {three(b)}" for a, b in figures.T]


def noisy_rows(
    index: int, ratio: float, seen: bool, result: dict[str, Tally]
) -> list[tuple[object, ...]]:
    """Return the rows of one process, noise and setting."""
    where = (CASES[index].title, f"{ratio:g}", "yes" if seen else "no")
    rows: list[tuple[object, ...]] = []
    for method, tally in result.items():
        title = f"{method} ({tally.failed} failed)" if tally.failed else method
        cells = pairs(tally.magnitudes()) if tally.errors else ["-"] * len(QUANTITIES)
        rows.append((*where, title, *cells))
    fit = result["waveform"]
    bound = 100.0 * np.outer(NORMAL, np.median(fit.bounds, axis=0))
    rows.insert(1, (*where, "waveform: rms error / bound", *map(three, fit.over_bound())))
    rows.insert(2, (*where, "Cramer-Rao bound", *pairs(bound)))
    if not seen and (index, ratio) in TARGETS:
        rows.insert(3, (*where, "target", *pairs(np.array(TARGETS[index, ratio]).T)))
    return rows


def coverage_row(index: int, seen: bool, tally: Tally) -> tuple[object, ...]:
    """Return the shares of intervals that hold the truth, in %."""
    count = len(tally.covered)
    shares = 100.0 * np.mean(tally.covered, axis=0)
    scatter = 196.0 * math.sqrt(0.95 * 0.05 / count)
    where = (CASES[index].title, "yes" if seen else "no", count)
    return (*where, *(f"{s:.1f}" for s in shares), f"95 ± {scatter:.1f}")


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=SEEDS, help="records for each row")
    parser.add_argument("--coverage", type=int, default=COVERAGE, help="for the intervals")
    parser.add_argument("--quick", action="store_true", help="few records: does it run?")
    options = parser.parse_args()
    seeds, coverage = (3, 4) if options.quick else (options.seeds, options.coverage)
    ratios = (COVERED_RATIO,) if options.quick else RATIOS
    print("Largest |relative error| without noise:\n")
    print(noise_free(), flush=True)
    rows: list[tuple[object, ...]] = []
    covered: list[tuple[object, ...]] = []
    for index, case in enumerate(CASES[:1] if options.quick else CASES):
        for ratio in ratios:
            for seen in (False, True):
                count = max(seeds, coverage) if ratio == COVERED_RATIO else seeds
                result = tallies(case, ratio, seen, count, seeds)
                if ratio == COVERED_RATIO:
                    covered.append(coverage_row(index, seen, result["waveform"]))
                shown = {name: tally.first(seeds) for name, tally in result.items()}
                rows += noisy_rows(index, ratio, seen, shown)
    print(f"\n|relative error| in %, median / 95th percentile over {seeds} records:\n")
    print(table(("process", "NSR", "relay sees noise", "", *QUANTITIES), rows))
    print(f"\nShare of 95 % intervals that hold the truth, in %, at NSR {COVERED_RATIO:g}:\n")
    print(table(("process", "relay sees noise", "records", *QUANTITIES, "nominal"), covered))
    return 0


if __name__ == "__main__":
    sys.exit(main())
