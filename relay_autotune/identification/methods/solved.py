# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What every method that solves equations has in common: its refusals, covariance and remarks.

A method reads some numbers of a relay test, and its equations turn them into the parameters of a
structure. From there on all are alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, carried
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.fold import Reading
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import LAG_N, Structure, equal_lags
from relay_autotune.process.ultimate import ultimate_point

# Relative difference of two solutions that is worth a remark.
_TOO_LITTLE_DIFFERENCE = 1e-3


def structure_asked_for(
    method: str, known: Known, structures: Sequence[Structure]
) -> Structure | None:
    """Return the structure that is known, or None where the choice is the method's.

    :param method: its name, for the message.
    :param known: a known structure, a known order.
    :param structures: those of the method; equal lags stand for any number of them.
    :raises IdentificationError: if it is none of these, or needs an order, or has another one.
    """
    name, order = known.structure, known.order
    if not name:
        return equal_lags(order) if order and LAG_N in structures else None
    found = {each.name: each for each in structures}.get(name)
    if found is None:
        raise IdentificationError(
            f"{method} has no structure {name!r}; it has {', '.join(s.name for s in structures)}"
        )
    if found.any_order:
        if not order:
            raise IdentificationError(
                f"the structure {name} needs its order, the number of equal lags: give it"
            )
        return equal_lags(order)
    if order not in (0, found.order):
        raise IdentificationError(
            f"the structure {name} has {found.order} lags, but the order given is {order}: leave "
            "one of the two out"
        )
    return found


def solved(
    method: str,
    structure: Structure,
    equations: Callable[[FloatArray], Sequence[float]],
    reading: Reading,
    *,
    sign: int = 1,
    extra_delay: float = 0.0,
    remarks: Sequence[str] = (),
) -> Identification:
    """Solve the equations of a method for what was read, and carry its scatter through them.

    :param method: its name in the registry.
    :param structure: of the model.
    :param equations: from the numbers read to the values of the parameters, for a relay that
        turns the process upwards, with the dead time that the relay added.
    :param reading: the numbers.
    :param sign: of the gain.
    :param extra_delay: dead time that the relay added [s].
    :param remarks: sentences for the user; empty ones are left out.
    :raises IdentificationError: if the equations have no solution.
    """

    def values(numbers: FloatArray) -> FloatArray:
        found = np.array(equations(numbers))
        found[0] *= sign
        found[-1] = max(found[-1] - extra_delay, 0.0)
        return found

    best, covariance = values(reading.values), None
    if reading.covariance is not None:
        covariance = carried(values, reading.values, reading.covariance)
    estimate = Estimate.of(structure, best, covariance)
    warnings = tuple(r for r in remarks if r)
    return identified(method, estimate, reading.quantile, warnings=warnings)


def literally(
    how: str,
    structure: Structure,
    solve: Callable[[], Sequence[float]],
    found: Sequence[float] | FloatArray,
) -> list[str]:
    """Return what the equations of a paper give as they stand, if that is something else.

    :param how: which equations, and what they leave out.
    :param structure: of the model.
    :param solve: returns the values by these equations.
    :param found: the values by the exact ones, shape (p,).
    """
    try:
        literal = np.array(solve())
    except IdentificationError:
        return [f"as in the paper, {how} would have no solution"]
    if np.allclose(literal, found, rtol=_TOO_LITTLE_DIFFERENCE, atol=0.0):
        return []
    numbers = ", ".join(
        f"{name.replace('_', ' ')} {value:.4g}"
        for name, value in zip(structure.names, literal, strict=True)
    )
    point = ultimate_point(structure.build(literal))
    ultimate = f", K_u {point.gain:.4g}" if point else ""
    return [f"as in the paper, {how} would give {numbers}{ultimate}"]
