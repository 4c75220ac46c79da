# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The batch of Astrom and Hagglund: `python3 benchmarks/ah_batch.py [--ratio R] [--quick]`.

Each of the 133 processes goes through RelayExperiment with its default parameters, which samples
the measurement and sees its noise; the waveform fit chooses the structure.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

from ah_processes import FAMILIES
from markdown import table
from processes import true_point

# isort: split
import math

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import IdentificationError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import Identification
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record

FloatArray = NDArray[np.float64]

RATIO = 0.05
PER_PERIOD = 100
AMPLITUDE = 1.0
MOST_SAMPLES = 100_000
# Errors of K_u and w_u [%].
NARROW, WIDE = (2.0, 1.0), (4.0, 2.0)


@dataclass(frozen=True)
class Outcome:
    """The result of one process.

    :param title: its parameters.
    :param errors: of K_u and w_u [%]; infinite where there is no model.
    :param deviations: the same errors in standard deviations stated by the fit.
    :param chosen: the structure, or why there is none.
    :param record: of how many samples and cycles.
    """

    title: str
    errors: tuple[float, float]
    deviations: tuple[float, float]
    chosen: str
    record: str

    def within(self, limits: tuple[float, float]) -> bool:
        """Return whether both errors keep their limits [%]."""
        return all(abs(e) <= limit for e, limit in zip(self.errors, limits, strict=True))


def experiment(model: TransferFunction, noise: FloatArray) -> Record:
    """Return the record of a sampled relay that sees the noise.

    :param model: the process, at rest before the first sample.
    :param noise: what is added to each sample [y], shape (n,); the relay stops by itself before.
    """
    period = 2.0 * math.pi / true_point(model).frequency / PER_PERIOD
    loop = RelayExperiment(ExperimentParameters(amplitude=AMPLITUDE), 0.0)
    plant, command = Plant(model), 0.0
    for k, added in enumerate(noise):
        command = loop.step(k * period, plant.advance(k * period, command) + added)
        if loop.finished:
            break
    return loop.record()


def noisy(model: TransferFunction, ratio: float, seed: tuple[int, ...]) -> Record:
    """Return an experiment with a noise-to-signal ratio.

    :param model: the process.
    :param ratio: mean|noise|/mean|signal|, of the same experiment without noise, in its cycles.
    :param seed: of the noise.
    """
    clean = experiment(model, np.zeros(MOST_SAMPLES))
    signal = np.abs(clean.measurement[clean.cycle_start[0] :])
    std = ratio * float(np.mean(signal)) * math.sqrt(math.pi / 2.0)
    return experiment(model, std * np.random.default_rng(seed).standard_normal(MOST_SAMPLES))


def outcome(title: str, model: TransferFunction, ratio: float, seed: tuple[int, ...]) -> Outcome:
    """Run one process and identify it."""
    record = noisy(model, ratio, seed)
    size = f"{len(record)} samples, {max(len(record.cycle_start) - 1, 0)} cycles"
    truth = true_point(model)
    try:
        found = identify(record)
    except IdentificationError as error:
        nothing = (math.inf, math.inf)
        return Outcome(title, nothing, nothing, f"none: {error} {record.reason}", size)
    change = found.ultimate_gain - truth.gain, found.ultimate_frequency - truth.frequency
    return Outcome(
        title,
        (100.0 * change[0] / truth.gain, 100.0 * change[1] / truth.frequency),
        (change[0] / found.ultimate_gain_std, change[1] / found.ultimate_frequency_std),
        described(found),
        size,
    )


def described(found: Identification) -> str:
    """Return the structure and its parameters."""
    values = ", ".join(f"{v:.3g}" for v in found.values)
    order = f" of order {order}" if (order := found.estimate.structure.given_order) else ""
    return f"{found.structure}{order} ({values})"


def shares(title: str, outcomes: list[Outcome]) -> tuple[object, ...]:
    """Return a row with how many keep the limits."""
    errors = np.abs([o.errors for o in outcomes])
    covered = [sum(abs(o.deviations[k]) <= NORMAL_95 for o in outcomes) for k in (0, 1)]
    return (
        title,
        len(outcomes),
        *(sum(o.within(limits) for o in outcomes) for limits in (NARROW, WIDE)),
        *(f"{m:.2f} / {w:.2f}" for m, w in zip(np.median(errors, 0), errors.max(0), strict=True)),
        *covered,
    )


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ratio", type=float, default=RATIO, help="noise-to-signal ratio")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--quick", action="store_true", help="two processes: does it run?")
    options = parser.parse_args()
    results: dict[str, list[Outcome]] = {}
    for family, processes in list(FAMILIES.items())[: 1 if options.quick else None]:
        some = processes[5:7] if options.quick else processes
        print(family, file=sys.stderr, flush=True)
        # No two processes share their noise.
        results[family] = [
            outcome(*p, options.ratio, (options.seed, *family.encode(), *p[0].encode()))
            for p in some
        ]
    everything = [o for outcomes in results.values() for o in outcomes]
    rows = [shares(family, outcomes) for family, outcomes in results.items()]
    rows.append(shares("all", everything))
    limits = [f"K_u within {k:g} %, w_u within {w:g} %" for k, w in (NARROW, WIDE)]
    largest = ("K_u: median / largest error [%]", "w_u")
    print(table(("family", "processes", *limits, *largest, "K_u in 95 %", "w_u in 95 %"), rows))
    inside = [
        100.0 * sum(o.within(x) for o in everything) / len(everything) for x in (NARROW, WIDE)
    ]
    print(f"\n{limits[0]}: {inside[0]:.1f} % of the processes (target 93 %)")
    print(f"{limits[1]}: {inside[1]:.1f} % of the processes (target 100 %)")
    outside = [
        (
            f"{family.split(' = ')[0]}, {o.title}",
            *(f"{e:+.2f} ({d:+.1f})" for e, d in zip(o.errors, o.deviations, strict=True)),
            o.chosen,
            o.record,
        )
        for family, outcomes in results.items()
        for o in outcomes
        if not o.within(NARROW)
    ]
    if outside:
        print("\nOutside, errors in % (in stated standard deviations):\n")
        print(table(("process", "K_u", "w_u", "chosen", "record"), outside))
    return 0


if __name__ == "__main__":
    sys.exit(main())
