# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A relay test as its averaged limit cycle, and the uncertainty from cycle to cycle."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.record.cycles import (
    LimitCycle,
    cycles_of,
    find_cycles,
    limit_cycle,
    settings_of,
)
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

_LEAST_CYCLES = 3
# Least distance from both levels, in amplitudes, that counts as between them, and the largest
# share of the time that the command of a relay is there.
_OFF_LEVEL = 0.05
_MOST_BETWEEN = 0.01
_LEAST_SAMPLES = 4
# Number of cycles that gives their scatter within 10 %.
_MOST_SINGLES = 60

NOT_SETTLED = "the limit cycle had not settled: its last cycles still differ"


@dataclass(frozen=True)
class CycleRun:
    """Cycles of a relay test with their features.

    :param record: its ``cycle_start`` bounds these cycles alone.
    :param settings: the relay, inferred where the record does not tell it.
    :param cycle: averages over the cycles.
    """

    record: Record
    settings: RelaySettings
    cycle: LimitCycle


@dataclass(frozen=True)
class RelayTest:
    """A relay test for the methods that need a limit cycle only.

    :param whole: the cycles that agree, averaged.
    :param singles: each of them by itself; of many, an evenly spread selection.
    """

    whole: CycleRun
    singles: tuple[CycleRun, ...]

    def scatter(
        self, measure: Callable[[CycleRun], FloatArray]
    ) -> tuple[FloatArray | None, float]:
        """Return the covariance of a mean over cycles, from how the single cycles differ.

        :param measure: from a stretch to values, shape (p,); a cycle for which it raises an
            ``IdentificationError`` is left out.
        :return: covariance, shape (p, p), None if fewer than three cycles are left; and half the
            width of a 95 % interval in standard deviations.
        """
        found = []
        for single in self.singles:
            try:
                found.append(measure(single))
            except IdentificationError:
                # One cycle may be too noisy for a method; the others still tell the scatter.
                continue
        count = len(found)
        quantile = float(stdtrit(max(count - 1, 1), 0.975))
        if count < _LEAST_CYCLES:
            return None, quantile
        # Relative to the first one, so that equal values have no scatter by rounding.
        away = np.array(found) - found[0]
        away = away - np.mean(away, axis=0)
        # The mean is over all cycles, of which these may be a selection.
        averaged = count * len(self.whole.cycle.cycles) / len(self.singles)
        return away.T @ away / ((count - 1) * averaged), quantile


def relay_test(method: str, record: Record, *, two_levels: bool = True) -> RelayTest:
    """Read a record as a relay test.

    :param method: on whose behalf, for the message.
    :param record: the record.
    :param two_levels: False: the command may take the time it needs from level to level.
    :raises IdentificationError: if it holds no whole cycle, too few samples in one, no motion,
        or a command of more than two levels.
    """
    settings = settings_of(record)
    bounds = record.cycle_start or find_cycles(record)
    cycles = cycles_of(record)
    if settings is None or not cycles:
        raise IdentificationError(
            f"{method} needs at least one whole cycle of a relay test and the record holds none: "
            "use the method waveform, which takes any input"
        )
    average = limit_cycle(cycles)
    samples = (bounds[average.cycles[-1] + 1] - bounds[average.cycles[0]]) / len(average.cycles)
    if samples < _LEAST_SAMPLES or not average.period > 0.0:
        raise IdentificationError(
            f"a cycle of {average.period:g} s holds {samples:.3g} samples; {method} needs at "
            f"least {_LEAST_SAMPLES}: sample faster, or use a relay with more hysteresis"
        )
    if not average.peak_max > average.peak_min:
        raise IdentificationError(
            "the measurement is constant while the relay switches: check the sensor, the "
            "actuator and that both topics belong to one loop"
        )

    u = record.input()
    if two_levels:
        ends = bounds[average.cycles[0]], bounds[average.cycles[-1] + 1]
        _require_two_levels(method, settings, u, record.time[list(ends)])

    def stretch(first: int, last: int, cycle: LimitCycle) -> CycleRun:
        # A copy that shares the columns, which are many and read-only.
        part = copy.copy(record)
        for name, value in (
            ("settings", settings),
            ("cycle_start", bounds[first : last + 2]),
            ("held_input", u),
        ):
            object.__setattr__(part, name, value)
        return CycleRun(part, settings, cycle)

    stride = -(-len(average.cycles) // _MOST_SINGLES)
    return RelayTest(
        stretch(average.cycles[0], average.cycles[-1], average),
        tuple(stretch(i, i, limit_cycle(cycles[i : i + 1])) for i in average.cycles[::stride]),
    )


def _require_two_levels(
    method: str, settings: RelaySettings, u: PiecewiseConstant, span: FloatArray
) -> None:
    """Refuse a command that takes time between the levels, as under a rate limit."""
    inside = (u.times > span[0]) & (u.times < span[1])
    times = np.concatenate((span[:1], u.times[inside], span[1:]))
    held = np.diff(times)
    middle = settings.baseline + settings.bias
    away = np.abs(np.abs(u(times[:-1]) - middle) / settings.amplitude - 1.0)
    between = float(np.sum(held[away > _OFF_LEVEL]) / (span[1] - span[0]))
    if between > _MOST_BETWEEN:
        raise IdentificationError(
            f"the command is between its two levels for {100.0 * between:.2g} % of the time, as a "
            f"limit of its rate makes it; {method} is for a relay that switches at once: use the "
            "method waveform, which takes the command as it was"
        )
