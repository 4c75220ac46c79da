"""The start of each executable: what is installed begins here, and loads the rest.

Loading takes most of a second, in which there is nothing to tidy up: Ctrl-C ends the process then
as it ends any program, without a traceback. Python's own way is an exception, which shows up
wherever an import just was, and which some callbacks of the import system print and pass over.
Commands ask for that exception once they are at work (`cli.arguments.guarded`), and nodes for
handlers of their own (`nodes.lifetime.run`).
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from functools import partial
from importlib import import_module


def start(module: str) -> int:
    """Load an executable's module and run it.

    :param module: name of one with a function main.
    :return: the exit status.
    """
    # The next file that is opened would take the number of an output that was closed, and with it
    # all that is said there.
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
    # One that was started with SIGINT ignored, as by nohup, goes on ignoring it.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # One that comes in between waits: noted for a handler that is gone, it would be lost.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    status: int = import_module(module).main()
    return status


def command(module: str) -> int:
    """Start a command that takes no part in a ROS graph.

    :param module: name of one with a function main.
    :return: the exit status.
    """
    # As the interpreter ends, the collector would search all that was imported, for nothing, which
    # takes 70 ms. Nodes leave it to do so: it gives back what rclpy holds.
    atexit.register(gc.freeze)
    return start(module)


relay_node = partial(start, "relay_autotune.nodes.relay")
identifier_node = partial(start, "relay_autotune.nodes.identifier")
plant_node = partial(start, "relay_autotune.nodes.plant")
controller_node = partial(start, "relay_autotune.nodes.controller")
tune_loop = partial(start, "relay_autotune.cli.tune_loop")
replay = partial(command, "relay_autotune.cli.replay")
identify = partial(command, "relay_autotune.cli.identify")
tune = partial(command, "relay_autotune.cli.tune")
csv_to_bag = partial(command, "relay_autotune.cli.csv_to_bag")
report = partial(command, "relay_autotune.cli.report")
