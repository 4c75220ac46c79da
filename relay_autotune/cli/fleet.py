"""Many bags: on the processors of this machine, or on a Dask cluster; each done exactly once."""

from __future__ import annotations

import multiprocessing
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from relay_autotune.cli.replay_bag import Done, Job, died, work
from relay_autotune.errors import BagError

_CONNECT_S = 10.0
_PRELOADED = [
    f"relay_autotune.{name}"
    for name in ("threads", "autotune", "bag.reader", "cli.replay_bag", "document")
]

Work = Callable[[Job], Done]


def in_processes(jobs: Sequence[Job], count: int, do: Work = work) -> Iterator[tuple[int, Done]]:
    """Do jobs in processes of this machine; yield the number of each, and what became of it.

    A job that takes its process down is tried once more in a process of its own, and reported.

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
                    # One of those that had begun; they begin in the order of their numbers.
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
    # A fork of a process that has threads, as numpy's may, can stand still for ever.
    context = multiprocessing.get_context("forkserver")
    # What every job needs is loaded once, in the process that they are forked from.
    context.set_forkserver_preload(_PRELOADED)
    return ProcessPoolExecutor(count, mp_context=context)


def on_cluster(jobs: Sequence[Job], address: str, do: Work = work) -> Iterator[tuple[int, Done]]:
    """Do jobs on a Dask cluster; yield the number of each, and what became of it.

    What a worker that dies had begun, others do again; each result comes once.

    :param jobs: what to do; the workers must see the recordings under the same paths.
    :param address: of the scheduler, such as ``tcp://host:8786``.
    :param do: does one job.
    :raises BagError: if there is no dask.distributed, or no scheduler.
    """
    try:
        import distributed
    except ImportError:
        raise BagError(
            "--scheduler needs the Python package distributed; "
            "install it with: pip install distributed"
        ) from None
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
        for future in distributed.as_completed(futures):
            number = futures[future]
            if future.status == "finished":
                yield number, future.result()
            else:
                yield number, died(jobs[number], f"failed on the cluster: {future.exception()}")
            # Its result is not kept on the cluster until all are done.
            future.release()
