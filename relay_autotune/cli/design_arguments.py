# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Options that say what is asked of a controller and where its gains go, for several commands."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from relay_autotune.cli.arguments import add_quantities, finite, given_quantities
from relay_autotune.loop.laws import LAWS
from relay_autotune.quantities import declared
from relay_autotune.tuning.task import CONTROLLERS, DesignOptions

if TYPE_CHECKING:
    from relay_autotune.cli.export import Target


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
    from relay_autotune.cli.export import WITHOUT_LAW

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
    from relay_autotune.cli.export import EXPORTS

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
    from relay_autotune.cli.export import Target

    limits = {n: getattr(options, n) for n in ("command_min", "command_max")}
    given = {n: v for n, v in limits.items() if v is not None}
    dof = options.dof or next(iter(getattr(options, "joint", ())), "joint")
    return Target(node=options.node, dof=dof, **given)
