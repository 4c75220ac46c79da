# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The part of an experiment in which the relay switches: its cycles, or why there are none."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from relay_autotune.arrays import FloatArray
from relay_autotune.experiment.faults import (
    NO_ANSWER,
    TELL,
    RunawayWatch,
    has_moved,
    is_growing,
    why_no_return,
    why_noise_alone,
)
from relay_autotune.experiment.relay_law import (
    DwellFilter,
    DwellLimit,
    Relay,
    ample_swing,
    clear_swing,
)
from relay_autotune.experiment.samples import Run, State
from relay_autotune.record.cycles import MIN_CYCLES, cycle_from_samples, next_cycle
from relay_autotune.record.record import Cycle
from relay_autotune.text import duration

# Two instants that differ by less than this part of the sample interval are equal.
_ROUNDING = 1e-6

# The share of the high level in a period is known when two cycles agree within the first number; a
# later change by more than the second number means a load. A load that stops the oscillation is
# compensated by shifts of a part of the amplitude, a limited number at a time.
_SAME_SHARE, _OTHER_SHARE = 0.03, 0.08
_MOST_SHIFTS, _SHIFT = 2, 0.7
# Number of stays that may need a shift: a load that comes and goes twice. A process that
# needs it at every turn does not oscillate.
MOST_BORNE = 4
_FOLLOWS = 2
# Ratio of a cycle to the one before beyond which it is no sign of a load yet.
_ALONE = 4.0

# Part of the patience that applies after the first whole cycle.
_PATIENCE_IN_CYCLES = 0.4

# The measurement has run away if its distance is this many times the oscillation's, for this many
# samples, since a sensor has spikes.
_RUNAWAY, _RUNAWAY_SAMPLES = 30.0, 5

# The switching may last max_cycles plus this many cycles of twice the longest allowed stay. The
# spare cycles cover those that could not be counted.
_SPARE_CYCLES = 12

# Chatter: more switches in a cycle than this, and this many times as many as in any cycle before.
_CHATTER, _CHATTER_RATIO = 40, 10.0

# Fast switching: this many cycles in a row are shorter than this part of the usual cycle.
_FAST_CYCLES, _FAST = 3, 0.3
# Or of the last stays at most one lasts half the time that the process took to respond to a kick
# by the same amplitude: a process cannot answer faster, and noise leaves a long stay in each half
# cycle.
_MANY_STAYS, _OF_RESPONSE = 40, 0.5
# Three stays as long as that show that the time to respond was not that of a gap.
_SHOWN = 3

# If the levels started at a quarter, the swings are compared once the swing grows by less than
# this factor from one cycle to the next.
_STILL = 1.1
# A last swing this many times as large as a clear one should have been clear at a quarter, too.
_CLEARLY = 5.0

# A measurement that did not move for this many stays of the relay does not follow it.
_STAYS = 2

# Least difference of the periods of two cycles that is told, as a fraction.
_DIFFER = 0.001

_SIGNS = {1: "positive", -1: "negative"}


def usual_period(cycles: Sequence[Cycle]) -> float:
    """Return the lower quartile of the undisturbed periods [s]; 0 for less than two of them.

    The longer ones may hold an actuator that stuck, and the shortest the begin of fast switching.
    """
    clean = sorted(cycle.period for cycle in cycles if not cycle.disturbed)
    return clean[len(clean) // 4] if len(clean) > 1 else 0.0


class Oscillation:
    """Answer samples with the relay until its cycles agree, or until there is no oscillation.

    An amplitude that is not given grows from cycle to cycle until the oscillation is large enough;
    cycles count from then on. A load changes the mean command that the process needs, and with it
    the half periods; the levels are shifted so that the half periods stay the same.

    :param run: the experiment so far; the relay begins at its last sample.
    :param doubtful: True if the user did not give the sign, so that it may be reversed later.
    :param first_limit: longest stay until the first switch [s].
    :param until_converged: False: agreement of the cycles does not end it.
    """

    def __init__(
        self, run: Run, *, doubtful: bool, first_limit: float, until_converged: bool
    ) -> None:
        self._run = run
        self._parameters = run.parameters
        self._samples = run.trace
        self._levels = run.levels
        self._doubtful = doubtful
        self._first_limit = first_limit
        self._until_converged = until_converged
        self._on_the_way: deque[tuple[float, bool, bool]] = deque()
        self._switched_at: deque[int] = deque(maxlen=_STAYS + 1)
        self._turns: DwellFilter
        self._limit = first_limit
        self._patient_from = -math.inf
        self._share = math.nan
        self._switches_before = 0
        self._kick_amplitude = run.levels.amplitude
        self._answered: deque[bool] = deque(maxlen=_MANY_STAYS)
        self._long_stays = 0
        self._shifts = self._borne = 0
        self._shifted_at = -math.inf
        self._furthest = math.inf
        self._away = 0
        self._begin()

    @property
    def command(self) -> float:
        """The level in force [u]."""
        return self._levels.high if self._is_high else self._levels.low

    def answer(self, t: float, y: float) -> float:
        """Take the last sample and return the command; end the run where it cannot go on.

        :param t: its time [s].
        :param y: the measurement [y].
        """
        relay = self._relay
        if relay.update(t, y):
            self._run.switches += 1
            # Only a stay without a shift of the levels counts: else each shift would lengthen the
            # limit of the next stay.
            was_shifted = self._shifts > 0
            self._answers = self._turns.add(
                t,
                relay.last_stay,
                self._levels.balance,
                counts=relay.switches > 1 and not was_shifted,
            )
            self._learn(0.0 if was_shifted else relay.last_stay)
            self._shifts = 0
            if begins := relay.is_high and self._answers:
                self._turns.begin(t)
            elif self._turns.is_overdue(t, self._samples.interval):
                self._learn_anew()
            due = t + self._parameters.extra_delay
            self._on_the_way.append((due, relay.is_high, begins))
            self._switched_at.append(len(self._samples) - 1)
            self._look_for_noise()
            self._look_for_chatter()
        elif t - max(relay.since, self._patient_from) > self._limit:
            self._no_return(t, y)
        elif self._runs_away(t, y):
            if self._doubtful and not self._run.cycles:
                self._no_return(t, y)
            else:
                self._end(State.FAILED, self._why_lost(t, y))
        waiting = self._on_the_way
        while waiting and waiting[0][0] <= t + _ROUNDING * self._samples.interval:
            _, self._is_high, begins = waiting.popleft()
            if begins:
                self._begin_cycle()
        return self.command

    def tell(self, t: float, y: float) -> str:
        """Say how the oscillation goes, after the sample that was answered last.

        :param t: its time [s].
        :param y: the measurement [y].
        """
        relay, run, cycles = self._relay, self._run, self._run.cycles
        since, needed = t - relay.since, self._parameters.min_cycles
        if self._levels.searching:
            told = "the amplitude is still growing"
        elif not cycles:
            told = "no whole cycle yet"
        elif len(cycles) < needed:
            told = f"{len(cycles)} of at least {needed} cycles"
        else:
            last, before = cycles[-1].period, cycles[-2].period
            differ = 100.0 * max(abs(last - before) / before if before > 0.0 else 0.0, _DIFFER)
            told = f"{len(cycles)} cycles, the periods of the last two differ by {differ:.2g} %"
        patience = ""
        if cycles and since > cycles[-1].period:
            patience = f", longer than a cycle took; it may take {duration(self._limit)}"
        rises = relay.is_high == (run.process_gain_sign > 0)
        target = run.setpoint + (run.hysteresis if rises else -run.hysteresis)
        return (
            f"{told}; at {self.command:g} for {duration(since)}{patience}: the measurement "
            f"{y:.6g} is to {'rise' if rises else 'fall'} to {target:.6g}"
        )

    def _runs_away(self, t: float, y: float) -> bool:
        if not self._run.cycles:
            return self._watch.add(t, y - self._run.setpoint)
        self._away = self._away + 1 if abs(y - self._run.setpoint) > self._furthest else 0
        return self._away >= _RUNAWAY_SAMPLES

    def _begin(self) -> None:
        run, t, y = self._run, self._samples.seen[-1], self._samples.measurement[-1]
        self._relay = Relay(run.process_gain_sign, run.setpoint, run.hysteresis, t, y)
        self._is_high = self._relay.is_high
        floor = max(run.hysteresis, abs(y - run.setpoint), 3.0 * run.noise_std)
        self._watch = RunawayWatch(floor)
        run.cycle_start = ()
        self._on_the_way.clear()
        self._switched_at.clear()
        self._answered.clear()
        self._long_stays = 0
        self._switches_before = self._run.switches
        self._patience = DwellLimit(self._levels.balance)
        self._turns = DwellFilter(t, self._run.response_time)
        self._answers = self._is_lost = False
        # The shortest cycle before a cycle was lost [s]; 0: no cycle was lost.
        self._usual = 0.0
        # The most switches in a cycle, and the number of switches at the end of the last cycle.
        self._most, self._counted = 0, self._run.switches
        self._began, self._longest_limit = t, 0.0
        p = self._parameters
        self._learn(self._run.response_time)
        if not p.max_half_cycle and (p.hysteresis > 0.0 or not math.isnan(p.setpoint)):
            # The user's set-point decides the distance to the first switch, so the time to respond
            # gives no limit.
            self._limit = self._first_limit
        self._longest_limit = self._limit

    @property
    def latest(self) -> float:
        """Deadline of the switching, unless the limit of a stay grows before [s]."""
        cycles = self._parameters.max_cycles + _SPARE_CYCLES
        return self._began + 2.0 * cycles * self._longest_limit

    def _learn(self, stay: float) -> None:
        self._patience.learn(stay, self._samples.interval)
        p = self._parameters
        limit = self._patience.limit
        if self._run.cycles:
            least = DwellLimit.LEAST_SAMPLES * self._samples.interval
            limit = max(_PATIENCE_IN_CYCLES * limit, least)
        self._limit = p.max_half_cycle or limit + 2.0 * p.extra_delay
        self._longest_limit = max(self._longest_limit, self._limit)

    def _learn_anew(self) -> None:
        """Learn the length of a stay again from the relay's present switching, or fail."""
        turns, most = self._turns, self._parameters.max_cycles
        self._usual = self._usual or usual_period(self._run.cycles)
        if self._switches_fast(2.0 * turns.longest, self._usual):
            return
        if len(self._run.cycles) + turns.lost >= most:
            self._end(
                State.FAILED,
                f"no clear cycle for {turns.lost_for:.3g} s, though the relay went on switching, "
                f"after {self._run.counted}, and max_cycles, {most}, are over: its half "
                f"cycles differ too much; check sensor and actuator, and that the process rests "
                f"at the baseline",
            )
            return
        self._patience.forget(turns.longest)
        self._is_lost = True

    def _switches_fast(self, period: float, usual: float) -> bool:
        """Fail if a period is too short compared with the usual one."""
        if period >= _FAST * usual:
            return False
        self._end_fast(
            f"each {0.5 * period:.3g} s or sooner after {self._run.counted}, where a "
            f"cycle took {usual:.3g} s before"
        )
        return True

    def _chatters(self) -> bool:
        """Fail if the relay switched far more often in the last cycle than in any before."""
        count, self._counted = self._run.switches - self._counted, self._run.switches
        most, self._most = self._most, max(self._most, count)
        if not most or count <= max(_CHATTER_RATIO * most, _CHATTER):
            return False
        self._end_fast(
            f"{count} times in the last of {self._run.counted}, and {most} times at most "
            f"in those before"
        )
        return True

    def _look_for_chatter(self) -> None:
        """Fail if the process cannot have caused the last stays."""
        stay = self._relay.last_stay
        is_long = stay >= _OF_RESPONSE * self._run.response_time
        if stay > 0.0:  # the clock goes
            self._answered.append(is_long)
        self._long_stays += is_long
        known = self._levels.amplitude <= self._kick_amplitude and self._long_stays >= _SHOWN
        if known and len(self._answered) == _MANY_STAYS and sum(self._answered) <= 1:
            self._end_fast(
                f"{_MANY_STAYS} times with at most one stay of {_OF_RESPONSE:g} times the "
                f"{self._run.response_time:.3g} s that the process took to respond"
            )

    def _end_fast(self, how: str) -> None:
        self._end(
            State.FAILED, f"the relay switches fast, {how}: check the sensor and the actuator"
        )

    # Cycles.

    def _begin_cycle(self) -> None:
        self._run.cycle_start += (len(self._samples) - 1,)
        if len(self._run.cycle_start) < 2 or self._has_grown():
            self._counted = self._run.switches
            return
        cycle = self._cycle_that_ended()
        if was_lost := self._is_lost:
            cycle = replace(cycle, disturbed=True)
            self._is_lost = False
        self._run.cycles += (cycle,)
        last = max(c.period for c in self._run.cycles[-_FAST_CYCLES:])
        usual = self._usual or usual_period(self._run.cycles[:-_FAST_CYCLES])
        if self._switches_fast(last, usual) or self._chatters():
            return
        p = self._parameters
        if is_growing([c.peak_max - c.peak_min for c in self._run.cycles]):
            self._end(
                State.FAILED,
                f"the oscillation grows faster and faster, after {self._run.counted}: an "
                f"unstable process that the relay cannot hold; give a larger amplitude",
            )
        elif noise := self._only_noise(TELL):
            self._end(State.FAILED, noise)
        elif clipped := self._clipped():
            self._end(State.FAILED, clipped)
        elif self._until_converged and cycle.converged:
            n = len(self._run.cycles)
            which = f"{n}" if n == p.min_cycles else f"the last {p.min_cycles} of {n}"
            self._complete(
                f"{which} cycles agree within {100.0 * p.cycle_tolerance:g} %, allowing for noise"
            )
        elif len(self._run.cycles) + self._turns.lost >= p.max_cycles:
            self._complete(
                f"max_cycles, {p.max_cycles}, reached; the last {p.min_cycles} cycles do not "
                f"agree within {100.0 * p.cycle_tolerance:g} %"
                if self._until_converged
                else f"max_cycles, {p.max_cycles}, reached"
            )
        else:
            swing = max(c.peak_max - c.peak_min for c in self._run.cycles)
            self._furthest = 0.5 * _RUNAWAY * swing
            if not (was_lost or self._is_alone(cycle.period)):
                self._bear_load()

    def _look_for_noise(self) -> None:
        """Make the amplitude larger, or fail, if the last stays did not move the measurement."""
        first, last = self._switched_at[0], self._switched_at[-1]
        if len(self._switched_at) <= _STAYS or last - first < TELL:
            return
        # Noise may switch the relay many times while the measurement passes the band.
        time = self._samples.seen[last] - self._samples.seen[first]
        noise = self._noise_alone(first, last) if time >= _STAYS * self._run.response_time else ""
        if noise and self._levels.can_grow:
            self._levels.grow()
            self._begin()
        elif noise:
            self._end(State.FAILED, noise)

    def _has_grown(self) -> bool:
        """Make an amplitude that is not given larger if the last cycle was too small."""
        if not self._levels.searching:
            return False
        first, last = self._run.cycle_start[-2:]
        y = self._samples.columns(first, last + 1)[1]
        half_swing = 0.5 * float(y.max() - y.min())
        noise = self._run.noise_std
        clear = clear_swing(noise, self._run.hysteresis, y)
        least = self._parameters.target_amplitude or ample_swing(clear, noise, self._room, y)
        clipped = (
            "" if self._levels.from_small else self._levels.why_clipped(half_swing, settled=False)
        )
        if clipped:
            self._end(State.FAILED, clipped)
            return True
        self._levels.note_small(half_swing, clear)
        factor = self._levels.growth_for(half_swing, least)
        if factor == 1.0:
            if half_swing < least and not self._levels.from_small:
                self._run.notes.append(
                    f"the amplitude {self._levels.amplitude:g} is all that the command limits "
                    f"allow, and the measurement swings by {half_swing:.3g} only, less than "
                    f"{least:.3g}"
                )
            self._levels.searching = False
            return False
        self._levels.grow(factor)
        self._run.cycle_start = (last,)
        return True

    @property
    def _room(self) -> float:
        """Distance of the set-point to the nearest limit of the measurement [y]."""
        p, middle = self._parameters, self._run.setpoint
        room = min(middle - p.measurement_min, p.measurement_max - middle)
        return min(room, p.max_deviation) if p.max_deviation > 0.0 else room

    def _clipped(self) -> str:
        """Return why the actuator is at its ends, once the swing grows no more; empty: nothing."""
        if not (self._levels.from_small and self._run.is_tried):
            return ""
        before, last = (0.5 * (c.peak_max - c.peak_min) for c in self._run.cycles[-2:])
        return "" if last > _STILL * before else self._levels.why_clipped(last, settled=True)

    def _should_have_told(self) -> bool:
        """Return True if a quarter of the last swing would have stood clear of the noise."""
        first, last = self._run.cycle_start[-2:]
        y = self._samples.columns(first, last + 1)[1]
        clear = clear_swing(self._run.noise_std, self._run.hysteresis, y)
        return 0.5 * float(y.max() - y.min()) > _CLEARLY * clear

    def _cycle_that_ended(self) -> Cycle:
        run, p = self._run, self._parameters
        first, last = run.cycle_start[-2:]
        cycle = cycle_from_samples(
            run.cycle_count,
            *self._samples.columns(first, last + 1),
            middle=run.baseline + self._levels.bias,
            reverse_acting=run.process_gain_sign < 0,
        )
        interval = cycle.period / (last - first)
        return next_cycle(
            run.cycles, cycle, interval, run.noise_std, p.min_cycles, p.cycle_tolerance
        )

    def _is_alone(self, period: float) -> bool:
        """Return True if a cycle is much longer than the one before: an actuator may have stuck.

        A load would show in the next cycle, too.
        """
        return len(self._run.cycles) > 1 and period > _ALONE * self._run.cycles[-2].period

    def _bear_load(self) -> None:
        """Shift the levels by the change of the mean command that a load has caused."""
        last = self._run.cycles[-2:]
        share = [c.period_high / c.period if c.period > 0.0 else 0.5 for c in last]
        if math.isnan(self._share):
            if len(share) == 2 and abs(share[1] - share[0]) < _SAME_SHARE:
                self._share = share[1]
            return
        change = share[-1] - self._share
        # After a disturbed cycle a small change counts too: the rest of the same load.
        if abs(change) > (_SAME_SHARE if last[0].disturbed else _OTHER_SHARE):
            self._shift(2.0 * change * self._levels.amplitude)
            self._run.cycles = (*self._run.cycles[:-1], replace(last[1], disturbed=True))

    def _shift(self, by: float) -> None:
        self._levels.shift(by)
        note = "a load came during the test, and the relay's levels were shifted to compensate it"
        if note not in self._run.notes:
            self._run.notes.append(note)

    # The end.

    def _complete(self, reason: str) -> None:
        """Complete, unless the last cycles may be noise alone."""
        if noise := self._only_noise(1):
            self._end(State.FAILED, noise)
            return
        if self._levels.from_small and not self._levels.grew_enough:
            untold = (
                "whether the actuator goes as far as the levels could not be told, since no "
                "oscillation at a quarter of the amplitude stood clear of the noise: look whether "
                f"it goes from {self._levels.low:g} to {self._levels.high:g}"
            )
            if not self._run.cycles[-1].converged or self._should_have_told():
                self._end(State.FAILED, f"{untold}; {reason}")
                return
            self._run.notes.append(untold)
        self._end(State.COMPLETED, reason)

    def _only_noise(self, least: int) -> str:
        """Return why the last cycles are no oscillation, "" if they may be one.

        :param least: number of samples needed for a decision before MIN_CYCLES cycles.
        """
        last_cycles = self._run.cycle_start[-min(len(self._run.cycles), MIN_CYCLES) - 1 :]
        first, last = last_cycles[0], last_cycles[-1]
        few = len(self._run.cycles) < MIN_CYCLES and last - first < least
        return "" if few else self._noise_alone(first, last)

    def _noise_alone(self, first: int, last: int) -> str:
        """Return why the samples first to last - 1 are no oscillation, "" if they may be one."""
        measurement = self._samples.columns(first, last)[1]
        return why_noise_alone(measurement, self._run.noise_std, self._run.counted)

    def _end(self, state: State, reason: str) -> None:
        disturbed = sum(cycle.disturbed for cycle in self._run.cycles)
        if state is State.COMPLETED and disturbed:
            self._run.notes.append(
                f"{disturbed} of {self._run.cycle_count} cycles disturbed: a long gap in the "
                "samples, a load step, or switches that formed no clear cycle"
            )
        self._run.end(state, reason)

    def _no_return(self, t: float, y: float) -> None:
        """Fail, unless the amplitude can grow or a doubtful sign can be reversed."""
        # A half cycle beyond the noise shows that the process follows the relay both ways.
        stays = self._run.switches - self._switches_before
        follows = bool(self._run.cycles) or (stays >= _FOLLOWS and self._answers)
        # A constant measurement is no response at all; a saturated one still is.
        moved = has_moved(self._since(self._told_at)[1])
        if self._doubtful and not follows and moved:
            self._doubtful = False
            sign = self._run.process_gain_sign
            self._run.notes.append(
                f"the process gain was first taken for {_SIGNS[sign]}: the measurement did not "
                f"come back; give process_gain_sign to spare the process that"
            )
            self._run.process_gain_sign = -sign
            self._begin()
            return
        if self._levels.can_grow:
            self._levels.grow()
            self._begin()
            return
        may_shift = self._shifts < _MOST_SHIFTS if self._shifts else self._borne < MOST_BORNE
        if follows and may_shift and moved:
            # It did oscillate before: a load may be too large for one of the levels.
            before = self.command
            self._shift((_SHIFT if self._is_high else -_SHIFT) * self._levels.amplitude)
            if self.command != before:
                self._borne += not self._shifts
                self._shifts += 1
                self._shifted_at = t
                # Each shift gets half of the patience again.
                self._patient_from = t - 0.5 * self._limit
                return
        self._end(State.FAILED, self._why_lost(t, y))

    @property
    def _told_at(self) -> float:
        """Time of the last change of the command [s]."""
        return max(self._relay.since, self._shifted_at)

    def _since(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Return time and measurement since an instant."""
        first = bisect_left(self._samples.seen, time)
        return self._samples.columns(first, len(self._samples))[:2]

    def _why_lost(self, t: float, y: float) -> str:
        time, measurement = self._since(self._relay.since)
        sign = self._run.process_gain_sign
        towards = sign if self._relay.is_high else -sign
        why = (
            why_no_return(time, towards * measurement, self._run.noise_std)
            if has_moved(self._since(self._told_at)[1])
            else NO_ANSWER
        )
        shifted = (
            f", and {self._borne} stays ended only when the levels were shifted"
            if self._borne >= MOST_BORNE
            else ""
        )
        return (
            f"no oscillation after {self._run.counted}{shifted}: the measurement is {y:g} "
            f"and did not come back to {self._run.setpoint:g} -/+ {self._run.hysteresis:g} within "
            f"{t - self._relay.since:.3g} s; {why} (process_gain_sign was taken as "
            f"{_SIGNS[sign]})"
        )
