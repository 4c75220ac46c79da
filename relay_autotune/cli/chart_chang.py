"""The methods for an unbiased relay for the numbers of a chart."""

from __future__ import annotations

from collections.abc import Mapping

from relay_autotune.identification.known import Known
from relay_autotune.identification.methods.atv import atv_from_numbers
from relay_autotune.identification.methods.chang import chang_from_numbers
from relay_autotune.identification.methods.li import li_from_numbers
from relay_autotune.identification.result import Identification
from relay_autotune.identification.shown.symmetric_cycle import SymmetricCycle


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
