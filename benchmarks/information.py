# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a record can tell of K_u at best: the Cramer-Rao bound."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from processes import true_point

from relay_autotune.process.response import response
from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    LAG_COMPLEX,
    LAG_N_ZERO,
    UNSTABLE_FOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record

FloatArray = NDArray[np.float64]

_STEP = 1e-5
# A direction counts as unknown if its information is below this part of the largest one.
_UNSEEN = 1e-13
_FELT = 1e-9


def relative_bounds(
    model: TransferFunction, record: Record, noise_std: float, times: FloatArray
) -> FloatArray:
    """Return the least standard deviation of K_u over K_u that any unbiased estimate can have.

    With J the derivatives of the samples up to each time by the parameters of the true structure
    and by an offset, and g that of K_u,  sqrt(g (J'J/s^2)^-1 g').

    :param model: the true process, its structure known; equal lags are one parameter.
    :param record: its commands and the times of its samples.
    :param noise_std: of white Gaussian noise, s [y].
    :param times: shape (m,) [s].
    :return: shape (m,); infinite where the samples do not show K_u.
    """
    build, values = _parameters(model)
    gain = true_point(model).gain
    rows, gradient = [], []
    u = record.input()
    for i, value in enumerate(values):
        ends = [values.copy(), values.copy()]
        ends[0][i] += _STEP * value
        ends[1][i] -= _STEP * value
        up, down = build(ends[0]), build(ends[1])
        change = response(up, record.time, u) - response(down, record.time, u)
        rows.append(change / (2.0 * _STEP * abs(value)))
        gains = true_point(up).gain - true_point(down).gain
        gradient.append(gains / (2.0 * _STEP * abs(value) * gain))
    jacobian = np.array([*rows, np.ones(record.time.size)])
    size = np.linalg.norm(jacobian, axis=1)
    jacobian, g = jacobian / size[:, None] / noise_std, np.array([*gradient, 0.0]) / size
    found = []
    for t in times:
        part = jacobian[:, : int(np.searchsorted(record.time, t, side="right"))]
        information, directions = np.linalg.eigh(part @ part.T)
        along = directions.T @ g
        seen = information > _UNSEEN * information.max()
        hidden = np.abs(along[~seen]).max(initial=0.0) > _FELT * np.abs(along).max()
        variance = float(np.sum(along[seen] ** 2 / information[seen]))
        found.append(math.inf if hidden else math.sqrt(variance))
    return np.array(found)


def _parameters(
    model: TransferFunction,
) -> tuple[Callable[[FloatArray], TransferFunction], FloatArray]:
    """Return the transfer function of any values of the true structure, and the true values."""
    order, delay, gain = model.order, model.dead_time, model.gain
    constants, zeros = model.time_constants, [z.real for z in model.zeros]
    lags = [t.real for t in constants if t.imag == 0.0]
    build = TransferFunction
    match model.structure:
        case "lag_n":
            return lambda v: build.lag_n(v[0], v[1], order, v[2]), np.array((gain, lags[0], delay))
        case "lag_n_zero":
            return (
                LAG_N_ZERO.of_order(order).build,
                np.array((gain, lags[0], zeros[0], delay)),
            )
        case "lag_complex":
            pair = next(t for t in constants if t.imag != 0.0)
            return (
                LAG_COMPLEX.build,
                np.array((gain, lags[0], 1.0 / abs(pair), pair.real / abs(pair), delay)),
            )
        case "fopdt":
            return lambda v: build.fopdt(v[0], v[1], v[2]), np.array((gain, lags[0], delay))
        case "sopdt":
            return (
                lambda v: build.sopdt(v[0], (v[1], v[2]), v[3]),
                np.array((gain, lags[0], lags[1], delay)),
            )
        case "unstable_fopdt":
            return (
                UNSTABLE_FOPDT.build,
                np.array((abs(gain), abs(lags[0]), delay)),
            )
        case "integrator_inverse":
            return (
                INTEGRATOR_INVERSE.build,
                np.array((gain, -zeros[0], lags[0], delay)),
            )
    raise ValueError(f"no parameters of a {model.structure} are known here")
