# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A sensor that publishes only on change: the meaning of its silence."""

from __future__ import annotations

import math

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
