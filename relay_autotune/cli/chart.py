# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The input of `identify`: numbers read off a chart, and the methods that use them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.errors import SelectionError, look_up
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods.atv import atv_from_numbers
from relay_autotune.identification.methods.chang import chang_from_numbers
from relay_autotune.identification.methods.li import li_from_numbers
from relay_autotune.identification.methods.luyben import (
    identify_step_numbers,
    require_structure,
)
from relay_autotune.identification.methods.thyagarajan_method import identify_numbers
from relay_autotune.identification.methods.wang import (
    FopdtCycle,
    fopdt_from_biased,
    fopdt_with_gain,
)
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.shown.shape import Shape
from relay_autotune.identification.shown.symmetric_cycle import SymmetricCycle
from relay_autotune.process.structures import FOPDT


def identify_chang_chart(numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify lags by the exact equations of Chang et al.

    :param numbers: period, amplitude, relay, dead_time; hysteresis.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    return chang_from_numbers(_cycle(numbers), known)


def identify_atv_chart(numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify lags by the original ATV.

    :param numbers: period, amplitude, relay, dead_time; hysteresis.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    return atv_from_numbers(_cycle(numbers), known)


def identify_li_chart(numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify lags with their gain from two tests, the second with a dead time added.

    :param numbers: period, amplitude, relay; period_2, amplitude_2, extra_delay; relay_2 and
        hysteresis.
    :param known: dead time, structure and order where they are known.
    :raises IdentificationError: if no such model has both limit cycles.
    """
    relay, hysteresis = numbers["relay"], numbers.get("hysteresis", 0.0)
    first = SymmetricCycle(numbers["period"], numbers["amplitude"], relay, hysteresis, 0.0)
    second = SymmetricCycle(
        numbers["period_2"],
        numbers["amplitude_2"],
        numbers.get("relay_2", relay),
        hysteresis,
        numbers["extra_delay"],
    )
    return li_from_numbers((first, second), known)


def _cycle(numbers: Mapping[str, float]) -> SymmetricCycle:
    return SymmetricCycle(
        numbers["period"],
        numbers["amplitude"],
        numbers["relay"],
        numbers.get("hysteresis", 0.0),
        numbers["dead_time"],
    )


def identify_step_chart(numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify an integrating process with inverse response (Luyben 2003, eqs 4 to 6).

    :param numbers: t1, t2, extremum, step, dead_time.
    :param known: the structure, which can only be this one.
    :raises IdentificationError: if no such process has these numbers.
    """
    require_structure(known)
    return identify_step_numbers(
        numbers["t1"], numbers["t2"], numbers["extremum"], numbers["step"], numbers["dead_time"]
    )


def identify_thyagarajan_chart(numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify a model of the structure that the shape of a limit cycle suggests.

    :param numbers: period, amplitude, relay; time_to_peak, time_half, rise, hysteresis.
    :param known: structure, order and dead time where they are known.
    :raises SelectionError: if neither numbers nor structure tell the category.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    peak = numbers.get("time_to_peak", math.nan)
    half = numbers.get("time_half", math.nan)
    shape = Shape(
        half_period=0.5 * numbers["period"],
        amplitude=numbers["amplitude"],
        level=numbers.get("hysteresis", 0.0),
        time_to_peak=peak,
        rise=numbers.get("rise", peak),
        rise_half=half,
        sharpness=math.nan,
        plateau=math.nan,
    )
    lags = known.order > 1 or known.structure == "lag_n"
    if math.isnan(half) and math.isnan(peak) and math.isnan(known.dead_time) and not lags:
        raise SelectionError(
            "thyagarajan also needs --time-to-peak for a curve with sharp edges, with --time-half "
            "for one that is almost rectangular, or --structure lag_n: with --order 2 for one "
            "that took many cycles to grow, with --order 5 for one that did not"
        )
    if not math.isnan(half) and math.isnan(shape.rise):
        raise SelectionError("--time-half also needs --time-to-peak")
    # The time to half of the peak is used only for almost rectangular curves.
    category = "1a" if math.isnan(half) else "1b"
    return identify_numbers(shape, numbers["relay"], known, category)


def identify_biased_chart(numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify a FOPDT model from the limit cycle of a biased relay (eqs 6 to 11).

    :param numbers: period_high, period_low, peak_max, peak_min, relay, bias; hysteresis; and
        mean_measurement with mean_command where the gain is not known.
    :param known: the gain, whose sign is that of the process.
    :raises SelectionError: if neither the gain nor the means are given.
    :raises IdentificationError: if the numbers are no limit cycle of a FOPDT process.
    """
    gain = known.gain
    if math.isnan(gain):
        if not {"mean_measurement", "mean_command"} <= numbers.keys():
            raise SelectionError(
                "wang_biased also needs --gain, or --mean-measurement and --mean-command"
            )
        if numbers["mean_command"] == 0.0:
            raise SelectionError(
                "--mean-command must not be 0: the gain is the ratio of the means (eq 6)"
            )
        gain = numbers["mean_measurement"] / numbers["mean_command"]
    # With the sign of the command inverted, a reverse-acting process has a positive gain.
    sign = -1 if gain < 0.0 else 1
    high, low = (numbers["period_high"], numbers["period_low"])[::sign]
    cycle = FopdtCycle(high, low, numbers["peak_max"], numbers["peak_min"])
    k, tau, dead_time = fopdt_from_biased(
        cycle,
        abs(gain),
        numbers["relay"],
        sign * numbers["bias"],
        numbers.get("hysteresis", 0.0),
    )
    return _fopdt("wang_biased", sign * k, tau, dead_time)


def identify_unbiased_chart(numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify a FOPDT model from the limit cycle of an unbiased relay (eqs 21 and 22).

    :param numbers: period, amplitude, relay; hysteresis.
    :param known: the gain.
    :raises IdentificationError: if the numbers are no limit cycle of a FOPDT process.
    """
    k, tau, dead_time = fopdt_with_gain(
        abs(known.gain),
        numbers["period"],
        numbers["amplitude"],
        numbers["relay"],
        numbers.get("hysteresis", 0.0),
    )
    return _fopdt("wang_unbiased", math.copysign(k, known.gain), tau, dead_time)


def _fopdt(method: str, gain: float, time_constant: float, dead_time: float) -> Identification:
    return identified(method, Estimate.of(FOPDT, np.array((gain, time_constant, dead_time))))


Numbers = Mapping[str, float]
ChartMethod = Callable[[Numbers, Known], Identification]

ANY, POSITIVE, NOT_NEGATIVE, NOT_ZERO = "", "> 0", ">= 0", "not 0"


@dataclass(frozen=True)
class ChartNumber:
    """A number that the command line may give.

    :param unit: its unit.
    :param meaning: what it is, for the help.
    :param range: one of ``ANY``, ``POSITIVE``, ``NOT_NEGATIVE``, ``NOT_ZERO``.
    """

    unit: str
    meaning: str
    range: str = ANY


@dataclass(frozen=True)
class Chart:
    """A method with the numbers that it takes.

    :param summary: what it does, for the help.
    :param identify: returns a model from the given numbers, by name, and what is known of the
        process: gain, dead time, structure and order.
    :param required: names of the numbers that it needs.
    :param optional: names of the numbers that it can use.
    :param any_structure: True if it takes a known structure and order.
    """

    summary: str
    identify: ChartMethod
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    any_structure: bool = False


# The methods get "gain" and "dead_time" by their argument `known`.
NUMBERS: dict[str, ChartNumber] = {
    "period": ChartNumber("s", "period of the limit cycle", POSITIVE),
    "period_high": ChartNumber("s", "time that the command stays high", POSITIVE),
    "period_low": ChartNumber("s", "time that the command stays low", POSITIVE),
    "amplitude": ChartNumber("y", "half of peak to peak of the measurement", POSITIVE),
    "peak_max": ChartNumber("y", "highest measurement, from its steady state"),
    "peak_min": ChartNumber("y", "lowest measurement, from its steady state"),
    "relay": ChartNumber("u", "amplitude of the relay, half the distance of its levels", POSITIVE),
    "bias": ChartNumber("u", "middle of the relay's levels, from the steady state"),
    "hysteresis": ChartNumber(
        "y", "half width of the switching band, 0 if not given", NOT_NEGATIVE
    ),
    "gain": ChartNumber("y/u", "static gain of the process", NOT_ZERO),
    "dead_time": ChartNumber("s", "dead time of the process", NOT_NEGATIVE),
    "extra_delay": ChartNumber("s", "dead time added to the relay, in the second test", POSITIVE),
    "period_2": ChartNumber("s", "period in the second test", POSITIVE),
    "amplitude_2": ChartNumber("y", "half of peak to peak in the second test", POSITIVE),
    "relay_2": ChartNumber("u", "amplitude of the relay in the second test, if another", POSITIVE),
    "mean_measurement": ChartNumber("y", "mean over whole cycles, from the steady state"),
    "mean_command": ChartNumber("u", "mean over whole cycles, from the steady state"),
    "time_to_peak": ChartNumber("s", "from a switch to the peak after it", POSITIVE),
    "rise": ChartNumber(
        "s", "from the steady state to the peak, if not the time from the switch", POSITIVE
    ),
    "time_half": ChartNumber("s", "from the steady state to half of the peak", POSITIVE),
    "step": ChartNumber("u", "height of a step of the command", NOT_ZERO),
    "t1": ChartNumber("s", "from the end of the dead time to the extremum", POSITIVE),
    "t2": ChartNumber("s", "from the end of the dead time to the return", POSITIVE),
    "extremum": ChartNumber(
        "y", "minimum or maximum after a step, from the steady state", NOT_ZERO
    ),
}

CHART_METHODS: dict[str, Chart] = {
    "wang_biased": Chart(
        "FOPDT from a biased relay (Wang, Hang and Zou 1997)",
        identify_biased_chart,
        ("period_high", "period_low", "peak_max", "peak_min", "relay", "bias"),
        ("hysteresis", "gain", "mean_measurement", "mean_command"),
    ),
    "wang_unbiased": Chart(
        "FOPDT from an unbiased relay (Wang, Hang and Zou 1997)",
        identify_unbiased_chart,
        ("period", "amplitude", "relay", "gain"),
        ("hysteresis",),
    ),
    "chang": Chart(
        "lags, exactly in time, from an unbiased relay (Chang, Shen and Yu 1992)",
        identify_chang_chart,
        ("period", "amplitude", "relay", "dead_time"),
        ("gain", "hysteresis"),
        any_structure=True,
    ),
    "atv": Chart(
        "lags by the describing function, from an unbiased relay (Luyben 1987)",
        identify_atv_chart,
        ("period", "amplitude", "relay", "dead_time"),
        ("gain", "hysteresis"),
        any_structure=True,
    ),
    "li": Chart(
        "lags with their gain from two tests, one with a dead time added (Li et al. 1991)",
        identify_li_chart,
        ("period", "amplitude", "relay", "period_2", "amplitude_2", "extra_delay"),
        ("dead_time", "hysteresis", "relay_2"),
        any_structure=True,
    ),
    "thyagarajan": Chart(
        "structure by the shape, from an unbiased relay (Thyagarajan and Yu 2003)",
        identify_thyagarajan_chart,
        ("period", "amplitude", "relay"),
        ("time_to_peak", "time_half", "rise", "hysteresis", "dead_time"),
        any_structure=True,
    ),
    "luyben_step": Chart(
        "integrator with inverse response, from a step (Luyben 2003)",
        identify_step_chart,
        ("t1", "t2", "extremum", "step", "dead_time"),
    ),
}
CHART_METHODS["wang"] = replace(CHART_METHODS["wang_biased"], summary="the same as wang_biased")


def option(name: str) -> str:
    """Return the command-line option of a number."""
    return "--" + name.replace("_", "-")


def identify_chart(method: str, numbers: Numbers, known: Known) -> Identification:
    """Identify a model from numbers.

    :param method: one of ``CHART_METHODS``.
    :param numbers: those that were given, by name.
    :param known: what else is known of the process; gain and dead time come from ``numbers``.
    :raises SelectionError: if the method is unknown, or a number is missing, out of its range, or
        not used by the method.
    :raises IdentificationError: if no model has these numbers.
    """
    chart = look_up(CHART_METHODS, method, "method", SelectionError)
    lacking = [option(n) for n in chart.required if n not in numbers]
    if lacking:
        raise SelectionError(f"{method} also needs {', '.join(lacking)}")
    unused = [option(n) for n in numbers if n not in chart.required + chart.optional]
    if unused:
        takes = ", ".join(option(n) for n in chart.required + chart.optional)
        raise SelectionError(f"{method} does not use {', '.join(unused)}; it takes {takes}")
    if (known.structure or known.order) and not chart.any_structure:
        raise SelectionError(f"{method} does not use --structure and --order")
    for name, value in numbers.items():
        _require_range(name, value)
    facts = replace(
        known,
        gain=numbers.get("gain", math.nan),
        dead_time=numbers.get("dead_time", math.nan),
    )
    return chart.identify(numbers, facts)


def _require_range(name: str, value: float) -> None:
    wanted = NUMBERS[name].range
    good = {
        ANY: True,
        POSITIVE: value > 0.0,
        NOT_NEGATIVE: value >= 0.0,
        NOT_ZERO: value != 0.0,
    }[wanted]
    if not good or not math.isfinite(value):
        raise SelectionError(f"{option(name)} must be finite and {wanted}, found {value:g}")
