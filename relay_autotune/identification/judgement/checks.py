# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Checks whether a model is the process, and that linear, on the data that it was fitted to."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.moves import PAST, law_of
from relay_autotune.record.record import Record

_SURE = 4.5
_LEAST_ASYMMETRY = 0.05
_OTHER_AMPLITUDE = 1.2
# Least number of samples in a cycle: with fewer, straight lines between them miss more than 1 %.
_LEAST_SAMPLES = 24
# Relative difference up to which curves count as the same.
_ALIKE = 1e-6
# The last samples of a record that are looked at.
_MOST_CHANGES = 20_000
# Numbers of a law.
_NUMBERS = 2 * PAST + 2
# Least number of means in a model's response, in which it then does not answer at once, and in the
# record.
_BLOCKS_OF_RESPONSE, _BLOCKS = 20.0, 100
# Frequencies over which a spectrum is averaged.
_NEAR = 5
# Largest pole of a law that integrates, as it is found in noise: up to 1.04 in recorded loops, and
# 1.08 to 8 where it was the process.
_INTEGRATES = 1.05


def read_backward(record: Record, model: TransferFunction, fitted: FloatArray) -> float | None:
    """Return how much of the command is a controller's whose inverse the model is, 0 to 1.

    With the law of a controller, ``(1 - A) u = B y + v``, and the process, ``y = G u + e``,

        (1 - A - B G) u = B e + v,

    the command comes from v, which was given from outside as a set-point is, and from e, noise and
    loads, to which the controller answered. Where e outweighs v, a fit may find G = (1 - A)/B, the
    law read backward: exactly there ``|B e| = |v|``. So the part of the command's power over
    frequency on which G is that inverse, ``d = 1 - |1 - G B/(1 - A)|^2``, counts by
    ``|B e|^2/|v|^2``, at most 1. And a law follows each measurement at once, whereas a process
    answers later: no more counts than the share of what the command's own past does not tell of
    it that the measurement does (Granger 1969).

    All of it is asked of means of ever more samples, too, as long as these are short against the
    response: from row to row, rounding and noise hide a slow law, as that of an integral is. What
    the means leave of the command's power counts.

    A law follows the measurement; a command that stands still for longer than the whole response
    takes does not.

    The law of a controller is stable, or it integrates. One that grows is the process itself: it
    answers within the means, and its command from its answer, without the dead time, grows.

    :param record: any record.
    :param model: the model fitted to it.
    :param fitted: its measurement at the samples, NaN where it was not fitted, shape (n,).
    :return: None where samples are few, or the command moves no more often than a law has numbers,
        or the response is over before it moves again.
    """
    u, y = record.command[-_MOST_CHANGES:], record.measurement[-_MOST_CHANGES:]
    stays = np.diff(np.flatnonzero(np.diff(u)))
    answered = max(model.response_time / record.mean_interval, _NUMBERS)
    if 2 * np.count_nonzero(stays > answered) >= stays.size:
        return None
    e = np.nan_to_num(record.measurement - fitted)[-_MOST_CHANGES:]
    longest = min(
        model.response_time / (_BLOCKS_OF_RESPONSE * record.mean_interval), u.size / _BLOCKS
    )
    found = []
    for size in (1 << k for k in range(max(int(longest), 1).bit_length())):
        of, by, left = (
            x[: x.size // size * size].reshape(-1, size).mean(axis=1) for x in (u, y, e)
        )
        share = _read_backward(of, by, left, size * record.mean_interval, model)
        if share is not None:
            found.append(share * float(np.var(of) / np.var(u)))
    return max(found, default=None)


def _read_backward(
    u: FloatArray, y: FloatArray, e: FloatArray, interval: float, model: TransferFunction
) -> float | None:
    """Return what :func:`read_backward` does, of samples at one interval.

    :param u: the command, shape (n,).
    :param y: the measurement, shape (n,).
    :param e: what the model leaves of it, shape (n,).
    :param interval: s.
    :param model: the model.
    """
    u, y = u - u.mean(), y - y.mean()
    if u.size < _LEAST_SAMPLES or np.count_nonzero(np.diff(u)) <= _NUMBERS or not np.ptp(y) > 0.0:
        return None
    u_size, y_size = float(np.std(u)), float(np.std(y))
    e = e[PAST:] / y_size
    u, y = u / u_size, y / y_size
    now, (factors, v, alone) = u[PAST:], law_of(u, y)
    if not alone @ alone > _ALIKE * now.size:
        return None
    if np.abs(np.roots(np.append(1.0, -factors[:PAST]))).max() > _INTEGRATES:
        return 0.0
    follows = 1.0 - float(v @ v) / float(alone @ alone)
    w = 2.0 * math.pi * np.fft.rfftfreq(e.size, interval)[1:]
    delay = np.exp(-1j * w * interval) ** np.arange(PAST + 1)[:, None]
    answer, rest = factors[PAST:-1] @ delay, 1.0 - factors[:PAST] @ delay[1:]

    def power(x: FloatArray) -> FloatArray:
        return np.asarray(np.abs(np.fft.rfft((x - x.mean()) * np.hanning(x.size))[1:]) ** 2)

    def near(x: FloatArray) -> FloatArray:
        return np.convolve(x, np.ones(_NEAR), "same")

    weight = power(now)
    # Of a law without noise both are zero, to rounding.
    floor = _ALIKE**2 * near(np.abs(rest) ** 2 * weight)
    inner, outer = floor + near(np.abs(answer) ** 2 * power(e)), floor + near(power(v))
    share = np.minimum(inner / outer, 1.0)
    away = np.abs(1.0 - model(1j * w) * answer / rest * (u_size / y_size)) ** 2
    backward = float(weight @ (share * np.maximum(1.0 - away, 0.0))) / float(weight.sum())
    return min(follows, backward)


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
