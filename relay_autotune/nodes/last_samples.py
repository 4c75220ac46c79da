# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The last measurements before a tune: how often they come, and whether they are at rest."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from relay_autotune.experiment.settling import CONSTANT_SAMPLES, RestState, rest_state

# The last samples that are kept, and the time that they may cover [s].
_KEPT, _WINDOW = 2000, 10.0


class LastSamples:
    """Keep the last measurements with their time of arrival."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, float]] = deque(maxlen=_KEPT)

    def add(self, value: float) -> None:
        """Take a measurement [y] that has arrived now."""
        self._kept.append((time.monotonic(), value))

    def forget(self) -> None:
        """Start again, since the command will change."""
        self._kept.clear()

    @property
    def interval(self) -> float:
        """Mean interval of the samples [s]; 0: not known."""
        if len(self._kept) < 2:
            return 0.0
        return (self._kept[-1][0] - self._kept[0][0]) / (len(self._kept) - 1)

    @property
    def newest(self) -> float | None:
        """The newest measurement [y]; None: none has come."""
        return self._kept[-1][1] if self._kept else None

    def rest(self) -> RestState | None:
        """Return how the measurement rested over the last seconds; None: there are too few."""
        since = time.monotonic() - _WINDOW
        recent = np.array([sample for sample in self._kept if sample[0] >= since])
        if len(recent) < CONSTANT_SAMPLES:
            return None
        return rest_state(recent[:, 0] - recent[0, 0], recent[:, 1], len(recent))
