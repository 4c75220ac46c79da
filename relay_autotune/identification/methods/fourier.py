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
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares
from scipy.special import fdtrc

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, jacobian
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.shown.fourier import (
    FrequencyPoint,
    measured_points,
    static_gain,
    steady_state,
    with_noise_about,
)
from relay_autotune.identification.shown.limit_cycle import NOT_SETTLED, RelayTest, relay_test
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
    w = float(brentq(excess, grid[i], grid[i + 1], xtol=1e-300, rtol=1e-14))
    size = float(logarithm(np.array([w]))[0][0])
    return UltimatePoint(math.copysign(math.exp(-size), sign), w)


METHOD = "fourier"

_UNLIKELY = 1e-3
_LAGS = (0.1, 0.5, 2.0, 10.0)
_NO_VALUE = 1e12 * (1.0 + 1.0j)
_LARGEST, _SMALLEST = 300.0, 1e-300
_LONGEST = 1e4
_BEYOND = 1.3
_STEP = 0.1
# Step of derivatives, and distance that counts as at an end: in logarithms, or in times of a
# radian.
_DIFFERENCE = 1e-4
_AT_END = 1e-6


# Structures beside equal lags: gain, at most one time constant, and dead time.
_STRUCTURES = {s.name: s for s in (FOPDT, IPDT, INTEGRATOR_LAG, UNSTABLE_FOPDT)}


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
    structure = _structure_asked_for(known)
    test = relay_test(METHOD, record, two_levels=False)
    fit = _Fit(structure, known, -1 if test.whole.settings.reverse_acting else 1)
    harmonics = measured_points(test.whole)
    points = _with_static_gain(test, record, harmonics, structure)
    values, cost = fit.best(points)
    if not structure.unstable:
        harmonics = with_noise_about(structure.build(values), test.whole, harmonics)
        points = _with_static_gain(test, record, harmonics, structure)
        cost, x = fit.refined(fit.searched(values), points)
        values = fit.values(x)
    remarks = [] if test.whole.cycle.converged else [NOT_SETTLED]
    freedom = points.numbers - fit.free.size
    # The standard deviations are estimates with few degrees of freedom.
    told = max(4 * (len(test.whole.cycle.cycles) - 1), 1)
    unlikely = freedom > 0 and fdtrc(freedom, told, cost / freedom) < _UNLIKELY
    if unlikely:
        remarks.append(
            f"the points lie {math.sqrt(cost / freedom):.2g} times as far from the model as their "
            "noise allows: the process is of another structure; K_u and w_u are those of the "
            "points"
        )
    between = smooth if unlikely else interpolated
    covariance, ultimate_std = fit.uncertainty(points, values, between)
    covariance = covariance * (cost / freedom if unlikely else 1.0)
    found = identified(METHOD, Estimate.of(structure, values, covariance))
    point = between(found.model, points.frequency, points.value)
    if point is None:
        remarks.append("the points do not tell where the phase is -180 degrees")
    elif not _covered(point.frequency, harmonics):
        remarks.append(
            f"the ultimate frequency lies outside the points, which begin at "
            f"{harmonics[0].frequency:.4g} rad/s: K_u and w_u depend on the structure of the model"
        )
    return replace(
        found,
        ultimate_gain=math.nan if point is None else point.gain,
        ultimate_gain_std=ultimate_std[0],
        ultimate_frequency=math.nan if point is None else point.frequency,
        ultimate_frequency_std=ultimate_std[1],
        warnings=(*found.warnings, *remarks),
        points=harmonics,
    )


def _covered(frequency: float, points: tuple[FrequencyPoint, ...]) -> bool:
    low, high = points[0].frequency, points[-1].frequency
    return low / _BEYOND <= frequency <= high * _BEYOND


def _with_static_gain(
    test: RelayTest, record: Record, points: tuple[FrequencyPoint, ...], structure: Structure
) -> _Points:
    """Add the static gain as a point at w = 0, where the means show it and the model has one."""
    frequency = [p.frequency for p in points]
    value = [p.value for p in points]
    std = [p.std for p in points]
    settings = test.whole.settings
    rest = steady_state(record, settings)
    if not structure.integrators and rest.measured:
        try:
            gain = static_gain(test, rest)
        except IdentificationError:
            # The mean command of an unbiased relay is the baseline.
            pass
        else:
            frequency.insert(0, 0.0)
            value.insert(0, complex(gain.value))
            std.insert(0, gain.std(rest))
    return _Points(np.array(frequency), np.array(value), np.array(std))


def _structure_asked_for(known: Known) -> Structure:
    if known.structure == LAG_N.name or (not known.structure and known.order > 1):
        return LAG_N.of_order(known.order or 2)
    name = known.structure or FOPDT.name
    if name not in _STRUCTURES:
        raise IdentificationError(
            f"{METHOD} has no structure {name!r}; it has {LAG_N.name}, {', '.join(_STRUCTURES)}"
        )
    return _STRUCTURES[name]


@dataclass(frozen=True)
class _Fit:
    """Weighted least squares over points, with a gain in the direction of the relay.

    :param structure: of the model.
    :param known: gain and dead time that are not fitted.
    :param sign: +1, or -1 for a reverse-acting relay.
    """

    structure: Structure
    known: Known
    sign: int

    def __post_init__(self) -> None:
        if self.sign * self.known.gain < 0.0:
            raise IdentificationError(
                f"a gain of {self.known.gain:g} is against the direction of the relay: the known "
                "gain has the wrong sign"
            )

    @cached_property
    def given(self) -> FloatArray:
        """The known values; NaN: to be fitted."""
        facts = {"gain": self.known.gain, "dead_time": self.known.dead_time}
        return np.array([facts.get(n, math.nan) for n in self.structure.names])

    @cached_property
    def free(self) -> NDArray[np.intp]:
        """Indices of the values that are fitted."""
        return np.flatnonzero(np.isnan(self.given))

    @cached_property
    def delays(self) -> NDArray[np.bool_]:
        """Which of the fitted values are a dead time; the others are fitted as logarithms."""
        return np.asarray(~self.structure.logarithmic[self.free])

    def values(self, x: FloatArray) -> FloatArray:
        """Return the values of a point of the search."""
        found = self.given.copy()
        found[self.free] = np.where(self.delays, x, np.exp(np.where(self.delays, 0.0, x)))
        if self.free.size and self.free[0] == 0:
            found[0] *= self.sign
        return found

    def searched(self, values: FloatArray) -> FloatArray:
        """Return the point of the search for some values."""
        at = np.abs(values[self.free])
        return np.where(self.delays, at, np.log(np.maximum(at, _SMALLEST)))

    def residual(self, x: FloatArray, points: _Points) -> FloatArray:
        """Return the model's error in each number, over its standard deviation."""
        model = self.structure.build(self.values(x))
        with np.errstate(over="ignore", invalid="ignore"):
            away = (model(1j * points.frequency) - points.value) / points.std
        # A search that strays meets models without a value: they get a huge error.
        away = np.where(np.isfinite(away), away, _NO_VALUE)
        return np.concatenate((away.real, away.imag[points.frequency > 0.0]))

    def refined(self, x: FloatArray, points: _Points) -> tuple[float, FloatArray]:
        """Return the least sum of squares and where it is, from a start."""
        if x.size == 0:
            return float(np.sum(self.residual(x, points) ** 2)), x
        unit = self._unit(points)
        solved = least_squares(
            self.residual,
            x,
            bounds=self._bounds(unit),
            x_scale=np.where(self.delays, unit, 1.0),
            args=(points,),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        return 2.0 * float(solved.cost), solved.x

    def _unit(self, points: _Points) -> float:
        """Return the time in which a radian passes at the lowest frequency [s]."""
        return 1.0 / float(points.frequency[points.frequency > 0.0][0])

    def _bounds(self, unit: float) -> tuple[FloatArray, FloatArray]:
        """Return both ends of the search: the longest lag is an integrator."""
        ends = {
            "gain": _LARGEST,
            "time_constant": math.log(_LONGEST * unit),
            "dead_time": math.inf,
        }
        high = np.array([ends[self.structure.names[i]] for i in self.free])
        return np.where(self.delays, 0.0, -_LARGEST), high

    def best(self, points: _Points) -> tuple[FloatArray, float]:
        """Return the values of the nearest model, and its sum of squares."""
        first = int(np.flatnonzero(points.frequency > 0.0)[0])
        w, target = float(points.frequency[first]), complex(points.value[first])
        names = self.structure.names
        found = []
        for lag in _LAGS if self.structure.factors else _LAGS[:1]:
            start = {"gain": float(self.sign), "time_constant": lag / w, "dead_time": 0.0}
            trial = self.structure.build(np.array([start[n] for n in names]))
            ratio = target / complex(trial(1j * w))
            # The rest of the phase is dead time.
            start["gain"] = abs(ratio)
            start["dead_time"] = (-float(np.angle(ratio)) % (2.0 * math.pi)) / w
            found.append(self.refined(self.searched(np.array([start[n] for n in names])), points))
        cost, x = min(found, key=lambda each: each[0])
        # Another period of dead time turns each harmonic by whole turns, and fits as well.
        x = np.where(self.delays, np.mod(x, 2.0 * math.pi / w), x)
        return self.values(x), cost

    def uncertainty(
        self, points: _Points, values: FloatArray, between: Interpolation
    ) -> tuple[FloatArray, tuple[float, float]]:
        """Return the covariance of the values, and the deviations of K_u and w_u.

        Each measured number is moved by a share of its deviation; the least of the sum of
        squares then lies one Newton step away. With fewer numbers than values the covariance is
        NaN.

        :param points: what was measured.
        :param values: of the nearest model.
        :param between: how the ultimate point follows from model, frequencies and points.
        """
        x = self.searched(values)
        steps = self._newton_steps(x, points)
        ends_of_search = self._bounds(self._unit(points))
        # In the order of the residuals: all real parts, then the imaginary ones.
        numbers = [(i, 1.0 + 0.0j) for i in range(points.value.size)]
        numbers += [(int(i), 1.0j) for i in np.flatnonzero(points.frequency > 0.0)]
        place = np.array([i for i, _ in numbers])
        size = points.std[place] * np.array([direction for _, direction in numbers])

        def answer(deviations: FloatArray) -> FloatArray:
            moved = points.value.copy()
            np.add.at(moved, place, deviations * size)
            there = self.values(np.clip(x + deviations @ steps, *ends_of_search))
            point = between(self.structure.build(there), points.frequency, moved)
            ultimate = (math.nan,) * 2 if point is None else (point.gain, point.frequency)
            return np.append(there, ultimate)

        none = np.zeros(len(numbers))
        spread = jacobian(answer, none, none + _STEP)
        squares = spread @ spread.T
        if points.numbers < self.free.size:
            # A single point does not determine three values.
            squares[:-2, :-2] = math.nan
        return squares[:-2, :-2], (math.sqrt(squares[-2, -2]), math.sqrt(squares[-1, -1]))

    def _newton_steps(self, x: FloatArray, points: _Points) -> FloatArray:
        """Return how the minimum moves with each measured number, by one standard deviation.

        ``(J'J + sum_i r_i r_i'')^-1 J'`` with the residuals r and their derivatives J; a value at
        an end of its range stays there.

        :param x: where the sum of squares is least, shape (p,).
        :param points: what was measured.
        :return: shape (numbers, p), in the order of :meth:`residual`.
        """
        unit = self._unit(points)
        scale = np.where(self.delays, unit, 1.0)
        low, high = self._bounds(unit)
        inside = np.flatnonzero(np.minimum(x - low, high - x) > _AT_END * scale)
        room = np.where(self.delays, 0.5 * x, math.inf)
        sides = np.diag(np.minimum(_DIFFERENCE * scale, room))[inside]
        here = self.residual(x, points)
        ahead = np.array([self.residual(x + h, points) - here for h in sides])
        back = np.array([self.residual(x - h, points) - here for h in sides])
        steps = np.zeros((points.numbers, x.size))
        if inside.size == 0:
            return steps
        size = sides.max(axis=1)[:, None]
        jacobian = (ahead - back) / (2.0 * size)
        hessian = jacobian @ jacobian.T
        for i, a in enumerate(sides):
            hessian[i, i] += here @ (ahead[i] + back[i]) / size[i, 0] ** 2
            for k in range(i):
                both = self.residual(x + a + sides[k], points) - here
                both += self.residual(x - a - sides[k], points) - here
                mixed = both - ahead[i] - back[i] - ahead[k] - back[k]
                hessian[i, k] += 0.5 * (here @ mixed) / (size[i, 0] * size[k, 0])
                hessian[k, i] = hessian[i, k]
        units = scale[inside]
        scaled = np.linalg.pinv(hessian * np.outer(units, units), hermitian=True)
        steps[:, inside] = jacobian.T @ (scaled * np.outer(units, units))
        return steps
