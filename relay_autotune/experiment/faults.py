# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What ends an experiment: faults of the sensor, of its clock and of the process.

Each watch takes samples and returns a reason to end. The last part is the command after the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.reasons import Code, Reason, Value
from relay_autotune.record.record import Cycle, RelaySettings

# If less than this part of the samples at rest equals the one before, the noise changes every
# sample, and this many equal samples in a row cannot be chance.
_RARELY_EQUAL = 0.05
_FROZEN_SAMPLES = 20
# Otherwise the run of equal samples is compared with the longest run of the cycles before.
_FROZEN_RATIO = 3.0

# Samples needed for the difference of the clocks; smallest step that counts [s]; time after which
# a larger difference is a step and not a delay [s]; part of a drift that is followed at a sample.
_STEP_SAMPLES = 10
_STEP_LEAST = 0.05
_STEP_LASTS = 1.0
_FOLLOWED = 1e-3


class FrozenWatch:
    """Recognise a sensor that repeats one value.

    A sensor with noise is frozen after 20 equal samples. If equal samples are normal (a coarse
    resolution, a slow converter, a process without noise), it is judged after the first whole
    cycle: it is frozen after three times the longest run of equal samples so far plus 20 samples.
    """

    def __init__(self) -> None:
        self._last = math.nan
        self._pairs = self._equal = 0
        self.run = 1
        """Number of equal samples, the last one included."""
        self._longest = 1
        self._noisy = False

    def add(self, measurement: float, *, at_rest: bool, in_cycles: bool) -> bool:
        """Take a sample; return True if the sensor is frozen.

        :param measurement: the sample [y].
        :param at_rest: True before the kick.
        :param in_cycles: True once a whole cycle was seen.
        """
        same = measurement == self._last
        self._last = measurement
        if at_rest:
            self._pairs += 1
            self._equal += same
        if not same:
            if not at_rest:
                self._longest = max(self._longest, self.run)
            self.run = 1
            self._noisy = (
                self._pairs > _FROZEN_SAMPLES and self._equal < _RARELY_EQUAL * self._pairs
            )
            return False
        self.run += 1
        if self._noisy:
            return self.run > _FROZEN_SAMPLES
        return in_cycles and self.run > _FROZEN_SAMPLES + _FROZEN_RATIO * self._longest


class ClockWatch:
    """Recognise a step between the clock that stamps samples and the clock that receives them.

    The delay of a sample varies, and a busy machine may delay many of them. But no sample arrives
    before it was sent, and a backlog is soon worked off. So a drop of receive minus source time is
    a step at once; a rise is a step if it lasts for a second and 10 samples.
    """

    def __init__(self) -> None:
        self._first: list[float] = []
        self._begin = self._reference = math.nan
        self._late_since = math.nan
        self._late = 0

    @property
    def drift(self) -> float:
        """Change of the difference of the clocks since the start [s]."""
        return 0.0 if math.isnan(self._begin) else self._reference - self._begin

    def add(self, source: float, receive: float) -> Reason | None:
        """Take the two times of a sample; return a reason if a clock has stepped.

        :param source: when it was taken, on the sensor's clock [s].
        :param receive: when it arrived, on our clock [s].
        """
        difference = receive - source
        if len(self._first) < _STEP_SAMPLES:
            self._first.append(difference)
            self._begin = self._reference = min(self._first)
            return None
        moved = difference - self._reference
        if moved > _STEP_LEAST:
            if self._late == 0:
                self._late_since = receive
            self._late += 1
            lasting = receive - self._late_since > _STEP_LASTS and self._late >= _STEP_SAMPLES
            return self._stepped(difference) if lasting else None
        self._late = 0
        if moved < -_STEP_LEAST:
            return self._stepped(difference)
        # A drift is followed, a step is not.
        self._reference += moved if moved < 0.0 else _FOLLOWED * moved
        return None

    def _stepped(self, difference: float) -> Reason:
        return Code.CLOCK_STEPPED(before=self._reference, now=difference)


# A silence is too long if it exceeds a multiple of the longest one while the relay switched, a
# number of repetitions, and a whole period.
_SILENT_RATIO = 3.0
_SILENT_REPETITIONS = 20


class Repetition:
    """Decide when the last measurement counts as a new sample.

    For a sensor that publishes only on change, silence means that the value has not changed. So
    the value counts as a new sample after each period of silence.

    :param period: the silence before a repetition [s], > 0.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.value = math.nan
        """The last measurement [y]; NaN before the first."""
        self._since = math.nan

    @property
    def is_heard(self) -> bool:
        """True after the first measurement."""
        return not math.isnan(self._since)

    def hear(self, now: float, value: float) -> None:
        """Take a received measurement.

        :param now: the time [s].
        :param value: [y].
        """
        self.value = value
        self._since = now

    def wait(self, now: float) -> float:
        """Return the time until the next repetition [s]; 0: now; the period before a measurement.

        If the clock has gone back it is 0, so that the consumer of the sample sees the step.

        :param now: the time [s].
        """
        if now < self._since:
            return 0.0
        return max(self._since + self.period - now, 0.0) if self.is_heard else self.period

    def repeat(self, now: float) -> float:
        """Return the value as a sample of now [y].

        :param now: the time [s].
        """
        self._since = now
        return self.value


class SilenceWatch:
    """Distinguish a dead sensor from one whose value has not changed.

    At rest any silence is allowed. While the relay switches, the measurement must move: after the
    first whole cycle, a silence is too long if it exceeds the longest cycle, three times the
    longest silence since the relay began, and 20 repetitions. Before that cycle, the relay's own
    time limit applies.
    """

    def __init__(self) -> None:
        self._last = math.nan
        self._heard = math.nan
        self._longest = 0.0
        self._repetitions = 0
        self.repeated = 0
        """Number of repeated samples."""
        self.silence = 0.0
        """Time since the sensor's last message [s]."""

    def hear(self, time: float, *, relaying: bool) -> None:
        """Take a received sample.

        :param time: its instant [s].
        :param relaying: True if the relay switches.
        """
        if relaying:
            # The silence before the first message began at rest, so it does not count.
            if not math.isnan(self._heard):
                self._longest = max(self._longest, time - self._heard)
            self._heard = time
        self._last = time
        self._repetitions = 0
        self.silence = 0.0

    def repeat(self, time: float, *, longest_cycle: float) -> bool:
        """Take a repeated sample; return True if the sensor has been silent too long.

        :param time: its instant [s].
        :param longest_cycle: the longest period so far [s]; inf before the first whole cycle.
        """
        self.repeated += 1
        self._repetitions += 1
        if math.isnan(self._last):
            self._last = time
        self.silence = time - self._last
        longest = max(_SILENT_RATIO * self._longest, longest_cycle)
        return self._repetitions > _SILENT_REPETITIONS and self.silence > longest


# The swings grow like an unstable loop's after this many steps, each larger than the one before by
# a factor, to a multiple of the first swing. In the transient of a stable loop the steps become
# smaller.
_STEPS = 3
_FASTER = 1.15
_LARGER = 3.0

# Growth is exponential if a step by this factor takes no longer than a step some steps earlier,
# with a tolerance. The initial response of eight lags, t^8, takes 1.7 times as long. Steps with
# fewer samples are too short to decide.
_STEP, _LEAST_STEPS, _APART, _NO_LONGER = 8.0, 4, 2, 1.1
_SAMPLES = 10
# A distance that falls below this part of its maximum has stopped growing.
_FALLEN = 0.05

# A measurement is level if in its last third it moves by less than this part of its whole way.
_LEVEL = 0.03
# A measurement has not come back if it is within this part of its way from its extreme.
_BACK = 0.1


class RunawayWatch:
    """Recognise exponential growth: an unstable process that the relay cannot hold.

    Before the first cycle no distance of the process is known as "far". But the response of a
    stable process multiplies more and more slowly.

    :param floor: distance from which steps count [y]; 0: from the first distance above zero.
    """

    def __init__(self, floor: float) -> None:
        self._floor = floor
        self._next = _STEP * floor
        self._passed: list[float] = []
        self._samples = 0
        self._above = False

    def add(self, time: float, distance: float) -> bool:
        """Take a sample; return True if it runs away.

        :param time: its instant [s].
        :param distance: from the set-point, positive or negative [y].
        """
        away = abs(distance)
        self._samples += 1
        if (distance > 0.0) != self._above:
            # A measurement that changes sides follows the relay. And just after a passage
            # through zero, the distance of any process multiplies fast.
            self._above = not self._above
            self._passed.clear()
        if away < self._next:
            if away < _FALLEN * self._next:
                self._passed.clear()
                self._next = _STEP * self._floor
            return False
        # Only one step for each sample, so that a spike of the sensor counts as one.
        self._passed.append(time)
        self._next = _STEP * (self._next or away)
        samples, self._samples = self._samples, 0
        if len(self._passed) <= _LEAST_STEPS or samples < _SAMPLES:
            return False
        before, begin = self._passed[-1 - _APART], self._passed[-2 - _APART]
        last = self._passed[-1] - self._passed[-2]
        return last <= _NO_LONGER * (before - begin)


def why_no_return(
    time: FloatArray, towards: FloatArray, noise_std: float, /, **facts: Value
) -> Reason:
    """Return what the measurement did while the relay stayed at one level.

    :param time: instants of the samples of that stay [s], shape (n,).
    :param towards: the samples, times 1 if the relay pushed upwards and -1 if downwards [y],
        shape (n,).
    :param noise_std: standard deviation of the noise [y].
    :param facts: for the sentence of the reason.
    """
    edges = time[0] + (time[-1] - time[0]) * np.array([1.0, 2.0]) / 3.0
    thirds = np.split(towards, np.searchsorted(time, edges))
    if min(map(len, thirds)) == 0:
        return Code.TOO_FEW_SAMPLES(**facts)
    first, second, third = (float(part.mean()) for part in thirds)
    whole = float(towards.max() - towards.min())
    still = 3.0 * noise_std / min(len(part) for part in thirds) ** 0.5
    level = max(_LEVEL * whole, still)
    # It may first swing further out; the question is whether it came back from there.
    way_back = float(towards[-1] - towards.min())
    away = way_back <= max(_BACK * whole, level, 6.0 * noise_std)
    if away and third - float(towards[0]) < -level:
        if second - third > first - second > 0.0:
            facts["faster"] = "faster and faster"
        rests = abs(third - second) <= level
        return (Code.MOVED_AWAY_LOAD if rests else Code.MOVED_AWAY_UNSTABLE)(**facts)
    return (Code.SATURATED if abs(third - second) <= level else Code.TOO_SLOW)(**facts)


def is_growing(swings: Sequence[float]) -> bool:
    """Return True if the swings of the cycles grow like those of an unstable loop.

    :param swings: of each cycle so far, in one measure [y].
    """
    last = swings[-(_STEPS + 1) :]
    if len(last) <= _STEPS or last[0] <= 0.0 or last[-1] < _LARGER * last[0]:
        return False
    steps = [b - a for a, b in pairwise(last)]
    return steps[0] > 0.0 and all(b >= _FASTER * a for a, b in pairwise(steps))


# Least ratio of the samples' standard deviation to the noise's for an oscillation. A relay without
# a process switches on noise, too, and some of its cycles agree in the end.
_ABOVE_NOISE = 1.5

TELL = 50
"""Number of samples for this decision before there are enough cycles."""


def why_noise_alone(measurement: FloatArray, noise_std: float, cycles: int) -> Reason | None:
    """Return why samples are no oscillation, None if they may be one.

    :param measurement: the samples [y], shape (n,).
    :param noise_std: standard deviation of the noise at rest [y].
    :param cycles: their number so far.
    """
    spread = float(measurement.std())
    if spread >= _ABOVE_NOISE * noise_std:
        return None
    return Code.NOISE_ALONE(cycles=cycles, spread=spread, noise=noise_std)


# Half the ultimate gain: the quarter-decay margin of Ziegler and Nichols for proportional control.
HOLD_SHARE = 0.5


@dataclass(frozen=True)
class SafePolicy:
    """How the process is left when an experiment ends.

    :param command: command after an abort or a failure [u]; NaN: the baseline.
    :param hold: True for a process that drifts or runs away at a constant command (integrating or
        unstable): proportional control holds it as soon as its ultimate gain is roughly known, or
        from the kick on if ``gain`` is given.
    :param gain: gain of that proportional control [u/y]; 0: half of the ultimate gain.
    :param give_back: True if another controller takes over at once at any end; the experiment's
        ``safe_command`` then follows that controller's command.
    """

    command: float = math.nan
    hold: bool = False
    gain: float = 0.0
    give_back: bool = False


def proportional_hold(
    settings: RelaySettings | None, cycles: Sequence[Cycle], gain: float
) -> Callable[[float], float] | None:
    r"""Return proportional control about the set-point, ``u = u0 + k (r - y)``, within limits.

    k is half of the describing function's ultimate gain ``4 mu/(pi a)``, where a is half the
    swing of the measurement, with the sign of the process; u0 is the mean command of the last
    cycle, which balanced the process.

    :param settings: the relay's settings; its levels are the limits.
    :param cycles: the cycles so far.
    :param gain: a gain that the user gave [u/y]; 0: none.
    :return: the command [u] for a measurement [y]: u0 if that is not finite. None: k is not known.
    """
    if settings is None:
        return None
    centre = settings.baseline
    if cycles:
        last = cycles[-1]
        centre = last.mean_command
        if gain == 0.0 and last.amplitude > 0.0:
            gain = HOLD_SHARE * 4.0 * settings.amplitude / (math.pi * last.amplitude)
            gain = -gain if settings.reverse_acting else gain
    if gain == 0.0:
        return None

    def command(measurement: float) -> float:
        if not math.isfinite(measurement):
            return centre
        wanted = centre + gain * (settings.setpoint - measurement)
        return min(max(wanted, settings.low), settings.high)

    return command
