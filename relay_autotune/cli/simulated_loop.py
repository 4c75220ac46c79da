# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""simulated_loop: a loop to try everything on, which needs neither a plant nor `ros2 launch`.

It starts plant_node, controller_node, relay_node and identifier_node with the parameters of the
tutorial, and ends them on Ctrl-C. In a terminal it asks for set-points meanwhile, and shows for
ten seconds what each of them does.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from relay_autotune.cli.arguments import DONE, Parser, run_command
from relay_autotune.cli.own_nodes import START_WITHIN, OwnNodes
from relay_autotune.cli.terminal import Working, number_of
from relay_autotune.errors import LoopError, RelayAutotuneError, SelectionError

PROGRAM = "simulated_loop"
NODES = ("controller_node", "relay_node", "identifier_node", "plant_node")
# How long the answer to a set-point is shown [s].
_SHOWN = 10


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    options = _parser().parse_args(args)
    import relay_autotune.nodes.loop_client  # noqa: F401  see run_command

    return run_command(PROGRAM, lambda: _run(options))


def _parser() -> Parser:
    parser = Parser(
        PROGRAM,
        description=__doc__,
        epilog="Then, in another terminal:\n  tune_loop",
    )
    parser.add_argument(
        "--params", type=Path, metavar="FILE",
        help="parameters of the four nodes; default: config/tutorial.yaml of the package",
    )  # fmt: skip
    return parser


def _run(options: argparse.Namespace) -> int:
    file = options.params or installed("tutorial.yaml")
    if not file.is_file():
        # ROS itself would only warn, and start the nodes with their defaults.
        raise SelectionError(f"--params {file}: there is no such file")
    try:
        with OwnNodes() as nodes:
            for name in NODES:
                nodes.start(name, ["--params-file", str(file)])
            _serve(nodes)
    except KeyboardInterrupt:
        print("\nended")
    return DONE


def installed(name: str) -> Path:
    """Return a file of the package's folder config, as it is installed."""
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        return Path(get_package_share_directory("relay_autotune"), "config", name)
    except PackageNotFoundError:
        raise RelayAutotuneError(
            f"config/{name} is not installed: enter the environment with `. ./env.sh`, or source "
            f"the workspace, or give --params FILE"
        ) from None


def _serve(nodes: OwnNodes) -> None:
    """Show the loop and take set-points, until Ctrl-C."""
    from std_msgs.msg import Float64

    from relay_autotune.nodes.loop_client import LoopClient

    with LoopClient(PROGRAM, "", "relay_node") as client:

        def now(seconds: float) -> float:
            came: list[Float64] = client.heard(Float64, "/measurement", bool, least=seconds)
            if not came:
                raise LoopError("plant_node publishes no measurement")
            return float(came[-1].data)

        client.why_lost = nodes.why_lost
        topics = ("/measurement", "/command")
        with Working("starting the nodes"):
            if not client.wait(lambda: all(map(client.has_publisher, topics)), START_WITHIN):
                raise LoopError(f"the nodes have not started within {START_WITHIN:g} s")
        print(f"{', '.join(NODES)} run; the measurement is {now(0.1):.2f} y; Ctrl-C ends them")
        while sys.stdin.isatty():
            try:
                typed = input("new set-point [y], or Enter to look: ").strip()
            except EOFError:
                break
            wanted = number_of(typed)
            if typed and wanted is None:
                print(f"{typed} is no number; type one such as 40.5")
                continue
            if wanted is None:
                print(f"  measurement {now(0.1):.2f} y")
                continue
            with client.publishing(Float64(data=wanted), "/setpoint") as publish:
                publish()
            for second in range(1, _SHOWN + 1):
                print(f"  {second:2d} s  measurement {now(1.0):.2f} y", flush=True)
        sys.stdout.flush()
        client.rest(math.inf)
