"""What the commands have in common: arguments, messages and the way they end."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from relay_autotune.errors import RelayAutotuneError, SelectionError

if TYPE_CHECKING:
    from relay_autotune.identification.known import Known

DONE, NOTHING_FOUND, USAGE = 0, 1, 2


def finite(text: str) -> float:
    """Return a finite number given on the command line."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a finite number, found {text}")
    return value


def say(program: str, text: str) -> None:
    """Tell the user something that is no result."""
    print(f"{program}: {text}", file=sys.stderr)


def guarded(program: str, work: Callable[[], int]) -> int:
    """Return the exit status of a command's work; an error becomes one line.

    What the work is known to need is loaded before: from here on Ctrl-C is an exception, so that
    files and processes are left in order, and an import may lose it.

    :param program: name of the command.
    :param work: does it, and returns its exit status.
    """
    left_to_system = signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    try:
        if left_to_system:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        status = work()
        sys.stdout.flush()
    except SelectionError as error:
        say(program, str(error))
        return USAGE
    except RelayAutotuneError as error:
        say(program, str(error))
        return NOTHING_FOUND
    except BrokenPipeError:
        # Whoever read the results has seen enough; nothing may be flushed to it at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOTHING_FOUND
    except KeyboardInterrupt:
        return 130
    finally:
        if left_to_system:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    return status


def add_known(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add the flags that say what is known of the process, which :func:`known_facts` reads.

    :param parser: of the command, or a group of its options.
    """
    parser.add_argument("--gain", type=finite, metavar="K", help="known gain of the process [y/u]")
    parser.add_argument("--dead-time", type=finite, metavar="S", help="known dead time [s]")
    parser.add_argument("--structure", metavar="NAME", default="", help="known structure")
    parser.add_argument("--order", type=int, metavar="N", default=0, help="known number of lags")


def known_facts(options: argparse.Namespace) -> Known:
    """Return what the options say to be known of the process.

    :param options: with gain and dead_time, None where they were not given; structure, order.
    :raises ParameterError: if a value cannot be.
    """
    from relay_autotune.identification.known import Known

    return Known(
        gain=math.nan if options.gain is None else options.gain,
        dead_time=math.nan if options.dead_time is None else options.dead_time,
        structure=options.structure,
        order=options.order,
        loss=getattr(options, "loss", None) or Known.loss,
    )
