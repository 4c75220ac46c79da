# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Kills of controller_node at random moments of apply and verify, and which gains follow.

Usage, after `. ./env.sh`:

    python3 benchmarks/controller_kills.py [--runs 200] [--minutes 60] [--quick]

Each run offers other gains, calls ~/apply and, where that has answered, ~/verify, kills the node
with SIGKILL at a random moment, starts it again and looks at the gains: those of this node in a
loop that is stepped by hand (see test/support/hand_loop.py), and those of another node in a loop
in real time (test/support/remote_loop.py). The gains on trial would fail, so that only those of
before are right; another node also keeps gains that were applied and whose verification had not
begun, or ended without a verdict. Half of the runs are of each kind. Exit status 1 if other gains
are in force.
"""

from __future__ import annotations

import argparse
import math
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from markdown import table
from rclpy.action import ActionClient
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

# The rig and the loops are those of the tests.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from hand_loop import HandLoop
from loop_rig import Process, Rig
from remote_loop import VERDICT, Loop
from ros_domain import free_domain, remove_unmapped

from relay_autotune_msgs.action import Verify
from relay_autotune_msgs.msg import PidGains, TransferFunction

RUNS = 200
# Kills come at a random moment between the call of ~/apply and this time after it [s].
WITHIN = 2.5
SILENT = "any; no answer"
APPLY, BETWEEN, VERIFY, FAILED = "apply", "between", "verify", "after a failure"
# A loop that stands still on a busy machine ends a verification without a verdict.
NO_VERDICT = "after no verdict"
PHASES = (APPLY, BETWEEN, VERIFY, FAILED, NO_VERDICT, SILENT)
# A process that has seen many peers die may hear nobody any more: kills until new ones come.
EACH = 25


@dataclass(frozen=True)
class Kill:
    """A kill and its result.

    :param kind: whose gains: ``own``, or those of ``another`` node.
    :param phase: what had been asked for and had not been answered.
    :param seconds: from the start of the next process until the gains were seen in force.
    :param problem: which gains were in force where they must not; empty: none.
    """

    kind: str
    phase: str
    seconds: float
    problem: str


class Course:
    """Apply and verify, as far as they come until a moment.

    :param rig: the rig.
    :param go_on: lets the loop go on for a moment.
    """

    def __init__(self, rig: Rig, go_on: Callable[[], Any]) -> None:
        self.rig = rig
        self.go_on = go_on
        self.apply = rig.node.create_client(Trigger, "controller_node/apply")
        self.verify = ActionClient(rig.node, Verify, "controller_node/verify")

    def until(self, moment: float, height: float) -> str:
        """Call ~/apply, then ~/verify, and return what was being done at a moment."""
        self.rig.until(lambda: self.apply.service_is_ready(), "the service")
        self.rig.until(self.verify.server_is_ready, "the action")
        deadline = time.monotonic() + moment
        applied, sent, answer = self.apply.call_async(Trigger.Request()), None, None
        steps: list[Any] = []
        while time.monotonic() < deadline:
            self.go_on()
            if sent is None and applied.done():
                assert applied.result().success, applied.result().message
                goal = Verify.Goal(setpoint_step=height)
                sent = self.verify.send_goal_async(goal, feedback_callback=steps.append)
            elif sent is not None and sent.done() and answer is None:
                answer = sent.result().get_result_async()
        if not applied.done():
            return APPLY
        if answer is not None and answer.done():
            went_back = answer.result().result.reason.endswith("again")
            return FAILED if went_back else NO_VERDICT
        # Until a step has begun, the verification may not have.
        return VERIFY if any(s.feedback.elapsed > 0.0 for s in steps) else BETWEEN


@contextmanager
def rig_of_its_own() -> Iterator[Rig]:
    """Yield a rig in a domain of its own."""
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        rig = Rig(domain, Path(folder))
        try:
            yield rig
        finally:
            rig.close()


def kill(process: Process) -> None:
    """Kill a process, and remove the shared memory that it leaves."""
    process.signal(signal.SIGKILL)
    process.wait()
    remove_unmapped(process.segments)


def kills_of(
    stretch: Callable[[Iterable[int], float], Iterator[Kill]], runs: int, deadline: float
) -> list[Kill]:
    """Return the kills of one kind, with new processes for each stretch of them."""
    found: list[Kill] = []
    while len(found) < runs and time.monotonic() < deadline:
        try:
            counts = range(len(found), min(len(found) + EACH, runs))
            for kill in stretch(counts, deadline):
                found.append(kill)
        except AssertionError as error:
            print(str(error).splitlines()[0], file=sys.stderr)
            found.append(Kill(stretch.__name__, SILENT, math.nan, ""))
    return found


def own(counts: Iterable[int], deadline: float) -> Iterator[Kill]:
    """Kill a node that controls: it must start with the gains that it had proven."""
    with rig_of_its_own() as rig:
        loop = HandLoop(rig, kc=0.3, ti=1.0)
        loop.apply(0.5, 0.6, "proven")
        result = loop.verify(setpoint_step=0.3)
        assert result.verdict == result.PASSED, result.reason
        course = Course(rig, loop.step)
        for count in counts:
            if time.monotonic() > deadline:
                break
            random = Random(f"own {count}")
            loop.step(120)
            # For a process with a third of the gain that it has.
            loop.offer(0.9 + 1e-4 * count, 0.3, f"tried {count}", gain=0.7)
            phase = course.until(random.uniform(0.0, WITHIN), 0.3)
            kill(loop.node)
            begun = time.monotonic()
            loop.start()
            kc, ti = loop.gains_shown()
            right = (kc, ti) == (0.5, 0.6)
            taken = time.monotonic() - begun
            yield Kill("own", phase, taken, "" if right else f"kc {kc}, ti {ti}")


def another(counts: Iterable[int], deadline: float) -> Iterator[Kill]:
    """Kill a node that sets another node's gains: that node must get back its previous gains."""
    with rig_of_its_own() as rig:
        loop = Loop(rig)
        before = loop.values()
        setpoint = rig.node.create_publisher(Float64, "setpoint", 10)
        course = Course(rig, lambda: rig.executor.spin_once(timeout_sec=0.01))
        model = TransferFunction(final=True, verdict=VERDICT, dead_time=0.1)
        model.numerator, model.denominator = [0.6], [0.3, 1.0]
        loop.models.publish(model)
        for count in counts:
            if time.monotonic() > deadline:
                break
            random = Random(f"another {count}")
            rig.until(lambda: setpoint.get_subscription_count() >= 3, "both controllers")
            setpoint.publish(Float64(data=5.0))
            name = f"tried {count}"
            kc = 0.8 + 1e-4 * count
            gains = PidGains(final=True, verdict=VERDICT, kc=kc, ti=0.3, b=1.0)
            gains.experiment_id = name
            loop.gains.publish(gains)
            rig.until(lambda name=name: f"gains of {name} wait" in loop.controller.log, name)
            rig.run_for(2.0)
            phase = course.until(random.uniform(0.0, WITHIN), 0.5)
            kill(loop.controller)
            begun = time.monotonic()
            loop.start()
            # Gains stay if ~/apply was finished and no verification was running or has failed.
            stay = phase in (BETWEEN, NO_VERDICT)
            allowed = [before, [kc, kc / 0.3, 0.0]] if stay else [before]
            values: list[float] = []

            def are_right(values: list[float] = values, right: Any = allowed) -> bool:
                values[:] = loop.values()
                return values in right

            try:
                rig.until(are_right, "the gains of before")
            except AssertionError:
                if not values:
                    raise
            problem = "" if values in allowed else str(values)
            yield Kill("another", phase, time.monotonic() - begun, problem)
            if values != before:
                loop.trigger("revert")


def rows(kills: list[Kill]) -> list[tuple[object, ...]]:
    """Return a row of the table for each kind of gains and moment."""
    found = []
    for kind in dict.fromkeys(kill.kind for kill in kills):
        for phase in PHASES:
            some = [kill for kill in kills if (kill.kind, kill.phase) == (kind, phase)]
            if some:
                times = [kill.seconds for kill in some]
                wrong = sum(1 for kill in some if kill.problem)
                shown = (f"{np.median(times):.1f}", f"{max(times):.1f}")
                shown = ("-", "-") if phase == SILENT else shown
                found.append((kind, phase, len(some), wrong, *shown))
    return found


def main() -> int:
    """Kill and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=RUNS, help="kills, of both kinds together")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after so long")
    parser.add_argument("--quick", action="store_true", help="two kills of each kind")
    asked = parser.parse_args()
    runs = 2 if asked.quick else asked.runs // 2
    deadline = time.monotonic() + 60.0 * asked.minutes
    kills = [kill for work in (own, another) for kill in kills_of(work, runs, deadline)]
    headings = (
        *("gains", "killed in", "kills", "other gains than before"),
        *("start to gains, median [s]", "longest [s]"),
    )
    print(table(headings, rows(kills)))
    for kill in kills:
        if kill.problem:
            print(f"{kill.kind}, {kill.phase}: {kill.problem}", file=sys.stderr)
    return 1 if any(kill.problem for kill in kills) else 0


if __name__ == "__main__":
    sys.exit(main())
