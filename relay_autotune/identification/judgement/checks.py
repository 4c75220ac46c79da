# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Checks whether a process is linear, on the data that a linear model was fitted to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.residuals import effective_sample_fraction
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record

_SURE = 4.5
_LEAST_ASYMMETRY = 0.05
_OTHER_AMPLITUDE = 1.2
# Least number of samples in a cycle: with fewer, straight lines between them miss more than 1 %.
_LEAST_SAMPLES = 24
# Levels at which the effect of a command may end, in shares of its range; beside its first level.
_SHARES = (0.25, 0.5, 0.75)
# Relative difference up to which curves count as the same.
_ALIKE = 1e-6
_LEVELS, _MOST_SAMPLES, _SURE_LOSS = 3, 2000, 3.0
# Least range of the command on one side but for few samples [%], as a share of the whole range.
_BUT_FEW, _OWN = (1.0, 99.0), 0.2
# Earlier samples that a controller's law may hold, a PID's with a filter, and the last samples of
# a record that are looked at.
_PAST, _MOST_CHANGES = 3, 20_000


def lost_effect(
    record: Record, model: TransferFunction, fitted: FloatArray | None = None
) -> tuple[float, float] | None:
    """Return how much of their effect commands lose on one side of a level, and that level.

    The parts of the command above and below a level get a gain each, a and b, in the least-squares
    sense; the loss is ``(|a - b| - 3 sigma)/max(|a|, |b|)``, with sigma the standard deviation of
    the difference, at the level where it is largest. Where an actuator is at its end it is 1.

    :param record: any record.
    :param model: the model fitted to it.
    :param fitted: the fitted measurement [y], shape (n,), NaN where there is none. What of it is
        no response, as a way back to rest, has a size of its own. None: offset and drift alone.
    :return: None where the command has two levels alone, samples are few, or the process grows
        by itself.
    """
    if model.grows or len(record) < _LEAST_SAMPLES:
        return None
    u = record.input()
    levels = np.unique(np.append(u.values, u.initial))
    if levels.size < _LEVELS or not np.ptp(levels) > 0.0:
        return None
    few = np.unique(np.linspace(0, len(record) - 1, _MOST_SAMPLES).astype(np.int64))
    part = replace(
        record,
        time=record.time[few],
        measurement=record.measurement[few],
        command=record.command[few],
        receive_time=np.empty(0),
        command_time=np.empty(0),
        cycle_start=(),
    )
    beside = []
    if fitted is not None and len(fitted) == len(record):
        beside.append((fitted - response(model, record.time, u))[few])
    inner = levels[0] + np.array(_SHARES) * np.ptp(levels)
    held = u(record.time)
    found = []
    for level in (*inner, u.initial):
        if not levels[0] < level < levels[-1]:
            continue
        # A level of a single sample is no move.
        sides = [held[side] for side in (held >= level, held <= level) if np.any(side)]
        own = max(float(np.ptp(np.percentile(side, _BUT_FEW))) for side in sides)
        if own < _OWN * float(np.ptp(levels)):
            # Where no side has moves of its own, each part is the other one scaled and shifted.
            continue
        parts = [
            response(
                model,
                part.time,
                PiecewiseConstant(
                    u.times, keep(u.values - level, 0.0), keep(u.initial - level, 0)
                ),
            )
            for keep in (np.maximum, np.minimum)
        ]
        (above, below), covariance = _factors(part, parts, beside, correlated=True)
        contrast = np.array((1.0, -1.0))
        sigma = math.sqrt(max(float(contrast @ covariance @ contrast), 0.0))
        largest = max(abs(above), abs(below))
        if largest > 0.0:
            loss = (abs(above - below) - _SURE_LOSS * sigma) / largest
            found.append((float(max(loss, 0.0)), float(level)))
    return max(found, default=None)


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

    Each record's response gets a gain of its own, in the least-squares sense, beside an offset and
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
        swings.append(0.5 * float(np.ptp(np.append(u.values, u.initial))))
        factor, covariance = _factors(record, [response(model, record.time, u)])
        gains.append(float(factor[0]))
        deviations.append(math.sqrt(max(float(covariance[0, 0]), 0.0)))
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


def _factors(
    record: Record,
    parts: Sequence[FloatArray],
    beside: Sequence[FloatArray] = (),
    *,
    correlated: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Return the factors of some responses in a record, and their covariance.

    An offset and a drift are estimated beside them.

    :param parts: each of the record's length.
    :param beside: further curves of free size, NaN where they are not known.
    :param correlated: True: correlated samples count less.
    """
    line = record.time - record.time.mean()
    columns = np.stack((*parts, np.ones(len(record)), line, *beside))
    known = np.isfinite(columns).all(axis=0)
    columns, measured = columns[:, known], record.measurement[known]
    size = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    size[size == 0.0] = 1.0
    scaled = columns / size[:, None]
    # A further curve that is offset and drift alone adds nothing.
    factors, *_ = np.linalg.lstsq(scaled.T, measured, rcond=_ALIKE)
    residual = measured - factors @ scaled
    variance = float(residual @ residual) / measured.size
    if correlated:
        variance /= effective_sample_fraction(residual)
    covariance = np.linalg.pinv(scaled @ scaled.T, rcond=_ALIKE**2) * variance
    count = len(parts)
    return factors[:count] / size[:count], (covariance / np.outer(size, size))[:count, :count]
