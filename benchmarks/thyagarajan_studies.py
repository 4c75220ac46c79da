# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Thyagarajan and Yu's studies: `python3 benchmarks/thyagarajan_studies.py [--seeds N] [--quick]`.

The category map (their Fig 4), how noise and hysteresis change the category, the shapes of the
equivalent models (Fig 9), the equations literally and exactly, and the noise study of Tables 6
and 7 as statistics over many records instead of single draws.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table, three
from numpy.typing import NDArray

from relay_autotune.errors import RelayAutotuneError
from relay_autotune.identification.judgement.assessment import integrated_error, validate
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.limit_cycle.shape import (
    Shape,
    shape_of_half_cycle,
    shape_of_record,
)
from relay_autotune.identification.methods import identify
from relay_autotune.identification.methods.lags import EXACT, FIRST, equal
from relay_autotune.identification.methods.thyagarajan import HIGHER_ORDER, SMALL_DEAD_TIME
from relay_autotune.identification.methods.wang import flat_fopdt, fopdt
from relay_autotune.process.simulation import HalfCycle
from relay_autotune.process.structures import UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))
from relay_runs import RelayRun, simulate_relay
from sampled_relay import exact_limit_cycle

FloatArray = NDArray[np.float64]
Numbers = tuple[float, float, float]

ORDERS = (1, 2, 3, 5, 8, 15, 20)
DEAD_TIMES = (0.001, 0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
EXAMPLES = {
    "1: e^(-10 s)/(s + 1)^3": TransferFunction.lag_n(1.0, 1.0, 3, 10.0),
    "2: e^(-15 s)/(s + 1)^15": TransferFunction.lag_n(1.0, 1.0, 15, 15.0),
    "3: e^(-10 s)/(s + 1)^2": TransferFunction.lag_n(1.0, 1.0, 2, 10.0),
    "4: e^(-0.05 s)/(25 s + 1)^2": TransferFunction.lag_n(1.0, 25.0, 2, 0.05),
    "5: e^(-0.6 s)/(6 s + 1)^8": TransferFunction.lag_n(1.0, 6.0, 8, 0.6),
    "6: e^(-0.001 s)/(s + 1)^20": TransferFunction.lag_n(1.0, 1.0, 20, 0.001),
    "e^(-0.1 s)/(s + 1)": TransferFunction.fopdt(1.0, 1.0, 0.1),
    "e^(-s)/(s + 1)": TransferFunction.fopdt(1.0, 1.0, 1.0),
    "e^(-10 s)/(s + 1)": TransferFunction.fopdt(1.0, 1.0, 10.0),
}
PER_CYCLE = 200
SEEDS = 100


def exact_shape(model: TransferFunction, hysteresis: float = 0.0) -> Shape:
    """Return the shape of a process's limit cycle under a relay of amplitude 1."""
    cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0, 0.0, hysteresis))
    return shape_of_half_cycle(HalfCycle(model, 0.5 * cycle.period))


def experiment(model: TransferFunction, cycles: int, amplitude: float = 1.0) -> RelayRun:
    """Return an ideal experiment with ``PER_CYCLE`` samples in a cycle, from the kick on."""
    relay = RelaySettings(0.0, 0.0, amplitude)
    end = simulate_relay(model, relay, cycles=cycles).command.times[-1]
    period = exact_limit_cycle(model, relay).period
    return simulate_relay(
        model, relay, cycles=cycles, time=np.arange(0.0, end, period / PER_CYCLE)
    )


def noise_std(run: RelayRun, ratio: float) -> float:
    """Return the standard deviation of noise of a ratio mean|noise|/mean|signal|."""
    steady = run.measurement[run.time >= run.cycles[-2].start]
    return ratio * float(np.mean(np.abs(steady))) * math.sqrt(math.pi / 2.0)


def fopdt_of(shape: Shape, level: float = 0.0) -> TransferFunction:
    """Return the FOPDT model of category 1a, stable or unstable."""
    numbers = (shape.period, shape.amplitude, shape.time_to_peak, 1.0, level)
    try:
        return TransferFunction.fopdt(*fopdt(*numbers))
    except RelayAutotuneError:
        return UNSTABLE_FOPDT.build(fopdt(*numbers, unstable=True))


def flat_of(shape: Shape, level: float | None = None) -> TransferFunction:
    """Return the FOPDT model of category 1b."""
    numbers = (shape.period, shape.amplitude, shape.rise, shape.rise_half, 1.0, level)
    return TransferFunction.fopdt(*flat_fopdt(*numbers))


def two_lags_of(shape: Shape, level: float | None = None) -> TransferFunction:
    """Return the model of category 2."""
    return _equal_lags_of(2, shape, level, SMALL_DEAD_TIME)


def five_lags_of(shape: Shape, level: float | None = None) -> TransferFunction:
    """Return the model of category 3."""
    return _equal_lags_of(HIGHER_ORDER, shape, level, 0.0)


def _equal_lags_of(
    order: int, shape: Shape, level: float | None, ratio: float
) -> TransferFunction:
    cycle = SymmetricCycle(shape.period, shape.amplitude, 1.0, level or 0.0, 0.0)
    gain, tau = equal(order, cycle, wave=FIRST if level is None else EXACT, ratio=ratio)
    return TransferFunction.lag_n(gain, tau, order, ratio * tau)


def least_error(model: TransferFunction, shape: Shape) -> str:
    """Return the structure of the least integrated absolute error (eq 30 with |G_m - G|)."""
    w = 2.0 * math.pi / shape.period
    errors = {}
    for name, make in (("1", fopdt_of), ("1 ", flat_of), ("2", two_lags_of), ("3", five_lags_of)):
        try:
            errors[name] = integrated_error(make(shape), model, w, relative=False)
        except RelayAutotuneError:
            continue
    return min(errors, key=errors.__getitem__).strip()


def category_map(dead_times: tuple[float, ...]) -> str:
    """Return the table of categories over order and dead time."""
    rows = []
    for order in ORDERS:
        cells = []
        for dead_time in dead_times:
            model = TransferFunction.lag_n(1.0, 1.0, order, dead_time)
            shape = exact_shape(model)
            best = least_error(model, shape)
            cells.append(shape.category + ("" if shape.category[0] == best else f" ({best})"))
        rows.append((order, *cells))
    return table(("n", *(f"D/tau = {d:g}" for d in dead_times)), rows)


def categories_in_noise(seeds: int) -> str:
    """Return how many records have the category of their process."""
    rows = []
    for title, model in EXAMPLES.items():
        wanted = exact_shape(model).category
        run = experiment(model, 24 if wanted == "2" else 6)
        shares = []
        for ratio in (0.05, 0.1, 0.2):
            std = noise_std(run, ratio)
            found = [shape_of_record(_noisy(run, std, seed)).category for seed in range(seeds)]
            others = sorted(set(found) - {wanted}, key=found.count)
            share = f"{100.0 * found.count(wanted) / seeds:.0f}"
            shares.append(f"{share} ({others[-1]})" if others else share)
        rows.append((title, wanted, *shares))
    return table(("process", "category", "NSR 0.05", "NSR 0.1", "NSR 0.2"), rows)


def _noisy(run: RelayRun, std: float, seed: int) -> Record:
    return run.record(noise_std=std, rng=np.random.default_rng((seed, round(1e9 * std))))


def equivalent_shapes() -> str:
    """Return how far the limit cycles of the equivalent models are from their process's."""
    rows = []
    for title, model in list(EXAMPLES.items())[:6]:
        shape = exact_shape(model)
        record = experiment(model, 60 if shape.category == "2" else 8).record()
        cells = []
        flat = shape.category == "1b"
        for make in (flat_of if flat else fopdt_of, two_lags_of, five_lags_of):
            # The exact equations are given zero as the level at which an ideal relay switches.
            found = validate(make(shape, 0.0), record)
            cells.append("none" if found.reason else f"{100.0 * found.shape:.2g}")
        rows.append((title, shape.category, *cells))
    return table(("process", "category", "FOPDT", "two lags", "five lags"), rows)


def equations_with_hysteresis() -> str:
    """Return errors of K_u and w_u by the equations, literally and exactly."""
    rows = []
    makers: dict[str, tuple[Callable[..., TransferFunction], float | None]] = {
        "1a": (fopdt_of, 0.0),
        "1b": (flat_of, None),
        "2": (two_lags_of, None),
        "3": (five_lags_of, None),
    }
    for title, model in EXAMPLES.items():
        ideal = exact_shape(model)
        make, without = makers[ideal.category]
        for share in (0.0, 0.1, 0.3):
            shape = exact_shape(model, share * ideal.amplitude)
            cells = [_errors(make, shape, level, model) for level in (without, shape.level)]
            rows.append((title, ideal.category, f"{share:g}", *cells))
    headings = ("process", "category", "hysteresis / a", "literally", "exactly")
    return table(headings, rows)


def _errors(
    make: Callable[..., TransferFunction],
    shape: Shape,
    level: float | None,
    process: TransferFunction,
) -> str:
    try:
        point = ultimate_point(make(shape, level))
    except RelayAutotuneError:
        return "no solution"
    truth = ultimate_point(process)
    if point is None or truth is None:
        return "no ultimate point"
    gain, frequency = point.gain / truth.gain - 1.0, point.frequency / truth.frequency - 1.0
    return f"{100.0 * gain:+.1f} / {100.0 * frequency:+.1f}"


def by_hand(record: Record, run: RelayRun, flat: bool) -> Numbers:
    """Read two cycles as the paper does: fictitious peaks, averaged.

    The local maxima that noise makes within a tenth of the half period about the highest sample
    are averaged, their heights and their times; and these over the four half cycles.
    """
    heights, delays, halves = [], [], []
    for cycle in run.cycles[-2:]:
        low_at = cycle.start + cycle.period_high
        for begin, length, sign in (
            (cycle.start, cycle.period_high, -1.0),
            (low_at, cycle.period_low, 1.0),
        ):
            part = (record.time >= begin) & (record.time < begin + length)
            t, y = record.time[part] - begin, sign * record.measurement[part]
            near = np.abs(t - t[np.argmax(y)]) < 0.1 * length
            local = np.flatnonzero((y[1:-1] > y[:-2]) & (y[1:-1] > y[2:])) + 1
            peaks = local[near[local]]
            peaks = peaks if peaks.size else np.array([np.argmax(y)])
            heights.append(float(np.mean(y[peaks])))
            delays.append(float(np.mean(t[peaks])))
            halves.append(float(t[np.argmax(y >= 0.5 * heights[-1])]))
    period = float(np.mean([c.period for c in run.cycles[-2:]]))
    a, peak, half = (float(np.mean(v)) for v in (heights, delays, halves))
    h = run.settings.amplitude
    return flat_fopdt(period, a, peak, half, h) if flat else fopdt(period, a, peak, h)


def noise_study(seeds: int) -> str:
    """Return the statistics of Tables 6 and 7."""
    rows = []
    for dead_time, ratio, printed in (
        (0.1, 0.2, ("0.396, 0.372, 0.109", "0.553, 0.541, 0.104")),
        (10.0, 0.1, ("1.25, 2.31, 8.71", "1.00, 1.64, 9.17")),
    ):
        model = TransferFunction.fopdt(1.0, 1.0, dead_time)
        std = noise_std(experiment(model, 3), ratio)
        for amplitude, draw in zip((1.0, 2.0), printed, strict=True):
            run = experiment(model, 3, amplitude)
            two = run.cycles[-2].start - 0.6 * run.cycles[-2].period
            readings: dict[str, Callable[[Record], Numbers]] = {
                "by hand": partial(by_hand, run=run, flat=dead_time > 1.0),
                "thyagarajan": partial(by_method, begin=two),
            }
            found: dict[str, list[Numbers]] = {name: [] for name in readings}
            for seed in range(seeds):
                record = _noisy(run, std, seed)
                for name, read in readings.items():
                    try:
                        found[name].append(read(record))
                    except RelayAutotuneError:
                        continue
            for name, values in found.items():
                spread = [
                    f"{three(m)} [{three(low)}, {three(high)}]"
                    for low, m, high in np.percentile(np.array(values), (5, 50, 95), axis=0).T
                ]
                fraction = f"{100.0 * (1.0 - len(values) / seeds):.0f}"
                points = [ultimate_point(TransferFunction.fopdt(*v)) for v in values]
                truth = ultimate_point(model)
                assert truth is not None
                errors = [abs(p.gain / truth.gain - 1.0) for p in points if p is not None]
                gain = " / ".join(three(100.0 * e) for e in np.percentile(errors, (50, 95)))
                case = (f"{dead_time:g}", f"{amplitude:g}", three(ratio / amplitude))
                rows.append((*case, name, *spread, gain, fraction, draw))
    headings = (
        *("true D", "h", "NSR", "reading", "K", "tau", "D", "error of K_u [%]", "failed [%]"),
        "the paper's draw of K, tau, D",
    )
    return table(headings, rows)


def _from(record: Record, begin: float) -> Record:
    """Return a record from some time on."""
    first = int(np.searchsorted(record.time, begin))
    starts = tuple(i - first for i in record.cycle_start if i >= first)
    return Record(
        time=record.time[first:],
        measurement=record.measurement[first:],
        command=record.command[first:],
        settings=record.settings,
        noise_std=record.noise_std,
        cycle_start=starts,
        outcome=record.outcome,
        held_input=record.held_input,
    )


def by_method(record: Record, begin: float) -> Numbers:
    """Identify a FOPDT model from what a record holds from some time on."""
    found = identify(_from(record, begin), "thyagarajan", Known(structure="fopdt"))
    k, tau, dead_time = (float(v) for v in found.values)
    return k, tau, dead_time


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=SEEDS, help="records of each noise level")
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    given = parser.parse_args()
    seeds = 4 if given.quick else given.seeds
    dead_times = DEAD_TIMES[1::3] if given.quick else DEAD_TIMES
    print("Categories of e^(-D s)/(tau s + 1)^n:\n")
    print(category_map(dead_times), flush=True)
    print(f"\nRecords with the category of their process [%], of {seeds}:\n")
    print(categories_in_noise(seeds), flush=True)
    print("\nDifference in shape of the equivalent models [% of the amplitude]:\n")
    print(equivalent_shapes(), flush=True)
    print("\nErrors of K_u / w_u [%] by the equations of the category:\n")
    print(equations_with_hysteresis(), flush=True)
    print(f"\nTables 6 and 7 over {seeds} records, median [5th, 95th percentile]:\n")
    print(noise_study(seeds), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
