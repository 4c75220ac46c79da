# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""From options to what is made of recordings: which part of them, how to identify, what to design.

It is the same in this process, in another one and on another host.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from relay_autotune.analysis import Task, agreed, analyse, analyse_jointly
from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.bag.signals import CLOCKS, TIME_UNITS, Selection
from relay_autotune.cli.arguments import (
    DEBUG,
    NOTHING_FOUND,
    USAGE,
    add_quantities,
    as_typed,
    exit_status,
    finite,
    given_quantities,
    say,
)
from relay_autotune.cli.table import compared_lines, heading, rows, table
from relay_autotune.cli.terminal import WIDEST, Working
from relay_autotune.errors import NotThereError, RelayAutotuneError, SelectionError, defect
from relay_autotune.exchange.export import EXPORTS, Target, exported
from relay_autotune.expected_time import expected_time
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import ONLY_JOINT
from relay_autotune.loop.gains import FORMS, Controller, Gains
from relay_autotune.loop.laws import LAWS
from relay_autotune.quantities import Quantity, declared
from relay_autotune.record.moves import resting_command
from relay_autotune.record.record import Record
from relay_autotune.recordings import read_experiments
from relay_autotune.result import Analysis
from relay_autotune.text import in_units, visible
from relay_autotune.tuning.task import CONTROLLERS, DesignOptions
from relay_autotune.verdict import Verdict

if TYPE_CHECKING:
    from relay_autotune.report.case import Case
    from relay_autotune.result import Shaping
    from relay_autotune.web.shape import DesignRequest


@dataclass(frozen=True)
class Job:
    """One bag to replay, or several that are one.

    :param name: how results call it.
    :param paths: the recordings; several are one timeline, or tests of one process.
    :param selection: what of them is wanted.
    :param task: how to identify, and what is asked of the controller.
    :param jointly: whether the experiments of all recordings give one model.
    :param among_others: whether there are others, which topics or columns may be named for.
    :param table_width: columns of the table for people; None: the document is wanted instead.
    :param name_width: columns of the name in a table with one line for each experiment; 0: the
        table tells all of a bag.
    :param export: the kind of file that is wanted instead, and where its gains go; None: none.
    :param accept_doubtful: True: the file may hold gains whose verdict is doubtful.
    :param present: the gains that the controller has now, to see them beside; None: not known.
    :param form: form of the gains in the table, one of ``FORMS``.
    """

    name: str
    paths: tuple[str, ...]
    selection: Selection
    task: Task
    jointly: bool = False
    among_others: bool = False
    table_width: int | None = None
    name_width: int = 0
    export: tuple[str, Target] | None = None
    accept_doubtful: bool = False
    present: Controller | None = None
    form: str = FORMS[0]

    @property
    def label(self) -> str:
        """The name without folders."""
        return Path(self.name).name


@dataclass(frozen=True)
class Done:
    """What became of a job.

    :param name: that of the job.
    :param status: the exit status that it deserves.
    :param said: sentences for standard error.
    :param text: the table, or the document on one line; empty: there is none.
    :param heading: the lines above a table of such texts; empty: there is none.
    :param error: why nothing was found; empty: something was.
    :param analyses: those of its experiments, in the process that made them.
    """

    name: str
    status: int
    said: tuple[str, ...]
    text: str
    heading: str = ""
    error: str = ""
    analyses: tuple[Analysis, ...] = ()


def work(job: Job) -> Done:
    """Do a job for another process, which needs no more than texts.

    :param job: what to do.
    """
    return replace(replay(job, quiet=True), analyses=())


def replay(job: Job, *, quiet: bool) -> Done:
    """Read, identify and tune; an error becomes part of the result.

    :param job: what to do.
    :param quiet: as of `analysed`.
    """
    said: list[str] = []
    analyses: tuple[Analysis, ...] = ()
    try:
        analyses = analysed(job, said, quiet=quiet)
        if job.export is None:
            text = _text(job, analyses)
        else:
            gains, to, text = _exported(analyses, *job.export, doubtful=job.accept_doubtful)
            said += [f"{job.name}: {in_units(each, to.units)}" for each in gains.warnings]
            for each in analyses:
                if lines := compared_lines(each, job.present, job.table_width or WIDEST):
                    said.append("\n".join([f"{job.name}:", *lines]))
    except SelectionError as error:
        command = shlex.join(("replay", *job.paths))
        return _failed(job, said, error.with_choices(command), USAGE)
    except RelayAutotuneError as error:
        # Doubtful gains are there, although they are not exported unasked.
        return _failed(job, said, str(error), status_of(analyses) or NOTHING_FOUND)
    except Exception as error:
        if os.environ.get(DEBUG):
            raise
        why = f"{job.name} could not be analysed: {defect(error)}"
        return _failed(job, said, why, NOTHING_FOUND)
    status = status_of(analyses)
    if status == NOTHING_FOUND and not job.table_width:
        # A table has the reasons.
        said += [
            f"{job.name}: {'' if a.models else 'nothing identified: '}{a.reason}" for a in analyses
        ]
    is_row = job.name_width and analyses
    above = heading(job.name_width, analyses[0].record.units) if is_row else ""
    return Done(job.name, status, tuple(said), text, heading=above, analyses=analyses)


def status_of(analyses: Sequence[Analysis]) -> int:
    """Return the exit status that a bag deserves.

    :param analyses: of its experiments.
    """
    return exit_status(
        found=any(a.best_gains is not None for a in analyses),
        doubtful=any(a.verdict is Verdict.DOUBTFUL for a in analyses),
    )


def analysed(job: Job, said: list[str], *, quiet: bool) -> tuple[Analysis, ...]:
    """Read, identify and tune.

    :param job: what to do.
    :param said: gets sentences for standard error.
    :param quiet: False: it is said how much of a bag is read, and what the computation is at.
    :raises RelayAutotuneError: if the recording cannot be read, or lacks what is asked for.
    """
    records: list[Record] = []
    # Those of one process are read one by one, others are one timeline.
    groups = [(path,) for path in job.paths] if job.jointly else [job.paths]
    with Working(f"reading {job.name}", patient=True, quiet=quiet) as reading:
        for paths in groups:
            try:
                recording = read_experiments(paths, job.selection, reading.share)
            except NotThereError as error:
                if not job.among_others:
                    raise
                said.append(f"{error.lacking}: it is read by its own names")
                own = replace(job.selection, measurement=None, command=None, time=None)
                recording = read_experiments(paths, own, reading.share)
            name = paths[0] if job.jointly else job.name
            said += [f"{name}: {note}" for note in recording.notes]
            records += recording.experiments
    expected = math.nan if quiet else expected_time(*map(len, records))
    with Working("computing the model", expected, quiet=quiet) as working:
        if job.jointly:
            return (analyse_jointly(records, **vars(job.task)),)
        found = tuple(analyse(each, **vars(job.task), tell=working.at) for each in records)
        return agreed(found) if recording.of_one_process else found


def _exported(
    analyses: Sequence[Analysis], how: str, target: Target, *, doubtful: bool
) -> tuple[Gains, Target, str]:
    """Return gains, where they go, and the file; there must be those of one experiment alone."""
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
    if only.verdict is not Verdict.TRUSTED and not doubtful:
        raise RelayAutotuneError(
            f"gains are {only.verdict.name.lower()}: {only.judgement.reason}; give "
            "--accept-doubtful to export them anyway"
        )
    assert only.best_gains is not None
    gains, to = only.best_gains, _target_from(target, only.record, only.shaping)
    return gains, to, exported(gains, how, to, doubt=only.judgement.reason).rstrip("\n")


def _target_from(target: Target, record: Record | None, shaping: Shaping | None) -> Target:
    """Return where gains go with units, noise, and the command at which a record rests."""
    if shaping is not None:
        task = shaping.task
        target = replace(target, noise_std=task.options.noise_std, model=task.held(task.model))
    if record is None:
        return target
    recorded = float(record.command.min()), float(record.command.max())
    return replace(target, present=resting_command(record), recorded=recorded, units=record.units)


def _text(job: Job, analyses: Sequence[Analysis], error: str | None = None) -> str:
    if job.table_width is not None:
        if job.name_width:
            # The name of the recording begins the row.
            why = error and error.removeprefix(job.name).lstrip(": ")
            return "\n".join(rows(job.label, analyses, why, job.name_width, job.table_width))
        if error is not None:
            return ""
        return table(job.name, analyses, job.table_width, job.present, job.form)
    # Imported here, since a table for people does not need it.
    from relay_autotune.exchange.models import document, to_json

    return to_json(document(job.name, analyses, error=error))


def _failed(job: Job, said: Sequence[str], why: str, status: int) -> Done:
    why = visible(why, keep="\n")
    sentence = (
        why
        if any(p in why for p in (job.name, *map(visible, job.paths)))
        else f"{job.name}: {why}"
    )
    text = _text(job, (), sentence)
    return Done(job.name, status, (*said, sentence), text, error=sentence)


def died(job: Job, how: str) -> Done:
    """Return the result of a job that took its process down.

    :param job: the job.
    :param how: what happened, for people.
    """
    return _failed(job, (), f"{job.name}: {how}", NOTHING_FOUND)


# What of a design most users ask for.
_ASKED = ("controller", "ms", "sample_period", "law")


def add_design(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the options that say what is asked of a controller, those that most users need.

    :param parser: of the command.
    :return: the group that they are in.
    """
    group = parser.add_argument_group("what is asked of the controller")
    kind = group.add_mutually_exclusive_group()
    kind.add_argument(
        "--controller", choices=CONTROLLERS, metavar="KIND",
        help="auto, pi or pid; auto is PI unless the rule finds PID worth it",
    )  # fmt: skip
    for each in ("pi", "pid"):
        kind.add_argument(
            f"--{each}", dest="controller", action="store_const", const=each,
            help=f"the same as --controller {each}",
        )  # fmt: skip
    add_quantities(group, (each for each in declared(DesignOptions) if each.name in _ASKED[1:]))
    return group


def add_design_details(parser: argparse.ArgumentParser) -> None:
    """Add the others of these options.

    :param parser: of the command.
    """
    group = parser.add_argument_group("more on the design")
    add_quantities(group, (each for each in declared(DesignOptions) if each.name not in _ASKED))


def design_options(options: argparse.Namespace) -> DesignOptions:
    """Return what is asked of a controller.

    :param options: with those of :func:`add_design`.
    :raises SelectionError: if a value is out of its range, or --export names no program.
    """
    given = given_quantities(options, declared(DesignOptions))
    export = getattr(options, "export", None)
    problem = Quantity("--export", "", choices=("", *EXPORTS)).problem(export or "")
    if problem is not None:
        raise SelectionError(problem)
    if "law" not in given and export in LAWS:
        given["law"] = export
    return DesignOptions(**given)


def add_export(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the options that say where gains go.

    :param parser: of the command.
    :return: the group that they are in.
    """
    group = parser.add_argument_group("gains as a file")
    group.add_argument(
        "--export",
        metavar="LAW",
        help="print the gains for a program instead: a law of --law, which needs not be named "
        "again, yaml or launch",
    )
    group.add_argument(
        "--node", default="/pid_controller", metavar="NAME", help="whose file it is (%(default)s)"
    )
    group.add_argument(
        "--dof", metavar="NAME", help="its degree of freedom (that of --joint, else joint)"
    )
    group.add_argument("--command-min", type=finite, metavar="U", help="lower clamp in it [u]")
    group.add_argument("--command-max", type=finite, metavar="U", help="upper clamp in it [u]")
    return group


def export_target(options: argparse.Namespace) -> Target:
    """Return where gains go.

    :param options: with those of :func:`add_export`.
    :raises SelectionError: if a name or a clamp cannot be.
    """
    known = {n: getattr(options, n) for n in ("command_min", "command_max", "noise_std")}
    given = {n: v for n, v in known.items() if v is not None}
    dof = options.dof or next(iter(getattr(options, "joint", ())), "joint")
    return Target(node=options.node, dof=dof, **given)


def add_analysis(parser: argparse.ArgumentParser) -> None:
    """Add options: what is taken from a recording, and what is asked, as most users need them.

    :param parser: of the command.
    """
    taken = parser.add_argument_group("what is taken from a recording")
    for signal in ("measurement", "command"):
        taken.add_argument(
            f"--{signal}", metavar="NAME",
            help=f"of the {signal}: TOPIC, TOPIC:FIELD, or the column of a CSV",
        )  # fmt: skip
    for end, what in (("start", "before"), ("end", "after")):
        taken.add_argument(
            f"--{end}", type=finite, metavar="S",
            help=f"leave out what is {what} S [s from the start]",
        )  # fmt: skip
    taken.add_argument(
        "--joint", action="append", default=[], metavar="NAME",
        help="find measurement and command of this joint by its name; of several, one after the "
        "other",
    )  # fmt: skip
    taken.add_argument(
        "--jointly", action="store_true",
        help="take all experiments as tests of one process, with one model",
    )  # fmt: skip
    add_design(parser).add_argument(
        "--present", nargs=3, type=finite, metavar=("KC", "TI", "TD"),
        help="gains in the controller now, to see them beside the new ones [u/y, s, s]; TI 0: P",
    )  # fmt: skip


def add_details(parser: argparse.ArgumentParser) -> None:
    """Add the others of the options of :func:`add_analysis`, which fewer users need.

    :param parser: of the command.
    """
    taken = parser.add_argument_group("recordings that need more")
    add_times(taken)
    taken.add_argument(
        "--command-before", type=finite, metavar="U",
        help="command under which the process rested before the recording, where that begins "
        "with its step",
    )  # fmt: skip
    taken.add_argument(
        "--clock", choices=CLOCKS, default=CLOCKS[0], metavar="TIME",
        help="time of a message: publish, log or header, the stamp in it (%(default)s)",
    )  # fmt: skip
    taken.add_argument(
        "--join", action="store_true", help="take all BAGs as one recording on one timeline"
    )
    taken.add_argument(
        "--joint-order", metavar="NAMES",
        help="joints, with commas, of commands that do not name them, as in the controller's "
        "parameter joints",
    )  # fmt: skip
    taken.add_argument(
        "--max-chunk", dest="largest_chunk", type=_size, metavar="SIZE", default=LARGEST_CHUNK,
        help="leave out chunks that declare more than SIZE, such as 64M or 2G "
        f"({LARGEST_CHUNK >> 20}M)",
    )  # fmt: skip
    how = parser.add_argument_group("how the process is identified, and the rule of the gains")
    how.add_argument("--method", default="waveform", help="how to identify (%(default)s)")
    add_quantities(how, declared(Known))
    how.add_argument("--rule", default="robust", help="how to tune (%(default)s)")
    add_design_details(parser)


def present_of(options: argparse.Namespace, loops: Collection[str]) -> Controller | None:
    """Return the gains that a controller has now; None: they were not given.

    :param options: with those of :func:`add_analysis`.
    :param loops: names of all that is analysed.
    :raises SelectionError: if they cannot be, or of which loop they are is not known.
    """
    if options.present is None:
        return None
    if len(loops) > 1:
        raise SelectionError(
            f"--present is of one loop, and {len(loops)} are given ({', '.join(loops)}): name one"
        )
    kc, ti, td = options.present
    try:
        return Controller(kc, ti, td)
    except RelayAutotuneError as error:
        raise SelectionError(f"--present: {error}") from error


def add_times(parser: argparse._ActionsContainer) -> None:
    """Add options: what a CSV file does not say of its times.

    :param parser: of the command, or a group of its options.
    """
    parser.add_argument("--time", metavar="NAME", help="column of the time of a CSV")
    parser.add_argument(
        "--time-unit", choices=TIME_UNITS, metavar="UNIT",
        help=f"its unit, where the CSV does not say it: {', '.join(TIME_UNITS)} (s)",
    )  # fmt: skip
    parser.add_argument(
        "--period", type=finite, metavar="S", help="time from row to row of a CSV without times"
    )


def _size(text: str) -> int:
    match = re.fullmatch(r"(\d{1,12})([kMG]?)", text)
    if match is None or int(match[1]) == 0:
        raise argparse.ArgumentTypeError(f"expected a size such as 64M or 2G, found {text!r}")
    return int(match[1]) << {"": 0, "k": 10, "M": 20, "G": 30}[match[2]]


def jobs_of(
    options: argparse.Namespace, recordings: Sequence[str], *, table_width: int | None = None
) -> list[Job]:
    """Return what is to be done with recordings, each once.

    :param options: with those of :func:`add_analysis`.
    :param recordings: their names.
    :param table_width: columns of a table for people; None: documents are wanted instead.
    :raises SelectionError: if options contradict each other, or a name is unknown.
    """
    try:
        known = Known(**given_quantities(options, declared(Known)))
        task = Task(options.method, options.rule, known, design_options(options))
    except RelayAutotuneError as error:
        raise SelectionError(str(error)) from error
    start, end = options.start, options.end
    if start is not None and end is not None and start >= end:
        raise SelectionError(f"--start {start:g} is not before --end {end:g}")
    joints = list(dict.fromkeys(options.joint)) or [""]
    order = (
        tuple(name.strip() for name in options.joint_order.split(","))
        if options.joint_order
        else ()
    )
    _check_joints(joints, order)
    jointly = options.jointly or options.method in ONLY_JOINT
    taken = {each.name: getattr(options, each.name) for each in fields(Selection)}
    names = list(dict.fromkeys(recordings))
    groups = [tuple(names)] if jointly or options.join else [(name,) for name in names]
    jobs = [
        Job(
            name=visible(", ".join(group) + (f" {joint}" if joint else "")),
            paths=group,
            selection=Selection(**taken | {"joint": joint, "joint_order": order}),
            task=task,
            jointly=jointly,
            among_others=len(groups) > 1,
            table_width=table_width,
        )
        for group in groups
        for joint in joints
        if group
    ]
    present = present_of(options, [job.name for job in jobs])
    return [replace(job, present=present) for job in jobs]


def _check_joints(joints: Sequence[str], order: Sequence[str]) -> None:
    """Refuse joints that cannot be.

    :raises SelectionError: with what to write instead.
    """
    for joint in joints:
        if joint and Path(joint).exists():
            raise SelectionError(
                f"--joint names a joint, but {joint} is a recording; to take all experiments as "
                f"tests of one process, write --jointly"
            )
        if joint and order and joint not in order:
            raise SelectionError(
                f"--joint-order {','.join(order)} does not have the joint {joint}"
            )
    if order and not joints[0]:
        raise SelectionError("--joint-order is for a joint: name it with --joint")
    if len(set(order)) < len(order):
        raise SelectionError(f"--joint-order {','.join(order)} names a joint twice")


def show(options: argparse.Namespace, models: Sequence[tuple[Case, Shaping | None]]) -> None:
    """Serve a page with models to shape until Ctrl-C.

    :param options: as the parser of the command parsed them.
    :param models: the experiments, each with what the design of its gains takes.
    :raises SelectionError: if the address cannot be used.
    """
    # Imported here: tornado is for --web alone.
    from relay_autotune.web.address import Address
    from relay_autotune.web.server import Page, run
    from relay_autotune.web.shape import DesignRequest, PageModel

    rule, target = options.rule or DesignRequest.rule, export_target(options)

    def subject(case: Case, shaping: Shaping | None) -> PageModel:
        first = DesignRequest.of(rule, shaping.task.options if shaping else DesignOptions())

        def command(asked: DesignRequest) -> str:
            changed = asked.changed_from(first) | ({"law": None} if asked.law == "" else {})
            return as_typed(options, web=None, web_address=None, export=None, **changed)

        return PageModel(
            case, shaping, first, command, target=_target_from(target, case.record, shaping)
        )

    subjects = [subject(case, shaping) for case, shaping in models]

    page = Page(subjects, options.web_address or Address())
    units = [case.units for case, _ in models]
    if all(each == units[0] for each in units):
        page.units = units[0]
    run(page, lambda url: say(options.parser.prog, f"the page is at {url} until Ctrl-C"))
