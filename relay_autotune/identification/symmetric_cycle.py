"""The limit cycle of an unbiased relay in numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.cycle_scatter import Stretch
from relay_autotune.identification.known import Known
from relay_autotune.record import RelaySettings

FloatArray = NDArray[np.float64]

_MOST_BIAS = 0.01
_MOST_SKEW = 0.05


@dataclass(frozen=True)
class SymmetricCycle:
    """What the methods for an unbiased relay take from a limit cycle.

    :param period: P [s].
    :param amplitude: a, half of peak to peak [y].
    :param relay: h, amplitude of the relay [u].
    :param hysteresis: epsilon [y].
    :param dead_time: D, of the process and what the relay added to it [s].
    """

    period: float
    amplitude: float
    relay: float
    hysteresis: float
    dead_time: float

    @property
    def frequency(self) -> float:
        """Frequency of the limit cycle, eq 1 of Chang et al. [rad/s]."""
        return 2.0 * math.pi / self.period

    @property
    def part(self) -> float:
        """Part of a half period that is left when the command has arrived, m of Chang et al."""
        return 1.0 - 2.0 * self.dead_time / self.period


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


def symmetric_cycle(stretch: Stretch, dead_time: float) -> SymmetricCycle:
    """Return the numbers of a stretch of cycles.

    :param stretch: the cycles.
    :param dead_time: of the process [s].
    """
    cycle, settings = stretch.cycle, stretch.settings
    return SymmetricCycle(
        cycle.period,
        0.5 * (cycle.peak_max - cycle.peak_min),
        settings.amplitude,
        settings.hysteresis,
        dead_time + settings.extra_delay,
    )


def skew_warning(stretch: Stretch) -> str:
    """Return a sentence if the half periods differ too much for a symmetric relay, else none."""
    cycle = stretch.cycle
    skew = abs(cycle.period_high - cycle.period_low) / cycle.period
    if skew < _MOST_SKEW:
        return ""
    return (
        f"the half periods differ by {100.0 * skew:.0f} % of the period: the set-point is not "
        "where the process rests, or the load changed; the equations are those of equal halves"
    )


def half_cycles(stretch: Stretch) -> tuple[FloatArray, FloatArray]:
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
