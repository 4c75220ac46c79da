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
from relay_autotune.identification.estimate import Estimate, jacobian
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods.thyagarajan2003 import (
    HIGHER_ORDER,
    SMALL_DEAD_TIME,
    dead_time_ratio,
    flat_fopdt,
    fopdt,
    higher_order,
    lags_from_cycle,
    order_from_curvature,
    small_dead_time,
    unstable_fopdt,
)
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.shown.limit_cycle import (
    NOT_SETTLED,
    relay_test,
    require_unbiased,
    skew_warning,
)
from relay_autotune.identification.shown.shape import (
    Reading,
    Shape,
    curvature_time,
    envelope,
    read_shape,
)
from relay_autotune.process.model_parameters import DEAD_TIME, GAIN, TIME_CONSTANT, Parameter
from relay_autotune.process.structures import FOPDT, IPDT, LAG_N, UNSTABLE_FOPDT, Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record

METHOD = "thyagarajan"

_TOO_LITTLE_DIFFERENCE = 1e-3
_STEP = 1e-4
_DEVIATIONS = 2.0
_OTHER_RATIO = 0.01


@dataclass(frozen=True)
class Solver:
    """One structure with its equations, for a relay of amplitude 1 that turns a process upwards.

    :param name: the structure, as text.
    :param equations: their numbers in the paper.
    :param structure: of the model.
    :param solve: from shape and the level at which the relay switched to values, shape (p,);
        level None: by the equations of the paper as they stand.
    :param ideal: the level of the relay in the paper's equations; None: they have no place for it.
    """

    name: str
    equations: str
    structure: Structure
    solve: Callable[[Shape, float | None], FloatArray]
    ideal: float | None = 0.0

    def exact(self, shape: Shape) -> FloatArray:
        """Return the values for the level at which the relay switched, shape (p,)."""
        return self.solve(shape, shape.level)

    def literal(self, shape: Shape) -> FloatArray:
        """Return the values by the equations as they stand, shape (p,)."""
        return self.solve(shape, self.ideal)


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
    if known.structure in (FOPDT.name, UNSTABLE_FOPDT.name) and reading.shape.category in (
        "2",
        "3",
    ):
        # One lag has sharp peaks, though noise may hide them.
        reading = read_shape(record, sharp=True)
    extra = settings.extra_delay
    seen = replace(known, dead_time=known.dead_time + extra)
    solver, why = choose(reading, seen)
    warnings = [why]
    if not test.whole.cycle.converged:
        warnings.append(NOT_SETTLED)
    warnings += [w for w in (skew_warning(test.whole),) if w]
    warnings += refinements(reading.shape, record)
    sign = -1.0 if settings.reverse_acting else 1.0
    return _identified(solver, reading, settings.amplitude * sign, extra, warnings)


def identify_numbers(shape: Shape, relay: float, known: Known, categorised: str) -> Identification:
    """Identify a model from the numbers of a shape.

    :param shape: NaN where a number is not known.
    :param relay: amplitude of the relay, negative for a reverse-acting process [u].
    :param known: as for :func:`identify_thyagarajan`.
    :param categorised: category that is taken where no structure is known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    reading = Reading(shape, (), None, 1)
    solver, _ = choose(reading, known, categorised)
    return _identified(solver, reading, relay, 0.0, [])


def choose(reading: Reading, known: Known, categorised: str = "") -> tuple[Solver, str]:
    """Choose the structure, and return it with the reason.

    :param reading: the shape.
    :param known: what is known, with the dead time as the relay saw it.
    :param categorised: category; default: that of the shape.
    :raises IdentificationError: if the method lacks the structure that is known.
    """
    shape, dead_time = reading.shape, known.dead_time
    found = categorised or shape.category
    if not math.isnan(dead_time):
        shape = replace(shape, time_to_peak=dead_time)
    why = (
        f"the shape is of category {found} (q = {shape.sharpness:.2f}, tau_G/P = "
        f"{shape.growth:.2f}, plateau {shape.plateau:.2f} of the half period)"
    )
    match known.structure:
        case FOPDT.name:
            return (_flat() if found == "1b" else _sharp(dead_time)), why
        case UNSTABLE_FOPDT.name:
            return _unstable(dead_time), why
        case LAG_N.name if known.order == 1:
            return _sharp(dead_time), why
        case LAG_N.name if known.order:
            return _lags(known.order, dead_time), why
        case LAG_N.name:
            return _lags(2 if found == "2" else HIGHER_ORDER, dead_time), why
        case "" if known.order > 1:
            return _lags(known.order, dead_time), why
        case "":
            pass
        case other:
            raise IdentificationError(
                f"{METHOD} has no structure {other!r}; it has fopdt, unstable_fopdt and lag_n"
            )
    if found == "1a":
        return _by_peak(reading, shape, dead_time, why)
    if found == "1b":
        return _flat(), f"{why}: FOPDT"
    if found == "2":
        return _lags(2, dead_time), f"{why}: two equal lags with little dead time"
    text = (
        f"{why}: {HIGHER_ORDER} equal lags, which stand for any higher order; the data do not "
        "check that"
    )
    return _lags(HIGHER_ORDER, dead_time), text


def _by_peak(reading: Reading, shape: Shape, dead_time: float, why: str) -> tuple[Solver, str]:
    """Tell a stable from an unstable FOPDT process by when the peak comes."""
    earliest = 0.5 * shape.half_period * (1.0 - shape.level / shape.amplitude)
    late = shape.time_to_peak - earliest
    spread = reading.std("time_to_peak") if reading.covariance is not None else 0.0
    if abs(late) <= max(_DEVIATIONS * spread, 1e-9 * earliest) and math.isnan(dead_time):
        return _integrating(), (
            f"{why}: FOPDT, but with its peak within {_DEVIATIONS:g} standard deviations of P/4: "
            "the time constant is too long to be told from an integrator's or an unstable one's; "
            "gain/time constant is determined and given as the gain of an integrator. A biased "
            "relay would determine the static gain"
        )
    if late > 0.0:
        return _sharp(dead_time), f"{why}: FOPDT"
    return _unstable(dead_time), f"{why}, and its peak comes before P/4: unstable FOPDT"


def _peak_time(shape: Shape, dead_time: float) -> float:
    return shape.time_to_peak if math.isnan(dead_time) else dead_time


def _sharp(dead_time: float) -> Solver:
    def solve(s: Shape, level: float | None) -> FloatArray:
        return np.array(fopdt(s.period, s.amplitude, _peak_time(s, dead_time), 1.0, level or 0.0))

    return Solver("FOPDT", "eqs 10 and 11", FOPDT, solve)


def _unstable(dead_time: float) -> Solver:
    def solve(s: Shape, level: float | None) -> FloatArray:
        peak = _peak_time(s, dead_time)
        return np.array(unstable_fopdt(s.period, s.amplitude, peak, 1.0, level or 0.0))

    return Solver("unstable FOPDT", "eqs 16 and 17", UNSTABLE_FOPDT, solve)


def _integrating() -> Solver:
    def solve(s: Shape, level: float | None) -> FloatArray:
        epsilon = level or 0.0
        if not (s.time_to_peak > 0.0 and s.amplitude > epsilon):
            raise IdentificationError(
                f"the peak of {s.amplitude:g} comes {s.time_to_peak:g} s after the switch at "
                f"{epsilon:g}: this is no limit cycle of a process with dead time"
            )
        # Half a period takes y from epsilon up to a, in D, and down to -epsilon.
        return np.array(((s.amplitude - epsilon) / s.time_to_peak, s.time_to_peak))

    return Solver("integrator with dead time", "the limit of eqs 10 and 11", IPDT, solve)


def _flat() -> Solver:
    def solve(s: Shape, level: float | None) -> FloatArray:
        return np.array(flat_fopdt(s.period, s.amplitude, s.rise, s.rise_half, 1.0, level))

    return Solver("FOPDT", "eqs 20 to 22", FOPDT, solve, ideal=None)


def _lags(order: int, dead_time: float) -> Solver:
    """K/(tau s + 1)^n with the dead time that is known, or that the category assumes."""
    ratio = SMALL_DEAD_TIME if order == 2 else 0.0
    assumed = {"ratio": ratio} if math.isnan(dead_time) else {"dead_time": dead_time}

    def solve(s: Shape, level: float | None) -> FloatArray:
        if level is not None:
            found = lags_from_cycle(order, s.period, s.amplitude, 1.0, level, **assumed)
        elif order == 2:
            found = small_dead_time(s.period, s.amplitude, 1.0)
        else:
            return np.array(higher_order(s.period, s.amplitude, 1.0, order))
        return np.array(found[:2])

    lags = LAG_N.of_order(order)
    return Solver(
        f"{order} equal lags",
        "eqs 23 and 24" if order == 2 else "eqs 26 and 27",
        _TiedLags(lags.name, lags.factors, given=dead_time, ratio=ratio),
        solve,
        ideal=None,
    )


def _identified(
    solver: Solver, reading: Reading, relay: float, extra: float, warnings: list[str]
) -> Identification:
    shape, structure = reading.shape, solver.structure
    if isinstance(structure, _TiedLags):
        structure = replace(structure, extra=extra)

    def scaled(values: FloatArray) -> FloatArray:
        moved = values.copy()
        moved[0] /= relay
        if DEAD_TIME in structure.parameters:
            moved[-1] = max(moved[-1] - extra, 0.0)
        return moved

    values = scaled(solver.exact(shape))
    covariance, quantile = None, NORMAL_95
    if reading.covariance is not None:
        slopes = _jacobian(lambda s: scaled(solver.exact(s)), reading)
        if slopes is not None:
            covariance = slopes @ reading.covariance @ slopes.T
        quantile = float(stdtrit(reading.cycles - 1, 0.975))
    found = identified(METHOD, Estimate.of(structure, values, covariance), quantile)
    remarks = (*_literal(solver, shape, scaled, found), *_sensitive(solver, shape))
    return replace(found, warnings=(*found.warnings, *warnings, *remarks))


def _jacobian(solve: Callable[[Shape], FloatArray], reading: Reading) -> FloatArray | None:
    """Return the derivatives of the values by the shape; None where one has no solution."""
    shape, names = reading.shape, reading.names
    size = [shape.amplitude if n in ("amplitude", "level") else shape.half_period for n in names]
    spread = np.array([reading.std(name) for name in names])
    at = np.array([getattr(shape, name) for name in names])

    def values(x: FloatArray) -> FloatArray:
        return solve(replace(shape, **dict(zip(names, x.tolist(), strict=True))))

    try:
        return jacobian(values, at, np.maximum(_STEP * spread, 1e-9 * np.array(size)))
    except IdentificationError:
        return None


def _literal(
    solver: Solver, shape: Shape, scaled: Callable[[FloatArray], FloatArray], found: Identification
) -> list[str]:
    """Return what the paper's equations give, where that differs."""
    begin = f"as in the paper, for an ideal relay, {solver.equations} "
    if solver.equations not in ("eqs 10 and 11", "eqs 16 and 17"):
        begin = f"as in the paper, by the first harmonic, {solver.equations} "
    try:
        values = scaled(solver.literal(shape))
    except IdentificationError:
        return [f"{begin}would have no solution: the relay switched at {shape.level:.4g}"]
    if np.allclose(values, found.values, rtol=_TOO_LITTLE_DIFFERENCE, atol=0.0):
        return []
    numbers = ", ".join(
        f"{name.replace('_', ' ')} {value:.4g}"
        for name, value in zip(found.parameters, values, strict=True)
    )
    point = ultimate_point(found.estimate.structure.build(values))
    ultimate = f", K_u {point.gain:.4g}" if point else ""
    return [f"{begin}would give {numbers}{ultimate}"]


def _sensitive(solver: Solver, shape: Shape) -> list[str]:
    """Return how much K_u depends on the dead time that two lags are assumed to have."""
    if solver.name != "2 equal lags":
        return []
    points = []
    for ratio in (SMALL_DEAD_TIME, _OTHER_RATIO):
        try:
            gain, tau, dead_time = small_dead_time(
                shape.period, shape.amplitude, 1.0, ratio, shape.level
            )
        except IdentificationError:
            return []
        points.append(ultimate_point(LAG_N.of_order(2).build((gain, tau, dead_time))))
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
