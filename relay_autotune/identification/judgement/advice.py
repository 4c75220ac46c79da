# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What test would determine the parameters that a record does not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relay_autotune.identification.combinations import DETERMINED
from relay_autotune.identification.result import Identification
from relay_autotune.record.record import Record

# Largest factor of the amplitude that is advised.
_MOST_TIMES = 5.0
_FEW_SAMPLES = 3.0
_LITTLE_BIAS = 0.1
# Least rest before the first change, as a share of the time between changes.
_SHORT_REST = 0.5
_SLOW = ("gain", "time_constant", "time_constant_1")


@dataclass(frozen=True)
class _Tests:
    """Properties of the records.

    :param biased: one of them has a mean command off the baseline.
    :param rested: one of them begins with samples at rest.
    :param interval: typical time between samples [s].
    :param relay: all were relay tests.
    """

    biased: bool
    rested: bool
    interval: float
    relay: bool


def advice(found: Identification, records: Sequence[Record]) -> tuple[str, ...]:
    """Return what would determine the parameters that are not determined.

    :param found: the identification.
    :param records: what it was identified from.
    """
    missing = set(found.undetermined)
    if not missing:
        return ()
    tests = _tests_of(records)
    said = []
    if missing & set(_SLOW) and not found.model.integrators:
        said += _for_slow(found, tests)
    small = missing - set(_SLOW)
    if found.model.integrators or len(found.model.time_constants) == 1:
        small |= missing & {"time_constant"} if found.model.integrators else set()
    if small:
        said += _for_fast(found, sorted(small), tests)
    said += _for_noise(found, missing)
    return tuple(said)


def _tests_of(records: Sequence[Record]) -> _Tests:
    biased, rested = False, False
    for record in records:
        u = record.input()
        settings = record.settings
        if settings is not None and abs(settings.bias) > _LITTLE_BIAS * settings.amplitude:
            biased = True
        changes = u.times
        if changes.size:
            gap = float(np.median(np.diff(changes))) if changes.size > 1 else record.duration
            rested |= float(changes[0] - record.time[0]) >= _SHORT_REST * gap
    intervals = [record.mean_interval for record in records]
    relay = all(record.settings is not None for record in records)
    return _Tests(biased, rested, max(intervals), relay)


def _for_slow(found: Identification, tests: _Tests) -> list[str]:
    """Return tests for a static gain and a slow lag: the measurement has to stop rising."""
    said = []
    slowest = max((abs(t) for t in found.model.time_constants), default=0.0)
    if tests.relay and not tests.biased:
        said.append(
            "a relay with a bias would determine the gain, since its mean command differs from "
            "that at rest: set bias_ratio to 0.3"
        )
    if not tests.rested:
        said.append(
            "samples at rest before the first change of the command would determine the gain, "
            "since they fix the measurement's zero"
        )
    if slowest > 0.0:
        said.append(
            f"a step of the command held for about {3.0 * slowest:.2g} s, three times the slowest "
            "lag, would determine gain and time constant"
        )
    return said


def _for_fast(found: Identification, names: Sequence[str], tests: _Tests) -> list[str]:
    """Return tests that tell dead time, small lags and zeros apart: by high frequencies."""
    said = []
    text = ", ".join(name.replace("_", " ") for name in names)
    fast = found.model.dead_time
    if fast < _FEW_SAMPLES * tests.interval:
        said.append(
            f"faster sampling would help with the {text}: the dead time is {fast:.2g} s, the time "
            f"between samples {tests.interval:.2g} s"
        )
    else:
        said.append(
            f"a second, slower test with a dead time added to the relay (extra_delay of about "
            f"{fast:.2g} s), fitted together with this one, would tell the {text} apart"
        )
    return said


def _for_noise(found: Identification, missing: set[str]) -> list[str]:
    """Return how much larger or longer the same test would have to be."""
    # An interval is as wide as the noise over the amplitude, and narrows with the cycles.
    widest = 0.0
    for name, value, low, high in zip(
        found.parameters, found.values, found.ci95_low, found.ci95_high, strict=True
    ):
        if name in missing:
            half = 0.5 * (high - low)
            times = half / (DETERMINED * abs(value)) if value else math.inf
            widest = max(widest, times)
    if not 1.0 < widest <= _MOST_TIMES:
        return []
    return [
        f"an amplitude {widest:.1f} times as large, or {math.ceil(widest**2)} times as many "
        "cycles, would narrow every interval enough"
    ]
