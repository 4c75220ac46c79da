# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Results of simulated experiments, and their tables."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from markdown import table
from random_experiments import DISTURBANCES, FAULTS, HAPPENINGS, NOTHING

from relay_autotune.quantities import NORMAL_95

MOST_REFUSED = 5.0
LEAST_CYCLES = 3
_RATIOS = (0.0, 0.05, 0.1, 0.15, 0.2)


@dataclass
class Result:
    """The result of one experiment.

    :param seed: of the experiment.
    :param state: of the code.
    :param happening: what happened in it.
    :param structure: of the true process.
    :param ratio: noise-to-signal ratio.
    :param per_cycle: samples in a cycle.
    :param finds_amplitude: True if the amplitude was not given.
    :param outcome: of the experiment.
    :param cycles: whole cycles.
    :param delay: samples from the cause of the end to the safe command; -1: there was no cause.
    :param late: see :class:`Experiment`.
    :param unsafe: see :class:`Experiment`.
    :param gains: whether there are gains.
    :param reason: why it did not complete, or why there are no gains.
    :param found: structure of the model.
    :param stable: whether the loop on the true process is stable.
    :param ms: its Ms with the loop's own delay; NaN: none.
    :param asked: what the gains' reason says of Ms; NaN: none.
    :param gain_error: relative error of K_u; NaN: no model.
    :param gain_std: its standard deviation, relative.
    :param frequency_error: relative error of w_u.
    :param frequency_std: its standard deviation, relative.
    :param seconds: of a processor that it took.
    """

    seed: int
    state: str
    happening: str
    structure: str
    ratio: float
    per_cycle: int
    finds_amplitude: bool
    outcome: str = ""
    cycles: int = 0
    delay: int = -1
    late: bool = False
    unsafe: bool = False
    gains: bool = False
    reason: str = ""
    found: str = ""
    stable: bool = True
    ms: float = math.nan
    asked: float = math.nan
    gain_error: float = math.nan
    gain_std: float = math.nan
    frequency_error: float = math.nan
    frequency_std: float = math.nan
    seconds: float = 0.0


def summary(results: Sequence[Result]) -> tuple[str, bool]:
    """Return all tables, and whether the targets are met."""
    quiet = [r for r in results if r.happening == NOTHING]
    late = sum(r.late for r in results)
    gains = sum(r.gains for r in results if r.outcome != "completed")
    unsafe = sum(r.unsafe for r in results)
    unstable = sum(not r.stable for r in results)
    refused = 100.0 * sum(not _served(r) for r in quiet) / max(len(quiet), 1)
    enough = [r for r in quiet if r.cycles >= LEAST_CYCLES]
    of_these = 100.0 * sum(not _served(r) for r in enough) / max(len(enough), 1)
    states = sorted({r.state for r in results})
    cost = np.mean([r.seconds for r in results])
    parts = [
        f"{len(results)} experiments, seeds {min(r.seed for r in results)} to "
        f"{max(r.seed for r in results)}, of {len(states)} state{'s' * (len(states) > 1)} of the "
        f"code ({', '.join(states)}), {cost:.2f} s of a processor each. Gains "
        f"from an experiment that was not completed: {gains} (target 0). Safe command later than "
        f"one sample: {late} (target 0). Another command after it, or a process that ran away "
        f"though it could be held: {unsafe}. Recommended loops unstable on the true process: "
        f"{unstable} (target 0). Undisturbed experiments without gains: {refused:.1f} %, of those "
        f"with {LEAST_CYCLES} cycles or more {of_these:.1f} % (target {MOST_REFUSED:g} %).",
        _happenings(results),
        "Samples from a fault to the safe command; a frozen sensor, a wrong sign and a stuck "
        "actuator have to be told from a process first:",
        _delays(results),
        "Undisturbed, by structure of the true process:",
        _figures("structure", quiet, lambda r: r.structure),
        "Undisturbed, by noise-to-signal ratio:",
        _figures("ratio", quiet, _ratio),
        "Undisturbed, by how the amplitude was set:",
        _figures("amplitude", quiet, lambda r: "found" if r.finds_amplitude else "given"),
        "With disturbances:",
        _figures(
            "disturbance",
            [r for r in results if r.happening in DISTURBANCES],
            lambda r: r.happening,
        ),
    ]
    reasons = Counter(f"{r.structure}: {_short(r.reason)}" for r in quiet if not _served(r))
    if reasons:
        parts += [
            "Undisturbed experiments without gains, by reason:",
            table(("reason", "experiments"), reasons.most_common(12)),
        ]
    # The heading of an empty table is left out.
    shown = [
        part
        for k, part in enumerate(parts)
        if part and (part.startswith("|") or k == 0 or (k + 1 < len(parts) and parts[k + 1]))
    ]
    return "\n\n".join(shown), not (gains or late or unsafe or unstable) and (
        of_these <= MOST_REFUSED
    )


def _filled(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    return table(headings, rows) if rows else ""


def _served(result: Result) -> bool:
    return result.outcome == "completed" and result.gains


def _short(reason: str) -> str:
    words = "".join("#" if c.isdigit() else c for c in reason).replace("|", "/")
    while "##" in words or "#.#" in words:
        words = words.replace("#.#", "#").replace("##", "#")
    return words[:110]


def _ratio(result: Result) -> str:
    k = max(j for j, low in enumerate(_RATIOS[:-1]) if result.ratio >= low or j == 0)
    return f"{_RATIOS[k]:g} to {_RATIOS[k + 1]:g}"


def _happenings(results: Sequence[Result]) -> str:
    rows = []
    for name in dict.fromkeys(HAPPENINGS):
        some = [r for r in results if r.happening == name]
        if not some:
            continue
        done = [r for r in some if r.outcome == "completed"]
        rows.append(
            (
                *(name, len(some), len(done)),
                sum(r.outcome in ("aborted", "failed") for r in some),
                sum(r.outcome == "unknown" for r in some),
                sum(not r.gains for r in done),
                sum(r.gains for r in some if r.outcome != "completed"),
                *(sum(r.late for r in some), sum(r.unsafe for r in some)),
                sum(not r.stable for r in some),
            )
        )
    headings = (
        *("what happens", "experiments", "completed", "aborted or failed", "goes on"),
        "completed, no gains",
        *("gains without completion", "safe command late", "unsafe after", "unstable loops"),
    )
    return _filled(headings, rows)


def _delays(results: Sequence[Result]) -> str:
    rows = []
    for name in FAULTS:
        some = [r for r in results if r.happening == name and r.delay >= 0]
        # An end before the happening had another cause.
        if some and name not in ("measurement limit", "deviation", "wrong sign"):
            cycles = [r.delay / r.per_cycle for r in some]
            values = [r.delay for r in some]
            rows.append(
                (
                    *(name, len(some), f"{np.median(values):.0f}", max(values)),
                    f"{max(cycles):.2f}",
                )
            )
    return _filled(("fault", "experiments", "median", "longest", "longest [cycles]"), rows)


def _percentiles(values: Sequence[float], scale: float, digits: int, *at: float) -> str:
    known = np.array([v for v in values if np.isfinite(v)])
    if known.size == 0:
        return "-"
    return " / ".join(f"{scale * p:.{digits}f}" for p in np.percentile(known, at))


def _held(errors: Sequence[float], stds: Sequence[float]) -> str:
    pairs = [
        (e, s) for e, s in zip(errors, stds, strict=True) if np.isfinite(e) and np.isfinite(s)
    ]
    if not pairs:
        return "-"
    return f"{100.0 * np.mean([abs(e) <= NORMAL_95 * s for e, s in pairs]):.0f}"


def _figures(heading: str, results: Sequence[Result], key: Callable[[Result], str]) -> str:
    rows = []
    groups = sorted({key(r) for r in results})
    for name in (*groups, "all") if len(groups) > 1 else groups:
        some = [r for r in results if name in ("all", key(r))]
        errors = [abs(r.gain_error) for r in some]
        rows.append(
            (
                *(name, len(some)),
                f"{100.0 * sum(not _served(r) for r in some) / len(some):.1f}",
                sum(not r.stable for r in some),
                _percentiles(errors, 100.0, 2, 50, 95),
                _held([r.gain_error for r in some], [r.gain_std for r in some]),
                _held([r.frequency_error for r in some], [r.frequency_std for r in some]),
                _percentiles([r.ms / r.asked for r in some], 1.0, 2, 5, 50, 95, 100),
                sum(r.asked > 1.401 for r in some),
            )
        )
    headings = (
        *(heading, "experiments", "without gains [%]", "unstable loops"),
        *("error of K_u, median / 95 % [%]", "95 % intervals that hold K_u [%]", "w_u [%]"),
        *("true Ms over asked, 5 / 50 / 95 / 100 %", "Ms relaxed"),
    )
    return _filled(headings, rows)
