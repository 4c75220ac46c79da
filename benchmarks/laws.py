# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains for each law, on the batch: `python3 benchmarks/laws.py [--kept FILE] [--quick]`.

PID gains are designed for a law at a sampling period, with Ms <= 1.4. Then the law runs, sample by
sample, on the exact process, with sinusoids added to the measurement: at the frequency of the
claimed Ms, below it and above it. Each of the 133 processes is run at three rates with every law;
laws with the same difference equation share the design and the run. With --kept each result is
appended to a file, and what the file has already is not run again.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import reference  # noqa: F401  before numpy
from ah_processes import FAMILIES
from markdown import table

# isort: split
import numpy as np

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import Law, SampledLaw
from relay_autotune.loop.laws import LAWS
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Plant
from relay_autotune.tuning.robust import robust
from relay_autotune.tuning.task import DesignOptions, DesignTask

# Samples in an ultimate period.
RATES = (80.0, 20.0, 8.0)
MS = 1.4
# Frequencies of the sinusoids, relative to that of Ms.
BESIDE = (1.0, 0.75, 1.3)
# A window of the test, in periods of the slowest sinusoid; two that agree to this part end it.
WINDOW, SAME = 6.0, 1e-3
MOST_SAMPLES = 120_000
LARGEST = 1e4


@dataclass(frozen=True)
class Case:
    """What came of one design.

    :param rate: samples in an ultimate period.
    :param law: its name.
    :param title: of the process.
    :param claimed: Ms; NaN: no gains.
    :param measured: largest amplitude of the sinusoids; infinite: the loop did not settle.
    :param unnamed: Ms where the law runs gains for which no law was named; infinite: unstable.
    :param why: why there are no gains.
    """

    rate: float
    law: str
    title: str
    claimed: float = math.nan
    measured: float = math.nan
    unnamed: float = math.nan
    why: str = ""

    @property
    def error(self) -> float:
        """How far the running law is from the claim, in parts of it."""
        return abs(self.measured / self.claimed - 1.0)


def measured_ms(law: SampledLaw, model: TransferFunction, frequency: float) -> float:
    """Return the largest amplitude of sinusoids on the measurement of a law that runs.

    :param law: with its gains.
    :param model: the process.
    :param frequency: of the claimed Ms [rad/s].
    """
    turns = np.array([frequency * part for part in BESIDE]) * law.period
    turns = turns[turns < 0.98 * math.pi] if turns[0] < 0.95 * math.pi else turns[:1]
    window = int(WINDOW * 2.0 * math.pi / turns.min()) + 40
    plant, running, command, k = Plant(model), law.running(), 0.0, 0
    before = math.inf
    while k < MOST_SAMPLES:
        seen = np.empty(window)
        instants = np.arange(k, k + window)
        added = np.sin(np.outer(instants, turns)).sum(axis=1)
        for n, t in enumerate(instants * law.period):
            seen[n] = plant.advance(float(t), command) + added[n]
            command = running.step(0.0, float(seen[n]))
        k += window
        if not np.abs(seen).max() < LARGEST:
            return math.inf
        angles = np.outer(instants, turns)
        rest = np.column_stack((np.ones(window), instants - instants[0]))
        waves = np.column_stack((np.sin(angles), np.cos(angles), rest))
        found, *_ = np.linalg.lstsq(waves, seen, rcond=None)
        count = turns.size
        largest = float(np.hypot(found[:count], found[count : 2 * count]).max())
        if abs(largest - before) < SAME * largest:
            return largest
        before = largest
    return math.inf


def tried(title: str, model: TransferFunction, law: str, rate: float) -> Case:
    """Design for a law at a rate, and run it.

    :param title: of the process.
    :param model: the process.
    :param law: its name.
    :param rate: samples in an ultimate period.
    """
    point = ultimate_point(model)
    assert point is not None, "every process of the batch has an ultimate point"
    period = point.period / rate
    options = DesignOptions(controller="pid", ms=MS, sample_period=period, law=law)
    task = DesignTask(model=model, options=options)
    try:
        controller, _ = robust(task)
    except RelayAutotuneError as error:
        return Case(rate, law, title, why=str(error))
    runs = task.law(controller)
    found, frequency = Loop(runs, model).margins()
    measured = measured_ms(runs, model, frequency)
    unnamed = task.law(unnamed_gains(model, period))
    return Case(rate, law, title, found.ms, measured, Loop(unnamed, model).ms())


@lru_cache(maxsize=1)
def unnamed_gains(model: TransferFunction, period: float) -> Controller:
    """Return gains for no law in particular.

    :param model: the process.
    :param period: of the samples [s].
    """
    options = DesignOptions(controller="pid", ms=MS, sample_period=period)
    return robust(DesignTask(model=model, options=options))[0]


def loop_of(law: Law) -> tuple[object, ...]:
    """Return all that design and run depend on: laws that share it have the same loop."""
    signs = (law.only_positive, law.needs_integral)
    return (law.integral, law.slope, law.smoothing, law.weights, law.delay, *signs)


def cases(quick: bool, kept: Path | None) -> Iterator[Case]:
    """Yield the results.

    :param quick: True: few, to see whether it runs.
    :param kept: file with a result in each line, to which new ones are appended; None: no file.
    """
    lines = kept.read_text().splitlines() if kept is not None and kept.exists() else []
    known = {(c.title, c.rate, c.law): c for c in (Case(**json.loads(line)) for line in lines)}
    batch = [(f"{family.split(' = ')[0]}, {title}", model)
             for family, processes in FAMILIES.items() for title, model in processes]  # fmt: skip
    for title, model in batch[:1] if quick else batch:
        for rate in RATES[-1:] if quick else RATES:
            same: dict[tuple[object, ...], Case] = {}
            for name, law in LAWS.items():
                found = known.get((title, rate, name))
                if found is None:
                    found = same.get(loop_of(law)) or tried(title, model, name, rate)
                    found = replace(found, law=name)
                    if kept is not None:
                        with kept.open("a") as file:
                            file.write(json.dumps(asdict(found)) + "\n")
                same[loop_of(law)] = found
                yield found


def row(name: str, found: list[Case]) -> tuple[object, ...]:
    """Return the results of some cases."""
    done = [c for c in found if not c.why]
    errors = [100.0 * c.error for c in done] or [math.nan]
    return (
        name,
        len(found),
        len(found) - len(done),
        sum(math.isinf(c.measured) for c in done),
        f"{max((c.claimed for c in done), default=math.nan):.4f}",
        f"{np.median(errors):.3f}",
        f"{max(errors):.3f}",
        sum(c.error <= 0.02 for c in done),
        f"{max((c.unnamed for c in done), default=math.nan):.2f}",
    )


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kept", type=Path, help="file for the results, also those of before")
    parser.add_argument("--quick", action="store_true", help="few processes: does it run?")
    options = parser.parse_args()
    found = []
    for case in cases(options.quick, options.kept):
        found.append(case)
        if len(found) % 100 == 0:
            print(f"{len(found)} done", file=sys.stderr, flush=True)
    titles = ("law", "designs", "no gains", "did not settle", "largest Ms claimed",
              "median error [%]", "largest error [%]", "within 2 %",
              "largest Ms without --law")  # fmt: skip
    rows = [row(name, part) for name in LAWS if (part := [c for c in found if c.law == name])]
    rows += [
        row(f"{rate:g} samples a period", [c for c in found if c.rate == rate]) for rate in RATES
    ]
    print(table(titles, [*rows, row("all", found)]))
    for case in found:
        if case.why or not case.error <= 0.02:
            said = case.why or f"Ms {case.claimed:.4f}, measured {case.measured:.4f}"
            print(f"\n{case.law}, {case.title}, {case.rate:g} samples a period: {said}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
