# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The methods for an unbiased relay that find lags: the choice of a model, and its uncertainty.

Period, amplitude, level at the switch and dead time are what the test tells; the equations of
:mod:`~relay_autotune.identification.methods.lags` make a model of them. If the gain is known,
period and amplitude each give a time constant of models 1 to 3; their difference shows whether the
structure is right. The simplest model that fits is used (Luyben 1987, Chang, Shen and Yu 1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.estimate import Estimate, carried
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.dead_time import DeadTime, read_dead_time
from relay_autotune.identification.limit_cycle.limit_cycle import (
    NOT_SETTLED,
    CycleReader,
    CycleRun,
    SymmetricCycle,
    half_cycles,
    known_gain,
    relay_test,
    require_unbiased,
    skew_warning,
)
from relay_autotune.identification.methods.lags import (
    MODEL_1,
    MODEL_4,
    MODEL_5,
    constants_text,
    equal,
    lags_of,
    model_asked_for,
    model_text,
    solutions,
    with_amplitude,
)
from relay_autotune.identification.methods.square_wave import EXACT, Wave, level
from relay_autotune.identification.result import Identification, identified
from relay_autotune.process.structures import Structure, equal_lags
from relay_autotune.quantities import NORMAL_95
from relay_autotune.record.record import Record

_MOST_EQUAL = 20
# Ratio of two misfits of the half cycles up to which structures are equally good, and the misfit
# that sampling causes, as a share of the amplitude.
_ALIKE = 1.02
_ALIKE_SHARE = 3e-3
_SHAPE_SAMPLES = 300

# Gain and time constants.
Solution = tuple[float, ...]


@dataclass(frozen=True)
class SymmetricMethod:
    """A method that finds one of models 1 to 5 from a symmetric limit cycle.

    :param name: its name in the registry.
    :param wave: which harmonics count in its equations; without :data:`EXACT` the hysteresis that
        is told counts, not the level at which the relay was seen to switch.
    :param agreement: largest mismatch that counts as zero where its scatter is not known.
    :param remarks: from model, limit cycle and gain to sentences for the user.
    """

    name: str
    wave: Wave
    agreement: float
    remarks: Callable[[Structure, SymmetricCycle, float], list[str]]

    def solve(self, model: Structure, cycle: SymmetricCycle, gain: float) -> list[Solution]:
        """Return the solutions of a model.

        Equal lags with a known gain have an equation too many: exactly their time constant is
        that of the period; by the describing function it is the mean of both.

        :param model: which one.
        :param cycle: the limit cycle.
        :param gain: K > 0 [y/u]; NaN: not known.
        :raises IdentificationError: if there is none, or models 4 or 5 lack the gain.
        """
        if self.wave is EXACT or not model.equal_lags or math.isnan(gain):
            return solutions(model, cycle, gain, self.wave)
        return [(gain, 0.5 * sum(self._both(model.order, cycle, gain)))]

    def mismatch(self, order: int, cycle: SymmetricCycle, gain: float) -> float:
        """Return log(tau by the period/tau by the amplitude) of n equal lags.

        :param order: n >= 1.
        :param cycle: the limit cycle.
        :param gain: K > 0 [y/u].
        :return: zero: the structure fits; positive: the process has more lag; infinite: no time
            constant gives the period; negative: it has less lag.
        :raises IdentificationError: if the gain is too small for the amplitude or the hysteresis,
            or the dead time too large for the period.
        """
        try:
            by_amplitude, by_period = self._both(order, cycle, gain)
        except IdentificationError:
            # Unless the numbers themselves cannot be.
            self._by_amplitude(order, cycle, gain)
            if cycle.part <= 0.0 or not cycle.level < min(gain * cycle.relay, cycle.amplitude):
                raise
            return math.inf
        return math.log(by_period / by_amplitude)

    def excess(self, order: int, cycle: SymmetricCycle, gain: float) -> float:
        """Return y/(K h) at the switch minus what it should be, of n equal lags by the amplitude.

        :param order: n >= 1, as for :meth:`mismatch`, whose sign it has.
        """
        lags = (self._by_amplitude(order, cycle, gain),) * order
        height = self.wave.level(lags, cycle.period, max(cycle.part, 0.0))
        return height - cycle.level / (gain * cycle.relay)

    def _by_amplitude(self, order: int, cycle: SymmetricCycle, gain: float) -> float:
        relative = cycle.amplitude / (gain * cycle.relay)
        return with_amplitude((1.0 / order,) * order, cycle.period, relative, self.wave)[0]

    def _both(self, order: int, cycle: SymmetricCycle, gain: float) -> tuple[float, float]:
        """Return tau by the amplitude and by the period; the phase of the latter needs no gain."""
        by_amplitude = self._by_amplitude(order, cycle, gain)
        told = gain if self.wave is EXACT else math.nan
        return by_amplitude, equal(order, cycle, told, self.wave)[1]


@dataclass(frozen=True)
class LimitCycle:
    """What is known of a limit cycle.

    :param cycle: its numbers; the dead time includes what the relay added.
    :param dead_time: of the process.
    :param sign: of its gain.
    :param covariance: of period, amplitude, level and dead time, shape (4, 4); None: not known.
    :param quantile: half the width of a 95 % interval in standard deviations.
    :param whole: the cycles in the record; None: there is none.
    """

    cycle: SymmetricCycle
    dead_time: DeadTime
    sign: int
    covariance: FloatArray | None = None
    quantile: float = NORMAL_95
    whole: CycleRun | None = None

    @property
    def features(self) -> FloatArray:
        """Period, amplitude, level at the switch and dead time."""
        cycle = self.cycle
        return np.array((cycle.period, cycle.amplitude, cycle.level, cycle.dead_time))

    def at(self, features: FloatArray) -> SymmetricCycle:
        """Return the limit cycle with other features."""
        period, amplitude, height, dead_time = features.tolist()
        return replace(
            self.cycle,
            period=period,
            amplitude=amplitude,
            # The scatter about zero is that of the reading, to both sides.
            switch_level=min(height, 0.99 * amplitude),
            dead_time=max(dead_time, 0.0),
        )

    def std(self, function: Callable[[SymmetricCycle], float]) -> float:
        """Return the standard deviation of a number of the cycle; NaN: not known."""
        if self.covariance is None:
            return math.nan

        def number(features: FloatArray) -> FloatArray:
            return np.array([function(self.at(features))])

        spread = carried(number, self.features, self.covariance)
        return math.sqrt(spread[0, 0])


def read_limit_cycle(method: SymmetricMethod, record: Record, known: Known) -> LimitCycle:
    """Return the limit cycle of an unbiased relay test, with its scatter from cycle to cycle.

    :param method: for which method.
    :param record: a relay test without bias.
    :param known: gain and dead time where they are known.
    :raises IdentificationError: if the relay was biased, or the dead time cannot be read.
    """
    test = relay_test(method.name, record)
    whole = test.whole
    require_unbiased(method.name, whole.settings)
    sign = -1 if whole.settings.reverse_acting else 1
    known_gain(known, sign)
    reader = CycleReader.of(whole)
    dead_time = read_dead_time(test, record, known, noisy=reader.noisy)

    def read(stretch: CycleRun) -> SymmetricCycle:
        found = reader.read(stretch, dead_time.value)
        return found if method.wave is EXACT else replace(found, switch_level=math.nan)

    def features(stretch: CycleRun) -> FloatArray:
        found = read(stretch)
        height = reader.level(stretch) if method.wave is EXACT else found.level
        return np.array((found.period, found.amplitude, height, 0.0))

    covariance, quantile = test.scatter(features)
    if covariance is not None:
        covariance[3, 3] = dead_time.std**2
    return LimitCycle(read(whole), dead_time, sign, covariance, quantile, whole)


def from_record(method: SymmetricMethod, record: Record, known: Known) -> Identification:
    """Identify one of models 1 to 5 from an unbiased relay test.

    :param method: how.
    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known. Without the gain
        only equal lags can be found; a dead time that is not known is read from the record;
        without the structure the simplest model that fits is taken.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    return from_cycle(method, read_limit_cycle(method, record, known), known)


def from_numbers(method: SymmetricMethod, cycle: SymmetricCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from the numbers of a limit cycle.

    :param method: how.
    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    sign = -1 if known.gain < 0.0 else 1
    return from_cycle(method, LimitCycle(cycle, DeadTime(cycle.dead_time), sign), known)


def from_cycle(method: SymmetricMethod, seen: LimitCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from a limit cycle, read or told.

    :param method: how.
    :param seen: the limit cycle.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    gain, cycle, whole = abs(known.gain), seen.cycle, seen.whole
    model, remark = model_asked_for(method.name, known), ""
    if model is None:
        choice = _choice_by_shape if math.isnan(gain) else _choice
        model, remark = choice(method, seen, gain)
    found = method.solve(model, cycle, gain)
    if whole is not None:
        found = sorted(found, key=lambda each: shape_misfit(whole, model, cycle, each))
    taken, *others = found

    def values(features: FloatArray) -> FloatArray:
        candidates = method.solve(model, seen.at(features), gain)
        nearest = min(candidates, key=lambda each: _distance(each, taken))
        dead_time = seen.dead_time.value + features[3] - cycle.dead_time
        return np.array((seen.sign * nearest[0], *nearest[1:], max(dead_time, 0.0)))

    covariance = None
    if seen.covariance is not None:
        covariance = carried(values, seen.features, seen.covariance)
    remarks = [seen.dead_time.source, remark]
    if whole is not None:
        remarks += [skew_warning(whole), "" if whole.cycle.converged else NOT_SETTLED]
    if model.equal_lags and not math.isnan(gain):
        remarks.append(_mismatch_text(method, model, cycle, gain))
    remarks += [
        f"{model_text(model)} has two solutions, which period and amplitude do not tell apart: "
        f"{constants_text(taken[1:])} was taken, {constants_text(other[1:])} would do as well"
        for other in others
    ]
    remarks += method.remarks(model, cycle, gain)
    best = np.array((seen.sign * taken[0], *taken[1:], seen.dead_time.value))
    estimate = Estimate.of(model, best, covariance)
    warnings = tuple(r for r in remarks if r)
    return identified(method.name, estimate, seen.quantile, warnings=warnings)


def _distance(solution: Solution, other: Solution) -> float:
    return sum(abs(math.log(a / b)) for a, b in zip(solution[1:], other[1:], strict=True))


def _choice(method: SymmetricMethod, seen: LimitCycle, gain: float) -> tuple[Structure, str]:
    """Choose the simplest model that fits, where the gain is known."""
    found: dict[int, float] = {}

    def fits(order: int) -> bool:
        found[order] = method.mismatch(order, seen.cycle, gain)
        return _agrees(method, seen, gain, order, found[order])

    # Between two orders of equal lags lies a model with one lag more that differs.
    for order, between in ((1, MODEL_1), (2, MODEL_4), (3, MODEL_5)):
        if fits(order):
            return equal_lags(order), ""
        if found[order] < 0.0:
            return between, ""
    for order in range(4, _MOST_EQUAL + 1):
        if fits(order):
            return equal_lags(order), ""
        if found[order] < 0.0:
            break
    return equal_lags(min((n for n in found if n >= 3), key=lambda n: abs(found[n]))), ""


def _agrees(
    method: SymmetricMethod, seen: LimitCycle, gain: float, order: int, mismatch: float
) -> bool:
    """Return whether period and amplitude agree on n equal lags, within what is uncertain.

    That is the scatter of the cycles, and half a sample interval of dead time.
    """
    if abs(mismatch) <= method.agreement or seen.whole is None or math.isinf(mismatch):
        return abs(mismatch) <= method.agreement
    cycle, half = seen.cycle, 0.5 * seen.whole.record.interval

    def excess(at: SymmetricCycle, dead_time: float = cycle.dead_time) -> float:
        return method.excess(order, replace(at, dead_time=max(dead_time, 0.0)), gain)

    here, scatter = excess(cycle), seen.std(excess)
    shifts = [abs(excess(cycle, cycle.dead_time + side) - here) for side in (-half, half)]
    return abs(here) <= max(0.0 if math.isnan(scatter) else seen.quantile * scatter, *shifts)


def _choice_by_shape(
    method: SymmetricMethod, seen: LimitCycle, gain: float
) -> tuple[Structure, str]:
    """Choose among equal lags by the shape of the half cycles.

    Period and amplitude only give gain and time constant then.
    """
    cycle, whole = seen.cycle, seen.whole
    away: dict[int, float] = {}
    for order in range(1, _MOST_EQUAL + 1):
        if order > 3 and (
            whole is None or not away or min(away, key=away.__getitem__) < order - 1
        ):
            break
        try:
            (solution,) = method.solve(equal_lags(order), cycle, gain)
        except IdentificationError:
            continue
        away[order] = 0.0
        if whole is not None:
            misfit = shape_misfit(whole, equal_lags(order), cycle, solution)
            away[order] = misfit / cycle.amplitude
    if not away:
        # The error of the simplest model says what is wrong.
        method.solve(MODEL_1, cycle, gain)
    model = equal_lags(min(n for n in away if alike(away[n], min(away.values()))))
    why = "its simplicity" if whole is None else "the shape of its half cycles"
    return model, (
        f"without the gain the structure is not checked: {model_text(model)} was taken for "
        f"{why}; give the gain or the structure where they are known"
    )


def alike(misfit: float, least: float) -> bool:
    """Return True if half cycles are as near to the record's as the nearest.

    :param misfit: a :func:`shape_misfit` over the amplitude.
    :param least: that of the structure that comes nearest.
    """
    return misfit <= _ALIKE * least + _ALIKE_SHARE


def shape_misfit(
    whole: CycleRun, model: Structure, cycle: SymmetricCycle, solution: Solution
) -> float:
    """Return the root mean square of half cycles minus those of a solution [y]."""
    since, y = half_cycles(whole)
    stride = max(1, since.size // _SHAPE_SAMPLES)
    gain, *constants = solution
    lags, half = lags_of(model, constants), 0.5 * cycle.period

    def modelled(time: float) -> float:
        # The command that turns the measurement down arrives after the dead time.
        before = time < cycle.dead_time
        part = min(max((time - cycle.dead_time) / half + before, 0.0), 1.0)
        return (1.0 if before else -1.0) * level(lags, cycle.period, part)

    shape = np.array([modelled(time) for time in since[::stride].tolist()])
    return math.sqrt(float(np.mean((y[::stride] - gain * cycle.relay * shape) ** 2)))


def _mismatch_text(
    method: SymmetricMethod, model: Structure, cycle: SymmetricCycle, gain: float
) -> str:
    difference = method.mismatch(model.order, cycle, gain)
    if abs(difference) <= method.agreement:
        return ""
    if math.isinf(difference):
        apart = "cannot agree: no time constant gives the period"
    else:
        apart = (
            f"differ: the period's is {100.0 * math.expm1(difference):+.3g} % off the amplitude's"
        )
    return (
        f"the two time constants of {model_text(model)} {apart}; the process is of another "
        "structure, or gain or dead time are not right"
    )
