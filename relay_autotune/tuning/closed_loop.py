"""A sampled PI or PID controller on the exact process."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import TuningError
from relay_autotune.models import TransferFunction
from relay_autotune.simulation import Plant
from relay_autotune.tuning.gains import Controller

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ClosedLoop:
    """Deviations from the operating point in a closed loop.

    :param time: s, shape (n,).
    :param measurement: y, shape (n,).
    :param command: u, shape (n,), held from each sample to the next.
    """

    time: FloatArray
    measurement: FloatArray
    command: FloatArray


def simulate_closed_loop(
    controller: Controller,
    model: TransferFunction,
    *,
    period: float,
    duration: float,
    setpoint: float = 0.0,
    load: float = 0.0,
    load_time: float = 0.0,
) -> ClosedLoop:
    """Run a PI controller at its sampling period; between samples the process moves exactly.

    The integral is advanced by the backward rule: ``I += kc period/ti e`` before the output.

    :param controller: the gains, PI.
    :param model: the process, at rest.
    :param period: sampling period [s].
    :param duration: s.
    :param setpoint: step of the set-point at t = 0 [y].
    :param load: step of the load at the process input [u].
    :param load_time: when it comes [s].
    :raises TuningError: if the controller has derivative action.
    """
    if controller.td > 0.0:
        raise TuningError("the sampled closed loop is for PI control, found td > 0")
    plant = Plant(model)
    time = np.arange(int(duration / period) + 1, dtype=np.float64) * period
    measurement, command = np.empty(time.size), np.empty(time.size)
    integral = output = 0.0
    for k, t in enumerate(time):
        disturbed = output + (load if t > load_time else 0.0)
        y = plant.advance(float(t), disturbed)
        integral += controller.i * period * (setpoint - y)
        output = controller.kc * (controller.b * setpoint - y) + integral
        measurement[k], command[k] = y, output
    return ClosedLoop(time, measurement, command)
