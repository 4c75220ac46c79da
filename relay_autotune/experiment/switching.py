# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The state of an experiment in which the relay switches: its cycles, or why there are none.

The watches of the switching stand in two lists: those of a sample and those of a cycle. Each
returns the reason to end, or None.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from relay_autotune.arrays import FloatArray
from relay_autotune.experiment.faults import (
    TELL,
    RunawayWatch,
    is_growing,
    why_no_return,
    why_noise_alone,
)
from relay_autotune.experiment.phases import Answer, Run, kick_limit
from relay_autotune.experiment.relay_law import (
    MOST_COMPENSATED,
    DwellFilter,
    LoadCompensation,
    Relay,
    Swing,
    clear_swing,
    sought_swing,
)
from relay_autotune.experiment.settling import rest_state
from relay_autotune.reasons import Code, Reason, Value
from relay_autotune.record.cycles import MIN_CYCLES, cycle_from_samples, next_cycle
from relay_autotune.record.record import Cycle
from relay_autotune.text import counted, duration

# Two instants that differ by less than this part of the sample interval are equal.
_ROUNDING = 1e-6

_FOLLOWS = 2
# Ratio of a cycle to the one before beyond which it is no sign of a load yet.
_ALONE = 4.0

# The relay may stay at one level this many times as long as in the longest stay so far, or as the
# process took to respond if that is longer, before the measurement counts as lost. A biased relay
# gets more time, in proportion to the ratio of its two steps. The limit is at least a number of
# samples: without noise, the response of a high-order process is seen at the first sample, and
# takes hundreds of samples to turn. After the first whole cycle, a part of the limit applies.
_LONGER, _LEAST_SAMPLES = 10.0, 200
_LIMIT_IN_CYCLES = 0.4

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
_LONG_STAYS = 3

# If the levels started at a quarter, the swings are compared once the swing grows by less than
# this factor from one cycle to the next.
_STILL = 1.1
# A last swing this many times as large as a clear one should have been clear at a quarter, too.
_CLEARLY = 5.0

# A measurement that did not move for this many stays of the relay does not follow it.
_STAYS = 2

# Fewer samples do not show whether it has moved at all.
_SHOWS = 10

# Whether it rests within the band is looked at after this many times the time to respond: by then
# it has moved for as long as that, if it moves at all.
_RESTS_AFTER = 2.0

# Least difference of the periods of two cycles that is reported, as a fraction.
_DIFFER = 0.001

_SIGNS = {1: "positive", -1: "negative"}


def usual_period(cycles: Sequence[Cycle]) -> float:
    """Return the lower quartile of the undisturbed periods [s]; 0 for less than two of them.

    The longer ones may hold an actuator that stuck, and the shortest the begin of fast switching.
    """
    clean = sorted(cycle.period for cycle in cycles if not cycle.disturbed)
    return clean[len(clean) // 4] if len(clean) > 1 else 0.0


class _FastWatch:
    """See that the relay switches faster than the process can make it.

    :param switches: of the relay so far.
    """

    def __init__(self, switches: int) -> None:
        self._at_cycle = switches
        self._most = 0
        self._answered: deque[bool] = deque(maxlen=_MANY_STAYS)
        self._long_stays = 0

    def forget_cycle(self, switches: int) -> None:
        """Begin to count switches anew, since the last cycle does not count."""
        self._at_cycle = switches

    def stay(self, stay: float, response_time: float, *, known: bool) -> Reason | None:
        """Take a stay that has ended [s].

        :param stay: its length [s].
        :param response_time: how long the process took to respond [s].
        :param known: True if the amplitude is not larger than then.
        """
        is_long = stay >= _OF_RESPONSE * response_time
        if stay > 0.0:  # the clock goes
            self._answered.append(is_long)
        self._long_stays += is_long
        known = known and self._long_stays >= _LONG_STAYS
        if known and len(self._answered) == _MANY_STAYS and sum(self._answered) <= 1:
            return Code.FAST_STAYS(stays=_MANY_STAYS, part=_OF_RESPONSE, response=response_time)
        return None

    def cycle(self, switches: int, cycles: int) -> Reason | None:
        """Take the number of switches at the end of a cycle."""
        count, self._at_cycle = switches - self._at_cycle, switches
        most, self._most = self._most, max(self._most, count)
        if not most or count <= max(_CHATTER_RATIO * most, _CHATTER):
            return None
        return Code.FAST_IN_CYCLE(switches=count, cycles=cycles, most=most)


class _Course:
    """The switching since the relay began, with one amplitude that counts, and one sign.

    :param run: of the experiment, with the band, the sign and the response.
    """

    def __init__(self, run: Run) -> None:
        (t, y), facts = run.now, run.facts
        self.relay = Relay(facts.sign, facts.setpoint, facts.hysteresis, t, y)
        self.is_high = self.relay.is_high
        """The level in force, later than the relay by the added delay."""
        self.on_the_way: deque[tuple[float, bool, bool]] = deque()
        """Switches that are delayed: when, which level, and whether a cycle begins."""
        self.switched_at: deque[int] = deque(maxlen=_STAYS + 1)
        """Samples at which it switched last."""
        self.look_after = _RESTS_AFTER * facts.response_time
        """Length of the present stay at which it is looked whether the measurement rests [s]."""
        self.began = t
        self.fast = _FastWatch(run.switches)
        floor = max(facts.hysteresis, abs(y - facts.setpoint), 3.0 * facts.rest.noise_std)
        self.runaway = RunawayWatch(floor)
        self.longest = 0.0
        """The longest stay, or the time to respond if that is longer [s]."""
        self.ratio = _LONGER / run.levels.balance
        """How many times as long the next stay may be."""
        self.stays = DwellFilter(t, facts.response_time)
        self.answers = False
        """True if the last stay can be a response of the process."""
        self.is_lost = False
        """True while no cycle is recognised."""
        self.usual = 0.0
        """Usual period before a cycle was lost [s]; 0: none was."""


class Switching:
    """Answer samples with the relay until its cycles agree, or until there is no oscillation.

    An amplitude that is not given grows from cycle to cycle until the oscillation is large enough;
    cycles count from then on. A load changes the mean command that the process needs, and with it
    the half periods; the levels are shifted so that the half periods stay the same.

    :param run: of the experiment, with the band, the sign and the response; the relay begins at
        its last sample.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        # A sign that was found may have to be reversed.
        self._is_doubtful = run.parameters.process_gain_sign == 0
        self._kick_amplitude = run.levels.amplitude
        self._load = LoadCompensation(run.levels, run.notes)
        self._furthest = math.inf
        self._away = 0
        self._begin()

    @property
    def command(self) -> float:
        """The level in force [u]."""
        return self._run.level(is_high=self._course.is_high)

    @property
    def where(self) -> str:
        """The state as the end of a sentence."""
        n = len(self._run.cycles)
        return f"after {counted(n, 'whole cycle')}"

    @property
    def latest(self) -> float:
        """Deadline of the switching, unless the limit of a stay grows before [s]."""
        cycles = self._run.parameters.max_cycles + _SPARE_CYCLES
        return self._course.began + 2.0 * cycles * self._longest_limit

    def answer(self, t: float, y: float) -> Answer:
        """Take the last sample, its time without gaps [s] and the measurement [y]."""
        course, relay = self._course, self._course.relay
        if relay.update(t, y):
            if end := self._switched(t):
                return end
        elif self._rests_in_band(t, y):
            self._run.levels.grow()
            self._begin()
        elif t - max(relay.since, self._load.waits_from) > self._limit:
            if end := self._on_timeout(t, y):
                return end
        elif self._runs_away(t, y):
            over = self._is_doubtful and not self._run.cycles
            if end := self._on_timeout(t, y) if over else self._why_lost(t, y):
                return end
        # The course may have begun anew.
        course = self._course
        waiting, rounding = course.on_the_way, _ROUNDING * self._run.trace.interval
        while waiting and waiting[0][0] <= t + rounding:
            _, course.is_high, begins = waiting.popleft()
            if begins and (end := self._begin_cycle()):
                return end
        return self.command

    def status(self, t: float, y: float) -> str:
        """Say how the oscillation goes, after the sample that was answered last."""
        relay, facts, cycles = self._course.relay, self._run.facts, self._run.cycles
        since, needed = t - relay.since, self._run.parameters.min_cycles
        if self._run.levels.searching:
            now = "the amplitude is still growing"
        elif not cycles:
            now = "no whole cycle yet"
        elif len(cycles) < needed:
            now = f"{len(cycles)} of at least {needed} cycles"
        else:
            last, before = cycles[-1].period, cycles[-2].period
            differ = 100.0 * max(abs(last - before) / before if before > 0.0 else 0.0, _DIFFER)
            now = f"{len(cycles)} cycles, the periods of the last two differ by {differ:.2g} %"
        longer = ""
        if cycles and since > cycles[-1].period:
            longer = f", longer than a cycle took; it may take {duration(self._limit)}"
        rises = relay.is_high == (facts.sign > 0)
        target = facts.setpoint + (facts.hysteresis if rises else -facts.hysteresis)
        return (
            f"{now}; at {self.command:g} u for {duration(since)}{longer}: the measurement "
            f"{y:.6g} y is to {'rise' if rises else 'fall'} to {target:.6g} y"
        )

    # Stays of the relay.

    def _begin(self) -> None:
        self._run.cycle_start = ()
        self._course = _Course(self._run)
        p, self._longest_limit = self._run.parameters, 0.0
        self._learn(self._run.facts.response_time)
        if not p.max_half_cycle and (p.hysteresis > 0.0 or not math.isnan(p.setpoint)):
            # The user's set-point decides the distance to the first switch, so the time to respond
            # gives no limit.
            self._limit = kick_limit(self._run)
        self._longest_limit = self._limit

    def _learn(self, stay: float) -> None:
        """Set the limit of the next stay from one that has ended [s]."""
        p, course = self._run.parameters, self._course
        course.longest = max(course.longest, stay)
        least = _LEAST_SAMPLES * self._run.trace.interval
        limit = max(course.ratio * course.longest, least)
        if self._run.cycles:
            limit = max(_LIMIT_IN_CYCLES * limit, least)
        self._limit = p.max_half_cycle or limit + 2.0 * p.extra_delay
        self._longest_limit = max(self._longest_limit, self._limit)

    def _switched(self, t: float) -> Reason | None:
        """Take a switch of the relay."""
        course, relay, run = self._course, self._course.relay, self._run
        run.switches += 1
        # Only a stay without a shift of the levels counts: else each shift would lengthen the
        # limit of the next stay.
        was_shifted, self._load.shifts = self._load.shifts > 0, 0
        course.look_after = _RESTS_AFTER * run.facts.response_time
        course.answers = course.stays.add(
            t,
            relay.last_stay,
            run.levels.balance,
            counts=relay.switches > 1 and not was_shifted,
        )
        self._learn(0.0 if was_shifted else relay.last_stay)
        end: Reason | None = None
        if begins := relay.is_high and course.answers:
            course.stays.begin(t)
        elif course.stays.is_overdue(t, run.trace.interval):
            end = self._learn_anew()
        course.on_the_way.append((t + run.parameters.extra_delay, relay.is_high, begins))
        course.switched_at.append(len(run.trace) - 1)
        end = end or self._look_for_noise()
        # The course may have begun anew.
        course, known = self._course, run.levels.amplitude <= self._kick_amplitude
        fast = course.fast.stay(course.relay.last_stay, run.facts.response_time, known=known)
        return end or fast

    def _learn_anew(self) -> Reason | None:
        """Learn the length of a stay again from the relay's present switching, or fail."""
        course, most = self._course, self._run.parameters.max_cycles
        course.usual = course.usual or usual_period(self._run.cycles)
        if fast := self._too_fast(2.0 * course.stays.longest, course.usual):
            return fast
        if len(self._run.cycles) + course.stays.lost >= most:
            lost = course.stays.lost_for
            return Code.NO_CLEAR_CYCLE(time=lost, cycles=len(self._run.cycles), most=most)
        course.longest = course.stays.longest
        course.is_lost = True
        return None

    def _look_for_noise(self) -> Reason | None:
        """Make the amplitude larger, or fail, if the last stays did not move the measurement."""
        at = self._course.switched_at
        first, last = at[0], at[-1]
        if len(at) <= _STAYS or last - first < TELL:
            return None
        # Noise may switch the relay many times while the measurement passes the band.
        seen = self._run.trace.seen
        if seen[last] - seen[first] < _STAYS * self._run.facts.response_time:
            return None
        noise = self._noise_alone(first, last)
        if noise is None:
            return None
        if not self._run.levels.can_grow:
            return noise
        self._run.levels.grow()
        self._begin()
        return None

    def _runs_away(self, t: float, y: float) -> bool:
        distance = y - self._run.facts.setpoint
        if not self._run.cycles:
            return self._course.runaway.add(t, distance)
        self._away = self._away + 1 if abs(distance) > self._furthest else 0
        return self._away >= _RUNAWAY_SAMPLES

    def _rests_in_band(self, t: float, y: float) -> bool:
        """Return True if a first, small amplitude has brought the measurement to rest in the band.

        It will not leave that, and the time to respond, by which a stay is limited, may hold the
        wait for a level that the process has answered at all.
        """
        levels, facts, course = self._run.levels, self._run.facts, self._course
        stay = t - course.relay.since
        if stay < course.look_after or not (levels.from_small and levels.can_grow):
            return False
        course.look_after = _RESTS_AFTER * stay
        time, measurement = self._since(course.relay.since + 0.5 * stay)
        if len(time) < TELL or abs(y - facts.setpoint) >= facts.hysteresis:
            return False
        return self._has_moved() and rest_state(time - time[0], measurement, len(time)).is_steady

    def _on_timeout(self, t: float, y: float) -> Reason | None:
        """Fail, unless the amplitude can grow or a doubtful sign can be reversed."""
        levels, load, course = self._run.levels, self._load, self._course
        # A half cycle beyond the noise shows that the process follows the relay both ways.
        follows = bool(self._run.cycles) or (course.relay.switches >= _FOLLOWS and course.answers)
        # A constant measurement is no response at all; a saturated one still is.
        moved = self._has_moved()
        if self._is_doubtful and not follows and moved:
            self._is_doubtful = False
            self._run.notes.append(Code.NOTE_SIGN(sign=_SIGNS[self._run.facts.sign]))
            self._run.facts.sign *= -1
            # What one level drove away takes as long to come back, and longer with a bias.
            load.waits_from = t + (t - course.relay.since) / levels.balance
            self._begin()
            return None
        if levels.can_grow:
            levels.grow()
            self._begin()
            return None
        if follows and moved and load.may_push():
            # It did oscillate before: a load may be too large for one of the levels.
            before = self.command
            load.push(1 if course.is_high else -1)
            if self.command != before:
                load.pushed(t, self._limit)
                return None
        return self._why_lost(t, y)

    def _has_moved(self) -> bool:
        """Return True unless the measurement stands still since the command last changed."""
        _, y = self._since(max(self._course.relay.since, self._load.at))
        return len(y) < _SHOWS or bool(y.max() > y.min())

    def _since(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Return time and measurement since an instant."""
        trace = self._run.trace
        return trace.columns(bisect_left(trace.seen, time), len(trace))[:2]

    def _why_lost(self, t: float, y: float) -> Reason:
        relay, facts = self._course.relay, self._run.facts
        values: dict[str, Value] = {
            "cycles": len(self._run.cycles),
            "value": y,
            "setpoint": facts.setpoint,
            "hysteresis": facts.hysteresis,
            "time": t - relay.since,
            "sign": _SIGNS[facts.sign],
        }
        if self._load.compensated >= MOST_COMPENSATED:
            values["shifted"] = self._load.compensated
        if not self._has_moved():
            return Code.NO_ANSWER(**values)
        time, measurement = self._since(relay.since)
        towards = facts.sign if relay.is_high else -facts.sign
        return why_no_return(time, towards * measurement, facts.rest.noise_std, **values)

    # Cycles.

    def _begin_cycle(self) -> Reason | None:
        """Take the begin of a cycle, which ends the one before."""
        course, run, p = self._course, self._run, self._run.parameters
        run.cycle_start += (len(run.trace) - 1,)
        if len(run.cycle_start) < 2:
            course.fast.forget_cycle(run.switches)
            return None
        grown, clipped = self._has_grown()
        if clipped or grown:
            course.fast.forget_cycle(run.switches)
            return clipped
        cycle = self._cycle_that_ended()
        was_lost, course.is_lost = course.is_lost, False
        if was_lost:
            cycle = replace(cycle, disturbed=True)
        run.cycles += (cycle,)
        for watch in _OF_CYCLES:
            if why := watch(self):
                return why
        n = len(run.cycles)
        agreed: dict[str, Value] = {"percent": 100.0 * p.cycle_tolerance}
        if run.until_converged and cycle.converged:
            which = f"{n}" if n == p.min_cycles else f"the last {p.min_cycles} of {n}"
            return self._complete(Code.CYCLES_AGREE(which=which, cycles=n, **agreed))
        if n + course.stays.lost >= p.max_cycles:
            more = {"needed": p.min_cycles, **agreed} if run.until_converged else {}
            return self._complete(Code.MAX_CYCLES(most=p.max_cycles, cycles=n, **more))
        self._furthest = _RUNAWAY * max(cycle.amplitude for cycle in run.cycles)
        # A cycle much longer than the one before may hold an actuator that stuck; a load would
        # show in the next cycle, too.
        is_alone = n > 1 and cycle.period > _ALONE * run.cycles[-2].period
        if not (was_lost or is_alone) and self._load.shows_in(run.cycles[-2:]):
            run.cycles = (*run.cycles[:-1], replace(cycle, disturbed=True))
        return None

    def _has_grown(self) -> tuple[bool, Reason | None]:
        """Make an amplitude that is not given larger if the last cycle was too small.

        :return: whether it did, and why the actuator must be at its ends.
        """
        run, facts, levels = self._run, self._run.facts, self._run.levels
        if not levels.searching:
            return False, None
        swing, clear, y = self._last_swing()
        least = sought_swing(run.parameters, facts.rest.noise_std, facts.setpoint, y)
        if not levels.from_small and (why := levels.why_clipped(swing, settled=False)):
            return False, why
        levels.note_small(swing, clear)
        factor = levels.growth_for(swing.half, least)
        if factor is not None:
            levels.grow(factor)
            run.cycle_start = run.cycle_start[-1:]
            return True, None
        if swing.half < least and not levels.from_small:
            run.notes.append(
                Code.NOTE_SMALL(amplitude=levels.amplitude, swing=swing.half, least=least)
            )
        levels.searching = False
        return False, None

    def _last_swing(self) -> tuple[Swing, float, FloatArray]:
        """Return the swing of the last cycle, half of the least clear one, and its samples."""
        run = self._run
        first, last = run.cycle_start[-2:]
        time, y, _ = run.trace.columns(first, last + 1)
        clear = clear_swing(run.parameters, run.facts.rest.noise_std, y)
        return Swing(0.5 * float(y.max() - y.min()), float(time[-1] - time[0])), clear, y

    def _cycle_that_ended(self) -> Cycle:
        run, p = self._run, self._run.parameters
        first, last = run.cycle_start[-2:]
        cycle = cycle_from_samples(
            len(run.cycles),
            *run.trace.columns(first, last + 1),
            middle=run.baseline + run.levels.bias,
            reverse_acting=run.facts.sign < 0,
        )
        interval = cycle.period / (last - first)
        noise = run.facts.rest.noise_std
        return next_cycle(run.cycles, cycle, interval, noise, p.min_cycles, p.cycle_tolerance)

    # What a cycle shows.

    def _too_fast(self, period: float, usual: float) -> Reason | None:
        """Return a reason if a period is too short compared with the usual one."""
        if period >= _FAST * usual:
            return None
        return Code.FAST_CYCLES(half=0.5 * period, cycles=len(self._run.cycles), usual=usual)

    def _fast_cycles(self) -> Reason | None:
        last = max(c.period for c in self._run.cycles[-_FAST_CYCLES:])
        return self._too_fast(
            last, self._course.usual or usual_period(self._run.cycles[:-_FAST_CYCLES])
        )

    def _chatter(self) -> Reason | None:
        return self._course.fast.cycle(self._run.switches, len(self._run.cycles))

    def _growth(self) -> Reason | None:
        growing = is_growing([cycle.amplitude for cycle in self._run.cycles])
        return Code.GROWING(cycles=len(self._run.cycles)) if growing else None

    def _clipped(self) -> Reason | None:
        """Return why the actuator is at its ends, once the swing grows no more."""
        levels = self._run.levels
        if not (levels.from_small and self._run.is_tried):
            return None
        before, last = (Swing(cycle.amplitude, cycle.period) for cycle in self._run.cycles[-2:])
        grows = last.half > _STILL * before.half
        return None if grows else levels.why_clipped(last, settled=True)

    def _only_noise(self, least: int = TELL) -> Reason | None:
        """Return why the last cycles are no oscillation, None if they may be one.

        :param least: number of samples needed for a decision before MIN_CYCLES cycles.
        """
        count = len(self._run.cycles)
        last_cycles = self._run.cycle_start[-min(count, MIN_CYCLES) - 1 :]
        first, last = last_cycles[0], last_cycles[-1]
        few = count < MIN_CYCLES and last - first < least
        return None if few else self._noise_alone(first, last)

    def _noise_alone(self, first: int, last: int) -> Reason | None:
        """Return why the samples first to last - 1 are no oscillation, None if they may be one."""
        run = self._run
        measurement = run.trace.columns(first, last)[1]
        return why_noise_alone(measurement, run.facts.rest.noise_std, len(run.cycles))

    def _complete(self, why: Reason) -> Reason:
        """Complete, unless the last cycles may be noise alone."""
        run, levels = self._run, self._run.levels
        if noise := self._only_noise(1):
            return noise
        if levels.from_small and not levels.grew_enough:
            reach: dict[str, Value] = {"low": levels.low, "high": levels.high}
            swing, clear, _ = self._last_swing()
            # A quarter of this swing would have stood clear of the noise.
            if not run.cycles[-1].converged or swing.half > _CLEARLY * clear:
                return Code.REACH_UNKNOWN(**reach, **why.values)
            run.notes.append(Code.NOTE_REACH(**reach))
        if disturbed := sum(cycle.disturbed for cycle in run.cycles):
            run.notes.append(Code.NOTE_DISTURBED(disturbed=disturbed, cycles=len(run.cycles)))
        return why


_OF_CYCLES: tuple[Callable[[Switching], Reason | None], ...] = (
    Switching._fast_cycles,
    Switching._chatter,
    Switching._growth,
    Switching._only_noise,
    Switching._clipped,
)
"""What is looked for at the end of each cycle, in this order."""
