# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exact simulation of a process that is stepped from outside."""

from __future__ import annotations

from collections import deque

import numpy as np

from relay_autotune.errors import ModelError
from relay_autotune.process.modes import Modes
from relay_autotune.process.transfer_function import TransferFunction


class Plant:
    """A process whose input is held between calls, exact for any real dead time.

    :param model: the process.
    :param initial_command: the command at which it rests [u].
    """

    def __init__(self, model: TransferFunction, *, initial_command: float = 0.0) -> None:
        self.time = 0.0
        self._dead_time = model.dead_time
        self._modes = Modes.of(model)
        self._z = self._modes.rest()
        self._weights = self._modes.weights(self._z)
        self._since = 0.0
        self._command = initial_command
        self._arrived = initial_command
        self._on_the_way: deque[tuple[float, float]] = deque()

    def advance(self, time: float, command: float) -> float:
        """Hold ``command`` from now on, move to ``time`` and return the output there.

        :param time: not before the present time [s].
        :param command: [u].
        :return: deviation of the output from rest [y].
        :raises ModelError: if ``time`` lies in the past.
        """
        if time < self.time:
            raise ModelError(f"the plant is at {self.time:g} s and cannot go back to {time:g} s")
        if command != self._command:
            self._on_the_way.append((self.time + self._dead_time, command))
            self._command = command
        while self._on_the_way and self._on_the_way[0][0] <= time:
            self._arrive(*self._on_the_way.popleft())
        self.time = time
        return float(self._modes.outputs(self._weights, np.array([time - self._since]))[0, 0])

    def _arrive(self, time: float, command: float) -> None:
        z = self._modes.move(self._z, time - self._since)
        self._z = z + (command - self._arrived) * self._modes.input_direction
        self._weights = self._modes.weights(self._z)
        self._since, self._arrived = time, command
