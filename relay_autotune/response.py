"""Exact response of a process to a piecewise-constant input."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from relay_autotune.models import TransferFunction
from relay_autotune.modes import Modes
from relay_autotune.record import PiecewiseConstant

FloatArray = NDArray[np.float64]


def response(model: TransferFunction, time: ArrayLike, u: PiecewiseConstant) -> FloatArray:
    """Return the output's deviation from rest, exact for any real dead time.

    The process rests at ``u.initial`` before the first change of the input (an integrating
    process: in balance). Nothing is discretised: between the delayed changes the response is
    evaluated in closed form at the times asked for.

    :param model: the process.
    :param time: when the output is wanted [s], any shape and order.
    :param u: the input.
    :return: deviation of y, shape of ``time``.
    """
    t = np.asarray(time, dtype=np.float64)
    flat = t.ravel()
    changes = u.times + model.dead_time
    if changes.size == 0 or flat.size == 0:
        return np.zeros(t.shape)
    end = max(float(flat.max()), float(changes[-1]))
    modes = Modes(model, horizon=max(end - float(changes[0]), np.finfo(float).tiny))
    steps = np.diff(u.values, prepend=u.initial)
    z = np.empty((changes.size, modes.size), dtype=np.complex128)
    current = modes.rest()
    for k in range(changes.size):
        if k:
            current = modes.move(current, float(changes[k] - changes[k - 1]))
        current = current + steps[k] * modes.input_direction
        z[k] = current
    segment = np.searchsorted(changes, flat, side="right") - 1
    after = segment >= 0
    y = np.zeros(flat.shape)
    index = segment[after]
    weights = [w[index] for w in modes.weights(z)]
    y[after] = modes.output(weights, flat[after] - changes[index])
    return y.reshape(t.shape)
