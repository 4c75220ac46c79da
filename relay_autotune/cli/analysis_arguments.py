# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Options of several commands: which part of a recording, how to identify, what to design."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from relay_autotune.analysis import Task
from relay_autotune.bag.limits import LARGEST_CHUNK
from relay_autotune.bag.signals import CLOCKS, TIME_UNITS, Selection
from relay_autotune.cli.arguments import add_quantities, finite, given_quantities
from relay_autotune.cli.export import EXPORTS, WITHOUT_LAW, Target
from relay_autotune.cli.replay_bag import Job
from relay_autotune.errors import RelayAutotuneError, SelectionError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import ONLY_JOINT
from relay_autotune.loop.laws import LAWS
from relay_autotune.quantities import declared
from relay_autotune.text import visible
from relay_autotune.tuning.task import CONTROLLERS, DesignOptions


def add_design(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what is asked of a controller.

    :param parser: of the command.
    """
    group = parser.add_argument_group("what is asked of the controller")
    kind = group.add_mutually_exclusive_group()
    kind.add_argument(
        "--controller", choices=CONTROLLERS, help="auto is PI unless the rule finds PID worth it"
    )
    for each in ("pi", "pid"):
        kind.add_argument(
            f"--{each}",
            dest="controller",
            action="store_const",
            const=each,
            help=f"the same as --controller {each}",
        )
    add_quantities(group, (each for each in declared(DesignOptions) if each.name != "controller"))


def design_options(options: argparse.Namespace) -> DesignOptions:
    """Return what is asked of a controller.

    :param options: with those of :func:`add_design`.
    :raises SelectionError: if a value is out of its range.
    """
    given = given_quantities(options, declared(DesignOptions))
    export = getattr(options, "export", None)
    if "law" not in given and export in LAWS and export != WITHOUT_LAW:
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
        choices=EXPORTS,
        metavar="LAW",
        help="print a file that other programs load instead: yaml, or of a law of --law, which "
        "needs not be named again",
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
    limits = {n: getattr(options, n) for n in ("command_min", "command_max")}
    given = {n: v for n, v in limits.items() if v is not None}
    dof = options.dof or next(iter(getattr(options, "joint", ())), "joint")
    return Target(node=options.node, dof=dof, **given)


def add_analysis(parser: argparse.ArgumentParser) -> None:
    """Add options: what is taken from a recording, how it is identified and tuned.

    :param parser: of the command.
    """
    taken = parser.add_argument_group("what is taken from a recording")
    for signal in ("measurement", "command"):
        taken.add_argument(
            f"--{signal}",
            metavar="TOPIC[:FIELD]",
            help=f"topic, or column of a CSV, of the {signal}",
        )
    add_times(taken)
    taken.add_argument(
        "--start", type=finite, metavar="S", help="leave out what is before S [s from the start]"
    )
    taken.add_argument(
        "--end", type=finite, metavar="S", help="leave out what is after S [s from the start]"
    )
    taken.add_argument(
        "--command-before", type=finite, metavar="U",
        help="command that held before the recording, where that begins with its step",
    )  # fmt: skip
    taken.add_argument(
        "--clock", choices=CLOCKS, default=CLOCKS[0],
        help="time of a message: when it was published, when it was recorded, or its header's "
        "stamp (%(default)s)",
    )  # fmt: skip
    taken.add_argument(
        "--join", action="store_true", help="take all BAGs as one recording on one timeline"
    )
    taken.add_argument(
        "--joint", action="append", default=[], metavar="NAME",
        help="find measurement and command of this joint by its name; of several, one after the "
        "other",
    )  # fmt: skip
    taken.add_argument(
        "--joint-order", metavar="NAME,NAME,...",
        help="joints of commands that do not name them, as in the controller's parameter joints",
    )  # fmt: skip
    taken.add_argument(
        "--jointly", action="store_true",
        help="take all experiments as tests of one process, with one model",
    )  # fmt: skip
    taken.add_argument(
        "--max-chunk", dest="largest_chunk", type=_size, metavar="SIZE", default=LARGEST_CHUNK,
        help="leave out chunks that declare more than SIZE, such as 64M or 2G "
        f"({LARGEST_CHUNK >> 20}M)",
    )  # fmt: skip
    how = parser.add_argument_group("identification and design")
    how.add_argument("--method", default="waveform", help="how to identify (%(default)s)")
    add_quantities(how, declared(Known))
    how.add_argument("--rule", default="robust", help="how to tune (%(default)s)")
    add_design(parser)


def add_times(parser: argparse._ActionsContainer) -> None:
    """Add options: what a CSV file does not say of its times.

    :param parser: of the command, or a group of its options.
    """
    parser.add_argument("--time", metavar="NAME", help="column of the time of a CSV")
    parser.add_argument(
        "--time-unit", choices=TIME_UNITS, help="its unit, where the CSV does not say it (s)"
    )
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
    return [
        Job(
            name=visible(", ".join(group) + (f" {joint}" if joint else "")),
            paths=group,
            selection=Selection(**taken | {"joint": joint, "joint_order": order}),
            task=task,
            jointly=jointly,
            table_width=table_width,
        )
        for group in groups
        for joint in joints
        if group
    ]


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
