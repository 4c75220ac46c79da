# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `thyagarajan`: the structure by the shape of the limit cycle, then its parameters.

Thyagarajan and Yu 2003. The exact equations are used, with the level at which the relay was seen
to switch; a warning tells what the paper's own equations give.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import stdtrit

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, carried
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.limit_cycle import (
    NOT_SETTLED,
    SymmetricCycle,
    relay_test,
    require_unbiased,
    skew_warning,
)
from relay_autotune.identification.limit_cycle.shape import (
    Reading,
    Shape,
    curvature_time,
    envelope,
    read_shape,
)
from relay_autotune.identification.methods.lags import equal
from relay_autotune.identification.methods.square_wave import FIRST
from relay_autotune.identification.methods.thyagarajan2003 import (
    HIGHER_ORDER,
    SMALL_DEAD_TIME,
    dead_time_ratio,
    flat_fopdt,
    fopdt,
    order_from_curvature,
    unstable_fopdt,
)
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.model_parameters import DEAD_TIME, GAIN, TIME_CONSTANT, Parameter
from relay_autotune.process.structures import FOPDT, IPDT, LAG_N, UNSTABLE_FOPDT, Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record

METHOD = "thyagarajan"

_TOO_LITTLE_DIFFERENCE = 1e-3
_DEVIATIONS = 2.0
_OTHER_RATIO = 0.01


@dataclass(frozen=True)
class Row:
    """One structure with its equations, for a relay of amplitude 1 that turns a process upwards.

    :param name: the structure, as text.
    :param equations: their numbers in the paper.
    :param structure: of the model.
    :param solve: from shape and the level at which the relay switched to values, shape (p,);
        None: by the equations of the paper as they stand.
    :param harmonic: whether these use the first harmonic.
    """

    name: str
    equations: str
    structure: Structure
    solve: Callable[[Shape, float | None], Sequence[float]]
    harmonic: bool = False


@dataclass(frozen=True)
class _TiedLags(Structure):
    """Equal lags whose dead time is known, or follows from the lag: it is not a parameter.

    :param given: dead time [s]; NaN: it follows from the lag.
    :param ratio: dead time over time constant.
    :param extra: dead time of the relay, which the two others include [s].
    """

    given: float = math.nan
    ratio: float = 0.0
    extra: float = 0.0

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Gain and time constant."""
        return (GAIN, TIME_CONSTANT)

    def build(self, values: Sequence[float] | FloatArray) -> TransferFunction:
        """Return the transfer function of gain and time constant."""
        gain, tau = values
        dead_time = self.ratio * tau if math.isnan(self.given) else self.given
        return LAG_N.of_order(self.order).build((gain, tau, max(dead_time - self.extra, 0.0)))


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
    test = relay_test(METHOD, record)
    settings = test.whole.settings
    require_unbiased(METHOD, settings)
    reading = read_shape(record)
    one_lag = known.structure in (FOPDT.name, UNSTABLE_FOPDT.name)
    if one_lag and reading.shape.category in ("2", "3"):
        # One lag has sharp peaks, though noise may hide them.
        reading = read_shape(record, sharp=True)
    extra = settings.extra_delay
    shape = reading.shape
    row, reading, why = choose(reading, replace(known, dead_time=known.dead_time + extra))
    warnings = [why, "" if test.whole.cycle.converged else NOT_SETTLED, skew_warning(test.whole)]
    warnings = [w for w in warnings if w] + refinements(shape, record)
    sign = -1.0 if settings.reverse_acting else 1.0
    return _identified(row, reading, settings.amplitude * sign, extra, warnings)


def identify_numbers(shape: Shape, relay: float, known: Known, categorised: str) -> Identification:
    """Identify a model from the numbers of a shape.

    :param shape: NaN where a number is not known.
    :param relay: amplitude of the relay, negative for a reverse-acting process [u].
    :param known: as for :func:`identify_thyagarajan`.
    :param categorised: category that is taken where no structure is known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    row, reading, _ = choose(Reading(shape, (), None, 1), known, categorised)
    return _identified(row, reading, relay, 0.0, [])


def choose(reading: Reading, known: Known, categorised: str = "") -> tuple[Row, Reading, str]:
    """Choose the structure, and return it with the reading and the reason.

    A dead time that is known takes the place of the time to the peak in the reading.

    :param reading: the shape.
    :param known: what is known, with the dead time as the relay saw it.
    :param categorised: category; default: that of the shape.
    :raises IdentificationError: if the method lacks the structure that is known.
    """
    shape, dead_time = reading.shape, known.dead_time
    found = categorised or shape.category
    why = (
        f"the shape is of category {found} (q = {shape.sharpness:.2f}, tau_G/P = "
        f"{shape.growth:.2f}, plateau {shape.plateau:.2f} of the half period)"
    )
    if not math.isnan(dead_time):
        reading = reading.given("time_to_peak", dead_time)
    orders = {"2": 2, "3": HIGHER_ORDER}
    structure = known.structure or (LAG_N.name if known.order > 1 else "")
    if structure == FOPDT.name:
        return (_FLAT if found == "1b" else _SHARP), reading, why
    if structure == UNSTABLE_FOPDT.name:
        return _UNSTABLE, reading, why
    if structure == LAG_N.name:
        order = known.order or orders.get(found, HIGHER_ORDER)
        return (_SHARP if order == 1 else _lags(order, dead_time)), reading, why
    if structure:
        raise IdentificationError(
            f"{METHOD} has no structure {structure!r}; it has fopdt, unstable_fopdt and lag_n"
        )
    if found in orders:
        row = _lags(orders[found], dead_time)
        text = {
            "2": "two equal lags with little dead time",
            "3": f"{HIGHER_ORDER} equal lags, which stand for any higher order; the data do not "
            "check that",
        }[found]
    elif found == "1b":
        row, text = _FLAT, "FOPDT"
    else:
        row, text = _by_peak(reading, known=not math.isnan(dead_time))
    return row, reading, f"{why}: {text}"


def _by_peak(reading: Reading, *, known: bool) -> tuple[Row, str]:
    """Tell a stable from an unstable FOPDT process by when the peak comes."""
    shape = reading.shape
    earliest = 0.5 * shape.half_period * (1.0 - shape.level / shape.amplitude)
    late = shape.time_to_peak - earliest
    spread = reading.std("time_to_peak") if reading.covariance is not None else 0.0
    if abs(late) <= max(_DEVIATIONS * spread, 1e-9 * earliest) and not known:
        return _INTEGRATING, (
            f"FOPDT, but with its peak within {_DEVIATIONS:g} standard deviations of P/4: "
            "the time constant is too long to be told from an integrator's or an unstable one's; "
            "gain/time constant is determined and given as the gain of an integrator. A biased "
            "relay would determine the static gain"
        )
    if late > 0.0:
        return _SHARP, "FOPDT"
    return _UNSTABLE, "its peak comes before P/4, so that it is an unstable FOPDT"


def _integrator(s: Shape, level: float | None) -> tuple[float, float]:
    epsilon = level or 0.0
    if not (s.time_to_peak > 0.0 and s.amplitude > epsilon):
        raise IdentificationError(
            f"the peak of {s.amplitude:g} comes {s.time_to_peak:g} s after the switch at "
            f"{epsilon:g}: this is no limit cycle of a process with dead time"
        )
    # Half a period takes y from epsilon up to a, in D, and down to -epsilon.
    return (s.amplitude - epsilon) / s.time_to_peak, s.time_to_peak


def _flat(s: Shape, level: float | None) -> tuple[float, float, float]:
    return flat_fopdt(s.period, s.amplitude, s.rise, s.rise_half, 1.0, level)


_SHARP = Row(
    *("FOPDT", "eqs 10 and 11", FOPDT),
    lambda s, level: fopdt(s.period, s.amplitude, s.time_to_peak, 1.0, level or 0.0),
)
_UNSTABLE = Row(
    *("unstable FOPDT", "eqs 16 and 17", UNSTABLE_FOPDT),
    lambda s, level: unstable_fopdt(s.period, s.amplitude, s.time_to_peak, 1.0, level or 0.0),
)
_INTEGRATING = Row(
    *("integrator with dead time", "the limit of eqs 10 and 11", IPDT), _integrator, harmonic=True
)
_FLAT = Row(*("FOPDT", "eqs 20 to 22", FOPDT), _flat, harmonic=True)


def _lags(order: int, dead_time: float) -> Row:
    """K/(tau s + 1)^n with the dead time that is known, or that the category assumes."""
    assumed = SMALL_DEAD_TIME if order == 2 else 0.0
    known = not math.isnan(dead_time)

    def solve(s: Shape, level: float | None) -> tuple[float, float]:
        cycle = SymmetricCycle(s.period, s.amplitude, 1.0, 0.0, 0.0, level or 0.0)
        if level is None:
            return equal(order, cycle, wave=FIRST, ratio=assumed)
        if known:
            return equal(order, replace(cycle, dead_time=dead_time))
        return equal(order, cycle, ratio=assumed)

    lags = LAG_N.of_order(order)
    structure = _TiedLags(lags.name, lags.factors, given=dead_time, ratio=assumed)
    equations = "eqs 23 and 24" if order == 2 else "eqs 26 and 27"
    return Row(f"{order} equal lags", equations, structure, solve, harmonic=True)


def _identified(
    row: Row, reading: Reading, relay: float, extra: float, warnings: list[str]
) -> Identification:
    shape, structure = reading.shape, row.structure
    if isinstance(structure, _TiedLags):
        structure = replace(structure, extra=extra)

    def values(s: Shape, level: float | None) -> FloatArray:
        found = np.array(row.solve(s, level))
        found[0] /= relay
        if DEAD_TIME in structure.parameters:
            found[-1] = max(found[-1] - extra, 0.0)
        return found

    best = values(shape, shape.level)
    covariance, quantile = None, NORMAL_95
    if reading.covariance is not None:

        def of_features(features: FloatArray) -> FloatArray:
            moved = reading.at(features)
            return values(moved, moved.level)

        covariance = carried(of_features, reading.features, reading.covariance)
        quantile = float(stdtrit(reading.cycles - 1, 0.975))
    found = identified(METHOD, Estimate.of(structure, best, covariance), quantile)
    remarks = (*_literal(row, shape, values, found), *_sensitive(row, shape))
    return replace(found, warnings=(*found.warnings, *warnings, *remarks))


def _literal(
    row: Row,
    shape: Shape,
    values: Callable[[Shape, float | None], FloatArray],
    found: Identification,
) -> list[str]:
    """Return what the paper's equations give, where that differs."""
    by = "by the first harmonic" if row.harmonic else "for an ideal relay"
    begin = f"as in the paper, {by}, {row.equations} "
    try:
        literal = values(shape, None)
    except IdentificationError:
        return [f"{begin}would have no solution: the relay switched at {shape.level:.4g}"]
    if np.allclose(literal, found.values, rtol=_TOO_LITTLE_DIFFERENCE, atol=0.0):
        return []
    numbers = ", ".join(
        f"{name.replace('_', ' ')} {value:.4g}"
        for name, value in zip(found.parameters, literal, strict=True)
    )
    point = ultimate_point(found.estimate.structure.build(literal))
    ultimate = f", K_u {point.gain:.4g}" if point else ""
    return [f"{begin}would give {numbers}{ultimate}"]


def _sensitive(row: Row, shape: Shape) -> list[str]:
    """Return how much K_u depends on the dead time that two lags are assumed to have."""
    if row.name != "2 equal lags":
        return []
    points = []
    cycle = SymmetricCycle(shape.period, shape.amplitude, 1.0, 0.0, 0.0, shape.level)
    for ratio in (SMALL_DEAD_TIME, _OTHER_RATIO):
        try:
            gain, tau = equal(2, cycle, ratio=ratio)
        except IdentificationError:
            return []
        points.append(ultimate_point(LAG_N.of_order(2).build((gain, tau, ratio * tau))))
    first, second = points
    if first is None or second is None:
        return []
    return [
        f"D/tau = {SMALL_DEAD_TIME:g} is an assumption: with {_OTHER_RATIO:g} K_u would change by "
        f"{100.0 * (second.gain / first.gain - 1.0):+.0f} %; a hysteresis makes that worse. "
        "Give the dead time where it is known"
    ]


def refinements(shape: Shape, record: Record) -> list[str]:
    """Return what eqs 25 and 28 would give; nothing is chosen by them.

    :param shape: of the record.
    :param record: the relay test, from its start.
    """
    if shape.category == "2":
        return [
            f"eq 25 would have D/tau = {dead_time_ratio(shape.growth):.2g}; it is 10 % off at "
            "0.001 and 0.01, up to 46 % between, and useless above: not used"
        ]
    if shape.category != "3":
        return []
    curvature = curvature_time(envelope(record), shape.amplitude) / shape.period
    if math.isnan(curvature):
        return []
    return [
        f"eq 28 would have {order_from_curvature(curvature):.1f} lags; its tau_C is not defined "
        "in the paper and depends on how the test starts: not used"
    ]
