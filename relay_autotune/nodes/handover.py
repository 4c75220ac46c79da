"""The way of the present controller's command through relay_node, out of it and back."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

# So many of the controller's last commands make its mean.
_KEPT = 200
# Where no oscillation says how fast the process is, a return takes so long [s].
_RETURN_TIME = 5.0


class Handover:
    """What the present controller wants, and what the actuator is told when no tune runs.

    Idle, each command of the controller is passed on as it comes. When a tune has ended, the
    controller may want something else than the actuator has; the difference is taken back over
    the return time, in a straight line, so that the actuator sees no bump.

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
        """Time since the controller's last command [s]; inf: none has come."""
        return time.monotonic() - self._arrived

    @property
    def last(self) -> float:
        """The controller's last command [u]; NaN: none has come."""
        return self._last

    def is_connected(self, timeout: float) -> bool:
        """Return True if the controller's commands come.

        :param timeout: greatest age of the last one [s].
        """
        return self.age <= timeout

    def mean(self) -> float:
        """Return the mean of the controller's last commands [u]; NaN: none has come."""
        return sum(self._kept) / len(self._kept) if self._kept else math.nan

    def hear(self, command: float) -> float | None:
        """Take a command of the controller; return what went to the actuator, None: nothing did.

        :param command: [u]; one that is not finite is not passed on.
        """
        if not math.isfinite(command):
            return None
        now = time.monotonic()
        self._last, self._arrived = command, now
        if self._active:
            return None
        if not math.isnan(self._left_at):
            # The first command after a tune: what it lacks of the last one is the bump.
            self._offset, self._return_from = self._left_at - command, now
            self._left_at = math.nan
        self._kept.append(command)
        passed = command + self._offset_at(now)
        self._send(passed)
        return passed

    def note(self, command: float) -> None:
        """Take a command that the controller has sent to the actuator by itself [u]."""
        self._last, self._arrived = command, time.monotonic()
        self._kept.append(command)

    def take_over(self) -> None:
        """Keep the controller's commands back from now on."""
        self._active = True
        self._offset = 0.0

    def give_back(self, command: float, return_time: float) -> None:
        """Pass the controller's commands on again.

        :param command: what the actuator has now [u]; NaN: whatever that is, without a return.
        :param return_time: time over which the difference is taken back [s]; 0: 5 s.
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
