# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Checks of graph, controller, actuator and clock while a tune runs."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

from rclpy.node import Node
from rclpy.subscription import Subscription

from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.nodes.lifetime import STEADY

# Interval of the checks [s]; the graph is checked once in _GRAPH_EVERY of them.
LOOK_EVERY = 0.05
_GRAPH_EVERY = 4
# Name that the middleware gives to a publisher whose node is not discovered yet.
_UNKNOWN = "NODE_NAME_UNKNOWN"

# Longest time for which the samples' time may stand still: a multiple of measurement_timeout or
# repeat_period, and at least a number of seconds. Then the largest ratio of steady time to the
# samples' time: for gaps in the samples, and for the clock of a simulation.
_STANDING, _LEAST_STANDING = 2.0, 5.0
_SLACK, _SLACK_SIMULATED = 3.0, 100.0

# A slow actuator under a fast relay missed the level in 3 of its last 6 half cycles.
_STAYS = 6
_MISSED = 3


class FollowWatch:
    """Recognise an actuator that does not follow, from a feedback of its position.

    The actuator is faulty if its position is outside the tolerance for longer than the timeout.
    If the relay switches faster than that, it is faulty when both are true: it missed the level in
    three of the last six half cycles, and it followed no switch for the timeout. The second
    condition excuses positions that a busy machine delivers late.

    :param tolerance: returns the largest distance that counts as "at the command" [u]; called at
        each position.
    :param timeout: longest time that the actuator may take [s].
    """

    def __init__(self, tolerance: Callable[[], float], timeout: float) -> None:
        self._tolerance = tolerance
        self._timeout = timeout
        self._command = math.nan
        self._since = -math.inf
        self._came = True
        self._stays: deque[bool] = deque(maxlen=_STAYS)
        self._followed = math.nan
        self._position = math.nan
        self._ends: dict[float, float] = {}

    @property
    def rail(self) -> str:
        """Sentence part for an actuator that moves but always stops short of the command."""
        ends = {**self._ends, self._command: self._position}
        told = sorted(command for command in ends if not math.isnan(command))
        if len(told) < 2:
            return ""
        low, high = told[0], told[-1]
        moved = ends[high] - ends[low]
        if not 0.0 < moved < high - low - self._tolerance():
            return ""
        return (
            f"; it moves between {ends[low]:g} and {ends[high]:g} only: it is clipped there, give "
            f"command_min and command_max within these"
        )

    def add(self, now: float, command: float, position: float) -> bool:
        """Take a position; return True if the actuator does not follow.

        :param now: the time [s].
        :param command: the command in force [u].
        :param position: the reported position [u].
        """
        if command != self._command:
            self._ends[self._command] = self._position
            if math.isnan(self._followed):
                self._followed = now
            self._stays.append(self._came)
            self._command, self._since, self._came = command, now, False
        self._position = position
        if abs(position - command) <= self._tolerance():
            if not self._came and self._stays[-1]:
                self._followed = now
            self._came, self._since = True, now
            return False
        if now - self._since > self._timeout:
            return True
        late = now - self._followed > self._timeout
        return late and self._stays.count(False) >= _MISSED


class Guard:
    """Check the graph, the controller and the actuator every 50 ms while a tune runs.

    :param node: the node that tunes.
    :param stop: called with the reason when a check ends the tune.
    """

    def __init__(self, node: Node, stop: Callable[[str], None]) -> None:
        self._stop = stop
        self._looks = 0
        self._checks: list[Callable[[], str]] = []
        self._timer = node.create_timer(LOOK_EVERY, self._look, clock=STEADY, autostart=False)

    def begin(self, checks: list[Callable[[], str]]) -> None:
        """Start the checks.

        :param checks: each returns a reason to end the tune, or "".
        """
        self._checks, self._looks = checks, 0
        self._timer.reset()

    def end(self) -> None:
        """Stop the checks."""
        self._checks = []
        self._timer.cancel()

    def every_look_at_the_graph(self, check: Callable[[], str]) -> Callable[[], str]:
        """Run a check less often, since it queries the middleware."""
        return lambda: check() if self._looks % _GRAPH_EVERY == 0 else ""

    def _look(self) -> None:
        self._looks += 1
        for check in self._checks:
            reason = check()
            if reason:
                self._stop(reason)
                return


def second_publisher(node: Node, topic: str) -> str:
    """Return a sentence if another node publishes a topic of the node, else "".

    :param node: the node.
    :param topic: resolved name of a topic that it publishes.
    """
    if node.count_publishers(topic) <= 1:
        return ""
    who = _publishers(node, topic)
    mine = node.get_fully_qualified_name()
    if mine in who:
        who.remove(mine)
    return f"{topic} is also published by {_named(who)}: two of them would fight for the actuator"


def second_source(node: Node, subscription: Subscription) -> str:
    """Return a sentence if a subscription has several publishers, else "".

    A publisher of another type or an incompatible QoS does not count.

    :param node: the node.
    :param subscription: one of the node's subscriptions.
    """
    count = subscription.get_publisher_count()
    if count <= 1:
        return ""
    topic = subscription.topic_name
    return (
        f"{topic} is published by {count} publishers, {_named(_publishers(node, topic))}, "
        f"expected one: the relay would act on a mixture; end the others (a killed one leaves the "
        f"graph after 20 s)"
    )


def namesake(node: Node) -> str:
    """Return a sentence if another node has the node's own full name, else ""."""
    mine = (node.get_name(), node.get_namespace())
    count = node.get_node_names_and_namespaces().count(mine)
    if count <= 1:
        return ""
    return (
        f"{count} nodes have the name {node.get_fully_qualified_name()}, expected one: a "
        f"call reaches any of them; end the others (a killed one leaves the graph after 20 s), or "
        f"give them other names"
    )


def _publishers(node: Node, topic: str) -> list[str]:
    """Return the full names of a topic's publishing nodes, one for each publisher."""
    return [
        # A publisher is discovered a little earlier than its node.
        "a node not known yet"
        if _UNKNOWN in end.node_name
        else f"{end.node_namespace.rstrip('/')}/{end.node_name}"
        for end in node.get_publishers_info_by_topic(topic)
    ]


def _named(names: list[str]) -> str:
    return " and ".join(sorted(names)) or "another node"


class Silence:
    """A limit on the silence of a signal, on the steady clock.

    :param what: subject of the sentence.
    :param timeout: the limit [s].
    :param age: returns the time since the last message [s].
    """

    def __init__(self, what: str, timeout: float, age: Callable[[], float]) -> None:
        self._what = what
        self._timeout = timeout
        self._age = age

    def __call__(self) -> str:
        """Return a sentence if the limit is passed, else ""."""
        silent = self._age()
        return f"{self._what} for {silent:.3g} s" if silent > self._timeout else ""


class Overtime:
    """A limit on the duration of a tune by the steady clock, for any clock of its samples.

    The samples' time may stand still for ``standing`` seconds, as with a stuck ``/clock``. The
    tune may take ``slack`` times as long as the experiment and its present part may take by the
    samples' time.

    :param experiment: the tune.
    :param standing: longest time without progress of the samples' time [s].
    :param slack: how many times slower than the steady clock that time may go, at most.
    """

    def __init__(self, experiment: RelayExperiment, standing: float, slack: float) -> None:
        self._experiment = experiment
        self._standing = standing
        self._slack = slack
        self._begin = self._moved_at = now()
        self._elapsed = math.nan

    @classmethod
    def of(cls, experiment: RelayExperiment, node: Node) -> Overtime:
        """Return the limit that follows from the node's parameters."""
        pauses = [
            float(node.get_parameter(name).value)
            for name in ("measurement_timeout", "repeat_period")
        ]
        simulated = bool(node.get_parameter("use_sim_time").value)
        by_number = experiment.parameters.sample_period > 0.0
        return cls(
            experiment,
            max(_STANDING * max(pauses), _LEAST_STANDING),
            _SLACK_SIMULATED if simulated or by_number else _SLACK,
        )

    def __call__(self) -> str:
        """Return a sentence if a limit is passed, else ""."""
        tune, present = self._experiment, now()
        if tune.elapsed != self._elapsed:
            self._elapsed, self._moved_at = tune.elapsed, present
        if (still := present - self._moved_at) > self._standing:
            return (
                f"the time of the measurement has stood still at {tune.elapsed:.6g} s for "
                f"{still:.3g} s: check /clock, or what stamps the measurement"
            )
        most = min(tune.latest, tune.parameters.max_duration or math.inf)
        if (lasted := present - self._begin) > self._slack * most + self._standing:
            return (
                f"the tune is not over after {lasted:.4g} s, of which the measurement's clock "
                f"tells {tune.elapsed:.4g} s: check /clock, or what stamps the measurement"
            )
        return ""


def now() -> float:
    """Return the steady clock's time [s]."""
    return time.monotonic()
