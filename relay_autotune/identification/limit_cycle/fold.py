# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The averaged period of a relay test as a smooth curve that keeps its sharp edges.

All samples of the steady cycles are laid over one period by the time since the last switch. A
periodic cubic spline runs through them; where the command reaches a first-order process, a dead
time after each switch, the rate of the measurement jumps, and no smoothing may round that edge.
So the spline may have one kink in each half, the same time after each switch. Whether there is
one, where, and how many knots the data carry, is decided by the Bayesian information criterion.

The spline is fitted by least squares and may have a kink.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray
from scipy.linalg import cho_factor
from scipy.linalg.lapack import dpotrs

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import carried, student_95
from relay_autotune.record.cycles import cycle_bounds, limit_cycle, settings_of
from relay_autotune.record.record import Record, RelaySettings, cached_on_record
from relay_autotune.scalar import minimum_near

_RIDGE = 1e-13
# Of the phase of a kink, for each function with one.
_TOLERANCE = 2.5e-8


class Spline:
    """A fit to points, without a kink or with one anywhere.

    The kink's few functions are projected off those of the spline, so that each place costs
    little more than they do.

    :param basis: the functions.
    :param count: number of the spline's functions.
    :param x: phases, shape (n,).
    :param y: shape (n,).
    :param weight: number of samples that each point stands for, shape (n,).
    """

    def __init__(
        self, basis: Basis, count: int, x: FloatArray, y: FloatArray, weight: FloatArray
    ) -> None:
        # Imported here, because it loads slowly, and a record without a relay needs none.
        from scipy.sparse import csr_array

        self._basis, self._count, self._x = basis, count, x
        self._root = np.sqrt(weight)[:, None]
        columns = basis.spline(x, count, 0)
        if basis.mirrored:
            columns = np.column_stack((columns, np.ones(x.size)))
        # Only four or five of the functions are not zero at a point.
        self._columns = csr_array(columns * self._root)
        self._transposed = csr_array(self._columns.T)
        gram = (self._transposed @ self._columns).toarray()
        # Knots without samples leave functions without data.
        gram[np.diag_indices_from(gram)] += _RIDGE * float(np.trace(gram))
        self._factor = cho_factor(gram)
        target = self._root[:, 0] * y
        self._smooth = self._along(target)
        self._left = target - self._columns @ self._smooth

    def _along(self, columns: FloatArray) -> FloatArray:
        # cho_solve would take longer to check the right side than to solve.
        found, _ = dpotrs(self._factor[0], self._transposed @ columns, self._factor[1])
        return np.asarray(found)

    def fitted(self, edge: float) -> tuple[FloatArray, float]:
        """Return the coefficients and the sum of squared residuals.

        :param edge: phase of the kink; NaN: none.
        :return: coefficients of the spline, of the kink's functions, and the offset.
        """
        if math.isnan(edge):
            return self._smooth, float(self._left @ self._left)
        cost, part, along = self._kinked(edge)
        rest = self._smooth - along @ part
        return np.concatenate((rest[: self._count], part, rest[self._count :])), cost

    def _kinked(self, edge: float) -> tuple[float, FloatArray, FloatArray]:
        columns = self._basis.edges(self._x, edge, 0) * self._root
        along = self._along(columns)
        columns = columns - self._columns @ along
        part = np.linalg.lstsq(columns, self._left, rcond=1e-10)[0]
        rest = self._left - columns @ part
        return float(rest @ rest), np.asarray(part), along

    def searched(self, places: FloatArray) -> float:
        """Return the place at which a kink leaves the least sum of squares.

        :param places: phases, shape (m,).
        """
        return float(places[np.argmin([self._kinked(p)[0] for p in places.tolist()])])

    def refined(self, near: float, places: FloatArray) -> float:
        """Return the best place of a kink between the two places about one.

        :param near: phase.
        :param places: increasing phases, shape (m,).
        """
        i = int(np.argmin(np.abs(places - near)))
        return minimum_near(
            lambda p: self._kinked(p)[0], places, i, _TOLERANCE * self._basis.kinks
        )[0]


def _with_slopes(*rows: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Return coefficients of polynomials and of their derivatives, a column for each."""
    coefficients = np.array(rows).T
    return coefficients, np.asarray(polyder(coefficients))


# The four pieces of a cubic B-spline, and functions with a jump of the first and of the second
# derivative at the ends of their unit.
_PIECES = _with_slopes(
    *((1 / 6, -0.5, 0.5, -1 / 6), (2 / 3, 0.0, -1.0, 0.5), (1 / 6, 0.5, 0.5, -0.5)),
    (0.0, 0.0, 0.0, 1 / 6),
)
_BERNOULLI = _with_slopes((0.0, 1.0, -1.0, 0.0), (0.0, 1.0, -3.0, 2.0))


@dataclass(frozen=True)
class Basis:
    """Functions of the phase that repeat with period 1.

    :param mirrored: True: their second half is the first one upside down.
    :param high: phase of the switch to low.
    """

    mirrored: bool
    high: float

    @property
    def kinks(self) -> int:
        """Number of functions with a kink."""
        return 2 if self.mirrored else 4

    def spline(self, phase: FloatArray, count: int, derivative: int) -> FloatArray:
        """Return cubic B-splines on even knots, or their rates, shape (n, count)."""
        knots = count * (2 if self.mirrored else 1)
        place = (phase % 1.0) * knots
        cell = np.minimum(np.floor(place).astype(np.int64), knots - 1)
        columns, rows = np.zeros((phase.size, knots)), np.arange(phase.size)
        pieces = float(knots) ** derivative * polyval(place - cell, _PIECES[derivative])
        for k, piece in enumerate(pieces):
            columns[rows, (cell + k) % knots] += piece
        return columns[:, :count] - columns[:, count:] if self.mirrored else columns

    def edges(self, phase: FloatArray, edge: float, derivative: int) -> FloatArray:
        """Return functions whose first or second derivative jumps, shape (n, kinks).

        They are Bernoulli's polynomials of second and third degree, at ``edge`` and at
        ``high + edge``.
        """
        pair = _BERNOULLI[derivative]
        first, second = (
            polyval((phase - place) % 1.0, pair).T for place in (edge, self.high + edge)
        )
        return first - second if self.mirrored else np.hstack((first, second))


# Numbers of knots in half a period, from the fewest on, and least number of samples for each
# function.
_KNOTS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
_SAMPLES_PER_KNOT = 3.0
_MOST_POINTS = 1200
_PLACES = 40
_PATIENCE = 2
# Number of knots up to which the kink is searched for everywhere; with more, near the last one.
_SEARCHED = 16
_NEGLIGIBLE = 1e-9
# Halves that differ by less of the period count as equal, and a relay with less bias as unbiased.
SYMMETRIC = 0.05
NO_BIAS = 0.01
_GRID = 2001
_DEVIATIONS = 6.0
_SHARE = 0.02


@dataclass(frozen=True)
class Fold:
    """One period of the steady oscillation, as a function of the time since the switch to high.

    :param period_high: mean time with the command high [s].
    :param period_low: mean time with the command low [s].
    :param settings: the relay.
    :param edge: time from each switch to the kink that follows it [s]; NaN: the curve is smooth.
    :param noise_std: scatter of the samples about the curve [y].
    :param samples: number of samples laid over one another.
    :param mirrored: True if each half is the other one upside down, up to an offset.
    :param coefficients: of the spline's functions, of those of the kinks, and the offset [y].
    :param lowest: of all samples, about the set-point [y].
    :param highest: of all samples, about the set-point [y].
    """

    period_high: float
    period_low: float
    settings: RelaySettings
    edge: float
    noise_std: float
    samples: int
    mirrored: bool
    coefficients: FloatArray
    lowest: float
    highest: float

    @property
    def period(self) -> float:
        """Mean whole period [s]."""
        return self.period_high + self.period_low

    @property
    def count(self) -> int:
        """Number of the spline's functions."""
        kinks = 0 if math.isnan(self.edge) else Basis(self.mirrored, 0.0).kinks
        return self.coefficients.size - kinks - self.mirrored

    @property
    def curve_std(self) -> float:
        """Standard deviation of the curve itself, on average [y]."""
        return self.noise_std * math.sqrt(self.coefficients.size / self.samples)

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the measurement about the set-point at any times.

        :param time: since the switch to the high level [s], shape (n,).
        :return: y, shape (n,).
        """
        return self._value(np.asarray(time, dtype=np.float64), 0)

    def slope(self, time: FloatArray) -> FloatArray:
        """Return the rate of the measurement at any times.

        :param time: since the switch to the high level [s], shape (n,).
        :return: y/s, shape (n,).
        """
        return self._value(np.asarray(time, dtype=np.float64), 1)

    def peaks(self) -> tuple[float, float]:
        """Return the lowest and the highest measurement about the set-point [y].

        Noise makes a smooth maximum beside a kink too high; so the kink counts where it is the
        peak within the uncertainty of the curve. No peak lies beyond all samples.
        """
        y = self(np.linspace(0.0, self.period, _GRID))
        ends = max(float(np.min(y)), self.lowest), min(float(np.max(y)), self.highest)
        if math.isnan(self.edge):
            return ends
        kinks = self(np.array([self.edge, self.period_high + self.edge]))
        allowed = self.tolerance
        low = max(float(np.min(kinks)), self.lowest)
        high = min(float(np.max(kinks)), self.highest)
        return (
            low if low <= ends[0] + allowed else ends[0],
            high if high >= ends[1] - allowed else ends[1],
        )

    @property
    def tolerance(self) -> float:
        """How much lower than the highest point a kink may lie and still be the peak [y].

        At a kink the curve is less certain than on average, and splines swing a little about it.
        """
        swing = 0.5 * float(np.ptp(self(np.linspace(0.0, self.period, _GRID))))
        return _DEVIATIONS * self.curve_std + _SHARE * swing

    def half(self, time: FloatArray) -> FloatArray:
        """Return the deviation after the switch that turns the measurement down, of both halves.

        :param time: since that switch, up to half a period [s], shape (n,).
        :return: mean of one half and of the other, turned over [y], shape (n,).
        """
        down, up = self(time + self.period_high), self(time)
        return 0.5 * (down - up) * (-1.0 if self.settings.reverse_acting else 1.0)

    def fundamental(self) -> complex:
        """Return G(j w) at the frequency of the limit cycle (Wang et al. 1997, eq 23) [y/u]."""
        w, unit = 2.0 * math.pi / self.period, self.period / _GRID
        # The sum over a whole period is exact but for the kinks.
        time = unit * np.arange(_GRID)
        answer = unit * complex(np.sum(self(time) * np.exp(-1j * w * time)))
        swing = self.settings.high - self.settings.low
        return answer / (swing * (1.0 - np.exp(-1j * w * self.period_high)) / (1j * w))

    @property
    def switching(self) -> tuple[float, float]:
        """Middle and half distance of the levels at which the relay was seen to switch [y].

        The latter is negative where noise put them in the order in which no relay switches.
        """
        at_high, at_low = (float(v) for v in self(np.array([0.0, self.period_high])))
        side = -1.0 if self.settings.reverse_acting else 1.0
        return 0.5 * (at_high + at_low), 0.5 * (at_low - at_high) * side

    def _value(self, time: FloatArray, derivative: int) -> FloatArray:
        unit = self.period
        columns = Basis(self.mirrored, self.period_high / unit)
        count = self.count
        y = columns.spline(time / unit, count, derivative) @ self.coefficients[:count]
        if not math.isnan(self.edge):
            part = columns.edges(time / unit, self.edge / unit, derivative)
            y = y + part @ self.coefficients[count : count + columns.kinks]
        if self.mirrored and derivative == 0:
            y = y + self.coefficients[-1]
        return np.asarray(y / unit if derivative else y)


def fold(record: Record, *, sharp: bool = False, left_out: int | None = None) -> Fold:
    """Average the steady cycles of a relay test.

    :param record: with at least one whole cycle.
    :param sharp: True if there is a kink for certain, so that only its place is decided.
    :param left_out: number of a cycle that is left out, with the knots of the average of all and
        the kink near theirs; None: none.
    :raises IdentificationError: if the record holds no whole cycle, or too few samples in it.
    """
    if settings_of(record) is None or len(cycle_bounds(record)) < 2:
        raise IdentificationError(
            "the shape of a limit cycle needs at least one whole cycle of a relay test and the "
            "record holds none: use the method waveform, which takes any input"
        )
    return _averaged(record, sharp, left_out)


# Least number of cycles that have a scatter; of many, not every one is left out.
LEAST_CYCLES, _MOST_PARTS = 3, 20


@dataclass(frozen=True)
class Reading:
    """Numbers of a limit cycle, with their scatter from cycle to cycle.

    :param values: the numbers, shape (n,).
    :param covariance: of these, shape (n, n); None: not estimated.
    :param cycles: number of cycles that were averaged.
    """

    values: FloatArray
    covariance: FloatArray | None = None
    cycles: int = 1

    @classmethod
    def of(
        cls,
        record: Record,
        measure: Callable[[Fold], FloatArray],
        *,
        sharp: bool = False,
    ) -> Reading:
        """Measure an averaged period; the scatter is that of leaving out each cycle once.

        :param record: with whole cycles; fewer than three have no scatter.
        :param measure: from an averaged period to numbers, shape (n,).
        :param sharp: as for :func:`fold`.
        """
        cycles = limit_cycle(record).cycles
        count, values, covariance = len(cycles), measure(fold(record, sharp=sharp)), None
        if count >= LEAST_CYCLES:
            left_out = cycles[:: -(-count // _MOST_PARTS)]
            folds = [fold(record, sharp=sharp, left_out=c) for c in left_out]
            parts = np.array([measure(each) for each in folds])
            away = parts - np.mean(parts, axis=0)
            covariance = np.asarray(away.T @ away * (count - 1) / len(parts))
        return cls(values, covariance, count)

    @property
    def quantile(self) -> float:
        """Half the width of a 95 % interval in standard deviations."""
        return student_95(self.cycles - 1)

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the numbers, shape (n,); NaN: not estimated."""
        if self.covariance is None:
            return np.full(self.values.size, math.nan)
        return np.sqrt(np.diag(self.covariance))

    def carried(self, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return the covariance of a function of the numbers, NaN where none was estimated.

        :param function: from numbers, shape (n,), to values, shape (p,).
        """
        if self.covariance is not None:
            return carried(function, self.values, self.covariance)
        size = function(self.values).size
        return np.full((size, size), math.nan)

    def with_number(self, i: int, value: float, std: float) -> Reading:
        """Return the reading with a number that is known otherwise, independently of the others.

        :param i: its place.
        :param value: the number.
        :param std: its standard deviation.
        """
        values, covariance = self.values.copy(), self.covariance
        values[i] = value
        if covariance is not None:
            covariance = covariance.copy()
            covariance[i], covariance[:, i] = 0.0, 0.0
            covariance[i, i] = std**2
        return Reading(values, covariance, self.cycles)


@cached_on_record
def _averaged(record: Record, sharp: bool, left_out: int | None) -> Fold:
    settings = settings_of(record)
    assert settings is not None
    chosen = [c for c in limit_cycle(record).cycles if c != left_out]
    like = None if left_out is None else _averaged(record, sharp, None)
    since, is_high, y, high, low = _overlaid(record, settings, chosen)
    mirrored = abs(settings.bias) <= NO_BIAS * settings.amplitude and abs(
        high - low
    ) <= SYMMETRIC * (high + low)
    if like is not None:
        mirrored = like.mirrored
    if mirrored:
        high = low = 0.5 * (high + low)
    usable = np.where(is_high, since < high, since < low)
    time = (since + np.where(is_high, 0.0, high))[usable]
    return _smoothed(
        time, y[usable] - settings.setpoint, high, low, settings, mirrored, like, sharp
    )


def as_switched(seen: Fold) -> RelaySettings:
    """Return the relay with the levels at which it was seen to switch.

    :param seen: the averaged period.
    """
    middle, level = seen.switching
    setpoint = seen.settings.setpoint + middle
    return replace(seen.settings, setpoint=setpoint, hysteresis=max(level, 0.0))


def _overlaid(
    record: Record, settings: RelaySettings, chosen: Sequence[int]
) -> tuple[FloatArray, NDArray[np.bool_], FloatArray, float, float]:
    """Return of all samples the time since the last switch, the level and y; mean half periods."""
    middle, bounds = settings.baseline + settings.bias, cycle_bounds(record)
    switches = [_switches(record, bounds[c], bounds[c + 1], middle) for c in chosen]
    up, down, end = np.array(switches).T
    cycle = np.searchsorted(up, record.time, side="right") - 1
    inside = (cycle >= 0) & (record.time < end[cycle])
    time, cycle = record.time[inside], cycle[inside]
    is_high = time < down[cycle]
    since = time - np.where(is_high, up[cycle], down[cycle])
    half_periods = float(np.mean(down - up)), float(np.mean(end - down))
    return since, is_high, record.measurement[inside], *half_periods


def switched_at(record: Record, samples: Sequence[int]) -> FloatArray:
    """Return when the command switched next to some samples [s].

    :param record: with a command that switches.
    :param samples: numbers of the samples.
    """
    switches = record.input().times
    nearest = [switches[np.argmin(np.abs(switches - record.time[s]))] for s in samples]
    return np.minimum(nearest, record.time[-1])


def _switches(record: Record, first: int, last: int, middle: float) -> tuple[float, float, float]:
    """Return the instants at which a cycle's command went high, low, and high again."""
    u = record.input()
    up, end = switched_at(record, (first, last)).tolist()
    inside = (u.times > up) & (u.times < end)
    edges = np.concatenate((u.times[inside], [end]))
    # Noise may make the relay switch back and forth; the longest stay at the low level counts.
    levels = u.values[inside]
    stays = [(b - a, a) for (a, b), v in zip(pairwise(edges), levels, strict=True) if v < middle]
    if not stays:
        raise IdentificationError(
            f"the command never went low in the cycle that begins at {up:g} s: the record's "
            "cycles and its command do not belong together"
        )
    return up, float(max(stays)[1]), end


def _smoothed(
    time: FloatArray,
    y: FloatArray,
    high: float,
    low: float,
    settings: RelaySettings,
    mirrored: bool,
    like: Fold | None,
    sharp: bool,
) -> Fold:
    if like is None and y.size < _SAMPLES_PER_KNOT * 2 * _KNOTS[0]:
        raise IdentificationError(
            f"the steady cycles hold {y.size} samples; their shape needs at least "
            f"{_SAMPLES_PER_KNOT * 2 * _KNOTS[0]:g}: sample faster, or let the relay run longer"
        )
    unit = high + low
    x, value, weight = _binned(time / unit, y)
    n = x.size
    basis = Basis(mirrored, high / unit)
    # The command reaches the process before the next switch, which it causes.
    places = np.linspace(0.0, min(high, low) / unit, _PLACES + 1, endpoint=False)[1:]

    def smoothed(spline: Spline, edge: float) -> Fold:
        coefficients, cost = spline.fitted(edge)
        scatter = math.sqrt(cost / max(n - coefficients.size, 1))
        return Fold(
            *(high, low, settings, edge * unit, scatter, y.size, mirrored, coefficients),
            *(float(np.min(y)), float(np.max(y))),
        )

    if like is not None:
        spline, edge = Spline(basis, like.count, x, value, weight), like.edge / unit
        return smoothed(spline, edge if math.isnan(edge) else spline.refined(edge, places))
    floor = n * (_NEGLIGIBLE * float(np.ptp(y))) ** 2 or 1e-300
    best: tuple[Spline, float] | None = None
    least, worse, edge = math.inf, 0, math.nan
    for half in _KNOTS:
        count = half if mirrored else 2 * half
        if best is not None and (n < _SAMPLES_PER_KNOT * count or worse > _PATIENCE):
            break
        worse += 1
        spline = Spline(basis, count, x, value, weight)
        if half <= _SEARCHED:
            edge = spline.searched(places)
        edge = spline.refined(edge, places)
        for place in (edge,) if sharp else (math.nan, edge):
            coefficients, cost = spline.fitted(place)
            k = coefficients.size + (not math.isnan(place))
            criterion = n * math.log(max(cost, floor)) + k * math.log(n)
            if criterion < least:
                least, worse, best = criterion, 0, (spline, place)
    assert best is not None
    return smoothed(*best)


def _binned(phase: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Average neighbouring samples where there are more than the curve needs."""
    if phase.size <= _MOST_POINTS:
        return phase, y, np.ones(phase.size)
    number = np.floor(phase * (_MOST_POINTS / float(phase.max()))).astype(np.int64)
    count = np.bincount(number).astype(np.float64)
    used = count > 0.0
    x, value = (np.bincount(number, v)[used] / count[used] for v in (phase, y))
    return x, value, count[used]
