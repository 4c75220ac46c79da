# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the methods for an unbiased relay have share: dead time, choice of a model, uncertainty.

If the gain is known, period and amplitude each give a time constant of models 1 to 3; their
difference shows whether the structure is right. The simplest model that fits is used (Luyben 1987,
Chang, Shen and Yu 1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.experiment.settling import ResponseDetector, RestState
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods.lags import (
    MODEL_1,
    MODEL_4,
    MODEL_5,
    Solution,
    constants_text,
    lags_of,
    level,
    model_asked_for,
    model_text,
)
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.shown.fold import Fold, fold
from relay_autotune.identification.shown.limit_cycle import (
    NOT_SETTLED,
    CycleReader,
    CycleRun,
    RelayTest,
    SymmetricCycle,
    features,
    half_cycles,
    known_gain,
    relay_test,
    require_unbiased,
    skew_warning,
)
from relay_autotune.process.structures import Structure, equal_lags
from relay_autotune.record.record import Record, RelaySettings

# Least jump of the rate at a sharp edge, relative to its largest value: that of one lag jumps by
# more than 1 where the command arrives.
_JUMP = 0.6
_BESIDE = 0.01
_MOST_SINGLES = 8


@dataclass(frozen=True)
class DeadTime:
    """Where the dead time of the process comes from.

    :param value: s.
    :param std: standard deviation of what was read [s]; 0: it was given.
    :param source: a sentence for the user; empty: it was given.
    """

    value: float
    std: float = 0.0
    source: str = ""


def read_dead_time(test: RelayTest, record: Record, known: Known, *, noisy: bool) -> DeadTime:
    """Return the dead time that is known, or read it from the record.

    One lag turns at once when the command arrives, so that the measurement has an edge there in
    each half cycle. If the averaged half cycles have one, its time is taken, otherwise the time
    from the first kick to the first sample outside the noise.

    :param test: the relay test.
    :param record: the whole record, with the samples before the kick.
    :param known: a known dead time.
    :param noisy: True if noise matters.
    :raises IdentificationError: if it is not known and the record does not show it.
    """
    if not math.isnan(known.dead_time):
        return DeadTime(known.dead_time)
    settings = test.whole.settings
    edge, sharp = _edge(test.whole)
    if sharp:
        value = max(edge - settings.extra_delay, 0.0)
        source = (
            f"the dead time of {value:.4g} s was read as the time from the switch to the sharp "
            "peak; give it where it is known better, since these equations are sensitive to it"
        )
        return DeadTime(value, _scatter_of_edge(test, noisy), source)
    first, interval = _first_response(record, settings)
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
    return DeadTime(value, interval / math.sqrt(12.0), source)


def _edge(stretch: CycleRun) -> tuple[float, bool]:
    """Return the time from a switch to the edge after it, and whether it is sharp."""
    try:
        curve = fold(stretch.record, tuple(range(len(stretch.record.cycle_start) - 1)))
    except IdentificationError:
        return math.nan, False
    if math.isnan(curve.edge):
        return math.nan, False
    return curve.edge, _is_sharp(curve)


def _is_sharp(curve: Fold) -> bool:
    beside = _BESIDE * 0.5 * curve.period
    before, after = curve.slope(np.array((curve.edge - beside, curve.edge + beside)))
    # Away from the edges, where a spline in noise has its largest rates.
    steepest = np.abs(curve.slope(np.linspace(0.0, curve.period, 101)))
    return bool(abs(after - before) > _JUMP * float(np.percentile(steepest, 90.0)))


def _scatter_of_edge(test: RelayTest, noisy: bool) -> float:
    """Return the standard deviation of the edge [s].

    In noise it is the scatter of single cycles; without, the edge is between two samples.
    """
    if not noisy:
        return test.whole.record.interval / math.sqrt(12.0 * len(test.whole.cycle.cycles))
    stride = -(-len(test.singles) // _MOST_SINGLES)
    edges = np.array([_edge(single)[0] for single in test.singles[::stride]])
    edges = edges[np.isfinite(edges)]
    if edges.size < 2:
        return 0.0
    return float(np.std(edges, ddof=1)) / math.sqrt(len(test.whole.cycle.cycles))


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


MOST_EQUAL = 20

# Ratio of two misfits of the half cycles up to which structures are equally good, and the misfit
# that sampling causes, as a share of the amplitude.
_ALIKE = 1.02
_ALIKE_SHARE = 3e-3
_SHAPE_SAMPLES = 300
_SMALL = 0.1


@dataclass(frozen=True)
class SymmetricMethod:
    """A method that finds one of models 1 to 5 from a symmetric limit cycle.

    :param name: its name in the registry.
    :param solve: from model, limit cycle and gain (> 0; NaN: not known) to the numbers.
    :param mismatch: from order, limit cycle and gain to log(tau by the period/tau by the
        amplitude) of equal lags. Zero: the structure fits. Positive: the process has more lag;
        infinite: no time constant gives the period. Negative: it has less lag.
    :param agreement: largest mismatch that counts as zero where its scatter is not known.
    :param remarks: from model, limit cycle and gain to sentences for the user.
    """

    name: str
    solve: Callable[[Structure, SymmetricCycle, float], Solution]
    mismatch: Callable[[int, SymmetricCycle, float], float]
    agreement: float
    remarks: Callable[[Structure, SymmetricCycle, float], list[str]]


@dataclass(frozen=True)
class Found:
    """An identification with the limit cycle that it was found from.

    :param identification: the model.
    :param model: its structure.
    :param cycle: the limit cycle.
    :param period_std: standard deviation of its period [s]; NaN: not estimated.
    :param amplitude_std: of its amplitude [y]; NaN: not estimated.
    """

    identification: Identification
    model: Structure
    cycle: SymmetricCycle
    period_std: float = math.nan
    amplitude_std: float = math.nan


def from_record(method: SymmetricMethod, record: Record, known: Known) -> Found:
    """Identify one of models 1 to 5 from an unbiased relay test.

    :param method: how.
    :param record: a relay test without bias.
    :param known: gain, dead time, structure and order where they are known.
    :raises IdentificationError: if the relay was biased, or no such model has the limit cycle.
    """
    test = relay_test(method.name, record)
    whole = test.whole
    require_unbiased(method.name, whole.settings)
    sign = -1 if whole.settings.reverse_acting else 1
    gain = known_gain(known, sign)
    reader = CycleReader.of(whole)
    dead_time = read_dead_time(test, record, known, noisy=reader.noisy)

    def read(stretch: CycleRun) -> SymmetricCycle:
        return reader.read(stretch, dead_time.value)

    cycle = read(whole)
    model, remark = _choice(method, test, read, gain, known)
    solution = _by_shape(whole, model, cycle, method.solve(model, cycle, gain))

    def values(stretch: CycleRun) -> FloatArray:
        single = _alike(method.solve(model, read(stretch), gain), solution)
        return single.values(sign, dead_time.value)

    def values_at(delay: float) -> FloatArray:
        moved = replace(cycle, dead_time=delay + whole.settings.extra_delay)
        return _alike(method.solve(model, moved, gain), solution).values(sign, delay)

    covariance, quantile = test.scatter(values)
    if covariance is not None and dead_time.std > 0.0:
        covariance = covariance + _covariance_of(values_at, dead_time)
    remarks = [
        dead_time.source,
        remark,
        skew_warning(whole),
        "" if whole.cycle.converged else NOT_SETTLED,
        *_remarks(method, model, cycle, gain, solution),
    ]
    identification = identified(
        method.name,
        Estimate.of(model, solution.values(sign, dead_time.value), covariance),
        quantile,
        warnings=tuple(r for r in remarks if r),
    )
    spread, _ = test.scatter(features)
    if spread is None:
        return Found(identification, model, cycle)
    period_std, amplitude_std = (float(s) for s in np.sqrt(np.diag(spread)))
    return Found(identification, model, cycle, period_std, amplitude_std)


def _covariance_of(values_at: Callable[[float], FloatArray], dead_time: DeadTime) -> FloatArray:
    """Return the covariance that the uncertainty of a dead time that was read adds.

    :param values_at: from a dead time [s] to the values.
    :param dead_time: as it was read.
    """
    ends = []
    for side in (-1.0, 1.0):
        delay = max(dead_time.value + side * _SMALL * dead_time.std, 0.0)
        try:
            ends.append((delay, values_at(delay)))
        except IdentificationError:
            # At the end of the range of solutions a difference to one side is enough.
            ends.append((dead_time.value, values_at(dead_time.value)))
    (low, below), (high, above) = ends
    if not high > low:
        return np.full((below.size, below.size), math.nan)
    rate = dead_time.std * (above - below) / (high - low)
    return np.outer(rate, rate)


def from_numbers(method: SymmetricMethod, cycle: SymmetricCycle, known: Known) -> Found:
    """Identify one of models 1 to 5 from the numbers of a limit cycle.

    :param method: how.
    :param cycle: the limit cycle of an unbiased relay.
    :param known: gain, structure and order where they are known.
    :raises IdentificationError: if no such model has the limit cycle.
    """
    sign = -1 if known.gain < 0.0 else 1
    gain = abs(known.gain)
    model, remark = model_asked_for(method.name, known), ""
    if model is None and math.isnan(gain):
        model, remark = _choose_without_gain(method, cycle, None)
    elif model is None:
        model, remark = choose(method, cycle, gain)
    solution = method.solve(model, cycle, gain)
    remarks = [remark, *_remarks(method, model, cycle, gain, solution)]
    identification = identified(
        method.name,
        Estimate.of(model, solution.values(sign, cycle.dead_time)),
        warnings=tuple(r for r in remarks if r),
    )
    return Found(identification, model, cycle)


def choose(
    method: SymmetricMethod,
    cycle: SymmetricCycle,
    gain: float,
    tolerance: Callable[[int], float] | None = None,
) -> tuple[Structure, str]:
    """Choose the simplest model that fits, where the gain is known.

    :param method: whose mismatch counts.
    :param cycle: the limit cycle.
    :param gain: K > 0 [y/u].
    :param tolerance: from the order of equal lags to the largest mismatch that counts as zero;
        default: the method's agreement.
    :return: the model, and a sentence where none fits well, else an empty one.
    """
    found: dict[int, float] = {}

    def fits(order: int) -> bool:
        found[order] = method.mismatch(order, cycle, gain)
        if not math.isfinite(found[order]):
            return False
        return abs(found[order]) <= (tolerance(order) if tolerance else method.agreement)

    # Between two orders of equal lags lies a model with one lag more that differs.
    for order, between in ((1, None), (2, MODEL_4), (3, MODEL_5)):
        if fits(order):
            return equal_lags(order), ""
        if found[order] < 0.0:
            return (MODEL_1 if between is None else between), ""
    best = 3
    for order in range(4, MOST_EQUAL + 1):
        if fits(order):
            return equal_lags(order), ""
        if abs(found[order]) < abs(found[best]):
            best = order
        if found[order] < 0.0:
            break
    return equal_lags(best), ""


def _choice(
    method: SymmetricMethod,
    test: RelayTest,
    read: Callable[[CycleRun], SymmetricCycle],
    gain: float,
    known: Known,
) -> tuple[Structure, str]:
    cycle = read(test.whole)
    asked = model_asked_for(method.name, known)
    if asked is not None:
        return asked, ""
    if math.isnan(gain):
        return _choose_without_gain(method, cycle, test.whole)
    interval = test.whole.record.interval

    def tolerance(order: int) -> float:
        """Allow for the scatter of the cycles, and half a sample interval of dead time."""

        def value(stretch: CycleRun) -> FloatArray:
            found = method.mismatch(order, read(stretch), gain)
            if not math.isfinite(found):
                raise IdentificationError("this cycle alone has no time constant")
            return np.array([found])

        allowed = method.agreement
        covariance, quantile = test.scatter(value)
        if covariance is not None:
            allowed = max(allowed, quantile * math.sqrt(covariance[0, 0]))
        for shift in (-0.5, 0.5):
            moved = replace(cycle, dead_time=max(cycle.dead_time + shift * interval, 0.0))
            if moved.part > 0.0:
                change = method.mismatch(order, moved, gain) - method.mismatch(order, cycle, gain)
                allowed = max(allowed, abs(change))
        return allowed

    return choose(method, cycle, gain, tolerance)


def _choose_without_gain(
    method: SymmetricMethod, cycle: SymmetricCycle, whole: CycleRun | None
) -> tuple[Structure, str]:
    """Choose among equal lags by the shape of the half cycles.

    Period and amplitude only give gain and time constant then.

    :param whole: the cycles; None: nothing is known of their shape.
    """
    solved: dict[int, Solution] = {}
    away: dict[int, float] = {}
    for order in range(1, MOST_EQUAL + 1):
        if order > 3 and (
            not solved or whole is None or min(away, key=away.__getitem__) < order - 1
        ):
            break
        try:
            solved[order] = method.solve(equal_lags(order), cycle, math.nan)
        except IdentificationError:
            continue
        away[order] = 0.0
        if whole is not None:
            misfit = shape_misfit(whole, equal_lags(order), cycle, solved[order])
            away[order] = misfit / cycle.amplitude
    if not solved:
        # The error of the simplest model says what is wrong.
        method.solve(MODEL_1, cycle, math.nan)
    order = min(n for n in solved if alike(away[n], min(away.values())))
    why = "its simplicity" if whole is None else "the shape of its half cycles"
    model = equal_lags(order)
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
    lags = lags_of(model, solution.constants)
    half = 0.5 * cycle.period
    squares = 0.0
    for time, seen in zip(since[::stride].tolist(), y[::stride].tolist(), strict=True):
        # The command that turns the measurement down arrives after the dead time.
        before = time < cycle.dead_time
        part = (time - cycle.dead_time) / half + before
        height = level(lags, cycle.period, min(max(part, 0.0), 1.0))
        squares += (seen - (height if before else -height) * solution.gain * cycle.relay) ** 2
    return math.sqrt(squares / since[::stride].size)


def _remarks(
    method: SymmetricMethod,
    model: Structure,
    cycle: SymmetricCycle,
    gain: float,
    solution: Solution,
) -> list[str]:
    remarks = []
    if model.equal_lags and not math.isnan(gain):
        difference = method.mismatch(model.order, cycle, gain)
        if abs(difference) > method.agreement:
            remarks.append(_mismatch_text(model, difference))
    remarks += [
        f"{model_text(model)} has two solutions, which period and amplitude do not tell apart: "
        f"{solution} was taken, {constants_text(other)} would do as well"
        for other in solution.others
    ]
    return remarks + method.remarks(model, cycle, gain)


def _mismatch_text(model: Structure, difference: float) -> str:
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


def _by_shape(
    whole: CycleRun, model: Structure, cycle: SymmetricCycle, solution: Solution
) -> Solution:
    """Put the solution first whose half cycles are most like the record's."""
    if not solution.others:
        return solution

    def misfit(constants: tuple[float, ...]) -> float:
        return shape_misfit(whole, model, cycle, Solution(solution.gain, constants))

    first, *rest = sorted((solution.constants, *solution.others), key=misfit)
    return Solution(solution.gain, first, tuple(rest))


def _alike(solution: Solution, reference: Solution) -> Solution:
    """Return the one of several solutions that is nearest to another."""

    def away(constants: tuple[float, ...]) -> float:
        pairs = zip(constants, reference.constants, strict=True)
        return sum(abs(math.log(c / r)) for c, r in pairs)

    return Solution(solution.gain, min((solution.constants, *solution.others), key=away))
