# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""When to fit a running experiment, and whether its result is accurate enough to end it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from relay_autotune.errors import ParameterError
from relay_autotune.quantities import NORMAL_95, result_field
from relay_autotune.reasons import Code, Reason

if TYPE_CHECKING:
    from relay_autotune.experiment.experiment import RelayExperiment

ULTIMATE_GAIN, MS = "ultimate_gain", "ms"
SOUGHT = (ULTIMATE_GAIN, MS)
_NAMES = {ULTIMATE_GAIN: "K_u", MS: "the predicted Ms"}

# Ms is at least 1; a value below by rounding is accepted.
_LEAST_MS = 1.0 - 1e-6
# Nothing is concluded before the first half cycle.
_LEAST_SWITCHES = 2
# Least and largest growth of the time since the kick between two fits. In between, the growth
# assumes that the interval narrows with the cube of that time at most.
_LEAST_GROWTH, _MOST_GROWTH = 1.02, 1.15
_STEEPNESS = 3.0


@dataclass(frozen=True)
class FitProgress:
    """Result of the newest fit of a running experiment; NaN: not estimated.

    :raises ParameterError: if a number is outside its possible range.
    """

    ultimate_gain: float = result_field("u/y", math.nan)
    """K_u."""
    ultimate_gain_std: float = result_field("u/y", math.nan)
    """Its standard deviation."""
    ms: float = result_field("", math.nan)
    """Ms that the gains designed on the model would have."""
    ms_low: float = result_field("", math.nan)
    """Lower end of its 95 % interval."""
    ms_high: float = result_field("", math.nan)
    """Upper end; inf: some of the loops would be unstable."""

    def __post_init__(self) -> None:
        problem = ""
        if math.isinf(self.ultimate_gain):
            problem = f"K_u is {self.ultimate_gain:g}, expected a finite number"
        elif self.ultimate_gain_std < 0.0:
            problem = f"the standard deviation of K_u is {self.ultimate_gain_std:g}, expected >= 0"
        elif self.ms < _LEAST_MS or math.isinf(self.ms):
            problem = f"the predicted Ms is {self.ms:g}, expected a finite number of at least 1"
        elif self.ms_low > self.ms_high or self.ms_low < _LEAST_MS:
            problem = (
                f"the predicted Ms is between {self.ms_low:g} and {self.ms_high:g}, expected two "
                "numbers of at least 1, the lower one first"
            )
        if problem:
            raise ParameterError(f"{problem}: nothing is concluded from it")

    def width(self, sought: str) -> float:
        """Return half the width of a 95 % interval over the value; NaN: not estimated.

        :param sought: one of ``SOUGHT``.
        """
        if sought == ULTIMATE_GAIN:
            value, half = abs(self.ultimate_gain), NORMAL_95 * self.ultimate_gain_std
        else:
            value, half = self.ms, 0.5 * (self.ms_high - self.ms_low)
        return half / value if value > 0.0 and half >= 0.0 else math.nan


class EarlyEnd:
    """End an experiment once an interval is as narrow as wanted.

    Each look is a fit of the whole record. The next look comes when the time since the kick has
    grown by a factor that depends on the interval's present width, or at a switch of the relay
    after the least growth. So the number of looks grows only with the logarithm of the duration,
    and does not depend on the sampling rate.

    :param sought: which interval, one of ``SOUGHT``.
    :param wanted: its half width, as a fraction of the value.
    """

    def __init__(self, sought: str, wanted: float) -> None:
        self.sought, self.wanted = sought, wanted
        self._switches = 0
        self._last = 0.0
        self._waits = False
        self._growth = _MOST_GROWTH

    def is_due(self, running: RelayExperiment) -> bool:
        """Return True if it is time for the next look.

        Looks begin after the first half cycle. Between switches, the next one comes when the last
        look was answered and enough time has passed.

        :param running: the experiment.
        """
        if running.switches < _LEAST_SWITCHES:
            return False
        since = running.elapsed - running.facts.kicked_at
        if running.switches != self._switches:
            return since >= _LEAST_GROWTH * self._last
        return not self._waits and since >= self._growth * self._last

    def look(self, running: RelayExperiment) -> None:
        """Note a look now.

        :param running: the experiment.
        """
        self._switches = running.switches
        self._last = running.elapsed - running.facts.kicked_at
        self._waits = True

    def judge(self, running: RelayExperiment, found: FitProgress) -> Reason | None:
        """Take the answer to a look; return why the experiment may end, None if it may not.

        :param running: the experiment.
        :param found: result of its newest fit.
        """
        width = found.width(self.sought)
        ratio = width / self.wanted if width > 0.0 else math.inf
        growth = ratio ** (1.0 / _STEEPNESS) if ratio > 1.0 else 1.0
        self._growth = min(max(growth, _LEAST_GROWTH), _MOST_GROWTH)
        self._waits = False
        if not width <= self.wanted or running.switches < _LEAST_SWITCHES:
            return None
        return Code.CONFIDENT(
            switches=running.switches,
            cycles=running.cycle_count,
            quantity=_NAMES[self.sought],
            width=width,
            wanted=self.wanted,
        )
