# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How the peaks of a relay test grow to their limit cycle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import fdtrc

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.record.cycles import cycles_of, settings_of
from relay_autotune.record.record import Record, asked_once

_LEAST_PEAKS = 6
_QUICKEST = 0.1
_TRIALS = 60
_CHANCE = 1e-3
_NEGLIGIBLE = 1e-3
_CONSTANT_RATE = 1.0 - math.exp(-1.0)


@dataclass(frozen=True)
class Envelope:
    """The peaks of a relay test in the order of time.

    :param time: of each peak, since the command first moved [s], shape (n,).
    :param height: deviation from the set-point, downward peaks counted positive [y], shape (n,).
    """

    time: FloatArray
    height: FloatArray


@asked_once
def envelope(record: Record) -> Envelope:
    """Return the peaks of all whole cycles of a record.

    :param record: a relay test.
    :raises IdentificationError: if it holds no whole cycle.
    """
    settings = settings_of(record)
    cycles = cycles_of(record)
    if settings is None or not cycles:
        raise IdentificationError(
            "the record holds no whole cycle of a relay test, so that there are no peaks"
        )
    moved = np.flatnonzero(record.command != settings.baseline)
    begin = float(record.time[moved[0]]) if moved.size else float(record.time[0])
    times, heights = [], []
    for cycle in cycles:
        low_at = cycle.start + cycle.period_high
        # With a positive gain the high level turns the measurement up, so that it ends a minimum.
        high_turns, low_turns = (
            (cycle.time_to_peak_max, cycle.time_to_peak_min)
            if settings.reverse_acting
            else (cycle.time_to_peak_min, cycle.time_to_peak_max)
        )
        down, up = settings.setpoint - cycle.peak_min, cycle.peak_max - settings.setpoint
        times += [cycle.start + high_turns - begin, low_at + low_turns - begin]
        heights += [up, down] if settings.reverse_acting else [down, up]
    return Envelope(np.array(times), np.array(heights))


def growth_time(peaks: Envelope, noise_std: float = 0.0) -> float:
    """Return the time constant tau_G with which the peaks grow, or shrink, to their limit [s].

    ``height = limit + c exp(-t/tau_G) + d (-1)^k`` is fitted by least squares, with d from an
    offset of the set-point. In the end the differences of successive peaks shrink by
    ``exp(-P/(2 tau_G))``, the multiplier of the limit cycle; but while they are small the half
    cycles are shorter than P/2, so that their number is no measure of time.

    :param peaks: of a relay test.
    :param noise_std: standard deviation of the noise of a sample [y].
    :return: 0 where the peaks do not differ beyond their scatter, so that they are steady at
        once; NaN for fewer than 6 peaks, or if they do not follow one another.
    """
    n = peaks.height.size
    if n < _LEAST_PEAKS:
        return math.nan
    time, height = peaks.time - peaks.time[0], peaks.height
    fixed = np.stack((np.ones(n), (-1.0) ** np.arange(n)), axis=1)

    def cost(columns: FloatArray) -> float:
        rest = height - columns @ np.linalg.lstsq(columns, height, rcond=1e-12)[0]
        return float(rest @ rest)

    def fit(log_time: float) -> float:
        return cost(np.column_stack((fixed, np.exp(-time / math.exp(log_time)))))

    half = float(np.median(np.diff(time)))
    if not half > 0.0:
        return math.nan
    ends = math.log(_QUICKEST * half), math.log(max(float(time[-1]), half))
    trials = np.linspace(*ends, _TRIALS)
    i = int(np.argmin([fit(x) for x in trials]))
    bounds = (float(trials[max(i - 1, 0)]), float(trials[min(i + 1, _TRIALS - 1)]))
    found = minimize_scalar(fit, bounds=bounds, method="bounded", options={"xatol": 1e-9})
    steady, growing = cost(fixed), fit(float(found.x))
    level = float(np.mean(np.abs(height)))
    least = (n - 4) * max(0.5 * noise_std, _NEGLIGIBLE * level) ** 2
    # The drop of the cost over the cost left, for 2 more parameters, is distributed as F.
    statistic = 0.5 * (steady - growing) * (n - 4) / max(growing, least, 1e-300)
    if fdtrc(2, n - 4, max(statistic, 0.0)) > _CHANCE:
        return 0.0
    return math.exp(float(found.x))


def normalised_growth(multiplier: float) -> float:
    """Return tau_G/P of a limit cycle, ``-0.5/ln(rho)``.

    :param multiplier: rho, the ratio of successive differences of the peaks in each half cycle.
    """
    return -0.5 / math.log(multiplier) if 0.0 < multiplier < 1.0 else 0.0


def curvature_time(peaks: Envelope, limit: float) -> float:
    """Return when the envelope reaches 63.2 % of its limit [s].

    This reading of Thyagarajan and Yu's tau_C, which they do not define, is the one that comes
    closest to their eq 28, for a test whose relay first switched as soon as the measurement
    moved. The peaks are joined by straight lines, from zero on.

    :param peaks: of a test from its start.
    :param limit: height of the steady peaks [y].
    :return: NaN if no peak reaches that.
    """
    target = _CONSTANT_RATE * limit
    above = np.flatnonzero(peaks.height >= target)
    if above.size == 0:
        return math.nan
    time = np.concatenate(([0.0], peaks.time))
    height = np.concatenate(([0.0], peaks.height))
    j = int(above[0])
    share = (target - height[j]) / (height[j + 1] - height[j])
    return float(time[j] + share * (time[j + 1] - time[j]))
