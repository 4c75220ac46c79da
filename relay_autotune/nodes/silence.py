# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The measurement as it arrives: its last samples, losses, and silence.

Silence is a fault, or a sensor that publishes only on change.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from relay_autotune.errors import FieldError, ParameterError
from relay_autotune.experiment.faults import Repetition
from relay_autotune.experiment.settling import CONSTANT_SAMPLES, RestState, rest_state
from relay_autotune.nodes import quality
from relay_autotune.nodes.lifetime import STEADY
from relay_autotune.nodes.live_types import Reader

# Shortest period of a timer, and interval of the graph checks during a tune [s].
_LEAST_WAIT = 1e-3
_LOOK_EVERY = 0.2
# The last samples that are kept, and the time that they may cover [s].
_KEPT, _WINDOW = 2000, 10.0
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
        raise ParameterError(
            f"command_period and sample_period {sample_period:g} s are both given: a plant in "
            "lockstep would take each repeated command for the answer to a sample; set one of "
            "them to 0"
        )
    if sample_period > 0.0 and repeat_period > 0.0:
        raise ParameterError(
            f"repeat_period and sample_period {sample_period:g} s are both given: a sensor that "
            "is silent while nothing changes has no constant sample period; set sample_period to 0"
        )


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
        if self._simulated:
            clock = node.get_clock()
            self._now: Callable[[], float] = lambda: float(clock.now().nanoseconds) * 1e-9
        else:
            clock = STEADY
            self._now = time.monotonic
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

    def why_dead(self) -> str:
        """Return a sentence if the sensor must be dead, since its publisher has left, else ""."""
        if not self._repetition.is_heard or self._node.count_publishers(self._topic):
            return ""
        return f"no measurement on {self._topic} any more: its publisher has left"

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
            _again(self._timer, _LEAST_WAIT)
            return
        wait = self._repetition.wait(now)
        if wait <= 0.0:
            self._repeat(self._repetition.repeat(now), 0.0)
            wait = self._repetition.period
        _again(self._timer, wait)

    def _look_at_step(self, now: float) -> None:
        if self._is_due(now) and now > self._silent_at:
            at = self._silent_at
            self._repeat(self._repetition.repeat(at), now - at)
        self._silent_at = now if self._is_due(now) else math.nan

    def _is_due(self, now: float) -> bool:
        return self._repetition.wait(now) <= _ROUNDING


class Counter:
    """Count arrivals: their number, the time since the last, and losses in the middleware."""

    def __init__(self) -> None:
        self.lost = 0
        """Samples lost since `begin`, by the publisher's numbers."""
        self._last_arrival = -math.inf
        self._arrivals = self._arrivals_before = 0
        self._sequence = 0

    @property
    def age(self) -> float:
        """Time since the last arrival [s]; inf before the first."""
        return time.monotonic() - self._last_arrival

    def begin(self) -> None:
        """Count losses, and the age, from here on."""
        self.lost = 0
        self._last_arrival = time.monotonic()

    def add(self, number: int | None) -> None:
        """Take an arrival.

        :param number: its publication sequence number; None: not known.
        """
        self._last_arrival = time.monotonic()
        self._arrivals += 1
        if number is not None:
            if number > self._sequence + 1 and self._sequence:
                self.lost += number - self._sequence - 1
            self._sequence = number

    def since_last_asked(self) -> int:
        """Return the number of arrivals since this was last asked."""
        count = self._arrivals - self._arrivals_before
        self._arrivals_before = self._arrivals
        return count


class LastSamples:
    """Keep the last measurements with their time of arrival."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, float]] = deque(maxlen=_KEPT)

    def add(self, value: float) -> None:
        """Take a measurement [y] that has arrived now."""
        self._kept.append((time.monotonic(), value))

    def forget(self) -> None:
        """Start again, since the command will change."""
        self._kept.clear()

    @property
    def interval(self) -> float:
        """Mean interval of the samples [s]; 0: not known."""
        if len(self._kept) < 2:
            return 0.0
        return (self._kept[-1][0] - self._kept[0][0]) / (len(self._kept) - 1)

    @property
    def newest(self) -> float | None:
        """The newest measurement [y]; None: none has come."""
        return self._kept[-1][1] if self._kept else None

    def _recent(self) -> list[tuple[float, float]]:
        since = time.monotonic() - _WINDOW
        return [sample for sample in self._kept if sample[0] >= since]

    def before(self) -> list[float]:
        """Return the measurements of the last seconds, or the last 20 of a slow sensor [y]."""
        recent = self._recent()
        if len(recent) < CONSTANT_SAMPLES:
            recent = list(self._kept)[-CONSTANT_SAMPLES:]
        return [value for _, value in recent]

    def rest(self) -> RestState | None:
        """Return how the measurement rested over the last seconds; None: there are too few."""
        recent = np.array(self._recent())
        if len(recent) < CONSTANT_SAMPLES:
            return None
        return rest_state(recent[:, 0] - recent[0, 0], recent[:, 1], len(recent))


def losses(count: int) -> str:
    """Say how many samples were lost on the way; "" for none."""
    return f"{count} {'sample' if count == 1 else 'samples'} lost on the way" if count else ""


class Sensor:
    """Watch the measurement: by its messages, or with repetition by its publisher.

    :param node: the node.
    :param reader: how the measurement is read from its messages.
    :param counter: counts the messages.
    :param repeat: called as by :class:`Repeater`.
    :param stop: called with the reason when a tune must end.
    """

    def __init__(
        self,
        node: Any,
        reader: Reader,
        counter: Counter,
        *,
        repeat: Callable[[float, float], None],
        stop: Callable[[str], None],
    ) -> None:
        self._node = node
        self._counter = counter
        self._stop = stop
        self.repeat_period = period = float(node.get_parameter("repeat_period").value)
        """Silence after which a value is repeated [s]; 0: never."""
        self._repeater = Repeater(node, period, reader, repeat) if period > 0.0 else None
        self._timer: Timer | None = None
        self.hear = self._repeater.hear if self._repeater else None
        """To be called with each measurement; None: no call needed."""
        self.misread = ""
        """Why the last message could not be read; empty: it could."""

    @property
    def age(self) -> float:
        """Time without a valid value [s]; inf before the first."""
        age = self._counter.age
        return age if self._repeater is None else self._repeater.age(age)

    def why_dead(self) -> str:
        """Return why nothing can be measured: its messages, or its publisher has left; else ""."""
        return self.misread or ("" if self._repeater is None else self._repeater.why_dead())

    @property
    def _timeout(self) -> float:
        return float(self._node.get_parameter("measurement_timeout").value)

    def watch(self) -> None:
        """Watch on the steady clock until :meth:`rest`."""
        wait = self._timeout if self._repeater is None else _LOOK_EVERY
        self._timer = self._node.create_timer(wait, self._look, clock=STEADY)

    def rest(self) -> None:
        """Stop watching."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def _look(self) -> None:
        if self._timer is None:
            return
        if self._repeater is not None:
            if reason := self.why_dead():
                self._stop(reason)
            return
        age = self._counter.age
        if age < self._timeout:
            _again(self._timer, self._timeout - age)
            return
        topic = self._node.resolve_topic_name("measurement")
        self._stop(f"no measurement on {topic} for {age:.3g} s")


def _again(timer: Any, wait: float) -> None:
    timer.timer_period_ns = max(int(wait * 1e9), int(_LEAST_WAIT * 1e9))
    timer.reset()
