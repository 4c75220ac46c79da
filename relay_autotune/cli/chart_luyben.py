"""Luyben's step test for the numbers of a chart."""

from __future__ import annotations

from collections.abc import Mapping

from relay_autotune.identification.known import Known
from relay_autotune.identification.methods.luyben import (
    identify_step_numbers,
    require_structure,
)
from relay_autotune.identification.result import Identification


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
