# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A simulated process in a loop: actuator, exact dynamics, disturbances and sensor."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from relay_autotune.errors import ModelError, ParameterError
from relay_autotune.process.response import Modes
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import check, quantity

_EPSILON = float(np.finfo(float).eps)


@dataclass
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
    :raises ParameterError: if the limits cross, or a value is out of its range.
    """

    initial: float
    _: KW_ONLY
    minimum: float = -math.inf
    maximum: float = math.inf
    dead_band: float = quantity(0.0, "u", lower=0.0).means("Play of the actuator.")
    stiction: float = quantity(0.0, "u", lower=0.0).means("Band in which the actuator sticks.")
    falling_gain: float = quantity(1.0, lower=1e-3, upper=1e3).means(
        "Factor on the command's part below rest, for a process that cools slower than it heats."
    )
    position: float = field(init=False)

    def __post_init__(self) -> None:
        if not self.minimum < self.maximum:
            raise ParameterError(
                f"the actuator's lower limit must be below its upper one, "
                f"found {self.minimum:g} and {self.maximum:g}"
            )
        check(self, ParameterError)
        if not self.minimum <= self.initial <= self.maximum:
            raise ParameterError(
                f"the actuator cannot start at {self.initial:g}, outside its limits "
                f"{self.minimum:g} to {self.maximum:g}"
            )
        self._follower = self.position = self.initial

    def move(self, command: float) -> float:
        """Give a command and return the resulting input of the process [u].

        :param command: [u]; ignored if it is not finite.
        """
        if not math.isfinite(command):
            return self.acting
        wanted = min(max(command, self.minimum), self.maximum)
        half = 0.5 * self.dead_band
        self._follower = min(max(self._follower, wanted - half), wanted + half)
        if self.stiction == 0.0 or abs(self._follower - self.position) > self.stiction:
            self.position = self._follower
        return self.acting

    @property
    def acting(self) -> float:
        """Input of the process at the present position [u]."""
        below = min(self.position - self.initial, 0.0)
        return self.position + (self.falling_gain - 1.0) * below


class Plant:
    """A process whose input is held between calls, exact for any real dead time.

    :param model: the process.
    :param initial_command: the command at which it rests [u].
    """

    def __init__(self, model: TransferFunction, *, initial_command: float = 0.0) -> None:
        self.time = 0.0
        self._dead_time = model.dead_time
        self._modes = Modes.of(model)
        self._states, self._rounding = self._modes.rest(), 0.0
        self._since = 0.0
        self._command = initial_command
        # When the process sees the command change, and by how much.
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
            self._on_the_way.append((self.time + self._dead_time, command - self._command))
            self._command = command
        while self._on_the_way and self._on_the_way[0][0] <= time:
            self._arrive(*self._on_the_way.popleft())
        self.time = time
        y = float(self._modes.outputs(self._states, np.array([time - self._since]))[0, 0])
        # At the arrival of the first command the parts cancel, but for rounding.
        return y if abs(y) > self._rounding else 0.0

    def _arrive(self, time: float, change: float) -> None:
        moved = self._modes.moved(self._states, time - self._since)
        self._states = self._modes.stepped(moved, change)
        self._rounding = _EPSILON * self._modes.size_of(self._states)
        self._since = time


@dataclass(frozen=True)
class Disturbances:
    """Disturbances of a process.

    >>> from relay_autotune import Disturbances
    >>> Disturbances(noise_std=0.02, load_time=60.0, load_size=0.5).load_size
    0.5

    :raises ParameterError: if a value is out of its range.
    """

    noise_std: float = quantity(0.0, "y", lower=0.0).means("Standard deviation of white noise.")
    quantisation: float = quantity(0.0, "y", lower=0.0).means("Resolution of the sensor; 0: none.")
    load_time: float = quantity(0.0, "s", lower=0.0).means(
        "When a load step enters before the process."
    )
    load_size: float = quantity(0.0, "u").means("Height of the load step; 0: none.")
    drift: float = quantity(0.0, "y/s").means("Slope added to the measurement.")

    def __post_init__(self) -> None:
        check(self, ParameterError)


class VirtualProcess:
    """A process that rests at its operating point until it is commanded.

    >>> from relay_autotune import TransferFunction, VirtualProcess
    >>> tank = VirtualProcess(TransferFunction.fopdt(0.8, 12.0, 3.0), rest_measurement=61.0)
    >>> tank.command(10.0)
    >>> [round(tank.measure(t), 2) for t in (3.0, 15.0, 100.0)]
    [61.0, 66.06, 69.0]

    :param model: the process.
    :param rest_measurement: measurement at the operating point, y0 [y].
    :param rest_command: command at the operating point, u0 [u].
    :param actuator: turns commands into the input of the model; default: an ideal one.
    :param disturbances: noise, load and drift; default: none.
    :param seed: seed of the noise; the same seed gives the same noise for the same samples.
    """

    def __init__(
        self,
        model: TransferFunction,
        *,
        rest_measurement: float = 0.0,
        rest_command: float = 0.0,
        actuator: Actuator | None = None,
        disturbances: Disturbances | None = None,
        seed: int = 0,
    ) -> None:
        self._plant = Plant(model, initial_command=rest_command)
        self._actuator = actuator or Actuator(rest_command)
        self._disturbances = disturbances or Disturbances()
        self._rest_measurement = rest_measurement
        self._noise = np.random.default_rng(seed).standard_normal
        self._position = self._actuator.move(rest_command)
        self._load_waits = self._disturbances.load_size != 0.0
        self._load = 0.0

    @property
    def time(self) -> float:
        """Present time of the process [s]."""
        return self._plant.time

    @property
    def position(self) -> float:
        """Position of the actuator [u]."""
        return self._actuator.position

    def command(self, value: float, time: float | None = None) -> None:
        """Give a command that holds until the next one.

        :param value: [u]; ignored if it is not finite.
        :param time: when it takes effect, not before the present time [s]; default: now.
        """
        if time is not None:
            self._advance(time)
        self._position = self._actuator.move(value)

    def measure(self, time: float) -> float:
        """Move to ``time`` and return the sensor's value there [y].

        :param time: not before the present time [s].
        """
        acting = self._disturbances
        y = self._rest_measurement + self._advance(time) + acting.drift * time
        if acting.noise_std > 0.0:
            y += acting.noise_std * self._noise()
        if acting.quantisation > 0.0:
            y = round(y / acting.quantisation) * acting.quantisation
        return y

    def _advance(self, time: float) -> float:
        if self._load_waits and time >= self._disturbances.load_time:
            # The step enters at its own instant, not at a sample.
            self._load_waits = False
            self._plant.advance(
                max(self._disturbances.load_time, self._plant.time), self._position
            )
            self._load = self._disturbances.load_size
        return self._plant.advance(time, self._position + self._load)
