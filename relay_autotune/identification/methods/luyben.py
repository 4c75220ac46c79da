# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `luyben_step`: an integrating process with inverse response, from a step test.

Dead time, extremum and return are read off a smooth curve: the baseline, and from the end of the
dead time on a polynomial that leaves it. The dead time is where the two fit best; Akaike's
information criterion decides the number of powers.

Luyben, "Identification and Tuning of Integrating Processes with Deadtime and Inverse Response",
Ind. Eng. Chem. Res. 2003. The process is K (1 - tau1 s) exp(-D s)/(s (tau2 s + 1)). All times here
count from the end of the dead time; y is the deviation from before the step of height du.

The paper solves its eqs 4 to 6 by iteration in three unknowns, with a program whose third equation
has a divisor tau2 too many (its printed example follows from that). With
r = (tau1 + tau2)/tau2 and z = t2/tau2 only one monotone equation has to be solved:

    t1 = tau2 ln r,   r = z/(1 - exp(-z)),   t2/t1 = z/ln r,   y_ext = du K (t1 - tau1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.limit_cycle.fold import Reading
from relay_autotune.identification.methods.solved import solved, structure_asked_for
from relay_autotune.identification.result import FitReport, Identification
from relay_autotune.process.response import response
from relay_autotune.process.structures import INTEGRATOR_INVERSE
from relay_autotune.record.record import PiecewiseConstant, Record
from relay_autotune.scalar import minimum_near, root

_SMALL = 1e-3
_LARGEST = 1e8


def from_step(t1: float, t2: float, extremum: float, step: float) -> tuple[float, float, float]:
    """Return (K, tau1, tau2) of the process (eqs 4 to 6 in closed form).

    :param t1: when the extremum is reached, a minimum or a maximum [s].
    :param t2: when y is back where it was before the step [s].
    :param extremum: height of the extremum, from before the step [y].
    :param step: du [u].
    :return: K [y/(u s)], of the sign that has the extremum on the side away from K du; tau1 and
        tau2 [s].
    :raises IdentificationError: unless 0 < 2 t1 < t2, or if the extremum or the step is zero.
    """
    if extremum == 0.0 or step == 0.0 or not math.isfinite(extremum) or not math.isfinite(step):
        raise IdentificationError(
            f"an inverse response of {extremum:g} to a step of {step:g} tells nothing: both must "
            "be finite and not zero"
        )
    if not 0.0 < 2.0 * t1 < t2:
        raise IdentificationError(
            f"the extremum comes after {t1:g} s and the return after {t2:g} s, but an integrator "
            "with inverse response takes more than twice as long to return; both count from the "
            "end of the dead time"
        )
    ratio = t2 / t1

    def excess(z: float) -> float:
        return _ratio(z) - ratio

    if excess(_LARGEST) < 0.0:
        raise IdentificationError(
            f"a return {ratio:g} times later than the extremum is no response of this structure: "
            "its lag would vanish"
        )
    z = root(excess, 0.0, _LARGEST, 1e-16)
    if z == 0.0:
        raise IdentificationError(
            "the return comes at just twice the time of the extremum, so that the inverse "
            "response would vanish beside the lag: read the times more closely"
        )
    tau2 = t2 / z
    tau1 = tau2 * _r_less_1(z)
    # t1 - tau1 = tau2 (ln r - (r - 1))
    return extremum / (step * (t1 - tau1)), tau1, tau2


def _r_less_1(z: float) -> float:
    """Return z/(1 - exp(-z)) - 1 without cancellation."""
    if z < _SMALL:
        return z / 2.0 + z * z / 12.0 - z**4 / 720.0
    return (z + math.expm1(-z)) / -math.expm1(-z)


def _ratio(z: float) -> float:
    """Return t2/t1 = z/ln r, which rises from 2 at z = 0."""
    return z / math.log1p(_r_less_1(z)) if z > 0.0 else 2.0


METHOD = "luyben_step"

_LEAST_SAMPLES = 20
_MOST_POINTS = 2000
_MOST_POWERS = 16
_PATIENCE = 2
_PLACES = 60
_SEARCHED = 4
_BEYOND = 1.4
_SIGNIFICANT = 4.0
_NEGLIGIBLE = 1e-9
_UNEXPLAINED = 1.5


@dataclass(frozen=True)
class StepTest:
    """One step in a record.

    :param begin: when the command steps [s].
    :param step: du [u].
    :param time: of the samples, up to the next change of the command [s], shape (n,).
    :param y: the samples, shape (n,).
    """

    begin: float
    step: float
    time: FloatArray
    y: FloatArray


def identify_step(record: Record, known: Known = NOTHING) -> Identification:
    """Identify an integrating process with inverse response from a step test (eqs 4 to 6).

    :param record: one step of the command, long enough for the measurement to come back; samples
        before the step tell the baseline.
    :param known: a known dead time is not read from the record.
    :raises IdentificationError: if the record holds no such response.
    """
    structure_asked_for(METHOD, known, (INTEGRATOR_INVERSE,))
    test = step_test(record)
    noise = record.noise
    reading, end = _read_curve(test, _return_time(test, noise), known.dead_time)
    found = solved(
        *(METHOD, INTEGRATOR_INVERSE),
        lambda numbers: _values(numbers, end, test.step),
        reading,
    )
    # The whole step response, as far as the command kept still.
    u = PiecewiseConstant(np.array([test.begin]), np.array([test.step]), 0.0)
    fitted = np.full(len(record), math.nan)
    fitted[: test.time.size] = reading.values[-1] + response(found.model, test.time, u)
    left = float(np.sqrt(np.nanmean((record.measurement - fitted) ** 2)))
    spread = float(np.std(test.y))
    warnings = found.warnings
    if left > max(_UNEXPLAINED * noise, 1e-4 * float(np.ptp(test.y))):
        text = (
            f"the model leaves {left:.3g} rms of the step response unexplained, where the noise "
            f"is {noise:.3g}: noise moved the few numbers that the method reads, the process is "
            "of another structure, or it was not in balance before the step; the method waveform "
            "uses all samples"
        )
        warnings = (*warnings, text)
    fit = FitReport(left, record.noise_std, 1.0 - left / spread if spread > 0.0 else math.nan)
    return replace(found, fit=fit, warnings=warnings, fitted=fitted)


def identify_step_numbers(
    t1: float, t2: float, extremum: float, step: float, dead_time: float
) -> Identification:
    """Identify an integrating process with inverse response from numbers read by hand.

    :param t1: from the end of the dead time to the extremum [s].
    :param t2: from the end of the dead time to the return [s].
    :param extremum: its height, from before the step [y].
    :param step: du [u].
    :param dead_time: D [s].
    :raises IdentificationError: if no such process has these numbers.
    """
    numbers = Reading(np.array((t1, t2, extremum)))
    return solved(
        *(METHOD, INTEGRATOR_INVERSE),
        lambda x: (*from_step(float(x[0]), float(x[1]), float(x[2]), step), dead_time),
        numbers,
    )


def step_test(record: Record) -> StepTest:
    """Return the first step of a record.

    :param record: the record.
    :raises IdentificationError: if the command never changes, or no sample precedes the change.
    """
    u, time = record.input(), record.time
    inside = np.flatnonzero((u.times >= time[0]) & (u.times < time[-1]))
    if inside.size == 0:
        raise IdentificationError(
            f"the command never changes within the record; {METHOD} needs one step of it"
        )
    k = int(inside[0])
    begin = float(u.times[k])
    before = float(u.levels[k])
    end = float(u.times[k + 1]) if k + 1 < u.times.size else math.inf
    # The sample at the step itself was taken before it.
    part = time <= end
    if not bool(np.any(time <= begin)):
        raise IdentificationError("no sample precedes the step, so that its baseline is not known")
    if np.count_nonzero(part & (time > begin)) < _LEAST_SAMPLES:
        raise IdentificationError(
            f"the command changes again {end - begin:g} s after its first step, with fewer than "
            f"{_LEAST_SAMPLES} samples between: {METHOD} needs one step and its whole response"
        )
    return StepTest(begin, float(u.values[k]) - before, time[part], record.measurement[part])


def _return_time(test: StepTest, noise: float) -> float:
    """Return roughly when the measurement is back at its baseline, from the step on [s].

    The area between the measurement and its baseline falls while the response is inverse and
    rises from then on, so that its least is where the measurement returns, however noisy.
    """
    after = test.time > test.begin
    since = test.time[after] - test.begin
    deviation = test.y[after] - float(np.mean(test.y[~after]))
    last = max(deviation.size // 10, 1)
    side = math.copysign(1.0, float(np.mean(deviation[-last:])))
    interval = np.diff(since, prepend=0.0)
    area = np.cumsum(side * deviation * interval)
    i = int(np.argmin(area))
    scatter = noise * math.sqrt(float(np.sum(interval[: i + 1] ** 2)))
    least = max(_SIGNIFICANT * scatter, _NEGLIGIBLE * float(np.sum(np.abs(deviation) * interval)))
    if not -area[i] > least:
        raise IdentificationError(
            "the measurement shows no inverse response to the step beyond its noise, or had not "
            "come back from it when the record or the step ended: record longer, make the step "
            "larger, or use the method waveform"
        )
    return float(since[i])


def _read_curve(test: StepTest, until: float, known: float) -> tuple[Reading, float]:
    """Read a smooth curve: the baseline, and a polynomial that leaves it after the dead time.

    :param test: the step.
    :param until: roughly when the measurement returns, from the step on [s].
    :param known: the dead time [s]; NaN: the one with which the curve fits best.
    :return: the dead time, the coefficients of T_k(2 x - 1) - T_k(-1), T_k Chebyshev's polynomials
        with k = 1, 2, ..., and the baseline; and where the polynomial ends [s].
    """
    end = _BEYOND * until
    count = int(np.count_nonzero(test.time <= test.begin + end))
    # Neighbours are averaged, those before the step apart from those after it.
    stride = max(1, count // _MOST_POINTS)
    first = int(np.searchsorted(test.time, test.begin, side="right")) % stride
    edges = np.arange(first, count, stride)
    weight = np.diff(np.append(edges, count))
    time, y = (np.add.reduceat(x[:count], edges) / weight for x in (test.time, test.y))
    since, n = time - test.begin, y.size
    floor = n * (_NEGLIGIBLE * float(np.ptp(y))) ** 2 or 1e-300
    # The extremum comes after the dead time and before the return.
    places = np.linspace(0.0, until, _PLACES, endpoint=False)

    def fitted(dead_time: float, powers: int) -> tuple[float, FloatArray, FloatArray]:
        x = np.clip(2.0 * (since - dead_time) / (end - dead_time) - 1.0, -1.0, 1.0)
        moved = np.polynomial.chebyshev.chebvander(x, powers)[:, 1:] - _at_begin(powers)
        columns = np.column_stack((moved, np.ones(n)))
        solution = np.linalg.lstsq(columns, y, rcond=1e-12)[0]
        rest = y - columns @ solution
        return float(rest @ rest), np.asarray(solution), columns

    def placed(near: float, powers: int) -> float:
        """Return the dead time of the least sum of squares, next to another one."""
        if not math.isnan(known):
            return known

        def left(place: float) -> float:
            return fitted(place, powers)[0]

        # With few powers the end of the dead time is searched for everywhere.
        away = [left(p) for p in places] if powers <= _SEARCHED else np.abs(places - near)
        i = int(np.argmin(away))
        found, least = minimum_near(left, places, i, 1e-9 * float(places[-1]))
        # The search does not try its ends.
        return 0.0 if i <= 1 and left(0.0) <= least else found

    best, dead_time, worse = (math.inf, 0.0, 0), known, 0
    for powers in range(2, min(_MOST_POWERS, n // 4) + 1):
        dead_time = placed(dead_time, powers)
        cost = max(fitted(dead_time, powers)[0], floor)
        criterion = n * math.log(cost) + 2.0 * (powers + 2) * n / max(n - powers - 3, 1)
        worse = 0 if criterion < best[0] else worse + 1
        best = min(best, (criterion, dead_time, powers))
        if worse > _PATIENCE:
            break
    if not best[-1]:
        raise IdentificationError(
            f"the inverse response holds {n} samples, too few to read it: sample faster"
        )
    # One power more than fits best, so that the intervals hold the noise and no missing power.
    powers = min(best[-1] + 1, _MOST_POWERS)
    dead_time = placed(best[1], powers)
    cost, solution, columns = fitted(dead_time, powers)
    numbers = np.concatenate(([dead_time], solution))
    late = since - dead_time
    slope = _deviation(numbers, end).deriv()(np.maximum(late, 0.0))
    by_dead_time = np.where((late > 0.0) & math.isnan(known), -slope, 0.0)
    slopes = np.column_stack((by_dead_time, columns))
    freedom = n - slopes.shape[1] + (not math.isnan(known))
    if freedom < 1:
        return Reading(numbers, None, test.y.size), end
    covariance = np.linalg.pinv(slopes.T @ slopes, rcond=1e-14) * (cost / freedom)
    return Reading(numbers, np.asarray(covariance), test.y.size), end


def _at_begin(powers: int) -> FloatArray:
    """Return T_k(-1) for k = 1, 2, ..., shape (powers,)."""
    return (-1.0) ** np.arange(1, powers + 1)


def _deviation(numbers: FloatArray, end: float) -> np.polynomial.Chebyshev:
    """Return the deviation from the baseline against the time since the dead time ended."""
    c = numbers[1:-1]
    constant = -float(c @ _at_begin(c.size))
    return np.polynomial.Chebyshev((constant, *c), domain=[0.0, end - numbers[0]])


def _values(numbers: FloatArray, end: float, step: float) -> Sequence[float]:
    """Read extremum and return off the curve, and solve."""
    deviation, span = _deviation(numbers, end), end - float(numbers[0])
    turns = _real_roots(deviation.deriv(), span)
    side = math.copysign(1.0, float(deviation(span)))
    turns = turns[side * deviation(turns) < 0.0]
    if turns.size == 0:
        raise IdentificationError(
            "the step response has no extremum on the side away from where it goes: it is no "
            "integrating process with inverse response, or noise hides it"
        )
    t1 = float(turns[np.argmin(side * deviation(turns))])
    returns = _real_roots(deviation, span)
    returns = returns[returns > t1]
    if returns.size == 0:
        raise IdentificationError(
            "the measurement does not come back to where it was before the step: record longer"
        )
    return *from_step(t1, float(returns[0]), float(deviation(t1)), step), float(numbers[0])


def _real_roots(polynomial: np.polynomial.Chebyshev, span: float) -> FloatArray:
    roots = polynomial.roots()
    real = roots.real[np.abs(roots.imag) < 1e-9 * span]
    return np.sort(real[(real > 1e-9 * span) & (real <= span)])
