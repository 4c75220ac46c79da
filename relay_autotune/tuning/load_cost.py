# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""Integrated absolute errors of many controllers at once, after a step of the load.

The error's own integral is ``1/ki`` exactly, whatever the process; only the part of the other
sign has to be followed,

    IAE = 1/ki + 2 int max(-y, 0) dt,

which is small for well damped loops, so that few points suffice.
"""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.transfer_function import TransferFunction

_POINTS = 512
_RESETS, _TURNS = 6.0, 5.0
_DECAY = math.log(1e8)


def load_iaes(
    model: TransferFunction,
    kp: FloatArray,
    ki: FloatArray,
    td: FloatArray,
    tf: FloatArray,
    frequency: float,
) -> FloatArray:
    """Return the IAE of a unit step of the load for each controller [y s/u].

    The response is inverted by a fast Fourier transform along ``Re s = sigma`` (Dubner and Abate
    1968), the dead time being exact.

    :param model: the process.
    :param kp: proportional gains, positive, of stable loops, shape (k,).
    :param ki: integral gains, shape (k,).
    :param td: derivative times [s], shape (k,).
    :param tf: time constants of the filter [s], shape (k,).
    :param frequency: at which loops of this process oscillate if at all [rad/s].
    """
    reset = kp / ki
    if model.is_stable:
        # With a small gain the response is that of the integral alone.
        reset = reset + 1.0 / (ki * abs(model.gain))
    duration = _RESETS * reset + _TURNS * 2.0 * math.pi / frequency
    period = 2.0 * duration[:, None]
    sigma = _DECAY / period
    s = sigma + 1j * np.arange(_POINTS + 1) * (2.0 * math.pi / period)
    p, i, d, f = (values[:, None] for values in (kp, ki, td, tf))
    process = model.process_sign * model(s)
    controller = (p * (1.0 + d * s) + i / s) / (1.0 + f * s + 0.5 * (f * s) ** 2)
    smooth = np.sinc(np.arange(_POINTS + 1) / _POINTS)
    transform = process / (s * (1.0 + controller * process)) * smooth
    step = period / (2 * _POINTS)
    time = np.arange(_POINTS) * step
    y = np.fft.irfft(transform, axis=-1)[:, :_POINTS] * np.exp(sigma * time) / step
    return np.asarray(1.0 / ki + 2.0 * step[:, 0] * np.maximum(-y, 0.0).sum(axis=1))
