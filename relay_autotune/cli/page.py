# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What commands with `--web` have in common: its options, and the page with models to shape."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Sequence
from typing import TYPE_CHECKING

from relay_autotune.cli.arguments import as_typed, say
from relay_autotune.errors import MissingPackageError

if TYPE_CHECKING:
    from relay_autotune.loop.gains import Gains
    from relay_autotune.report.case import Case
    from relay_autotune.result import Shaping
    from relay_autotune.web.shape import Asked

_LOOPBACK = "127.0.0.1"


def add_web(
    parser: argparse.ArgumentParser,
    what: str = "also serve a page to shape the gains, until Ctrl-C",
) -> None:
    """Add the options of the page.

    :param parser: of the command.
    :param what: the page does.
    """
    group = parser.add_argument_group("a page in the browser")
    group.add_argument("--web", action="store_true", help=what)
    group.add_argument(
        "--web-address", default=_LOOPBACK, metavar="HOST[:PORT]",
        help="where it is served (%(default)s, any free port); other than on this machine's own "
        "address it asks for a token, which is part of the address that is printed",
    )  # fmt: skip


def check_web(options: argparse.Namespace) -> None:
    """Refuse a page that cannot be served, before any work is done.

    :param options: with those of :func:`add_web`.
    :raises MissingPackageError: if the package that serves it is not installed.
    :raises SelectionError: if its address is none.
    """
    if importlib.util.find_spec("tornado") is None:
        raise MissingPackageError(
            "--web needs the Python package tornado; install it with: pip install tornado, or "
            "apt install python3-tornado"
        )
    from relay_autotune.web.address import address_of

    address_of(options.web_address)


def show(
    program: str,
    parser: argparse.ArgumentParser,
    options: argparse.Namespace,
    models: Sequence[tuple[Case, Shaping | None]],
) -> None:
    """Serve a page with models to shape until Ctrl-C.

    :param program: name of the command.
    :param parser: that of the command.
    :param options: as it parsed them.
    :param models: the experiments, each with what the design of its gains takes.
    :raises SelectionError: if the address cannot be used.
    """
    # Imported here, because it loads slowly and must not delay a tune.
    from relay_autotune.cli.analysis_arguments import export_target
    from relay_autotune.cli.export import exported, exports_of
    from relay_autotune.tuning.task import DesignOptions
    from relay_autotune.web.address import address_of
    from relay_autotune.web.server import Page, run
    from relay_autotune.web.shape import Asked, Subject

    rule, target = options.rule or Asked.rule, export_target(options)

    def subject(case: Case, shaping: Shaping | None) -> Subject:
        first = Asked.of(rule, shaping.task.options if shaping else DesignOptions())

        def command(asked: Asked) -> str:
            changed = asked.changed_from(first) | ({"law": None} if asked.law == "" else {})
            return as_typed(
                program, parser, options, web=None, web_address=None, export=None, **changed
            )

        return Subject(case, shaping, first, command)

    subjects = [subject(case, shaping) for case, shaping in models]

    def written(gains: Gains, how: str, doubt: str) -> str:
        return exported(gains, how, target, doubt=doubt)

    page = Page(subjects, exports_of, written, address_of(options.web_address))
    run(page, lambda url: say(program, f"the page is at {url} until Ctrl-C"))
