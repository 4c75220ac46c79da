# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Fits that explain the samples by something that no sample can show."""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Input, PiecewiseConstant

# Least number of samples in each period of an oscillation of the process.
_SAMPLES_A_SWING = 4.0
# Shortest response of a process, in intervals between samples.
_SHORTEST_RESPONSE = 0.5
# Longest zero in lengths of the record: beyond, a slow pole cancels it, or it is a drift.
_LONGEST_ZERO = 2.0
# A response is seen where the measurement leaves the mean of a rest by this many times the range
# of the rest, by this many of its standard deviations, and by this share of the whole range.
_RANGES, _DEVIATIONS, _SHARE = 3.0, 6.0, 0.03
# Least number of samples of a rest, and shares of the time before the change that are looked at.
_RESTING, _RESTS = 15, (1.0, 0.5, 0.25)
# Longest dead time that is believed, over the time of the first response.
_BELIEVED = 2.0


def is_unseen(
    model: TransferFunction, interval: float, length: float, pushed: float = math.inf
) -> bool:
    """Return whether a fit owes its small residual to what happens between the samples.

    It rings faster than the samples show: noise alone leads to such a resonance, of any height,
    and it would limit every gain. Or its whole response falls between two samples, or comes from
    an unreasonable zero: so a controller responds, where command and measurement were swapped. Or
    its response turns into the direction of its gain later than any push of the command lasted:
    what the record shows is the other direction, and the rest is a drift.

    :param model: the fit.
    :param interval: between samples [s].
    :param length: of the record [s].
    :param pushed: longest time for which the command acted in one direction [s]; the record's
        length where it is longer.
    """
    swing = _SAMPLES_A_SWING * interval / (2.0 * math.pi)
    if any(c.imag != 0.0 and abs(c) < swing for c in model.time_constants):
        return True
    whole = model.dead_time + sum(abs(c) for c in model.time_constants)
    if not model.integrators and whole < _SHORTEST_RESPONSE * interval:
        return True
    if any(abs(zero) > _LONGEST_ZERO * length for zero in model.zeros):
        return True
    if not (model.is_stable or model.integrators) or all(zero.real >= 0.0 for zero in model.zeros):
        return False
    step = PiecewiseConstant(np.zeros(1), np.ones(1), 0.0)
    return (
        float(response(model, np.array([min(pushed, length)]), step)[0]) * model.process_sign
        <= 0.0
    )


def longest_push(time: FloatArray, u: Input) -> float:
    """Return the longest time for which a command stayed on one side of its mean [s].

    :param time: of the samples [s], shape (n,).
    :param u: the command.
    :return: infinite for ramps, whose response turns gradually.
    """
    if not isinstance(u, PiecewiseConstant):
        return math.inf
    level = u(time)
    turns = np.flatnonzero(np.diff(level > level.mean())) + 1
    return float(np.diff(time[np.concatenate(([0], turns, [time.size - 1]))]).max())


def latest_dead_time(time: FloatArray, y: FloatArray, u: Input, sign: int) -> float:
    """Return the longest dead time that the first response after a rest allows [s].

    A response is sure where the measurement leaves the rest before the first change of the
    command much farther than it moved during the rest, within no longer than the rest lasted, so
    that neither noise nor a drift explains it. Twice the time of that response is allowed, since
    a process may change its dead time a little meanwhile.

    :param time: of the samples [s], shape (n,).
    :param y: the measurement, in any unit, shape (n,).
    :param u: the command.
    :param sign: of the process: a response in the other direction is an inverse one, for which a
        dead time may stand.
    :return: infinite where no response is sure.
    """
    inside = np.flatnonzero((u.times >= time[0]) & (u.times < time[-1]))
    if not inside.size or not isinstance(u, PiecewiseConstant):
        return math.inf
    change, k = float(u.times[inside[0]]), int(inside[0])
    direction = sign * np.sign(u.values[k] - (u.values[k - 1] if k else u.initial))
    first = int(np.searchsorted(time, change, side="right"))
    length, whole = change - float(time[0]), float(np.ptp(y))
    latest = math.inf
    for share in _RESTS:
        begin = int(np.searchsorted(time, change - share * length))
        rest = y[begin:first]
        if rest.size < _RESTING:
            break
        band = max(_RANGES * np.ptp(rest), _DEVIATIONS * rest.std(), _SHARE * whole)
        outside = direction * (y[first:] - rest.mean()) > band
        # A single sample may be a spike.
        at = np.flatnonzero(outside[:-1] & outside[1:])
        seen = float(time[first + at[0]]) - change if at.size else math.inf
        if seen <= share * length:
            latest = min(latest, _BELIEVED * seen)
    return latest
