"""The relay itself: when it switches, and how long it waits for the measurement to come back."""

from __future__ import annotations

import math


class Relay:
    """A relay with hysteresis.

    Direct-acting (sign 1), it goes low when the measurement rises to ``setpoint + hysteresis``
    and high when it falls to ``setpoint - hysteresis``; reverse-acting (sign -1), it does the
    opposite. Without hysteresis the measurement has to pass the set-point: a quantised one may
    rest on it.

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
        # In the measurement times the sign a high command pushes upwards always, so that one
        # rule serves both actions.
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
    """How long a relay may stay at one level before the measurement is taken for lost.

    That is :data:`RATIO` times the longest stay so far, or the time that the process took to
    respond where that is longer, and more in proportion to how unequally a biased relay pushes
    to its two sides; but never less than :data:`LEAST_SAMPLES` samples, since without noise a
    process of high order is seen to respond at the first sample and takes hundreds to turn.

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
        """Take another stay for the longest one so far [s]."""
        self._longest = longest

    def learn(self, stay: float, interval: float) -> None:
        """Set the limit of the stay that begins, from the one that ended.

        :param stay: how long the relay was at the level before, or, to begin with, the time that
            the process took to respond to the kick [s].
        :param interval: mean sample interval [s].
        """
        self._longest = max(self._longest, stay)
        self.limit = max(self._ratio * self._longest, self.LEAST_SAMPLES * interval)
