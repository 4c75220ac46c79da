# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Pass the present controller's command through, interrupt it for a tune, and return to it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

# Number of the controller's last commands that are averaged.
_KEPT = 200
# Return time when no oscillation has shown how fast the process is [s].
_RETURN_TIME = 5.0


class Handover:
    """The present controller's command, and the command to the actuator when no tune runs.

    Without a tune, each command of the controller is passed on at once. After a tune, a silence of
    the controller or a start from a known command, the controller's command may differ from the
    actuator's. The difference shrinks to zero along a straight line over the return time, so that
    the actuator sees no bump.

    :param send: publishes a command.
    """

    def __init__(self, send: Callable[[float], None]) -> None:
        self._send = send
        self._last = math.nan
        self._arrived = -math.inf
        self._kept: deque[float] = deque(maxlen=_KEPT)
        self._active = False
        self._left_at = math.nan
        self._offset = 0.0
        self._return_from = -math.inf
        self._return_time = _RETURN_TIME

    @property
    def age(self) -> float:
        """Time since the controller's last command [s]; inf before the first."""
        return time.monotonic() - self._arrived

    @property
    def last(self) -> float:
        """The controller's last command [u]; NaN before the first."""
        return self._last

    def is_connected(self, timeout: float) -> bool:
        """Return True if the controller's commands come.

        :param timeout: greatest age of the last one [s].
        """
        return self.age <= timeout

    def mean(self) -> float:
        """Return the mean of the controller's last commands [u]; NaN before the first."""
        return sum(self._kept) / len(self._kept) if self._kept else math.nan

    def hear(self, command: float) -> float | None:
        """Take a command of the controller; return the command sent to the actuator, or None.

        :param command: [u]; one that is not finite is not passed on.
        """
        if not math.isfinite(command):
            return None
        now = time.monotonic()
        self._last, self._arrived = command, now
        if self._active:
            return None
        if not math.isnan(self._left_at):
            # First command since: its difference from the last one would be the bump.
            self._offset, self._return_from = self._left_at - command, now
            self._left_at = math.nan
        self._kept.append(command)
        passed = command + self._offset_at(now)
        self._send(passed)
        return passed

    def note(self, command: float) -> None:
        """Note a command that the controller has sent to the actuator directly [u]."""
        self._last, self._arrived = command, time.monotonic()
        self._kept.append(command)

    def take_over(self) -> None:
        """Stop passing on the controller's commands."""
        self._active = True
        self._offset = 0.0

    def give_back(self, command: float, return_time: float) -> None:
        """Pass the controller's commands on again.

        :param command: the actuator's present command [u]; NaN: change over without a return.
        :param return_time: time in which the difference shrinks to zero [s]; 0: 5 s.
        """
        self._active = False
        self._left_at = command
        self._return_time = return_time if return_time > 0.0 else _RETURN_TIME

    def _offset_at(self, now: float) -> float:
        if self._offset == 0.0:
            return 0.0
        left = 1.0 - (now - self._return_from) / self._return_time
        if left <= 0.0:
            self._offset = 0.0
            return 0.0
        return left * self._offset
