# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The averaged period of a relay test as a smooth curve that keeps its sharp edges.

All samples of the steady cycles are laid over one period by the time since the last switch. A
periodic cubic spline runs through them; where the command reaches a first-order process, a dead
time after each switch, the rate of the measurement jumps, and no smoothing may round that edge.
So the spline may have one kink in each half, the same time after each switch. Whether there is
one, where, and how many knots the data carry, is decided by the Bayesian information criterion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.shown.periodic_spline import Basis, Kinks, Spline
from relay_autotune.record.cycles import find_cycles, limit_cycle, settings_of
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings, asked_once

# Numbers of knots in half a period, from the fewest on, and least number of samples for each.
_KNOTS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
_SAMPLES_PER_KNOT = 3.0
_MOST_POINTS = 1200
_PLACES = 40
_PATIENCE = 2
# Number of knots up to which the kink is searched for everywhere; with more, near the last one.
_SEARCHED = 16
_NEGLIGIBLE = 1e-9
_SYMMETRIC = 0.05
_NO_BIAS = 0.01
_GRID = 2001
_DEVIATIONS = 6.0
_SHARE = 0.02
_CELLS = 64
_QUADRATURE = np.polynomial.legendre.leggauss(4)


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
    """

    period_high: float
    period_low: float
    settings: RelaySettings
    edge: float
    noise_std: float
    samples: int
    mirrored: bool
    coefficients: FloatArray

    @property
    def period(self) -> float:
        """Mean whole period [s]."""
        return self.period_high + self.period_low

    @property
    def knots(self) -> int:
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
        peak within the uncertainty of the curve.
        """
        y = self(np.linspace(0.0, self.period, _GRID))
        ends = float(np.min(y)), float(np.max(y))
        if math.isnan(self.edge):
            return ends
        kinks = self(np.array([self.edge, self.period_high + self.edge]))
        allowed = _DEVIATIONS * self.curve_std + _SHARE * 0.5 * (ends[1] - ends[0])
        low, high = float(np.min(kinks)), float(np.max(kinks))
        return (
            low if low <= ends[0] + allowed else ends[0],
            high if high >= ends[1] - allowed else ends[1],
        )

    def fundamental(self) -> complex:
        """Return G(j w) at the frequency of the limit cycle (Wang et al. 1997, eq 23) [y/u]."""
        w = 2.0 * math.pi / self.period
        edge = 0.5 * self.period_high if math.isnan(self.edge) else self.edge
        bounds = (0.0, edge, self.period_high, self.period_high + edge, self.period)
        nodes, weights = _QUADRATURE
        answer = 0.0j
        for begin, end in pairwise(bounds):
            # In each piece between kinks the spline is smooth except at its knots.
            cells = np.linspace(begin, end, _CELLS + 1)
            half = 0.5 * (end - begin) / _CELLS
            time = (cells[:-1, None] + half * (nodes + 1.0)).ravel()
            share = np.tile(weights * half, _CELLS)
            answer += complex(np.sum(self(time) * np.exp(-1j * w * time) * share))
        swing = self.settings.high - self.settings.low
        return answer / (swing * (1.0 - np.exp(-1j * w * self.period_high)) / (1j * w))

    def _value(self, time: FloatArray, derivative: int) -> FloatArray:
        unit = self.period_high if self.mirrored else self.period
        columns = Basis(self.mirrored, self.period_high / unit)
        knots = self.knots
        y = columns.spline(time / unit, knots, derivative) @ self.coefficients[:knots]
        if not math.isnan(self.edge):
            part = columns.edges(time / unit, self.edge / unit, derivative)
            y = y + part @ self.coefficients[knots : knots + columns.kinks]
        if self.mirrored and derivative == 0:
            y = y + self.coefficients[-1]
        return np.asarray(y / unit if derivative else y)


def fold(record: Record, cycles: tuple[int, ...] = (), *, sharp: bool = False) -> Fold:
    """Average the steady cycles of a relay test.

    :param record: with at least one whole cycle.
    :param cycles: numbers of the cycles to be averaged; default: those of the limit cycle.
    :param sharp: True if there is a kink for certain, so that only its place is decided.
    :raises IdentificationError: if the record holds no whole cycle, or too few samples in it.
    """
    if settings_of(record) is None or len(record.cycle_start or find_cycles(record)) < 2:
        raise IdentificationError(
            "the shape of a limit cycle needs at least one whole cycle of a relay test and the "
            "record holds none: use the method waveform, which takes any input"
        )
    return _averaged(record, cycles or limit_cycle(record).cycles, sharp)


@asked_once
def fold_without(
    record: Record, cycles: tuple[int, ...], left_out: int, sharp: bool = False
) -> Fold:
    """Average all but one of some cycles, with the knots of the average of all.

    :param record: with whole cycles.
    :param cycles: numbers of the cycles.
    :param left_out: number of the cycle that is left out; the kink is sought near that of all.
    :param sharp: as for :func:`fold`.
    :raises IdentificationError: if there are too few samples in the others.
    """
    rest = tuple(c for c in cycles if c != left_out)
    return _average(record, rest, fold(record, cycles, sharp=sharp), sharp=False)


@asked_once
def _averaged(record: Record, cycles: tuple[int, ...], sharp: bool) -> Fold:
    return _average(record, cycles, None, sharp=sharp)


def _average(record: Record, cycles: tuple[int, ...], like: Fold | None, *, sharp: bool) -> Fold:
    settings = settings_of(record)
    assert settings is not None
    bounds = record.cycle_start or find_cycles(record)
    since, is_high, y, high, low = _overlaid(record, settings, bounds, cycles)
    mirrored = abs(settings.bias) <= _NO_BIAS * settings.amplitude and abs(
        high - low
    ) <= _SYMMETRIC * (high + low)
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
    at_high, at_low = (float(v) for v in seen(np.array([0.0, seen.period_high])))
    half = 0.5 * (at_low - at_high) * (-1.0 if seen.settings.reverse_acting else 1.0)
    return replace(
        seen.settings,
        setpoint=seen.settings.setpoint + 0.5 * (at_high + at_low),
        hysteresis=max(half, 0.0),
    )


def _overlaid(
    record: Record, settings: RelaySettings, bounds: tuple[int, ...], chosen: tuple[int, ...]
) -> tuple[FloatArray, NDArray[np.bool_], FloatArray, float, float]:
    """Return of all samples the time since the last switch, the level and y; mean half periods."""
    u = record.input()
    middle = settings.baseline + settings.bias
    since, is_high, y, highs, lows = [], [], [], [], []
    for index in chosen:
        first, last = bounds[index], bounds[index + 1]
        up, down, end = _switches(record, u, first, last, middle)
        t = record.time[first : last + 1]
        inside = (t >= up) & (t < end)
        t = t[inside]
        at_high = t < down
        since.append(t - np.where(at_high, up, down))
        is_high.append(at_high)
        y.append(record.measurement[first : last + 1][inside])
        highs.append(down - up)
        lows.append(end - down)
    return (
        np.concatenate(since),
        np.concatenate(is_high),
        np.concatenate(y),
        float(np.mean(highs)),
        float(np.mean(lows)),
    )


def _switches(
    record: Record, u: PiecewiseConstant, first: int, last: int, middle: float
) -> tuple[float, float, float]:
    """Return the instants at which a cycle's command went high, low, and high again."""
    ends = []
    for sample in (first, last):
        nearest = int(np.argmin(np.abs(u.times - record.time[sample])))
        ends.append(min(float(u.times[nearest]), float(record.time[-1])))
    up, end = ends
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
    if y.size < _SAMPLES_PER_KNOT * 2 * _KNOTS[0]:
        raise IdentificationError(
            f"the steady cycles hold {y.size} samples; their shape needs at least "
            f"{_SAMPLES_PER_KNOT * 2 * _KNOTS[0]:g}: sample faster, or let the relay run longer"
        )
    unit = high if mirrored else high + low
    x, value, weight = _binned(time / unit, y)
    n = x.size
    basis = Basis(mirrored, high / unit)
    # The command reaches the process before the next switch, which it causes.
    places = np.linspace(0.0, min(high, low) / unit, _PLACES + 1, endpoint=False)[1:]

    def smoothed(spline: Spline, edge: float) -> Fold:
        coefficients, cost = spline.fitted(edge)
        scatter = math.sqrt(cost / max(n - coefficients.size, 1))
        return Fold(high, low, settings, edge * unit, scatter, y.size, mirrored, coefficients)

    if like is not None:
        spline, edge = Spline(basis, like.knots, x, value, weight), like.edge / unit
        return smoothed(spline, edge if math.isnan(edge) else spline.refined(edge, places))
    floor = n * (_NEGLIGIBLE * float(np.ptp(y))) ** 2 or 1e-300
    best: tuple[Spline, float] | None = None
    least, worse, edge = math.inf, 0, math.nan
    kinks = Kinks.at(basis, places, x, weight)
    for half in _KNOTS:
        knots = half if mirrored else 2 * half
        if best is not None and (n < _SAMPLES_PER_KNOT * knots or worse > _PATIENCE):
            break
        worse += 1
        spline = Spline(basis, knots, x, value, weight)
        if half <= _SEARCHED:
            edge = spline.searched(kinks)
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
