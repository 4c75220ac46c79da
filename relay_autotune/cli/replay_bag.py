# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What `replay` makes of one bag: the same in this process, in another one and on another host."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from relay_autotune.analysis import Task, analyse, analyse_jointly
from relay_autotune.bag.reader import read_experiments
from relay_autotune.bag.signals import Selection
from relay_autotune.cli.arguments import DEBUG, NOTHING_FOUND, USAGE, deserved
from relay_autotune.cli.export import Target, exported
from relay_autotune.cli.table import table
from relay_autotune.errors import RelayAutotuneError, SelectionError, defect
from relay_autotune.record.record import Record
from relay_autotune.result import Analysis
from relay_autotune.text import visible
from relay_autotune.verdict import Verdict

Progress = Callable[[int, int], None]
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Job:
    """One bag to replay, or several that are one.

    :param name: how results call it.
    :param paths: the recordings; several are one timeline, or tests of one process.
    :param selection: what of them is wanted.
    :param task: how to identify, and what is asked of the controller.
    :param jointly: whether the experiments of all recordings give one model.
    :param table_width: columns of the table for people; None: the document is wanted instead.
    :param export: the kind of file that is wanted instead, and where its gains go; None: none.
    :param accept_doubtful: True: the file may hold gains whose verdict is doubtful.
    """

    name: str
    paths: tuple[str, ...]
    selection: Selection
    task: Task
    jointly: bool = False
    table_width: int | None = None
    export: tuple[str, Target] | None = None
    accept_doubtful: bool = False


@dataclass(frozen=True)
class Done:
    """What became of a job.

    :param name: that of the job.
    :param status: the exit status that it deserves.
    :param said: sentences for standard error.
    :param text: the table, or the document on one line; empty: there is none.
    """

    name: str
    status: int
    said: tuple[str, ...]
    text: str


def work(job: Job) -> Done:
    """Read, identify and tune; an error becomes part of the result.

    :param job: what to do.
    """
    return replay(job)[0]


def replay(
    job: Job, progress: Progress | None = None, tell: Tell = lambda _: None
) -> tuple[Done, tuple[Analysis, ...]]:
    """Read, identify and tune; return also the analyses themselves.

    :param job: what to do.
    :param progress: told of how far a bag has been read.
    :param tell: told of what the computation is at.
    """
    said: list[str] = []
    try:
        analyses = analysed(job, said, progress, tell)
        if job.export is not None:
            text = _exported(analyses, *job.export, accept_doubtful=job.accept_doubtful)
            return Done(job.name, status_of(analyses), tuple(said), text), analyses
    except SelectionError as error:
        return _failed(job, said, str(error), USAGE), ()
    except RelayAutotuneError as error:
        return _failed(job, said, str(error), NOTHING_FOUND), ()
    except Exception as error:
        if os.environ.get(DEBUG):
            raise
        why = f"{job.name} could not be analysed: {defect(error)}"
        return _failed(job, said, why, NOTHING_FOUND), ()
    status = status_of(analyses)
    if status == NOTHING_FOUND:
        # A model that a check contradicts is shown, with the reason why there are no gains.
        said += [
            f"{job.name}: {'' if a.models else 'nothing identified: '}{a.reason}" for a in analyses
        ]
    return Done(job.name, status, tuple(said), _text(job, analyses)), analyses


def status_of(analyses: Sequence[Analysis]) -> int:
    """Return the exit status that a bag deserves.

    :param analyses: of its experiments.
    """
    return deserved(
        found=any(a.models and not a.judgement.contradicted for a in analyses),
        doubtful=any(a.verdict is Verdict.DOUBTFUL for a in analyses),
    )


def analysed(
    job: Job, said: list[str], progress: Progress | None = None, tell: Tell = lambda _: None
) -> tuple[Analysis, ...]:
    """Read, identify and tune.

    :param job: what to do.
    :param said: gets sentences for standard error.
    :param progress: told of how far a bag has been read.
    :param tell: told of what the computation is at.
    :raises RelayAutotuneError: if the recording cannot be read, or lacks what is asked for.
    """
    if job.jointly:
        records: list[Record] = []
        for path in job.paths:
            recording = read_experiments(path, job.selection, progress)
            said += [f"{path}: {note}" for note in recording.notes]
            records += recording.experiments
        return (analyse_jointly(records, **vars(job.task)),)
    recording = read_experiments(job.paths, job.selection, progress)
    said += [f"{job.name}: {note}" for note in recording.notes]
    return tuple(analyse(each, **vars(job.task), tell=tell) for each in recording.experiments)


def _exported(
    analyses: Sequence[Analysis], how: str, target: Target, *, accept_doubtful: bool
) -> str:
    """Return the gains as a file; there must be those of one experiment alone."""
    found = [a for a in analyses if a.best_gains is not None]
    if not found:
        why = analyses[0].reason if analyses else "there is no experiment"
        raise RelayAutotuneError(f"no gains to export: {why}")
    if len(found) > 1:
        raise SelectionError(
            f"{len(found)} experiments have gains and a file holds those of one: choose it by "
            "--start and --end, or take all for tests of one process by --jointly"
        )
    only = found[0]
    if only.verdict is not Verdict.TRUSTED and not accept_doubtful:
        raise RelayAutotuneError(
            f"gains are {only.verdict.name.lower()}: {only.judgement.reason}; give "
            "--accept-doubtful to export them anyway"
        )
    assert only.best_gains is not None
    if only.record.settings is not None:
        target = replace(target, present=only.record.settings.baseline)
    return exported(only.best_gains, how, target, doubt=only.judgement.reason).rstrip("\n")


def _text(job: Job, analyses: Sequence[Analysis], error: str | None = None) -> str:
    if job.table_width is not None:
        if error is not None:
            return ""
        return table(job.name, analyses, job.table_width)
    # Imported here, since a table for people does not need it.
    from relay_autotune.exchange.document import document, to_json

    return to_json(document(job.name, analyses, error=error))


def _failed(job: Job, said: Sequence[str], why: str, status: int) -> Done:
    why = visible(why, keep="\n")
    sentence = (
        why
        if any(p in why for p in (job.name, *map(visible, job.paths)))
        else f"{job.name}: {why}"
    )
    return Done(job.name, status, (*said, sentence), _text(job, (), sentence))


def died(job: Job, how: str) -> Done:
    """Return the result of a job that took its process down.

    :param job: the job.
    :param how: what happened, for people.
    """
    return _failed(job, (), f"{job.name}: {how}", NOTHING_FOUND)
