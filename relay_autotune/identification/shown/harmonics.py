# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The frequency response at the harmonics of a limit cycle, each point with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.shown.cycle_scatter import CycleRun
from relay_autotune.identification.shown.fourier import (
    FrequencyPoint,
    cycle_window,
    excitation,
    fourier_integral_sampled,
    frequency_point,
)
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction

Points = tuple[FrequencyPoint, ...]

_MOST = 9
# Largest w h of a harmonic with samples h apart, and the factor of the relative error
# (w h)^2/12 of straight lines between them.
_COARSEST = 0.5
_POLYGON = 1.0 / 12.0
_TOO_UNCERTAIN = 0.2
_NEIGHBOURS = 6


def measured_points(whole: CycleRun) -> Points:
    """Return the points at the harmonics that the command of a relay test excites.

    Their standard deviations are those of white noise, and of straight lines between the samples.
    Harmonics that are uncertain by more than a fifth, or have too few samples, are left out.

    :param whole: the cycles.
    :raises IdentificationError: if a cycle has too few samples, or the response at its own
        frequency drowns in noise.
    """
    record = whole.record
    interval = record.interval
    fundamental = 2.0 * math.pi / whole.cycle.period
    if fundamental * interval > _COARSEST:
        raise IdentificationError(
            f"a cycle of {whole.cycle.period:g} s holds {whole.cycle.period / interval:.3g} "
            f"samples; Fourier integrals need at least {2.0 * math.pi / _COARSEST:.0f}: sample "
            "faster, or use the method waveform"
        )
    first, last = record.cycle_start[0], record.cycle_start[-1]
    # White noise in n samples h apart has integrals whose parts have the variance std^2 h^2 n/2.
    part = record.noise * interval * math.sqrt(0.5 * (last - first))
    found = []
    for harmonic in range(1, int(_COARSEST / (fundamental * interval)) + 1)[:_MOST]:
        try:
            point = frequency_point(record, harmonic)
        except IdentificationError:
            # The command of a symmetric relay holds nothing at the even ones.
            continue
        point = replace(point, std=_deviation(point, interval, part / abs(_excited(whole, point))))
        if not point.std > _TOO_UNCERTAIN * abs(point.value):
            found.append(point)
        elif harmonic == 1:
            raise _drowned(point)
    if not found:
        raise IdentificationError(
            "the command holds nothing at the frequency of its cycles: they are not bounded by "
            "the switches of a relay"
        )
    return tuple(found)


def with_noise_about(model: TransferFunction, whole: CycleRun, points: Points) -> Points:
    """Return points with standard deviations from the residual of a model.

    Between the harmonics the residual's Fourier integrals show noise alone: neither the limit
    cycle nor the error of the model has a part there. So they give the size of the noise at the
    harmonics, whatever its colour.

    :param model: near the points, without unstable poles.
    :param whole: the cycles that they were measured in.
    :param points: from :func:`measured_points`.
    :return: those that are certain enough.
    :raises IdentificationError: if the point at the frequency of the limit cycle is not.
    """
    record = whole.record
    start, end, cycles = cycle_window(record)
    if cycles < 2:
        return points
    interval = record.interval
    inside = slice(record.cycle_start[0], record.cycle_start[-1] + 1)
    time = record.time[inside]
    left = record.measurement[inside] - response(model, time, record.input())
    left = left - np.polyval(np.polyfit(time - time[0], left, 1), time - time[0])
    step = 2.0 * math.pi / (end - start)
    begin, until = max(start, float(time[0])), min(end, float(time[-1]))
    found = []
    for point in points:
        number = round(point.frequency / step)
        powers = [
            abs(fourier_integral_sampled(time, left, begin, until, each * step)) ** 2
            for each in range(number - _NEIGHBOURS, number + _NEIGHBOURS + 1)
            if each % cycles and each > 0
        ]
        part = math.sqrt(0.5 * float(np.mean(powers)))
        deviation = _deviation(point, interval, part / abs(_excited(whole, point)))
        if not deviation > _TOO_UNCERTAIN * abs(point.value):
            found.append(replace(point, std=deviation))
    if not found or found[0].frequency > points[0].frequency:
        raise _drowned(points[0])
    return tuple(found)


def _drowned(point: FrequencyPoint) -> IdentificationError:
    return IdentificationError(
        f"the response at {point.frequency:.4g} rad/s, the frequency of the limit cycle, is "
        f"uncertain by more than {100.0 * _TOO_UNCERTAIN:.0f} %: raise the amplitude of the "
        "relay, or let it run for more cycles"
    )


def _excited(whole: CycleRun, point: FrequencyPoint) -> complex:
    start, end, cycles = cycle_window(whole.record)
    return excitation(whole.record, round(point.frequency * (end - start) / cycles / 2 / math.pi))


def _deviation(point: FrequencyPoint, interval: float, noise: float) -> float:
    chord = _POLYGON * (point.frequency * interval) ** 2 * abs(point.value)
    return math.hypot(noise, chord)
