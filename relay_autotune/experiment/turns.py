# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Which switches of the relay begin a cycle, and what to do when no cycle is clear."""

from __future__ import annotations

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


class Turns:
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
