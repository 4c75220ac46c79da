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
import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from relay_autotune.cli.arguments import (
    DONE,
    NOTHING_FOUND,
    Parser,
    add_web,
    check_web,
    given_quantities,
    guarded_in_graph,
    say,
)
from relay_autotune.cli.own_nodes import PROGRAM, START_WITHIN
from relay_autotune.cli.settings import FLAGS, SETTINGS, Answers, Kind, add_settings, kind_of
from relay_autotune.cli.terminal import (
    GoBack,
    Signals,
    Working,
    agrees,
    require_new,
    width,
)
from relay_autotune.cli.tune_view import Shown, check_lines
from relay_autotune.errors import SelectionError
from relay_autotune.exchange.export import EXPORTS
from relay_autotune.nodes.shell import prefix, typed_for_parameter
from relay_autotune.text import apart

if TYPE_CHECKING:
    from relay_autotune.cli.loops import Loop

# How long nodes that were found may take to know what they need for a tune [s].
_READY_WITHIN = 30.0


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    given = list(sys.argv[1:] if args is None else args)
    own, ros = apart(given)
    options = _parser().parse_args(own)
    options.typed = given
    try:
        _require_consistent(options)
        _require_no_parameter(options, ros)
        kind = kind_of(options)
    except SelectionError as error:
        options.parser.refuse(str(error))

    def work(graph: ExitStack) -> int:
        with ExitStack() as nodes:
            return Session(options, ros, kind, graph, nodes).run()

    return guarded_in_graph(PROGRAM, work)


def _require_consistent(options: argparse.Namespace) -> None:
    """Refuse options that are out of their range, or contradict each other."""
    given_quantities(options, SETTINGS)
    if options.at is not None:
        Answers(options).take({"at": options.at}, "--at")
    if options.measurement and options.measurement == options.command:
        raise SelectionError(
            f"--measurement and --command are both {options.command}: give the topic of the "
            "sensor, and that of the actuator"
        )
    if options.web and (options.dry_run or options.json or options.report or options.export):
        raise SelectionError(
            "--web has check, result, report and exports on its page: leave out --dry-run, "
            "--json, --report and --output"
        )
    if options.export in EXPORTS:
        raise SelectionError(
            f"--export takes a file; give the program as --law {options.export}, and the file as "
            "--output FILE"
        )
    if options.step is not None and (
        options.verify is False or (options.yes and not options.verify)
    ):
        raise SelectionError(
            "--step is that of the proof, which is not wanted here: give --verify, too"
        )
    if options.verify and (options.web or options.json or options.record_only or options.dry_run):
        raise SelectionError(
            "--verify proves the gains of a tune that prints them: leave out --web, --json, "
            "--record-only and --dry-run"
        )


def _require_no_parameter(options: argparse.Namespace, ros: list[str]) -> None:
    """Refuse a parameter that only relay_node has."""
    for flag, given in pairwise(ros):
        name, is_set, value = given.partition(":=")
        if flag not in ("-p", "--param") or not is_set or name == "use_sim_time":
            continue
        space = (options.namespace or "").strip("/")
        node = "/".join(("", *filter(None, (space, options.node))))
        do = f"give {FLAGS[name]} {value}" if name in FLAGS else "leave it out"
        if name not in FLAGS and not (options.measurement or options.joint):
            do = typed_for_parameter(node, name, value)
        raise SelectionError(f"{flag} {given} sets nothing in relay_node: {do}")


def _parser() -> Parser:
    parser = Parser(
        PROGRAM,
        description=__doc__,
        epilog="Example:\n  tune_loop --namespace tank --amplitude 0.5 --report tank.html",
    )
    add_settings(parser)
    add_web(parser, "serve a page on which tunes are started, watched and ended, until Ctrl-C")
    return parser


@dataclass
class Session:
    """One run of the command, step by step: look, start, find, agree, tune, conclude.

    :param options: of the command line; answers are kept there.
    :param ros: arguments for ROS.
    :param kind: of the loop.
    :param graph: where the clients end.
    :param nodes: where the nodes of the command end, before the clients.
    :param signals: those that end it.
    """

    options: argparse.Namespace
    ros: list[str]
    kind: Kind
    graph: ExitStack
    nodes: ExitStack
    signals: Signals = field(default_factory=Signals)

    def run(self) -> int:
        """Do all steps, and return the exit status."""
        options, signals = self.options, self.signals
        signals.note(signal.SIGINT)
        self._check_files()
        starts = self.kind is not Kind.NODES
        if starts:
            # At once, since what follows takes a second to load.
            what = (options.joint or options.measurement, options.controller or options.command)
            sentence = f"looking at {what[0]} and {what[1]}; nothing is commanded yet"
            print(sentence, file=sys.stderr, flush=True)
        with Working("loading what talks to the nodes", quiet=not starts):
            import relay_autotune.nodes.tune_client  # noqa: F401  see Signals
        if starts or options.dry_run:
            # Nothing commands the process before the plan is agreed to: Ctrl-C may end it here.
            signals.obey()
            signals.raise_if_came()
        loops = self._looked_at()
        patience = max(map(self._find, loops))
        # A sensor that is slower than that needs a longer --wait.
        deadline = time.monotonic() + min(patience, max(options.wait, _READY_WITHIN))
        loop = loops[0]
        asks = (loop.has_own_nodes or options.dry_run) and not options.web
        if asks and not self._is_agreed(loop, deadline):
            return NOTHING_FOUND
        if options.dry_run:
            return DONE
        # Imported here, so that --help does not load rclpy.
        from relay_autotune.nodes.lifetime import ending_signals

        # Until here nothing has started. Ctrl-Z may stop this command; the tune then continues.
        signals.note(signal.SIGINT, *(ending_signals() - {signal.SIGTSTP}))
        signals.raise_if_came()
        if options.web:
            from relay_autotune.cli.tune_page import serve

            return serve(loops, options, signals.came)
        self._tune(loop, deadline)
        return self._concluded(loop)

    def _check_files(self) -> None:
        """Refuse what could not be written or served, before any work is done."""
        options = self.options
        if options.report:
            from relay_autotune.cli.report import check_output, tell_replaced

            check_output(options.report)
            tell_replaced(PROGRAM, options.report)
        if options.export:
            require_new(options.export)
        check_web(options)

    def _looked_at(self) -> list[Loop]:
        """Look at the loops, and ask for what is not given."""
        from relay_autotune.cli.loops import Loop, TopicLoop
        from relay_autotune.nodes.loop_client import LoopClient
        from relay_autotune.nodes.tune_client import TuneClient

        options, ros = self.options, self.ros

        def client(space: str, robot: LoopClient | None = None) -> TuneClient:
            with Working("joining the ROS graph"):
                return self.graph.enter_context(TuneClient(space, options.node, ros, robot))

        # The nodes of this process alone have a namespace of their own.
        own = options.namespace or f"tune_loop_{os.getpid()}"
        if self.kind is Kind.TOPICS:
            return [TopicLoop(client(own), options)]
        if self.kind is not Kind.NODES:
            from relay_autotune.cli.joint_tune import JointLoop

            with Working("joining the ROS graph"):
                robot = self.graph.enter_context(LoopClient(own, "", options.node, ros))
            return [JointLoop(robot, options, client)]
        given = options.namespace or ""
        spaces = given.split(",") if options.web else [given]
        # The loops of a page have settings of their own.
        return [Loop(client(space), argparse.Namespace(**vars(options))) for space in spaces]

    def _find(self, loop: Loop) -> float:
        """Start its nodes, if they are those of the command, and find all; return the patience.

        :return: how long they may take [s].
        """
        options, patience, what = self.options, float(self.options.wait), "looking for"
        if loop.has_own_nodes:
            patience, what = max(patience, START_WITHIN), "starting the nodes for"
            self.nodes.enter_context(loop.nodes)
            for name, arguments in loop.arguments().items():
                loop.nodes.start(name, arguments)
            loop.client.why_lost = loop.nodes.why_lost
            loop.client.why_ended = partial(loop.nodes.why_lost, "relay_node")
        with Working(f"{what} {loop.title}"):
            loop.client.find(
                patience,
                needs_identifier=not (options.dry_run or options.record_only),
                leave=lambda: bool(self.signals.came),
            )
        self.nodes.callback(loop.restore)
        loop.joined()
        return patience

    def _is_agreed(self, loop: Loop, deadline: float) -> bool:
        """Show the plan of a tune, and return whether it is to start; a dry run only shows it."""
        options, may_go_back = self.options, loop.answers.may_go_back
        while True:
            if plan := loop.plan():
                print("\n".join(check_lines(plan, width())), file=sys.stderr, flush=True)
            with Working("looking at the loop"):
                found = loop.check(deadline)
            if not self._may_start(loop, found):
                return False
            if options.dry_run:
                # The option may have been abbreviated, as --dry.
                dry = [w for w in options.typed if len(w) > 2 and "--dry-run".startswith(w)]
                again = [word for word in options.typed if word not in dry]
                if not options.json:
                    print(f"\nNext:\n  {'start it':<26} {prefix()}{shlex.join((PROGRAM, *again))}")
                return True
            try:
                agreed = agrees("Start the tune?", yes=options.yes, back=may_go_back)
            except GoBack:
                loop.ask_again()
                continue
            if not agreed:
                say(PROGRAM, "not started")
            return agreed

    def _may_start(self, loop: Loop, found: Any) -> bool:
        """Show whether a tune could start, and how.

        :param found: the `Tune.Result` of a check, or of a tune that was refused.
        """
        client, options = loop.client, self.options
        may, checks = client.succeeded, loop.checklist(found)
        if options.json and (options.dry_run or not may):
            document = {"accepted": may, "reason": found.reason, "checks": checks}
            print(json.dumps({"node": client.name} | document))
        elif checks:
            shown = "\n".join(check_lines(checks, width()))
            print(shown, flush=True, file=sys.stdout if options.dry_run else sys.stderr)
        if not may:
            say(PROGRAM, f"{loop.title} refuses: {found.reason}")
        return may

    def _tune(self, loop: Loop, deadline: float) -> None:
        """Ask for the tune, and show it until its result is there."""
        from relay_autotune.nodes.lifetime import never_wait_for

        signals, shown = self.signals, Shown(sys.stderr, live=sys.stderr.isatty())
        shown.say(f"tune of {loop.title}; Ctrl-C cancels it")
        with ExitStack() as stack:
            # Signals must work even while writing to standard error would block.
            stack.callback(never_wait_for(sys.stderr.fileno()))
            loop.tune(shown, signals.came, deadline)
            shown.clear()

    def _concluded(self, loop: Loop) -> int:
        """Show the result, and hand over the gains."""
        # Imported here, because it loads slowly and must not delay a tune.
        from relay_autotune.cli.after_tune import AfterTune

        came = self.signals.came
        # The tune is over, so a signal may end the command at once.
        self.signals.obey()
        if loop.has_own_nodes and not loop.client.cancelled:
            # It came as the tune ended: nothing is asked for, or done, after that.
            self.signals.raise_if_came()
        tune = AfterTune(loop)
        if not tune.is_started:
            self._may_start(loop, tune.result)
            return NOTHING_FOUND
        try:
            return tune.conclude()
        except OSError:
            # The terminal is closed.
            if signal.SIGHUP in came:
                return NOTHING_FOUND
            raise
