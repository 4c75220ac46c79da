# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The averaged limit cycle of a relay test, its scatter from cycle to cycle, and its symmetry."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
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
        # Imported here, as relay_node needs this module's types alone, and starts sooner so.
        from scipy.special import stdtrit

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


_MOST_BIAS = 0.01
_MOST_SKEW = 0.05

# Noise below this share of the amplitude is neglected.
_QUIET = 2e-3
_BINS = 100
_SAMPLES_PER_BIN = 8
_WINDOW = 0.05
_LEAST_NEAR = 4


@dataclass(frozen=True)
class SymmetricCycle:
    """The numbers of a limit cycle that the methods for an unbiased relay need.

    :param period: P [s].
    :param amplitude: a, half of peak to peak [y].
    :param relay: h, amplitude of the relay [u].
    :param hysteresis: epsilon [y].
    :param dead_time: D, of the process and what the relay added to it [s].
    :param switch_level: measurement at the switch, which sampling and noise move away from the
        hysteresis [y]; NaN: the hysteresis.
    """

    period: float
    amplitude: float
    relay: float
    hysteresis: float
    dead_time: float
    switch_level: float = math.nan

    @property
    def frequency(self) -> float:
        """Frequency of the limit cycle, eq 1 of Chang et al. [rad/s]."""
        return 2.0 * math.pi / self.period

    @property
    def level(self) -> float:
        """Measurement at the switch [y]."""
        return self.hysteresis if math.isnan(self.switch_level) else self.switch_level

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


def require_unbiased(method: str, settings: RelaySettings) -> None:
    """Refuse a biased relay.

    :raises IdentificationError: if the bias is more than 1 % of the relay's amplitude.
    """
    if abs(settings.bias) > _MOST_BIAS * settings.amplitude:
        raise IdentificationError(
            f"the relay had a bias of {settings.bias:g}, but the equations of {method} hold for "
            "a symmetric one: use the method wang_biased or waveform"
        )


def known_gain(known: Known, sign: int) -> float:
    """Return the size of the known gain, NaN if it is not known.

    :param known: the gain.
    :param sign: +1, or -1 for a reverse-acting relay.
    :raises IdentificationError: if the gain has the wrong sign for the relay.
    """
    if sign * known.gain < 0.0:
        raise IdentificationError(
            f"a gain of {known.gain:g} is against the direction of the relay: the known gain has "
            "the wrong sign"
        )
    return abs(known.gain)


@dataclass(frozen=True)
class CycleReader:
    """Reads the numbers of a limit cycle from stretches of one relay test.

    :param excess: what noise adds to the height of a peak, on average [y].
    :param noisy: True if noise matters for the measurement at a switch.
    """

    excess: float
    noisy: bool

    @classmethod
    def of(cls, whole: CycleRun) -> CycleReader:
        """Return the reader for the cycles of a relay test.

        :param whole: all of them.
        """
        record = whole.record
        noise = record.noise
        _, amplitude = features(whole)
        if noise <= _QUIET * amplitude:
            return cls(0.0, False)
        return cls(min(_excess_of_peaks(whole, noise), 0.5 * float(amplitude)), True)

    def level(self, stretch: CycleRun) -> float:
        """Return the measurement at a switch, from the middle of the peaks [y].

        Noise may put it below zero, where no relay switches.

        :param stretch: the cycles.
        """
        return _level_at_switch(stretch, self.noisy)

    def read(self, stretch: CycleRun, dead_time: float) -> SymmetricCycle:
        """Return the numbers of some cycles.

        :param stretch: the cycles.
        :param dead_time: of the process [s].
        :raises IdentificationError: if their amplitude does not exceed that of noise alone.
        """
        settings = stretch.settings
        period, amplitude = features(stretch).tolist()
        if not amplitude > self.excess:
            raise IdentificationError(
                f"an amplitude of {amplitude:g} is no more than noise alone gives: raise the "
                "amplitude of the relay"
            )
        delay = dead_time + settings.extra_delay
        level = self.level(stretch)
        return SymmetricCycle(
            period,
            amplitude - self.excess,
            settings.amplitude,
            settings.hysteresis,
            delay,
            min(max(level, 0.0), 0.99 * (amplitude - self.excess)),
        )


def skew_warning(stretch: CycleRun) -> str:
    """Return a sentence if the half periods differ too much for a symmetric relay, else ""."""
    cycle = stretch.cycle
    skew = abs(cycle.period_high - cycle.period_low) / cycle.period
    if skew < _MOST_SKEW:
        return ""
    return (
        f"the half periods differ by {100.0 * skew:.0f} % of the period: the set-point is not "
        "where the process rests, or the load changed; the equations are those of equal halves"
    )


def features(stretch: CycleRun) -> FloatArray:
    """Return period [s] and amplitude [y] of a stretch of cycles."""
    cycle = stretch.cycle
    return np.array((cycle.period, 0.5 * (cycle.peak_max - cycle.peak_min)))


def half_cycles(stretch: CycleRun) -> tuple[FloatArray, FloatArray]:
    """Lay the samples of all half cycles over one another.

    :param stretch: the cycles.
    :return: time since the switch that turns the measurement down [s], and the measurement from
        the middle of its peaks, turned over in the other halves [y]; shape (n,) each.
    """
    record, settings = stretch.record, stretch.settings
    first, last = record.cycle_start[0], record.cycle_start[-1]
    time = record.time[first:last]
    u = record.input()
    middle = 0.5 * (stretch.cycle.peak_max + stretch.cycle.peak_min)
    index = np.searchsorted(u.times, time, side="right") - 1
    since = time - u.times[np.maximum(index, 0)]
    high = u.values[np.maximum(index, 0)] > settings.baseline + settings.bias
    side = np.where(high != settings.reverse_acting, -1.0, 1.0)
    inside = (index >= 0) & (since < 0.5 * stretch.cycle.period)
    return since[inside], (side * (record.measurement[first:last] - middle))[inside]


def _excess_of_peaks(whole: CycleRun, noise: float) -> float:
    """Return by how much the highest sample of a half cycle exceeds its peak on average [y].

    With heights s_i and standard deviation sigma of the noise, the highest sample is below z with
    the probability prod Phi((z - s_i)/sigma).
    """
    from scipy.special import log_ndtr  # as above

    since, y = half_cycles(whole)
    halves = 2 * len(whole.cycle.cycles)
    bins = max(min(_BINS, since.size // _SAMPLES_PER_BIN), 2)
    number = np.minimum((since / (0.5 * whole.cycle.period) * bins).astype(np.int64), bins - 1)
    count = np.bincount(number, minlength=bins)
    used = count > 0
    height = np.bincount(number, y, bins)[used] / count[used]
    top = float(np.max(height))
    z = np.linspace(top - noise, top + 6.0 * noise, 300)
    below = np.sum(count[used] / halves * log_ndtr((z[:, None] - height) / noise), axis=1)
    above = 1.0 - np.exp(below)
    step = z[1] - z[0]
    mean = z[0] + float(np.sum(0.5 * (above[:-1] + above[1:])) * step)
    return max(mean - top, 0.0)


def _level_at_switch(stretch: CycleRun, noisy: bool) -> float:
    """Return the measurement at a switch, from the middle of the peaks [y].

    In noise it is read from a straight line through the samples around each switch. The sample
    that made the relay switch is left out: its noise is biased to the side of the switch.
    """
    record, settings, cycle = stretch.record, stretch.settings, stretch.cycle
    first, last = record.cycle_start[0], record.cycle_start[-1]
    time, y = record.time, record.measurement
    # The rate may jump where the command arrives.
    peak = 0.5 * (cycle.time_to_peak_max + cycle.time_to_peak_min)
    window = min(_WINDOW * cycle.period, 0.8 * peak)
    middle = 0.5 * (cycle.peak_max + cycle.peak_min)
    u = record.input()
    # Where noise makes the relay switch back and forth, the switch before a long stay counts.
    stay = np.diff(np.append(u.times, time[-1]))
    chosen = (u.times >= time[first]) & (u.times < time[last]) & (stay > 0.2 * cycle.period)
    found = []
    for at, value in zip(u.times[chosen].tolist(), u.values[chosen].tolist(), strict=True):
        went_high = value > settings.baseline + settings.bias
        side = -1.0 if went_high != settings.reverse_acting else 1.0
        near = np.arange(*np.searchsorted(time, (at - window, at + window)))
        near = near[time[near] != at]
        if noisy and near.size >= _LEAST_NEAR:
            here = np.polyfit(time[near] - at, y[near], 1)[1]
        else:
            here = np.interp(at, time, y)
        found.append(side * (float(here) - middle))
    return float(np.mean(found)) if found else settings.hysteresis
