# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The dead time that a relay test shows: by the sharp edge after a switch, or the first kick."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.errors import IdentificationError
from relay_autotune.experiment.settling import ResponseDetector, RestState
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.fold import Fold, Reading, fold
from relay_autotune.identification.limit_cycle.limit_cycle import RelayTest
from relay_autotune.record.record import Record, RelaySettings

# Least jump of the rate at a sharp edge, relative to its largest value: that of one lag jumps by
# more than 1 where the command arrives.
_JUMP = 0.6
_BESIDE = 0.01


@dataclass(frozen=True)
class DeadTime:
    """Where the dead time of the process comes from.

    :param value: s.
    :param std: standard deviation of what was read [s]; 0: it was given.
    :param source: a sentence for the user; empty: it was given.
    """

    value: float
    std: float = 0.0
    source: str = ""


def read_dead_time(test: RelayTest, known: Known) -> DeadTime:
    """Return the dead time that is known, or read it from the record.

    One lag turns at once when the command arrives, so that the measurement has an edge there in
    each half cycle. If the averaged half cycles have one, its time is taken, otherwise the time
    from the first kick to the first sample outside the noise.

    :param test: the relay test, with the samples before the kick.
    :param known: a known dead time.
    :raises IdentificationError: if it is not known and the record does not show it.
    """
    if not math.isnan(known.dead_time):
        return DeadTime(known.dead_time)
    settings, cycles = test.settings, test.cycle.cycles
    if _is_sharp(fold(test.whole, cycles)):
        edge = Reading.of(test.whole, cycles, lambda seen: np.array([seen.edge]))
        value = max(float(edge.values[0]) - settings.extra_delay, 0.0)
        source = (
            f"the dead time of {value:.4g} s was read as the time from the switch to the sharp "
            "peak; give it where it is known better, since these equations are sensitive to it"
        )
        # An edge lies between two samples, whatever the cycles agree on.
        between = test.record.interval / math.sqrt(12.0 * len(cycles))
        scatter = float(np.nan_to_num(edge.std[0]))
        return DeadTime(value, max(scatter, between), source)
    first, interval = _first_response(test.whole, settings)
    if math.isnan(first):
        raise IdentificationError(
            "the dead time is not known, and neither sharp peaks nor a first kick from rest show "
            "it in the record: give the dead time, or use the method waveform"
        )
    value = max(first - settings.extra_delay, 0.0)
    source = (
        f"the dead time of {value:.4g} s was read from the first response to the kick, which a "
        "slow beginning or noise delays; give it where it is known better"
    )
    return DeadTime(value, interval / math.sqrt(12.0), source)


def _is_sharp(curve: Fold) -> bool:
    if math.isnan(curve.edge):
        return False
    beside = _BESIDE * 0.5 * curve.period
    before, after = curve.slope(np.array((curve.edge - beside, curve.edge + beside)))
    # Away from the edges, where a spline in noise has its largest rates.
    steepest = np.abs(curve.slope(np.linspace(0.0, curve.period, 101)))
    return bool(abs(after - before) > _JUMP * float(np.percentile(steepest, 90.0)))


def _first_response(record: Record, settings: RelaySettings) -> tuple[float, float]:
    """Return the time from the first kick to the response, and the interval in which it began.

    NaN: there was no kick from rest.
    """
    u = record.input()
    resting = abs(u.initial - settings.baseline) < 0.5 * settings.amplitude
    if u.times.size == 0 or not resting or u.times[0] < record.time[0]:
        return math.nan, math.nan
    kick = float(u.times[0])
    before = record.measurement[record.time <= kick]
    noise = record.noise_std
    if math.isnan(noise):
        noise = float(np.std(before)) if before.size >= 10 else 0.0
    # Without noise, rounding remains.
    floor = 1e-9 * float(np.ptp(record.measurement))
    rest = RestState(
        mean=float(np.mean(before)),
        slope=0.0,
        noise_std=max(noise, floor),
        span=float(kick - record.time[0]),
        samples=before.size,
        range_seen=float(np.ptp(before)),
    )
    detector = ResponseDetector(rest, kick)
    after = slice(int(np.searchsorted(record.time, kick, side="right")), None)
    for time, y in zip(record.time[after], record.measurement[after], strict=True):
        if detector.add(float(time), float(y)):
            seen = 0.5 * (detector.last_inside + detector.first_outside) - kick
            return seen, detector.first_outside - detector.last_inside
    return math.nan, math.nan
