# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Make a rosbag2 bag of two columns of a CSV file: `csv_to_bag CSV BAG`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from relay_autotune.bag.csv_file import read_csv
from relay_autotune.bag.signals import Selection
from relay_autotune.cli.arguments import DONE, Parser, finite, run_command, say
from relay_autotune.cli.jobs import add_times
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.text import NAME_OF_ROS

PROGRAM = "csv_to_bag"

_EPILOG = """\
The bag gets two topics of std_msgs/Float64, named for their columns without the
unit: the column "Heater 1 (%)" becomes /heater_1.  Measurement and command of a
row carry the time of that row.

Example:
  csv_to_bag bags/heater.csv heater_bag \\
      --measurement 'Temperature 1 (degC)' --command 'Heater 1 (%)'
  replay heater_bag --measurement /temperature_1 --command /heater_1
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: those of the command line; default: the process's own.
    :return: the exit status.
    """
    parser = Parser(
        PROGRAM,
        description="Make a rosbag2 bag of two columns of a CSV file.",
        epilog=_EPILOG,
    )
    parser.add_argument("csv", metavar="CSV", type=Path, help="file with a header line")
    parser.add_argument("bag", metavar="BAG", type=Path, help="directory to make")
    parser.add_argument("--measurement", metavar="NAME", help="column of the measurement")
    parser.add_argument("--command", metavar="NAME", help="column of the command")
    add_times(parser)
    parser.add_argument("--measurement-topic", metavar="TOPIC", help="name of its topic")
    parser.add_argument("--command-topic", metavar="TOPIC", help="name of its topic")
    parser.add_argument(
        "--epoch",
        type=finite,
        default=0.0,
        metavar="S",
        help="time zero of the file [s since 1970-01-01 UTC] (%(default)s)",
    )
    options = parser.parse_args(arguments)
    return run_command(PROGRAM, lambda: _convert(options))


def _convert(options: argparse.Namespace) -> int:
    # Imported here, so that --help needs no yaml.
    from relay_autotune.bag.writer import BagWriter, Topic, encode_float64

    wanted = Selection(
        options.measurement,
        options.command,
        options.time,
        time_unit=options.time_unit,
        period=options.period,
    )
    log, *others = read_csv(options.csv, wanted)
    if others:
        raise BagError(
            f"{options.csv} holds {1 + len(others)} recordings, each with times that start anew; "
            "expected one"
        )
    for note in log.notes:
        say(PROGRAM, f"{options.csv}: {note}")
    measurement, command = log.measurement, log.command
    topics = (
        options.measurement_topic or topic_name(measurement.name),
        options.command_topic or topic_name(command.name),
    )
    for topic in topics:
        if not (topic.startswith("/") and NAME_OF_ROS.match(topic)):
            raise SelectionError(
                f"{topic!r} is not a topic name; expected one like /tank/level, "
                f"given with --measurement-topic and --command-topic"
            )
    epoch_ns = round(options.epoch * 1e9)
    first, last = (epoch_ns + int(measurement.time_ns[place]) for place in (0, -1))
    if not 0 <= first <= last < 2**63:
        raise BagError(
            f"{options.csv} begins at {measurement.time_ns[0] / 1e9:g} s, but a bag has no time "
            f"before 1970 or after 2262; give the date at which its time is zero with --epoch"
        )
    facts = {
        "source": options.csv.name,
        "measurement column": measurement.name,
        "command column": command.name,
    }
    with BagWriter(
        options.bag,
        [Topic(name) for name in topics],
        start_ns=first,
        custom=facts,
    ) as bag:
        rows = [
            (int(time_ns) + epoch_ns, topic, float(value))
            for topic, signal in zip(topics, (measurement, command), strict=True)
            for time_ns, value in zip(signal.time_ns, signal.values, strict=True)
        ]
        # The measurement of a row comes first.
        for time_ns, topic, value in sorted(rows, key=lambda row: row[0]):
            bag.write(topic, time_ns, time_ns, encode_float64(value))
    counts = f"{len(measurement)} messages on {topics[0]}, {len(command)} on {topics[1]}"
    say(PROGRAM, f"{options.bag}: {counts}")
    return DONE


def topic_name(column: str) -> str:
    """Return the topic for a column: its name in lower case, without a unit in brackets."""
    bare = re.sub(r"[(\[].*?[)\]]", "", column).lower()
    name = "_".join(re.findall(r"[a-z0-9]+", bare))
    return f"/{name}" if name[:1].isalpha() else f"/_{name}"
