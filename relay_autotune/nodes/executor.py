# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A single-threaded executor with a fast path for the messages of one subscription.

rclpy's executor checks every service, timer and event of a node twice for each message. This
executor waits for the favoured subscription alone while its messages follow each other closely,
and checks everything else a few hundred times a second.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.executors import (
    ConditionReachedException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription

# Messages further apart than this take the ordinary path [s].
CLOSE = 0.002
# Interval at which everything else is checked while messages follow closely [s].
LOOK_AROUND = 0.005
# After this time without a callback all work is done; it also lets the last message leave [s].
_NOTHING_MORE = 0.02


class Executor(SingleThreadedExecutor):
    """rclpy's single-threaded executor, one callback at a time, with a favoured subscription."""

    def __init__(self) -> None:
        super().__init__()
        self._favoured: Subscription | None = None
        self._wait_set: Any = None
        self._flowing = False
        self._look_around_at = 0.0

    def favour(self, subscription: Subscription) -> None:
        """Give the messages of a subscription the fast path.

        :param subscription: one whose callback takes the message and the middleware's facts, and
            does not rely on what other callbacks do in between, such as that of /clock.
        """
        with self.context.handle:
            self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self.context.handle)
        self._favoured = subscription

    def turn(self, timeout_sec: float | None) -> bool:
        """Wait for a callback and run it; return False if none became ready.

        :param timeout_sec: how long to wait [s]; None: as long as it takes.
        """
        if self._flowing:
            now = time.monotonic()
            if now >= self._look_around_at:
                self._look_around_at = now + LOOK_AROUND
                if self._any(0.0):
                    return True
            if self._take_favoured(CLOSE if timeout_sec is None else 0.0):
                return True
            self._flowing = False
        return self._any(timeout_sec)

    def finish(self, within: float) -> None:
        """Finish pending tasks, such as the answer to an ended goal; take no new messages.

        :param within: how long it may take [s].
        """
        deadline = time.monotonic() + within
        # A wait is needed to see work that one task has started.
        while time.monotonic() < deadline and self._any(_NOTHING_MORE, []):
            pass

    def _take_favoured(self, timeout_sec: float) -> bool:
        subscription = self._favoured
        assert subscription is not None
        handle = subscription.handle
        with handle:
            taken = handle.take_message(subscription.msg_type, False)
            if taken is None and timeout_sec > 0.0:
                self._wait_set.clear_entities()
                self._wait_set.add_subscription(handle)
                self._wait_set.wait(int(timeout_sec * 1e9))
                taken = handle.take_message(subscription.msg_type, False)
        if taken is None:
            return False
        subscription.callback(*taken)
        return True

    def _any(self, timeout_sec: float | None, nodes: list[Node] | None = None) -> bool:
        try:
            handler, entity, _ = self.wait_for_ready_callbacks(timeout_sec, nodes)
        except (ConditionReachedException, ShutdownException, TimeoutException):
            return False
        handler()
        error = handler.exception()
        if error is not None:
            raise error
        # A task has no entity, and a node may have no favoured subscription.
        if entity is not None and entity is self._favoured:
            self._flowing = True
        return True
