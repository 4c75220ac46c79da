# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The set-point weight b that avoids an unnecessary overshoot after a set-point step."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relay_autotune.loop.gains import Controller
from relay_autotune.loop.responses import ClosedLoopTransforms, abscissae, inverted
from relay_autotune.process.transfer_function import TransferFunction

_WEIGHTS = np.linspace(0.0, 1.0, 101)
_POINTS = 2048
_RESETS, _TURNS = 8.0, 6.0
# Allowed overshoot, and what is allowed beyond the least overshoot if that is larger: to avoid the
# last part with b = 0 would make the response much slower.
_OVERSHOOT, _SPARE = 0.05, 0.02


def with_setpoint_weight(
    controller: Controller, model: TransferFunction, frequency: float
) -> Controller:
    """Return the controller with the largest weight b without unnecessary overshoot.

    The response is ``y_i + b y_p``, with one part from the integral and one from the proportional
    action, so all weights are compared at the cost of one simulation. The largest b is taken
    whose overshoot is at most 5 %, or at most 2 % more than the least.

    :param controller: PI or PID, of a stable loop.
    :param model: the process, with all dead time of the loop.
    :param frequency: about which the loop is closed [rad/s].
    """
    reset = controller.ti
    if model.is_stable:
        reset += 1.0 / abs(controller.i * model.gain)
    duration = _RESETS * reset + _TURNS * 2.0 * math.pi / frequency
    to = ClosedLoopTransforms(controller, model)
    at = abscissae(duration, _POINTS)
    through = to.measurement_from_load(at) / at
    proportional = inverted(controller.kc * through, duration)
    integral = inverted(controller.i * through / at, duration)
    highest = np.array([float((integral + b * proportional).max()) for b in _WEIGHTS])
    overshoot = np.maximum(highest - 1.0, 0.0)
    allowed = max(_OVERSHOOT, float(overshoot.min()) + _SPARE)
    best = int(np.flatnonzero(overshoot <= allowed)[-1])
    return replace(controller, b=float(_WEIGHTS[best]))
