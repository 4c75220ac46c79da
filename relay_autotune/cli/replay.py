# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Identify and tune from recordings: `replay BAG [BAG ...]`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from relay_autotune.bag.reader import READABLE, may_be_recording, recordings_in
from relay_autotune.cli.arguments import (
    DONE,
    DOUBTFUL,
    Parser,
    add_web,
    check_web,
    run_command,
    say,
    worst,
)
from relay_autotune.cli.jobs import (
    Done,
    Job,
    add_analysis,
    add_details,
    add_export,
    export_target,
    jobs_of,
    replay,
    show,
)
from relay_autotune.cli.report import (
    as_asked,
    check_output,
    command_line,
    tell_replaced,
    write_report,
)
from relay_autotune.cli.terminal import Working, require_new, width, write
from relay_autotune.errors import SelectionError
from relay_autotune.loop.gains import FORMS
from relay_autotune.result import Analysis
from relay_autotune.text import counted

if TYPE_CHECKING:
    from relay_autotune.report.case import Case

PROGRAM = "replay"
# Columns of a table that names of recordings fill at most.
_LONGEST_NAME = 32

_EPILOG = """\
A BAG is a rosbag2 directory, an .mcap file, or a table of text such as a .csv.
Topics need not be named if the bag holds experiments of relay_node, or one pair
of topics, each of a single number, that looks like measurement and command.
Others among several BAGs are passed over, with a line each. Of a folder of
recordings a table is printed as they are done, a line for each experiment.

Results go to standard output, everything else to standard error.

Exit status: 0 every bag gave gains; 1 at least one gave none; 2 the command
line, or the choice of topics or columns, is wrong; 3 gains of at least one
experiment are doubtful.

Examples, with the recordings that come with the package:
  replay bags/biased_relay
  replay bags/heater.csv --measurement 'Temperature 1' --command 'Heater 1'
  replay --ms 1.6 --export pid_controller --dof heater bags/step_test > g.yaml
  replay --web bags/step_test
  replay --jobs 2 --output fleet.csv bags/*
  replay --jointly bags/biased_relay bags/unbiased_relay_with_noise
And with some of your own:
  replay --measurement /imu:angular_velocity.z --command /wheel/volt robot_bag
  replay --joint left_wheel --joint right_wheel --output wheels.csv robot_bag
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: those of the command line; default: the process's own.
    :return: the exit status.
    """
    options = _parser().parse_args(arguments)
    options.command_line = command_line(PROGRAM, arguments)
    return run_command(PROGRAM, lambda: _run(options))


def _parser() -> Parser:
    parser = Parser(
        PROGRAM,
        usage="%(prog)s [options] BAG [BAG ...]",
        description="Identify the process in recordings, and tune a controller for it.",
        epilog=_EPILOG,
    )
    parser.add_argument("bags", nargs="+", metavar="BAG", help="recordings")
    add_analysis(parser)
    out = parser.add_argument_group("what comes out")
    out.add_argument("--json", action="store_true", help="print one JSON document a bag")
    out.add_argument(
        "--report", metavar="FILE", help="also write a report: .html, or a .png, .svg or .pdf"
    )
    out.add_argument(
        "-o", "--output", metavar="FILE",
        help="write results as they come to a .jsonl, .csv or .parquet file instead; "
        "bags that it already has are left out; with --export the file of the gains",
    )  # fmt: skip
    out.add_argument(
        "--form", choices=FORMS, default=FORMS[0], metavar="FORM",
        help="form in which gains are shown, too: series; ISA and parallel form always are",
    )  # fmt: skip
    add_export(parser).add_argument(
        "--accept-doubtful", action="store_true", help="also write gains that are doubtful"
    )
    add_web(parser)
    add_details(parser)
    many = parser.add_argument_group("many bags")
    many.add_argument(
        "--jobs", type=_count, metavar="N", default=1, help="bags at a time (%(default)s)"
    )
    many.add_argument(
        "--scheduler", metavar="ADDRESS", help="work on a Dask cluster, such as tcp://host:8786"
    )
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"expected a number from 1 to 1024, found {text!r}")
    return int(text)


def _run(options: argparse.Namespace) -> int:
    file = None
    if options.export:
        # With --export, --output is the file of the gains.
        file, options.output = options.output, None
        if file:
            require_new(file)
    jobs = _jobs(options)
    for flag, wanted in (("--report", options.report), ("--web", options.web)):
        if wanted and (options.output or options.scheduler or options.jobs > 1):
            raise SelectionError(f"{flag} cannot be combined with --output, --jobs or --scheduler")
    if options.report:
        check_output(options.report)
    check_web(options)
    if options.output:
        return _into_file(jobs, options)
    status = DONE
    analyses: list[Analysis] = []
    cases: list[Case] = []
    named = options.measurement is not None or options.command is not None
    is_table = not (options.json or options.export or options.web)
    above = ""
    for done in _in_order(jobs, options):
        # Rows of other units have a heading of their own.
        if done.heading not in ("", above):
            above = done.heading
            write(f"{above}\n", None)
        if named or not jobs[0].name_width:
            _tell(done)
        if done.text:
            write(f"{done.text}\n", file if done.analyses else None)
        status = worst(status, done.status)
        analyses += done.analyses
        if options.report or options.web:
            # Imported here, since a table needs none of the report.
            from relay_autotune.report.case import case_of, unreadable

            cases += [case_of(analysis, done.name) for analysis in done.analyses]
            cases += [unreadable(done.name, done.error)] * bool(done.error and options.report)
    if analyses and options.report:
        tell_replaced(PROGRAM, options.report)
        write_report(as_asked(cases, options), options.report)
        say(PROGRAM, f"the report is {options.report}")
    elif analyses and status != DONE and len(jobs) == 1 and is_table:
        # A load, or a command of another loop, is seen at once.
        figures = f"report{options.command_line.removeprefix(PROGRAM)} -o report.html"
        say(PROGRAM, f"figures show why: {figures}")
    if analyses and options.web:
        shown = as_asked([case for case in cases if case.record is not None], options)
        shapings = [analysis.shaping for analysis in analyses]
        show(options, list(zip(shown, shapings, strict=True)))
    return status


def _jobs(options: argparse.Namespace) -> list[Job]:
    """Return what is to be done.

    :raises SelectionError: if options contradict each other, or a name is unknown.
    """
    with_table = not (options.json or options.output)
    recordings = _recordings(options.bags)
    jobs = jobs_of(options, recordings, table_width=width() if with_table else None)
    jobs = [replace(j, form=options.form, accept_doubtful=options.accept_doubtful) for j in jobs]
    target = export_target(options)
    if with_table and len(jobs) > 1 and any(recordings_in(Path(name)) for name in options.bags):
        name_width = min(max(len(job.label) for job in jobs), _LONGEST_NAME)
        jobs = [replace(job, name_width=name_width) for job in jobs]
    if options.scheduler:
        # The workers of a cluster have working directories of their own.
        jobs = [replace(j, paths=tuple(str(Path(p).absolute()) for p in j.paths)) for j in jobs]
    if options.export:
        if len(jobs) > 1:
            raise SelectionError(
                f"--export writes the gains of one bag alone, and {len(jobs)} are given: name "
                f"one, such as {jobs[0].name}"
            )
        if options.json:
            raise SelectionError("--export writes a file of its own: leave out --json")
        jobs = [replace(jobs[0], export=(options.export, target))]
    return jobs


def _recordings(given: Sequence[str]) -> list[str]:
    """Return what of the command line can be a recording; a pattern such as bags/* names more."""
    found: list[str] = []
    left_out = []
    for name in dict.fromkeys(given):
        inside = recordings_in(Path(name))
        if inside or len(given) == 1 or may_be_recording(Path(name)):
            found += map(str, inside) if inside else [name]
        else:
            left_out.append(name)
    if not found:
        # The error of each then says what it is.
        return list(given)
    for name in left_out:
        say(PROGRAM, f"{name} is left out: it is not a recording ({READABLE})")
    return found


def _into_file(jobs: Sequence[Job], options: argparse.Namespace) -> int:
    """Write results to a file as they come."""
    from relay_autotune.cli.fleet import ResultsFile

    with ResultsFile(options.output) as results:
        left = [job for job in jobs if job.name not in results.done]
        status = results.status
        if len(left) < len(jobs):
            say(PROGRAM, f"{len(jobs) - len(left)} of {len(jobs)} bags are in {results.path}")
        failed = 0
        with Working(f"working on {counted(len(left), 'bag')}", patient=True) as working:
            for count, (_, done) in enumerate(_as_they_come(left, options), start=1):
                working.clear()
                _tell(done)
                results.add(done.name, done.text)
                failed += done.status not in (DONE, DOUBTFUL)
                status = worst(status, done.status)
                working.share(count, len(left))
    of_these = f", {failed} of them without a model" if failed else ""
    say(PROGRAM, f"{counted(len(left), 'bag')} done{of_these}; results in {options.output}")
    return status


def _in_order(jobs: Sequence[Job], options: argparse.Namespace) -> Iterator[Done]:
    """Yield results in the order of the command line."""
    early: dict[int, Done] = {}
    due = 0
    for number, done in _as_they_come(jobs, options, alone=True):
        early[number] = done
        while due in early:
            yield early.pop(due)
            due += 1


def _as_they_come(
    jobs: Sequence[Job], options: argparse.Namespace, *, alone: bool = False
) -> Iterator[tuple[int, Done]]:
    """Yield the number of each job and its result.

    :param alone: whether each job says itself what it is at, unless several run at a time.
    """
    if options.scheduler:
        from relay_autotune.cli.fleet import on_cluster

        yield from on_cluster(jobs, options.scheduler)
    elif options.jobs > 1 and len(jobs) > 1:
        from relay_autotune.cli.fleet import in_processes

        yield from in_processes(jobs, options.jobs)
    else:
        for number, job in enumerate(jobs):
            yield number, replay(job, quiet=not alone)


def _tell(done: Done) -> None:
    for sentence in done.said:
        say(PROGRAM, sentence)
