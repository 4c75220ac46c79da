# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Effect of measurement noise on the command of a sampled controller."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.loop.gains import ControlLaw, Controller
from relay_autotune.loop.margins import frequencies
from relay_autotune.loop.sampled import filter_matrices
from relay_autotune.process.transfer_function import TransferFunction

_ANGLES = 2048

# Grid of filter time constant over sampling period, for interpolation.
_RATIOS = np.geomspace(1e-3, 1e4, 141)


@lru_cache(maxsize=1)
def _moments() -> FloatArray:
    """Return var(yf), cov(yf, h yf') and var(h yf') for each of ``_RATIOS``, shape (3, n)."""
    motions = [filter_matrices(float(ratio), 1.0) for ratio in _RATIOS]
    turn, past, present = (np.array(part) for part in zip(*motions, strict=True))
    # Scaled to the filter's time constant, both states have one order of magnitude.
    size = np.stack((np.ones(_RATIOS.size), _RATIOS), axis=1)
    turn, past, present = turn * size[:, :, None] / size[:, None, :], past * size, present * size
    # State and next sample are correlated only by the sample before.
    shared = _outer((turn @ present[..., None])[..., 0], past)
    drive = _outer(past, past) + _outer(present, present) + shared + shared.swapaxes(1, 2)
    twice = turn[:, :, None, :, None] * turn[:, None, :, None, :]
    operator = np.eye(4) - twice.reshape(-1, 4, 4)
    covariance = np.linalg.solve(operator, drive.reshape(-1, 4, 1))
    return covariance[:, [0, 1, 3], 0].T / np.stack((size[:, 0], _RATIOS, _RATIOS**2))


def _outer(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the outer products of vectors, shape (n, 2, 2)."""
    return np.asarray(left[:, :, None] * right[:, None, :])


def open_noise_gain(td: FloatArray, tf: FloatArray, period: float) -> FloatArray:
    """Return the standard deviation of ``yf + td dyf/dt`` per that of white sampled noise.

    Multiplied by kc it is the standard deviation of the command, without the integral part and
    without feedback through the loop.

    :param td: derivative times [s], shape (k,).
    :param tf: time constants of the filter [s], shape (k,).
    :param period: period of the samples [s].
    """
    at = np.log(np.maximum(tf / period, _RATIOS[0]))
    value, mixed, slope = (np.interp(at, np.log(_RATIOS), row) for row in _moments())
    lead = td / period
    return np.sqrt(value + 2.0 * lead * mixed + lead**2 * slope)


def filter_for(td: FloatArray, largest: FloatArray, period: float) -> FloatArray:
    """Return the least time constant of the filter that keeps the noise gain within a limit.

    :param td: derivative times [s], shape (k,).
    :param largest: largest allowed :func:`open_noise_gain`, shape (k,).
    :param period: period of the samples [s].
    :return: s, shape (k,); infinite: no usable time constant is enough.
    """
    value, mixed, slope = _moments()
    lead = (td / period)[:, None]
    gains = np.sqrt(value + 2.0 * lead * mixed + lead**2 * slope)
    # Beyond some time constant the noise gain only falls.
    keeps = gains <= largest[:, None]
    first = np.where(keeps.any(axis=1), keeps.argmax(axis=1), _RATIOS.size)
    inside = np.clip(first, 1, _RATIOS.size - 1)
    rows = np.arange(td.size)
    above, below = np.log(gains[rows, inside - 1]), np.log(gains[rows, inside])
    share = np.clip((above - np.log(largest)) / np.maximum(above - below, 1e-300), 0.0, 1.0)
    steps = np.log(_RATIOS)
    found = np.exp(steps[inside - 1] + share * (steps[inside] - steps[inside - 1])) * period
    found = np.where(first == 0, 0.0, found)
    return np.where(first == _RATIOS.size, math.inf, found)


def noise_gain(controller: ControlLaw, model: TransferFunction, period: float) -> float:
    """Return the standard deviation of the command per that of white measurement noise.

    The noise of the samples reaches the command directly and around the loop, in which the command
    is held for a period. A PI or PID controller is computed as
    :class:`~relay_autotune.loop.sampled.SampledPid` runs it.

    :param controller: the controller of a stable loop.
    :param model: the process, with all dead time of the loop, that of the hold included.
    :param period: period of the samples [s]; 0: the largest magnitude from noise to command, an
        upper bound for every period.
    :return: u/y.
    """
    if period == 0.0:
        grid = frequencies(*controller.characteristic(model))
        s = 1j * grid
        return float(np.abs(controller(s) / (1.0 + controller(s) * model(s))).max())
    angle = (np.arange(_ANGLES) + 0.5) * (math.pi / _ANGLES)
    s = 1j * angle / period
    sampled = _sampled(controller, angle, period)
    held = model(s) * np.sinc(angle / (2.0 * math.pi))
    return float(np.sqrt(np.mean(np.abs(sampled / (1.0 + sampled * held)) ** 2)))


def _sampled(controller: ControlLaw, angle: FloatArray, period: float) -> ComplexArray:
    if not isinstance(controller, Controller):
        return controller(1j * angle / period)
    turn, past, present = filter_matrices(controller.tf, period)
    z = np.exp(1j * angle)
    # Transform of the state, by Cramer's rule.
    first, second = (past[k] + present[k] * z for k in (0, 1))
    (f11, f12), (f21, f22) = turn.tolist()
    determinant = (z - f11) * (z - f22) - f12 * f21
    value = ((z - f22) * first + f12 * second) / determinant
    slope = ((z - f11) * second + f21 * first) / determinant
    integral = controller.i * period * z / (z - 1.0)
    return np.asarray(controller.kc * (value + controller.td * slope) + integral * value)
