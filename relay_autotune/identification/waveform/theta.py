# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The parameters of a fit, theta: what they do to the output, how far they move, what they mean.

Theta is the logarithms of the parameters of a structure's factors, then the dead time.
"""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.partial_fractions import recursion
from relay_autotune.identification.waveform.rational import responses
from relay_autotune.process.model_parameters import DEAD_TIME, Quadratic
from relay_autotune.process.structures import FOPDT, Structure
from relay_autotune.record.record import Input, PiecewiseConstant

_LOG_STEP = 1.0
_DEAD_TIME_STEP = 0.3
_LOG_DAMPING = (math.log(0.005), math.log(50.0))
_LOG_RANGE = 30.0


def columns_of(
    structure: Structure, theta: FloatArray, time: FloatArray, u: Input
) -> tuple[FloatArray, FloatArray]:
    """Return the responses of a structure, shape (k, n), and their derivatives, shape (m, k, n).

    :param structure: the structure.
    :param theta: shape (m,).
    :param time: sample times [s], shape (n,).
    :param u: the input; its deviation from ``u.initial`` acts.
    """
    if structure == FOPDT and isinstance(u, PiecewiseConstant):
        return one_lag(theta, time, u)
    return responses(structure.denominator, structure.powers, theta, time, u)


def theta_of(structure: Structure, values: FloatArray) -> FloatArray:
    """Return the theta that stands for values of a structure's parameters, shape (m,).

    :param structure: the structure.
    :param values: of its parameters, in their order, shape (p,).
    """
    given = dict(zip(structure.parameters, values.tolist(), strict=True))
    logs: list[float] = []
    for factor in structure.factors:
        poles = factor.poles([given[p] for p in factor.parameters])
        if isinstance(factor, Quadratic):
            size = math.sqrt(abs(poles[0] * poles[1]))
            logs += [math.log(size), math.log(0.5 * (poles[0] + poles[1]).real / size)]
        else:
            logs.append(math.log(abs(poles[0].real)))
    return np.array([*logs, given[DEAD_TIME]])


def unit_steps(structure: Structure, theta: FloatArray) -> FloatArray:
    """Return the size of a unit step: 1 of a logarithm, and all times together of D [s].

    :param structure: the structure.
    :param theta: shape (m,).
    """
    lags = sum(abs(c) for c in structure.denominator.constants(theta[:-1]))
    return np.array([*[1.0] * (theta.size - 1), lags + float(theta[-1]) or 1.0])


def stepped(
    structure: Structure, theta: FloatArray, step: FloatArray, longest: float = math.inf
) -> FloatArray:
    """Return theta after a step in units of :func:`unit_steps`, within its bounds.

    :param structure: the structure.
    :param theta: shape (m,).
    :param step: shape (m,).
    :param longest: time constant beyond which a lag is an integrator [s].
    """
    # For so few numbers plain floats are quicker than arrays.
    *logs, dead_time = theta.tolist()
    *moves, by_dead_time = step.tolist()
    logs = [
        _clip(at + _clip(by, -_LOG_STEP, _LOG_STEP), -_LOG_RANGE, _LOG_RANGE)
        for at, by in zip(logs, moves, strict=True)
    ]
    first, limit = 0, math.log(longest)
    for factor in structure.factors:
        logs[first] = min(logs[first], limit)
        if isinstance(factor, Quadratic):
            logs[first + 1] = _clip(logs[first + 1], *_LOG_DAMPING)
        first += len(factor.parameters)
    limited = _clip(by_dead_time, -_DEAD_TIME_STEP, _DEAD_TIME_STEP)
    later = dead_time + limited * float(unit_steps(structure, theta)[-1])
    return np.array([*logs, max(later, 0.0)])


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def one_lag(
    theta: FloatArray, time: FloatArray, u: PiecewiseConstant
) -> tuple[FloatArray, FloatArray]:
    """Return the unit-gain response of a FOPDT and its derivatives, by their closed form.

    Between two delayed changes the lag moves from s_k towards the level U_k,

        r = U_k + (s_k - U_k) exp(-delta/tau),   dr/dD = -(U_k - r)/tau,

    and dr/dtau follows the same recursion from change to change. This is many times as fast as
    the general way.

    :param theta: (log tau, D).
    :param time: sample times [s], shape (n,).
    :param u: the input; its deviation from ``u.initial`` acts.
    :return: shapes (1, n) and (2, 1, n).
    """
    tau, dead_time = math.exp(float(theta[0])), float(theta[1])
    levels, gaps = u.values - u.initial, np.diff(u.times) / tau
    state, slope = _at_changes(levels, gaps)
    delayed = time - dead_time
    segment = u.times.searchsorted(delayed, side="right") - 1
    k = np.maximum(segment, 0)
    delta = (delayed - u.times[k]) / tau
    e = np.exp(-np.maximum(delta, 0.0))
    level_at = levels[k]
    part = (state[k] - level_at) * e
    values = np.stack((level_at + part, slope[k] * e + part * delta, part / tau))
    values[:, segment < 0] = 0.0
    return values[:1], values[1:, None, :]


def _at_changes(levels: FloatArray, gaps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lag's state s at each change, and its derivative by log tau.

    :param levels: after each change, shape (m,).
    :param gaps: between changes, over tau, shape (m - 1,).
    """
    decay = np.exp(-gaps)
    state = recursion(decay, np.append(0.0, -np.expm1(-gaps) * levels[:-1]))
    away = state[:-1] - levels[:-1]
    return state, recursion(decay, np.append(0.0, decay * away * gaps))
