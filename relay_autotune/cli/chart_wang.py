"""The methods of Wang, Hang and Zou for the numbers of a chart."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from relay_autotune.errors import SelectionError
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods.wang import (
    FopdtCycle,
    fopdt_from_biased,
    fopdt_with_gain,
)
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import FOPDT


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
    # With the command turned round a reverse-acting process has a positive gain.
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
