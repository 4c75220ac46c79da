# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Responses of any structure to the recorded input, with derivatives by its parameters theta.

Theta is the logarithms of the parameters of the factors of a structure, then the dead time.

Where the poles are equal or well apart, the response is a sum of partial fractions. With the
step of a held input as a pole at s = 0, an output is

    Y(s) = sum_p sum_j A_(p,j)/(s - p)^(j+1),    y(t) = sum_p sum_j A_(p,j) S_(p,j)(t),
    S_(p,j)(t) = sum_k step_k (t - t_k)^j/j! exp(p (t - t_k)),

which needs no matrix and is several times as fast as the modes of
:class:`relay_autotune.process.response.Modes`. The terms of close poles cancel: such poles are
left to the modes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs, ztbtrs

from relay_autotune.arrays import FloatArray
from relay_autotune.process.model_parameters import DEAD_TIME, Denominator, Lag, Quadratic
from relay_autotune.process.response import Modes, coordinates_at_changes
from relay_autotune.process.structures import FOPDT, Structure
from relay_autotune.record.record import Input, PiecewiseConstant, PiecewiseLinear

# Real for a real pole, complex for the upper one of a pair.
Numbers = NDArray[Any]

# Largest loss of accuracy by the differences of close poles: four digits.
_MOST_CANCELLATION = math.log(1e4)
# Longest time constant in horizons: a longer one cancels with the held input.
_LONGEST = 10.0
# Taylor coefficients of powers of s: binomial coefficients, and the power that is left.
_MOST = 24
_POWERS = np.maximum(np.subtract.outer(np.arange(_MOST), np.arange(_MOST)), 0)
_BINOMIALS = np.array([[float(math.comb(i, j)) for j in range(_MOST)] for i in range(_MOST)])
# Largest exponent of a growing mode.
_OVERFLOW = 300.0


@dataclass(frozen=True)
class Pole:
    """One pole of an output to a held input.

    :param value: p [rad/s]; of a conjugate pair the one with the positive imaginary part.
    :param multiplicity: how often it occurs.
    :param numerators: A of each output, shape (multiplicity, outputs).
    """

    value: complex
    multiplicity: int
    numerators: Numbers

    @property
    def number(self) -> Any:
        """The pole, real where it can be."""
        return self.value if self.value.imag else self.value.real

    def states(self, changes: FloatArray, steps: FloatArray, *, backward: bool) -> Numbers:
        """Return S_(p,j) just after each change, shape (multiplicity, m).

        :param changes: when the input steps [s], shape (m,).
        :param steps: by how much, shape (m,).
        :param backward: True: a growing pole is followed from zero after the last change.
        """
        p, terms = self.number, self.multiplicity
        if not (backward and self.value.real > 0.0):
            return _recursions(p, changes, steps, terms, 1.0)
        # Backward in time, each step is undone before the earlier one is reached.
        before = _recursions(-p, -changes[::-1], -steps[::-1], terms, -1.0)[:, ::-1]
        before[0] += steps
        return before


def partial_fractions(
    constants: Sequence[complex], integrators: int, numerators: FloatArray, horizon: float
) -> list[Pole] | None:
    """Return the poles of outputs to a unit step; None where some are too close to each other.

    :param constants: time constants T of ``prod(1 + T s)``, equal ones repeated, pairs complete
        [s].
    :param integrators: further poles at s = 0.
    :param numerators: of each output, coefficients of powers of s, lowest first, of lower degree
        than the poles and the step have together, shape (outputs, d).
    :param horizon: longest time that will be asked for [s].
    """
    count: dict[complex, int] = {}
    lead = 1.0 + 0.0j
    for constant in constants:
        count[-1.0 / constant] = count.get(-1.0 / constant, 0) + 1
        lead *= constant
    if any(abs(p) * horizon * _LONGEST < 1.0 for p in count):
        return None
    if any(_cancellation(p, count) > _MOST_CANCELLATION for p in count):
        return None
    count[0j] = 1 + integrators
    found = []
    for p, multiplicity in count.items():
        if p.imag < 0.0:
            continue
        others = [(q, times) for q, times in count.items() if q != p]
        series = _series_of_others(p, others, multiplicity)
        # Row k of the product of two Taylor series; the highest power of 1/(s - p) comes first.
        last = range(multiplicity - 1, -1, -1)
        product = [[series[k - i] if i <= k else 0j for k in last] for i in range(multiplicity)]
        rows: Numbers = (_taylor(numerators, p, multiplicity) @ (np.array(product) / lead)).T
        found.append(Pole(p, multiplicity, rows if p.imag else np.ascontiguousarray(rows.real)))
    return found


def _cancellation(p: complex, count: dict[complex, int]) -> float:
    """Return the logarithm of how much the terms of a pole are larger than their sum."""
    total, nearest = 0.0, 0.0
    for q, times in count.items():
        if q != p:
            closeness = math.log(min(abs(p), abs(q)) / abs(p - q))
            if closeness > 0.0:
                total += times * closeness
                nearest = max(nearest, closeness)
    return total + (count[p] - 1) * nearest


def _series_of_others(p: complex, others: list[tuple[complex, int]], terms: int) -> list[complex]:
    """Return the Taylor series of ``prod (s - q)^-times`` about p."""
    series = [1.0 + 0.0j] + [0j] * (terms - 1)
    for q, times in others:
        inverse = 1.0 / (p - q)
        for _ in range(times):
            # Division by (p - q) + x, lowest power first.
            carried = 0j
            for k in range(terms):
                carried = (series[k] - carried) * inverse
                series[k] = carried
    return series


def _taylor(numerators: FloatArray, p: complex, terms: int) -> Numbers:
    """Return the first Taylor coefficients of polynomials about p, shape (outputs, terms)."""
    degree = numerators.shape[1]
    return np.asarray(numerators @ (_BINOMIALS[:degree, :terms] * p ** _POWERS[:degree, :terms]))


def follow(
    poles: Sequence[Pole],
    states: Sequence[Numbers],
    time: FloatArray,
    segment: NDArray[np.int64],
    changes: FloatArray,
) -> FloatArray:
    """Return the outputs at some samples, shape (outputs, n).

    :param poles: from :func:`partial_fractions`.
    :param states: from :meth:`Pole.states`, one for each.
    :param time: sample times [s], shape (n,).
    :param segment: index of the last change before each sample, shape (n,).
    :param changes: when the input steps [s], shape (m,).
    """
    since = time - changes[segment]
    motions: list[FloatArray] = []
    shares: list[FloatArray] = []
    for pole, state in zip(poles, states, strict=True):
        exponent = pole.number * since
        if pole.value.real > 0.0:
            # A state that decayed from beyond this bound is zero: exp() must not overflow.
            exponent = np.minimum(exponent, _OVERFLOW)
        decay = np.exp(exponent) if pole.value != 0j else 1.0
        at_change = [row.take(segment) for row in state]
        powers = [np.ones(since.size)]
        for j, here in enumerate(at_change):
            moved = here
            for i, earlier in enumerate(reversed(at_change[:j]), start=1):
                if i == len(powers):
                    powers.append(powers[-1] * since / i)
                moved = moved + earlier * powers[i]
            moved = moved * decay
            numerators = pole.numerators[j]
            if pole.value.imag:
                # A conjugate pair gives twice the real part of one pole's output.
                motions += [moved.real, moved.imag]
                shares += [2.0 * numerators.real, -2.0 * numerators.imag]
            else:
                motions.append(moved)
                shares.append(numerators)
    return np.stack(shares, axis=1) @ np.stack(motions)


def _recursions(
    p: Any, instants: FloatArray, steps: FloatArray, terms: int, direction: float
) -> Numbers:
    """Return S_(p,j) at instants that follow one another in a direction of time."""
    gaps = instants[1:] - instants[:-1]
    decay = np.exp(p * gaps)
    state = np.zeros((terms, instants.size), dtype=decay.dtype)
    state[0] = recursion(decay, steps)
    weights = [decay]
    for j in range(1, terms):
        weights.append(weights[-1] * gaps * (direction / j))
        drive = np.zeros(instants.size, dtype=decay.dtype)
        for i in range(j):
            drive[1:] += weights[j - i] * state[i, :-1]
        state[j] = recursion(decay, drive)
    return state


def recursion(decay: Numbers, drive: FloatArray | Numbers) -> Numbers:
    """Return ``x_k = decay_(k-1) x_(k-1) + drive_k``, a triangular system of two bands.

    :param decay: of magnitude at most 1, shape (m - 1,).
    :param drive: shape (m,).
    """
    # Each column of the bands holds a diagonal element, and what the next x takes of this one.
    bands = np.ones((drive.size, 2), dtype=decay.dtype).T
    bands[1, :-1] = -decay
    solve = ztbtrs if np.iscomplexobj(decay) else dtbtrs
    found: Numbers = solve(bands, drive[:, None], uplo="L", diag="U")[0][:, 0]
    return found


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
    denominator: Denominator, theta: FloatArray, time: FloatArray, *, growing_only: bool = False
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
    constants = denominator.constants(own, 1)
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
