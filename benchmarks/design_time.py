# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time of robust design: `python3 benchmarks/design_time.py [--quick]`."""

from __future__ import annotations

import argparse
import sys
from functools import partial

from markdown import table, three
from reference import take_turns

# isort: split
import numpy as np

from relay_autotune.process.structures import INTEGRATOR_INVERSE
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.frontier import Bounds
from relay_autotune.tuning.robust import robust
from relay_autotune.tuning.search import Search
from relay_autotune.tuning.task import DesignOptions, DesignTask

T = TransferFunction
PROCESSES = {
    "1.65 e^(-10 s)/(20 s + 1)": T.fopdt(1.65, 20.0, 10.0),
    "e^(-0.6 s)/(6 s + 1)^8": T.lag_n(1.0, 6.0, 8, 0.6),
    "0.547 (1 - 0.418 s) e^(-0.1 s)/(s (1.06 s + 1))": INTEGRATOR_INVERSE.build(
        (0.547, 0.418, 1.06, 0.1)
    ),
    "e^(-0.5 s)/(s^2 + 0.8 s + 1)": T.oscillator(1.0, 1.0, 0.4, 0.5),
}
TARGETS = {
    "PI of least IAE": 100,
    "PID of least IAE": 250,
    "PI, 100 models": 1000,
    "PID, 100 models": 1000,
}
TURNS = 15


def around(model: TransferFunction, count: int) -> tuple[TransferFunction, ...]:
    """Return models whose gain, dead time and time constants are spread by 5 %."""
    rng = np.random.default_rng(0)
    factors = np.exp(0.05 * rng.standard_normal((count, 3)))
    return tuple(
        T(
            model.gain * g,
            tuple(z * t for z in model.zeros),
            tuple(c * t for c in model.time_constants),
            model.integrators,
            model.dead_time * d,
        )
        for g, d, t in factors.tolist()
    )


def works(model: TransferFunction) -> dict[str, partial[object]]:
    """Return what is timed on a process, by name."""
    bounds = Bounds(1.4, DesignOptions().largest_mt(model))

    def design(derivative: bool) -> object:
        return Search(model).optimum(bounds, derivative=derivative)

    found = {
        "PI of least IAE": partial(design, False),
        "PID of least IAE": partial(design, True),
    }
    for kind in ("pi", "pid"):
        options = DesignOptions(controller=kind)
        task = DesignTask(model=model, models=around(model, 100), options=options)
        found[f"{kind.upper()}, 100 models"] = partial(robust, task)
    return found


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one process: does it run?")
    options = parser.parse_args()
    rows, beside = [], []
    for title, model in list(PROCESSES.items())[: 1 if options.quick else None]:
        timings = take_turns(
            works(model), 1 if options.quick else TURNS, warm_up=not options.quick
        )
        beside.append(timings.pop("reference").seconds)
        rows += [
            (
                title,
                name,
                three(1e3 * timing.seconds),
                f"<= {TARGETS[name]:,}",
                three(timing.multiple),
            )
            for name, timing in timings.items()
        ]
    print(table(("process", "design", "median [ms]", "target [ms]", "x reference"), rows))
    print(f"\nreference workload: {three(1e3 * float(np.median(beside)))} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())
