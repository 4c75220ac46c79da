# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the commands have in common: options, messages, the way they end, the page of --web."""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from relay_autotune.cli.terminal import Help, broken, end_with_terminal, keep_output, width
from relay_autotune.errors import (
    MissingPackageError,
    ParameterError,
    RelayAutotuneError,
    SelectionError,
    defect,
    output_refused,
)
from relay_autotune.quantities import Quantity
from relay_autotune.text import visible

if TYPE_CHECKING:
    from relay_autotune.web.address import Address

DONE, NOTHING_FOUND, USAGE, DOUBTFUL = 0, 1, 2, 3
# From best to worst; a command for several bags ends with the worst of their statuses.
_WORSE = (DONE, DOUBTFUL, NOTHING_FOUND, USAGE)


def worst(*statuses: int) -> int:
    """Return the worst of several exit statuses.

    :param statuses: at least one.
    """
    return max(statuses, key=_WORSE.index)


def exit_status(*, found: bool, doubtful: bool) -> int:
    """Return the exit status that a result deserves.

    :param found: whether there is what was asked for.
    :param doubtful: whether it is doubtful.
    """
    if not found:
        return NOTHING_FOUND
    return DOUBTFUL if doubtful else DONE


_NEGATIVE = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\Z|-inf|-nan")


class Parser(argparse.ArgumentParser):
    """The command line of a command. What is wrong with it is said in one line.

    The options that it parses hold it as ``parser``, see :func:`as_typed`.

    :param program: name of the command.
    :param others: as for :class:`argparse.ArgumentParser`.
    """

    def __init__(self, program: str, **others: Any) -> None:
        super().__init__(program, formatter_class=Help, **others)
        # Without it -1e-3 is taken for an option.
        self._negative_number_matcher = _NEGATIVE
        self.set_defaults(parser=self)

    def print_help(self, file: Any = None) -> None:
        """Print the help; an output that takes none is an error, which argparse would ignore.

        :param file: to which it is written; None: standard output.
        """
        print(self.format_help(), end="", file=file, flush=True)

    def error(self, message: str) -> NoReturn:
        """Refuse the command line, and say where it is read what it takes.

        :param message: what is wrong.
        """
        self.refuse(f"{message}; {self.prog} --help shows what it takes")

    def refuse(self, message: str) -> NoReturn:
        """End the process with status 2.

        :param message: what is wrong, and what to do.
        """
        say(self.prog, message)
        sys.exit(USAGE)


# Set to anything in the environment, it lets a defect end a command with its traceback.
DEBUG = "RELAY_AUTOTUNE_DEBUG"


def finite(text: str) -> float:
    """Return a finite number given on the command line."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a finite number, found {text.strip()}")
    return value


def step_height(text: str) -> float:
    """Return the height of a step given on the command line."""
    value = finite(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError("expected a step up or down, found 0")
    return value


def say(program: str, text: str) -> None:
    """Write a message that is not a result to standard error: one line, broken on a terminal.

    :param program: name of the command.
    :param text: the message; control characters in it are made visible.
    """
    message = visible(f"{program}: {text}", keep="\n")
    if sys.stderr.isatty():
        # A terminal would break lines within words.
        message = "\n".join("\n".join(broken(line, width())) for line in message.split("\n"))
    print(message, file=sys.stderr)


def run_command(program: str, work: Callable[[], int]) -> int:
    """Return the exit status of a command's work; an error becomes one line.

    Import what the work needs before: from here on Ctrl-C is an exception, so that files and
    processes are left in order, but an exception may be lost in an import.

    :param program: name of the command.
    :param work: does it, and returns its exit status.
    """
    left_to_system = signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    try:
        if left_to_system:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        status = work()
        sys.stdout.flush()
    except (SelectionError, ParameterError) as error:
        say(program, str(error))
        return USAGE
    except RelayAutotuneError as error:
        say(program, str(error))
        return NOTHING_FOUND
    except KeyboardInterrupt:
        return 130
    except ModuleNotFoundError:
        # The start of the executable says what to install.
        raise
    except Exception as error:
        if output_refused(program, error):
            return NOTHING_FOUND
        if os.environ.get(DEBUG):
            raise
        say(program, f"stopped by {defect(error)}")
        return NOTHING_FOUND
    finally:
        if left_to_system:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    return status


_Client = TypeVar("_Client")


class Graph(ExitStack):
    """The clients of a command in the ROS graph.

    :ivar joined: True: it has, or had, at least one.
    """

    joined = False

    def enter_context(self, cm: AbstractContextManager[_Client]) -> _Client:
        """Enter a client, which is left at the end."""
        self.joined = True
        return super().enter_context(cm)


def guarded_in_graph(program: str, work: Callable[[ExitStack], int]) -> int:
    """Return the exit status of a command that talks to nodes, as `run_command`; leave the graph.

    :param program: name of the command.
    :param work: does it, and returns its exit status; the clients that it enters into the stack
        end afterwards.
    """
    end_with_terminal()
    keep_output()
    with Graph() as graph:
        status = run_command(program, lambda: work(graph))
        if graph.joined:
            # Imported here, because other commands do not need ROS.
            from relay_autotune.nodes.lifetime import end_soon

            end_soon(status)
    return status


_KINDS: dict[type, Callable[[str], Any]] = {int: int, float: finite}


def typed_as(quantity: Quantity) -> Quantity:
    """Return a quantity in the unit of the command line: angles are in degrees."""
    if quantity.unit != "rad":
        return quantity
    numbers = {n: math.degrees(getattr(quantity, n)) for n in ("default", "lower", "upper")}
    return replace(quantity, unit="deg", **numbers)  # type: ignore[arg-type]


def flag_of(quantity: Quantity) -> str:
    """Return the flag that sets a quantity, such as --loop-delay."""
    return "--" + (quantity.flag or quantity.name).replace("_", "-")


def add_quantities(
    parser: argparse.ArgumentParser | argparse._ArgumentGroup, quantities: Iterable[Quantity]
) -> None:
    """Add a flag for each of some quantities; :func:`given_quantities` reads them.

    :param parser: of the command, or a group of its options.
    :param quantities: what the flags set.
    """
    for each in map(typed_as, quantities):
        default = ""
        if each.is_number and math.isfinite(each.default):  # type: ignore[arg-type]
            default = f" ({each.default:g})"
        text = each.description.removesuffix(".").replace("NaN:", "not given:")
        parser.add_argument(
            flag_of(each),
            dest=each.name,
            type=_KINDS.get(type(each.default), str),
            metavar=each.unit.upper() if each.unit else "N" if each.is_number else "NAME",
            help=f"{text[0].lower()}{text[1:]}{default}".replace("%", "%%"),
        )


def given_quantities(
    options: argparse.Namespace, quantities: Iterable[Quantity]
) -> dict[str, Any]:
    """Return the values that were given on the command line, by the quantities' names.

    :param options: with the flags of :func:`add_quantities`.
    :param quantities: what the flags set.
    :raises SelectionError: if a value is out of its range.
    """
    given = {}
    for each in quantities:
        value, typed = getattr(options, each.name), typed_as(each)
        if value is None:
            continue
        # NaN is not allowed here: a flag that is not given is left out.
        asked = replace(typed, default=type(typed.default)()) if typed.is_number else typed
        problem = asked.problem(value)
        if problem is not None:
            raise SelectionError(flag_of(typed) + problem.removeprefix(typed.name))
        given[each.name] = value if typed is each else math.radians(value)
    return given


def as_typed(options: argparse.Namespace, **changed: Any) -> str:
    """Return the command line that gives some options, without those that have their defaults.

    :param options: as a :class:`Parser` parsed them.
    :param changed: other values of some of them, by name; None: left out.
    """
    values = vars(options) | changed
    flags: list[str] = []
    given: list[str] = []
    written = set()
    for action in options.parser._actions:
        value = values.get(action.dest)
        if action.dest in written or value is None or value == action.default:
            continue
        written.add(action.dest)
        words = [_typed(each) for each in (value if isinstance(value, list) else [value])]
        option = action.option_strings[-1] if action.option_strings else ""
        if not option:
            given += words
        elif action.nargs is None:
            # One that may be given several times has its name before each value.
            for word in words:
                flags += [option, word]
        else:
            flags += [option, *(words if action.nargs else [])]
    return shlex.join([options.parser.prog, *given, *flags])


def _typed(value: Any) -> str:
    return f"{value:.12g}" if isinstance(value, float) else str(value)


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
        "--web-address", type=_address, metavar="HOST[:PORT]",
        help="where it is served (127.0.0.1, any free port); other than on this machine's own "
        "address it asks for a token, which is part of the address that is printed",
    )  # fmt: skip


def _address(text: str) -> Address:
    # What reads an address takes a while to load.
    from relay_autotune.web.address import address_of

    try:
        return address_of(text)
    except SelectionError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def check_web(options: argparse.Namespace) -> None:
    """Refuse a page that cannot be served, or an address without one, before any work is done.

    :param options: with those of :func:`add_web`.
    :raises SelectionError: if there is an address alone.
    :raises MissingPackageError: if the package that serves a page is not installed.
    """
    if options.web_address and not options.web:
        raise SelectionError("--web-address is that of a page: give --web, too")
    if options.web and importlib.util.find_spec("tornado") is None:
        raise MissingPackageError(
            "--web needs the Python package tornado; install it with: pip install tornado, or "
            "apt install python3-tornado"
        )
