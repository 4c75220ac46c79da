# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""How long the computation of a model and its gains will take on this machine: to tell people."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

# Time of `analyse` for a record of a thousand samples, alone and with the other methods and rules,
# over that of the benchmark; and how it grows with the number of samples. Both are medians over
# relay tests of 14 random processes with one to three lags and 400 to 12,000 samples, which took
# 0.75 to 1.4 times as long; one record of many rival structures took five times as long.
_ALONE, _ALL, _GROWS = 58.0, 74.0, 0.1


def benchmark(clock: Callable[[], float]) -> float:
    """Return how long this machine takes for some work like that of a fit, some 20 ms [s].

    :param clock: returns the time [s].
    """
    begun, times = clock(), np.linspace(0.0, 1.0, 4000)
    for k in range(1000):
        np.cumsum(np.exp(-k * times))
        sum(range(200))
    return clock() - begun


def expected_time(
    *samples: int, alone: bool = False, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return how long the analysis of some records will take about [s].

    The time of the benchmark tells how fast the machine is, and how busy.

    :param samples: number of samples of each record.
    :param alone: as for :func:`~relay_autotune.analysis.analyse`.
    :param clock: returns the time [s].
    """
    factor = (_ALONE if alone else _ALL) * benchmark(clock)
    return factor * sum((max(each, 1) / 1000.0) ** _GROWS for each in samples)
