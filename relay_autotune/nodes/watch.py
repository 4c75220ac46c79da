# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a node sees of a loop: losses and silence, other publishers, actuator and clock.

Silence is a fault, or a sensor that publishes only on change.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Future

from relay_autotune.errors import FieldError, ParameterError
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.faults import Repetition
from relay_autotune.experiment.settling import CONSTANT_SAMPLES, RestState, rest_state
from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import STEADY, ServedNode
from relay_autotune.nodes.live_types import Reader
from relay_autotune.nodes.quality import who
from relay_autotune.reasons import Code, Reason

# Interval of the looks at the loop, and shortest period of a timer [s].
LOOK_EVERY, _LEAST_WAIT = 0.05, 1e-3
# The last samples that are kept, and the time that they may cover [s].
_KEPT, _WINDOW = 2000, 10.0
# Shortest time over which rest is judged [s]: a drift shows in less only where it is fast.
_LEAST_SPAN = 2.0
# Longest silence of a sensor where measurement_timeout is 0: a time [s], or a number of usual
# intervals if that is longer. Some samples in a row may be lost on the way, and the relay, which
# switches at a sample, is then late by no more than these.
LEAST_SILENCE, SILENT_INTERVALS = 1.0, 5.0
# Rounding of equal times as floats of seconds since 1970 [s].
_ROUNDING = 1e-6


def require_own_time(
    sample_period: float, repeat_period: float, command_period: float = 0.0
) -> None:
    """Refuse to repeat measurements, or commands, if their number is the only clock.

    :param sample_period: the parameter [s].
    :param repeat_period: the parameter [s].
    :param command_period: the parameter [s].
    :raises ParameterError: if the first and one of the others are given.
    """
    if sample_period > 0.0 and command_period > 0.0:
        other, which = "command_period", "one of them"
        why = "a plant in lockstep would take each repeated command for the answer to a sample"
    elif sample_period > 0.0 and repeat_period > 0.0:
        other, which = "repeat_period", "sample_period"
        why = "a sensor that is silent while nothing changes has no constant sample period"
    else:
        return
    raise ParameterError(Code.TWO_CLOCKS(other=other, period=sample_period, why=why, which=which))


class Repeater:
    """Take the last measurement again while the sensor is silent.

    Time is the steady clock or the simulated one. The simulated clock moves in steps, and the
    measurement of a step arrives after it. So silence at a step is known only at the next step,
    and the repeated value is a sample of the earlier step. A value from before the node's start is
    received if the publisher is latched (transient local).

    :param node: the node.
    :param period: silence after which a value is repeated [s], > 0.
    :param reader: how the measurement is read from its messages.
    :param repeat: called with the repeated value [y] and the age of its instant [s].
    """

    def __init__(
        self, node: Any, period: float, reader: Reader, repeat: Callable[[float, float], None]
    ) -> None:
        self._node = node
        self._reader = reader
        self._repeat = repeat
        self._repetition = Repetition(period)
        self._simulated = bool(node.get_parameter("use_sim_time").value)
        self._silent_at = math.nan
        clock = node.get_clock() if self._simulated else STEADY
        self._now: Callable[[], float] = lambda: float(clock.now().nanoseconds) * 1e-9
        wait = _LEAST_WAIT if self._simulated else period
        self._timer = node.create_timer(wait, self._look, clock=clock)
        self._ear: Subscription | None = quality.subscription(
            node, reader.kind, "measurement", self._on_kept, quality.RESULT
        )
        self._topic = self._ear.topic_name
        self._direct = False

    def hear(self, value: float) -> None:
        """Take a received measurement [y]."""
        self._direct = True
        self._silent_at = math.nan
        self._repetition.hear(self._now(), value)

    def age(self, since_last: float) -> float:
        """Return the time without a valid value [s]; inf before the first.

        :param since_last: time since the last message came [s].
        """
        if not self._repetition.is_heard:
            return math.inf
        return since_last if self.why_dead() else 0.0

    def why_dead(self) -> Reason | None:
        """Return a reason if the sensor must be dead, since its publisher has left."""
        if not self._repetition.is_heard or self._node.count_publishers(self._topic):
            return None
        return Code.SENSOR_GONE(topic=self._topic)

    def _on_kept(self, message: Any) -> None:
        if not self._direct:
            # The subscription of the node says why a message cannot be read.
            with suppress(FieldError):
                self._repetition.hear(self._now(), self._reader.value(message))

    def _look(self) -> None:
        if self._ear is not None and self._direct:
            self._node.destroy_subscription(self._ear)
            self._ear = None
        now = self._now()
        if self._simulated:
            self._look_at_step(now)
            again(self._timer, _LEAST_WAIT)
            return
        wait = self._repetition.wait(now)
        if wait <= 0.0:
            self._repeat(self._repetition.repeat(now), 0.0)
            wait = self._repetition.period
        again(self._timer, wait)

    def _look_at_step(self, now: float) -> None:
        if self._is_due(now) and now > self._silent_at:
            at = self._silent_at
            self._repeat(self._repetition.repeat(at), now - at)
        self._silent_at = now if self._is_due(now) else math.nan

    def _is_due(self, now: float) -> bool:
        return self._repetition.wait(now) <= _ROUNDING


class LastSamples:
    """Keep the last measurements with the times at which they were published.

    Those of their arrival would tell how a node that has just started takes what waits for it.
    """

    def __init__(self) -> None:
        self._kept: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._interval_before = 0.0

    def add(self, value: float, published_ns: int | None) -> None:
        """Take a measurement [y].

        :param value: the measurement.
        :param published_ns: when it was published [ns]; None, 0: not known, so it is now.
        """
        self._kept.append((1e-9 * (published_ns or time.time_ns()), value))

    def forget(self) -> None:
        """Start again, since the command will change; the interval stays known."""
        self._interval_before = self.interval
        self._kept.clear()

    @property
    def _span(self) -> float:
        return self._kept[-1][0] - self._kept[0][0] if self._kept else 0.0

    @property
    def are_enough(self) -> bool:
        """Whether they cover enough time to judge their rate, and whether they rest."""
        return self._span >= _LEAST_SPAN or len(self._kept) == _KEPT

    @property
    def interval(self) -> float:
        """Mean interval of the samples [s]; 0: not known."""
        if len(self._kept) < 2:
            return self._interval_before
        return max(self._span, 0.0) / (len(self._kept) - 1)

    @property
    def newest(self) -> float | None:
        """The newest measurement [y]; None: none has come."""
        return self._kept[-1][1] if self._kept else None

    def _recent(self) -> list[tuple[float, float]]:
        """Return the samples of the last seconds, or the last 20 of a slow sensor."""
        kept = list(self._kept)
        recent = [sample for sample in kept if sample[0] >= kept[-1][0] - _WINDOW]
        return recent if len(recent) >= CONSTANT_SAMPLES else kept[-CONSTANT_SAMPLES:]

    def before(self) -> list[float]:
        """Return the recent measurements [y]."""
        return [value for _, value in self._recent()]

    def rest(self) -> RestState | None:
        """Return how the measurement rested recently; None: there are too few."""
        recent = np.array(self._recent())
        if len(recent) < CONSTANT_SAMPLES or not self.are_enough:
            return None
        return rest_state(recent[:, 0] - recent[0, 0], recent[:, 1], len(recent))


class Sensor:
    """The measurement: its subscription, its last samples, its losses and its silence.

    The subscription is reliable, and best effort once a publisher offers no more. A reliable one
    receives nothing from a best effort publisher, and a best effort one would lose samples of a
    reliable publisher without need. A reliability that the user gives by ``qos_overrides`` stays
    as it is. The messages have the fast path of the node, unless another callback, that of /clock,
    tells the time of a sample. With repetition, it is the publisher that shows whether the sensor
    lives, and not its messages.

    :param node: the node.
    :param reader: how the measurement is read from its messages.
    :param take: takes each message and the middleware's facts about it.
    :param repeat: called as by :class:`Repeater`.
    """

    def __init__(
        self,
        node: ServedNode,
        reader: Reader,
        take: Callable[[Any, dict[str, Any]], None],
        repeat: Callable[[float, float], None],
    ) -> None:
        self._node, self.reader, self._take = node, reader, take
        self._favours = not node.get_parameter("use_sim_time").value
        self.subscription = self._subscribed(quality.MEASUREMENT, **quality.OVERRIDABLE)
        """The subscription in force."""
        given = f"qos_overrides.{self.subscription.topic_name}.subscription.reliability"
        self._is_given = given in node._parameter_overrides
        self.repeat_period = period = float(node.get_parameter("repeat_period").value)
        """Silence after which a value is repeated [s]; 0: never."""
        self._repeater = Repeater(node, period, reader, repeat) if period > 0.0 else None
        self.hear = self._repeater.hear if self._repeater else None
        """To be called with each measurement; None: no call needed."""
        self.samples = LastSamples()
        """The last measurements."""
        self.misread: Reason | None = None
        """Why the last message could not be read; None: it could."""
        self._lost = 0
        self._arrived = -math.inf
        self._arrivals = self._sequence = 0

    def _subscribed(self, profile: QoSProfile, **options: Any) -> Subscription:
        found: Subscription = quality.subscription(
            self._node, self.reader.kind, "measurement", self._take, profile, **options
        )
        if self._favours:
            self._node.favoured = found
        return found

    def look(self) -> None:
        """Subscribe anew if a publisher is there that the subscription cannot hear.

        To be called often, but not where no sample may be missed.
        """
        old, profile = self.subscription, self.subscription.qos_profile
        is_best_effort = profile.reliability == ReliabilityPolicy.BEST_EFFORT
        if self._is_given or is_best_effort:
            return
        name = old.topic_name
        if self._node.count_publishers(name) <= old.get_publisher_count():
            return
        offered = [
            end
            for end in self._node.get_publishers_info_by_topic(name)
            if end.topic_type == self.reader.type_name
            and end.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        ]
        if not offered:
            return
        weaker = copy(profile)
        weaker.reliability = ReliabilityPolicy.BEST_EFFORT
        self.subscription = self._subscribed(weaker)
        self._node.destroy_subscription(old)
        self._node.get_logger().info(
            f"{name} is taken best effort, as {who(offered[0])} offers it: samples that "
            f"are lost on the way are counted"
        )

    def count(self, number: int | None) -> None:
        """Take the arrival of a message.

        :param number: its publication sequence number; None: not known.
        """
        self._arrived = time.monotonic()
        self._arrivals += 1
        if number is not None:
            if number > self._sequence + 1 and self._sequence:
                self._lost += number - self._sequence - 1
            self._sequence = number

    @property
    def lost(self) -> int:
        """Samples lost since `begin`, by the numbers of its only publisher."""
        return self._lost if self.subscription.get_publisher_count() <= 1 else 0

    def arrivals(self) -> int:
        """Return the number of messages since this was last asked."""
        count, self._arrivals = self._arrivals, 0
        return count

    @property
    def since_message(self) -> float:
        """Time since the last message [s]; inf before the first."""
        return time.monotonic() - self._arrived

    @property
    def age(self) -> float:
        """Time without a valid value [s]; inf before the first."""
        age = self.since_message
        return age if self._repeater is None else self._repeater.age(age)

    def why_dead(self) -> Reason | None:
        """Return why nothing can be measured: its messages, or its publisher has left."""
        return self.misread or (None if self._repeater is None else self._repeater.why_dead())

    def begin(self) -> None:
        """Begin a tune: count silence and losses from here on."""
        self._lost, self._arrived = 0, time.monotonic()

    @property
    def timeout(self) -> float:
        """Longest silence that is no fault [s]."""
        given = float(self._node.get_parameter("measurement_timeout").value)
        return given or max(LEAST_SILENCE, SILENT_INTERVALS * self.samples.interval)

    @property
    def left(self) -> float:
        """For how long its silence is no fault yet [s]."""
        if self._repeater is not None:
            return math.inf
        return self.timeout - self.since_message

    def problem(self) -> Reason | None:
        """Return why a tune must end: it is silent, or with repetition its publisher has left."""
        if self._repeater is not None:
            return self.why_dead()
        if self.left > 0.0:
            return None
        topic = self._node.resolve_topic_name("measurement")
        return Code.SILENT_SENSOR(topic=topic, silence=self.since_message)


def again(timer: Any, wait: float) -> None:
    """Let a timer fire after a time [s], and then at this interval."""
    timer.timer_period_ns = max(int(wait * 1e9), int(_LEAST_WAIT * 1e9))
    timer.reset()


# Longest time for which the samples' time may stand still: a multiple of the sensor's longest
# silence or of repeat_period, and at least a number of seconds. Then the largest ratio of steady
# time to the samples' time: for gaps in the samples, and for the clock of a simulation.
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
    def rail(self) -> dict[str, float]:
        """The ends of an actuator that moves but always stops short of the command [u]."""
        ends = {**self._ends, self._command: self._position}
        commands = sorted(command for command in ends if not math.isnan(command))
        if len(commands) < 2:
            return {}
        low, high = commands[0], commands[-1]
        moved = ends[high] - ends[low]
        if not 0.0 < moved < high - low - self._tolerance():
            return {}
        return {"low": ends[low], "high": ends[high]}

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


@dataclass(frozen=True)
class Watch:
    """What looks at a loop.

    :param problem: returns a reason to end a tune, None while there is none; it may also act.
    :param in_tune: True: it looks while a tune runs; False: while none does; None: always.
    :param every: it takes part in each look of this number: 1, or more where it queries the graph.
    """

    problem: Callable[[], Reason | None]
    in_tune: bool | None = True
    every: int = 1


def arrival(node: Node) -> Future:
    """Return what is done once a node that has just started must know all others of its graph.

    :param node: the node.
    """
    known: Future = Future()

    def end() -> None:
        timer.cancel()
        known.set_result(None)

    timer = node.create_timer(quality.ALL_KNOWN_AFTER, end, clock=STEADY)
    return known


def second_publisher(node: Node, topic: str) -> Reason | None:
    """Return a reason if another node publishes a topic of the node.

    :param node: the node.
    :param topic: resolved name of a topic that it publishes.
    """
    if node.count_publishers(topic) <= 1:
        return None
    others = _publishers(node, topic, node.get_fully_qualified_name())
    return Code.SECOND_PUBLISHER(topic=topic, others=others)


def second_source(node: Node, subscription: Subscription) -> Reason | None:
    """Return a reason if a subscription has several publishers.

    A publisher of another type or an incompatible QoS does not count.

    :param node: the node.
    :param subscription: one of the node's subscriptions.
    """
    count = subscription.get_publisher_count()
    if count <= 1:
        return None
    topic = subscription.topic_name
    return Code.SECOND_SOURCE(topic=topic, count=count, others=_publishers(node, topic))


def namesake(node: Node) -> Reason | None:
    """Return a reason if another node has the node's own full name."""
    mine = (node.get_name(), node.get_namespace())
    count = node.get_node_names_and_namespaces().count(mine)
    if count <= 1:
        return None
    return Code.NAMESAKE(count=count, node=node.get_fully_qualified_name())


def _publishers(node: Node, topic: str, but: str = "") -> str:
    """Return the names of a topic's publishing nodes, one for each publisher but one of a node."""
    names = sorted(map(who, node.get_publishers_info_by_topic(topic)))
    if but in names:
        names.remove(but)
    return " and ".join(names) or "another node"


# The steady clock's time [s].
now = time.monotonic


class Overtime:
    """A limit on the duration of a tune by the steady clock, for any clock of its samples.

    The samples' time may stand still for some seconds, as with a stuck ``/clock``. The tune may
    take some times as long as the experiment and its present part may take by the
    samples' time.

    :param experiment: the tune.
    :param pause: longest time between two samples [s].
    :param simulated: True if their time is that of a simulation.
    """

    def __init__(self, experiment: RelayExperiment, pause: float, *, simulated: bool) -> None:
        self._experiment = experiment
        self._standing = max(_STANDING * pause, _LEAST_STANDING)
        by_number = experiment.parameters.sample_period > 0.0
        self._slack = _SLACK_SIMULATED if simulated or by_number else _SLACK
        self._begin = self._moved_at = now()
        self._elapsed = math.nan

    def problem(self) -> Reason | None:
        """Return a reason if a limit is passed."""
        tune, present = self._experiment, now()
        if tune.elapsed != self._elapsed:
            self._elapsed, self._moved_at = tune.elapsed, present
        if (still := present - self._moved_at) > self._standing:
            return Code.TIME_STANDS(time=tune.elapsed, still=still)
        most = min(tune.latest, tune.parameters.max_duration or math.inf)
        if (lasted := present - self._begin) > self._slack * most + self._standing:
            return Code.OVERTIME(lasted=lasted, time=tune.elapsed)
        return None
