# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the moves of a command and the answers to them show, before any model is fitted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import FloatArray
from relay_autotune.record.record import Input, PiecewiseConstant, Record, cached_on_record

# Largest share of the samples at which a relay switches. Where a command changes more often, only
# changes by at least this share of its range count.
_MOST_SWITCHES = 0.5
_SWITCH = 0.25
# Jumps of a command are those beyond four standard deviations, six medians, of its usual moves.
_A_JUMP = 6.0
# Least number of samples of a rest; the largest share of its range by which the measurement moves
# during it, and by which it would, going on like that, in the whole record.
_RESTING = 10
_STILL, _STILL_LATER = 0.05, 0.5
# A response is seen where the measurement leaves the line of a rest by this many times the range
# about it and its drift, and by this share of the whole range. Of 300,000 rests of ten samples in
# white noise 40 showed one, of as many random walks 3 %.
_RANGES, _DRIFTS, _SHARE = 3.0, 2.0, 0.03
# Least distance of the measurements at which a command rises and falls by the clock, in ranges.
_APART = 0.5
# Longest dead time that is believed, over the time of the first response.
_BELIEVED = 2.0
# Number of time constants within which an unstable process leaves any rest.
MOST_GROWTH = 7.0
# Earlier samples that a controller's law may hold: a PID's with a filter, and a sine and a ramp.
PAST = 3
# Largest difference of a command from one sine, over its variance. A triangle's is 0.11, that of a
# sine which is held sixteen times in each period 0.055.
_NO_SINE = 0.06
# Share below which a direction of what a command is told from is one of rounding.
_DEPENDENT = 1e-9


def changes_within(u: Input, time: FloatArray) -> FloatArray:
    """Return when an input changes between the first and the last sample [s].

    :param u: the input.
    :param time: of the samples [s], shape (n,).
    """
    return np.asarray(u.times[(u.times >= time[0]) & (u.times < time[-1])])


def moves_always(time: FloatArray, u: Input) -> bool:
    """Return whether a command moves at most samples, as a controller's does.

    :param time: of the samples [s], shape (n,).
    :param u: the command.
    """
    return changes_within(u, time).size > _MOST_SWITCHES * time.size


def large_changes(u: PiecewiseConstant) -> FloatArray:
    """Return when a command moves far, as a controller's does when its set-point is switched [s].

    :param u: the command.
    """
    return np.asarray(u.times[np.abs(np.diff(u.levels)) >= _SWITCH * float(np.ptp(u.values))])


def only_move(u: PiecewiseConstant, time: FloatArray) -> float | None:
    """Return when an input changes, if it does so once between the first and the last sample [s].

    :param u: the input.
    :param time: of the samples [s], shape (n,).
    """
    changes = changes_within(u, time)
    moves = changes[np.diff(u.levels)[np.isin(u.times, changes)] != 0.0]
    return float(moves[0]) if moves.size == 1 else None


def begins_with_only_move(time: FloatArray, u: Input) -> bool:
    """Return whether an input changes once, before three samples show how the measurement moves.

    Beside the answer a drift, a free state or a move before then explain anything: an integrator
    and a drift answer as a lag does, of either sign.

    :param time: of the samples [s], shape (n,).
    :param u: the input.
    """
    move = only_move(u, time) if isinstance(u, PiecewiseConstant) else None
    return move is not None and int(np.count_nonzero(time < move)) < 3


def longest_stay(time: FloatArray, u: Input) -> float:
    """Return the longest time between samples for which an input stood still [s].

    :param time: of the samples [s], shape (n,).
    :param u: the input.
    """
    changes = changes_within(u, time)
    return float(np.max(np.diff(np.concatenate((time[:1], changes, time[-1:])))))


def longest_push(time: FloatArray, u: Input) -> float:
    """Return the longest time for which a command stayed on one side of its mean [s].

    :param time: of the samples [s], shape (n,).
    :param u: the command.
    :return: infinite for ramps, whose response turns gradually.
    """
    if not isinstance(u, PiecewiseConstant):
        return math.inf
    level = u(time)
    turns = np.flatnonzero(np.diff(level > level.mean())) + 1
    return float(np.diff(time[np.concatenate(([0], turns, [time.size - 1]))]).max())


def left_by_one_sine(time: FloatArray, y: FloatArray, u: Input) -> float:
    """Return what a constant, a line and the steady answer to one sine leave of a measurement [y].

    Such an answer tells two numbers of a process, however long it lasts. At a sixth of its period
    apart, a sine fulfils ``u(t + h) + u(t - h) = u(t)``, and no other periodic command does; of
    ``u(t)`` and ``u(t - h)`` any answer to it is a sum.

    :param time: of the samples [s], shape (n,).
    :param y: the measurement, shape (n,).
    :param u: the command.
    :return: rms; NaN where the command is not two whole periods of one sine.
    """
    h = longest_push(time, u) / 3.0
    if not isinstance(u, PiecewiseConstant) or not 12.0 * h <= time[-1] - time[0]:
        return math.nan
    inside = (time >= time[0] + h) & (time <= time[-1] - h)
    t = time[inside]
    level = u(t)
    middle = np.mean(level)
    apart = u(t + h) + u(t - h) - level - middle
    if float(np.mean(apart**2)) > _NO_SINE * float(np.var(level)):
        return math.nan
    columns = np.stack((np.ones(t.size), t - t[0], level - middle, u(t - h) - middle), axis=1)
    left = y[inside] - columns @ np.linalg.lstsq(columns, y[inside], rcond=None)[0]
    return math.sqrt(float(np.mean(left**2)))


def answering_time(time: FloatArray, u: Input) -> float:
    """Return how long samples go on after the first change of an input within them [s].

    :param time: of the samples [s], shape (n,).
    :param u: the input; where it does not change, the time of all samples counts.
    """
    changes = changes_within(u, time)
    return float(time[-1] - (changes[0] if changes.size else time[0]))


def begins_at_rest(time: FloatArray, y: FloatArray, u: Input) -> bool:
    """Return whether an experiment begins with a rest, which shows what came before.

    A measurement that does not move for a while after the first change shows as much: what acts
    within a dead time had been commanded before the record.

    :param time: of the samples [s], shape (n,).
    :param y: the measurement, shape (n,).
    :param u: the input.
    """
    changes = changes_within(u, time)
    before = time < (changes[0] if changes.size else time[0])
    first = y[: max(int(np.count_nonzero(before)), 1)]
    before[: int(np.argmax(np.abs(y - first.mean()) > _STILL * np.ptp(y)))] = True
    if np.count_nonzero(before) < _RESTING or not np.ptp(time[before]) > 0.0:
        return False
    slope, left = _line_of(time[before], y[before])
    wide, spread = float(np.ptp(y)), math.sqrt(left.size) * float(np.std(time[before]))
    if abs(slope) * float(np.ptp(time[before])) > _STILL * wide:
        return False
    chance = 2.0 * float(np.std(left)) / spread
    return abs(slope) <= chance or abs(slope) * float(np.ptp(time)) <= _STILL_LATER * wide


@cached_on_record
def resting_command(record: Record) -> float:
    """Return the command at which a process rests before its test [u]; NaN: it does not.

    :param record: a record of any origin.
    """
    if record.settings is not None:
        return record.settings.baseline
    u = record.input()
    if not begins_at_rest(record.time, record.measurement, u):
        return math.nan
    return float(u(record.time[:1])[0])


def first_response(time: FloatArray, y: FloatArray, u: Input) -> tuple[float, float]:
    """Return the longest dead time that the first response after a rest allows, of each direction.

    A response is sure where the measurement leaves the line of the rest before the first change of
    the command much farther than it moved during the rest, within no longer than the rest lasted,
    so that neither noise nor a drift explains it. Twice the time of that response is allowed,
    since a process may change its dead time a little meanwhile. A response in the other direction
    is an inverse one, for which a dead time may stand.

    :param time: of the samples [s], shape (n,).
    :param y: the measurement, in any unit, shape (n,).
    :param u: the command.
    :return: of a gain below zero, and of one above [s]: infinite where no response is sure, minus
        infinity where a sure one goes in the other direction alone.
    """
    unknown = math.inf, math.inf
    inside = np.flatnonzero((u.times >= time[0]) & (u.times < time[-1]))
    if not inside.size or not isinstance(u, PiecewiseConstant):
        return unknown
    k = int(inside[0])
    change = float(u.times[k])
    rested = change - float(time[0])
    moved = np.sign(u.levels[k + 1 :] - u.levels[k])
    first = int(np.searchsorted(time, change, side="right"))
    if first < _RESTING:
        return unknown
    slope, noise = _line_of(time[:first], y[:first])
    left = moved[0] * (y - np.mean(y[:first]) - slope * (time - np.mean(time[:first])))
    drift = abs(slope) * float(np.ptp(time[:first]))
    band = max(_RANGES * float(np.ptp(noise)), _DRIFTS * drift, _SHARE * float(np.ptp(y)))
    # What comes after the command has crossed its rest may answer that.
    crossed = u.times[k:][moved == -moved[0]]
    last = int(np.searchsorted(time, crossed[0], side="right")) if crossed.size else time.size
    begins, answers = [], []
    for sign in (-1, 1):
        outside = sign * left[first:last] > band
        # A single sample may be a spike.
        at = time[first + np.flatnonzero(outside[:-1] & outside[1:])]
        begins.append(float(at[0]) - change if at.size else math.inf)
        # After the command came back, only the former answer and drifts go on.
        answers.append(bool(np.any(u(at) != u.levels[k])))
    latest = [_BELIEVED * begin if begin <= rested else math.inf for begin in begins]
    for one, other in ((0, 1), (1, 0)):
        # The direction is sure where the measurement never turns to the other side.
        if latest[one] < math.inf and begins[one] < begins[other] and not answers[other]:
            latest[other] = -math.inf
    return latest[0], latest[1]


def _line_of(time: FloatArray, y: FloatArray) -> tuple[float, FloatArray]:
    """Return the slope of the line through some samples, 0 at one instant, and what it leaves."""
    t, away = time - np.mean(time), y - np.mean(y)
    slope = float(t @ away) / (float(t @ t) or 1.0)
    return slope, away - slope * t


def answers_soon(time: FloatArray, y: FloatArray, u: Input) -> bool:
    """Return whether a measurement moves sooner after the first change than it had rested.

    Where it is about alike when the command rises and when it falls, a relay or a controller
    follows it, and changes the command because it left its rest, whatever moved it.

    :param time: of the samples [s], shape (n,).
    :param y: the measurement, in any unit, shape (n,).
    :param u: the command.
    """
    if not isinstance(u, PiecewiseConstant):
        return False
    inside = (u.times >= time[0]) & (u.times < time[-1])
    then = y[np.maximum(time.searchsorted(u.times[inside]) - 1, 0)]
    up = np.diff(u.levels)[inside] > 0.0
    turns = up.any() and not up.all()
    if turns and abs(then[up].mean() - then[~up].mean()) < _APART * np.ptp(y):
        return False
    # A command that does not change has no rest before it.
    rested = float(u.times[inside][0] - time[0]) if up.size else 0.0
    return any(0.0 <= latest < rested for latest in first_response(time, y, u))


def law_of(
    u: FloatArray, y: FloatArray, used: NDArray[np.bool_] | slice = slice(None)
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the law that tells a command from its own past and the measurement.

    ``u_k = sum_i a_i u_{k-i} + sum_j b_j y_{k-j} + c``, with i from 1 and j from 0 to ``PAST``, by
    least squares. A controller's law is such a one, with a set-point in what it leaves.

    :param u: the command, in any unit, shape (n,).
    :param y: the measurement, in any unit, shape (n,).
    :param used: which of the last n - PAST commands are told; default: all.
    :return: a, b and c; what the law leaves of these commands; and what a law of the command's own
        past leaves of them.
    """
    now = u[PAST:]
    own = [u[PAST - k : u.size - k] for k in range(1, PAST + 1)]
    seen = [y[PAST - k : y.size - k] for k in range(PAST + 1)]
    left = []
    for rows in (own, [*own, *seen]):
        columns = np.stack((*rows, np.ones(now.size)), axis=1)[used]
        factors = np.linalg.lstsq(columns, now[used], rcond=_DEPENDENT)[0]
        left.append(now[used] - columns @ factors)
    return factors, left[1], left[0]


def is_controlled(time: FloatArray, y: FloatArray, u: Input) -> bool:
    """Return whether a command moves at most samples, and as the measurement says.

    The command's next move is predicted by its past alone, and by that of the measurement, too
    (Granger 1969; Gustavsson, Ljung and Soderstrom 1977), beside the jumps that a set-point makes.
    A controller holds its command from sample to sample.

    :param time: of the samples [s], shape (n,).
    :param y: the measurement, in any unit, shape (n,).
    :param u: the command.
    """
    if not isinstance(u, PiecewiseConstant) or time.size <= 4 * PAST or not moves_always(time, u):
        return False
    moved, y = u(time) / np.ptp(u(time)), y / (np.ptp(y) or 1.0)
    jumps = np.abs(law_of(moved, y)[2])
    _, left, alone = law_of(moved, y, jumps <= _A_JUMP * np.median(jumps))
    least = left.size * _DEPENDENT**2
    odds = math.log(max(float(alone @ alone), least) / max(float(left @ left), least))
    # Schwarz's criterion, with a number for each of these measurements.
    return left.size * odds > (PAST + 1) * math.log(left.size)
