# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Points of the frequency response by Fourier integrals over whole cycles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.quantities import told
from relay_autotune.record.record import PiecewiseConstant, Record

_SMALL_ANGLE = 0.2


@dataclass(frozen=True)
class FrequencyPoint:
    """The process at one frequency."""

    frequency: float = told("rad/s", "w.", nan=True)
    value: complex = told("y/u", "G(j w).", nan=True)
    std: float = told(
        "y/u",
        "Standard deviation of its real and of its imaginary part; NaN: not estimated.",
        math.nan,
        lower=0.0,
    )


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
    h = np.diff(t)
    angle = w * h
    level, ramp = _polygon(angle)
    parts = h * np.exp(-1j * w * t[:-1]) * (v[:-1] * level + np.diff(v) * ramp)
    return complex(np.sum(parts))


def _polygon(angle: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the integrals of ``exp(-j angle x)`` and ``x exp(-j angle x)`` over 0 < x < 1.

    About the middle they are ``sin(b)/b`` and ``-j (sin(b) - b cos(b))/(2 b^2)`` with half the
    angle b, whose difference is a series where b is small.
    """
    b = 0.5 * angle
    square = b * b
    odd = b * (1.0 / 6.0 - square * (1.0 / 60.0 - square * (1.0 / 1680.0 - square / 90720.0)))
    even = np.sinc(b / math.pi)
    large = np.abs(angle) >= _SMALL_ANGLE
    if np.any(large):
        c = b[large]
        odd[large] = 0.5 * (np.sin(c) - c * np.cos(c)) / (c * c)
    middle = np.exp(-1j * b)
    level = middle * even
    return level, 0.5 * level - 1j * odd * middle


def cycle_window(record: Record, first: int = 0) -> tuple[float, float, int]:
    """Return start, end and number of the whole cycles of a record.

    The ends are the instants at which the command switched, not the samples beside them.

    :param record: with at least one whole cycle after ``first``.
    :param first: cycles left out at the beginning.
    :raises IdentificationError: if no whole cycle is left.
    """
    bounds = record.cycle_start[first:]
    if len(bounds) < 2:
        raise IdentificationError(
            f"the record holds {max(len(record.cycle_start) - 1, 0)} whole cycles, of which "
            f"{first} are left out; at least one is needed: let the relay switch longer"
        )
    u = record.input()

    def switch_at(sample: int) -> float:
        at = int(np.argmin(np.abs(u.times - record.time[sample])))
        return min(float(u.times[at]), float(record.time[-1]))

    return switch_at(bounds[0]), switch_at(bounds[-1]), len(bounds) - 1


def frequency_point(record: Record, harmonic: int = 1, first: int = 0) -> FrequencyPoint:
    """Return one point of the frequency response from a limit cycle (Wang et al. 1997, eq 23).

    ``G(j k w0) = int y exp(-j k w0 t) dt / int u exp(-j k w0 t) dt`` over whole cycles; exact in
    the limit cycle, whatever the process.

    :param record: with whole cycles.
    :param harmonic: k; odd, or the command of an unbiased relay holds nothing there.
    :param first: cycles left out at the beginning, while the limit cycle settles.
    :raises IdentificationError: if no whole cycle is left or the command lacks the harmonic.
    """
    start, end, w = _window_of_harmonic(record, harmonic, first)
    u = record.input()
    excited = fourier_integral_held(u, start, end, w)
    levels = np.append(u.values, u.initial)
    if abs(excited) < 1e-3 * (end - start) * float(np.ptp(levels)) / (2.0 * math.pi * harmonic):
        raise IdentificationError(
            f"the command holds nothing at harmonic {harmonic} of its cycle; use an odd one"
        )
    answer = fourier_integral_sampled(record.time, record.measurement, start, end, w)
    return FrequencyPoint(w, answer / excited)


def excitation(record: Record, harmonic: int = 1, first: int = 0) -> complex:
    """Return the Fourier integral of the command that a point is divided by [u s].

    :param record: as for :func:`frequency_point`, as are the next two.
    """
    start, end, w = _window_of_harmonic(record, harmonic, first)
    return fourier_integral_held(record.input(), start, end, w)


def _window_of_harmonic(record: Record, harmonic: int, first: int) -> tuple[float, float, float]:
    start, end, cycles = cycle_window(record, first)
    return start, end, harmonic * 2.0 * math.pi * cycles / (end - start)


def cycle_means(record: Record, first: int = 0) -> tuple[float, float]:
    """Return the means of measurement [y] and command [u] over whole cycles.

    :param record: with whole cycles.
    :param first: cycles left out at the beginning.
    :raises IdentificationError: if no whole cycle is left.
    """
    start, end, _ = cycle_window(record, first)
    y = fourier_integral_sampled(record.time, record.measurement, start, end, 0.0).real
    u = fourier_integral_held(record.input(), start, end, 0.0).real
    return y / (end - start), u / (end - start)
