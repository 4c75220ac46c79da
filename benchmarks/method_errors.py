# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Errors of every method on every process, for accuracy.py."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from markdown import table, three
from processes import Process

# isort: split
import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify, identify_jointly
from relay_autotune.identification.result import Identification
from relay_autotune.process.response import response
from relay_autotune.process.structures import TABLE
from relay_autotune.record.record import PiecewiseConstant, Record

FloatArray = NDArray[np.float64]

RATIOS = (0.0, 0.05, 0.1, 0.2)
SHOWN = 0.1
# Structures that chang and atv can identify; they are given gain and dead time.
_LAGS = ("fopdt", "lag_n", "sopdt", "two_equal_one")
# Structures that fourier can be given; for others it fits a FOPDT, and takes K_u from the points.
_ONE_LAG = ("fopdt", "lag_n", "ipdt", "integrator_lag", "unstable_fopdt")
_ADDED = 0.25


@dataclass
class Errors:
    """Relative errors of K_u and w_u over records.

    :param found: a row for each record that gave a model.
    :param failed: how many gave none.
    """

    found: list[FloatArray] = field(default_factory=list)
    failed: int = 0

    def cell(self, quantity: int) -> str:
        """Return median and 95th percentile of |error| in %, and how many failed."""
        if not self.found:
            return "-"
        errors = 100.0 * np.abs(np.array(self.found)[:, quantity])
        low, high = np.percentile(errors, (50.0, 95.0))
        failed = f" ({self.failed} failed)" if self.failed else ""
        return (f"{three(low)} / {three(high)}" if len(self.found) > 1 else three(low)) + failed


def methods(process: Process) -> tuple[str, ...]:
    """Return the methods that are for a process and its relay."""
    if process.bias:
        return ("waveform", "fourier", "wang_biased")
    if process.model.structure == "integrator_inverse":
        return ("waveform", "fourier", "thyagarajan", "luyben_step")
    unbiased = ("waveform", "fourier", "thyagarajan")
    if not process.model.is_stable:
        return unbiased
    lags = ("chang", "atv", "li") if process.model.structure in _LAGS else ()
    return (*unbiased, "wang_unbiased", *lags)


def known(process: Process, method: str) -> Known:
    """Return the known facts about a process that a method is given."""
    model = process.model
    order = model.order if TABLE[model.structure].any_order else 0
    if method == "waveform" or (method == "fourier" and model.structure in _ONE_LAG):
        return Known(structure=model.structure, order=order)
    if method in ("chang", "atv"):
        return Known(model.gain, model.dead_time, model.structure, order)
    if method == "li":
        return Known(structure=model.structure, order=order)
    return Known()


def step_record(process: Process, ratio: float, seed: int) -> Record:
    """Return a step test, with noise of a share of the mean deviation until the return."""
    horizon = 4.0 * sum(abs(t) for t in (*process.model.time_constants, *process.model.zeros))
    time = np.linspace(0.0, horizon, 1000)
    begin = 0.1 * horizon
    u = PiecewiseConstant(np.array([begin]), np.array([1.0]), 0.0)
    y = response(process.model, time, u)
    std = ratio * float(np.mean(np.abs(y[y <= 0.0]))) * math.sqrt(math.pi / 2.0)
    noise = std * np.random.default_rng((seed, 7)).standard_normal(time.size)
    return Record(time, y + noise, u(time), noise_std=std)


def identified(
    process: Process, method: str, record: Record, ratio: float, seed: int, *, seen: bool
) -> Identification:
    """Identify a process by a method, from a record or what else it needs."""
    facts = known(process, method)
    if method == "luyben_step":
        return identify(step_record(process, ratio, seed), method)
    if method != "li":
        return identify(record, method, facts)
    delay = _ADDED * 2.0 * math.pi / process.truth.frequency
    added = replace(process, extra_delay=delay)
    other = added.record(ratio, seed + 10_000, relay_sees_noise=seen)
    return identify_jointly((record, other), method, facts)


def errors(process: Process, ratio: float, seeds: int, *, seen: bool) -> dict[str, Errors]:
    """Return each method's errors over records of different noise."""
    truth = np.array((process.truth.gain, process.truth.frequency))
    result = {method: Errors() for method in methods(process)}
    for seed in range(seeds if ratio else 1):
        record = process.record(ratio, seed, relay_sees_noise=seen)
        for method, tally in result.items():
            try:
                model = identified(process, method, record, ratio, seed, seen=seen)
            except RelayAutotuneError:
                tally.failed += 1
                continue
            error = np.array((model.ultimate_gain, model.ultimate_frequency)) / truth - 1.0
            if np.all(np.isfinite(error)):
                tally.found.append(error)
            else:
                tally.failed += 1
    return result


def method_table(processes: Iterable[Process], ratios: tuple[float, ...], seeds: int) -> str:
    """Return the table of all methods on some processes."""
    rows: list[tuple[object, ...]] = []
    for process in processes:
        for seen in (False, True):
            # A sampled relay switches late even without noise.
            found = {r: errors(process, r, seeds, seen=seen) for r in ratios}
            for method in methods(process):
                cells = [found[r][method].cell(0) for r in ratios]
                rows.append(
                    (
                        process.title,
                        "yes" if seen else "no",
                        method,
                        *cells,
                        found[SHOWN][method].cell(1),
                    )
                )
    headings = [f"K_u, NSR {r:g}" for r in ratios]
    return table(("process", "relay sees noise", "method", *headings, f"w_u, NSR {SHOWN:g}"), rows)
