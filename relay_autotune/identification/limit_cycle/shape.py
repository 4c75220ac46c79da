# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Shape of a limit cycle, and the structure that it suggests.

Thyagarajan and Yu, "Improved Autotuning Using the Shape Factor from Relay Feedback", Ind. Eng.
Chem. Res. 2003, tell four shapes apart by eye: sharp edges (category 1a, FOPDT), almost
rectangular (1b, a high order with much dead time, taken for FOPDT), sinusoidal and growing over
many cycles (2, second order with little dead time), sinusoidal at once (3, higher order). The
numbers that tell them apart here reproduce every category of the paper's examples.

How its peaks grow from the first one tells, too.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace

import numpy as np
from scipy.special import fdtrc

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.limit_cycle.fold import Fold, Reading, fold
from relay_autotune.process.simulation import HalfCycle
from relay_autotune.record.cycles import cycles_of, settings_of
from relay_autotune.record.record import Record, cached_on_record
from relay_autotune.scalar import minimum_near, root, roots

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


@cached_on_record
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
    peaks = []
    for cycle in cycles:
        ends = [
            (cycle.time_to_peak_min, settings.setpoint - cycle.peak_min),
            (cycle.time_to_peak_max, cycle.peak_max - settings.setpoint),
        ]
        # With a positive gain the high level turns the measurement up, so that it ends a minimum.
        after_high, after_low = ends[::-1] if settings.reverse_acting else ends
        for switch, (late, height) in ((0.0, after_high), (cycle.period_high, after_low)):
            peaks.append((cycle.start + switch + late - begin, height))
    return Envelope(*np.array(peaks).T)


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
    found, growing = minimum_near(fit, trials, i, 1e-9)
    steady = cost(fixed)
    level = float(np.mean(np.abs(height)))
    least = (n - 4) * max(0.5 * noise_std, _NEGLIGIBLE * level) ** 2
    # The drop of the cost over the cost left, for 2 more parameters, is distributed as F.
    statistic = 0.5 * (steady - growing) * (n - 4) / max(growing, least, 1e-300)
    if fdtrc(2, n - 4, max(statistic, 0.0)) > _CHANCE:
        return 0.0
    return math.exp(found)


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


SHARP = 0.25
SLOW = 1.0
FLAT = 0.42

_GRID = 2001
_PARTS = np.linspace(0.0, 1.0, _GRID)
_SHARP_FOPDT = 0.2
_NEARLY_ONE = 1.0 - 1e-14


@dataclass(frozen=True)
class Shape:
    """Shape factors of the half of a limit cycle in which the deviation is positive.

    The command of a direct-acting process switches to low at t = 0, where y rises through the
    switching level; for an ideal relay that is the zero crossing.

    :param half_period: T, to the next switch [s].
    :param amplitude: a, highest deviation from the set-point [y].
    :param level: deviation at the switch, the hysteresis of an ideal relay [y].
    :param time_to_peak: t_p, from the switch [s].
    :param rise: t_a, from the upward zero crossing to the peak [s].
    :param rise_half: t_{a/2}, from the upward zero crossing to half the peak [s].
    :param sharpness: q = (t(0.9 a) - t_p)/(t(0.5 a) - t_p) on the falling side.
    :param plateau: time with y > 0.9 a, over T.
    :param growth: tau_G/P, the time constant with which the peaks grow to their limit, over the
        period; of a model -0.5/ln(rho), rho the ratio of successive differences of the peaks in
        each half cycle; 0: steady at once; NaN: not known.
    """

    half_period: float
    amplitude: float
    level: float
    time_to_peak: float
    rise: float
    rise_half: float
    sharpness: float
    plateau: float
    growth: float = math.nan

    @property
    def period(self) -> float:
        """P = 2 T [s]."""
        return 2.0 * self.half_period

    @property
    def category(self) -> str:
        """One of "1a", "1b", "2", "3"; a growth of NaN counts as steady at once.

        1. q < 0.25: 1a. A FOPDT process has 0.178 to 0.200 whatever its D/tau, a smooth peak at
           least 0.370. Where t_p < P/4 only an unstable FOPDT fits, whose q grows with D/tau; the
           limit then grows in proportion.
        2. else tau_G/P > 1: 2.
        3. else plateau > 0.42: 1b.
        4. else 3.
        """
        if self.sharpness < SHARP * _widened(self):
            return "1a"
        if self.growth > SLOW:
            return "2"
        return "1b" if self.plateau > FLAT else "3"


def relative_amplitude(time_to_peak: float, half_period: float, level: float) -> float:
    """Return a/(K h) of the FOPDT process that peaks at a time, negative for an unstable one.

    With v = a/(K h), P/(2 tau) is 2 atanh v, so that D over half the period is a function of v
    alone that rises from 0 at -1, by (1 - epsilon/a)/2 at 0, to 1 at 1 (Thyagarajan and Yu 2003,
    eqs 10, 11, 16 and 17).

    :param time_to_peak: from the switch to the peak, which is D [s].
    :param half_period: P/2 [s].
    :param level: epsilon/a, between -1 and 1.
    :return: NaN: no such process peaks then.
    """
    share = time_to_peak / half_period

    def excess(v: float) -> float:
        if abs(v) < 1e-12:
            return 0.5 * (1.0 - level) - share
        return (math.log1p(-level * v) - math.log1p(-v)) / (2.0 * math.atanh(v)) - share

    if not (abs(level) < 1.0 and excess(-_NEARLY_ONE) <= 0.0 <= excess(_NEARLY_ONE)):
        return math.nan
    return root(excess, -_NEARLY_ONE, _NEARLY_ONE, 1e-16)


def _widened(shape: Shape) -> float:
    """How much larger q is for the unstable FOPDT through this peak than for a stable one."""
    level = shape.level / shape.amplitude
    v = -relative_amplitude(shape.time_to_peak, shape.half_period, level)
    if not v > 0.0:
        return 1.0
    # From the peak the deviation falls as 1/v - (1/v - 1) exp(t/tau), in units of a.
    to_tenth, to_half = (math.log((1.0 - x * v) / (1.0 - v)) for x in (0.9, 0.5))
    return max(to_tenth / to_half / _SHARP_FOPDT, 1.0)


def shape_of_curve(
    y: HalfCycle | _Half, half_period: float, *, edge: float = math.nan, tolerance: float = 0.0
) -> Shape:
    """Measure the shape of one half of a limit cycle.

    :param y: deviation from the set-point; the half begins with the switch at t = 0 and the
        curve goes on before and after it.
    :param half_period: T [s].
    :param edge: where the rate is known to jump [s]; NaN: nowhere.
    :param tolerance: how much lower than the highest point the edge may lie and still count as
        the peak [y]; on a flat top noise would place it anywhere.
    :raises IdentificationError: if the deviation never becomes positive in the half, or does not
        pass zero on both sides of its peak.
    """
    period = half_period
    grid = period * _PARTS
    values = y(grid)
    top = int(np.argmax(values))
    if not values[top] > 0.0:
        raise IdentificationError(
            "the measurement does not pass the set-point between two switches: this is no limit "
            "cycle of a relay, or its hysteresis is not the one given"
        )
    ends = float(grid[max(top - 1, 0)]), float(grid[min(top + 1, _GRID - 1)])
    # The rate changes its sign there, smoothly or at an edge.
    peak = root(lambda t: float(y.slope(np.array([t]))[0]), *ends, 1e-15 * (ends[1] - ends[0]))
    a = max(_at(y, peak), float(values[top]))
    if not math.isnan(edge) and _at(y, edge) >= a - tolerance:
        peak, a = edge, _at(y, edge)

    def falls(side: float, *shares: float) -> list[float]:
        """Return where the curve first falls to shares of the peak, on one side of it."""
        levels, reach = a * np.array(shares), side * period
        below = y(peak + reach * _PARTS)[:, None] <= levels
        first = np.argmax(below, axis=0)
        if not np.all(first):
            raise IdentificationError(
                f"the measurement does not fall to {levels[first == 0][0]:g} beside its peak "
                "within half a period: the oscillation does not pass its set-point both ways"
            )
        ends = _PARTS[first - 1], _PARTS[first]
        parts = roots(lambda part: y(peak + reach * part) - levels, *ends)
        return (peak + reach * parts).tolist()

    zero, half, tenth = falls(-1.0, 0.0, 0.5, 0.9)
    half_down, tenth_down = falls(1.0, 0.5, 0.9)
    return Shape(
        half_period=half_period,
        amplitude=a,
        level=_at(y, 0.0),
        time_to_peak=peak,
        rise=peak - zero,
        rise_half=half - zero,
        sharpness=(tenth_down - peak) / (half_down - peak),
        plateau=(tenth_down - tenth) / half_period,
    )


def _at(y: HalfCycle | _Half, time: float) -> float:
    return float(y(np.array([time]))[0])


def shape_of_half_cycle(cycle: HalfCycle) -> Shape:
    """Return the shape of a model's exact limit cycle, with the growth of its multiplier.

    :param cycle: the limit cycle.
    """
    shape = shape_of_curve(cycle, cycle.half_period)
    return replace(shape, growth=normalised_growth(cycle.multiplier()))


# The numbers of a shape that vary from cycle to cycle.
VARYING = ("half_period", "amplitude", "level", "time_to_peak", "rise", "rise_half")


@cached_on_record
def shape_of_record(record: Record, *, sharp: bool = False) -> Shape:
    """Return the shape of a relay test, the mean of its two halves.

    :param record: with at least one whole cycle.
    :param sharp: True if the peaks are known to be sharp, however much noise there is.
    :raises IdentificationError: if the record holds no whole cycle, or none about its set-point.
    """
    shape = shape_of_fold(fold(record, sharp=sharp))
    noise = 0.0 if math.isnan(record.noise_std) else record.noise_std
    return replace(shape, growth=growth_time(envelope(record), noise) / shape.period)


def read_shape(record: Record, *, sharp: bool = False) -> tuple[Shape, Reading]:
    """Return the shape of a relay test, and how certain its numbers are.

    :param record: with at least one whole cycle.
    :param sharp: as for :func:`shape_of_record`.
    :return: the shape, and those of its numbers that are called ``VARYING``.
    :raises IdentificationError: as :func:`shape_of_record`.
    """

    def numbers(part: Fold) -> FloatArray:
        found = shape_of_fold(part)
        return np.array([getattr(found, name) for name in VARYING])

    shape = shape_of_record(record, sharp=sharp)
    return shape, Reading.of(record, numbers, sharp=sharp)


@dataclass(frozen=True)
class _Half:
    """The half of a fold from one of its switches on, with its deviation counted positive."""

    whole: Fold
    begin: float
    sign: float

    def __call__(self, time: FloatArray) -> FloatArray:
        return self.sign * self.whole(time + self.begin)

    def slope(self, time: FloatArray) -> FloatArray:
        return self.sign * self.whole.slope(time + self.begin)


def shape_of_fold(period: Fold) -> Shape:
    """Return the shape of an averaged period, the mean of its two halves.

    :param period: the averaged period.
    :raises IdentificationError: if a half never passes the set-point.
    """
    # The switch to low begins the half above the set-point; if reverse-acting, the one below.
    sign = -1.0 if period.settings.reverse_acting else 1.0
    hints = {"edge": period.edge, "tolerance": period.tolerance}
    low = shape_of_curve(_Half(period, period.period_high, sign), period.period_low, **hints)
    high = shape_of_curve(_Half(period, 0.0, -sign), period.period_high, **hints)
    pairs = zip(astuple(low), astuple(high), strict=True)
    return Shape(*(0.5 * (a + b) for a, b in pairs))
