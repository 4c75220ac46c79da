"""The method of Thyagarajan and Yu for the numbers of a chart."""

from __future__ import annotations

import math
from collections.abc import Mapping

from relay_autotune.errors import SelectionError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods.thyagarajan_method import identify_numbers
from relay_autotune.identification.result import Identification
from relay_autotune.identification.shown.shape import Shape


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
    # Whoever reads the time to half of the peak takes the curve for a rectangular one.
    category = "1a" if math.isnan(half) else "1b"
    return identify_numbers(shape, numbers["relay"], known, category)
