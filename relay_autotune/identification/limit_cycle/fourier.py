# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Points of the frequency response by Fourier integrals: at rest, fundamental and harmonics.

The point of frequency zero is the static gain from the means of measurement and command.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.limit_cycle.fold import LEAST_CYCLES
from relay_autotune.identification.limit_cycle.limit_cycle import RelayTest
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import result_field
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings, cached_on_record


@dataclass(frozen=True)
class FrequencyPoint:
    """The process at one frequency."""

    frequency: float = result_field("rad/s", nan=True)
    """w."""
    value: complex = result_field("y/u", nan=True)
    """G(j w)."""
    std: float = result_field("y/u", math.nan, lower=0.0)
    """Standard deviation of its real and of its imaginary part; NaN: not estimated."""


def fourier_integral_held(u: PiecewiseConstant, start: float, end: float, w: float) -> complex:
    """Return the integral of ``u(t) exp(-j w t)`` from ``start`` to ``end``, exactly.

    :param u: the held signal.
    :param start: s.
    :param end: s.
    :param w: rad/s; 0: the plain integral.
    """
    inside = u.times[(u.times > start) & (u.times < end)]
    edges = np.concatenate(([start], inside, [end]))
    levels = u(edges[:-1])
    if w == 0.0:
        return complex(np.sum(levels * np.diff(edges)))
    turns = np.exp(-1j * w * edges)
    return complex(np.sum(levels * np.diff(turns)) / (-1j * w))


def fourier_integral_sampled(
    time: FloatArray, y: FloatArray, start: float, end: float, w: float
) -> complex:
    """Return the integral of ``y(t) exp(-j w t)`` for samples joined by straight lines.

    Exact for the polygon at any frequency, so that coarse or irregular samples cost no more than
    their own interpolation error.

    :param time: increasing [s], shape (n,).
    :param y: shape (n,).
    :param start: not before the first sample [s].
    :param end: not after the last sample [s].
    :param w: rad/s; 0: the plain integral.
    """
    inside = (time > start) & (time < end)
    t = np.concatenate(([start], time[inside], [end]))
    v = np.concatenate((np.interp([start], time, y), y[inside], np.interp([end], time, y)))
    h, rise = np.diff(t), np.diff(v)
    if w == 0.0:
        return complex(np.sum((v[:-1] + 0.5 * rise) * h))
    # By parts: the two ends, and the rise along each line, or of a jump.
    turns = np.exp(-1j * w * t)
    moved = np.divide(np.diff(turns), h, out=-1j * w * turns[:-1], where=h > 0.0)
    ends = (v[0] * turns[0] - v[-1] * turns[-1]) / 1j
    return complex((ends + np.sum(rise * moved) / w) / w)


def frequency_point(record: Record, ends: FloatArray, harmonic: int = 1) -> FrequencyPoint:
    """Return one point of the frequency response from a limit cycle (Wang et al. 1997, eq 23).

    ``G(j k w0) = int y exp(-j k w0 t) dt / int u exp(-j k w0 t) dt`` over whole cycles; exact in
    the limit cycle, whatever the process.

    :param record: with whole cycles.
    :param ends: when they begin, and when the last one ends [s], shape (cycles + 1,).
    :param harmonic: k; odd, or the command of an unbiased relay holds nothing there.
    :raises IdentificationError: if the command lacks the harmonic.
    """
    start, end = float(ends[0]), float(ends[-1])
    w = harmonic * 2.0 * math.pi * (ends.size - 1) / (end - start)
    u = record.input()
    excited = fourier_integral_held(u, start, end, w)
    if abs(excited) < 1e-3 * (end - start) * float(np.ptp(u.levels)) / (2.0 * math.pi * harmonic):
        raise IdentificationError(
            f"the command holds nothing at harmonic {harmonic} of its cycle; use an odd one"
        )
    answer = fourier_integral_sampled(record.time, record.measurement, start, end, w)
    return FrequencyPoint(w, answer / excited)


def cycle_means(record: Record, start: float, end: float) -> tuple[float, float]:
    """Return the means of measurement [y] and command [u] between two instants.

    :param record: the record.
    :param start: begin of a cycle [s].
    :param end: end of a cycle [s].
    """
    y = fourier_integral_sampled(record.time, record.measurement, start, end, 0.0).real
    u = fourier_integral_held(record.input(), start, end, 0.0).real
    return y / (end - start), u / (end - start)


_LEAST_BIAS = 0.02
_LEAST_SAMPLES = 8
# Number of cycles that gives their scatter within 10 %.
_MOST_SINGLES = 60

UNKNOWN_REST = (
    "no samples at rest before the test: the set-point stands in for the steady state, and the "
    "intervals do not include its error"
)


@dataclass(frozen=True)
class SteadyState:
    """The measurement at rest under the baseline.

    :param value: [y].
    :param std: its standard deviation [y]; NaN: not estimated.
    :param measured: False: the set-point stands in for it.
    """

    value: float
    std: float
    measured: bool


@dataclass(frozen=True)
class StaticGain:
    """The gain from the means of command and measurement.

    :param value: K [y/u], with its sign.
    :param scatter: its standard deviation from cycle to cycle [y/u]; NaN: not estimated.
    :param excursion: mean command minus baseline [u].
    """

    value: float
    scatter: float
    excursion: float

    def std(self, rest: SteadyState) -> float:
        """Return the standard deviation with that of the steady state [y/u]."""
        return math.hypot(self.scatter, rest.std / self.excursion)


@cached_on_record
def steady_state(record: Record, settings: RelaySettings) -> SteadyState:
    """Return the measurement at rest.

    Before the first kick the command is the baseline; the mean of those samples is the steady
    state. Without any, the set-point stands in for it.

    :param record: the record.
    :param settings: its relay.
    """
    moved = np.flatnonzero(record.command != settings.baseline)
    resting = int(moved[0]) if moved.size else 0
    if resting < 1:
        return SteadyState(settings.setpoint, math.nan, measured=False)
    # The sample that was answered by the kick was itself taken at rest.
    y = record.measurement[: resting + 1]
    noise = float(np.std(y, ddof=1)) if y.size >= _LEAST_SAMPLES else record.noise
    return SteadyState(float(np.mean(y)), noise / math.sqrt(y.size), measured=True)


def static_gain(test: RelayTest, rest: SteadyState) -> StaticGain:
    """Return the static gain (Wang, Hang and Zou 1997, eq 6).

    ``K = (mean(y) - rest)/(mean(u) - baseline)`` over whole cycles. An error of the steady state,
    or a load that came after it was measured, enters K divided by the same denominator.

    :param test: a relay test with a bias.
    :param rest: the measurement under the baseline.
    :raises IdentificationError: if the mean command is the baseline: the relay was unbiased, or
        the process integrates.
    """
    record, settings = test.record, test.settings

    def ratio(start: float, end: float) -> tuple[float, float]:
        mean_y, mean_u = cycle_means(record, start, end)
        away = mean_u - settings.baseline
        return (mean_y - rest.value) / away if away else math.inf, away

    ends = test.ends
    value, excursion = ratio(float(ends[0]), float(ends[-1]))
    if abs(excursion) < _LEAST_BIAS * settings.amplitude:
        raise IdentificationError(
            f"the mean command is only {excursion:g} away from the baseline, so that its ratio to "
            "the measurement (eq 6) tells no gain: use a biased relay, or the method "
            "wang_unbiased; an integrating process always has a mean of zero"
        )
    count = ends.size - 1
    stride = -(-count // _MOST_SINGLES)
    each = [ratio(*ends[i : i + 2].tolist())[0] for i in range(0, count, stride)]
    known = len(each) >= LEAST_CYCLES
    scatter = float(np.std(each, ddof=1)) / math.sqrt(count) if known else math.nan
    return StaticGain(value, scatter, excursion)


Points = tuple[FrequencyPoint, ...]

_MOST = 9
# Largest w h of a harmonic with samples h apart, and the factor of the relative error
# (w h)^2/12 of straight lines between them.
_COARSEST = 0.5
_POLYGON = 1.0 / 12.0
_TOO_UNCERTAIN = 0.2
_NEIGHBOURS = 6


def measured_points(test: RelayTest) -> Points:
    """Return the points at the harmonics that the command of a relay test excites.

    Their standard deviations are those of white noise, and of straight lines between the samples.
    Harmonics that are uncertain by more than a fifth, or have too few samples, are left out.

    :param test: the relay test.
    :raises IdentificationError: if a cycle has too few samples, or the response at its own
        frequency drowns in noise.
    """
    record = test.record
    interval = record.interval
    fundamental = 2.0 * math.pi / test.cycle.period
    if fundamental * interval > _COARSEST:
        raise IdentificationError(
            f"a cycle of {test.cycle.period:g} s holds {test.cycle.period / interval:.3g} "
            f"samples; Fourier integrals need at least {2.0 * math.pi / _COARSEST:.0f}: sample "
            "faster, or use the method waveform"
        )
    first, last = test.bounds[0], test.bounds[-1]
    # White noise in n samples h apart has integrals whose parts have the variance std^2 h^2 n/2.
    part = record.noise * interval * math.sqrt(0.5 * (last - first))
    found = []
    for harmonic in range(1, int(_COARSEST / (fundamental * interval)) + 1)[:_MOST]:
        # The command of a symmetric relay holds nothing at the even ones.
        with suppress(IdentificationError):
            found.append(frequency_point(record, test.ends, harmonic))
    if not found:
        raise IdentificationError(
            "the command holds nothing at the frequency of its cycles: they are not bounded by "
            "the switches of a relay"
        )
    return _certain(test, found, [part] * len(found))


def with_noise_about(model: TransferFunction, test: RelayTest, points: Points) -> Points:
    """Return points with standard deviations from the residual of a model.

    Between the harmonics the residual's Fourier integrals show noise alone: neither the limit
    cycle nor the error of the model has a part there. So they give the size of the noise at the
    harmonics, whatever its colour.

    :param model: near the points, without unstable poles.
    :param test: that they were measured in.
    :param points: from :func:`measured_points`.
    :return: those that are certain enough.
    :raises IdentificationError: if the point at the frequency of the limit cycle is not.
    """
    record = test.record
    start, end, cycles = float(test.ends[0]), float(test.ends[-1]), test.ends.size - 1
    if cycles < 2:
        return points
    inside = slice(test.bounds[0], test.bounds[-1] + 1)
    time = record.time[inside]
    left = record.measurement[inside] - response(model, time, record.input())
    left = left - np.polyval(np.polyfit(time - time[0], left, 1), time - time[0])
    step = 2.0 * math.pi / (end - start)
    begin, until = max(start, float(time[0])), min(end, float(time[-1]))
    parts = []
    for point in points:
        number = round(point.frequency / step)
        powers = [
            abs(fourier_integral_sampled(time, left, begin, until, each * step)) ** 2
            for each in range(number - _NEIGHBOURS, number + _NEIGHBOURS + 1)
            if each % cycles and each > 0
        ]
        parts.append(math.sqrt(0.5 * float(np.mean(powers))))
    return _certain(test, points, parts)


def _certain(test: RelayTest, points: Sequence[FrequencyPoint], parts: Sequence[float]) -> Points:
    """Return points with their standard deviations, without those that are too uncertain.

    :param test: that they were measured in.
    :param points: the lowest first.
    :param parts: standard deviations of the parts of the measurement's integrals [y s].
    :raises IdentificationError: if the lowest one is too uncertain.
    """
    u, (start, *_, end) = test.record.input(), test.ends.tolist()
    found = []
    for point, part in zip(points, parts, strict=True):
        w, size = point.frequency, abs(point.value)
        noise = part / abs(fourier_integral_held(u, start, end, w))
        chord = _POLYGON * (w * test.record.interval) ** 2 * size
        std = math.hypot(noise, chord)
        if not std > _TOO_UNCERTAIN * size:
            found.append(replace(point, std=std))
        elif point is points[0]:
            raise IdentificationError(
                f"the response at {w:.4g} rad/s, the frequency of the limit cycle, is uncertain "
                f"by more than {100.0 * _TOO_UNCERTAIN:.0f} %: raise the amplitude of the relay, "
                "or let it run for more cycles"
            )
    return tuple(found)
