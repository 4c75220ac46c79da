# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Every rule on the papers' examples: `python3 benchmarks/paper_designs.py [--quick]`.

The loops of the worked cases with the Ms and IAE that they must have; what each rule gives for
each example, PI and PID; and the comparisons of Thyagarajan and Yu (Figs 10, 11, 14, 15) and of
Luyben (Figs 8 to 13) as figures.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
from markdown import table, three

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import ControlLaw, analyse_loop, is_stable
from relay_autotune.loop.gains import Controller, Performance, SeriesForm
from relay_autotune.process.structures import INTEGRATOR_INVERSE
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning import RULES, design
from relay_autotune.tuning.compensators import dead_time_compensator, high_order_compensator
from relay_autotune.tuning.rules.formulas import describing_point_of
from relay_autotune.tuning.rules.step_response import two_point_fopdt
from relay_autotune.tuning.task import DesignOptions, DesignTask

CASES = Path(__file__).resolve().parent.parent / "test/support/data/worked_cases.json"

_T = TransferFunction
DRUM = INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1))
# Title, process, and how the worked cases call it.
EXAMPLES = (
    ("e^(-10 s)/(s + 1)^3", _T.lag_n(1.0, 1.0, 3, 10.0), "ex1"),
    ("e^(-15 s)/(s + 1)^15", _T.lag_n(1.0, 1.0, 15, 15.0), "ex2"),
    ("e^(-10 s)/(s + 1)^2", _T.lag_n(1.0, 1.0, 2, 10.0), "ex3"),
    ("e^(-0.05 s)/(25 s + 1)^2", _T.lag_n(1.0, 25.0, 2, 0.05), "ex4"),
    ("e^(-0.6 s)/(6 s + 1)^8", _T.lag_n(1.0, 6.0, 8, 0.6), "ex5"),
    ("e^(-0.001 s)/(s + 1)^20", _T.lag_n(1.0, 1.0, 20, 0.001), "ex6"),
    ("e^(-0.01 s)/(2 s + 1)^2", _T.lag_n(1.0, 2.0, 2, 0.01), "eq42"),
    ("e^(-0.1 s)/(s + 1)", _T.fopdt(1.0, 1.0, 0.1), "fopdt .1"),
    ("e^(-s)/(s + 1)", _T.fopdt(1.0, 1.0, 1.0), "fopdt 1"),
    ("e^(-10 s)/(s + 1)", _T.fopdt(1.0, 1.0, 10.0), "fopdt 10"),
    ("1.65 e^(-10 s)/(20 s + 1)", _T.fopdt(1.65, 20.0, 10.0), "Chang"),
    ("0.547 (1 - 0.418 s) e^(-0.1 s)/(s (1.06 s + 1))", DRUM, "Luyben"),
)

# Thyagarajan and Yu, Table 5: the three designs for each example, kc and ti.
TABLE_5 = {
    "ex1": ((0.4587, 7.3858), (0.0023, 365.9), (0.4418, 11.724)),
    "ex2": ((0.4652, 17.6739), (0.0023, 856.64), (0.4416, 27.4452)),
    "ex3": ((0.4309, 7.4506), (0.0023, 337.2), (0.4415, 10.8036)),
    "ex4": ((269.6448, 11.9548), (1.5279, 78.4), (303.15, 2.5132)),
    "ex5": ((0.5758, 202.268), (0.0033, 1327.4), (0.6387, 42.5252)),
    "ex6": ((0.4880, 48.2641), (0.0024, 567.82), (0.4654, 18.1916)),
}
CATEGORIES = ("FOPDT (category 1)", "second order (2)", "higher order (3)")
RIGHT = {"ex1": 0, "ex2": 0, "ex3": 0, "ex4": 1, "ex5": 2, "ex6": 2}

# Luyben's Table 1: share of the PI controller's ti, then td and kc, the best of each first.
LUYBEN = (
    (11.5, ((1.15, 1.69), (0.576, 1.29), (0.767, 1.66), (2.3, 0.967))),
    (5.75, ((1.15, 1.61), (1.44, 1.40), (2.88, 0.774), (5.76, 0.436))),
)


def worked_loops() -> Iterator[tuple[str, Controller, dict[str, float]]]:
    """Yield process, controller and exact figures of each loop of the worked cases."""
    for case in json.loads(CASES.read_text()):
        name = case["id"]
        if name.startswith("design."):
            td = float(name.split("Td=")[1]) if "Td=" in name else 0.0
            given = case["inputs"]
            yield (
                given["process"],
                Controller(given["Kc"], given["Ti"], td, td / 10.0),
                case["exact"],
            )


def agreement(quick: bool) -> str:
    """Return how far the figures of the worked loops are from what they must be."""
    loops = list(worked_loops())
    rows = []
    for title, model, short in EXAMPLES[-1:] if quick else EXAMPLES:
        of_ms, of_iae, count, unstable = [0.0], [0.0], 0, 0
        for process, controller, exact in loops:
            if process != short and not process.startswith(f"{short} "):
                continue
            count += 1
            if not exact["stable"]:
                unstable += not is_stable(controller, model)
                continue
            found = analyse_loop(controller, model)
            of_ms.append(100.0 * abs(found.ms / exact["Ms"] - 1.0))
            of_iae.append(100.0 * abs(found.iae_load / exact["IAE_load"] - 1.0))
        rows.append((title, count, unstable, three(max(of_ms)), three(max(of_iae))))
    headings = ("process", "loops", "unstable, as listed", "Ms off by [%]", "IAE off by [%]")
    return table(headings, rows)


def rules_side_by_side(quick: bool) -> str:
    """Return what every rule gives for every example, PI and PID."""
    rows = []
    for title, model, _ in EXAMPLES[-2:-1] if quick else EXAMPLES:
        try:
            simple = None if model.structure == "fopdt" else two_point_fopdt(model)
        except TuningError:
            simple = None
        task = DesignTask(model=model, simple=simple, describing=describing_point_of(model))
        for rule in RULES:
            cells = [_cells(task, rule, kind) for kind in ("pi", "pid")]
            if any(cell[0] for cell in cells):
                rows.append((title, f"`{rule}`", *cells[0], *cells[1]))
    kinds = [f"{k} {what}" for k in ("PI:", "PID:") for what in ("kc", "ti, td [s]", "Ms", "IAE")]
    return table(("process", "rule", *kinds), rows)


def _cells(task: DesignTask, rule: str, kind: str) -> tuple[str, str, str, str]:
    task = replace(task, options=DesignOptions(controller=kind))
    try:
        controller, _ = RULES[rule](task)
    except TuningError:
        return "", "", "", ""
    times = three(controller.ti) + (f", {three(controller.td)}" if controller.td else "")
    if not is_stable(controller, task.model):
        return three(controller.kc), times, "unstable", ""
    try:
        found = design(task, rule)
    except TuningError:
        # Stable, but its response rings longer than the simulation.
        return three(controller.kc), times, "nearly unstable", ""
    return three(found.kc), times, f"{found.ms:.2f}", three(found.iae_load)


def figures_of(controller: ControlLaw, model: TransferFunction) -> tuple[str, ...]:
    """Return a closed loop's figures as cells."""
    if not is_stable(controller, model):
        return ("unstable", *("",) * 6)
    p: Performance = analyse_loop(controller, model)
    return (
        f"{p.ms:.2f}",
        f"{20.0 * math.log10(p.mt):.2f}",
        f"{100.0 * p.overshoot:.1f}",
        three(p.settling_time),
        three(p.iae_setpoint),
        three(p.iae_load),
        three(p.delay_margin),
    )


FIGURES = (
    *("Ms", "resonance [dB]", "overshoot [%]", "settled [s]", "IAE set-point", "IAE load"),
    "delay margin [s]",
)


def thyagarajan_figures(quick: bool) -> str:
    """Return the closed loops of Figs 10, 11, 14 and 15."""
    by_name = {short: (title, model) for title, model, short in EXAMPLES}
    rows = []
    for short in ("ex1",) if quick else TABLE_5:
        title, model = by_name[short]
        for k, (kc, ti) in enumerate(TABLE_5[short]):
            mark = " *" if RIGHT[short] == k else ""
            found = figures_of(Controller(kc, ti), model)
            rows.append(("10", title, f"PI for {CATEGORIES[k]}{mark}", *found))
    title, model = by_name["eq42"]
    for kc, ti, why in (
        (3.6398, 4.0, "true process"),
        (0.6038, 10.0, "D/tau = 0.001"),
        (4.1794, 3.7956, "D/tau by eq 25"),
    ):
        rows.append(
            ("11", title, f"PI, 45 degrees, {why}", *figures_of(Controller(kc, ti), model))
        )
    title, model = by_name["ex1"]
    inside = _T.fopdt(0.8724, 1.9574, 10.8567)
    law = dead_time_compensator(DesignTask(model=inside)).law
    rows.append(("14", title, "PI by IMC", *figures_of(Controller(0.4587, 7.3858), model)))
    rows.append(("14", title, "dead-time compensator, eq 50", *figures_of(law, model)))
    rows.append(("14", "its own model", "the same", *figures_of(law, inside)))
    title, model = by_name["ex5"]
    inside = _T.lag_n(1.5661, 10.6313, 5, 0.0)
    law = high_order_compensator(DesignTask(model=inside)).law
    rows.append(("15", title, "PI of 3 dB", *figures_of(Controller(0.6387, 42.5252), model)))
    rows.append(("15", title, "higher-order controller, eq 54", *figures_of(law, model)))
    rows.append(("15", "its own model", "the same", *figures_of(law, inside)))
    return table(("Fig", "process", "controller", *FIGURES), rows)


def luyben_figures(quick: bool) -> str:
    """Return the closed loops of Luyben's Figs 8 to 13, as printed and as designed here."""
    rows = [("8, 9", "PI, kc 0.854, ti 23", *figures_of(Controller(0.854, 23.0), DRUM))]
    for (ti, settings), which in zip(LUYBEN, ("10, 11", "12, 13"), strict=True):
        for td, kc in settings[:1] if quick else settings:
            c = SeriesForm(kc, ti, td).isa()
            name = f"series PID, kc {kc:g}, ti {ti:g}, td {td:g}"
            rows.append((which, name, *figures_of(c, DRUM)))
    for kind in ("pi",) if quick else ("pi", "pid"):
        task = DesignTask(model=DRUM, options=DesignOptions(controller=kind))
        for rule in ("luyben2003", "robust"):
            c, _ = RULES[rule](task)
            found = figures_of(c, DRUM)
            rows.append(("", f"`{rule}`: {kind.upper()}, {c}", *found))
    return table(("Fig", "controller [min]", *(f.replace("[s]", "[min]") for f in FIGURES)), rows)


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="only show that it runs")
    quick = parser.parse_args().quick
    print("The loops of the worked cases:\n")
    print(agreement(quick), flush=True)
    print("\nEvery rule on every example, judged on the process itself:\n")
    print(rules_side_by_side(quick), flush=True)
    print("\nThe closed loops of Thyagarajan and Yu; * the category of the process:\n")
    print(thyagarajan_figures(quick), flush=True)
    print("\nThe closed loops of Luyben:\n")
    print(luyben_figures(quick), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
