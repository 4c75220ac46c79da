# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The proportional gains between which a loop without integral action is stable."""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import unstable_at_small_gain


def stable_gains(
    model: TransferFunction, grid: FloatArray, td: float, tf: float
) -> tuple[float, float] | None:
    """Return the first range of proportional gains that keeps ``kp (1 + td s) F G`` stable.

    Each crossing of the negative real axis moves a pair of closed-loop poles to the right where
    the phase falls with frequency, to the left where it rises; the count starts from the process'
    own. Crossings are interpolated on the grid: a range to search in, not a proof.

    :param model: the process.
    :param grid: rad/s, shape (n,), increasing, fine enough to follow the phase.
    :param td: derivative time [s].
    :param tf: time constant of the filter [s].
    :return: lower and upper end, both >= 0, the upper one infinite where no gain is too large;
        None: no gain stabilises the loop.
    """
    filtered = 1.0 + 1j * grid * tf - 0.5 * (grid * tf) ** 2
    phase = model.phase(grid) + np.arctan(grid * td) - np.angle(filtered)
    size = np.log(np.abs(model(1j * grid) * (1.0 + 1j * grid * td) / filtered))
    turns = (phase + math.pi) / (2.0 * math.pi)
    level = np.floor(turns)
    cells = np.flatnonzero(np.diff(level) != 0.0)
    target = np.maximum(level[cells], level[cells + 1])
    change = turns[cells + 1] - turns[cells]
    share = (target - turns[cells]) / change
    gains = np.exp(-(size[cells] + share * (size[cells + 1] - size[cells])))
    crossings = list(zip(gains.tolist(), np.where(change < 0.0, 2, -2).tolist(), strict=True))
    if model.integrators == 0 and model.gain * model.process_sign < 0.0:
        rise = sum(z.real for z in model.zeros) - sum(t.real for t in model.time_constants)
        crossings.append((1.0 / abs(model.gain), -1 if rise + td - tf > model.dead_time else 1))
    on_the_right = unstable_at_small_gain(model)
    low = 0.0 if on_the_right == 0 else math.nan
    for gain, moved in sorted(crossings):
        on_the_right += moved
        if math.isnan(low) and on_the_right == 0:
            low = gain
        elif not math.isnan(low) and on_the_right > 0:
            return low, gain
    return None if math.isnan(low) else (low, math.inf)
