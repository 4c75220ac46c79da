# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Random histories of a relay experiment: whether each one ends, and how long it takes.

    python3 benchmarks/random_histories.py [--seeds A:B] [--file FILE] [--summary] [--quick]

A history is a process, parameters and one to four happenings: an actuator that sticks or is weak,
a gap in the samples, a load, a step of the clock, samples that are repeated, lost or swapped, a
silent sensor, a spike; at any moment, for any time, see test/support/histories.py. Each has to end
with a reason and the safe command within the bound of docs/safety.md. With --file each outcome is
written to a line of that file, and an interrupted run is continued. The exit status is 1 if a
history does not end in this way.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TextIO

from relay_autotune import threads  # noqa: F401  before numpy

# isort: split
import numpy as np
from markdown import table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from histories import HAPPENINGS, History

HISTORIES = 10_000
QUICK = 20


@dataclass(frozen=True)
class Result:
    """The result of one history.

    :param seed: of the history.
    :param happenings: what happened in it.
    :param outcome: of the experiment.
    :param begin: the first words of its reason.
    :param periods: how long it went on after its settling [periods of the process].
    :param share: the same as a share of the bound.
    :param problem: what was wrong; empty: nothing.
    """

    seed: int
    happenings: tuple[str, ...]
    outcome: str
    begin: str
    periods: float
    share: float
    problem: str


def run(seed: int) -> Result:
    """Run one history."""
    history = History(seed)
    tune = history.run()
    return Result(
        seed,
        tuple(sorted({h.kind for h in history.happenings})),
        tune.outcome.name.lower(),
        tune.reason.split(":")[0][:60],
        history.samples / history.limit.period,
        history.samples / history.bound,
        history.problem and f"{history.problem}: {history}",
    )


def summary(done: list[Result]) -> str:
    """Return the table of results."""
    rows = []
    for kind in ("any", *sorted(set(HAPPENINGS))):
        those = [r for r in done if kind in ("any", *r.happenings)]
        if not those:
            continue
        ends = Counter(r.outcome for r in those)
        periods = np.array([r.periods for r in those])
        rows.append(
            (
                kind,
                f"{len(those)}",
                f"{len(those) - sum(bool(r.problem) for r in those)}",
                f"{ends['completed']}",
                f"{ends['failed']}",
                f"{np.median(periods):.1f}",
                f"{np.percentile(periods, 99):.0f}",
                f"{periods.max():.0f}",
                f"{max(r.share for r in those):.2f}",
            )
        )
    return table(
        (
            *("happening", "histories", "ended within the bound", "completed", "failed"),
            *("periods, median", "99 %", "longest", "longest over its bound"),
        ),
        rows,
    )


def main() -> int:
    """Run the histories and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default=f"0:{HISTORIES}", metavar="A:B", help="B not included")
    parser.add_argument("--file", type=Path, help="outcomes, a line each; gone on with")
    parser.add_argument("--summary", action="store_true", help="only show what the file holds")
    parser.add_argument("--quick", action="store_true", help="a few histories")
    asked = parser.parse_args()
    first, last = (0, QUICK) if asked.quick else map(int, asked.seeds.split(":"))
    done: list[Result] = []
    if asked.file and asked.file.exists():
        lines = asked.file.read_text().splitlines()
        done = [Result(**json.loads(line)) for line in lines]
    known = {r.seed for r in done}
    output: TextIO | None = asked.file.open("a") if asked.file else None
    for seed in range(first, first if asked.summary else last):
        if seed in known:
            continue
        done.append(run(seed))
        if output is not None:
            output.write(json.dumps(asdict(done[-1])) + "\n")
            output.flush()
    print(summary(done))
    problems = [r.problem for r in done if r.problem]
    print(f"\n{len(done)} histories, {len(problems)} of which did not end as they must.")
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
