# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Write a report of recordings or results: `report BAG|RECORD.csv|RESULT.json ... -o FILE`.

The record of a tune is analysed again with the parameters of its identifier_node.
"""

from __future__ import annotations

import argparse
import math
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relay_autotune.analysis import PARAMETERS
from relay_autotune.cli.arguments import (
    DONE,
    NOTHING_FOUND,
    USAGE,
    Parser,
    flag_of,
    run_command,
    say,
    typed_as,
    worst,
)
from relay_autotune.cli.jobs import Job, add_analysis, add_details, analysed, jobs_of, present_of
from relay_autotune.errors import BagError, RelayAutotuneError, SelectionError, os_errors_as
from relay_autotune.report import PICTURES, is_ours, write_figures, write_page, write_picture

if TYPE_CHECKING:
    from relay_autotune.report.case import Case


PROGRAM = "report"

_EPILOG = """\
Each source is a recording as `replay` reads it (a rosbag2 directory, an .mcap
file or a .csv file), or a .json file as `replay --json` prints it.  The page is
one file that opens without a network; from a .json file the figures that need
samples are left out.

Exit status: 0 done; 1 a source could not be read, or nothing was identified in
it (the report is still written); 2 the command line, or the choice of topics,
is wrong.

Examples:
  report ~/.ros/relay_autotune/20261120T234315Z_2c010118 -o tune.html
  report demo_output/result.json -o demo.html
  report bags/step_test -o tank.html --figures figures \\
      --measurement /reactor/temperature --command /reactor/heater
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
        description="Write a report: the gains, the model, figures, and how sure they are.",
        epilog=_EPILOG,
    )
    parser.add_argument("sources", nargs="+", metavar="SOURCE", help="recordings or results")
    parser.add_argument(
        "-o", "--output", metavar="FILE", default="report.html",
        help="the report: .html, or one picture: .png, .svg or .pdf (%(default)s)",
    )  # fmt: skip
    parser.add_argument("--figures", metavar="DIR", help="also write each figure to a file in DIR")
    parser.add_argument(
        "--format", choices=("png", "svg"), default="png", help="of these figures (%(default)s)"
    )
    parser.add_argument("--title", metavar="TEXT", default="", help="title of the report")
    add_analysis(parser)
    add_details(parser)
    return parser


def _run(options: argparse.Namespace) -> int:
    check_output(options.output)
    # Imported here, since it takes long.
    from relay_autotune.report.case import unreadable

    cases: list[Case] = []
    status, failed, sources = DONE, 0, _sources(options)
    for names, read in sources:
        try:
            found = read()
        except RelayAutotuneError as error:
            unclear = isinstance(error, SelectionError)
            if unclear and len(sources) == 1:
                raise
            is_named = any(name in str(error) for name in names)
            say(PROGRAM, str(error) if is_named else f"{', '.join(names)}: {error}")
            status = worst(status, USAGE if unclear else NOTHING_FOUND)
            failed += 1
            found = [unreadable(", ".join(names), str(error))]
        else:
            for case in found:
                if case.model is None:
                    say(PROGRAM, f"{case.source}: nothing identified: {case.reason}")
                    status = worst(status, NOTHING_FOUND)
        cases += found
    if failed == len(sources):
        return status
    cases = as_asked(cases, options)
    tell_replaced(PROGRAM, options.output)
    write_report(cases, options.output, title=options.title)
    print(options.output)
    if folder := options.figures:
        with os_errors_as(BagError, f"the figures cannot be written to {folder}"):
            if any(Path(folder).glob(f"*.{options.format}")):
                say(PROGRAM, f"{folder} has figures already; those of the same name are replaced")
            for path in write_figures(cases, folder, options.format):
                print(path)
    return status


def command_line(program: str, arguments: Sequence[str] | None) -> str:
    """Return a command as it can be typed again.

    :param program: name of the command.
    :param arguments: what was given to its main function.
    """
    return shlex.join([program, *(sys.argv[1:] if arguments is None else arguments)])


def as_asked(cases: Sequence[Case], options: argparse.Namespace) -> list[Case]:
    """Return cases with what only the command line knows: present gains, and itself.

    :param cases: of the report.
    :param options: of the command line, and itself.
    :raises SelectionError: if the present gains cannot be.
    """
    loops = dict.fromkeys(case.source for case in cases if case.best_gains is not None)
    present = present_of(options, loops)
    return [replace(case, present=present, command=options.command_line) for case in cases]


def check_output(output: str) -> None:
    """Refuse a report that could not be written, before any work is done.

    :param output: name of its file.
    :raises SelectionError: if the ending is unknown, the folder does not exist, the file cannot be
        written, or it is a page of somebody else.
    """
    path = Path(output)
    if path.suffix.lower() not in (".html", *PICTURES):
        raise SelectionError(
            f"{output!r} does not say what the report is to be; expected an ending "
            f".html, {', '.join(PICTURES)}"
        )
    if not path.parent.is_dir():
        raise SelectionError(f"there is no folder {path.parent} for the report; make it first")
    existed = os.path.lexists(path)
    if existed and not path.is_file():
        raise SelectionError(f"{path} exists and is no file; name another one for the report")
    if existed and path.suffix.lower() == ".html" and not is_ours(path):
        raise SelectionError(
            f"{path} exists and is not a report of this package; name another file, or remove it"
        )
    if path.suffix.lower() == ".html":
        # A missing package is reported here, too.
        import relay_autotune.report.page  # noqa: F401
    refused = os_errors_as(
        SelectionError, f"the report {path} cannot be written", "; name another file"
    )
    # Only an attempt tells of rights, of file systems and of the length of names.
    with refused, path.open("ab"):
        pass
    if not existed:
        path.unlink()


def tell_replaced(program: str, output: str) -> None:
    """Say that an earlier report of the same name is replaced.

    :param program: name of the command.
    :param output: name of its file.
    """
    if os.path.lexists(output):
        say(program, f"{output} exists and will be replaced")


def write_report(cases: Sequence[Case], output: str, *, title: str = "") -> None:
    """Write a report as its file's ending says.

    :param cases: at least one.
    :param output: .html for the page, .png, .svg or .pdf for a picture of the first case.
    :param title: default: the first case's source.
    :raises BagError: if the file cannot be written.
    """
    with os_errors_as(BagError, f"the report {output} cannot be written"):
        if Path(output).suffix.lower() == ".html":
            write_page(cases, output, title=title)
        else:
            write_picture(cases[0], output, title=title)


_Source = tuple[tuple[str, ...], Callable[[], Sequence["Case"]]]


def _sources(options: argparse.Namespace) -> list[_Source]:
    """Return the names of each source, with what reads it, in the order of the command line."""
    from relay_autotune.report.case import read_documents

    names = list(dict.fromkeys(options.sources))
    jobs = jobs_of(options, [name for name in names if not _is_result(name)])
    found: list[_Source] = [(job.paths, partial(_cases, job)) for job in jobs]
    found += [((name,), partial(read_documents, name)) for name in names if _is_result(name)]
    # What several recordings make together stands where the first of them does.
    return sorted(found, key=lambda source: names.index(source[0][0]))


def _is_result(source: str) -> bool:
    return source.lower().endswith(".json")


def _cases(job: Job) -> list[Case]:
    """Read recordings and make of them what a report tells."""
    from relay_autotune.report.case import case_of

    said: list[str] = []
    try:
        found = analysed(job, said, quiet=False)
        return [case_of(analysis, job.name) for analysis in found]
    finally:
        for sentence in said:
            say(PROGRAM, sentence)


def flags_of(values: Mapping[str, Any]) -> str:
    """Return the flags with which `replay` and `report` give the identifier_node's result.

    :param values: of its parameters, by name.
    :return: the flags of those that are not the default.
    """
    found = []
    for entry in PARAMETERS:
        value = values[entry.name]
        if value == entry.default or value != value:
            continue
        typed = typed_as(entry)
        if typed.unit != entry.unit:
            value = math.degrees(value)
        found += [flag_of(typed), f"{value:.12g}" if isinstance(value, float) else str(value)]
    return shlex.join(found)
