# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Checks whether a process is linear, on the data that a linear model was fitted to."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record

_SURE = 4.5
_LEAST_ASYMMETRY = 0.05
_OTHER_AMPLITUDE = 1.2
# Least number of samples in a cycle: with fewer, straight lines between them miss more than 1 %.
_LEAST_SAMPLES = 24
# Relative difference up to which curves count as the same.
_ALIKE = 1e-6
# Earlier samples that a controller's law may hold, a PID's with a filter, and the last samples of
# a record that are looked at.
_PAST, _MOST_CHANGES = 3, 20_000


def read_backward(record: Record, model: TransferFunction) -> float | None:
    """Return how much of the command is a controller's whose inverse the model is, 0 to 1.

    A command that a controller makes, ``u_k = sum_i a_i u_(k-i) + sum_j b_j y_(k-j) + c``, follows
    each measurement at once, whereas a process answers later. The share s of what its own past
    does not tell of u and y does is the controller's (as in Granger 1969); the rest came from
    outside, and shows the process. With C = B/(1 - A) the law that was found and G the model, the
    part of the command's power over frequency on which G is 1/C, ``d = 1 - |1 - G C|^2``, tells
    whether the model is that law read backward. The number is ``s d``.

    :param record: any record.
    :param model: the model fitted to it.
    :return: None where samples are few, or the command does not vary.
    """
    u, y = (x[-_MOST_CHANGES:] - x.mean() for x in (record.command, record.measurement))
    if u.size < _LEAST_SAMPLES or not (np.ptp(u) > 0.0 and np.ptp(y) > 0.0):
        return None
    u_size, y_size = float(np.std(u)), float(np.std(y))
    u, y = u / u_size, y / y_size
    own = [u[_PAST - k : u.size - k] for k in range(1, _PAST + 1)]
    seen = [y[_PAST - k : y.size - k] for k in range(_PAST + 1)]
    now, constant = u[_PAST:], np.ones(u.size - _PAST)

    def fitted(rows: Sequence[FloatArray]) -> tuple[FloatArray, float]:
        columns = np.stack((*rows, constant), axis=1)
        factors = np.linalg.lstsq(columns, now, rcond=_ALIKE**1.5)[0]
        return factors, float(np.sum((now - columns @ factors) ** 2))

    _, alone = fitted(own)
    factors, left = fitted((*own, *seen))
    if not alone > _ALIKE * now.size:
        return None
    interval = record.mean_interval
    w = 2.0 * math.pi * np.fft.rfftfreq(u.size, interval)[1:]
    power = np.abs(np.fft.rfft(u * np.hanning(u.size))[1:]) ** 2
    delay = np.exp(-1j * w * interval) ** np.arange(_PAST + 1)[:, None]
    law = (factors[_PAST:-1] @ delay) / (1.0 - factors[:_PAST] @ delay[1:])
    away = np.abs(1.0 - model(1j * w) * law * (u_size / y_size)) ** 2
    alike = 1.0 - float(power @ np.minimum(away, 1.0)) / float(power.sum())
    return (1.0 - left / alone) * alike


def unequal_amplitudes(records: Sequence[Record], model: TransferFunction) -> str | None:
    """Say whether a process has another gain for larger changes of the command.

    Each record's response gets a gain of its own, in the least-squares sense, with an offset and
    a drift; a valve that sticks, or a flow that goes with the root of a pressure, has gains that
    depend on the amplitude.

    :param records: tests of one process, at least two.
    :param model: the model fitted to all of them, of a stable or integrating process.
    :return: a sentence, or None where all agree, or no amplitude is a fifth larger than another.
    """
    if model.grows:
        return None
    swings, gains, deviations = [], [], []
    for record in records:
        u = record.input()
        swings.append(0.5 * float(np.ptp(u.levels)))
        factor, deviation = _factor(record, response(model, record.time, u))
        gains.append(factor)
        deviations.append(deviation)
    least, most = int(np.argmin(swings)), int(np.argmax(swings))
    if not swings[most] > _OTHER_AMPLITUDE * swings[least]:
        return None
    uncertainty = math.hypot(deviations[least], deviations[most])
    if abs(gains[most] - gains[least]) <= max(_SURE * uncertainty, _LEAST_ASYMMETRY):
        return None
    return (
        f"a command that moves by {swings[least]:.3g} to either side acts {gains[least]:.2f} "
        f"times as strongly as in the model, one of {swings[most]:.3g} {gains[most]:.2f} times: "
        "the process is not linear; tune with an amplitude like that of its normal operation"
    )


def _factor(record: Record, answer: FloatArray) -> tuple[float, float]:
    """Return the factor of a response in a record, and its standard deviation.

    An offset and a drift are estimated with it.

    :param answer: of the record's length.
    """
    line = record.time - record.time.mean()
    columns = np.stack((answer, np.ones(len(record)), line))
    size = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    size[size == 0.0] = 1.0
    scaled = columns / size[:, None]
    factors = np.linalg.lstsq(scaled.T, record.measurement, rcond=_ALIKE)[0]
    residual = record.measurement - factors @ scaled
    covariance = np.linalg.pinv(scaled @ scaled.T, rcond=_ALIKE**2)
    variance = float(residual @ residual) / residual.size * float(covariance[0, 0])
    return float(factors[0] / size[0]), math.sqrt(max(variance, 0.0)) / float(size[0])
