"""A sensor that speaks only when its value changes: what its silence says."""

from __future__ import annotations

import math

# A silence is too long that lasts so many times the longest one while the relay switched, and so
# many repetitions, and a whole period at least.
_SILENT_RATIO = 3.0
_SILENT_REPETITIONS = 20


class Repetition:
    """Tell when the last measurement is to be taken again.

    A sensor that speaks only when its value changes says by its silence that the value has not
    changed; so the value is a sample again after each period of silence.

    :param period: the silence after which it is [s], > 0.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.value = math.nan
        """The last measurement [y]; NaN: none has come."""
        self._since = math.nan

    @property
    def is_heard(self) -> bool:
        """True once a measurement has come."""
        return not math.isnan(self._since)

    def hear(self, now: float, value: float) -> None:
        """Take a measurement that has come.

        :param now: the time [s].
        :param value: [y].
        """
        self.value = value
        self._since = now

    def wait(self, now: float) -> float:
        """Return the time until the value is to be repeated [s]; 0: now; the period: unheard.

        A clock that has gone back makes it 0, so that who takes the sample gets to know.

        :param now: the time [s].
        """
        if now < self._since:
            return 0.0
        return max(self._since + self.period - now, 0.0) if self.is_heard else self.period

    def repeat(self, now: float) -> float:
        """Return the value, which is a sample now [y].

        :param now: the time [s].
        """
        self._since = now
        return self.value


class SilenceWatch:
    """Recognise a sensor that has died, among silences that only say that nothing has changed.

    At rest any silence is in order. While the relay switches the measurement has to move: from
    the first whole cycle on, a silence is too long that lasts the longest cycle, three times the
    longest silence since the relay began, and more than 20 repetitions. Before, the relay's own
    patience judges.
    """

    def __init__(self) -> None:
        self._last = math.nan
        self._heard = math.nan
        self._longest = 0.0
        self._repetitions = 0
        self.repeated = 0
        """Number of samples that were repeated."""
        self.silence = 0.0
        """Time since the sensor spoke last [s]."""

    def hear(self, time: float, *, relaying: bool) -> None:
        """Take a sample that has come.

        :param time: its instant [s].
        :param relaying: True if the relay switches.
        """
        if relaying:
            # The first time that it speaks says nothing of how long it was silent at rest.
            if not math.isnan(self._heard):
                self._longest = max(self._longest, time - self._heard)
            self._heard = time
        self._last = time
        self._repetitions = 0
        self.silence = 0.0

    def repeat(self, time: float, *, longest_cycle: float) -> bool:
        """Take a sample that was repeated; return True if the sensor has been silent too long.

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
