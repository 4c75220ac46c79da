# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The relay: when it switches, and how long it waits for the measurement to come back."""

from __future__ import annotations

import math


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


class Patience:
    """How long a relay may stay at one level before the measurement counts as lost.

    The limit is :data:`RATIO` times the longest stay so far, or times the time to respond if that
    is longer. A biased relay gets more time, in proportion to the ratio of its two steps. The
    limit is at least :data:`LEAST_SAMPLES` samples: without noise, the response of a high-order
    process is seen at the first sample, and takes hundreds of samples to turn.

    :param amplitude: half the distance of the levels [u].
    :param bias: offset of their middle from the baseline [u], smaller than the amplitude.
    """

    RATIO = 10.0
    LEAST_SAMPLES = 200

    def __init__(self, amplitude: float, bias: float) -> None:
        self._longest = 0.0
        self._ratio = self.RATIO * (amplitude + abs(bias)) / (amplitude - abs(bias))
        self.limit = math.inf
        """Limit of the present stay [s]."""

    def forget(self, longest: float) -> None:
        """Replace the longest stay so far [s]."""
        self._longest = longest

    def learn(self, stay: float, interval: float) -> None:
        """Set the limit of the new stay from the stay that has ended.

        :param stay: length of the ended stay, or at the beginning the time that the process took
            to respond to the kick [s].
        :param interval: mean sample interval [s].
        """
        self._longest = max(self._longest, stay)
        self.limit = max(self._ratio * self._longest, self.LEAST_SAMPLES * interval)
