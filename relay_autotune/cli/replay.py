"""Identify and tune from recordings: `replay BAG [BAG ...]`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from relay_autotune.bag.reader import Selection, read_experiments
from relay_autotune.cli.arguments import (
    DONE,
    NOTHING_FOUND,
    USAGE,
    finite,
    guarded,
    known_facts,
    say,
)
from relay_autotune.errors import RelayAutotuneError, SelectionError

if TYPE_CHECKING:
    from relay_autotune.autotune import Analysis
    from relay_autotune.identification.known import Known
    from relay_autotune.record import Record

PROGRAM = "replay"

_EPILOG = """\
A BAG is a rosbag2 directory, an .mcap file, or a .csv file with a header line.  Topics need not
be named if the bag holds experiments of relay_node, or one pair of std_msgs/Float64 topics that
looks like measurement and command.

Results go to standard output, everything else to standard error.
Exit status: 0 done; 1 nothing was identified in at least one bag; 2 the command line, or the
choice of topics, does not fit.

Examples:
  replay ~/.ros/relay_autotune/20261120T234315Z_2c010118
  replay --measurement /tank/level --command /tank/valve robot_bag
  replay --json log.csv --measurement level --command valve --time t
  replay --method chang --gain 1.65 --dead-time 10 robot_bag
  replay --method li without_extra_delay with_extra_delay     (several tests, one model)
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: those of the command line; default: the process's own.
    :return: the exit status.
    """
    options = _parser().parse_args(arguments)
    return guarded(PROGRAM, lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Identify the process in recordings, and tune a controller for it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("bags", nargs="+", metavar="BAG", help="recordings")
    parser.add_argument(
        "--measurement", metavar="TOPIC", help="topic, or column of a CSV, of the measurement"
    )
    parser.add_argument(
        "--command", metavar="TOPIC", help="topic, or column of a CSV, of the command"
    )
    parser.add_argument("--time", metavar="NAME", help="column of the time [s] of a CSV")
    parser.add_argument(
        "--start", type=finite, metavar="S", help="leave out what is before S [s from the start]"
    )
    parser.add_argument(
        "--end", type=finite, metavar="S", help="leave out what is after S [s from the start]"
    )
    parser.add_argument("--method", default="waveform", help="how to identify (%(default)s)")
    parser.add_argument("--gain", type=finite, metavar="K", help="known gain of the process [y/u]")
    parser.add_argument("--dead-time", type=finite, metavar="S", help="known dead time [s]")
    parser.add_argument("--structure", metavar="NAME", default="", help="known structure")
    parser.add_argument("--order", type=int, metavar="N", default=0, help="known number of lags")
    parser.add_argument("--rule", default="thyagarajan", help="how to tune (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON document a bag")
    return parser


def _run(options: argparse.Namespace) -> int:
    from relay_autotune.autotune import check_names
    from relay_autotune.identification import JOINT_METHODS

    try:
        check_names(options.method, options.rule)
        known = known_facts(options)
    except RelayAutotuneError as error:
        raise SelectionError(str(error)) from error
    start, end = options.start, options.end
    if start is not None and end is not None and start >= end:
        raise SelectionError(f"--start {start:g} is not before --end {end:g}")
    selection = Selection(options.measurement, options.command, options.time, start, end)
    if options.method in JOINT_METHODS:
        return _replay_jointly(selection, options, known)
    return max(_replay(bag, selection, options, known) for bag in options.bags)


def _replay(bag: str, selection: Selection, options: argparse.Namespace, known: Known) -> int:
    """Read, identify, tune and print one bag; return the exit status it deserves."""
    from relay_autotune.autotune import analyse

    try:
        records = _read(bag, selection)
    except RelayAutotuneError as error:
        return _unreadable(bag, error, options)
    return _show(
        bag,
        [analyse(r, method=options.method, rule=options.rule, known=known) for r in records],
        options,
    )


def _replay_jointly(selection: Selection, options: argparse.Namespace, known: Known) -> int:
    """Take the experiments of all bags for tests of one process."""
    from relay_autotune.autotune import analyse_jointly

    records: list[Record] = []
    for bag in options.bags:
        try:
            records += _read(bag, selection)
        except RelayAutotuneError as error:
            return _unreadable(bag, error, options)
    analysis = analyse_jointly(records, method=options.method, rule=options.rule, known=known)
    return _show(", ".join(options.bags), [analysis], options)


def _read(bag: str, selection: Selection) -> tuple[Record, ...]:
    recording = read_experiments(bag, selection)
    for note in recording.notes:
        say(PROGRAM, f"{bag}: {note}")
    return recording.experiments


def _unreadable(bag: str, error: RelayAutotuneError, options: argparse.Namespace) -> int:
    text = str(error) if bag in str(error) else f"{bag}: {error}"
    say(PROGRAM, text)
    if options.json:
        _print_document(bag, error=text)
    return USAGE if isinstance(error, SelectionError) else NOTHING_FOUND


def _show(bag: str, analyses: Sequence[Analysis], options: argparse.Namespace) -> int:
    if options.json:
        _print_document(bag, analyses)
    else:
        from relay_autotune.cli.table import table

        print(table(bag, analyses))
    if any(analysis.models for analysis in analyses):
        return DONE
    for analysis in analyses:
        say(PROGRAM, f"{bag}: nothing identified: {analysis.reason}")
    return NOTHING_FOUND


def _print_document(bag: str, analyses: Sequence[Analysis] = (), error: str | None = None) -> None:
    from relay_autotune.document import document, to_json

    print(to_json(document(bag, analyses, error=error)), flush=True)


if __name__ == "__main__":
    sys.exit(main())
