# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Exact response of a process to a held input, and its exact transfer function in z.

A command is given at each sample and held until the next one. With the step response s, a dead
time D and the period h,

    G(z) = (1 - z^-1) sum_{m >= 1, m h >= D} s(m h - D) z^-m,

where the sum has a closed form, since s is the free motion of a linear system.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.process.modes import Coordinates, Modes
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant


def response(model: TransferFunction, time: ArrayLike, u: PiecewiseConstant) -> FloatArray:
    """Return the output's deviation from rest, exact for any real dead time.

    The process rests at ``u.initial`` before the first change of the input (an integrating
    process: in balance). Nothing is discretised: between the delayed changes the response is
    evaluated in closed form at the given times.

    :param model: the process.
    :param time: times of the output [s], any shape and order.
    :param u: the input.
    :return: deviation of y, shape of ``time``.
    """
    t = np.asarray(time, dtype=np.float64)
    flat = t.ravel()
    changes = u.times + model.dead_time
    if changes.size == 0 or flat.size == 0:
        return np.zeros(t.shape)
    end = max(float(flat.max()), float(changes[-1]))
    modes = Modes.of(model, horizon=max(end - float(changes[0]), np.finfo(float).tiny))
    steps = np.diff(u.values, prepend=u.initial)
    z = coordinates_at_changes(modes, changes, steps)
    segment = np.searchsorted(changes, flat, side="right") - 1
    after = segment >= 0
    y = np.zeros(flat.shape)
    index = segment[after]
    weights = [w[index] for w in modes.weights(z)]
    y[after] = modes.outputs(weights, flat[after] - changes[index])[:, 0]
    return y.reshape(t.shape)


def coordinates_at_changes(
    modes: Modes, changes: FloatArray, steps: FloatArray, *, backward: bool = False
) -> Coordinates:
    """Return the coordinates just after each change of the input, from rest before the first.

    :param modes: the process.
    :param changes: instants of the changes of the delayed input [s], shape (m,).
    :param steps: height of each change, shape (m,).
    :param backward: True: the growing modes are followed backward, from zero just after the last
        change, so that they stay bounded; their true motion differs by a multiple of their own
        free motion.
    :return: shape (m, modes.size).
    """
    forward = modes.propagators(np.diff(changes))
    growing = modes.growing
    backward = backward and bool(np.any(growing))
    if backward:
        # The growing modes are followed backward below.
        forward[:, growing, :] = 0.0
    kicks = steps[:, None] * modes.input_direction
    z = np.empty((changes.size, modes.size), dtype=np.result_type(forward, kicks))
    z[0] = kicks[0]
    for k in range(1, changes.size):
        z[k] = forward[k - 1] @ z[k - 1] + kicks[k]
    if backward:
        back = modes.propagators(-np.diff(changes))
        z[-1, growing] = 0.0
        for k in range(changes.size - 1, 0, -1):
            z[k - 1, growing] = (back[k - 1] @ (z[k] - kicks[k]))[growing]
    return z


# A dead time of a whole number of periods is recognised in spite of this relative rounding.
_ROUNDING = 1e-9


class HeldProcess:
    """A process whose input is held between samples, as a function of z.

    :param model: the process, with the dead time of the loop, but none for the hold.
    :param period: of the samples [s].
    :param delay: further samples until a command takes effect.
    """

    def __init__(self, model: TransferFunction, period: float, delay: int = 0) -> None:
        self.model = model
        self.period = period
        wait = max(math.ceil(model.dead_time / period * (1.0 - _ROUNDING)), 1)
        self._first = max(wait * period - model.dead_time, 0.0)
        self._wait = wait + delay
        self._modes = Modes.of(model)

    def __call__(self, z: ComplexArray) -> ComplexArray:
        """Return y/u at each z, shape (n,).

        :param z: on the unit circle or outside, no pole of the process, not 1 if it integrates.
        """
        moved = self._modes.step_transform(z, self._first, self.period)
        return np.asarray((1.0 - 1.0 / z) * z ** float(-self._wait) * moved)

    @property
    def unstable_poles(self) -> int:
        """Number of its poles outside the unit circle."""
        return sum(1 for t in self.model.time_constants if t.real < 0.0)
