# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time and memory of a replay over shapes of input: `python3 benchmarks/replay_shapes.py`.

Each recording is a process of two lags and a dead time under another command, sampled so often as
the row says; each is analysed in a process of its own, so that its peak of memory is its own.
Processor time is given, which others that work on the machine do not lengthen.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable

import numpy as np
from markdown import table, three
from numpy.typing import NDArray

from relay_autotune.analysis import analyse
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record

FloatArray = NDArray[np.float64]
Shape = Callable[[FloatArray, np.random.Generator], FloatArray]

# The recording lasts so long, however often it is sampled [s].
DURATION = 1000.0
PROCESS = TransferFunction.sopdt(2.0, (12.0, 4.0), 3.0)
NOISE = 0.02
SIZES = (1_000, 10_000, 100_000, 1_000_000)
# On this machine, no recording is to take longer than the first, and half of them the second.
MOST, USUAL = 10.0, 2.0


def _prbs(t: FloatArray, rng: np.random.Generator) -> FloatArray:
    return rng.choice([-1.0, 1.0], 1 + int(DURATION / 5.0))[(t / 5.0).astype(int)]


def _steps(t: FloatArray, rng: np.random.Generator) -> FloatArray:
    return rng.uniform(-1.0, 1.0, 1 + int(DURATION / 20.0))[(t / 20.0).astype(int)]


SHAPES: dict[str, Shape] = {
    "sine and square": lambda t, _: np.sin(0.1 * t) + 0.5 * np.sign(np.sin(0.03 * t)),
    "white noise": lambda t, rng: rng.standard_normal(t.size),
    "PRBS": _prbs,
    "PRBS at every sample": lambda t, rng: rng.choice([-1.0, 1.0], t.size),
    "many steps": _steps,
    "one long step": lambda t, _: (t >= 0.1 * DURATION).astype(float),
    "slow ramp": lambda t, _: np.clip(t / DURATION - 0.1, 0.0, 0.5),
    "quantised": lambda t, _: np.round(4.0 * np.sin(0.05 * t)) / 4.0,
}


def recording(shape: str, samples: int, seed: int = 0) -> Record:
    """Return a recording of the process.

    :param shape: of its command, one of ``SHAPES``.
    :param samples: how many.
    :param seed: of command and noise.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, DURATION, samples)
    u = SHAPES[shape](t, rng)
    held = PiecewiseConstant.from_samples(t, u)
    y = response(PROCESS, t, held) + NOISE * rng.standard_normal(samples)
    if shape == "quantised":
        y = np.round(20.0 * y) / 20.0
    return Record(t, y, u)


def _measure(shape: str, samples: int) -> tuple[float, float, str]:
    """Return processor time [s], peak of memory [MB] and what came of it."""
    record = recording(shape, samples)
    begun = time.process_time()
    found = analyse(record)
    took = time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    model = found.model
    said = "none" if model is None else f"{model.model}, {found.verdict.name.lower()}"
    return took, peak, said


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the smallest only: does it run?")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="samples")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=list(SHAPES))
    options = parser.parse_args()
    sizes, shapes = (SIZES[:1], ["PRBS"]) if options.quick else (options.sizes, options.shapes)
    rows, times = [], []
    for shape in shapes:
        for samples in sizes:
            # A process for each: the peak of memory is that of the process's whole life.
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                took, peak, said = pool.apply(_measure, (shape, samples))
            times.append(took)
            rows.append((shape, f"{samples:,}", three(took), three(peak), said))
            print(rows[-1], file=sys.stderr, flush=True)
    print(table(("command", "samples", "time [s]", "peak [MB]", "model, verdict"), rows))
    print(
        f"\nlongest {three(max(times))} s (target <= {MOST:g}), "
        f"median {three(float(np.median(times)))} s (target <= {USUAL:g})"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
