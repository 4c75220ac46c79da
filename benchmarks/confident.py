# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How early `stop_when: confident` ends a test: `python3 benchmarks/confident.py [--records N]`.

Each process for which the papers show a relay test is tested as relay_node does it, at a
noise-to-signal ratio of 0.1, with the sign of its gain given. Whenever relay_node would send the
record, it is fitted as identifier_node does it, and the test ends when the 95 % interval of K_u is
narrow enough. The classic criterion (three cycles whose half periods and peaks agree within 2 %)
is applied to the same process without noise. Lengths are counted from the kick on. Beside each
length stands the least one: the time at which the Cramer-Rao bound of K_u reaches the wanted
accuracy, for the same commands and a known structure.

A target may be missed where that bound needs more than half of the classic time; the exit status
is 1 if one is missed elsewhere. A median of 50 tests is known to a sixth of itself, so the errors
of all other processes together are printed, too. `--unknown-sign` lets each test find the
sign of the gain first, which is then part of both lengths. `--of ms` ends the tests by the
interval of the predicted Ms in place of that of K_u; the error is then that of the predicted Ms
against the Ms of the gains on the process, and no target is set. `--jobs 2` takes two processes
at a time.
"""

from __future__ import annotations

import argparse
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

from markdown import table

from relay_autotune import threads  # noqa: F401  before numpy
from relay_autotune.arrays import FloatArray
from relay_autotune.quantities import NORMAL_95

# isort: split
import numpy as np
from information import relative_bounds
from processes import true_point
from sampled_relay import exact_limit_cycle

from relay_autotune.analysis import RunningFit, Task, analyse
from relay_autotune.experiment.early_end import SOUGHT, ULTIMATE_GAIN, EarlyEnd, FitProgress
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    LAG_COMPLEX,
    LAG_N_ZERO,
    UNSTABLE_FOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.record.record import Record, RelaySettings
from relay_autotune.tuning.task import DesignOptions

RECORDS = 50
RATIO = 0.1
PER_CYCLE = 200
MOST_TIME = 0.5
# Half a 95 % interval: of a normal error whose median is 0.5 % and 95th percentile 1.45 %, and,
# with a tiny dead time, whose 95th percentile is 3.5 %.
ASKED, ASKED_OF_TINY = 0.0135, 0.035
ASKED_OF_MS = 0.02
MOST_ERROR = (0.005, 0.015)
MOST_ERROR_OF_TINY = (math.inf, 0.035)
MOST_CYCLES = 60
_MOST_SAMPLES = 200_000
# The least length is found to this fraction of the classic one.
_GRID = 200
_LONGEST = 4.0


@dataclass(frozen=True)
class Case:
    """A process of the papers.

    :param title: the process as people write it.
    :param source: where it is from.
    :param model: the process.
    :param tiny: True: a second order with tiny dead time.
    """

    title: str
    source: str
    model: TransferFunction
    tiny: bool = False

    @property
    def asked(self) -> float:
        """Half of the interval of K_u over it."""
        return ASKED_OF_TINY if self.tiny else ASKED

    @property
    def most_error(self) -> tuple[float, float]:
        """Largest error of K_u at the median and at the 95th percentile."""
        return MOST_ERROR_OF_TINY if self.tiny else MOST_ERROR


_T = TransferFunction
CASES = (
    Case("e^-s/(2s+1)", "Wang, table 1", _T.fopdt(1.0, 2.0, 1.0)),
    Case("e^-2s/(2s+1)", "Wang, table 1", _T.fopdt(1.0, 2.0, 2.0)),
    Case("e^-5s/(2s+1)", "Wang, table 1", _T.fopdt(1.0, 2.0, 5.0)),
    Case("e^-2s/(5s+1)", "Wang, table 1", _T.fopdt(1.0, 5.0, 2.0)),
    Case("e^-2s/(2s+1)^2", "Wang, table 3", _T.lag_n(1.0, 2.0, 2, 2.0)),
    Case("e^-2s/(2s+1)^5", "Wang, table 3", _T.lag_n(1.0, 2.0, 5, 2.0)),
    Case(
        "e^-0.5s/((s+1)(s^2+s+1))", "Wang, table 3", LAG_COMPLEX.build((1.0, 1.0, 1.0, 0.5, 0.5))
    ),
    Case(
        "(1-s)e^-s/(s+1)^5", "Wang, table 3", LAG_N_ZERO.of_order(5).build((1.0, 1.0, -1.0, 1.0))
    ),
    Case("1.65e^-10s/(20s+1)", "Chang, example 1", _T.fopdt(1.65, 20.0, 10.0)),
    Case("1.65e^-s/(20s+1)", "Chang, figure 3", _T.fopdt(1.65, 20.0, 1.0)),
    Case("37.3e^-s/((7200s+1)(2s+1))", "Chang, figure 4", _T.sopdt(37.3, (7200.0, 2.0), 1.0)),
    Case("e^-0.1s/(s+1)", "Thyagarajan, table 6", _T.fopdt(1.0, 1.0, 0.1)),
    Case("e^-10s/(s+1)", "Thyagarajan, table 7", _T.fopdt(1.0, 1.0, 10.0)),
    Case("e^-10s/(s+1)^3", "Thyagarajan, example 1", _T.lag_n(1.0, 1.0, 3, 10.0)),
    Case("e^-15s/(s+1)^15", "Thyagarajan, example 2", _T.lag_n(1.0, 1.0, 15, 15.0)),
    Case("e^-10s/(s+1)^2", "Thyagarajan, example 3", _T.lag_n(1.0, 1.0, 2, 10.0)),
    Case("e^-0.05s/(25s+1)^2", "Thyagarajan, example 4", _T.lag_n(1.0, 25.0, 2, 0.05), tiny=True),
    Case("e^-0.6s/(6s+1)^8", "Thyagarajan, example 5", _T.lag_n(1.0, 6.0, 8, 0.6)),
    Case("e^-0.001s/(s+1)^20", "Thyagarajan, example 6", _T.lag_n(1.0, 1.0, 20, 0.001)),
    Case("e^-0.01s/(2s+1)^2", "Thyagarajan, eq 42", _T.lag_n(1.0, 2.0, 2, 0.01), tiny=True),
    Case("e^-0.3s/(s-1)", "Thyagarajan, eqs 14-17", UNSTABLE_FOPDT.build((1.0, 1.0, 0.3))),
    Case(
        "0.547(1-0.418s)e^-0.1s/(s(1.06s+1))",
        "Luyben, example",
        INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
    ),
)


@dataclass(frozen=True)
class Length:
    """One test: its length from the kick on [s], its cycles, and the error of what was sought."""

    time: float
    cycles: float
    error: float = math.nan


class Bench:
    """One process under the relay.

    :param case: the process.
    :param sign: of its gain as the relay is told it; 0: to be found.
    """

    def __init__(self, case: Case, sign: int) -> None:
        self.case, self.sign = case, sign
        self.truth = true_point(case.model).gain
        cycle = exact_limit_cycle(case.model, RelaySettings(0.0, 0.0, 1.0, 0.3), tolerance=1e-6)
        self.period = cycle.period / PER_CYCLE
        self.classic, record = self._classic()
        last = slice(*record.cycle_start[-2:])
        # N2 of Wang et al., for Gaussian noise.
        swing = float(np.mean(np.abs(record.measurement[last])))
        self.noise = RATIO * swing * math.sqrt(0.5 * math.pi)

    def _run(
        self, noise: float, seed: int, early: EarlyEnd | None, least: float = 0.0
    ) -> tuple[RelayExperiment, FitProgress]:
        """Run a test; return it with what ended it."""
        tune = RelayExperiment(
            ExperimentParameters(
                amplitude=1.0, max_cycles=MOST_CYCLES, process_gain_sign=self.sign
            ),
            0.0,
            until_converged=early is None and least == 0.0,
        )
        disturbed = Disturbances(noise_std=noise)
        plant = VirtualProcess(self.case.model, disturbances=disturbed, seed=seed)
        ended_by, fit = FitProgress(), RunningFit()
        for k in range(_MOST_SAMPLES):
            plant.command(tune.step(k * self.period, plant.measure(k * self.period)))
            if tune.finished or 0.0 < least < tune.elapsed - tune.facts.kicked_at:
                break
            if early is not None and early.is_due(tune):
                early.look(tune)
                found = fit.fit(tune.record(), Task(), early.sought, early.wanted)
                if (reason := early.judge(tune, found.finding)) != "":
                    ended_by = found.finding
                    tune.conclude(reason)
                    break
        return tune, ended_by

    def _classic(self) -> tuple[Length, Record]:
        tune, _ = self._run(0.0, 0, None)
        return Length(tune.elapsed - tune.facts.kicked_at, tune.cycle_count), tune.record()

    def confident(self, seed: int, sought: str) -> Length:
        """Run a test until what is sought is known well enough."""
        asked = self.case.asked if sought == ULTIMATE_GAIN else ASKED_OF_MS
        tune, found = self._run(self.noise, seed, EarlyEnd(sought, asked))
        error = abs(found.ultimate_gain / self.truth - 1.0)
        if sought != ULTIMATE_GAIN and tune.finished:
            error = abs(self._true_ms(tune.record()) / found.ms - 1.0)
        return Length(tune.elapsed - tune.facts.kicked_at, 0.5 * tune.switches, error)

    def _true_ms(self, record: Record) -> float:
        """Return the Ms of the gains after a test on the process; NaN: there are none."""
        gains = analyse(record, alone=True).best_gains
        if gains is None:
            return math.nan
        options = DesignOptions(sample_period=self.period)
        loop = replace(self.case.model, dead_time=self.case.model.dead_time + options.added_delay)
        return analyse_loop(gains, loop).ms

    def bound(self, seed: int) -> tuple[float, float]:
        """Return the least length [s] for what is asked, and half the interval at half time."""
        longest = _LONGEST * self.classic.time
        tune, _ = self._run(self.noise, seed, None, least=longest)
        times = longest * np.arange(1, round(_LONGEST * _GRID) + 1) / (_LONGEST * _GRID)
        found = NORMAL_95 * relative_bounds(
            self.case.model, tune.record(), self.noise, tune.facts.kicked_at + times
        )
        enough = np.flatnonzero(found <= self.case.asked)
        least = float(times[enough[0]]) if enough.size else math.inf
        return least, float(found[round(MOST_TIME * _GRID) - 1])


@dataclass(frozen=True)
class Row:
    """The result of a process.

    :param cells: of the table.
    :param fine: True: the targets were met.
    :param can: True: the bound lets them be met.
    :param errors: of what was sought, of each test.
    """

    cells: tuple[object, ...]
    fine: bool
    can: bool
    errors: FloatArray


def _row(case: Case, seeds: range, sought: str, unknown_sign: bool) -> Row:
    """Return the row of a process."""
    # The pulse that finds the sign needs a process that returns by itself.
    bench = Bench(case, 0 if unknown_sign and case.model.is_stable else case.model.process_sign)
    usual = bench.classic.time
    runs = [bench.confident(seed, sought) for seed in seeds]
    least, at_half = np.median([bench.bound(seed) for seed in seeds[:3]], axis=0)
    share = float(np.median([r.time for r in runs])) / usual
    errors = np.array([r.error for r in runs])
    median, high = float(np.nanmedian(errors)), float(np.nanquantile(errors, 0.95))
    unfinished = int(np.isnan(errors).sum())
    most = case.most_error
    fine = share <= MOST_TIME and median <= most[0] and high <= most[1] and not unfinished
    can = bool(least <= MOST_TIME * usual)
    cells = (
        case.title,
        case.source,
        bench.classic.cycles,
        f"{usual:.3g}",
        f"{100 * share:.0f}",
        f"{np.median([r.cycles for r in runs]):.1f}",
        f"{100 * least / usual:.0f}" if math.isfinite(least) else f"> {100 * _LONGEST:.0f}",
        f"{100 * at_half:.2f}",
        f"{100 * median:.2f}",
        f"{100 * high:.2f}",
        "-" if sought != ULTIMATE_GAIN else "yes" if fine else "no" if can else "beyond the bound",
    )
    return Row(cells, fine, can, errors)


def main() -> int:
    """Run the tests and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=RECORDS)
    parser.add_argument("--unknown-sign", action="store_true", help="let each test find the sign")
    parser.add_argument("--of", choices=SOUGHT, default=ULTIMATE_GAIN, help="what is sought")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--only", default="", help="processes whose title has this")
    parser.add_argument("--quick", action="store_true", help="one process, never fails")
    asked = parser.parse_args()
    seeds = range(1 if asked.quick else asked.records)
    cases = [c for c in (CASES[1:2] if asked.quick else CASES) if asked.only in c.title]
    one = partial(_row, seeds=seeds, sought=asked.of, unknown_sign=asked.unknown_sign)
    if asked.jobs > 1:
        with ProcessPoolExecutor(asked.jobs) as pool:
            found = list(pool.map(one, cases))
    else:
        found = [one(case) for case in cases]
    headings = (
        *("process", "from", "classic, cycles", "classic [s]"),
        *("confident, % of classic", "cycles", "bound, % of classic", "bound at half [%]"),
        *("error, median [%]", "95th percentile [%]", "targets met"),
    )
    print(table(headings, [row.cells for row in found]))
    wanted = (
        f"K_u asked to within {100 * ASKED:g} % ({100 * ASKED_OF_TINY:g} % with a tiny dead time)"
        if asked.of == ULTIMATE_GAIN
        else f"the predicted Ms asked to within {100 * ASKED_OF_MS:g} %"
    )
    print(
        f"\n{len(seeds)} tests each, {PER_CYCLE} samples a period, {wanted}. Targets: at most "
        f"{100 * MOST_TIME:.0f} % of the classic time, errors of at most "
        f"{100 * MOST_ERROR[0]:g} % and {100 * MOST_ERROR[1]:g} % "
        f"({100 * MOST_ERROR_OF_TINY[1]:g} % at the 95th percentile with a tiny dead time)."
    )
    if asked.of != ULTIMATE_GAIN:
        return 0
    within = [row for row in found if row.can]
    errors = 100.0 * np.concatenate([row.errors for row in within]) if within else np.empty(0)
    if errors.size:
        print(
            f"\nAll {errors.size} tests of the {len(within)} processes that the bound lets meet "
            f"them: median {np.nanmedian(errors):.2f} %, 95th percentile "
            f"{np.nanquantile(errors, 0.95):.2f} %."
        )
    return 0 if asked.quick or all(row.fine for row in within) else 1


if __name__ == "__main__":
    sys.exit(main())
