# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Responses of any structure to the recorded input, with derivatives by its parameters theta.

Theta is the logarithms of the parameters of the factors of a structure, then the dead time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.process.factors import Denominator, Quadratic
from relay_autotune.process.response import Modes, recursion
from relay_autotune.process.structures import FOPDT, Structure
from relay_autotune.record.record import Input, PiecewiseConstant, PiecewiseLinear

_LOG_STEP = 1.0
_DEAD_TIME_STEP = 0.3
_LOG_DAMPING = (math.log(0.005), math.log(50.0))
_LOG_RANGE = 30.0


# Its arrays have no equality of their own.
@dataclass(frozen=True, eq=False)
class Inputs:
    """The inputs of one process, put together once for all trial parameters.

    :param each: the deviation of each from its ``initial`` acts, of ramps as exactly as of steps;
        only the first one may be of ramps.
    """

    each: tuple[Input, ...]

    @cached_property
    def alike(self) -> tuple[Inputs, ...]:
        """The inputs of ramps, and those of steps."""
        first, *others = self.each
        if isinstance(first, PiecewiseConstant) or not others:
            return (self,)
        return Inputs((first,)), Inputs(tuple(others))

    @cached_property
    def steps(self) -> tuple[FloatArray, FloatArray]:
        """When any of them steps, or its slope does [s], and by how much, (m,) and (inputs, m)."""
        at = np.unique(np.concatenate([u.times for u in self.each]))
        heights = np.zeros((len(self.each), at.size))
        for row, u in zip(heights, self.each, strict=True):
            # A ramp is a step that is integrated once more.
            row[at.searchsorted(u.times)] = u.steps
        return at, heights


def columns_of(
    structure: Structure,
    theta: FloatArray,
    time: FloatArray,
    inputs: Inputs,
    *,
    slopes: bool = True,
) -> list[tuple[FloatArray, FloatArray]]:
    """Return a structure's responses to each input, shape (k, n), and derivatives, (m, k, n).

    :param structure: the structure.
    :param theta: shape (m,).
    :param time: sample times [s], shape (n,).
    :param inputs: what acts.
    :param slopes: False: without derivatives, shape (0, k, n).
    """
    held = [u for u in inputs.each if isinstance(u, PiecewiseConstant)]
    if structure == FOPDT and len(held) == len(inputs.each):
        every = (one_lag(theta, time, u) for u in held)
        return [(found, changes if slopes else changes[:0]) for found, changes in every]
    return responses(structure.denominator, structure.powers, theta, time, inputs, slopes=slopes)


def unit_steps(structure: Structure, theta: FloatArray, least: float = 0.0) -> FloatArray:
    """Return the size of a unit step: 1 of a logarithm, and all times together of D [s].

    :param structure: the structure.
    :param theta: shape (m,).
    :param least: of the dead time's step [s], such as the time between samples.
    """
    lags = sum(abs(c) for c in structure.denominator.constants(theta[:-1]))
    return np.array([*[1.0] * (theta.size - 1), max(lags + float(theta[-1]), least) or 1.0])


def stepped(
    structure: Structure,
    theta: FloatArray,
    step: FloatArray,
    longest: float = math.inf,
    least: float = 0.0,
) -> FloatArray:
    """Return theta after a step in units of :func:`unit_steps`, within its bounds.

    :param structure: the structure.
    :param theta: shape (m,).
    :param step: shape (m,).
    :param longest: time constant beyond which a lag is an integrator [s].
    :param least: as for :func:`unit_steps`.
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
    later = dead_time + limited * float(unit_steps(structure, theta, least)[-1])
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


_CHUNK = 1 << 15
# ``q t^2`` below which a series has more digits than a difference.
_LITTLE_TURN = 1e-4


def responses(
    denominator: Denominator,
    powers: tuple[int, ...],
    theta: FloatArray,
    time: FloatArray,
    inputs: Inputs,
    *,
    slopes: bool = True,
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the responses of ``s^k exp(-D s)/(s^m Q)`` to each input, and their derivatives.

    Growing modes are followed backward from zero at the last sample, so that they stay bounded;
    the free motion that this leaves out has a column of its own, from :func:`free_motion`.

    :param denominator: the structure's denominator.
    :param powers: k of each response, p of them.
    :param theta: the parameters of the denominator, then D [s].
    :param time: sample times, not decreasing [s], shape (n,).
    :param inputs: what acts.
    :param slopes: False: without derivatives.
    :return: of each input shapes (p, n) and (len(theta), p, n), or (0, p, n).
    """
    own, dead_time = theta[:-1], float(theta[-1])
    if len(inputs.alike) > 1:
        every = (
            responses(denominator, powers, theta, time, some, slopes=slopes)
            for some in inputs.alike
        )
        return [found for some in every for found in some]
    ramps = isinstance(inputs.each[0], PiecewiseLinear)
    at, steps = inputs.steps
    changes = at + dead_time
    unstable = any(f.unstable for f in denominator.factors)
    if unstable:
        first, last = min(time[0], changes[0]) - 1.0, max(time[-1], changes[-1]) + 1e-9
        changes = np.concatenate(([first], changes, [last]))
        steps = np.pad(steps, ((0, 0), (1, 1)))
    rows = denominator.with_slopes(own, powers) if slopes else denominator.numerators(powers)
    constants = denominator.constants(own, int(slopes))
    integrators = denominator.integrators + ramps
    values = _follow(constants, integrators, rows, time, changes, steps, backward=unstable)
    p, shape = len(powers), (-1, len(powers), time.size)
    return [(values[:p, i], values[p:, i].reshape(shape)) for i in range(len(steps))]


def free_motion(
    denominator: Denominator,
    theta: FloatArray,
    time: FloatArray,
    *,
    growing_only: bool = False,
    slopes: bool = True,
) -> tuple[FloatArray, FloatArray]:
    """Return what a free initial state adds to the output, and its derivatives.

    A lag to the power n: ``x^j exp(-x)``, j < n, of the time x since the first sample over tau. An
    unstable one: ``exp((t - t_end)/tau)``. The free state of an integrator is the offset, which is
    a column of the fit anyway.

    :param denominator: the structure's denominator.
    :param theta: its parameters, then D [s].
    :param time: sample times, not decreasing [s], shape (n,).
    :param growing_only: True: of the poles in the right half plane alone.
    :param slopes: False: without derivatives.
    :return: shapes (q, n) and (len(theta), q, n), or (0, q, n).
    """
    size, first = theta.size if slopes else 0, 0
    columns: list[FloatArray] = [np.zeros((0, time.size))]
    derivatives: list[FloatArray] = [np.zeros((size, 0, time.size))]
    for factor, part in zip(denominator.factors, denominator.split(theta[:-1]), strict=True):
        place = slice(first, first + len(factor.parameters))
        first = place.stop
        if growing_only and not factor.unstable:
            continue
        if isinstance(factor, Quadratic):
            found, changes = _free_pair(part, time)
        else:
            # The time by which it has decayed.
            x = (time[-1] - time if factor.unstable else time - time[0]) / np.exp(part[0])
            j = np.arange(factor.multiplicity)[:, None]
            found = x**j * np.exp(-x)
            # Of n columns the derivative of the last one has a power more.
            changes = ((x - j) * found)[None]
        columns.append(found)
        derivatives.append(np.zeros((size, *found.shape)))
        derivatives[-1][place] = changes[:size]
    return np.concatenate(columns), np.concatenate(derivatives, axis=1)


def _free_pair(theta: FloatArray, time: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Return the free motions of a quadratic factor, shape (2, n), and derivatives, (2, 2, n).

    With a = zeta w0 and q = w0^2 (zeta^2 - 1) they are ``c = exp(-a t) cosh(sqrt(q) t)`` and
    ``s = exp(-a t) sinh(sqrt(q) t)/sqrt(q)``, with the derivatives by a ``-t c`` and ``-t s`` and
    by q ``t s/2`` and ``(t c - s)/(2 q)``, all of them smooth where q changes its sign.

    :param theta: (log(1/w0), log zeta).
    :param time: sample times [s], shape (n,).
    """
    frequency, zeta = math.exp(-theta[0]), math.exp(theta[1])
    t, a, q = time - time[0], zeta * frequency, frequency**2 * (zeta * zeta - 1.0)
    root = math.sqrt(abs(q))
    if q > 0.0:
        slow = np.exp(-(frequency**2) / (a + root) * t)
        fast = np.expm1(-2.0 * root * t)
        c, s = slow * (1.0 + 0.5 * fast), slow * fast / (-2.0 * root)
    else:
        decay = np.exp(-a * t)
        c, s = decay * np.cos(root * t), decay * t * np.sinc(root / math.pi * t)
    turn, x = t * c - s, q * t * t
    # Where the difference is all rounding, its series.
    few = np.abs(x) < _LITTLE_TURN
    by_q = np.where(few, np.exp(-a * t) * t**3 * (1.0 / 3.0 + x / 30.0), turn / (q or 1.0))
    by_time = (a * t * c - q * t * s, a * t * s - turn)
    by_damping = (a * t * (a * s - c), a * (a * by_q - t * s))
    return np.stack((c, s)), np.stack((by_time, by_damping))


def _follow(
    constants: Sequence[complex],
    integrators: int,
    numerators: FloatArray,
    time: FloatArray,
    changes: FloatArray,
    steps: FloatArray,
    *,
    backward: bool = False,
) -> FloatArray:
    """Return the outputs at the samples, zero before the first change, (outputs, inputs, n)."""
    horizon = max(float(max(time[-1], changes[-1]) - changes[0]), np.finfo(float).tiny)
    modes = Modes(constants, integrators, numerators, horizon)
    states = modes.states(changes, steps, backward=backward)
    segment = changes.searchsorted(time, side="right") - 1
    values = np.zeros((numerators.shape[0], steps.shape[0], time.size))
    # In pieces, so that a long record takes little memory beside its result.
    for start in range(int(segment.searchsorted(0)), time.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        since = time[part] - changes[segment[part]]
        values[..., part] = modes.outputs(states, since, segment[part])
    return values
