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
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.experiment.settling import NOT_SETTLED, ResponseDetector
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import Reading, fold
from relay_autotune.identification.limit_cycle.limit_cycle import (
    MOST_LEVEL,
    RelayTest,
    SymmetricCycle,
    relay_test,
)
from relay_autotune.identification.limit_cycle.shape import shape_of_record
from relay_autotune.identification.methods.lags import (
    EXACT,
    FIRST,
    MIXED,
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
from relay_autotune.process.structures import FOPDT, SOPDT, TWO_EQUAL_ONE, Structure, equal_lags
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Record


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
    settings = test.settings
    if _is_sharp(test):
        edge = Reading.of(test.record, lambda seen: np.array([seen.edge]))
        value = max(float(edge.values[0]) - settings.extra_delay, 0.0)
        source = (
            f"the dead time of {value:.4g} s was read as the time from the switch to the sharp "
            "peak; give it where it is known better, since these equations are sensitive to it"
        )
        # An edge lies between two samples, whatever the cycles agree on.
        between = test.record.interval / math.sqrt(12.0 * edge.cycles)
        scatter = float(np.nan_to_num(edge.std[0]))
        return value, max(scatter, between), source
    first, interval = _first_response(test)
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


def _is_sharp(test: RelayTest) -> bool:
    """Return whether the averaged half cycles have an edge, and the peak of one lag there."""
    try:
        shape = shape_of_record(test.record)
    except IdentificationError:
        return False
    return not math.isnan(fold(test.record).edge) and shape.category == "1a"


def _first_response(test: RelayTest) -> tuple[float, float]:
    """Return the time from the first kick to the response, and the interval in which it began.

    NaN: there was no kick from rest.
    """
    record, u, settings = test.record, test.record.input(), test.settings
    resting = abs(u.initial - settings.baseline) < 0.5 * settings.amplitude
    if not resting or not u.times.size or u.times[0] < record.time[0]:
        return math.nan, math.nan
    kick = float(u.times[0])
    mean = float(np.mean(record.measurement[record.time <= kick]))
    # Without noise, rounding remains.
    noise = max(record.noise, 1e-9 * float(np.ptp(record.measurement)))
    detector = ResponseDetector(replace(NOT_SETTLED, mean=mean, noise_std=noise), kick)
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


# The describing function alone explains a difference of 0.1.
CHANG = SymmetricMethod("chang", EXACT, 0.05, "eqs 8 to 12 and 21 to 25", MIXED)
ATV = SymmetricMethod("atv", FIRST, 0.1, "eqs 6, 7, 13 and 21 to 25", FIRST)


@dataclass(frozen=True)
class LagProblem:
    """Lags that are sought for a limit cycle.

    :param method: how.
    :param reading: period, amplitude, level at the switch, and dead time with what the relay
        added to it.
    :param relay: its amplitude [u].
    :param gain: K > 0 [y/u]; NaN: not known.
    :param test: the relay test; None: numbers of a chart.
    """

    method: SymmetricMethod
    reading: Reading
    relay: float
    gain: float
    test: RelayTest | None = None

    def at(self, numbers: FloatArray) -> SymmetricCycle:
        """Return the limit cycle of some numbers."""
        period, amplitude, height, dead_time = numbers.tolist()
        # The scatter about zero is that of the reading, to both sides.
        level = height if self.test is None else min(height, MOST_LEVEL * amplitude)
        return SymmetricCycle(period, amplitude, self.relay, level, max(dead_time, 0.0))

    @property
    def cycle(self) -> SymmetricCycle:
        """The limit cycle that was read."""
        return self.at(self.reading.values)

    def solve(
        self, model: Structure, cycle: SymmetricCycle | None = None, wave: Wave | None = None
    ) -> list[Solution]:
        """Return the solutions of a model.

        Equal lags with a known gain have an equation too many: exactly their time constant is
        that of the period; by the describing function it is the mean of both.

        :param model: which one.
        :param cycle: default: the one that was read.
        :param wave: which harmonics count; default: those of the method.
        :raises IdentificationError: if there is none, or models 4 or 5 lack the gain.
        """
        cycle, wave = cycle or self.cycle, wave or self.method.wave
        if wave is not FIRST or not model.equal_lags or math.isnan(self.gain):
            return solutions(model, cycle, self.gain, wave)
        # The phase needs no gain.
        both = self._by_amplitude(model.order, cycle) + equal(model.order, cycle, wave=wave)[1]
        return [(self.gain, 0.5 * both)]

    def misfit(self, model: Structure, solution: Solution) -> float:
        """Return how far a solution's half cycles are from the record's; 0 without a record."""
        if self.test is None:
            return 0.0
        process = model.build((*solution, self.cycle.dead_time))
        return shape_misfit(self.test, process, self.cycle)

    def choice(self) -> tuple[Structure, str]:
        """Return the simplest model that fits, and a sentence for the user.

        :raises IdentificationError: if none has the limit cycle.
        """
        if math.isnan(self.gain):
            return self._choice_by_shape()
        excesses: dict[int, float] = {}
        for order in range(1, _MOST_EQUAL + 1):
            excesses[order] = self._excess(order, self.cycle)
            if self._agrees(order, excesses[order]):
                return equal_lags(order), ""
            if excesses[order] < 0.0:
                break
        # Between two orders of equal lags lies a model with one lag more that differs.
        between = {1: FOPDT, 2: SOPDT, 3: TWO_EQUAL_ONE}.get(order)
        nearest = min((n for n in excesses if n >= 3), key=lambda n: abs(excesses[n]), default=3)
        return between if between and excesses[order] < 0.0 else equal_lags(nearest), ""

    def _choice_by_shape(self) -> tuple[Structure, str]:
        """Choose among equal lags by the shape of the half cycles.

        Period and amplitude only give gain and time constant then.
        """
        away: dict[int, float] = {}
        for order in range(1, _MOST_EQUAL + 1):
            if order > 3 and min(away, key=away.__getitem__, default=0) < order - 1:
                break
            with suppress(IdentificationError):
                (solution,) = self.solve(equal_lags(order))
                away[order] = self.misfit(equal_lags(order), solution)
        if not away:
            # The error of the simplest model says what is wrong.
            self.solve(FOPDT)
        model = equal_lags(min(n for n in away if alike(away[n], min(away.values()))))
        why = "its simplicity" if self.test is None else "the shape of its half cycles"
        return model, (
            f"without the gain the structure is not checked: {model_text(model)} was taken for "
            f"{why}; give the gain or the structure where they are known"
        )

    def disagreement(self, model: Structure) -> str:
        """Return a sentence where period and amplitude do not agree on equal lags, else none."""
        cycle, size = self.cycle, self.gain * self.relay
        if math.isnan(self.gain) or not model.equal_lags or self._agree(model.order):
            return ""
        height = cycle.level + size * self._excess(model.order, cycle)
        return (
            f"period and amplitude do not agree on {model_text(model)}: with this amplitude the "
            f"measurement would be {height:.3g} at the switch, where it was {cycle.level:.3g}; "
            "the process is of another structure, or gain or dead time are not right"
        )

    def _by_amplitude(self, order: int, cycle: SymmetricCycle) -> float:
        relative = cycle.amplitude / (self.gain * cycle.relay)
        return with_amplitude((1.0 / order,) * order, cycle.period, relative, self.method.wave)[0]

    def _excess(self, order: int, cycle: SymmetricCycle, factor: float = 1.0) -> float:
        """Return y/(K h) at the switch minus what it was, of n equal lags with the amplitude.

        :param order: n >= 1.
        :param cycle: the limit cycle.
        :param factor: of the time constant.
        :return: 0: period and amplitude agree; positive: the process has more lag.
        :raises IdentificationError: if the gain is too small for the amplitude.
        """
        lags = (factor * self._by_amplitude(order, cycle),) * order
        height = self.method.wave.level(lags, cycle.period, max(cycle.part, 0.0))
        return height - cycle.level / (self.gain * cycle.relay)

    def _agree(self, order: int) -> bool:
        """Return whether period and amplitude have the same time constant of n equal lags."""
        shorter, longer = (
            self._excess(order, self.cycle, math.exp(side * self.method.agreement))
            for side in (-1, 1)
        )
        return longer <= 0.0 <= shorter

    def _agrees(self, order: int, here: float) -> bool:
        """Return whether they do within what is uncertain.

        That is the scatter of the cycles, and half a sample interval of dead time.
        """
        if self._agree(order) or self.test is None:
            return self._agree(order)

        def excess(numbers: FloatArray) -> FloatArray:
            return np.array([self._excess(order, self.at(numbers))])

        read, half = self.reading, np.array((0.0, 0.0, 0.0, 0.5 * self.test.record.interval))
        allowed = [abs(float(excess(read.values + s * half)[0]) - here) for s in (-1.0, 1.0)]
        scatter = float(np.nan_to_num(read.quantile * math.sqrt(read.carried(excess)[0, 0])))
        return abs(here) <= max(*allowed, scatter)


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
    test = relay_test(method.name, record, unbiased=True)
    gain, settings = test.known_gain(known), test.settings
    dead_time, std, source = read_dead_time(test, known)
    late = dead_time + settings.extra_delay
    reading = test.read(lambda *_: late).with_number(3, late, std)
    problem = LagProblem(method, reading, settings.amplitude, gain, test)
    return _identified(problem, known, source, ideal=settings.hysteresis == 0.0)


def _from_numbers(method: SymmetricMethod, cycle: SymmetricCycle, known: Known) -> Identification:
    """Identify one of models 1 to 5 from the numbers of a limit cycle.

    :param method: how.
    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    numbers = np.array((cycle.period, cycle.amplitude, cycle.level, cycle.dead_time))
    problem = LagProblem(method, Reading(numbers), cycle.relay, abs(known.gain))
    return _identified(problem, known, "", ideal=cycle.level == 0.0)


identify_chang = partial(_from_record, CHANG)
identify_atv = partial(_from_record, ATV)
chang_from_numbers = partial(_from_numbers, CHANG)
atv_from_numbers = partial(_from_numbers, ATV)


def _identified(problem: LagProblem, known: Known, source: str, *, ideal: bool) -> Identification:
    method, cycle, test = problem.method, problem.cycle, problem.test
    sign = test.sign if test else (-1 if known.gain < 0.0 else 1)
    extra_delay = test.settings.extra_delay if test else 0.0
    model, remark = structure_asked_for(method.name, known, STRUCTURES), ""
    if model is None:
        model, remark = problem.choice()
    taken, *others = sorted(problem.solve(model), key=lambda each: problem.misfit(model, each))

    def values(numbers: FloatArray) -> Solution:
        at = problem.at(numbers)
        nearest = min(problem.solve(model, at), key=lambda each: _distance(each, taken))
        return *nearest, at.dead_time

    ideally, dead_time = replace(cycle, level=0.0), cycle.dead_time - extra_delay
    first = ", with the first harmonic of the amplitude," if method.literal is MIXED else ""
    k_u, w_u = ultimate_estimate(cycle)
    remarks = [
        *(source, remark, *(test.remarks() if test else ()), problem.disagreement(model)),
        *(
            f"{model_text(model)} has two solutions, which period and amplitude do not tell "
            f"apart: {_constants_text(taken)} was taken, {_constants_text(other)} would do as well"
            for other in others
        ),
        *literally(
            f"{method.paper} for an ideal relay{first}",
            model,
            lambda: (*problem.solve(model, ideally, method.literal)[0], dead_time),
            (*taken, dead_time),
        ),
    ]
    if method is ATV and not ideal:
        remarks.append(
            f"eqs 1 and 2 give K_u = {k_u:.4g} and w_u = {w_u:.4g} rad/s, but the hysteresis "
            "keeps the limit cycle off the ultimate point; K_u and w_u are those of the model"
        )
    found = method.name, model, values, problem.reading
    identification = solved(*found, sign=sign, late=extra_delay, remarks=remarks)
    if method is not ATV or not ideal:
        return identification
    spread = problem.reading.carried(lambda x: np.array(ultimate_estimate(problem.at(x))))
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


def alike(misfit: float, least: float) -> bool:
    """Return True if half cycles are as near to the record's as the nearest.

    :param misfit: a :func:`shape_misfit`.
    :param least: that of the structure that comes nearest.
    """
    return misfit <= _ALIKE * least + _ALIKE_SHARE


def shape_misfit(test: RelayTest, process: TransferFunction, cycle: SymmetricCycle) -> float:
    """Return how far half cycles are from those of a process, with noise, over the amplitude.

    :param test: the relay test.
    :param process: of positive gain, with the dead time that the relay added.
    :param cycle: its limit cycle.
    """
    half = 0.5 * cycle.period
    time = half * (np.arange(_SHAPE_POINTS) + 0.5) / _SHAPE_POINTS
    seen = fold(test.record)
    away = HalfCycle(process, half, cycle.relay)(time) - seen.half(time)
    return math.hypot(float(np.sqrt(np.mean(away**2))), seen.noise_std) / cycle.amplitude
