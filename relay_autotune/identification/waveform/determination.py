# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What a record determines: intervals, combinations, and the test that would tell the rest.

A wide interval is not symmetric: it follows from draws of the posterior, each side by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.result import (
    DETERMINED,
    Combination,
    Identification,
    is_determined,
)
from relay_autotune.identification.waveform.posterior import Posterior
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record
from relay_autotune.text import digits

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
    :param held: longest time for which a command was held [s].
    :param relay: all were relay tests.
    """

    biased: bool
    rested: bool
    interval: float
    held: float
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
    if found.model.integrators:
        small |= missing & {"time_constant"}
    if small:
        said += _for_fast(found, sorted(small), tests)
    said += _for_noise(found, missing, tests)
    return tuple(said)


def _tests_of(records: Sequence[Record]) -> _Tests:
    biased, rested, held = False, False, 0.0
    for record in records:
        u = record.input()
        settings = record.settings
        if settings is not None and abs(settings.bias) > _LITTLE_BIAS * settings.amplitude:
            biased = True
        changes = u.times
        if changes.size:
            gap = float(np.median(np.diff(changes))) if changes.size > 1 else record.duration
            rested |= float(changes[0] - record.time[0]) >= _SHORT_REST * gap
            held = max(held, *np.diff(np.append(changes, record.time[-1])).tolist())
    intervals = [record.mean_interval for record in records]
    relay = all(record.settings is not None for record in records)
    return _Tests(biased, rested, max(intervals), held, relay)


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
    if 3.0 * slowest > tests.held:
        said.append(
            f"a step of the command held for about {digits(3.0 * slowest, 2)} s, three times the "
            "slowest lag, would determine gain and time constant"
        )
    return said


def _for_fast(found: Identification, names: Sequence[str], tests: _Tests) -> list[str]:
    """Return tests that tell dead time, small lags and zeros apart: by high frequencies."""
    said = []
    text = ", ".join(name.replace("_", " ") for name in names)
    fast = found.model.dead_time
    ends = zip(found.estimate.structure.parameters, found.ci95_high, strict=True)
    longest = max((float(b) for p, b in ends if p.name in names and p.unit == "s"), default=fast)
    if longest < _FEW_SAMPLES * tests.interval:
        said.append(
            f"faster sampling would help with the {text}, which may be {digits(longest, 2)} s at "
            f"most: the time between samples is {digits(tests.interval, 2)} s"
        )
    elif not tests.relay:
        # Of lags, dead time and zero that cancel, the longest possible one sets the time.
        half = 2.0 * max(longest, fast)
        if found.ultimate_frequency_std < found.ultimate_frequency:
            half = math.pi / found.ultimate_frequency
        said.append(
            f"a few steps to and fro in the same record, each held for about {digits(half, 2)} s, "
            f"would tell the {text} apart: it takes fast changes"
        )
    else:
        said.append(
            f"a second, slower test with a dead time added to the relay (extra_delay of about "
            f"{digits(fast, 2)} s), fitted together with this one, would tell the {text} apart"
        )
    return said


def _for_noise(found: Identification, missing: set[str], tests: _Tests) -> list[str]:
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
    larger, more = ("an amplitude", "cycles") if tests.relay else ("steps", "of them")
    longer = f"{math.ceil(widest**2)} times as many {more}"
    if widest >= 1.05:
        longer = f"{larger} {widest:.1f} times as large, or {longer},"
    return [f"{longer} would narrow every interval enough"]


def with_what_is_determined(
    found: Identification, records: Sequence[Record], allowed: Posterior, quantile: float
) -> Identification:
    """Replace linear intervals where they are wide, and add the determined combinations.

    :param found: the identification with its linear intervals.
    :param records: what it was identified from.
    :param allowed: the models that the records allow.
    :param quantile: half width of an interval in standard deviations.
    """
    parameters = found.estimate.structure.parameters
    low, high = found.ci95_low.copy(), found.ci95_high.copy()
    if allowed.values.shape[0]:
        for i, parameter in enumerate(parameters):
            # A dead time at zero has one side.
            if parameter.name in found.undetermined or low[i] == parameter.least:
                value = float(found.values[i])
                low[i], high[i] = interval_of(
                    value, allowed.values[:, i], quantile, parameter.logarithmic
                )
    undetermined = tuple(
        p.name
        for p, value, a, b in zip(parameters, found.values, low, high, strict=True)
        if not is_determined(float(value), float(a), float(b))
    )
    low = np.maximum(low, found.estimate.structure.least)
    found = replace(found, ci95_low=low, ci95_high=high, undetermined=undetermined)
    if not undetermined:
        return found
    every = []
    for name, unit, function in _combinations(found.model):
        value = function(found.model)
        drawn = np.array([function(m) for m in allowed.own])
        std = math.sqrt(float(np.mean((drawn - value) ** 2))) if drawn.size else math.nan
        every.append(Combination(name, unit, value, std, *interval_of(value, drawn, NORMAL_95)))
    gain, frequency = found.ultimate_gain, found.ultimate_frequency
    for name, unit, value, std in (
        ("ultimate_gain", "u/y", gain, found.ultimate_gain_std),
        ("ultimate_frequency", "rad/s", frequency, found.ultimate_frequency_std),
    ):
        half = NORMAL_95 * std
        every.append(Combination(name, unit, value, std, value - half, value + half))
    found = replace(found, combinations=tuple(c for c in every if c.determined))
    return replace(found, advice=advice(found, records))


def interval_of(
    value: float, drawn: FloatArray, quantile: float, logarithmic: bool = False
) -> tuple[float, float]:
    """Return an interval by draws, each side of their median as of a normal distribution.

    The mean squares of both sides need fewer draws than their quantiles.

    :param value: the estimate, which the interval holds in any case.
    :param drawn: shape (k,); those that are not finite do not count.
    :param quantile: half width in standard deviations.
    :param logarithmic: True: by logarithms.
    """
    at = np.log(np.abs(drawn)) if logarithmic else drawn
    at = at[np.isfinite(at)]
    if not at.size:
        return math.nan, math.nan
    middle = float(np.median(at))
    ends = []
    for side in (-1.0, 1.0):
        away = np.maximum(side * (at - middle), 0.0)
        ends.append(middle + side * quantile * math.sqrt(2.0 * float(np.mean(away**2))))
    if logarithmic:
        ends = [math.copysign(math.exp(min(end, 700.0)), value) for end in ends]
    return min(*ends, value), max(*ends, value)


# A combination of parameters of a model.
_Combination = tuple[str, str, Callable[[TransferFunction], float]]


def _combinations(model: TransferFunction) -> list[_Combination]:
    """Return names, units and functions of the combinations that may be determined."""
    lags = len(model.time_constants)
    found: list[_Combination] = []
    per = " s" * (model.integrators + 1)
    if lags:
        # Its first slope: a short test of a slow process shows nothing else.
        found.append(("gain/time_constant", f"y/(u{per})", _slope))
    if lags > 1:
        found.append(("gain/product of lags", f"y/(u{' s' * (model.integrators + lags)})", _high))
    small = lags if model.integrators else lags - 1
    less = " - zero" * len(model.zeros)
    if small > 0 or model.zeros:
        found.append((f"dead_time + smaller lags{less}", "s", _apparent_dead_time))
    if lags and model.is_stable:
        found.append((f"dead_time + sum of lags{less}", "s", _residence))
    return found


def _slope(model: TransferFunction) -> float:
    return abs(model.gain) / max(abs(t) for t in model.time_constants)


def _high(model: TransferFunction) -> float:
    return abs(model.gain) / math.prod(abs(t) for t in model.time_constants)


def _apparent_dead_time(model: TransferFunction) -> float:
    lags = sorted((t.real for t in model.time_constants), key=abs)
    some = lags if model.integrators else lags[:-1]
    return model.dead_time + sum(some) - sum(z.real for z in model.zeros)


def _residence(model: TransferFunction) -> float:
    constants = sum(t.real for t in model.time_constants)
    return model.dead_time + constants - sum(z.real for z in model.zeros)
