# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A record read as a relay test: its steady cycles, its direction, its symmetry."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.fold import (
    NO_BIAS,
    SYMMETRIC,
    Fold,
    Reading,
    switched_at,
)
from relay_autotune.record.cycles import (
    LimitCycle,
    cycle_bounds,
    cycles_of,
    limit_cycle,
    settings_of,
)
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings

# Least distance from both levels, in amplitudes, that counts as between them, and the largest
# share of the time that the command of a relay is there.
_OFF_LEVEL = 0.05
_MOST_BETWEEN = 0.01
_LEAST_SAMPLES = 4
# Largest level at a switch, over the amplitude.
MOST_LEVEL = 0.99

# Relative errors of a period and an amplitude read off a chart.
CHART_ERRORS = (0.002, 0.01)

NOT_SETTLED = "the limit cycle had not settled: its last cycles still differ"


@dataclass(frozen=True)
class RelayTest:
    """A relay test for the methods that need a limit cycle only.

    :param record: the record.
    :param settings: the relay, inferred where the record does not have it.
    :param cycle: averages over the cycles that agree.
    :param bounds: samples at which these begin, and at which the last one ends.
    """

    record: Record
    settings: RelaySettings
    cycle: LimitCycle
    bounds: tuple[int, ...]

    @cached_property
    def ends(self) -> FloatArray:
        """When the cycles that agree begin, and when the last one ends [s], shape (n + 1,)."""
        return switched_at(self.record, self.bounds)

    @property
    def sign(self) -> int:
        """Sign of the process's gain by the direction of the relay."""
        return -1 if self.settings.reverse_acting else 1

    def known_gain(self, known: Known) -> float:
        """Return the size of the known gain, NaN if it is not known.

        :param known: the gain.
        :raises IdentificationError: if the gain has the wrong sign for the relay.
        """
        if self.sign * known.gain < 0.0:
            raise IdentificationError(
                f"a gain of {known.gain:g} is against the direction of the relay: the known gain "
                "has the wrong sign"
            )
        return abs(known.gain)

    def read(self, more: Callable[[Fold, float], float]) -> Reading:
        """Return period, amplitude, level at the switch, and one number more.

        :param more: from the averaged period and its amplitude to the number.
        """

        def measure(seen: Fold) -> FloatArray:
            low, high = seen.peaks()
            amplitude = 0.5 * (high - low)
            return np.array((seen.period, amplitude, seen.switching[1], more(seen, amplitude)))

        found = Reading.of(self.record, measure)
        # In noise the level may be below zero, where no relay switches; its scatter is to both
        # sides.
        found.values[2] = min(max(found.values[2], 0.0), MOST_LEVEL * found.values[1])
        return found

    def remarks(self, *, symmetric: bool = True) -> list[str]:
        """Return sentences on what the equations of a limit cycle take for granted.

        :param symmetric: whether they are those of equal halves.
        """
        found = [] if self.cycle.converged else [NOT_SETTLED]
        skew = abs(self.cycle.period_high - self.cycle.period_low) / self.cycle.period
        if symmetric and skew >= SYMMETRIC:
            found.append(
                f"the half periods differ by {100.0 * skew:.0f} % of the period: the set-point is "
                "not where the process rests, or the load changed; the equations are those of "
                "equal halves"
            )
        return found


def relay_test(
    method: str, record: Record, *, two_levels: bool = True, unbiased: bool = False
) -> RelayTest:
    """Read a record as a relay test.

    :param method: on whose behalf, for the message.
    :param record: the record.
    :param two_levels: False: the command may take the time it needs from level to level.
    :param unbiased: True: the equations are those of a symmetric relay.
    :raises IdentificationError: if it holds no whole cycle, too few samples in one, no motion,
        a command of more than two levels, or a bias of more than 1 % of the amplitude.
    """
    settings = settings_of(record)
    bounds = cycle_bounds(record)
    cycles = cycles_of(record)
    if settings is None or not cycles:
        raise IdentificationError(
            f"{method} needs at least one whole cycle of a relay test and the record holds none: "
            "use the method waveform, which takes any input"
        )
    average = limit_cycle(cycles)
    bounds = bounds[average.cycles[0] : average.cycles[-1] + 2]
    samples = (bounds[-1] - bounds[0]) / len(average.cycles)
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
    if two_levels:
        span = record.time[[bounds[0], bounds[-1]]]
        _require_two_levels(method, settings, record.input(), span)
    if unbiased and abs(settings.bias) > NO_BIAS * settings.amplitude:
        raise IdentificationError(
            f"the relay had a bias of {settings.bias:g}, but the equations of {method} hold for a "
            "symmetric one: use the method wang_biased or waveform"
        )
    return RelayTest(record, settings, average, bounds)


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


@dataclass(frozen=True)
class SymmetricCycle:
    """The numbers of a limit cycle that the methods for an unbiased relay need.

    :param period: P [s].
    :param amplitude: a, half of peak to peak [y].
    :param relay: h, amplitude of the relay [u].
    :param level: measurement at the switch, the hysteresis epsilon of an ideal relay [y].
    :param dead_time: D, of the process and what the relay added to it [s].
    :param errors: relative errors of period and amplitude.
    """

    period: float
    amplitude: float
    relay: float
    level: float
    dead_time: float
    errors: tuple[float, float] = CHART_ERRORS

    @property
    def frequency(self) -> float:
        """Frequency of the limit cycle, eq 1 of Chang et al. [rad/s]."""
        return 2.0 * math.pi / self.period

    @property
    def part(self) -> float:
        """Share of a half period that is left after the dead time, m of Chang et al."""
        return 1.0 - 2.0 * self.dead_time / self.period

    def require_switching(self) -> None:
        """Refuse a limit cycle within the switching level.

        :raises IdentificationError: if the level is not below the amplitude.
        """
        if not abs(self.level) < self.amplitude:
            raise IdentificationError(
                f"an amplitude of {self.amplitude:g} is not above the hysteresis of "
                f"{self.level:g}, so that the relay cannot have switched: check the numbers"
            )
