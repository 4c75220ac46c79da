# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The search for the PI or PID controller with the smallest IAE within bounds on Ms and Mt.

With the largest integral gain that the bounds allow, only kp and td remain to be chosen. A scan
of both finds the region of the optimum. A pattern search then finds the optimum, and tries
whether a smaller integral gain is better still. The models within the uncertainty come last. The
search begins with the few hardest ones; models on which its result breaks a bound are added until
these are at most 5 % of all models.

The error's own integral is ``1/ki`` exactly, whatever the process; only the part of the other
sign has to be followed,

    IAE = 1/ki + 2 int max(-y, 0) dt,

which is small for well damped loops, so that few points suffice. This cost need not be smooth.
Where two of its pieces meet in a ridge, few directions lead down along it; so the directions of
the pattern search change at each step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop, abscissae, inverted
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate, Slope
from relay_autotune.loop.laws import CONTINUOUS
from relay_autotune.loop.stability import peaks
from relay_autotune.process.model_set import ModelSet
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.tuning.candidates import Surroundings, filters_of, stable_gains
from relay_autotune.tuning.frontier import Bounds, Candidates, Responses, design_grid

_POINTS = 512
_RESETS, _TURNS = 6.0, 5.0
# Length of a sampled load response in ultimate periods, and range of its number of samples.
_PERIODS, _LEAST_SAMPLES, _MOST_SAMPLES = 32.0, 256, 2048
# Largest phase of the filter below the grid of frequencies [rad].
_TURNED = 0.1
# Samples in an ultimate period above which its cost is as good as that of the continuous loop.
_FAST = 25.0


_SHRINK, _GROW = 0.5, 1.5
_ON_A_LINE = np.array([-1.0, -0.5, -0.25, -0.125, 0.125, 0.25, 0.5, 1.0])
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
# A smaller improvement does not count.
_GAINED = 1.0 - 1e-7


def pattern_search(
    costs: Callable[[FloatArray, float], FloatArray],
    point: FloatArray,
    cost: float,
    size: int,
    steps: tuple[float, float],
    directions: int,
) -> tuple[FloatArray, float]:
    """Return the point of least cost near another, and its cost.

    :param costs: returns the costs, shape (k,), of points, shape (k, n); a cost above its second
        argument need not be exact.
    :param point: where to begin, shape (n,); its last coordinate stays at 0 or below.
    :param cost: cost at that point, positive.
    :param size: number of coordinates to move, the first ones.
    :param steps: the first step and the last.
    :param directions: number of directions tried at once.
    """
    rng = np.random.default_rng(0)
    (step, least), last, turns = steps, np.zeros((0, point.size)), 0
    while step > least:
        moves = np.zeros((_ON_A_LINE.size if size == 1 else directions, point.size))
        moves[:, :size] = _moves(size, directions, turns, rng)
        tried = point + step * np.concatenate((moves, last))
        tried[:, -1] = np.minimum(tried[:, -1], 0.0)
        found = costs(tried, cost)
        best = int(np.argmin(found))
        if found[best] < cost * _GAINED:
            # Along a ridge the last successful direction is often good again.
            last = (tried[best] - point)[None] / step
            step *= _GROW * float(np.linalg.norm(last))
            point, cost = tried[best], float(found[best])
        else:
            step *= _SHRINK * float(np.linalg.norm(moves, axis=1).min())
        turns += 1
    return point, cost


def _moves(size: int, directions: int, turns: int, rng: np.random.Generator) -> FloatArray:
    """Return the moves to try, of length at most 1, shape (k, size)."""
    if size == 1:
        return _ON_A_LINE[:, None]
    if size == 2:
        # Turned by the golden section of the angle between two, the directions never repeat.
        angles = (np.arange(directions) + _GOLDEN * turns) * (2.0 * math.pi / directions)
        return np.column_stack((np.cos(angles), np.sin(angles)))
    found = rng.standard_normal((directions, size))
    return np.asarray(found / np.linalg.norm(found, axis=1)[:, None])


# Proportional gains are scanned over this part of the stable range, from its upper end.
_DEPTH = 1e4
_GAINS = {False: 64, True: 32}
# Derivative times, in periods of the ultimate point.
_TIMES = np.geomspace(3e-3, 1.0, 14)
# First and last step of a search, and of one that is taken up again.
_WHOLE, _ROUGH, _FINE = (0.12, 1e-3), (0.12, 0.03), (0.08, 1e-3)
_AGAIN = 0.67
_DIRECTIONS = 20
# Steps of kp, of the share of the largest ki, and of kd, that show whether a smaller ki is better.
_INWARD = np.array(
    [(p, f, d) for p in (-0.03, 0.0, 0.03) for f in (-0.02, -0.1) for d in (0.0, 0.03)]
)
_TRIED_AT_ONCE = 40
# Range of a bound, and the relative tolerance of its excess over 1: on the process, and where the
# models around it are asked too.
_LEAST_BOUND, _LARGEST_BOUND = 1.01, 101.0
_EXCESS_TOLERANCE, _ROUGH_TOLERANCE = 0.01, 0.03
_MARGIN = 1.2
# Integral gains have to be above the lower end of their range by this factor.
_CLEAR = 1.02
# A bound counts as kept up to this factor; frequencies are added to the grid at most so often.
_HELD, _MOST_ADDED = 1.0 + 1e-4, 6
_UNLIMITED = 0.1
# Phase that derivative action adds with a good margin [rad]; where the frequency is sought at
# which a process is that much later, in ultimate frequencies; how far below it a design may be.
_LEAD, _HIGHEST, _FREQUENCIES, _ABOVE = math.pi / 6.0, 1e5, 200, 100.0
# The range of gains of the continuous loop is left by this factor at a sampling period.
_WIDER = 1.6
# An integral that is advanced before the output takes at most this part of kp' from kp.
_SHARE = 0.95
_NO_LIMIT = (
    "nothing limits the gain of a controller on this model, which has no dead time: give the "
    "controller's sampling period or the loop's delay"
)


@dataclass(frozen=True)
class Optimum:
    """The best controller of one kind, and what had to be given up for it.

    :param controller: the gains.
    :param iae: IAE after a unit step of the load, as computed in the search [y s/u].
    :param bounds: that it keeps.
    :param derivative: True: PID, False: PI.
    :param warnings: what it does not keep, each a sentence.
    """

    controller: Controller
    iae: float
    bounds: Bounds
    derivative: bool
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Search:
    """A process, and the limits that its controller must keep.

    Candidates hold kp' and td' of :mod:`~relay_autotune.tuning.frontier`.

    :param model: the process, with the dead time of the loop, but none for the hold.
    :param models: processes within its uncertainty, with the same dead time; the bounds also hold
        on all but 5 % of them. None: it is not known.
    :param filter_ratio: largest td/tf.
    :param noise: largest standard deviation of the command per that of the noise in the samples
        [u/y]; infinite: no limit.
    :param rate: the law that runs the gains, and its sampling period.
    """

    model: TransferFunction
    models: ModelSet | None = None
    filter_ratio: float = 10.0
    noise: float = math.inf
    rate: LawRate = CONTINUOUS

    @property
    def differentiates(self) -> bool:
        """True if the law has a derivative."""
        return self.rate.law.slope is not Slope.NONE

    @cached_property
    def late(self) -> TransferFunction:
        """The process with a dead time for the hold, as it is met about the crossover."""
        lag = self.rate.law.lag(self.rate.period)
        return replace(self.model, dead_time=self.model.dead_time + lag)

    @cached_property
    def frequency(self) -> float:
        """Frequency about which the loop is closed [rad/s]."""
        point = ultimate_point(self.late)
        if point is not None:
            # Two slow lags turn the phase as two integrators do, which derivative action holds at
            # frequencies far above.
            higher = point.frequency * np.geomspace(1.0, _HIGHEST, _FREQUENCIES)
            phase = self.late.phase(higher)
            held = higher[np.count_nonzero(phase >= phase[0] - _LEAD) - 1]
            return max(point.frequency, float(held) / _ABOVE)
        constants = [abs(c) for c in (*self.late.time_constants, self.late.dead_time) if c]
        return 1.0 / min(constants, default=1.0)

    @cached_property
    def _largest_kp(self) -> float:
        """A gain that is larger than any useful one, for loops that are stable at every gain."""
        return 1e4 / abs(complex(self.late(1j * self.frequency)))

    @cached_property
    def responses(self) -> Responses:
        """Response of the process, at the frequencies where bounds are tested."""
        grid = design_grid(self.late, self.frequency, self.rate.period)
        return Responses(ModelSet((self.model,)), grid, self.frequency, self.rate)

    @cached_property
    def around(self) -> Surroundings | None:
        """The models within the uncertainty of the process."""
        if self.models is None:
            return None
        grid = self.responses.grid
        few = np.append(grid[:-1:2], grid[-1])
        # Single precision is twice as fast and more than an ensemble needs.
        single = few.astype(np.float32)
        return Surroundings(Responses(self.models, single, self.frequency, self.rate))

    def _controller(self, best: Candidates) -> Controller:
        """Return the first of some candidates, with the sign of the process."""
        return best.controller(0, self.model.process_sign, self.rate)

    def _ceiling(self, kp: FloatArray) -> FloatArray | float:
        """Return the integral gains that each proportional gain allows by itself, shape (k,)."""
        # An integral that is advanced before the output takes a part of kp'; the rest is kp.
        lead = self.rate.law.integral.lead * self.rate.period
        return _SHARE * 2.0 * kp / lead if lead > 0.0 else math.inf

    def _span(self, td: float) -> tuple[float, float] | None:
        """Return the range of proportional gains to look at for a derivative time [s]."""
        # Higher frequencies than the sampled loop has may have limited the gain.
        grid = design_grid(self.late, self.frequency)
        span = stable_gains(self.late, grid, td, td / self.filter_ratio)
        if span is None or self.rate.period == 0.0:
            return span
        return span[0] / _WIDER, span[1] * _WIDER

    def _among(self, around: Surroundings | None) -> Search:
        """Return this search with other models around the process; its responses are kept."""
        search = replace(self, models=self.models if around else None)
        known = {"frequency": self.frequency, "responses": self.responses, "around": around}
        search.__dict__.update(known)
        return search

    def optimum(self, bounds: Bounds, *, derivative: bool) -> Optimum | None:
        """Return the controller with the smallest IAE; None: no controller keeps the bounds.

        :param bounds: on the sensitivities.
        :param derivative: True: PID, False: PI.
        :raises TuningError: if nothing limits the gain.
        """
        alone = self._among(None)
        scanned = alone.scan(bounds, self._times(derivative))
        if scanned is None:
            return None
        if np.isinf(scanned.ki).any():
            raise TuningError(_NO_LIMIT)
        point, iae = alone.least(scanned)
        if self.around is None:
            point, iae = self.settle(bounds, *self.descend(bounds, point, iae))
            if not math.isfinite(iae):
                return None
            best = self._at(bounds, point[None])
        else:
            point, _ = alone.descend(bounds, point, iae, _ROUGH)
            few = self.around.hardest(bounds, alone._at(bounds, point[None]))
            found = self._among_models(bounds, point, few)
            if found is None:
                return None
            best, iae = found
        if best.kp[0] > _UNLIMITED * self._largest_kp:
            raise TuningError(_NO_LIMIT)
        return Optimum(self._controller(best), iae, bounds, derivative)

    def _among_models(
        self, bounds: Bounds, point: FloatArray, asked: Surroundings
    ) -> tuple[Candidates, float] | None:
        """Return the best controller and its IAE, with bounds on the models around it as well.

        :param bounds: on the sensitivities.
        :param point: the rough optimum on the process itself.
        :param asked: the few hardest models.
        :return: None if no controller keeps the bounds.
        """
        steps = _ROUGH
        while True:
            search = self._among(asked)
            found = search._beginning(bounds, point)
            if found is None:
                return None
            point, iae = search.descend(bounds, *found, steps)
            if steps == _FINE:
                point, iae = search.settle(bounds, point, iae)
            if not math.isfinite(iae):
                return None
            best = search._at(bounds, point[None])
            more = asked.with_failed(bounds, best)
            if more is None and steps == _FINE:
                return best, iae
            asked, steps = more or asked, _FINE

    def _beginning(self, bounds: Bounds, point: FloatArray) -> tuple[FloatArray, float] | None:
        """Return a point that keeps the bounds, if possible near ``point``, and its IAE."""
        iae = float(self._worth(bounds, point[None], math.inf)[0])
        if math.isfinite(iae):
            return point, iae
        found = self._nearby(bounds, point)
        if found is None:
            # Tight bounds may hold far from this point only, so everything is scanned.
            scanned = self.scan(bounds, self._times(point.size > 2))
            found = None if scanned is None else self.least(scanned)
        return found

    def settle(self, bounds: Bounds, point: FloatArray, iae: float) -> tuple[FloatArray, float]:
        """Return the optimum for bounds that also hold between the frequencies of the grid.

        Frequencies at which a bound is exceeded are added to the grid.

        :param bounds: on the sensitivities.
        :param point: as for :meth:`descend`.
        :param iae: there [y s/u].
        :return: with an infinite IAE where none is near.
        """
        for _ in range(_MOST_ADDED):
            best = self._at(bounds, point[None])
            if not best.ki[0] > 0.0:
                return point, math.inf
            controller = self._controller(best)
            exact = Loop(self.rate.of(controller), self.model)
            found = zip(peaks(exact, exact.grid), (bounds.ms, bounds.mt), strict=True)
            missed = [w for (peak, w), bound in found if peak > _HELD * bound]
            if not missed:
                break
            self.responses.add(np.array(missed))
            start = point - np.append([0.02], np.zeros(point.size - 1))
            point, iae = self.descend(bounds, start, math.inf)
        return point, iae

    def _times(self, derivative: bool) -> FloatArray:
        return _TIMES * 2.0 * math.pi / self.frequency if derivative else np.zeros(1)

    def scan(
        self,
        bounds: Bounds,
        times: FloatArray,
        gains: tuple[float, float] = (0.0, math.inf),
        every: int = 1,
    ) -> Candidates | None:
        """Return controllers from the whole stable range that keep the bounds; None: none does.

        :param bounds: on the sensitivities.
        :param times: derivative times [s], shape (n,); one of 0: PI.
        :param gains: least and largest proportional gain to look at.
        :param every: n: every n-th gain and time is looked at.
        """
        derivative = bool(np.any(times))
        count, times = _GAINS[derivative] // every, times[::every]
        parts = []
        for time in times.tolist():
            span = self._span(time)
            if span is None:
                continue
            low, high = span
            if math.isinf(high):
                high = self._largest_kp
            low, high = max(low, high / _DEPTH, gains[0]), min(high, gains[1])
            if low < high:
                kp = np.log(np.geomspace(low, high, count + 2)[1:-1])
                kd = [kp + math.log(time)] if derivative else []
                # Arrays for all times at once would be too large for the cache.
                parts.append(self._at(bounds, np.column_stack((kp, *kd, np.zeros(count)))))
        if not parts:
            return None
        found = Candidates.joined(parts)
        found = found[found.ki > 0.0]
        return found if found.kp.size else None

    def least_ms(self, *, derivative: bool) -> float:
        """Return the least Ms that some controller attains, infinite where none is stable.

        :param derivative: True: PID, False: PI.
        """
        return self._least_bound(Bounds, derivative, _LARGEST_BOUND)

    def least_mt(self, ms: float, *, derivative: bool) -> float:
        """Return the least Mt that some controller attains while it keeps a bound on Ms.

        :param ms: the bound, which some controller keeps.
        :param derivative: True: PID, False: PI.
        """
        # Mt is at most Ms + 1, because T = 1 - S.
        return self._least_bound(partial(Bounds, ms), derivative, ms + 1.0)

    def _least_bound(
        self, bounds: Callable[[float], Bounds], derivative: bool, most: float
    ) -> float:
        low, high = math.log(_LEAST_BOUND - 1.0), math.log(most - 1.0)
        times, gains = self._times(derivative), (0.0, math.inf)
        # A scan of all models takes long, and the bound will be relaxed by more than it misses.
        every, tolerance = (2, _ROUGH_TOLERANCE) if self.models else (1, _EXCESS_TOLERANCE)
        found = self.scan(bounds(1.0 + math.exp(high)), times, gains, every)
        if found is None:
            return math.inf
        while high - low > tolerance:
            middle = 0.5 * (low + high)
            found = self.scan(bounds(1.0 + math.exp(middle)), times, gains, every)
            if found is None:
                low = middle
                continue
            high = middle
            # A tighter bound is attained in a narrower range of gains and times.
            gains = float(found.kp.min()) / _MARGIN, float(found.kp.max()) * _MARGIN
            if derivative:
                ends = found.td.min() / _MARGIN, found.td.max() * _MARGIN
                times = np.geomspace(*ends, _TIMES.size)
        return 1.0 + math.exp(high)

    def least(self, scanned: Candidates) -> tuple[FloatArray, float]:
        """Return the point of the smallest IAE among some controllers, and that IAE.

        The IAE is at least ``1/ki``, so few of them have to be simulated.
        """
        order = np.argsort(-scanned.ki)
        first, rest = order[:_TRIED_AT_ONCE], order[_TRIED_AT_ONCE:]
        iaes = self.iaes(scanned[first])
        best, iae = int(first[np.argmin(iaes)]), float(iaes.min())
        rest = rest[scanned.ki[rest] * iae > 1.0]
        if rest.size:
            iaes = self.iaes(scanned[rest])
            if iaes.min() < iae:
                best, iae = int(rest[np.argmin(iaes)]), float(iaes.min())
        kp, kd = scanned.kp[best], scanned.kd[best]
        return np.log([kp, *([kd] if kd > 0.0 else []), 1.0]), iae

    def descend(
        self, bounds: Bounds, point: FloatArray, iae: float, steps: tuple[float, float] = _WHOLE
    ) -> tuple[FloatArray, float]:
        """Return the optimum near a point, and its IAE.

        :param bounds: on the sensitivities.
        :param point: logarithms of kp, of kd (PID only), and of the share of the largest integral
            gain that is used.
        :param iae: there [y s/u].
        :param steps: the first and the last.
        """
        free, costs = point.size - 1, partial(self._worth, bounds)
        # Each direction costs more with the models around the process.
        count = _DIRECTIONS // 2 if self.models else _DIRECTIONS
        point, iae = pattern_search(costs, point, iae, free, steps, count)
        if self.models and point[-1] == 0.0:
            # A smaller integral gain was not better on the process itself.
            return point, iae
        inward = point + _INWARD[:, [0, *[2] * (free - 1), 1]]
        if costs(inward, iae).min() < iae:
            point, iae = pattern_search(costs, point, iae, free + 1, steps, count)
        if free > 1:
            again = _AGAIN * steps[0], steps[1]
            point, iae = pattern_search(costs, point, iae, free, again, count)
        return point, iae

    def _nearby(self, bounds: Bounds, point: FloatArray) -> tuple[FloatArray, float] | None:
        """Return a start for the search with the models around the process."""
        # Smaller gains: with the same td, then with the same kd.
        factors = np.log(np.geomspace(1.2, 0.02, 12))
        tried = np.repeat(point[None], 24, axis=0)
        tried[:, 0] += np.tile(factors, 2)
        if point.size > 2:
            tried[:12, 1] += factors
        iaes = self._worth(bounds, tried, math.inf)
        best = int(np.argmin(iaes))
        return (tried[best], float(iaes[best])) if math.isfinite(iaes[best]) else None

    def _worth(self, bounds: Bounds, points: FloatArray, iae: float) -> FloatArray:
        """Return the IAE of each point; infinite where it is certainly larger than ``iae``."""
        c = self._at(bounds, points, iae)
        useful = (c.ki > 0.0) & np.isfinite(c.ki)
        useful[useful] &= c.ki[useful] * iae > 1.0
        iaes = np.full(points.shape[0], math.inf)
        if useful.any():
            iaes[useful] = self.iaes(c[useful])
        return iaes

    def _at(self, bounds: Bounds, points: FloatArray, iae: float = math.inf) -> Candidates:
        """Return the controllers of points; ki is -inf where none keeps the bounds.

        :param iae: controllers with a larger IAE are of no interest [y s/u].
        """
        kp = np.exp(points[:, 0])
        td = np.exp(points[:, 1] - points[:, 0]) if points.shape[1] > 2 else np.zeros(kp.size)
        tf = self._filters(kp, td)
        found = Candidates(kp, np.full(kp.size, -math.inf), td, tf)
        usable = np.isfinite(tf)
        if not usable.any():
            return found
        share = np.exp(points[usable, -1])
        upper, lower = self._limits(bounds, found[usable], 1.0 / (share * iae))
        chosen = np.minimum(upper, self._ceiling(kp[usable])) * share
        # Beyond, the integral action alone would close the loop where no frequency was looked at.
        chosen[np.isfinite(chosen) & (chosen > self._beyond)] = -math.inf
        found.ki[usable] = np.where(chosen > _CLEAR * lower, chosen, -math.inf)
        return found

    @cached_property
    def _beyond(self) -> float:
        """Integral gain that closes the loop at the highest frequency of the grid [u/(y s)]."""
        if self.rate.period > 0.0:
            # The grid ends where all frequencies do.
            return math.inf
        highest = float(self.responses.grid[-1])
        return highest / float(np.abs(self.model(1j * highest)))

    def _limits(
        self, bounds: Bounds, c: Candidates, least: FloatArray | float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return the largest integral gains and the least, shape (k,).

        :param least: gains below this are of no interest, shape (k,).
        """
        found = self.responses.largest_ki(bounds, c)
        upper, lower = found[0][:, 0], found[1][:, 0]
        some = upper > least
        if self.around is None or not some.any():
            return upper, lower
        least = np.broadcast_to(least, upper.shape)[some]
        ends = self.around.limits(bounds, c[some], upper[some], least)
        upper, lower = np.where(some, upper, -math.inf), lower.copy()
        upper[some], lower[some] = ends[0], np.maximum(lower[some], ends[1])
        return upper, lower

    def _filters(self, kp: FloatArray, td: FloatArray) -> FloatArray:
        """Return the filter that each controller needs [s], shape (k,); infinite: none will do."""
        found = filters_of(self.rate, td, self.noise / kp, self.filter_ratio)
        # A slower one turns the loop below the frequencies that are looked at.
        return np.where(found * self.responses.grid[0] <= _TURNED, found, math.inf)

    def iaes(self, c: Candidates) -> FloatArray:
        """Return the IAE of a unit step of the load for each controller [y s/u]."""
        h, smoothing = self.rate.period, self.rate.law.smoothing
        p, d, i, tf = (values[:, None] for values in (c.kp, c.kd, c.ki, c.tf))
        if 2.0 * math.pi / self.frequency <= _FAST * h:
            s, process = self._line
            back = np.exp(-s * h)
            law = smoothing.value(tf, h)(back) * (p + i * 0.5 * h * (1.0 + back) / (1.0 - back))
            if np.any(d):
                law = law + d * smoothing.slope(tf, h)(back)
            load = h * process / ((1.0 - back) * (1.0 + law * process))
            y, step = inverted(load, (s.size - 1) * h, sampled=True), np.array(h)
        else:
            reset = c.kp / c.ki
            if self.late.is_stable:
                # With a small gain the response is that of the integral alone.
                reset = reset + 1.0 / (c.ki * abs(self.late.gain))
            duration = (_RESETS * reset + _TURNS * 2.0 * math.pi / self.frequency)[:, None]
            s = abscissae(duration, _POINTS)
            process = self.late.process_sign * self.late(s)
            law = (p + d * s + i / s) / (1.0 + tf * s + 0.5 * (tf * s) ** 2)
            y = inverted(process / (s * (1.0 + law * process)), duration)
            step = duration[:, 0] / _POINTS
        return np.asarray(1.0 / c.ki + 2.0 * step * np.maximum(-y, 0.0).sum(axis=1))

    @cached_property
    def _line(self) -> tuple[ComplexArray, ComplexArray]:
        """Return where sampled responses are transformed, and the process there."""
        h = self.rate.period
        wanted = max(int(_PERIODS * 2.0 * math.pi / (self.frequency * h)), _LEAST_SAMPLES - 1)
        samples = min(1 << wanted.bit_length(), _MOST_SAMPLES)
        s = abscissae(samples * h, samples)
        held = ModelSet((self.model,), h, self.rate.law.delay)
        return s, self.model.process_sign * held(s)[:, 0]
