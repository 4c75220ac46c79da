# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `fourier`: measured points of the frequency response, and a model through them.

The ratio of two Fourier integrals over whole cycles is the frequency response itself, without any
structure (Wang, Hang and Zou 1997, eq 23): at the frequency of the limit cycle, at its odd
harmonics, and at the even ones where a biased relay excites them. The ultimate point is
interpolated between these points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple, dataclass, replace

import numpy as np
from scipy.special import fdtrc

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, jacobian
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fourier import (
    FrequencyPoint,
    measured_points,
    static_gain,
    steady_state,
    with_noise_about,
)
from relay_autotune.identification.limit_cycle.limit_cycle import RelayTest, relay_test
from relay_autotune.identification.methods.solved import Fit, structure_asked_for
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import (
    FOPDT,
    INTEGRATOR_LAG,
    IPDT,
    LAG_N,
    UNSTABLE_FOPDT,
    Structure,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import UltimatePoint
from relay_autotune.record.record import Record
from relay_autotune.scalar import root

_NEAREST = 3
_REACH = 3.0
_GRID = 400


def interpolated(
    model: TransferFunction, frequency: FloatArray, value: ComplexArray
) -> UltimatePoint | None:
    """Return the ultimate point of a measured response, interpolated with the help of a model.

    ``log(G/M)`` runs straight over log(w) from point to point and is constant beyond them.

    :param model: M, near the points.
    :param frequency: of the points [rad/s], increasing, shape (m,); one at zero is not used.
    :param value: G there [y/u], shape (m,).
    :return: None where the phase does not pass -180 degrees near the lowest points.
    """
    used = frequency > 0.0
    at = np.log(frequency[used])
    ratio = np.log(value[used] / model(1j * frequency[used]))

    def logarithm(w: FloatArray) -> tuple[FloatArray, FloatArray]:
        place = np.log(w)
        size = np.log(np.abs(model(1j * w))) + np.interp(place, at, ratio.real)
        return size, model.phase(w) + np.interp(place, at, ratio.imag)

    return _crossing(logarithm, float(frequency[used][0]), model.process_sign)


def smooth(
    model: TransferFunction, frequency: FloatArray, value: ComplexArray
) -> UltimatePoint | None:
    """Return the ultimate point of a measured response, interpolated without a structure.

    Through the lowest three points, ``log|G|`` is a parabola over log(w), and the phase has the
    form ``a + b w + c log(w)``, exact for dead time and integrators.

    :param model: tells only how many turns lie between the points.
    :param frequency: as for :func:`interpolated`, as is the next.
    """
    chosen = np.flatnonzero(frequency > 0.0)[:_NEAREST]
    w0, g = frequency[chosen], value[chosen]
    turned = model.phase(w0)
    phase = turned + np.angle(g * model.process_sign * np.exp(-1j * turned))
    first = float(w0[0])

    def terms(w: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, one = np.log(w / first), np.ones_like(w)
        rows = np.stack((one, x, x * x)), np.stack((one, x, w / first))
        return rows[0][: chosen.size].T, rows[1][: chosen.size].T

    of_size, of_phase = terms(w0)
    size = np.linalg.solve(of_size, np.log(np.abs(g)))
    turn = np.linalg.solve(of_phase, phase)

    def logarithm(w: FloatArray) -> tuple[FloatArray, FloatArray]:
        by_size, by_phase = terms(w)
        return by_size @ size, by_phase @ turn

    return _crossing(logarithm, first, model.process_sign)


Interpolation = Callable[[TransferFunction, FloatArray, ComplexArray], UltimatePoint | None]


def _crossing(
    logarithm: Callable[[FloatArray], tuple[FloatArray, FloatArray]], near: float, sign: int
) -> UltimatePoint | None:
    """Return where the phase falls through -180 degrees, next to a frequency.

    :param logarithm: from frequencies to log|G| and the phase.
    :param near: [rad/s].
    :param sign: of the process.
    """

    def excess(w: float) -> float:
        return float(logarithm(np.array([w]))[1][0]) + math.pi

    grid = near * np.geomspace(1.0 / _REACH, _REACH, _GRID)
    height = logarithm(grid)[1] + math.pi
    falls = np.flatnonzero((height[:-1] > 0.0) & (height[1:] <= 0.0))
    if falls.size == 0:
        return None
    i = int(falls[np.argmin(np.abs(np.log(grid[falls] / near)))])
    w = root(excess, grid[i], grid[i + 1])
    size = float(logarithm(np.array([w]))[0][0])
    return UltimatePoint(math.copysign(math.exp(-size), sign), w)


METHOD = "fourier"

_UNLIKELY = 1e-3
_LAGS = (0.1, 0.5, 2.0, 10.0)
_BEYOND = 1.3
_STEP = 0.1

# Gain, at most one time constant, and dead time.
_STRUCTURES = (LAG_N, FOPDT, IPDT, INTEGRATOR_LAG, UNSTABLE_FOPDT)


@dataclass(frozen=True)
class _Points:
    """Measured points of the frequency response.

    :param frequency: w [rad/s], shape (m,); 0 for a static gain from means over whole cycles.
    :param value: G(j w) [y/u], shape (m,).
    :param std: of its real and its imaginary part [y/u], shape (m,).
    """

    frequency: FloatArray
    value: ComplexArray
    std: FloatArray

    @property
    def numbers(self) -> int:
        """Number of real numbers that were measured."""
        return 2 * self.value.size - int(np.sum(self.frequency == 0.0))


def identify_fourier(record: Record, known: Known = NOTHING) -> Identification:
    """Identify points of the frequency response from a relay test, and a model through them.

    The model is the FOPDT (or another of one time constant, where the structure is known) that
    comes nearest to the points, each weighted by its variance; the static gain from a biased
    relay counts as a point at w = 0. K_u and w_u are those of the points, where the phase between
    them passes -180 degrees: by :func:`interpolated`, or by :func:`smooth` where the points do
    not fit the model's structure.

    :param record: a relay test, biased or not.
    :param known: a structure ("fopdt", "lag_n" with its order, "ipdt", "integrator_lag",
        "unstable_fopdt"); gain and dead time where they are known.
    :raises IdentificationError: if there is no whole cycle, too few samples in one, the points
        drown in noise, or the gain that is known has the wrong sign.
    """
    if known.structure == LAG_N.name:
        known = replace(known, order=known.order or 2)
    structure = structure_asked_for(METHOD, known, _STRUCTURES) or FOPDT
    test = relay_test(METHOD, record, two_levels=False)
    test.known_gain(known)
    harmonics = measured_points(test)
    points = _with_static_gain(test, harmonics, structure)
    fit = _fit(structure, known, test.sign, points)
    cost, values = _nearest(fit, points)
    if not structure.unstable:
        harmonics = with_noise_about(structure.build(values), test, harmonics)
        points = _with_static_gain(test, harmonics, structure)
        fit = _fit(structure, known, test.sign, points)
        cost, x = fit.best((values,))
        values = fit.values(x)
    remarks = test.remarks(symmetric=False)
    freedom = points.numbers - fit.free.size
    # The standard deviations are estimates with few degrees of freedom.
    estimated = max(4 * (len(test.cycle.cycles) - 1), 1)
    unlikely = freedom > 0 and fdtrc(freedom, estimated, cost / freedom) < _UNLIKELY
    if unlikely:
        remarks.append(
            f"the points lie {math.sqrt(cost / freedom):.2g} times as far from the model as their "
            "noise allows: the process is of another structure; K_u and w_u are those of the "
            "points"
        )
    (gain, frequency), covariance = _with_ultimate_point(
        fit, points, fit.searched(values), smooth if unlikely else interpolated
    )
    low, high = harmonics[0].frequency / _BEYOND, harmonics[-1].frequency * _BEYOND
    if math.isnan(gain):
        remarks.append("the points do not tell where the phase is -180 degrees")
    elif not low <= frequency <= high:
        remarks.append(
            f"the ultimate frequency lies outside the points, which begin at "
            f"{harmonics[0].frequency:.4g} rad/s: K_u and w_u depend on the structure of the model"
        )
    wider = cost / freedom if unlikely else 1.0
    found = identified(METHOD, Estimate.of(structure, values, covariance[:-2, :-2] * wider))
    gain_std, frequency_std = np.sqrt(np.diag(covariance)[-2:]).tolist()
    return replace(
        found,
        ultimate_gain=gain,
        ultimate_gain_std=gain_std,
        ultimate_frequency=frequency,
        ultimate_frequency_std=frequency_std,
        warnings=(*found.warnings, *remarks),
        points=harmonics,
    )


def _with_static_gain(
    test: RelayTest, points: tuple[FrequencyPoint, ...], structure: Structure
) -> _Points:
    """Add the static gain as a point at w = 0, where the means show it and the model has one."""
    rest = steady_state(test.record, test.settings)
    if not structure.integrators and rest.measured:
        # The mean command of an unbiased relay is the baseline.
        with suppress(IdentificationError):
            gain = static_gain(test, rest)
            points = (FrequencyPoint(0.0, complex(gain.value), gain.std(rest)), *points)
    return _Points(*(np.array(x) for x in zip(*map(astuple, points), strict=True)))


def _fit(structure: Structure, known: Known, sign: int, points: _Points) -> Fit:
    """Return the least squares over points, with a gain in the direction of the relay."""

    def residual(values: FloatArray) -> FloatArray:
        model = structure.build(values)
        away = (model(1j * points.frequency) - points.value) / points.std
        return np.concatenate((away.real, away.imag[points.frequency > 0.0]))

    given = np.array([getattr(known, name, math.nan) for name in structure.names])
    # A radian at the lowest frequency.
    unit = 1.0 / float(points.frequency[points.frequency > 0.0][0])
    return Fit(structure, given, sign, residual, unit)


def _nearest(fit: Fit, points: _Points) -> tuple[float, FloatArray]:
    """Return the least sum of squares and where it is."""
    target = complex(points.value[points.frequency > 0.0][0])
    starts = []
    for lag in _LAGS if fit.structure.factors else _LAGS[:1]:
        start = {"gain": float(fit.sign), "time_constant": lag * fit.unit, "dead_time": 0.0}
        values = np.array([start[name] for name in fit.structure.names])
        ratio = target / complex(fit.structure.build(values)(1j / fit.unit))
        # The rest of the phase is dead time.
        values[0] = abs(ratio)
        values[-1] = (-float(np.angle(ratio)) % (2.0 * math.pi)) * fit.unit
        starts.append(values)
    cost, x = fit.best(starts)
    # Another period of dead time turns each harmonic by whole turns, and fits as well.
    values = fit.values(x)
    values[-1] %= 2.0 * math.pi * fit.unit
    return cost, values


def _with_ultimate_point(
    fit: Fit, points: _Points, x: FloatArray, between: Interpolation
) -> tuple[tuple[float, float], FloatArray]:
    """Return K_u and w_u, and the covariance of the model's values and these two.

    Each measured number is moved by a share of its deviation; the least of the sum of squares
    then lies one Newton step away. With fewer numbers than values the covariance of these is NaN.

    :param fit: the least squares.
    :param points: what was measured.
    :param x: where the sum of squares is least, shape (m,).
    :param between: how the ultimate point follows from model, frequencies and points.
    """
    # In the order of the residuals: all real parts, then the imaginary ones.
    places = np.arange(points.value.size)
    turned = places[points.frequency > 0.0]
    place = np.concatenate((places, turned))
    steps = fit.steps(x)[: place.size]
    size = points.std[place] * np.repeat((1.0, 1j), (places.size, turned.size))

    def answer(deviations: FloatArray) -> FloatArray:
        moved = points.value.copy()
        np.add.at(moved, place, deviations * size)
        there = fit.values(x + deviations @ steps)
        point = between(fit.structure.build(there), points.frequency, moved)
        ultimate = (math.nan,) * 2 if point is None else (point.gain, point.frequency)
        return np.append(there, ultimate)

    none = np.zeros(place.size)
    gain, frequency = answer(none)[-2:].tolist()
    spread = jacobian(answer, none, none + _STEP)
    squares = spread @ spread.T
    if place.size < fit.free.size:
        # A single point does not determine three values.
        squares[:-2, :-2] = math.nan
    return (gain, frequency), squares
