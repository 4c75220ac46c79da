# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""An imperfect actuator: limits, backlash and stiction."""

from __future__ import annotations

import math

from relay_autotune.errors import ParameterError


class Actuator:
    """Turn commands into positions; it keeps the position between calls.

    A command passes, in this order:

    1. the limits ``minimum`` and ``maximum``;
    2. the dead band (play): the position follows at a distance of half the dead band, so that
       after a reversal it stays until the command has moved by the whole of it;
    3. stiction in the one-parameter form of Stenman, Gustafsson and Forsman (2003): the position
       sticks until the command is further away than ``stiction``, and then jumps to it;
    4. ``falling_gain``: the distance of the position below ``initial`` is multiplied by this, as
       for a process that heats fast and cools slowly.

    :param initial: position at the start [u].
    :param minimum: lower limit of the position [u]; -inf: none.
    :param maximum: upper limit of the position [u]; inf: none.
    :param dead_band: width of the play [u], >= 0.
    :param stiction: width of the band in which it sticks [u], >= 0.
    :param falling_gain: factor on the position's distance below ``initial``, > 0; 1: no effect.
    :raises ParameterError: if the limits cross, or a width is negative or not finite.
    """

    def __init__(
        self,
        initial: float,
        *,
        minimum: float = -math.inf,
        maximum: float = math.inf,
        dead_band: float = 0.0,
        stiction: float = 0.0,
        falling_gain: float = 1.0,
    ) -> None:
        if not minimum < maximum:
            raise ParameterError(
                f"the actuator's lower limit must be below its upper one, "
                f"found {minimum:g} and {maximum:g}"
            )
        for name, width in (("dead_band", dead_band), ("stiction", stiction)):
            if not (math.isfinite(width) and width >= 0.0):
                raise ParameterError(f"{name} must be finite and not negative, found {width}")
        if not (math.isfinite(falling_gain) and falling_gain > 0.0):
            raise ParameterError(f"falling_gain must be finite and > 0, found {falling_gain}")
        if not minimum <= initial <= maximum:
            raise ParameterError(
                f"the actuator cannot start at {initial:g}, outside its limits "
                f"{minimum:g} to {maximum:g}"
            )
        self._minimum = minimum
        self._maximum = maximum
        self._half_play = 0.5 * dead_band
        self._stiction = stiction
        self._follower = initial
        self._initial = initial
        self._falling_gain = falling_gain
        self.position = initial

    def move(self, command: float) -> float:
        """Give a command and return the resulting input of the process [u].

        :param command: [u]; ignored if it is not finite.
        """
        if not math.isfinite(command):
            return self.acting
        wanted = min(max(command, self._minimum), self._maximum)
        half = self._half_play
        follower = min(max(self._follower, wanted - half), wanted + half)
        self._follower = follower
        if self._stiction == 0.0 or abs(follower - self.position) > self._stiction:
            self.position = follower
        return self.acting

    @property
    def acting(self) -> float:
        """Input of the process at the present position [u]."""
        below = min(self.position - self._initial, 0.0)
        return self.position + (self._falling_gain - 1.0) * below
