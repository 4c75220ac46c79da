# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The state about which a relay test moves, and the static gain from its means."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.shown.cycle_scatter import CycleRun, RelayTest
from relay_autotune.identification.shown.fourier import cycle_means
from relay_autotune.record.record import Record, RelaySettings, asked_once

_LEAST_BIAS = 0.02
_LEAST_SAMPLES = 8

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


@asked_once
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

    def ratio(part: CycleRun) -> FloatArray:
        mean_y, mean_u = cycle_means(part.record)
        away = mean_u - part.settings.baseline
        if abs(away) < _LEAST_BIAS * part.settings.amplitude:
            raise IdentificationError(
                f"the mean command is only {away:g} away from the baseline, so that its ratio to "
                "the measurement (eq 6) tells no gain: use a biased relay, or the method "
                "wang_unbiased; an integrating process always has a mean of zero"
            )
        return np.array(((mean_y - rest.value) / away, away))

    value, excursion = ratio(test.whole)
    covariance, _ = test.scatter(ratio)
    spread = math.nan if covariance is None else math.sqrt(covariance[0, 0])
    return StaticGain(float(value), spread, float(excursion))
