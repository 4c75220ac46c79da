# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The relay: when it switches, how long it waits for a return, and its two command levels.

The lengths of its stays tell which switches begin a cycle. The levels are given, or grown from
small to large within the limits, and shifted against a load.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from relay_autotune.arrays import FloatArray
from relay_autotune.experiment.parameters import FIRST_SHARE, ExperimentParameters
from relay_autotune.experiment.settling import resolution
from relay_autotune.reasons import Code, Reason
from relay_autotune.record.record import Cycle


class Relay:
    """A relay with hysteresis.

    Direct-acting (sign 1), it goes low when the measurement rises to ``setpoint + hysteresis``
    and high when it falls to ``setpoint - hysteresis``; reverse-acting (sign -1), it does the
    opposite. Without hysteresis the measurement must pass the set-point, because a quantised one
    may stay exactly on it.

    :param sign: sign of the process gain, 1 or -1.
    :param setpoint: measurement about which it switches [y].
    :param hysteresis: half width of the band in which it does not switch [y], >= 0.
    :param time: instant from which it acts [s].
    :param measurement: measurement at that instant [y]; it begins with the level that pushes
        towards the set-point, and with the high one within the band.
    """

    def __init__(
        self, sign: int, setpoint: float, hysteresis: float, time: float, measurement: float
    ) -> None:
        self.sign = sign
        # With the measurement times the sign, a high command always pushes upwards, and one rule
        # serves both actions.
        centre = sign * setpoint
        self._low_from = max(centre + hysteresis, math.nextafter(centre, math.inf))
        self._high_from = min(centre - hysteresis, math.nextafter(centre, -math.inf))
        self.is_high = sign * measurement < self._low_from
        self.since = time
        """Instant of the last switch, or of the begin [s]."""
        self.last_stay = 0.0
        """How long it stayed at the level before this one [s]."""
        self.switches = 0
        """Number of switches so far."""

    def update(self, time: float, measurement: float) -> bool:
        """Take one sample; return True if the relay switches on it."""
        pushed = self.sign * measurement
        if self.is_high:
            if pushed < self._low_from:
                return False
        elif pushed > self._high_from:
            return False
        self.is_high = not self.is_high
        self.last_stay = time - self.since
        self.since = time
        self.switches += 1
        return True


# A stay at the low level is noise at a switch, and begins no cycle, if it is shorter than this
# part of the longest stay (less for a biased relay, in proportion to the ratio of its steps), or
# of half the time that the process took to respond.
_SHORT_STAY = 0.2

# A cycle takes about two of the longest stays. If the relay switches for this many of them without
# a cycle, the longest stay is not typical. The least number of samples applies as well.
OVERDUE = 3.0
OVERDUE_SAMPLES = 200
# A stay this many times as long as the longest before restarts that time.
_MUCH_LONGER = 2.0


class DwellFilter:
    """Separate responses of the process from noise at a switch, by the length of the stays.

    After one very long stay (an actuator that sticks for a moment, a load that goes away again),
    all normal stays would look like noise. So if the relay keeps switching but no cycle begins for
    three times the longest stay, and 200 samples, the longest stay is forgotten, and the longest
    of this time replaces it. After a cycle, a stay of more than twice the longest one restarts
    this time, whose length still follows from the longest stay before. A stay during which the
    levels were shifted does not show how long the process takes; it only restarts this time.

    :param time: instant from which the relay acts [s].
    :param response_time: time that the process took to respond to the kick [s].
    """

    def __init__(self, time: float, response_time: float) -> None:
        self.longest = 0.0
        """The longest stay between two switches, of those that count [s]."""
        self.lost = 0
        """Number of times the longest stay was learned again."""
        self.lost_for = 0.0
        """Time without a cycle before it was last learned again [s]."""
        self._least = 0.5 * response_time
        self._usual = 0.0
        self._has_begun = False
        self._begun = 0
        self._since = time
        self._recent = 0.0

    def add(self, time: float, stay: float, balance: float, *, counts: bool) -> bool:
        """Take a stay that has ended; return True if it can be a response of the process.

        :param time: when it ended [s].
        :param stay: its length [s].
        :param balance: ratio of the shorter to the longer stay of a biased relay.
        :param counts: False for the stay before the first switch, which may begin anywhere, and
            for one during which the levels were shifted.
        """
        if not counts:
            self._since, self._recent = time, 0.0
        else:
            self._recent = max(self._recent, stay)
            if stay > _MUCH_LONGER * self.longest:
                # Cycles that it may hide come after it.
                if self._has_begun:
                    self._usual, self._begun = self._usual or self.longest, 0
                self._since, self._recent = time, 0.0
            self.longest = max(self.longest, stay)
        return stay >= _SHORT_STAY * max(balance * self.longest, self._least)

    def begin(self, time: float) -> None:
        """Note that a cycle begins [s]."""
        self._since, self._recent, self._has_begun = time, 0.0, True
        self._begun += 1
        if self._begun > 1:
            # This is the process's normal time now.
            self._usual = 0.0

    def is_overdue(self, time: float, interval: float) -> bool:
        """Return True, and learn the longest stay again, if a cycle should have begun.

        :param time: instant of a switch at which no cycle begins [s].
        :param interval: mean sample interval [s].
        """
        longest = max(self._usual or self.longest, 2.0 * self._least)
        waited = time - self._since
        if waited <= max(OVERDUE * longest, OVERDUE_SAMPLES * interval):
            return False
        self.longest = self._recent
        self._least = min(self._least, 0.5 * self._recent)
        self.lost += 1
        self.lost_for = waited
        self._usual = 0.0
        self._since, self._recent = time, 0.0
        return True


# Half swing that is clear of noise (in standard deviations), of the hysteresis (in half widths),
# and of the sensor's resolution (in steps).
CLEAR_OF_NOISE = 10.0
CLEAR_OF_HYSTERESIS = 3.0
CLEAR_OF_STEPS = 5.0
# Half swing that a search aims at, in standard deviations of the noise and in steps of the sensor,
# as far as it takes a share of the way to a limit of the measurement. From an oscillation that is
# only just clear, the verdict varies with the noise.
_AMPLE, _OF_ROOM = 20.0, 1.0 / 3.0

# Largest growth of a too small amplitude at a time.
_MOST_GROWTH = 4.0
# Reserve on a target, since the swing is not exactly proportional to the amplitude.
_TO_SPARE = 1.2
# The first swing at an amplitude is 10 to 25 % smaller than the settled one: from this part of a
# target on, another cycle shows whether that is reached.
_MAY_REACH = 0.75

# First share of a given amplitude, since its levels may lie beyond the actuator's ends.
_SMALL = 0.25

# Growth of the levels, and least growth of the swing, or of its rate, with it; below that the
# actuator is clipped. The first swing at an amplitude is not settled.
_GROWN, _CLIPPED = 3.0, 1.5


@dataclass(frozen=True)
class Swing:
    """What a cycle shows of the process's answer.

    :param half: half the swing of the measurement [y].
    :param period: s.
    """

    half: float
    period: float

    def over(self, other: Swing) -> float:
        """Return by how much the answer has grown.

        With the levels grows the swing, or its rate where noise or hysteresis hold its size: a
        larger command crosses them faster.

        :param other: the swing before.
        """
        return self.half / other.half * max(1.0, other.period / self.period)


class Levels:
    """The levels of a relay about its baseline.

    A given amplitude stays as it is; with ``from_small`` it starts at a quarter, so that the two
    swings of the measurement show whether the actuator goes as far. Otherwise the amplitude starts
    at a hundredth of the range of the command and grows. A level beyond a limit is cut to the
    limit; the upper and the lower step then differ, which counts as bias.

    :param parameters: the user's parameters, valid for the baseline.
    :param baseline: command of the operating point [u].
    :param from_small: True: a given amplitude is not applied at once.
    """

    def __init__(
        self, parameters: ExperimentParameters, baseline: float, *, from_small: bool = False
    ) -> None:
        self._parameters = parameters
        self._baseline = baseline
        self.from_small = from_small and not parameters.finds_amplitude
        """True if a given amplitude starts at a quarter."""
        self.searching = parameters.finds_amplitude or self.from_small
        """True while the amplitude may still grow."""
        self._wanted = parameters.amplitude
        self._shift = 0.0
        self._small = _SMALL
        if self.from_small:
            self.begin_small()
        elif parameters.finds_amplitude:
            self._wanted = parameters.first_amplitude
        # The amplitude of the last swing.
        self._seen_at = 0.0
        # Amplitude, swing and levels of the first cycle that was clear of the noise.
        self._first_clear: tuple[float, Swing, float, float] | None = None
        self._set()

    def _set(self) -> None:
        p = self._parameters
        if p.finds_amplitude:
            bias = p.bias_at(self._wanted)
        else:
            bias = p.relay_bias * (self._wanted / p.amplitude)
        middle = self._baseline + bias + self._shift
        # Shifted levels also stay within the limits.
        self.low = max(middle - self._wanted, p.command_min)
        """The lower level [u]."""
        self.high = min(middle + self._wanted, p.command_max)
        """The upper level [u]."""

    @property
    def _as_given(self) -> bool:
        # Keep the exact digits of the user's numbers.
        return self._wanted == self._parameters.amplitude and self._shift == 0.0

    @property
    def amplitude(self) -> float:
        """Half the distance of the levels, mu [u]."""
        if self._as_given:
            return self._parameters.amplitude
        return 0.5 * (self.high - self.low)

    @property
    def bias(self) -> float:
        """Middle of the levels minus the baseline, mu0 [u]."""
        if self._as_given:
            return self._parameters.relay_bias
        return 0.5 * (self.high + self.low) - self._baseline

    @property
    def balance(self) -> float:
        """Ratio of the smaller to the larger step, at least that with which a search may begin.

        Levels that a load has shifted may both lie on one side of the baseline.
        """
        amplitude, bias = self.amplitude, abs(self.bias)
        return max((amplitude - bias) / (amplitude + bias), FIRST_SHARE)

    @property
    def can_grow(self) -> bool:
        """True if the amplitude may be made larger."""
        p = self._parameters
        if self.from_small and self._wanted == p.amplitude:
            return False
        return self.searching and (self.low > p.command_min or self.high < p.command_max)

    def grow(self, factor: float = 2.0) -> None:
        """Make the amplitude larger, within the limits, if it is not given."""
        self._wanted *= factor
        if self.from_small:
            self._wanted = min(self._wanted, self._parameters.amplitude)
        self._set()

    def begin_small(self) -> None:
        """Apply the first share of a given amplitude, whatever the kick needed."""
        self._wanted = self._small * self._parameters.amplitude
        self._set()

    def begin_larger(self) -> None:
        """Double the first share of a given amplitude, which noise seemed to answer."""
        self._small = min(2.0 * self._small, 1.0)
        self.begin_small()

    def shift(self, by: float) -> None:
        """Move both levels, to compensate a load [u]."""
        self._shift += by
        self._set()

    def note_small(self, swing: Swing, clear: float) -> None:
        """Keep the first swing of the measurement that is clear of noise.

        :param swing: of the last cycle.
        :param clear: the half swing that is clear of noise, hysteresis and resolution [y].
        """
        if self._first_clear is None and swing.half >= clear:
            self._first_clear = self.amplitude, swing, self.low, self.high

    @property
    def grew_enough(self) -> bool:
        """True if the levels have grown enough for the response to have grown, too."""
        first = self._first_clear
        return first is not None and self.amplitude >= _GROWN * first[0]

    def why_clipped(self, swing: Swing, *, settled: bool) -> Reason | None:
        """Return why the actuator must be at its ends, None if it need not.

        A response that is clear of noise must grow with the levels.

        :param swing: of the last cycle.
        :param settled: True: the swing does not grow any more, and must have grown by at least
            the square root of the growth of the levels.
        """
        if self._first_clear is None or not self.grew_enough:
            return None
        amplitude, first, low, high = self._first_clear
        least = math.sqrt(self.amplitude / amplitude) if settled else _CLIPPED
        if swing.over(first) >= least:
            return None
        return Code.CLIPPED(
            before=amplitude,
            now=self.amplitude,
            swing_before=first.half,
            swing=swing.half,
            low=low,
            high=high,
        )

    def growth_for(self, half_swing: float, least: float) -> float | None:
        """Return the factor by which the amplitude must grow, None if it is large enough.

        It is 1 where the present amplitude may reach the least swing.

        :param half_swing: half the swing of the measurement over the last cycle [y].
        :param least: the half swing that is large enough [y].
        """
        if not self.can_grow:
            return None
        if self.from_small:
            return self._parameters.amplitude / self._wanted
        is_first, self._seen_at = self.amplitude != self._seen_at, self.amplitude
        if half_swing >= least:
            return None
        if is_first and half_swing >= _MAY_REACH * least:
            return 1.0
        return min(_TO_SPARE * least / half_swing, _MOST_GROWTH) if half_swing else _MOST_GROWTH


# The share of the high level in a period is known when two cycles agree within the first number; a
# later change by more than the second number means a load. A load that stops the oscillation is
# compensated by shifts of a part of the amplitude, a limited number at a time.
_SAME_SHARE, _OTHER_SHARE = 0.03, 0.08
_MOST_SHIFTS, _SHIFT = 2, 0.7
MOST_COMPENSATED = 4
"""Number of stays that may need a shift: a load that comes and goes twice. A process that needs it
at every turn does not oscillate."""


class LoadCompensation:
    """Shift the levels against a load, which changes the mean command that the process needs."""

    def __init__(self, levels: Levels, notes: list[Reason]) -> None:
        self._levels, self._notes = levels, notes
        self._share = math.nan
        self.shifts = 0
        """Number of shifts in the present stay."""
        self.compensated = 0
        """Number of stays that needed one."""
        self.at = -math.inf
        """Time of the last one [s]."""
        self.waits_from = -math.inf
        """Instant from which the limit of the present stay counts, at the earliest [s]."""

    def shows_in(self, last: Sequence[Cycle]) -> bool:
        """Compensate a load by the share of the high level; return True if there was one.

        :param last: the last two cycles, or the only one.
        """
        share = [c.period_high / c.period if c.period > 0.0 else 0.5 for c in last]
        if math.isnan(self._share):
            if len(share) == 2 and abs(share[1] - share[0]) < _SAME_SHARE:
                self._share = share[1]
            return False
        change = share[-1] - self._share
        # After a disturbed cycle a small change counts too: the rest of the same load.
        if abs(change) <= (_SAME_SHARE if last[0].disturbed else _OTHER_SHARE):
            return False
        self._shift(2.0 * change * self._levels.amplitude)
        return True

    def may_push(self) -> bool:
        """Return True if the levels may be shifted for a measurement that does not come back."""
        return self.shifts < _MOST_SHIFTS if self.shifts else self.compensated < MOST_COMPENSATED

    def push(self, sign: int) -> None:
        """Shift the levels by a part of the amplitude, up (1) or down (-1)."""
        self._shift(sign * _SHIFT * self._levels.amplitude)

    def pushed(self, t: float, limit: float) -> None:
        """Note that the command has moved with the levels, and give it half of a limit again."""
        self.compensated += not self.shifts
        self.shifts += 1
        self.at, self.waits_from = t, t - 0.5 * limit

    def _shift(self, by: float) -> None:
        self._levels.shift(by)
        note = Code.NOTE_LOAD()
        if note not in self._notes:
            self._notes.append(note)


def clear_swing(p: ExperimentParameters, noise_std: float, measurement: FloatArray) -> float:
    """Return the half swing that is clear of noise, hysteresis and resolution [y].

    :param p: the user's parameters.
    :param noise_std: standard deviation of the noise [y].
    :param measurement: samples of the oscillation [y], shape (n,).
    """
    return max(
        CLEAR_OF_NOISE * noise_std,
        CLEAR_OF_HYSTERESIS * p.band(noise_std),
        CLEAR_OF_STEPS * resolution(measurement),
    )


def sought_swing(
    p: ExperimentParameters, noise_std: float, setpoint: float, measurement: FloatArray
) -> float:
    """Return the half swing at which an amplitude that is searched for is large enough [y].

    :param p: the user's parameters.
    :param noise_std: standard deviation of the noise [y].
    :param setpoint: about which the relay switches [y].
    :param measurement: samples of the oscillation [y], shape (n,).
    """
    ample = _AMPLE * max(noise_std, resolution(measurement))
    clear = clear_swing(p, noise_std, measurement)
    return p.target_amplitude or max(clear, min(ample, _OF_ROOM * p.room(setpoint)))
