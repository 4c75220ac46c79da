# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The frequencies at which the bounds of a design are tested."""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.transfer_function import TransferFunction


def design_grid(model: TransferFunction, frequency: float) -> FloatArray:
    """Return the frequencies at which bounds are tested [rad/s].

    :param model: the process.
    :param frequency: about which the loop is closed [rad/s].
    """
    parts = [
        frequency * np.geomspace(low, high, count)
        for low, high, count in ((1e-3, 0.1, 70), (0.1, 10.0, 220), (10.0, 100.0, 60))
    ]
    if model.dead_time > 0.0:
        # With derivative action a lag of first order lets every turn pass alike, up to the filter.
        flat = len(model.time_constants) + model.integrators - len(model.zeros) <= 1
        turns = np.arange(0.1, (24.0 if flat else 8.0) * math.pi, 0.2) / model.dead_time
        parts.append(turns[turns < 300.0 * frequency])
    for c in (*model.zeros, *model.time_constants):
        if c.imag > 0.0 and abs(c.real) < 0.5 * abs(c):
            width = abs(c.real) / abs(c)
            around = (1.0 + width * np.linspace(-6.0, 6.0, 49)) / abs(c)
            parts.append(around[around > 0.0])
    return np.unique(np.concatenate(parts))
