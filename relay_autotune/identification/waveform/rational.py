# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Responses of any structure to the recorded input, with derivatives by its parameters."""

from __future__ import annotations

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.waveform.partial_fractions import follow, partial_fractions
from relay_autotune.process.model_parameters import Denominator, Lag
from relay_autotune.process.modes import Modes
from relay_autotune.process.response import coordinates_at_changes
from relay_autotune.record.record import Input, PiecewiseLinear

_CHUNK = 1 << 15


def responses(
    denominator: Denominator,
    powers: tuple[int, ...],
    theta: FloatArray,
    time: FloatArray,
    u: Input,
) -> tuple[FloatArray, FloatArray]:
    """Return the responses of ``s^k exp(-D s)/(s^m Q)`` and their derivatives.

    Growing modes are followed backward from zero at the last sample, so that they stay bounded;
    the free motion that this leaves out has a column of its own, from :func:`free_motion`.

    :param denominator: the structure's denominator.
    :param powers: k of each response, p of them.
    :param theta: the parameters of the denominator, then D [s].
    :param time: sample times, not decreasing [s], shape (n,).
    :param u: the input; its deviation from ``u.initial`` acts, of ramps as exactly as of steps.
    :return: shapes (p, n) and (len(theta), p, n).
    """
    own, dead_time = theta[:-1], float(theta[-1])
    changes = u.times + dead_time
    ramps = isinstance(u, PiecewiseLinear)
    # A ramp is a step that is integrated once more.
    before, levels = (0.0, u.slopes) if isinstance(u, PiecewiseLinear) else (u.initial, u.values)
    steps = levels.copy()
    steps[:1] -= before
    steps[1:] -= levels[:-1]
    unstable = any(f.unstable for f in denominator.factors)
    if unstable:
        first, last = min(time[0], changes[0]) - 1.0, max(time[-1], changes[-1]) + 1e-9
        changes = np.concatenate(([first], changes, [last]))
        steps = np.concatenate(([0.0], steps, [0.0]))
    numerators = denominator.numerators(own, powers)
    values = _follow(
        denominator, own, numerators, time, changes, steps, backward=unstable, ramps=ramps
    )
    p = len(powers)
    return values[:p], values[p:].reshape(theta.size, p, time.size)


def free_motion(
    denominator: Denominator,
    theta: FloatArray,
    time: FloatArray,
    *,
    growing_only: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Return what a free initial state adds to the output, and its derivatives.

    Stable poles: the responses of ``s^j/Q``, j < order, to an impulse at the first sample. An
    unstable lag: ``exp((t - t_end)/tau)``. The free state of an integrator is the offset, which
    is a column of the fit anyway.

    :param denominator: the structure's denominator.
    :param theta: its parameters, then D [s].
    :param time: sample times, not decreasing [s], shape (n,).
    :param growing_only: True: of the poles in the right half plane alone.
    :return: shapes (q, n) and (len(theta), q, n).
    """
    columns, derivatives = [], []
    own = denominator.split(theta[:-1])
    first = 0
    for factor, part in zip(denominator.factors, own, strict=True):
        place = slice(first, first + len(factor.parameters))
        first = place.stop
        if growing_only and not factor.unstable:
            continue
        if factor.unstable:
            x = (time - time[-1]) / np.exp(part[0])
            found, changes = np.exp(x)[None, :], (-x * np.exp(x))[None, None, :]
        elif isinstance(factor, Lag):
            found, changes = _free_lags(factor.multiplicity, float(part[0]), time)
        else:
            single = Denominator((factor,))
            # An impulse is the derivative of a step: one power of s higher.
            numerators = single.numerators(part, (1, 2), by_dead_time=False)
            values = _follow(single, part, numerators, time, time[:1], np.ones(1))
            found, changes = values[:2], values[2:].reshape(2, 2, time.size)
        all_changes = np.zeros((theta.size, *found.shape))
        all_changes[place] = changes
        columns.append(found)
        derivatives.append(all_changes)
    if not columns:
        return np.zeros((0, time.size)), np.zeros((theta.size, 0, time.size))
    return np.concatenate(columns), np.concatenate(derivatives, axis=1)


def _free_lags(
    multiplicity: int, log_tau: float, time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return ``x^j exp(-x)`` for j < n with x = (t - t0)/tau, and its derivative by log tau."""
    x = (time - time[0]) / np.exp(log_tau)
    j = np.arange(multiplicity)[:, None]
    decay = np.exp(-x)
    powers = x ** np.arange(multiplicity + 1)[:, None]
    columns = powers[:-1] * decay
    return columns, ((powers[1:] - j * powers[:-1]) * decay)[None, :, :]


def _follow(
    denominator: Denominator,
    own: FloatArray,
    numerators: FloatArray,
    time: FloatArray,
    changes: FloatArray,
    steps: FloatArray,
    *,
    backward: bool = False,
    ramps: bool = False,
) -> FloatArray:
    """Return the outputs at the samples, shape (outputs, n); zero before the first change."""
    horizon = max(float(max(time[-1], changes[-1]) - changes[0]), np.finfo(float).tiny)
    constants = denominator.extended_constants(own)
    segment = changes.searchsorted(time, side="right") - 1
    first = int(segment.searchsorted(0))
    integrators = denominator.integrators + ramps
    poles = partial_fractions(constants, integrators, numerators, horizon)
    values = np.zeros((numerators.shape[0], time.size))
    # In pieces, so that a long record takes little memory beside its result.
    if poles is not None:
        states = [p.states(changes, steps, backward=backward) for p in poles]
        for start in range(first, time.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            values[:, part] = follow(poles, states, time[part], segment[part], changes)
        return values
    modes = Modes(constants, integrators, numerators, horizon)
    weights = modes.weights(coordinates_at_changes(modes, changes, steps, backward=backward))
    for start in range(first, time.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        k = segment[part]
        chosen = [w[k] for w in weights]
        values[:, part] = modes.outputs(chosen, time[part] - changes[k]).T
    return values
