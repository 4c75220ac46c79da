"""Options that say what is asked of a controller and where its gains go, for several commands."""

from __future__ import annotations

import argparse
import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.arguments import finite
from relay_autotune.errors import SelectionError, TuningError

if TYPE_CHECKING:
    from relay_autotune.cli.export import Target
    from relay_autotune.tuning.task import DesignOptions

CONTROLLERS = ("auto", "pi", "pid")
EXPORTS = ("pid_controller", "yaml")


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
    number: dict[str, Any] = {"type": finite}
    group.add_argument("--ms", **number, metavar="M", help="largest Ms, 1.2 to 4 (1.4)")
    group.add_argument(
        "--mt", **number, metavar="M", help="largest Mt (1.4, of an integrating process 1.26)"
    )
    group.add_argument(
        "--sample-period", **number, metavar="S", help="period of the controller (0: continuous)"
    )
    group.add_argument(
        "--loop-delay", **number, metavar="S", help="dead time that the loop adds (0)"
    )
    group.add_argument(
        "--lambda",
        dest="closed_loop_time",
        **number,
        metavar="S",
        help="closed-loop time constant of imc, simc and unstable (the rule's own)",
    )
    group.add_argument("--noise-std", **number, metavar="Y", help="measurement noise [y]")
    group.add_argument(
        "--amplitude", **number, metavar="U", help="what a command may move, as the relay's [u]"
    )
    group.add_argument(
        "--noise-share", **number, metavar="R", help="noise in the command over --amplitude (0.1)"
    )
    group.add_argument("--filter-ratio", **number, metavar="N", help="largest td/tf (10)")
    group.add_argument(
        "--phase-peak", **number, metavar="DEG", help="phase peak of luyben2003 (-120)"
    )
    group.add_argument("--resonance", **number, metavar="DB", help="resonance of luyben2003 (2)")


def design_options(options: argparse.Namespace) -> DesignOptions:
    """Return what is asked of a controller.

    :param options: with those of :func:`add_design`.
    :raises SelectionError: if a value is out of its range.
    """
    from relay_autotune.tuning.task import DesignOptions

    names = {f.name for f in fields(DesignOptions)}
    given = {n: v for n, v in vars(options).items() if n in names and v is not None}
    if "phase_peak" in given:
        given["phase_peak"] = math.radians(given["phase_peak"])
    try:
        return DesignOptions(**given)
    except TuningError as error:
        raise SelectionError(str(error).replace("closed_loop_time", "lambda")) from error


def add_export(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the options that say where gains go.

    :param parser: of the command.
    :return: the group that they are in.
    """
    group = parser.add_argument_group("gains as a file")
    group.add_argument(
        "--export", choices=EXPORTS, help="print a file that other programs load instead"
    )
    group.add_argument(
        "--node", default="/pid_controller", metavar="NAME", help="whose file it is (%(default)s)"
    )
    group.add_argument(
        "--dof", default="joint", metavar="NAME", help="its degree of freedom (%(default)s)"
    )
    group.add_argument("--command-min", type=finite, metavar="U", help="lower clamp in it [u]")
    group.add_argument("--command-max", type=finite, metavar="U", help="upper clamp in it [u]")
    return group


def export_target(options: argparse.Namespace) -> Target:
    """Return where gains go.

    :param options: with those of :func:`add_export`.
    :raises SelectionError: if a name or a clamp cannot be.
    """
    from relay_autotune.cli.export import Target

    limits = {n: getattr(options, n) for n in ("command_min", "command_max")}
    given = {n: v for n, v in limits.items() if v is not None}
    return Target(node=options.node, dof=options.dof, **given)
