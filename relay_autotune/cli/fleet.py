# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Many bags: on the processors of this machine or a Dask cluster, each of them once.

Results go into a file as they come; a run that was cut short goes on from it.
"""

from __future__ import annotations

import csv
import fcntl
import json
import logging
import multiprocessing
import os
import signal
import threading
import uuid
from asyncio import CancelledError as TaskCancelledError
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Self

from relay_autotune.cli.arguments import DONE, exit_status, worst
from relay_autotune.cli.jobs import Done, Job, died, work
from relay_autotune.errors import BagError, SelectionError, os_errors_as
from relay_autotune.exchange.fields import columns
from relay_autotune.exchange.models import COLUMNS as OF_PROCESS
from relay_autotune.identification.result import FitReport, Identification
from relay_autotune.loop.gains import Gains
from relay_autotune.quantities import result_fields
from relay_autotune.text import cell

ENDINGS = (".jsonl", ".csv", ".parquet")

_OF_EXPERIMENT = (
    *("start", "duration", "outcome", "reason", "experiment_id", "verdict", "verdict_reason"),
)
# Columns of the selected model and its fit, and of the gains.
_METHOD, *_ACCURACY = columns(Identification)
_OF_MODEL = (_METHOD, *OF_PROCESS, *_ACCURACY)
_OF_FIT = columns(FitReport)
_OF_GAINS = columns(Gains)
COLUMNS = (*("bag", "experiment", "error"), *(*_OF_EXPERIMENT, *_OF_MODEL, *_OF_FIT, *_OF_GAINS))
_TEXTS = {
    *("bag", "error", "outcome", "reason", "experiment_id", "verdict", "verdict_reason"),
    *("structure", "zeros", "time_constants"),
    *(f.name for kind in (Identification, Gains) for f in result_fields(kind) if f.kind is str),
}


class ResultsFile:
    """A file of results, one document a line; a table is made of it at the end.

    :param output: the file: ``.jsonl`` holds the documents; ``.csv`` and ``.parquet`` a table
        with a row for each experiment, and the documents are in the same name with ``.jsonl``
        added.
    :raises SelectionError: if the ending is another one.
    :raises BagError: if the file cannot be written, is in use, or may hold something else.
    """

    def __init__(self, output: str) -> None:
        self._table = Path(output)
        kind = self._table.suffix.lower()
        if kind not in ENDINGS:
            raise SelectionError(
                f"--output {output!r} does not say what to write; expected an ending "
                f"{', '.join(ENDINGS)}"
            )
        if kind == ".parquet":
            _pyarrow()
        self.path = self._table if kind == ".jsonl" else Path(f"{output}.jsonl")
        if self._table.exists() and not self.path.exists():
            raise BagError(
                f"{self._table} exists, and there is no {self.path} that it was made of; name "
                "another file, or remove it"
            )
        if self.path.exists() and not self.path.is_file():
            raise BagError(f"{self.path} is no regular file; name another one")
        self.done: set[str] = set()
        self.status = DONE
        with os_errors_as(BagError, f"cannot write {self.path}"):
            self._file = self.path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._take_up()
        except BlockingIOError:
            self._file.close()
            raise BagError(f"{self.path} is being written by another process") from None
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self._table != self.path:
                self._write_table()
        finally:
            self._file.close()

    def add(self, name: str, document: str) -> None:
        """Add the document of a bag, in one piece; it outlives this process.

        :param name: of the bag.
        :param document: on one line.
        :raises BagError: if the file system refuses.
        """
        with os_errors_as(BagError, f"cannot write {self.path}"):
            self._file.write(document.encode() + b"\n")
            self._file.flush()
        self.done.add(name)

    def _take_up(self) -> None:
        """Find what is done; a last line that was cut is taken away."""
        self._file.seek(0)
        end = 0
        for line in self._file:
            if not line.endswith(b"\n"):
                os.ftruncate(self._file.fileno(), end)
                break
            document = self._document(line)
            self.done.add(document["bag"])
            self.status = worst(self.status, _status(document))
            end += len(line)

    def _document(self, line: bytes) -> dict[str, Any]:
        try:
            document = json.loads(line)
        except ValueError:
            document = None
        if isinstance(document, dict) and isinstance(document.get("bag"), str):
            return document
        raise BagError(
            f"{self.path} exists and holds something else than results of replay; "
            f"name another file, or remove it"
        )

    def _rows(self) -> Iterator[dict[str, Any]]:
        self._file.seek(0)
        for line in self._file:
            yield from rows(self._document(line))

    def _write_table(self) -> None:
        new = self._table.with_name(self._table.name + ".tmp")
        with os_errors_as(BagError, f"cannot write {self._table}"):
            if self._table.suffix.lower() == ".csv":
                with new.open("w", newline="", encoding="utf-8") as file:
                    writer = csv.DictWriter(file, COLUMNS)
                    writer.writeheader()
                    writer.writerows(
                        {n: cell(v) if isinstance(v, str) else v for n, v in row.items()}
                        for row in self._rows()
                    )
            else:
                pyarrow = _pyarrow()
                text, number = pyarrow.string(), pyarrow.float64()
                schema = pyarrow.schema(
                    (name, text if name in _TEXTS else number) for name in COLUMNS
                )
                table = pyarrow.Table.from_pylist(list(self._rows()), schema=schema)
                pyarrow.parquet.write_table(table, new)
            new.replace(self._table)


def rows(document: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a row for each experiment of a bag; for none, a row with the error alone.

    :param document: as `replay --json` prints it.
    """
    base = dict.fromkeys(COLUMNS) | {"bag": document["bag"], "error": document.get("error")}
    experiments = document.get("experiments", [])
    if not experiments:
        yield base
    for number, experiment in enumerate(experiments, start=1):
        row = base | {"experiment": number} | {n: experiment.get(n) for n in _OF_EXPERIMENT}
        if experiment["selected"] is not None:
            model = experiment["models"][experiment["selected"]]
            cells = ((name, model[name]) for name in _OF_MODEL)
            row |= {n: json.dumps(v) if isinstance(v, list) else v for n, v in cells}
            row |= {name: model["fit"][name] for name in _OF_FIT}
        if experiment["recommended"] is not None:
            gains = experiment["gains"][experiment["recommended"]]
            row |= {name: gains[name] for name in _OF_GAINS}
        yield row


def _status(document: dict[str, Any]) -> int:
    """Return the exit status that a bag deserves, as when it was done."""
    found = document.get("experiments", [])
    return exit_status(
        found=any(e.get("recommended") is not None for e in found),
        doubtful=any(e.get("verdict") == "doubtful" for e in found),
    )


def _pyarrow() -> Any:
    try:
        import pyarrow  # type: ignore[import-untyped]
        import pyarrow.parquet  # type: ignore[import-untyped]
    except ImportError:
        raise BagError(
            "a .parquet file needs the Python package pyarrow; install it with: "
            "pip install pyarrow, or choose .csv"
        ) from None
    return pyarrow


_CONNECT_S = 10.0
_PRELOADED = [
    f"relay_autotune.{name}"
    for name in ("threads", "analysis", "recordings", "cli.jobs", "exchange.models")
]

Work = Callable[[Job], Done]


def in_processes(jobs: Sequence[Job], count: int, do: Work = work) -> Iterator[tuple[int, Done]]:
    """Do jobs in processes of this machine; yield the number of each and its result.

    A job that crashes its process is tried once more, alone after all others, and then reported.

    :param jobs: what to do.
    :param count: number of processes.
    :param do: does one job.
    """
    waiting = deque(range(len(jobs)))
    again: set[int] = set()
    # Each process has a pipe of its own: it can be ended anywhere without a lock that stays closed
    # for the others, as in a pool.
    idle: list[Any] = []
    busy: dict[Any, int] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < (1 if waiting[0] in again else count):
                pipe = idle.pop() if idle else _worker(do)
                busy[pipe] = number = waiting.popleft()
                # If its process has just been ended, this is found below.
                with suppress(OSError):
                    pipe.send(jobs[number])
            over: list[Any] = wait(list(busy))
            for pipe in over:
                number = busy.pop(pipe)
                try:
                    done = pipe.recv()
                    idle.append(pipe)
                except (EOFError, OSError):
                    pipe.close()
                    if number not in again:
                        again.add(number)
                        waiting.append(number)
                        continue
                    reason = "its process was ended from outside, perhaps for want of memory"
                    done = died(jobs[number], reason)
                yield number, done
    finally:
        for pipe in (*idle, *busy):
            pipe.close()


def _worker(do: Work) -> Any:
    """Start a process that does jobs until its pipe is closed, and return this end of the pipe."""
    # A fork of a process with threads, which numpy may start, can hang.
    context = multiprocessing.get_context("forkserver")
    # The modules that every job needs are loaded once, in the process that is forked.
    context.set_forkserver_preload(_PRELOADED)
    # Ctrl-C reaches it, too, and while it loads them it would answer with a traceback. What it
    # starts itself lets the signal through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    ours, theirs = context.Pipe()
    with theirs:
        context.Process(target=_do_jobs, args=(theirs, do), daemon=True).start()
    return ours


def _do_jobs(pipe: Any, do: Work) -> None:
    """Do what comes; end at once by Ctrl-C, and when the command ends, whatever ended that.

    :param pipe: to the command.
    :param do: does one job.
    """
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    command = multiprocessing.parent_process()
    assert command is not None, "this is a worker"

    def watch() -> None:
        command.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            pipe.send(do(pipe.recv()))


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
