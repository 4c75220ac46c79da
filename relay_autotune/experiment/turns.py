"""Which switches of the relay begin a cycle, and what it does when none can be told."""

from __future__ import annotations

# A stay at the low level shorter than this part of the longest stay (less, in proportion to how
# unequally a biased relay pushes), or of half the time that the process took to respond, cannot be
# an answer of the process: it is noise at a switch, and no cycle begins after it.
SHORT_STAY = 0.2

# A cycle takes about two of the longest stays. Where the relay has switched for so many of them
# without one, the longest is not what the process takes; nor can it be told from fewer samples.
OVERDUE = 3.0
OVERDUE_SAMPLES = 200
# A stay so many times as long as the longest before begins this time anew.
_MUCH_LONGER = 2.0


class Turns:
    """Tell an answer of the process from noise at a switch, by how long the relay stayed.

    One stay that is much longer than those after it (an actuator that sticks for a moment, a load
    that goes again) would make noise of all of them. So where no cycle has begun for three times
    the longest stay, and 200 samples, and the relay has gone on switching, the longest stay is
    forgotten, and that of this time takes its place. After a cycle, a stay that is twice as long
    as all before does not count for these three times.

    :param time: instant from which the relay acts [s].
    :param response_time: time that the process took to respond to the kick [s].
    """

    def __init__(self, time: float, response_time: float) -> None:
        self.longest = 0.0
        """The longest stay between two switches, of those that count [s]."""
        self.lost = 0
        """How often the longest stay was learned anew."""
        self.lost_for = 0.0
        """How long no cycle had begun when it was, the last time [s]."""
        self._least = 0.5 * response_time
        self._usual = 0.0
        self._has_begun = False
        self._begun = 0
        self._since = time
        self._recent = 0.0

    def add(self, time: float, stay: float, balance: float, *, is_first: bool) -> bool:
        """Take a stay that has ended; return True if it can be an answer of the process.

        :param time: when it ended [s].
        :param stay: how long it was [s].
        :param balance: the shorter of two stays of a biased relay over the longer one.
        :param is_first: True for the stay before the first switch, which begins anywhere.
        """
        if not is_first:
            self._recent = max(self._recent, stay)
            if stay > _MUCH_LONGER * self.longest:
                # What it may hide comes after it.
                if self._has_begun:
                    self._usual, self._begun = self._usual or self.longest, 0
                self._since, self._recent = time, 0.0
            self.longest = max(self.longest, stay)
        return stay >= SHORT_STAY * max(balance * self.longest, self._least)

    def begin(self, time: float) -> None:
        """Note that a cycle begins [s]."""
        self._since, self._recent, self._has_begun = time, 0.0, True
        self._begun += 1
        if self._begun > 1:
            # The process takes so long now.
            self._usual = 0.0

    def is_overdue(self, time: float, interval: float) -> bool:
        """Return True, and learn the longest stay anew, if a cycle should have begun.

        :param time: instant of a switch at which none begins [s].
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
