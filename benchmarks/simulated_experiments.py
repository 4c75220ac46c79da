# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Experiments on random processes with noise, disturbances and faults, without DDS.

    python3 benchmarks/simulated_experiments.py [--seeds A:B] [--file FILE] [--summary] [--quick]

Each draws a process of a known structure, a sample period, a noise, and what happens: nothing, a
disturbance (load, drift, coarse sensor, sticking valve, lost samples), or a fault (NaN, silence, a
frozen sensor, a limit, a clock that goes backwards, a wrong sign, an actuator that is stuck, an
abort). Gains are those of the default method and rule. With --file each outcome is written to a
line of that file, and an interrupted run is continued; --summary only shows what the file
holds. A file holds outcomes of one state of the code. The exit status is 1 if a target is
missed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import time as wall
from dataclasses import asdict, fields
from pathlib import Path
from typing import TextIO

from random_experiments import Experiment, with_delay
from simulated_summary import Result, summary

import relay_autotune
from relay_autotune.analysis import analyse
from relay_autotune.identification.known import Known
from relay_autotune.loop.analysis import is_stable
from relay_autotune.loop.gains import Gains
from relay_autotune.loop.stability import peaks
from relay_autotune.process.frequencies import frequencies
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Outcome
from relay_autotune.result import Analysis
from relay_autotune.tuning.task import DesignOptions

EXPERIMENTS = 10_000
QUICK = 4


def state_of_code() -> str:
    """Return a digest of the code that is run."""
    digest = hashlib.sha256()
    package = Path(relay_autotune.__file__).parent
    core = [p for p in package.rglob("*.py") if not {"nodes", "cli", "bag", "report"} & {*p.parts}]
    for path in (*sorted(core), *sorted(Path(__file__).parent.glob("*_experiments.py"))):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def run(seed: int, state: str) -> Result:
    """Run one experiment and judge it."""
    began = wall.process_time()
    experiment = Experiment(seed)
    experiment.run()
    tune = experiment.tune
    result = Result(
        seed=seed,
        state=state,
        happening=experiment.happening,
        structure=experiment.model.structure,
        ratio=experiment.expected.ratio,
        per_cycle=experiment.per_cycle,
        finds_amplitude=experiment.finds_amplitude,
        outcome=tune.outcome.name.lower(),
        cycles=tune.cycle_count,
        late=experiment.late,
        unsafe=experiment.unsafe,
        reason="" if tune.outcome is Outcome.COMPLETED else tune.reason,
    )
    if experiment.caused_at >= 0:
        result.delay = experiment.ended_at - experiment.caused_at
    if tune.outcome is Outcome.COMPLETED:
        judge(result, experiment, analyse(tune.record(), alone=True))
    elif tune.finished and tune.sample_count:
        # What identifier_node would publish; one structure is enough to see that there is none.
        known = Known(structure="fopdt")
        result.gains = analyse(tune.record(), known=known, alone=True).best_gains is not None
    result.seconds = wall.process_time() - began
    return result


def judge(result: Result, experiment: Experiment, found: Analysis) -> None:
    """Compare what was found with the true process."""
    model = experiment.model
    if found.model is not None:
        truth, it = ultimate_point(model), found.model
        result.found = it.structure
        if truth is not None and math.isfinite(it.ultimate_gain):
            result.gain_error = it.ultimate_gain / truth.gain - 1.0
            result.gain_std = abs(it.ultimate_gain_std / it.ultimate_gain)
            result.frequency_error = it.ultimate_frequency / truth.frequency - 1.0
            result.frequency_std = it.ultimate_frequency_std / it.ultimate_frequency
    gains = found.best_gains
    result.gains = gains is not None
    result.reason = found.reason
    if gains is None:
        return
    sampled = with_delay(model, found.added_delay)
    result.stable = is_stable(gains, model) and is_stable(gains, sampled)
    result.asked = promised_ms(gains)
    if result.stable:
        grid = frequencies(*gains.characteristic(sampled))
        (peak, _), _ = peaks(lambda s: gains(s) * sampled(s), grid)
        result.ms = max(peak, 1.0)


def promised_ms(gains: Gains) -> float:
    """Return the bound on Ms for which gains were designed, 1.4 unless no controller keeps it."""
    words = gains.reason.replace(",", "").split()
    bounds = [words[k + 2] for k in range(len(words) - 2) if words[k : k + 2] == ["Ms", "<="]]
    return float(bounds[0]) if bounds else DesignOptions().ms


def read(file: Path) -> list[Result]:
    """Return the outcomes that a file holds."""
    names = {field.name for field in fields(Result)}
    found = []
    for line in file.read_text().splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            # The run was broken off as it wrote this line.
            continue
        found.append(Result(**{name: row[name] for name in names}))
    return found


def main() -> int:
    """Run the experiments and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--seeds", default=f"0:{EXPERIMENTS}", metavar="A:B", help="B not included"
    )
    parser.add_argument("--file", type=Path, help="outcomes, a line each; gone on with")
    parser.add_argument("--summary", action="store_true", help="only show what the file holds")
    parser.add_argument("--quick", action="store_true", help="a few experiments, never fails")
    asked = parser.parse_args()
    first, last = (0, QUICK) if asked.quick else map(int, asked.seeds.split(":"))
    done = read(asked.file) if asked.file and asked.file.exists() else []
    if not asked.summary:
        state = state_of_code()
        others = {r.state for r in done} - {state}
        if others:
            print(
                f"simulated_experiments: {asked.file} holds outcomes of another state of the "
                f"code, {', '.join(sorted(others))}; this is {state}: begin another file",
                file=sys.stderr,
            )
            return 2
        known = {r.seed for r in done}
        output: TextIO | None = asked.file.open("a") if asked.file else None
        for seed in range(first, last):
            if seed in known:
                continue
            result = run(seed, state)
            done.append(result)
            if output is not None:
                output.write(json.dumps(asdict(result)) + "\n")
                output.flush()
    text, met = summary(done)
    print(text)
    return 0 if met or asked.quick else 1


if __name__ == "__main__":
    sys.exit(main())
