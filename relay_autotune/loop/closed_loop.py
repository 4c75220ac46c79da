# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A sampled controller on the exact process."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.sampled import SampledController, SampledPid
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import Plant


@dataclass(frozen=True)
class ClosedLoop:
    """Deviations from the operating point in a closed loop.

    :param time: s, shape (n,).
    :param measurement: y, shape (n,), without the noise.
    :param command: u, shape (n,), held from each sample to the next.
    """

    time: FloatArray
    measurement: FloatArray
    command: FloatArray


def simulate_closed_loop(
    controller: Controller | SampledController,
    model: TransferFunction,
    *,
    period: float,
    duration: float,
    setpoint: float = 0.0,
    load: float = 0.0,
    load_time: float = 0.0,
    low: float = -math.inf,
    high: float = math.inf,
    noise: FloatArray | None = None,
) -> ClosedLoop:
    """Run a controller at its sampling period; the process is exact between samples.

    >>> from relay_autotune import Controller, TransferFunction, simulate_closed_loop
    >>> oven = TransferFunction.fopdt(1.65, 20.0, 10.0)
    >>> run = simulate_closed_loop(
    ...     Controller(kc=0.6, ti=20.0), oven, period=0.5, duration=300.0, setpoint=1.0)
    >>> print(f"{run.measurement[-1]:.3f} y, {run.command[-1]:.3f} u")
    1.000 y, 0.606 u

    :param controller: PI or PID gains, which :class:`SampledPid` runs, or any other controller of
        this period, at rest.
    :param model: the process, at rest, without the half period that a design adds to it.
    :param period: sampling period [s].
    :param duration: s.
    :param setpoint: step of the set-point at t = 0 [y].
    :param load: step of the load at the process input [u].
    :param load_time: instant of that step [s].
    :param low: least command [u]; only for gains.
    :param high: largest command [u]; only for gains.
    :param noise: noise on each sample of the controller [y], shape (n,); None: no noise.
    :raises TuningError: if the period is not positive or the limits leave no range.
    """
    law: SampledController
    if isinstance(controller, Controller):
        law = SampledPid(controller, period, low=low, high=high)
    else:
        law = controller
    plant = Plant(model)
    time = np.arange(int(duration / period) + 1, dtype=np.float64) * period
    seen = np.zeros(time.size) if noise is None else noise
    measurement, command = np.empty(time.size), np.empty(time.size)
    output = 0.0
    for k, t in enumerate(time):
        disturbed = output + (load if t > load_time else 0.0)
        measurement[k] = plant.advance(float(t), disturbed)
        command[k] = output = law.step(setpoint, float(measurement[k] + seen[k]))
    return ClosedLoop(time, measurement, command)
