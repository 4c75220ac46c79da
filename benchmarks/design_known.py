# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains for the batch of processes, known: `python3 benchmarks/design_known.py [--quick]`.

Robust PI and PID design on each of the 133 processes, against a search over a grid of gains, and
every other rule beside them.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field

import reference  # noqa: F401  before numpy
from ah_processes import FAMILIES
from brute_force import Judge, best_on_a_grid
from markdown import table, three

# isort: split
import numpy as np

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.loop.analysis import Loop, is_stable
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.stability import peaks
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.tuning import RULES
from relay_autotune.tuning.frontier import Bounds
from relay_autotune.tuning.rules.formulas import describing_point_of
from relay_autotune.tuning.search import Search
from relay_autotune.tuning.task import DesignOptions, DesignTask

MS = 1.4
SPREAD = {False: 12.0, True: 4.0}
KINDS = {False: "PI", True: "PID"}
QUICK = 2


@dataclass(frozen=True)
class Design:
    """One robust controller on one process."""

    controller: Controller
    stable: bool
    ms: float
    mt: float
    largest_mt: float
    iae: float
    ratio: float

    @property
    def excess(self) -> float:
        """By how much the bounds are exceeded; negative: they are kept."""
        return max(self.ms - MS, self.mt - self.largest_mt)


def load_error(controller: Controller, model: TransferFunction) -> float:
    """Return the IAE of a unit step of the load [y s/u]."""
    loop = controller.loop(model)
    (_, frequency), _ = peaks(loop, frequencies(loop))
    return Loop(controller, model).figures(frequency).iae_load


def designed(model: TransferFunction, derivative: bool) -> Design:
    """Return the robust controller of a process, beside the best one on grids of gains."""
    bounds = Bounds(MS, DesignOptions(ms=MS).largest_mt(model))
    optimum = Search(model).optimum(bounds, derivative=derivative)
    assert optimum is not None, "no process of the batch is unstable"
    found = optimum.controller
    loop = found.loop(model)
    (ms, _), (mt, _) = peaks(loop, frequencies(loop))
    iae = load_error(found, model)
    judge = Judge(model, bounds.ms, bounds.mt)
    other = best_on_a_grid(judge, found, iae, spread=SPREAD[derivative])
    best = iae if other is None else min(iae, load_error(other, model))
    return Design(found, is_stable(found, model), ms, mt, bounds.mt, iae, iae / best)


def row(title: str, designs: list[Design]) -> tuple[object, ...]:
    """Return the results of some processes with one kind of controller."""
    return (
        title,
        len(designs),
        sum(not d.stable for d in designs),
        f"{max(d.excess for d in designs):+.5f}",
        f"{max(abs(d.excess) for d in designs):.5f}",
        f"{np.median([d.ratio for d in designs]):.4f}",
        f"{max(d.ratio for d in designs):.4f}",
    )


def fopdt_of(model: TransferFunction) -> TransferFunction | None:
    """Return the FOPDT of the same static gain and ultimate point, for the rules that need one."""
    point = ultimate_point(model)
    if point is None or not model.is_stable or abs(point.gain * model.gain) <= 1.0:
        return None
    tau = math.sqrt((point.gain * model.gain) ** 2 - 1.0) / point.frequency
    delay = (math.pi - math.atan(tau * point.frequency)) / point.frequency
    return TransferFunction.fopdt(model.gain, tau, delay)


@dataclass
class Tally:
    """The results of a rule over the batch."""

    refused: int = 0
    unstable: int = 0
    ms: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)


def judged(model: TransferFunction, best: float, tallies: dict[str, Tally]) -> None:
    """Add one process to the results of each rule.

    :param model: the process.
    :param best: IAE of the robust PI controller [y s/u].
    :param tallies: by rule, added to.
    """
    task = DesignTask(model=model, simple=fopdt_of(model), describing=describing_point_of(model))
    for name, rule in RULES.items():
        tally = tallies.setdefault(name, Tally())
        try:
            controller, _ = rule(task)
        except RelayAutotuneError:
            tally.refused += 1
            continue
        if not is_stable(controller, model):
            tally.unstable += 1
            tally.ms.append(math.inf)
            continue
        loop = controller.loop(model)
        tally.ms.append(peaks(loop, frequencies(loop))[0][0])
        try:
            tally.ratios.append(load_error(controller, model) / best)
        except RelayAutotuneError:
            # So close to instability that its response does not die away.
            tally.ratios.append(math.inf)


def rule_rows(tallies: dict[str, Tally]) -> Iterable[tuple[object, ...]]:
    """Return a row for each rule."""
    for name, tally in tallies.items():
        if not tally.ms:
            yield (name, tally.refused, "", "", "", "")
            continue
        ninth = float(np.sort(tally.ms)[math.ceil(0.9 * len(tally.ms)) - 1])
        yield (
            name,
            tally.refused,
            tally.unstable,
            "unstable" if math.isinf(np.median(tally.ms)) else f"{np.median(tally.ms):.2f}",
            "unstable" if math.isinf(ninth) else f"{ninth:.2f}",
            three(float(np.median(tally.ratios))) if tally.ratios else "",
        )


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two processes: does it run?")
    options = parser.parse_args()
    designs: dict[bool, dict[str, list[Design]]] = {False: {}, True: {}}
    tallies: dict[str, Tally] = {}
    for family, processes in list(FAMILIES.items())[: 1 if options.quick else None]:
        print(family, file=sys.stderr, flush=True)
        some = processes[5 : 5 + QUICK] if options.quick else processes
        for derivative in designs:
            designs[derivative][family] = [designed(m, derivative) for _, m in some]
        for (_, model), pi in zip(some, designs[False][family], strict=True):
            judged(model, pi.iae, tallies)
    for derivative, by_family in designs.items():
        everything = [d for some in by_family.values() for d in some]
        rows = [row(family, some) for family, some in by_family.items()]
        print(f"Robust {KINDS[derivative]}, Ms <= {MS:g}:\n")
        headings = ("family", "processes", "unstable", "largest excess of a bound")
        distance = "largest distance of the active bound"
        against = "IAE over that of the search: median"
        print(
            table((*headings, distance, against, "largest"), [*rows, row("all", everything)]),
            end="\n\n",
        )
    headings = ("rule", "refused", "unstable", "Ms: median", "90th percentile")
    print("Every rule; IAE relative to robust PI:\n")
    print(table((*headings, "median ratio of IAE"), rule_rows(tallies)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
