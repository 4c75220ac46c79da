# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains from noisy experiments: `python3 benchmarks/design_identified.py [--quick]`.

Each of the 133 processes goes through RelayExperiment with its default parameters, which sees the
noise. The fit chooses the structure; the gains are designed on the model and on 100 models within
its uncertainty, and judged on the process itself.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass

import reference  # noqa: F401  before numpy
from ah_batch import noisy
from ah_processes import FAMILIES
from design_known import KINDS, MS, QUICK, load_error
from markdown import table

# isort: split
import numpy as np

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.methods import identify
from relay_autotune.loop.analysis import is_stable
from relay_autotune.loop.stability import peaks
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record
from relay_autotune.tuning.ensemble import ensemble
from relay_autotune.tuning.frontier import Bounds
from relay_autotune.tuning.robust import robust
from relay_autotune.tuning.search import Search
from relay_autotune.tuning.task import DesignOptions, DesignTask

RATIO = 0.1


@dataclass(frozen=True)
class Outcome:
    """Performance on the process of the gains from one experiment; empty if there are no gains."""

    title: str
    reason: str = ""
    ms: float = math.inf
    ratio: float = math.inf


def outcome(title: str, model: TransferFunction, record: Record, derivative: bool) -> Outcome:
    """Identify, design and judge.

    :param title: of the process.
    :param model: the process.
    :param record: of a noisy experiment.
    :param derivative: True: PID, False: PI.
    """
    try:
        found = identify(record)
        around = ensemble(found, rng=np.random.default_rng(0))
        options = DesignOptions(ms=MS, controller=KINDS[derivative].lower())
        task = DesignTask(model=found.model, models=around, options=options)
        controller, _ = robust(task)
    except RelayAutotuneError as error:
        return Outcome(title, f"no gains: {error}")
    if not is_stable(controller, model):
        return Outcome(title, f"unstable, designed on {found.structure}")
    loop = controller.loop(model)
    (ms, _), _ = peaks(loop, frequencies(loop))
    best = Search(model).optimum(Bounds(MS, options.largest_mt(model)), derivative=derivative)
    assert best is not None, "no process of the batch is unstable"
    ratio = load_error(controller, model) / load_error(best.controller, model)
    return Outcome(title, f"designed on {found.structure}", ms, ratio)


def row(title: str, outcomes: list[Outcome]) -> tuple[object, ...]:
    """Return the results of some processes."""
    ms = np.array([o.ms for o in outcomes])
    ratios = np.array([o.ratio for o in outcomes])
    return (
        title,
        len(outcomes),
        int(np.isinf(ms).sum()),
        f"{np.median(ms):.3f}",
        f"{ms.max():.3f}",
        *(f"{100.0 * np.mean(ms <= limit):.1f}" for limit in (1.42, 1.5)),
        *(f"{np.quantile(ratios, q, method='higher'):.3f}" for q in (0.5, 0.9)),
    )


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--quick", action="store_true", help="two processes: does it run?")
    options = parser.parse_args()
    results: dict[bool, dict[str, list[Outcome]]] = {False: {}, True: {}}
    for family, processes in list(FAMILIES.items())[: 1 if options.quick else None]:
        print(family, file=sys.stderr, flush=True)
        for title, model in processes[5 : 5 + QUICK] if options.quick else processes:
            seed = (options.seed, *family.encode(), *title.encode())
            record = noisy(model, RATIO, seed)
            for derivative, found in results.items():
                found.setdefault(family, []).append(
                    outcome(f"{family.split(' = ')[0]}, {title}", model, record, derivative)
                )
    headings = ("family", "processes", "unstable or none", "Ms: median", "largest")
    shares = ("at most 1.42 [%]", "at most 1.5 [%]")
    against = ("IAE over the optimum's, known: median", "90th percentile")
    for derivative, found in results.items():
        everything = [o for outcomes in found.values() for o in outcomes]
        rows = [row(family, outcomes) for family, outcomes in found.items()]
        print(f"{KINDS[derivative]}, Ms <= {MS:g} asked, noise-to-signal ratio {RATIO:g}:\n")
        print(table((*headings, *shares, *against), [*rows, row("all", everything)]))
        print()
        for o in everything:
            if o.ms > 1.5:
                print(f"{o.title}: Ms {o.ms:.3f}, {o.reason}\n")
    print(
        "Targets for PI: none unstable, Ms at most 1.42 on 90 % and at most 1.5 on 97 %, the "
        "median IAE within 10 % of the optimum's and its 90th percentile within 50 %."
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
