# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Jobs for worker processes, in a module that they can import."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from relay_autotune.cli.jobs import Done, Job


def mark(job: Job) -> Done:
    """Leave a mark at each run of a job."""
    with (Path(job.paths[0]) / job.name).open("a") as file:
        file.write("x")
    return Done(job.name, 0, (), "{}")


def die(job: Job) -> Done:
    os.kill(os.getpid(), signal.SIGKILL)
    return mark(job)


def die_of_bag_3(job: Job) -> Done:
    return die(job) if job.name == "bag3" else mark(job)


def die_once(job: Job, number: int) -> Done:
    """Kill the worker in the middle of a job, at its first run."""
    flag = Path(job.paths[0]) / "died"
    if job.name == f"bag{number}" and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.02)
    return mark(job)


def wait_for_ever(job: Job) -> Done:
    """Do the first job, report the process of the next one, and never return."""
    if job.name == "bag0":
        return mark(job)
    (Path(job.paths[0]) / f"{job.name}.pid").write_text(str(os.getpid()))
    while True:
        time.sleep(0.05)
