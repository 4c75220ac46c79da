# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""tune_loop: start a tune on a running relay_node, show its progress, and print the result.

Ctrl-C, or closing the terminal, cancels the tune; the plant then stays at the safe command, and
the recording is kept.
On a terminal the progress is shown in place and in colour (NO_COLOR turns that off), else a line
for each cycle goes to standard error. The result goes to standard output.

Exit status: 0 the tune completed, with gains (of a dry run: it could start); 1 it did not, or no
node is there to do it, or the report was not written; 2 the command line is wrong; 3 the gains are
doubtful. With --verify it is 1, too, where the gains did not pass.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from typing import TYPE_CHECKING, Any, TypeVar

from relay_autotune.cli.arguments import (
    NOTHING_FOUND,
    add_web,
    check_web,
    finite,
    guarded_in_graph,
    say,
)
from relay_autotune.cli.own_nodes import (
    PROGRAM,
    START_WITHIN,
    add_joint,
    add_new_loop,
    is_new_loop,
    is_of_joint,
    nodes_for,
    own_namespace,
    with_flags,
)
from relay_autotune.cli.terminal import Help, Working, agrees, require_new, width
from relay_autotune.cli.tune_view import TICK, Shown, check_lines, follow
from relay_autotune.errors import ParameterError, SelectionError
from relay_autotune.exchange.export import EXPORTS

if TYPE_CHECKING:
    from relay_autotune.nodes.loop_client import LoopClient
    from relay_autotune.nodes.tune_client import TuneClient

_Client = TypeVar("_Client", bound="LoopClient")
# Parts of the checklist's lines on rest while few samples have come, and on the model while
# identifier_node is not discovered.
NOT_KNOWN_YET, NO_MODEL = "not known yet", "no identifier_node"


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    given = list(sys.argv[1:] if args is None else args)
    own, ros = _apart(given)
    parser = _parser()
    options = parser.parse_args(own)
    if options.amplitude < 0.0 or options.wait < 0.0:
        parser.error("--amplitude and --wait are at least 0")
    if options.sample_period is not None and options.sample_period <= 0.0:
        parser.error(f"--sample-period is {options.sample_period:g}, expected more than 0 s")
    if options.web and (options.dry_run or options.json or options.report or options.export):
        parser.error(
            "--web has check, result, report and exports on its page: leave out --dry-run, "
            "--json, --report and --export"
        )
    if options.export in EXPORTS:
        parser.error(f"--export takes a file to write, such as gains.yaml, not {options.export}")
    if options.verify and (options.web or options.json or options.record_only or options.dry_run):
        parser.error(
            "--verify proves the gains of a tune that prints them: leave out --web, --json, "
            "--record-only and --dry-run"
        )
    options.typed = given
    if (options.measurement and options.command) or options.joint:
        # At once, since what follows takes a second to load.
        what = (options.joint or options.measurement, options.controller or options.command)
        told = f"looking at {what[0]} and {what[1]}; nothing is commanded yet"
        print(told, file=sys.stderr, flush=True)
    starts = bool(options.measurement or options.joint)
    with Working("loading what talks to the nodes") if starts else nullcontext():
        import relay_autotune.nodes.tune_client  # noqa: F401  see run_command

    return guarded_in_graph(PROGRAM, lambda graph: _tune(options, ros, graph))


def _apart(given: list[str]) -> tuple[list[str], list[str]]:
    """Return the options of the command, and those that ROS understands."""
    if "--ros-args" not in given:
        return given, []
    start = given.index("--ros-args")
    rest = given[start:]
    end = rest.index("--") if "--" in rest else len(rest)
    return given[:start] + rest[end + 1 :], rest[:end]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description=__doc__,
        formatter_class=Help,
        epilog="Example:\n  tune_loop --namespace tank --amplitude 0.5 --report tank.html",
    )
    parser.add_argument(
        "--amplitude", type=finite, default=0.0, metavar="U",
        help="half the distance of the two commands [u]; default: the node's parameter",
    )  # fmt: skip
    parser.add_argument(
        "--dry-run", action="store_true", help="only ask whether a tune could start, and how"
    )
    parser.add_argument(
        "--namespace", default="", metavar="NS",
        help="namespace of the loop; with --web several, separated by commas",
    )  # fmt: skip
    parser.add_argument(
        "--node", default="relay_node", metavar="NAME", help="name of the relay_node (%(default)s)"
    )
    parser.add_argument(
        "--record-only", action="store_true",
        help="tune without an identifier_node: a recording, and no model",
    )  # fmt: skip
    parser.add_argument(
        "--wait", type=finite, default=5.0, metavar="S",
        help="how long to wait for the nodes [s] (%(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--report", metavar="FILE",
        help="write a report: .html, or a picture: .png, .svg or .pdf",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    add_new_loop(parser)
    add_joint(parser)
    add_web(parser, "serve a page on which tunes are started, watched and ended, until Ctrl-C")
    return parser


def _tune(options: argparse.Namespace, ros: list[str], graph: ExitStack) -> int:
    interrupted: list[int] = []

    def heed(number: int) -> None:
        signal.signal(number, lambda n, _: interrupted.append(n))

    # Only note the signal: an exception could be lost in an import or in a callback of rclpy.
    heed(signal.SIGINT)
    # Imported here, so that --help does not load rclpy.
    from relay_autotune.nodes.lifetime import ending_signals, never_wait_for
    from relay_autotune.nodes.loop_client import LoopClient
    from relay_autotune.nodes.tune_client import TuneClient

    if options.report:
        from relay_autotune.cli.report import check_output

        check_output(PROGRAM, options.report)
    if options.export:
        require_new(options.export)
    if options.web:
        check_web(options)
    of_joint = is_of_joint(options)
    new = of_joint or is_new_loop(options)

    def joined(kind: Callable[..., _Client], *arguments: Any) -> _Client:
        try:
            with Working("joining the ROS graph"):
                found = kind(*arguments)
        except ParameterError as error:
            raise SelectionError(str(error)) from None
        graph.enter_context(found)
        return found

    with ExitStack() as stack:
        patience, robot, joint, nodes = options.wait, None, None, None
        if of_joint:
            from relay_autotune.cli.joint_tune import JointTune

            robot = joined(LoopClient, own_namespace(options), "", options.node, ros)
        if new:
            # Nothing commands the process before the plan is agreed to: Ctrl-C may end it here.
            signal.signal(signal.SIGINT, signal.default_int_handler)
            if interrupted:
                raise KeyboardInterrupt
            joint = JointTune(robot, options) if robot else None
        namespace = own_namespace(options) if new else options.namespace
        spaces = namespace.split(",") if options.web else [namespace]
        clients = [joined(TuneClient, space, options.node, ros, robot) for space in spaces]
        client = clients[0]
        if new:
            nodes = stack.enter_context(joint.nodes() if joint else nodes_for(client, options))
            client.why_lost = nodes.why_lost
            if joint:
                client.left_behind = joint.left_behind
            patience = max(patience, START_WITHIN)
        deadline = time.monotonic() + patience

        for each in clients:
            with Working(f"{'starting' if new else 'looking for'} {each.name}"):
                each.find(
                    patience,
                    needs_identifier=not (options.dry_run or options.record_only),
                    leave=lambda: bool(interrupted),
                )
        if joint:
            joint.show()
        asks_here = not (options.dry_run or options.web)
        if new and asks_here and not _is_agreed(client, options, deadline):
            return NOTHING_FOUND
        heed(signal.SIGINT)
        # Until here nothing has started. Ctrl-Z may stop this command; the tune then continues.
        heeded = ending_signals() - {signal.SIGTSTP}
        for number in heeded:
            heed(number)
        if interrupted:
            raise KeyboardInterrupt
        if options.web:
            from relay_autotune.cli.tune_page import TunePage

            return TunePage(clients, options).run(interrupted)
        shown = Shown(sys.stderr, live=sys.stderr.isatty() and not options.dry_run)
        if not options.dry_run:
            shown.say(f"tune of {client.name}; Ctrl-C cancels it")
        # Signals must work even while writing to standard error would block.
        wait_again = never_wait_for(sys.stderr.fileno())
        opens = joint is not None and not options.dry_run
        try:
            with joint.opened() if joint and opens else nullcontext(lambda _: "") as left:

                def why_over(state: int) -> str:
                    # A relay_node that is lost cannot be asked to end the tune.
                    return left(state) or (nodes.why_lost("identifier_node") if nodes else "")

                while True:
                    client.ask(options.amplitude, options.dry_run)
                    follow(client, shown, interrupted, why_over=why_over)
                    if interrupted or not client.not_ready_yet or time.monotonic() > deadline:
                        break
                    time.sleep(TICK)
                shown.clear()
        finally:
            wait_again()
        # Imported here, because it loads slowly and must not delay a tune.
        from relay_autotune.cli.after_tune import AfterTune

        # The tune is over, so a signal may end the command at once.
        for number in heeded:
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if interrupted and nodes is not None and not client.cancelled:
            # It came as the tune ended: nothing is asked for, or done, after that.
            raise KeyboardInterrupt
        try:
            return AfterTune(client, options, _parser(), nodes, joint).conclude()
        except OSError:
            # The terminal is closed.
            if signal.SIGHUP in interrupted:
                return NOTHING_FOUND
            raise


def _is_agreed(client: TuneClient, options: argparse.Namespace, deadline: float) -> bool:
    """Show the plan of a tune, and return whether it is to start."""
    with Working("looking at the loop"):
        while True:
            checks = list(client.check(options.amplitude).checks)
            # Right after its start the node does not know all of these yet.
            awaited = (NOT_KNOWN_YET,) if options.record_only else (NOT_KNOWN_YET, NO_MODEL)
            lacking = any(text in line for line in checks for text in awaited)
            if not (client.not_ready_yet or lacking):
                break
            if time.monotonic() > deadline:
                break
            time.sleep(TICK)
    shown = check_lines(list(map(with_flags, checks)), width())
    print("\n".join(shown), flush=True, file=sys.stderr)
    if not client.succeeded:
        say(PROGRAM, f"{client.name} refuses: {client.result.reason}")
        return False
    return agrees("Start the tune?", yes=options.yes)


if __name__ == "__main__":
    sys.exit(main())
