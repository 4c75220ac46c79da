# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A simulated process in a loop: actuator, exact dynamics, disturbances and sensor."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from relay_autotune.errors import ModelError, ParameterError
from relay_autotune.process.response import Modes
from relay_autotune.process.transfer_function import TransferFunction


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


@dataclass(frozen=True)
class Disturbances:
    """Disturbances of a process.

    >>> from relay_autotune import Disturbances
    >>> Disturbances(noise_std=0.02, load_time=60.0, load_size=0.5).load_size
    0.5

    :param noise_std: standard deviation of white Gaussian noise on each sample [y], >= 0.
    :param quantisation: step of the sensor's resolution [y], >= 0; 0: none.
    :param load_time: instant of a load step, which adds to the actuator's position [s], >= 0.
    :param load_size: its height [u]; 0: no load step.
    :param drift: slope of the measurement that no command causes [y/s].
    :raises ParameterError: if a value is out of its range.
    """

    noise_std: float = 0.0
    quantisation: float = 0.0
    load_time: float = 0.0
    load_size: float = 0.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        for name in ("noise_std", "quantisation", "load_time"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ParameterError(f"{name} must be finite and not negative, found {value}")
        for name in ("load_size", "drift"):
            if not math.isfinite(getattr(self, name)):
                raise ParameterError(f"{name} must be finite, found {getattr(self, name)}")


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
