# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A simulated process in a loop: actuator, exact dynamics, disturbances and sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.errors import ParameterError
from relay_autotune.process.actuator import Actuator
from relay_autotune.process.plant import Plant
from relay_autotune.process.transfer_function import TransferFunction


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
