# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Why a measurement does not come back to the relay, or does not oscillate: what it did."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from relay_autotune.arrays import FloatArray
from relay_autotune.record.record import Cycle

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

NO_ANSWER = (
    "it does not respond: it has stood still since the command last changed; check the sensor, "
    "and that the actuator follows"
)
"""Sentence for a measurement that did not move."""


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


def why_no_return(time: FloatArray, towards: FloatArray, noise_std: float) -> str:
    """Return what the measurement did while the relay stayed at one level, and a remedy.

    :param time: instants of the samples of that stay [s], shape (n,).
    :param towards: the samples, times 1 if the relay pushed upwards and -1 if downwards [y],
        shape (n,).
    :param noise_std: standard deviation of the noise [y].
    """
    thirds = [part for part in _thirds(time, towards) if len(part)]
    if len(thirds) < 3:
        return "there are too few samples to say why: check the sensor's rate"
    first, second, third = (float(part.mean()) for part in thirds)
    whole = float(towards.max() - towards.min())
    still = 3.0 * noise_std / min(len(part) for part in thirds) ** 0.5
    level = max(_LEVEL * whole, still)
    # It may first swing further out; the question is whether it came back from there.
    way_back = float(towards[-1] - towards.min())
    away = way_back <= max(_BACK * whole, level, 6.0 * noise_std)
    if away and third - float(towards[0]) < -level:
        faster = " faster and faster" if second - third > first - second > 0.0 else ""
        rests = abs(third - second) <= level
        other = (
            "a load has come that the relay cannot compensate"
            if rests
            else "the process is unstable and the amplitude too small to hold it"
        )
        return (
            f"it moved away{faster}, against the relay's push: process_gain_sign may be wrong, "
            f"the process was not at rest at the start, or {other}"
        )
    if abs(third - second) <= level:
        return (
            "the response saturates before the relay's band: the amplitude may be too small for "
            "the hysteresis or the set-point, a load may have come, or the actuator is at its end"
        )
    return (
        "it moves towards the band, but too slowly for what was seen before: give a larger "
        "amplitude or max_half_cycle, and let the process rest before the start"
    )


def has_moved(measurement: FloatArray) -> bool:
    """Return True if a measurement has changed at all, or has too few samples to decide.

    :param measurement: the samples since the command last changed [y], shape (n,).
    """
    return len(measurement) < _SAMPLES or bool(measurement.max() > measurement.min())


def _thirds(time: FloatArray, values: FloatArray) -> list[FloatArray]:
    begin, span = float(time[0]), float(time[-1] - time[0])
    edges = [begin + k * span / 3.0 for k in (1, 2)]
    early, late = time < edges[0], time >= edges[1]
    return [values[early], values[~early & ~late], values[late]]


def is_growing(swings: Sequence[float]) -> bool:
    """Return True if the swings of the cycles grow like those of an unstable loop.

    :param swings: peak to peak of each cycle so far [y].
    """
    last = swings[-(_STEPS + 1) :]
    if len(last) <= _STEPS or last[0] <= 0.0 or last[-1] < _LARGER * last[0]:
        return False
    steps = [b - a for a, b in pairwise(last)]
    return steps[0] > 0.0 and all(b >= _FASTER * a for a, b in pairwise(steps))


def count_cycles(cycles: list[Cycle]) -> str:
    """Return the number of cycles in words."""
    return f"{len(cycles)} whole cycle{'' if len(cycles) == 1 else 's'}"


# Least ratio of the samples' standard deviation to the noise's for an oscillation. A relay without
# a process switches on noise, too, and some of its cycles agree in the end.
_ABOVE_NOISE = 1.5

TELL = 50
"""Number of samples for this decision before there are enough cycles."""


def why_noise_alone(measurement: FloatArray, noise_std: float, after: str) -> str:
    """Return why samples are no oscillation, "" if they may be one.

    :param measurement: the samples [y], shape (n,).
    :param noise_std: standard deviation of the noise at rest [y].
    :param after: number of cycles, in words.
    """
    spread = float(measurement.std())
    if spread >= _ABOVE_NOISE * noise_std:
        return ""
    return (
        f"no oscillation after {after}, only noise: the measurement's standard deviation is "
        f"{spread:.3g}, that of its noise at rest {noise_std:.3g}; give a larger amplitude, or "
        "check that the actuator follows its command"
    )
