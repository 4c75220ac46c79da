# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `thyagarajan`: the structure by the shape of the limit cycle, then its parameters.

Thyagarajan and Yu, "Improved Autotuning Using the Shape Factor from Relay Feedback", Ind. Eng.
Chem. Res. 2003. The equations are exact, with all harmonics and the level at which the relay was
seen to switch; the paper's are for an ideal relay, and eqs 21 to 24, 26 and 27 for the first
harmonic alone, which a warning tells. The paper solved eq 23 with 22/7 for pi.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import Reading
from relay_autotune.identification.limit_cycle.limit_cycle import (
    SymmetricCycle,
    relay_test,
)
from relay_autotune.identification.limit_cycle.shape import (
    VARYING,
    Shape,
    curvature_time,
    envelope,
    read_shape,
)
from relay_autotune.identification.methods.lags import EXACT, FIRST, equal
from relay_autotune.identification.methods.solved import literally, solved, structure_asked_for
from relay_autotune.identification.methods.wang import flat_fopdt, fopdt
from relay_autotune.identification.result import Identification
from relay_autotune.process.structures import (
    FOPDT,
    IPDT,
    LAG_N,
    UNSTABLE_FOPDT,
    Structure,
    equal_lags,
)
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record

METHOD = "thyagarajan"
SMALL_DEAD_TIME = 0.001
HIGHER_ORDER = 5

_STRUCTURES = (FOPDT, UNSTABLE_FOPDT, LAG_N)
_PEAK = VARYING.index("time_to_peak")
_DEVIATIONS = 2.0
_OTHER_RATIO = 0.01


def dead_time_ratio(growth: float) -> float:
    """Return D/tau of a second-order process (eq 25, the logarithm to base 10).

    Within 10 % at D/tau = 0.001 and 0.01, 40 to 50 % too large between, useless above.

    :param growth: tau_G/P, the time constant of the growing peaks over the period.
    """
    return float(10.0 ** (-0.3031 * growth - 1.4767))


def order_from_curvature(curvature: float) -> float:
    """Return the order n (eq 28, the logarithm to base 10).

    The paper does not define tau_C; see :func:`~relay_autotune.identification.limit_cycle.shape.
    curvature_time`. Even for that reading n = 5 comes out as 7, and any other start of the test
    than at rest under an ideal relay gives other numbers.

    :param curvature: tau_C/P.
    """
    return float(10.0 ** (1.9040 - 1.3736 * curvature))


@dataclass(frozen=True)
class Row:
    """One structure with its equations, for a relay of amplitude 1 that turns a process upwards.

    :param paper: the equations in the paper, and what they leave out.
    :param structure: of the model.
    :param solve: from shape and the level at which the relay switches to values, shape (p,);
        None: by the equations of the paper as they stand.
    :param text: why this structure; empty: it was asked for.
    """

    paper: str
    structure: Structure
    solve: Callable[[Shape, float | None], Sequence[float]]
    text: str = ""


def _by_peak(structure: Structure) -> Row:
    unstable = structure.unstable
    equations = "eqs 16 and 17" if unstable else "eqs 10 and 11"
    text = "its peak comes before P/4, so that it is an unstable FOPDT" if unstable else "FOPDT"

    def solve(s: Shape, level: float | None) -> Sequence[float]:
        return fopdt(s.period, s.amplitude, s.time_to_peak, 1.0, level or 0.0, unstable=unstable)

    return Row(f"for an ideal relay, {equations}", structure, solve, text)


def _integrator(s: Shape, level: float | None) -> tuple[float, float]:
    epsilon = level or 0.0
    if not (s.time_to_peak > 0.0 and s.amplitude > epsilon):
        raise IdentificationError(
            f"the peak of {s.amplitude:g} comes {s.time_to_peak:g} s after the switch at "
            f"{epsilon:g}: this is no limit cycle of a process with dead time"
        )
    # Half a period takes y from epsilon up to a, in D, and down to -epsilon.
    return (s.amplitude - epsilon) / s.time_to_peak, s.time_to_peak


def _flat(s: Shape, level: float | None) -> Sequence[float]:
    return flat_fopdt(s.period, s.amplitude, s.rise, s.rise_half, 1.0, level)


SHARP_FOPDT, _UNSTABLE_FOPDT = _by_peak(FOPDT), _by_peak(UNSTABLE_FOPDT)
FLAT_FOPDT = Row("by the first harmonic, eqs 20 to 22", FOPDT, _flat, "FOPDT")
_INTEGRATING = Row(
    "for an ideal relay, the limit of eqs 10 and 11",
    IPDT,
    _integrator,
    f"FOPDT, but with its peak within {_DEVIATIONS:g} standard deviations of P/4: the time "
    "constant is too long to be told from an integrator's or an unstable one's; gain/time "
    "constant is determined and given as the gain of an integrator. A biased relay would "
    "determine the static gain",
)


def equal_lags_row(order: int, dead_time: float = math.nan, ratio: float = math.nan) -> Row:
    """Return the row of K/(tau s + 1)^n with a dead time.

    :param order: n.
    :param dead_time: where it is known [s].
    :param ratio: else D/tau; default: what the category assumes.
    """
    known, two = not math.isnan(dead_time), order == 2
    assumed = ratio if not math.isnan(ratio) else SMALL_DEAD_TIME if two else 0.0

    def solve(s: Shape, level: float | None) -> tuple[float, float, float]:
        wave = FIRST if level is None else EXACT
        given = dead_time if known and level is not None else 0.0
        ratio = 0.0 if given else assumed
        cycle = SymmetricCycle(s.period, s.amplitude, 1.0, level or 0.0, given)
        gain, tau = equal(order, cycle, wave=wave, ratio=ratio)
        return gain, tau, given + ratio * tau

    equations = "eqs 23 and 24" if two else "eqs 26 and 27"
    text = (
        "two equal lags with little dead time"
        if two
        else f"{order} equal lags, which stand for any higher order; the data do not check that"
    )
    return Row(f"by the first harmonic, {equations}", equal_lags(order), solve, text)


def identify_thyagarajan(record: Record, known: Known = NOTHING) -> Identification:
    """Identify a model from an unbiased relay test, its structure by the shape of the response.

    Category 1a: stable or unstable FOPDT (eqs 10, 11 or 16, 17), 1b: FOPDT (eq 20), 2: two equal
    lags with D = 0.001 tau (eqs 23, 24), 3: five equal lags (eqs 26, 27); all exact, with the
    level at which the relay switched.

    :param record: a relay test without bias.
    :param known: a structure ("fopdt", "unstable_fopdt" or "lag_n" with its order) takes the
        place of the category's; a dead time takes that of the time to the peak, or of the one
        that the structure assumes.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    test = relay_test(METHOD, record, unbiased=True)
    shape, reading = read_shape(record)
    one_lag = known.structure in (FOPDT.name, UNSTABLE_FOPDT.name)
    if one_lag and shape.category in ("2", "3"):
        # One lag has sharp peaks, though noise may hide them.
        shape, reading = read_shape(record, sharp=True)
    asked = replace(known, dead_time=known.dead_time + test.settings.extra_delay)
    row = _chosen(shape, reading, asked)
    why = (
        f"the shape is of category {shape.category} (q = {shape.sharpness:.2f}, tau_G/P = "
        f"{shape.growth:.2f}, plateau {shape.plateau:.2f} of the half period)"
        + (f": {row.text}" if row.text else "")
    )
    remarks = [why, *test.remarks(), *_refinements(shape, record)]
    relay, late = test.sign * test.settings.amplitude, test.settings.extra_delay
    return _identified(row, shape, reading, relay, asked.dead_time, remarks, late)


def identify_numbers(shape: Shape, relay: float, known: Known, categorised: str) -> Identification:
    """Identify a model from the numbers of a shape.

    :param shape: NaN where a number is not known.
    :param relay: amplitude of the relay, negative for a reverse-acting process [u].
    :param known: as for :func:`identify_thyagarajan`.
    :param categorised: category that is taken where no structure is known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    reading = Reading(np.array([getattr(shape, name) for name in VARYING]))
    row = _chosen(shape, reading, known, categorised)
    return _identified(row, shape, reading, relay, known.dead_time, [])


def _chosen(shape: Shape, reading: Reading, known: Known, categorised: str = "") -> Row:
    """Return the row of the structure that is known, or of the category.

    :param known: with the dead time as the relay saw it.
    :param categorised: category; default: that of the shape.
    """
    category, dead_time = categorised or shape.category, known.dead_time
    order = 2 if category == "2" else HIGHER_ORDER
    if known.structure == LAG_N.name and not known.order:
        known = replace(known, order=order)
    structure = structure_asked_for(METHOD, known, _STRUCTURES)
    if structure is not None:
        one_lag = FLAT_FOPDT if category == "1b" else SHARP_FOPDT
        rows = {FOPDT: one_lag, UNSTABLE_FOPDT: _UNSTABLE_FOPDT}
        return replace(rows.get(structure) or equal_lags_row(structure.order, dead_time), text="")
    if category in ("2", "3"):
        return equal_lags_row(order, dead_time)
    if category == "1b":
        return FLAT_FOPDT
    peak = shape.time_to_peak if math.isnan(dead_time) else dead_time
    earliest = 0.5 * shape.half_period * (1.0 - shape.level / shape.amplitude)
    unsure = max(_DEVIATIONS * float(np.nan_to_num(reading.std[_PEAK])), 1e-9 * earliest)
    if abs(peak - earliest) <= unsure and math.isnan(dead_time):
        return _INTEGRATING
    return SHARP_FOPDT if peak > earliest else _UNSTABLE_FOPDT


def _identified(
    row: Row,
    shape: Shape,
    reading: Reading,
    relay: float,
    dead_time: float,
    remarks: list[str],
    late: float = 0.0,
) -> Identification:
    """Solve a row, with a dead time that is known in the place of the time to the peak."""
    if not math.isnan(dead_time):
        reading = reading.with_number(_PEAK, dead_time, 0.0)

    def at(numbers: FloatArray) -> Shape:
        return replace(shape, **dict(zip(VARYING, numbers.tolist(), strict=True)))

    def values(numbers: FloatArray, *, literal: bool = False) -> Sequence[float]:
        moved = at(numbers)
        gain, *others = row.solve(moved, None if literal else moved.level)
        return gain / abs(relay), *others

    here = reading.values
    remarks += literally(
        row.paper, row.structure, lambda: values(here, literal=True), values(here)
    )
    if row.structure.order == 2 and math.isnan(dead_time):
        remarks += _sensitive(at(here))
    sign, found = 1 if relay > 0.0 else -1, (METHOD, row.structure, values, reading)
    return solved(*found, sign=sign, late=late, remarks=remarks)


def _sensitive(shape: Shape) -> list[str]:
    """Return how much K_u depends on the dead time that two lags are assumed to have."""
    gains = []
    cycle = SymmetricCycle(shape.period, shape.amplitude, 1.0, shape.level, 0.0)
    for ratio in (SMALL_DEAD_TIME, _OTHER_RATIO):
        try:
            gain, tau = equal(2, cycle, ratio=ratio)
        except IdentificationError:
            return []
        point = ultimate_point(equal_lags(2).build((gain, tau, ratio * tau)))
        gains.append(point.gain if point else math.nan)
    return [
        f"D/tau = {SMALL_DEAD_TIME:g} is an assumption: with {_OTHER_RATIO:g} K_u would change by "
        f"{100.0 * (gains[1] / gains[0] - 1.0):+.0f} %; a hysteresis makes that worse. "
        "Give the dead time where it is known"
    ]


def _refinements(shape: Shape, record: Record) -> list[str]:
    """Return what eqs 25 and 28 would give; nothing is chosen by them."""
    if shape.category == "2":
        return [
            f"eq 25 would have D/tau = {dead_time_ratio(shape.growth):.2g}; it is 10 % off at "
            "0.001 and 0.01, up to 46 % between, and useless above: not used"
        ]
    curvature = curvature_time(envelope(record), shape.amplitude) / shape.period
    if shape.category != "3" or math.isnan(curvature):
        return []
    return [
        f"eq 28 would have {order_from_curvature(curvature):.1f} lags; its tau_C is not defined "
        "in the paper and depends on how the test starts: not used"
    ]
