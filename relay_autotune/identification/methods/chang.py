# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The methods `chang` and `atv`: lags from the limit cycle of an unbiased relay.

Chang, Shen and Yu, "Derivation of Transfer Function from Relay Feedback Systems", Ind. Eng. Chem.
Res. 1992. Period, amplitude and level at the switch are read, the dead time is read or known; the
equations of :mod:`~relay_autotune.identification.methods.lags` make a model of them.

`chang` takes the exact equations, with all harmonics and the hysteresis, which the paper's lack.
`atv`, the original ATV (Luyben 1987), takes the describing function: period and amplitude give an
estimate of the ultimate point,

    w_u = 2 pi/P,   K_u = 4 h/(pi a)                                                  (eqs 1, 2)

and phase and magnitude there one equation each (eqs 7, 13; 6, 21 to 25); for equal lags of a known
gain tau is the mean of the two. The simplest model that fits is taken.

The dead time is read where a relay test shows it: by the sharp edge after a switch, or the kick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.experiment.settling import ResponseDetector, RestState
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import Fold, Reading, fold, level_at_switch
from relay_autotune.identification.limit_cycle.limit_cycle import (
    RelayTest,
    SymmetricCycle,
    relay_test,
)
from relay_autotune.identification.methods.lags import (
    EXACT,
    FIRST,
    MIXED,
    MODEL_1,
    MODEL_4,
    MODEL_5,
    STRUCTURES,
    Wave,
    equal,
    model_text,
    solutions,
    with_amplitude,
)
from relay_autotune.identification.methods.solved import literally, solved, structure_asked_for
from relay_autotune.identification.result import Identification
from relay_autotune.process.simulation import HalfCycle
from relay_autotune.process.structures import Structure, equal_lags
from relay_autotune.record.record import Record, RelaySettings

# Least jump of the rate at a sharp edge, relative to its largest value: that of one lag jumps by
# more than 1 where the command arrives.
_JUMP = 0.6
_BESIDE = 0.01


def read_dead_time(test: RelayTest, known: Known) -> tuple[float, float, str]:
    """Return the dead time that is known, or read it from the record.

    One lag turns at once when the command arrives, so that the measurement has an edge there in
    each half cycle. If the averaged half cycles have one, its time is taken, otherwise the time
    from the first kick to the first sample outside the noise.

    :param test: the relay test, with the samples before the kick.
    :param known: a known dead time.
    :return: the dead time and its standard deviation [s], and a sentence for the user; 0 and
        empty: it was given.
    :raises IdentificationError: if it is not known and the record does not show it.
    """
    if not math.isnan(known.dead_time):
        return known.dead_time, 0.0, ""
    settings, cycles = test.settings, test.cycle.cycles
    if _is_sharp(fold(test.record, cycles)):
        edge = Reading.of(test.record, cycles, lambda seen: np.array([seen.edge]))
        value = max(float(edge.values[0]) - settings.extra_delay, 0.0)
        source = (
            f"the dead time of {value:.4g} s was read as the time from the switch to the sharp "
            "peak; give it where it is known better, since these equations are sensitive to it"
        )
        # An edge lies between two samples, whatever the cycles agree on.
        between = test.record.interval / math.sqrt(12.0 * len(cycles))
        scatter = float(np.nan_to_num(edge.std[0]))
        return value, max(scatter, between), source
    first, interval = _first_response(test.record, settings)
    if math.isnan(first):
        raise IdentificationError(
            "the dead time is not known, and neither sharp peaks nor a first kick from rest show "
            "it in the record: give the dead time, or use the method waveform"
        )
    value = max(first - settings.extra_delay, 0.0)
    source = (
        f"the dead time of {value:.4g} s was read from the first response to the kick, which a "
        "slow beginning or noise delays; give it where it is known better"
    )
    return value, interval / math.sqrt(12.0), source


def _is_sharp(curve: Fold) -> bool:
    if math.isnan(curve.edge):
        return False
    beside = _BESIDE * 0.5 * curve.period
    before, after = curve.slope(np.array((curve.edge - beside, curve.edge + beside)))
    # Away from the edges, where a spline in noise has its largest rates.
    steepest = np.abs(curve.slope(np.linspace(0.0, curve.period, 101)))
    return bool(abs(after - before) > _JUMP * float(np.percentile(steepest, 90.0)))


def _first_response(record: Record, settings: RelaySettings) -> tuple[float, float]:
    """Return the time from the first kick to the response, and the interval in which it began.

    NaN: there was no kick from rest.
    """
    u = record.input()
    resting = abs(u.initial - settings.baseline) < 0.5 * settings.amplitude
    if u.times.size == 0 or not resting or u.times[0] < record.time[0]:
        return math.nan, math.nan
    kick = float(u.times[0])
    before = record.measurement[record.time <= kick]
    noise = record.noise_std
    if math.isnan(noise):
        noise = float(np.std(before)) if before.size >= 10 else 0.0
    # Without noise, rounding remains.
    floor = 1e-9 * float(np.ptp(record.measurement))
    rest = RestState(
        mean=float(np.mean(before)),
        slope=0.0,
        noise_std=max(noise, floor),
        span=float(kick - record.time[0]),
        samples=before.size,
        range_seen=float(np.ptp(before)),
    )
    detector = ResponseDetector(rest, kick)
    after = slice(int(np.searchsorted(record.time, kick, side="right")), None)
    for time, y in zip(record.time[after], record.measurement[after], strict=True):
        if detector.add(float(time), float(y)):
            seen = 0.5 * (detector.last_inside + detector.first_outside) - kick
            return seen, detector.first_outside - detector.last_inside
    return math.nan, math.nan


_MOST_EQUAL = 20
# Ratio of two misfits of the half cycles up to which structures are equally good, and the misfit
# that sampling causes, as a share of the amplitude.
_ALIKE = 1.02
_ALIKE_SHARE = 3e-3
_SHAPE_POINTS = 200
# Largest level at a switch, over the amplitude.
_MOST_LEVEL = 0.99

# Gain and time constants.
Solution = tuple[float, ...]


@dataclass(frozen=True)
class SymmetricMethod:
    """A method that finds models 1 to 5 from a symmetric limit cycle.

    :param name: its name in the registry.
    :param wave: which harmonics count in its equations.
    :param agreement: relative difference of two time constants that counts as none.
    :param paper: the equations as the paper has them.
    :param literal: which harmonics count in those.
    """

    name: str
    wave: Wave
    agreement: float
    paper: str
    literal: Wave

    def solve(
        self, model: Structure, cycle: SymmetricCycle, gain: float, wave: Wave | None = None
    ) -> list[Solution]:
        """Return the solutions of a model.

        Equal lags with a known gain have an equation too many: exactly their time constant is
        that of the period; by the describing function it is the mean of both.

        :param model: which one.
        :param cycle: the limit cycle.
        :param gain: K > 0 [y/u]; NaN: not known.
        :param wave: which harmonics count; default: those of the method.
        :raises IdentificationError: if there is none, or models 4 or 5 lack the gain.
        """
        wave = wave or self.wave
        if wave is not FIRST or not model.equal_lags or math.isnan(gain):
            return solutions(model, cycle, gain, wave)
        by_amplitude = self._by_amplitude(model.order, cycle, gain)
        # The phase needs no gain.
        return [(gain, 0.5 * (by_amplitude + equal(model.order, cycle, wave=wave)[1]))]

    def _by_amplitude(self, order: int, cycle: SymmetricCycle, gain: float) -> float:
        relative = cycle.amplitude / (gain * cycle.relay)
        return with_amplitude((1.0 / order,) * order, cycle.period, relative, self.wave)[0]

    def excess(self, order: int, cycle: SymmetricCycle, gain: float, factor: float = 1.0) -> float:
        """Return y/(K h) at the switch minus what it was, of n equal lags with the amplitude.

        :param order: n >= 1.
        :param cycle: the limit cycle.
        :param gain: K > 0 [y/u].
        :param factor: of the time constant.
        :return: 0: period and amplitude agree; positive: the process has more lag.
        :raises IdentificationError: if the gain is too small for the amplitude.
        """
        lags = (factor * self._by_amplitude(order, cycle, gain),) * order
        height = self.wave.level(lags, cycle.period, max(cycle.part, 0.0))
        return height - cycle.level / (gain * cycle.relay)


# The describing function alone explains a difference of 0.1.
CHANG = SymmetricMethod("chang", EXACT, 0.05, "eqs 8 to 12 and 21 to 25", MIXED)
ATV = SymmetricMethod("atv", FIRST, 0.1, "eqs 6, 7, 13 and 21 to 25", FIRST)


@dataclass(frozen=True)
class Seen:
    """A limit cycle, with the uncertainty of its numbers.

    :param reading: period, amplitude, level at the switch and dead time, with what the relay
        added to it.
    :param relay: its amplitude [u].
    :param test: the relay test; None: numbers of a chart.
    :param source: of the dead time, a sentence for the user.
    """

    reading: Reading
    relay: float
    test: RelayTest | None = None
    source: str = ""

    @property
    def cycle(self) -> SymmetricCycle:
        """The limit cycle."""
        period, amplitude, level, dead_time = self.reading.values.tolist()
        return SymmetricCycle(period, amplitude, self.relay, level, dead_time)

    @property
    def extra_delay(self) -> float:
        """Dead time that the relay added [s]."""
        return self.test.settings.extra_delay if self.test else 0.0

    def at(self, numbers: FloatArray) -> SymmetricCycle:
        """Return the limit cycle with other numbers."""
        period, amplitude, height, dead_time = numbers.tolist()
        # The scatter about zero is that of the reading, to both sides.
        level = min(height, _MOST_LEVEL * amplitude)
        return SymmetricCycle(period, amplitude, self.relay, level, max(dead_time, 0.0))


def seen_in(test: RelayTest, dead_time: float = 0.0, std: float = 0.0, source: str = "") -> Seen:
    """Return the limit cycle of an unbiased relay test.

    :param test: the relay test.
    :param dead_time: of the process [s].
    :param std: its standard deviation [s].
    :param source: where it comes from, a sentence for the user.
    """

    def measure(seen: Fold) -> FloatArray:
        low, high = seen.peaks()
        return np.array((seen.period, 0.5 * (high - low), level_at_switch(seen), 0.0))

    read = Reading.of(test.record, test.cycle.cycles, measure)
    # In noise the level may be below zero, where no relay switches.
    read.values[2] = min(max(read.values[2], 0.0), _MOST_LEVEL * read.values[1])
    read = read.with_number(3, dead_time + test.settings.extra_delay, std)
    return Seen(read, test.settings.amplitude, test, source)


def _from_record(
    method: SymmetricMethod, record: Record, known: Known = NOTHING
) -> Identification:
    """Identify one of models 1 to 5 from an unbiased relay test.

    :param method: how.
    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known. Without the gain
        only equal lags can be found; a dead time that is not known is read from the record;
        without the structure the simplest model that fits is taken.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    test = relay_test(method.name, record)
    test.require_unbiased()
    test.known_gain(known)
    seen = seen_in(test, *read_dead_time(test, known))
    return _identified(method, seen, known, ideal=test.settings.hysteresis == 0.0)


def _from_numbers(method: SymmetricMethod, cycle: SymmetricCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from the numbers of a limit cycle.

    :param method: how.
    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    numbers = np.array((cycle.period, cycle.amplitude, cycle.level, cycle.dead_time))
    seen = Seen(Reading(numbers), cycle.relay)
    return _identified(method, seen, known, ideal=cycle.level == 0.0)


identify_chang = partial(_from_record, CHANG)
identify_atv = partial(_from_record, ATV)
chang_from_numbers = partial(_from_numbers, CHANG)
atv_from_numbers = partial(_from_numbers, ATV)


def _identified(
    method: SymmetricMethod, seen: Seen, known: Known, *, ideal: bool
) -> Identification:
    gain, cycle, test = abs(known.gain), seen.cycle, seen.test
    sign = test.sign if test else (-1 if known.gain < 0.0 else 1)
    model, remark = structure_asked_for(method.name, known, STRUCTURES), ""
    if model is None:
        choice = _choice_by_shape if math.isnan(gain) else _choice
        model, remark = choice(method, seen, gain)
    found = method.solve(model, cycle, gain)
    if test is not None:
        found = sorted(found, key=lambda each: shape_misfit(test, model, cycle, each))
    taken, *others = found

    def values(numbers: FloatArray) -> tuple[float, ...]:
        at = seen.at(numbers)
        nearest = min(method.solve(model, at, gain), key=lambda each: _distance(each, taken))
        return *nearest, at.dead_time

    remarks = [seen.source, remark, *(test.remarks() if test else ())]
    if model.equal_lags and not math.isnan(gain):
        remarks.append(_disagreement(method, model, cycle, gain))
    remarks += [
        f"{model_text(model)} has two solutions, which period and amplitude do not tell apart: "
        f"{_constants_text(taken)} was taken, {_constants_text(other)} would do as well"
        for other in others
    ]
    how = f"{method.paper} for an ideal relay" + (
        ", with the first harmonic of the amplitude," if method.literal is MIXED else ""
    )
    dead_time = cycle.dead_time - seen.extra_delay
    ideally = replace(cycle, level=0.0)
    remarks += literally(
        how,
        model,
        lambda: (*method.solve(model, ideally, gain, method.literal)[0], dead_time),
        (*taken, dead_time),
    )
    k_u, w_u = ultimate_estimate(cycle)
    if method is ATV and not ideal:
        remarks.append(
            f"eqs 1 and 2 give K_u = {k_u:.4g} and w_u = {w_u:.4g} rad/s, but the hysteresis "
            "keeps the limit cycle off the ultimate point; K_u and w_u are those of the model"
        )
    identification = solved(
        *(method.name, model, values, seen.reading),
        sign=sign,
        extra_delay=seen.extra_delay,
        remarks=remarks,
    )
    if method is not ATV or not ideal:
        return identification
    spread = seen.reading.carried(lambda numbers: np.array(ultimate_estimate(seen.at(numbers))))
    gain_std, frequency_std = np.sqrt(np.diag(spread)).tolist()
    return replace(
        identification,
        ultimate_gain=sign * k_u,
        ultimate_gain_std=gain_std,
        ultimate_frequency=w_u,
        ultimate_frequency_std=frequency_std,
    )


def ultimate_estimate(cycle: SymmetricCycle) -> tuple[float, float]:
    """Return (K_u, w_u) by the describing function (eqs 2 and 1)."""
    return 4.0 * cycle.relay / (math.pi * cycle.amplitude), cycle.frequency


def _constants_text(solution: Solution) -> str:
    return ", ".join(f"tau{i} = {c:.4g} s" for i, c in enumerate(solution[1:], 1))


def _distance(solution: Solution, other: Solution) -> float:
    return sum(abs(math.log(a / b)) for a, b in zip(solution[1:], other[1:], strict=True))


def _choice(method: SymmetricMethod, seen: Seen, gain: float) -> tuple[Structure, str]:
    """Choose the simplest model that fits, where the gain is known."""
    excesses: dict[int, float] = {}
    # Between two orders of equal lags lies a model with one lag more that differs.
    between = {1: MODEL_1, 2: MODEL_4, 3: MODEL_5}
    for order in range(1, _MOST_EQUAL + 1):
        excesses[order] = method.excess(order, seen.cycle, gain)
        if _agrees(method, seen, gain, order, excesses[order]):
            return equal_lags(order), ""
        if excesses[order] < 0.0:
            if order in between:
                return between[order], ""
            break
    return equal_lags(min((n for n in excesses if n >= 3), key=lambda n: abs(excesses[n]))), ""


def _agree(method: SymmetricMethod, order: int, cycle: SymmetricCycle, gain: float) -> bool:
    """Return whether period and amplitude have the same time constant of n equal lags."""
    shorter, longer = (
        method.excess(order, cycle, gain, math.exp(side * method.agreement)) for side in (-1, 1)
    )
    return longer <= 0.0 <= shorter


def _agrees(method: SymmetricMethod, seen: Seen, gain: float, order: int, here: float) -> bool:
    """Return whether they do within what is uncertain.

    That is the scatter of the cycles, and half a sample interval of dead time.
    """
    cycle, read = seen.cycle, seen.reading
    if _agree(method, order, cycle, gain) or seen.test is None:
        return _agree(method, order, cycle, gain)

    def excess(numbers: FloatArray) -> FloatArray:
        return np.array([method.excess(order, seen.at(numbers), gain)])

    half = np.array((0.0, 0.0, 0.0, 0.5 * seen.test.record.interval))
    allowed = [abs(float(excess(read.values + s * half)[0]) - here) for s in (-1.0, 1.0)]
    scatter = float(np.nan_to_num(read.quantile * math.sqrt(read.carried(excess)[0, 0])))
    return abs(here) <= max(*allowed, scatter)


def _disagreement(
    method: SymmetricMethod, model: Structure, cycle: SymmetricCycle, gain: float
) -> str:
    if _agree(method, model.order, cycle, gain):
        return ""
    size = gain * cycle.relay
    height = cycle.level + size * method.excess(model.order, cycle, gain)
    return (
        f"period and amplitude do not agree on {model_text(model)}: with this amplitude the "
        f"measurement would be {height:.3g} at the switch, where it was {cycle.level:.3g}; the "
        "process is of another structure, or gain or dead time are not right"
    )


def _choice_by_shape(method: SymmetricMethod, seen: Seen, gain: float) -> tuple[Structure, str]:
    """Choose among equal lags by the shape of the half cycles.

    Period and amplitude only give gain and time constant then.
    """
    cycle, test = seen.cycle, seen.test
    away: dict[int, float] = {}
    for order in range(1, _MOST_EQUAL + 1):
        if order > 3 and (test is None or not away or min(away, key=away.__getitem__) < order - 1):
            break
        try:
            (solution,) = method.solve(equal_lags(order), cycle, gain)
        except IdentificationError:
            continue
        away[order] = 0.0
        if test is not None:
            away[order] = shape_misfit(test, equal_lags(order), cycle, solution)
    if not away:
        # The error of the simplest model says what is wrong.
        method.solve(MODEL_1, cycle, gain)
    model = equal_lags(min(n for n in away if alike(away[n], min(away.values()))))
    why = "its simplicity" if test is None else "the shape of its half cycles"
    return model, (
        f"without the gain the structure is not checked: {model_text(model)} was taken for "
        f"{why}; give the gain or the structure where they are known"
    )


def alike(misfit: float, least: float) -> bool:
    """Return True if half cycles are as near to the record's as the nearest.

    :param misfit: a :func:`shape_misfit`.
    :param least: that of the structure that comes nearest.
    """
    return misfit <= _ALIKE * least + _ALIKE_SHARE


def shape_misfit(
    test: RelayTest, model: Structure, cycle: SymmetricCycle, solution: Solution
) -> float:
    """Return how far half cycles are from those of a solution, with noise, over the amplitude.

    :param test: the relay test.
    :param model: the structure.
    :param cycle: its limit cycle.
    :param solution: gain > 0 and time constants.
    """
    half = 0.5 * cycle.period
    time = half * (np.arange(_SHAPE_POINTS) + 0.5) / _SHAPE_POINTS
    process = model.build((*solution, cycle.dead_time))
    seen = fold(test.record, test.cycle.cycles)
    away = HalfCycle(process, half, cycle.relay)(time) - seen.half(time)
    return math.hypot(float(np.sqrt(np.mean(away**2))), seen.noise_std) / cycle.amplitude
