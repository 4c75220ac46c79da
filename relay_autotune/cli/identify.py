# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Identify a process from numbers read off a chart: `identify --method NAME --period P ...`."""

from __future__ import annotations

import argparse
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from relay_autotune.cli.arguments import (
    DONE,
    Parser,
    add_quantities,
    flag_of,
    given_quantities,
    run_command,
)
from relay_autotune.cli.table import identification_lines
from relay_autotune.cli.terminal import labelled, width
from relay_autotune.errors import SelectionError, look_up
from relay_autotune.exchange.fields import to_document
from relay_autotune.exchange.models import to_json
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.limit_cycle.shape import Shape
from relay_autotune.identification.methods.chang import atv_from_numbers, chang_from_numbers
from relay_autotune.identification.methods.li import li_from_numbers
from relay_autotune.identification.methods.luyben import identify_step_numbers
from relay_autotune.identification.methods.thyagarajan import identify_numbers
from relay_autotune.identification.methods.wang import (
    FopdtCycle,
    fopdt_from_biased,
    fopdt_with_gain,
)
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import FOPDT
from relay_autotune.quantities import Quantity

PROGRAM = "identify"

_EPILOG = """\
Results go to standard output, everything else to standard error.

Exit status: 0 done; 1 no model has these numbers; 2 the command line is wrong.

Examples:
  identify --method wang_biased --period-high 15.4 --period-low 20.4 \\
           --peak-max 0.5 --peak-min -0.29 --relay 1 --bias 0.3 --gain 1
"""


def _number(name: str, unit: str, description: str, **limits: Any) -> Quantity:
    return Quantity(name, math.nan, unit, description=description, **limits)


_positive = partial(_number, lower=0.0, open_ended=True)
_not_negative = partial(_number, lower=0.0)
_not_zero = partial(_number, zero=False)
NUMBERS = (
    _positive("period", "s", "Period of the limit cycle."),
    _positive("period_high", "s", "Time that the command stays high."),
    _positive("period_low", "s", "Time that the command stays low."),
    _positive("amplitude", "y", "Half of peak to peak of the measurement."),
    _number("peak_max", "y", "Highest measurement, from its steady state."),
    _number("peak_min", "y", "Lowest measurement, from its steady state."),
    _positive("relay", "u", "Amplitude of the relay, half the distance of its levels."),
    _number("bias", "u", "Middle of the relay's levels, from the steady state."),
    _not_negative("hysteresis", "y", "Half width of the switching band, 0 if not given."),
    _not_zero("gain", "y/u", "Static gain of the process."),
    _not_negative("dead_time", "s", "Dead time of the process."),
    _positive("extra_delay", "s", "Dead time added to the relay, in the second test."),
    _positive("period_2", "s", "Period in the second test."),
    _positive("amplitude_2", "y", "Half of peak to peak in the second test."),
    _positive("relay_2", "u", "Amplitude of the relay in the second test, if another."),
    _number("mean_measurement", "y", "Mean over whole cycles, from the steady state."),
    _number("mean_command", "u", "Mean over whole cycles, from the steady state."),
    _positive("time_to_peak", "s", "From a switch to the peak after it."),
    _positive("rise", "s", "From the steady state to the peak, if not the time from the switch."),
    _positive("time_half", "s", "From the steady state to half of the peak."),
    _not_zero("step", "u", "Height of a step of the command."),
    _positive("t1", "s", "From the end of the dead time to the extremum."),
    _positive("t2", "s", "From the end of the dead time to the return."),
    _not_zero("extremum", "y", "Minimum or maximum after a step, from the steady state."),
)
"""What the command line may give."""


# Each method is a function of the numbers that it takes, by their names in NUMBERS; those without
# a default it needs. One that takes `known` can be given a structure and an order.


def _of_cycle(
    from_numbers: Callable[[SymmetricCycle, Known], Identification],
) -> Callable[..., Identification]:
    """Return the function of the numbers for a method that takes the cycle of one test."""

    def identify(
        known: Known,
        *,
        period: float,
        amplitude: float,
        relay: float,
        dead_time: float,
        gain: float = math.nan,
        hysteresis: float = 0.0,
    ) -> Identification:
        cycle = SymmetricCycle(period, amplitude, relay, hysteresis, dead_time)
        return from_numbers(cycle, replace(known, gain=gain, dead_time=dead_time))

    return identify


def _li(
    known: Known,
    *,
    period: float,
    amplitude: float,
    relay: float,
    period_2: float,
    amplitude_2: float,
    extra_delay: float,
    dead_time: float = math.nan,
    hysteresis: float = 0.0,
    relay_2: float = math.nan,
) -> Identification:
    second_relay = relay if math.isnan(relay_2) else relay_2
    first = SymmetricCycle(period, amplitude, relay, hysteresis, 0.0)
    second = SymmetricCycle(period_2, amplitude_2, second_relay, hysteresis, extra_delay)
    return li_from_numbers((first, second), replace(known, dead_time=dead_time))


def _thyagarajan(
    known: Known,
    *,
    period: float,
    amplitude: float,
    relay: float,
    time_to_peak: float = math.nan,
    time_half: float = math.nan,
    rise: float = math.nan,
    hysteresis: float = 0.0,
    dead_time: float = math.nan,
) -> Identification:
    shape = Shape(
        half_period=0.5 * period,
        amplitude=amplitude,
        level=hysteresis,
        time_to_peak=time_to_peak,
        rise=time_to_peak if math.isnan(rise) else rise,
        rise_half=time_half,
        sharpness=math.nan,
        plateau=math.nan,
    )
    lags = known.order > 1 or known.structure == "lag_n"
    if all(map(math.isnan, (time_half, time_to_peak, dead_time))) and not lags:
        raise SelectionError(
            "thyagarajan also needs --time-to-peak for a curve with sharp edges, with --time-half "
            "for one that is almost rectangular, or --structure lag_n: with --order 2 for one "
            "that took many cycles to grow, with --order 5 for one that did not"
        )
    if not math.isnan(time_half) and math.isnan(shape.rise):
        raise SelectionError("--time-half also needs --time-to-peak")
    # The time to half of the peak is used only for almost rectangular curves.
    category = "1a" if math.isnan(time_half) else "1b"
    return identify_numbers(shape, relay, replace(known, dead_time=dead_time), category)


def _wang_biased(
    *,
    period_high: float,
    period_low: float,
    peak_max: float,
    peak_min: float,
    relay: float,
    bias: float,
    hysteresis: float = 0.0,
    gain: float = math.nan,
    mean_measurement: float = math.nan,
    mean_command: float = math.nan,
) -> Identification:
    """Apply eqs 6 to 11 of Wang, Hang and Zou (1997)."""
    if math.isnan(gain):
        if math.isnan(mean_measurement) or math.isnan(mean_command):
            raise SelectionError(
                "wang_biased also needs --gain, or --mean-measurement and --mean-command"
            )
        if mean_command == 0.0:
            raise SelectionError(
                "--mean-command must not be 0: the gain is the ratio of the means (eq 6)"
            )
        gain = mean_measurement / mean_command
    # With the sign of the command inverted, a reverse-acting process has a positive gain.
    sign = -1 if gain < 0.0 else 1
    high, low = (period_high, period_low)[::sign]
    cycle = FopdtCycle(high, low, peak_max, peak_min)
    k, tau, dead_time = fopdt_from_biased(cycle, abs(gain), relay, sign * bias, hysteresis)
    return _fopdt("wang_biased", sign * k, tau, dead_time)


def _wang_unbiased(
    *, period: float, amplitude: float, relay: float, gain: float, hysteresis: float = 0.0
) -> Identification:
    """Apply eqs 21 and 22 of Wang, Hang and Zou (1997)."""
    k, tau, dead_time = fopdt_with_gain(abs(gain), period, amplitude, relay, hysteresis)
    return _fopdt("wang_unbiased", math.copysign(k, gain), tau, dead_time)


def _fopdt(method: str, gain: float, time_constant: float, dead_time: float) -> Identification:
    return identified(method, Estimate.of(FOPDT, np.array((gain, time_constant, dead_time))))


@dataclass(frozen=True)
class Chart:
    """A method with the numbers that it takes.

    :param summary: what it does, for the help.
    :param identify: returns a model.
    """

    summary: str
    identify: Callable[..., Identification]

    @cached_property
    def takes(self) -> dict[str, bool]:
        """The names of the numbers that it can use, and whether it needs each."""
        found = inspect.signature(self.identify).parameters
        return {
            name: each.default is each.empty for name, each in found.items() if name != "known"
        }

    @property
    def takes_structure(self) -> bool:
        """Whether it can be given a structure and an order."""
        return "known" in inspect.signature(self.identify).parameters


CHART_METHODS: dict[str, Chart] = {
    "wang_biased": Chart("FOPDT from a biased relay (Wang, Hang and Zou 1997)", _wang_biased),
    "wang_unbiased": Chart(
        "FOPDT from an unbiased relay (Wang, Hang and Zou 1997)", _wang_unbiased
    ),
    "chang": Chart(
        "lags, exactly in time, from an unbiased relay (Chang, Shen and Yu 1992)",
        _of_cycle(chang_from_numbers),
    ),
    "atv": Chart(
        "lags by the describing function, from an unbiased relay (Luyben 1987)",
        _of_cycle(atv_from_numbers),
    ),
    "li": Chart(
        "lags with their gain from two tests, one with a dead time added (Li et al. 1991)", _li
    ),
    "thyagarajan": Chart(
        "structure by the shape, from an unbiased relay (Thyagarajan and Yu 2003)", _thyagarajan
    ),
    "luyben_step": Chart(
        "integrator with inverse response, from a step (Luyben 2003)", identify_step_numbers
    ),
    "wang": Chart("the same as wang_biased", _wang_biased),
}


_FLAGS = {each.name: flag_of(each) for each in NUMBERS}


def identify_chart(method: str, numbers: Mapping[str, float], known: Known) -> Identification:
    """Identify a model from numbers.

    :param method: one of ``CHART_METHODS``.
    :param numbers: those that were given, by name.
    :param known: structure and order, where they are known.
    :raises SelectionError: if the method is unknown, or a number is missing, or not used by the
        method.
    :raises IdentificationError: if no model has these numbers.
    """
    chart = look_up(CHART_METHODS, method, "method", SelectionError)
    if lacking := [_FLAGS[n] for n, needed in chart.takes.items() if needed and n not in numbers]:
        raise SelectionError(f"{method} also needs {', '.join(lacking)}")
    if unused := [_FLAGS[n] for n in numbers if n not in chart.takes]:
        takes = ", ".join(_FLAGS[n] for n in chart.takes)
        raise SelectionError(f"{method} does not use {', '.join(unused)}; it takes {takes}")
    if (known.structure or known.order) and not chart.takes_structure:
        raise SelectionError(f"{method} does not use --structure and --order")
    return chart.identify(*([known] if chart.takes_structure else []), **numbers)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    :param arguments: those of the command line; default: the process's own.
    :return: the exit status.
    """
    options = _parser().parse_args(arguments)
    return run_command(PROGRAM, lambda: _run(options))


def _parser() -> Parser:
    methods: list[str] = []
    for name, chart in CHART_METHODS.items():
        numbers = [_FLAGS[n] if needed else f"[{_FLAGS[n]}]" for n, needed in chart.takes.items()]
        methods += labelled(name, chart.summary, width(), indent=17)
        methods += labelled("", "   ".join(numbers), width(), indent=17)
    parser = Parser(
        PROGRAM,
        description="Identify a process from the numbers of a limit cycle, without a record.",
        epilog="\n".join(["methods and their numbers:", *methods, "", _EPILOG]),
    )
    parser.add_argument("--method", required=True, metavar="NAME", help="how to identify")
    add_quantities(parser, NUMBERS)
    parser.add_argument("--structure", default="", metavar="NAME", help="structure of the model")
    parser.add_argument(
        "--order", type=int, default=0, metavar="N", help="number of equal lags of the model"
    )
    parser.add_argument("--json", action="store_true", help="print the model as a JSON document")
    return parser


def _run(options: argparse.Namespace) -> int:
    numbers = given_quantities(options, NUMBERS)
    known = Known(structure=options.structure, order=options.order)
    found = identify_chart(options.method, numbers, known)
    if options.json:
        print(to_json(to_document(found)), flush=True)
    else:
        print("\n".join(identification_lines(found, width())))
    return DONE
