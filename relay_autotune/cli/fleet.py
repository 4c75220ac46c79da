# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Many bags, on the processors of this machine or on a Dask cluster; each is done once."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
import uuid
from asyncio import CancelledError as TaskCancelledError
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from relay_autotune.cli.replay_bag import Done, Job, died, work
from relay_autotune.errors import BagError

_CONNECT_S = 10.0
_PRELOADED = [
    f"relay_autotune.{name}"
    for name in ("threads", "analysis", "bag.reader", "cli.replay_bag", "exchange.document")
]

Work = Callable[[Job], Done]


def in_processes(jobs: Sequence[Job], count: int, do: Work = work) -> Iterator[tuple[int, Done]]:
    """Do jobs in processes of this machine; yield the number of each and its result.

    A job that crashes its process is tried once more in a separate process, and then reported.

    :param jobs: what to do.
    :param count: number of processes.
    :param do: does one job.
    """
    waiting = dict(enumerate(jobs))
    while waiting:
        alone: list[int] = []
        with _pool(min(count, len(waiting))) as pool:
            futures = {pool.submit(do, job): number for number, job in waiting.items()}
            for future in as_completed(futures):
                try:
                    done = future.result()
                except BrokenProcessPool:
                    # One of the started jobs is the cause; jobs start in the order of numbers.
                    alone = sorted(waiting)[: 2 * count]
                    break
                number = futures[future]
                del waiting[number]
                yield number, done
        for number in alone:
            yield number, _alone(waiting.pop(number), do)


def _alone(job: Job, do: Work) -> Done:
    with _pool(1) as pool:
        try:
            return pool.submit(do, job).result()
        except BrokenProcessPool:
            return died(job, "its process was ended from outside, perhaps for want of memory")


def _pool(count: int) -> ProcessPoolExecutor:
    # A fork of a process with threads, which numpy may start, can hang.
    context = multiprocessing.get_context("forkserver")
    # The modules that every job needs are loaded once, in the process that is forked.
    context.set_forkserver_preload(_PRELOADED)
    return ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_the_command)


def _end_with_the_command() -> None:
    """Let this process end when the command ends, whichever signal ended that.

    Without it a worker would go on, or wait for work forever.
    """
    command = multiprocessing.parent_process()
    assert command is not None, "this is a worker"

    def watch() -> None:
        command.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def on_cluster(jobs: Sequence[Job], address: str, do: Work = work) -> Iterator[tuple[int, Done]]:
    """Do jobs on a Dask cluster; yield the number of each and its result.

    If a worker dies, other workers repeat its jobs; each result comes once.

    :param jobs: what to do; the workers must see the recordings under the same paths.
    :param address: of the scheduler, such as ``tcp://host:8786``.
    :param do: does one job.
    :raises BagError: if dask.distributed is not installed, the scheduler cannot be reached, or it
        ends before all jobs are done; the rest then has no result.
    """
    try:
        import distributed
    except ImportError:
        raise BagError(
            "--scheduler needs the Python package distributed; "
            "install it with: pip install distributed"
        ) from None
    for name in ("client", "core", "utils"):
        # Their tracebacks are not shown; an error is raised here as one sentence.
        logging.getLogger(f"distributed.{name}").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise BagError(f"cannot reach the scheduler {address}: {error}") from None
    with client:
        run = uuid.uuid4().hex
        futures = {
            client.submit(do, job, key=f"replay-{run}-{number}", pure=False): number
            for number, job in enumerate(jobs)
        }
        left = set(futures.values())
        for future in distributed.as_completed(futures):
            number = futures[future]
            try:
                # The result of a finished future may be lost on the way.
                yield number, _result(future, jobs[number])
            except (CancelledError, TaskCancelledError, OSError) as error:
                raise BagError(
                    f"the scheduler {address} is gone: {len(left)} of {len(jobs)} bags are not "
                    f"done; start it again and repeat the command, which goes on where this one "
                    f"ended if it has --output"
                ) from error
            left.discard(number)
            # Do not keep the result on the cluster until all are done.
            future.release()


def _result(future: Any, job: Job) -> Done:
    if future.status == "error":
        return died(job, f"failed on the cluster: {future.exception()}")
    done: Done = future.result()
    return done
