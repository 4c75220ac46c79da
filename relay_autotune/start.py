# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The start of each installed executable; it loads the rest.

Loading takes most of a second, with nothing to clean up. So Ctrl-C ends the process at once then,
without a traceback. Python's KeyboardInterrupt would appear in the middle of an import, and some
callbacks of the import system print and ignore it. Commands enable that exception later
(`cli.arguments.run_command`), and nodes install their own handlers (`nodes.lifetime.run`).
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from functools import partial
from importlib import import_module
from importlib.util import find_spec

from relay_autotune.errors import output_refused


def start(module: str, announced: tuple[str, ...] = ()) -> int:
    """Load an executable's module and run it.

    :param module: name of a module with a function main.
    :param announced: arguments with which it first says that it loads, since people wait for it.
    :return: the exit status.
    """
    # A process that was started with SIGINT ignored, as by nohup, keeps ignoring it.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Block SIGINT during the change: a signal noted for the old handler would be lost.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    # If an output is closed, the next opened file would get its number and all its text. So
    # occupy the numbers up to 2.
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
    name = module.rpartition(".")[2]
    if set(announced) & set(sys.argv):
        if find_spec("rclpy") is None:
            # Before it seems that something is looked at.
            sys.stderr.write(f"{name}: {_lacking(ModuleNotFoundError(name='rclpy'))}\n")
            return 1
        sys.stderr.write(f"{name} is loading; nothing is commanded yet\n")
        sys.stderr.flush()
    try:
        status: int = import_module(module).main()
    except ModuleNotFoundError as error:
        # With pip alone there is no ROS; without its extras, neither what draws nor what records.
        sys.stderr.write(f"{name}: {_lacking(error)}\n")
        return 1
    except OSError as error:
        if not output_refused(name, error):
            raise
        return 1
    return status


def _lacking(error: ModuleNotFoundError) -> str:
    """Return what to install where a package is missing.

    :raises ModuleNotFoundError: if it is one of our own modules, which is a defect.
    """
    name = (error.name or "").partition(".")[0]
    extra = next((extra for extra, names in _EXTRAS.items() if name in names), "")
    if name in ("", "relay_autotune"):
        raise error
    if extra:
        return f"it needs the Python package {name}: pip install '.[{extra}]' in the repository"
    return f"it needs ROS 2 Jazzy with {name}: `make setup` and `. ./env.sh` in the repository"


# The extras of setup.py, with the names under which they are imported.
_EXTRAS = {"report": ("jinja2", "markupsafe", "matplotlib"), "bags": ("mcap", "yaml")}


def command(module: str) -> int:
    """Start a command that is not part of a ROS graph.

    :param module: name of a module with a function main.
    :return: the exit status.
    """
    # Without this, the garbage collector would search all imported objects at the end, for 70 ms.
    # Nodes need that search, because it frees the objects of rclpy.
    atexit.register(gc.freeze)
    return start(module)


relay_node = partial(start, "relay_autotune.nodes.relay")
identifier_node = partial(start, "relay_autotune.nodes.identifier")
plant_node = partial(start, "relay_autotune.nodes.plant")
controller_node = partial(start, "relay_autotune.nodes.controller")
simulated_loop = partial(start, "relay_autotune.cli.simulated_loop")
tune_loop = partial(start, "relay_autotune.cli.tune_loop", announced=("--measurement", "--joint"))
apply_gains = partial(start, "relay_autotune.cli.apply_gains")
replay = partial(command, "relay_autotune.cli.replay")
identify = partial(command, "relay_autotune.cli.identify")
tune = partial(command, "relay_autotune.cli.tune")
csv_to_bag = partial(command, "relay_autotune.cli.csv_to_bag")
report = partial(command, "relay_autotune.cli.report")
