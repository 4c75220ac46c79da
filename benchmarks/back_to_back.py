# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Tunes one after the other for twenty minutes, and what the processes hold after each.

Usage, after `. ./env.sh`:

    python3 benchmarks/back_to_back.py [--seconds 1200] [--rate 500] [--file FILE] [--quick]

The installed plant_node (in lockstep, slowed down to a rate of samples), relay_node and
identifier_node form a loop over real DDS, and each tune begins when the gains of the one before
are known. After each of them the resident memory, open descriptors, threads and shared memory of
each process are noted, in a line of the file if one is given. The slope of each per tune is that
of a line through what comes after the first fifth of the tunes, when buffers of a fixed size are
full. The exit status is 1 if something grows. With --quick a few tunes are run, which says
nothing of growth, and the status is 0.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from endurance import resident
from markdown import table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from loop_rig import Process, Rig
from ros_domain import free_domain, mapped_segments

from relay_autotune_msgs.msg import PidGains

SECONDS = 1200.0
QUICK = 4
PERIOD = 0.2
WARM = 0.2
# What a process may grow by and still be flat, per tune and where that is no more than noise:
# a day of tunes, one each minute, is 1,440 of them.
MOST_MEMORY = 2000.0
KILO = 1e3
# A busy machine takes long for a fit [s].
PATIENCE = 600.0
PLANT = {
    "mode": "lockstep",
    "sample_period": PERIOD,
    "structure": "fopdt",
    "gain": 1.65,
    "time_constants": [20.0],
    "dead_time": 10.0,
    "noise_std": 0.01,
    "seed": 7,
}
# A busy machine stalls the loop for longer than a second, which would end a tune.
TUNE = {
    "amplitude": 1.0,
    "baseline": 0.0,
    "sample_period": PERIOD,
    "measurement_timeout": 60.0,
    "model_timeout": 60.0,
}


@dataclass(frozen=True)
class Held:
    """What a process holds after a tune.

    :param process: its name.
    :param tune: number of the tune.
    :param memory: resident [bytes].
    :param descriptors: open files and sockets.
    :param threads: of it.
    :param shared: entries of /dev/shm that it maps.
    """

    process: str
    tune: int
    memory: int
    descriptors: int
    threads: int
    shared: int


def held(process: Process, tune: int) -> Held:
    """Return what a process holds now."""
    folder = Path(f"/proc/{process.pid}")
    return Held(
        process.name,
        tune,
        resident(process.pid),
        len(list((folder / "fd").iterdir())),
        len(list((folder / "task").iterdir())),
        len(mapped_segments(process.pid)),
    )


@contextmanager
def loop(rate: float) -> Iterator[Rig]:
    """Start the three processes."""
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain:
        rig = Rig(domain, Path(folder))
        try:
            rig.plant(**PLANT, lockstep_speed=rate * PERIOD)
            rig.relay("--log-level", "warn", **TUNE)
            rig.identifier()
            yield rig
        finally:
            rig.close()


def run(rig: Rig, seconds: float, most: float, file: Path | None) -> list[Held]:
    """Tune until the time or the number of tunes is over."""
    gains = rig.listen("pi_gains", PidGains)
    seen: list[Held] = []
    end = time.monotonic() + seconds
    tune = 0
    while time.monotonic() < end and tune < most:
        tune += 1
        answer = rig.tune()
        rig.until(
            lambda answer=answer: any(g.experiment_id == answer.experiment_id for g in gains),
            f"gains of tune {tune}",
            PATIENCE,
        )
        gains.clear()
        # What is on the disk is no memory of theirs.
        shutil.rmtree(rig.bag(answer), ignore_errors=True)
        now = [held(process, tune) for process in rig.processes]
        seen += now
        if file is not None:
            with file.open("a") as output:
                output.writelines(json.dumps(asdict(h)) + "\n" for h in now)
    return seen


def report(seen: list[Held], seconds: float) -> tuple[str, bool]:
    """Return the table, and whether nothing grows."""
    tunes = max(h.tune for h in seen)
    warm = int(WARM * tunes)
    rows: list[tuple[object, ...]] = []
    flat = True
    for name in dict.fromkeys(h.process for h in seen):
        those = [h for h in seen if h.process == name]
        tune = np.array([h.tune for h in those], dtype=float)
        for what, unit, most in (
            ("memory", "kB", MOST_MEMORY),
            ("descriptors", "", 0.0),
            ("threads", "", 0.0),
            ("shared", "", 0.0),
        ):
            held = np.array([getattr(h, what) for h in those], dtype=float)
            later = tune > warm
            slope = _slope(tune[later], held[later])
            # Counts are whole: one that has grown is larger at the end than it ever was before.
            third = len(held[later]) // 3
            grows = (
                slope > most
                if what == "memory"
                else third > 0 and held[-third:].min() > held[later][:third].max()
            )
            flat &= not grows
            scale = KILO if unit else 1.0
            first, last, largest = (v / scale for v in (held[0], held[-1], held.max()))
            rows.append(
                (
                    name,
                    f"{what} [{unit}]" if unit else _NAMES[what],
                    *(f"{v:.0f}" for v in (first, held[later][0] / scale, last, largest)),
                    f"{round(slope / scale, 2) + 0.0:.2f}",
                    "grows" if grows else "flat",
                )
            )
    headings = (
        *("process", "what", "after the first tune", "warm", "at the end", "most"),
        *("slope per tune", ""),
    )
    return (
        f"{tunes} tunes in {seconds:.0f} s; warm: after {warm} of them.\n\n"
        f"{table(headings, rows)}\n\n"
        f"{'Nothing grows' if flat else 'SOMETHING GROWS'}; target: no count larger at the end, "
        f"memory by less than {MOST_MEMORY / KILO:g} kB per tune.",
        flat,
    )


_NAMES = {"descriptors": "descriptors", "threads": "threads", "shared": "entries of /dev/shm"}


def _slope(tune: np.ndarray, held: np.ndarray) -> float:
    return float(np.polyfit(tune, held, 1)[0]) if tune.size > 1 else 0.0


def main() -> int:
    """Run the tunes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=SECONDS, help="how long [s]")
    parser.add_argument("--rate", type=float, default=500.0, help="samples a second")
    parser.add_argument("--file", type=Path, help="what was seen, a line for each process")
    parser.add_argument("--quick", action="store_true", help="a few tunes, only to see it run")
    options = parser.parse_args()
    begin = time.monotonic()
    rate, most = (2000.0, QUICK) if options.quick else (options.rate, np.inf)
    with loop(rate) as rig:
        begin = time.monotonic()
        seen = run(rig, options.seconds, most, options.file)
        seconds = time.monotonic() - begin
    text, flat = report(seen, seconds)
    print(text)
    return 0 if flat or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
