# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The scatter of the targets over 30 seeds: `python3 benchmarks/target_spread.py [--quick]`.

The targets are medians and 95th percentiles over 30 records of another implementation. Some lie
below the values expected from the Cramer-Rao bound. Here sets of 30 efficient estimates are drawn
and compared with the targets, for each possible way in which the records may have been made.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass

from cases import CASES, QUANTITIES, SAMPLES, TARGETS, Case, output
from markdown import table, three

# isort: split
import numpy as np
from numpy.typing import NDArray

from relay_autotune.process.simulation import simulate_relay

FloatArray = NDArray[np.float64]

RATIO = 0.1
SEEDS = 30
# The biased relay's target lies far above the bound in every case, so it is not compared.
UNBIASED = (0, 1, 2, 4)
WINDOWS = {
    "from the first kick; offset and drift estimated": False,
    "cut out of the limit cycle; offset, drift and initial state estimated": True,
}
NOISES = {
    "mean\\|noise\\| = NSR mean\\|signal\\|": math.sqrt(math.pi / 2.0),
    "std(noise) = NSR mean\\|signal\\|": 1.0,
}


@dataclass(frozen=True)
class Spread:
    """Median and 95th percentile of |error| [%] over ``SEEDS`` records, many times.

    :param draws: shape (sets, 2, 5).
    """

    draws: FloatArray

    def chance(self, quantity: int, target: float) -> float:
        """Return how often the median of a quantity is at most the target."""
        return float(np.mean(self.draws[:, 0, quantity] <= target))

    def cell(self, quantity: int, target: float) -> str:
        """Return the middle of a median, its 5 to 95 % range, and the chance of the target."""
        low, middle, high = np.percentile(self.draws[:, 0, quantity], (5.0, 50.0, 95.0))
        chance = 100.0 * self.chance(quantity, target)
        return f"{three(middle)} ({three(low)} to {three(high)}), {chance:.0f} %"


def covariance(case: Case, *, limit_cycle: bool) -> FloatArray:
    """Return the bound of relative errors for a noise of ``RATIO`` times mean|signal|.

    :param case: the process.
    :param limit_cycle: True: five cycles of it; False: as many samples from the first kick on.
    """
    run = simulate_relay(case.model, case.settings(0.0), cycles=14)
    begin = run.cycles[7].start if limit_cycle else 0.0
    time = begin + case.period * np.arange(SAMPLES, dtype=np.float64)
    beside = [time - time.mean()]
    if limit_cycle:
        beside.append(np.exp(-(time - time[0]) / case.values[1]))
    signal = float(np.mean(np.abs(output(np.array(case.values), time, run.command))))
    return case.bound(time, run.command, beside) * (RATIO * signal) ** 2


def spread(cov: FloatArray, sets: int, rng: np.random.Generator) -> Spread:
    """Draw sets of efficient estimates, to first order."""
    variances, directions = np.linalg.eigh(cov)
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    errors = 100.0 * np.abs(rng.standard_normal((sets, SEEDS, cov.shape[0])) @ root.T)
    return Spread(np.percentile(errors, (50.0, 95.0), axis=1).transpose(1, 0, 2))


def strangeness(spreads: list[Spread]) -> tuple[float, float]:
    """Return how far the targets lie from the middle of the draws, and how often draws do.

    :param spreads: of each of ``UNBIASED``.
    :return: sum of squared deviations of the logarithms in units of their scatter, and the share
        of draws in which that is larger.
    """
    of_targets, of_draws = 0.0, np.zeros(spreads[0].draws.shape[0])
    for index, each in zip(UNBIASED, spreads, strict=True):
        drawn = np.log(each.draws)
        middle, scatter = drawn.mean(axis=0), drawn.std(axis=0)
        target = np.log(np.array(TARGETS[index, RATIO]).T)
        of_targets += float(np.sum(((target - middle) / scatter) ** 2))
        of_draws += np.sum(((drawn - middle) / scatter) ** 2, axis=(1, 2))
    return of_targets, float(np.mean(of_draws >= of_targets))


def all_as_low(spreads: list[Spread]) -> float:
    """Return the chance that the median of K_u is at most the target on every process."""
    k = QUANTITIES.index("K_u")
    return math.prod(
        each.chance(k, TARGETS[index, RATIO][k][0])
        for index, each in zip(UNBIASED, spreads, strict=True)
    )


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few draws: does it run?")
    sets = 200 if parser.parse_args().quick else 10_000
    rng = np.random.default_rng(0)
    joint = []
    for window, limit_cycle in WINDOWS.items():
        bounds = [covariance(CASES[i], limit_cycle=limit_cycle) for i in UNBIASED]
        by_noise = {
            noise: [spread(bound * factor**2, sets, rng) for bound in bounds]
            for noise, factor in NOISES.items()
        }
        rows = []
        for k, index in enumerate(UNBIASED):
            for quantity, name in enumerate(QUANTITIES):
                target = TARGETS[index, RATIO][quantity][0]
                cells = [each[k].cell(quantity, target) for each in by_noise.values()]
                rows.append((CASES[index].title, name, three(target), *cells))
        print(f"Median |error| in % over {SEEDS} records, {window}:")
        print("most likely (5 to 95 % range), chance of the target or less\n")
        print(table(("process", "", "target", *NOISES), rows) + "\n")
        for noise, spreads in by_noise.items():
            distance, share = strangeness(spreads)
            count = 2 * len(QUANTITIES) * len(UNBIASED)
            joint.append(
                (
                    window,
                    noise,
                    f"{distance:.0f} of {count}",
                    f"{100.0 * share:.1f} %",
                    f"{100.0 * all_as_low(spreads):.2g} %",
                )
            )
    print("All targets together: squared distance of the medians and 95th percentiles from the")
    print("middle; chance of more; chance that all medians of K_u are as low, if no two processes")
    print("shared their noise\n")
    print(table(("records", "noise", "distance", "chance", "K_u as low"), joint))
    return 0


if __name__ == "__main__":
    sys.exit(main())
