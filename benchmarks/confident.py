"""How early `stop_when: confident` ends a test: `python3 benchmarks/confident.py [--records N]`.

Each process is tested as relay_node does it, at a noise-to-signal ratio of 0.1. After each switch
a FOPDT is fitted, as identifier_node does while a test runs, and the test ends when the 95 %
interval of K_u is within 2 %. The classic criterion (three cycles that agree within 2 %) is
judged on the same process without noise. Lengths are counted from the kick on. The exit status
is 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass

from markdown import table

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np

from relay_autotune.autotune import analyse
from relay_autotune.models import TransferFunction
from relay_autotune.record import Outcome, RelaySettings
from relay_autotune.relay import ExperimentParameters, RelayExperiment
from relay_autotune.simulation import exact_limit_cycle
from relay_autotune.ultimate import ultimate_point
from relay_autotune.virtual_process import Disturbances, VirtualProcess

RECORDS = 40
RATIO = 0.1
CONFIDENCE = 0.02
PER_CYCLE = 200
MOST_TIME = 0.5
MOST_ERROR = (0.005, 0.015)

_BUILD = TransferFunction.from_structure
PROCESSES = (
    ("e^-2s/(2s+1)", _BUILD("fopdt", gain=1.0, time_constants=[2.0], dead_time=2.0)),
    ("1.65 e^-10s/(20s+1)", _BUILD("fopdt", gain=1.65, time_constants=[20.0], dead_time=10.0)),
    ("e^-0.1s/(s+1)", _BUILD("fopdt", gain=1.0, time_constants=[1.0], dead_time=0.1)),
    ("e^-10s/(s+1)", _BUILD("fopdt", gain=1.0, time_constants=[1.0], dead_time=10.0)),
    ("e^-10s/(s+1)^2", _BUILD("lag_n", gain=1.0, time_constants=[1.0], order=2, dead_time=10.0)),
    ("e^-0.6s/(6s+1)^8", _BUILD("lag_n", gain=1.0, time_constants=[6.0], order=8, dead_time=0.6)),
)


@dataclass(frozen=True)
class Length:
    """One test: how long it took from the kick on [s], how many cycles, and the error of K_u."""

    time: float
    cycles: int
    error: float


def classic(model: TransferFunction, period: float) -> Length:
    """Run a test without noise until three cycles agree."""
    tune = RelayExperiment(ExperimentParameters(amplitude=1.0, max_cycles=40), 0.0)
    plant = VirtualProcess(model)
    for k in range(200_000):
        plant.command(tune.step(k * period, plant.measure(k * period)))
        if tune.finished:
            break
    record = tune.record()
    kick = float(record.time[int(np.flatnonzero(record.command != 0.0)[0])])
    return Length(record.duration - kick, tune.cycle_count, math.nan)


def confident(model: TransferFunction, period: float, noise: float, seed: int) -> Length:
    """Run a test until the fitted K_u is known well enough."""
    tune = RelayExperiment(
        ExperimentParameters(amplitude=1.0, max_cycles=40), 0.0, until_converged=False
    )
    plant = VirtualProcess(model, disturbances=Disturbances(noise_std=noise), seed=seed)
    truth = ultimate_point(model).gain
    seen, found = 0, math.nan
    for k in range(200_000):
        plant.command(tune.step(k * period, plant.measure(k * period)))
        if tune.switches > max(seen, 1) and not tune.finished:
            seen = tune.switches
            fitted = analyse(tune.record(), final=False).model
            if fitted is not None:
                found = fitted.ultimate_gain
                if 1.96 * fitted.ultimate_gain_std <= CONFIDENCE * abs(found):
                    tune.conclude("K_u is known well enough")
        if tune.finished:
            break
    record = tune.record()
    kick = float(record.time[int(np.flatnonzero(record.command != 0.0)[0])])
    final = analyse(record, final=False).model if tune.outcome is Outcome.COMPLETED else None
    if final is not None:
        found = final.ultimate_gain
    return Length(record.duration - kick, tune.cycle_count, abs(found / truth - 1.0))


def main() -> int:
    """Run the tests and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=RECORDS)
    parser.add_argument("--quick", action="store_true", help="two processes, never fails")
    asked = parser.parse_args()
    records = 2 if asked.quick else asked.records
    rows, missed = [], 0
    for title, model in PROCESSES[:2] if asked.quick else PROCESSES:
        cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0, 0.3), tolerance=1e-6)
        period = cycle.period / PER_CYCLE
        # N2 of Wang et al., for a swing between a triangle's and a square's.
        noise = RATIO * 0.3 * (cycle.peak_max - cycle.peak_min) / math.sqrt(2.0 / math.pi)
        usual = classic(model, period)
        runs = [confident(model, period, noise, seed) for seed in range(records)]
        share = float(np.median([r.time for r in runs])) / usual.time
        errors = np.array([r.error for r in runs])
        median, high = float(np.median(errors)), float(np.quantile(errors, 0.95))
        fine = share <= MOST_TIME and median <= MOST_ERROR[0] and high <= MOST_ERROR[1]
        missed += not fine
        rows.append(
            (
                title,
                usual.cycles,
                f"{usual.time:.3g}",
                f"{np.median([r.cycles for r in runs]):g}",
                f"{100 * share:.0f}",
                f"{100 * median:.2f}",
                f"{100 * high:.2f}",
                "yes" if fine else "no",
            )
        )
    headings = (
        *("process", "classic, cycles", "classic [s]", "confident, cycles"),
        *("time, % of classic", "error of K_u, median [%]", "95th percentile [%]", "targets met"),
    )
    print(table(headings, rows))
    print(
        f"\n{records} tests each. Targets: at most {100 * MOST_TIME:.0f} % of the classic time, "
        f"errors of at most {100 * MOST_ERROR[0]:g} % and {100 * MOST_ERROR[1]:g} %."
    )
    return 1 if missed and not asked.quick else 0


if __name__ == "__main__":
    sys.exit(main())
