# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

r"""The largest integral gain that bounds on Ms and Mt allow, in closed form.

With a filter F, ``L = (kp (1 + td s) + ki/s) F G``. At a sampling period h the integral of any law
is, on the unit circle with ``w' = (2/h) tan(w h/2)``,

    I = 1/(j w') + lead h/2,   lead 1 if it is advanced before the output, -1 after it,

so that with ``kp' = kp + lead ki h/2``, ``td' = kp td/kp'``, the filter V and the derivative S the
loop is ``(kp' (1 + td' S/V) + ki/(j w')) V G``: the same form, exact at the sampling period. In
what follows kp, td and w are kp', td' and w' then. A bound on the sensitivity keeps L(jw) out of
a circle around -1, one on the complementary sensitivity out of a circle around a point further
left (Astrom and Hagglund 1998): ``|L + c| >= r`` with

    Ms: c = 1, r = 1/Ms;    Mt: c = Mt^2/(Mt^2 - 1), r = Mt/(Mt^2 - 1).

Divided by FG, with ``1/(F G) = x + j y``, this forbids at each frequency the inside of an ellipse
in the plane of kp and ki,

    (kp + c x)^2 + (kp w td + c y - ki/w)^2 < r^2 (x^2 + y^2).

(in general kp td w is the imaginary part of kp (1 + td S/V), and kp its real part). So for given
kp, td and tf every frequency forbids the integral gains between

    w (kp w td + c y -+ sqrt(r^2 (x^2 + y^2) - (kp + c x)^2)),

where the root is real. A loop that is stable without integral action stays stable up to the
least ``ki = w (kp w td + y)`` at a frequency with ``kp + x = 0``, where it reaches -1. The result
is the largest integral gain below that limit which no frequency forbids. The allowed range need
not begin at zero: with derivative action a bound may need some integral gain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.arrays import ComplexArray, FloatArray, IntArray
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate, polynomial
from relay_autotune.loop.laws import CONTINUOUS
from relay_autotune.process.model_set import ModelSet
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import unstable_at_small_gain

_ALL = slice(None)

# Beyond this multiple of the crossover the integral action adds little to the loop.
_BEYOND = 3.0
# A gap whose lower end is above this part of its upper end is ignored.
_NARROW = 0.9
# Part of kp within which a loop is near -1.
_NEAR = 0.3
# Added frequencies stay below half the sampling frequency by this factor.
_NEAR_END = 0.99
_NEIGHBOURS = np.array([0.995, 1.0, 1.005])


@dataclass(frozen=True)
class Bounds:
    """Largest magnitudes of sensitivity and complementary sensitivity that are allowed.

    :param ms: above 1.
    :param mt: above 1; infinite: no bound.
    """

    ms: float
    mt: float = math.inf

    @property
    def circles(self) -> tuple[tuple[float, float], ...]:
        """Centres -c and radii r of the circles that the loop must not enter, as (c, r)."""
        sensitivity = (1.0, 1.0 / self.ms)
        if math.isinf(self.mt):
            return (sensitivity,)
        square = self.mt**2
        return (sensitivity, (square / (square - 1.0), self.mt / (square - 1.0)))


@dataclass(frozen=True)
class Candidates:
    """Controllers to compare, with positive gains whatever the sign of the process.

    :param kp: proportional gains, shape (k,).
    :param ki: integral gains, shape (k,).
    :param td: derivative times [s], shape (k,).
    :param tf: time constants of the filter [s], shape (k,).
    """

    kp: FloatArray
    ki: FloatArray
    td: FloatArray
    tf: FloatArray

    @property
    def kd(self) -> FloatArray:
        """Derivative gains, shape (k,)."""
        return self.kp * self.td

    def single(self) -> Candidates:
        """Return them in single precision."""
        return Candidates(*(x.astype(np.float32) for x in (self.kp, self.ki, self.td, self.tf)))

    @classmethod
    def joined(cls, parts: Sequence[Candidates]) -> Candidates:
        """Return all of them, one after the other."""
        fields = zip(*((c.kp, c.ki, c.td, c.tf) for c in parts), strict=True)
        return cls(*(np.concatenate(field) for field in fields))

    def __getitem__(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Candidates:
        return Candidates(self.kp[index], self.ki[index], self.td[index], self.tf[index])

    def controller(self, k: int, sign: int, rate: LawRate) -> Controller:
        """Return controller k with the sign of the process.

        :param rate: the law, of which kp and td hold what its integral adds in half a sample.
        """
        ki, kd = float(self.ki[k]), float(self.kd[k])
        kp = float(self.kp[k]) - rate.law.integral.lead * 0.5 * rate.period * ki
        tf = rate.law.smoothing.setting(float(self.tf[k]), rate.period)
        return Controller(sign * kp, kp / ki, kd / kp, tf)


class Responses:
    """Frequency responses of models on one grid, with the sign that makes feedback negative.

    :param models: m of them, all with the sign of the first.
    :param grid: rad/s, shape (n,), increasing, up to half the sampling frequency; its
        floating-point type is used throughout.
    :param crossover: frequency about which loops are closed [rad/s].
    :param rate: the law and its sampling period.
    """

    def __init__(
        self,
        models: ModelSet,
        grid: FloatArray,
        crossover: float,
        rate: LawRate = CONTINUOUS,
    ) -> None:
        self._set = models.sampled(rate.period, rate.law.delay)
        self._sign, self._rate = models.models[0].process_sign, rate
        self.count = len(models)
        self.crossover = crossover
        self._keep(grid, self._evaluate(grid))
        self._poles = np.array([unstable_at_small_gain(m) for m in models.models])
        # The loops of these models reach -1 at w = 0 as the gain grows.
        self._at_rest = np.array(
            [m.integrators == 0 and m.gain * m.process_sign < 0.0 for m in models.models]
        )

    def _evaluate(self, grid: FloatArray) -> ComplexArray:
        through = self._set(1j * grid.astype(np.float64)).T
        values = np.full(through.shape, complex(math.inf, 0.0))
        np.divide(self._sign, through, out=values, where=through != 0.0)
        return np.ascontiguousarray(values.astype(np.result_type(grid, np.complex64)))

    def _keep(self, grid: FloatArray, inverse: ComplexArray) -> None:
        self.grid, self.inverse = grid, inverse
        self._smallest = np.abs(inverse).min(axis=0)
        h = self._rate.period
        if h > 0.0:
            angle = grid.astype(np.float64) * h
            self._back = np.exp(-1j * angle)
            self._warped = (2.0 / h * np.tan(0.5 * angle)).astype(grid.dtype)

    def add(self, frequencies: FloatArray) -> None:
        """Add frequencies to the grid, with neighbours on either side.

        :param frequencies: rad/s, shape (k,).
        """
        near = np.unique(frequencies[:, None] * _NEIGHBOURS)
        if self._rate.period > 0.0:
            near = np.unique(np.minimum(near, _NEAR_END * math.pi / self._rate.period))
        near = near[~np.isin(near, self.grid)]
        grid = np.concatenate((self.grid, near))
        order = np.argsort(grid)
        inverse = np.concatenate((self.inverse, self._evaluate(near)), axis=1)
        self._keep(grid[order], inverse[:, order])

    # Where next to nothing passes, inverses overflow, and only endless gains are forbidden.
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def largest_ki(
        self,
        bounds: Bounds,
        c: Candidates,
        of: IntArray | slice = _ALL,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the largest integral gains that the bounds leave, and how far they may fall.

        :param bounds: on the sensitivities.
        :param c: controllers with kp' and td', k of them, of which ki is not used.
        :param of: which models, m of them.
        :return: upper and lower ends of the range, shape (k, m), for the controllers in each
            model; an upper end not positive: none is allowed; infinite: any above the lower.
        """
        if not c.kp.size:
            # No filter keeps the limit of the noise.
            return (np.empty((0, self._poles[of].size)),) * 2
        column = self._relevant(bounds, c)
        w, own, unfiltered = self._law(c, column)
        inverse = self.inverse[of][None, :, column]
        if unfiltered is not None:
            inverse = unfiltered[:, None, :] * inverse
        # Arithmetic on the parts is faster where they lie together.
        x, y = np.ascontiguousarray(inverse.real), np.ascontiguousarray(inverse.imag)
        base, lead = own
        reach = base + x
        count = self._poles[of] + _gained((base, lead), (x, y), sampled=self._rate.period > 0.0)
        # A loop that begins left of -1 has a real pole there, which moves with the phase.
        turns = np.sign(lead[..., 0] * x[..., 0] - base[..., 0] * y[..., 0])
        count = count + np.where(self._at_rest[of] & (reach[..., 0] > 0.0), turns, 0.0)
        crossing = first_crossing(reach, w * (lead + y), c.kp)
        return envelope(bounds, own, w, (x, y), np.where(count == 0, crossing, 0.0))

    def _law(
        self, c: Candidates, column: NDArray[np.bool_]
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray], ComplexArray | None]:
        """Return what the law does at some frequencies.

        :return: w', shape (n,); real and imaginary part of kp' (1 + td' S/V), shape (k, 1, n or
            1); 1/V, shape (k, n), None: there is no filter.
        """
        h, smoothing = self._rate.period, self._rate.law.smoothing
        gain, lead, dtype = c.kp[:, None, None], c.kd[:, None, None], self.inverse.dtype
        filtered = bool(np.any(c.tf))
        if h == 0.0:
            w = self.grid[column]
            s = 1j * w * c.tf[:, None]
            return w, (gain, lead * w), 1.0 + s + 0.5 * s * s if filtered else None
        w, back, time = self._warped[column], self._back[column], c.tf[:, None]
        slope = smoothing.slope(time, h)
        if not (filtered and smoothing.on_measurement):
            values = np.atleast_2d(slope(back)) if np.any(c.td) else np.zeros((1, w.size), dtype)
            unfiltered = None
        else:
            # Value and slope of one filter have their denominator in common.
            value = smoothing.value(time, h)
            above = polynomial(value.top, back)
            values = polynomial(slope.top, back) / above
            unfiltered = (polynomial(value.bottom, back) / above).astype(dtype)
        values = values.astype(dtype)[:, None, :]
        return w, (gain + lead * values.real, lead * values.imag), unfiltered

    def _relevant(self, bounds: Bounds, c: Candidates) -> NDArray[np.bool_]:
        """Return the frequencies at which some loop is large enough to meet a bound.

        Beyond the crossover the integral adds little to the loop.
        """
        w = self.grid
        largest = np.sqrt((c.kp[:, None] ** 2 + (c.kd[:, None] * w) ** 2).max(axis=0))
        smallest = self._smallest
        if self._rate.period == 0.0:
            smallest = smallest * np.sqrt(1.0 + 0.25 * (w * c.tf.min()) ** 4)
        room = min(centre - r for centre, r in bounds.circles)
        found = (w < _BEYOND * self.crossover) | (2.0 * largest > room * smallest)
        # The end of the circle, where a loop has a real pole.
        found[-1] |= self._rate.period > 0.0
        return np.asarray(found)


def _gained(
    own: tuple[FloatArray, FloatArray], parts: tuple[FloatArray, FloatArray], *, sampled: bool
) -> FloatArray:
    """Return how many unstable poles come as the loops' gain grows to 1, shape (k, m).

    A pair for each crossing of the negative real axis left of -1 with falling phase, one pair less
    with rising phase, and of sampled loops one pole where a loop ends left of -1 at half the
    sampling frequency.

    :param own: real and imaginary part of the law over its filter, shape (k, 1, n or 1).
    :param parts: real and imaginary part of 1/(V G), shape (k or 1, m, n).
    :param sampled: whether the grid ends at half the sampling frequency.
    """
    (base, lead), (x, y) = own, parts
    # Whether Im L > 0.
    above = (lead / base * x > y) != (base < 0.0)
    flat = np.flatnonzero(above[..., :-1] != above[..., 1:])
    which, n = np.divmod(flat, above.shape[-1] - 1)
    k, m = np.divmod(which, above.shape[1])

    def loop(at: IntArray) -> ComplexArray:
        """Return L at the ends of the cells with a crossing."""
        p, q, u, v = (np.broadcast_to(part, above.shape)[k, m, at] for part in (base, lead, x, y))
        return np.asarray((p + 1j * q) / (u + 1j * v))

    before, after = loop(n), loop(n + 1)
    share = before.imag / (before.imag - after.imag)
    left = before.real + share * (after.real - before.real) < -1.0
    turned = np.where(left, np.where(after.imag > 0.0, 2.0, -2.0), 0.0)
    size = above.shape[0] * above.shape[1]
    found = np.bincount(which, turned, size).astype(float).reshape(above.shape[:-1])
    if sampled:
        p, q, u, v = base[..., -1], lead[..., -1], x[..., -1], y[..., -1]
        ends_left = p * u + q * v < -(u * u + v * v)
        found -= np.where(ends_left, np.sign(q * u - p * v), 0.0)
    return found


def envelope(
    bounds: Bounds,
    rest: tuple[FloatArray, FloatArray],
    w: FloatArray,
    parts: tuple[FloatArray, FloatArray],
    stable: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the envelope of the ellipses: upper and lower ends of the range, shape (k, m).

    :param bounds: on the sensitivities.
    :param rest: real and imaginary part of the controller without integral and filter, such as
        kp and kp td w, shape (k, 1, n or 1).
    :param w: frequencies at which the integral action is ki/(j w), shape (n,).
    :param parts: real and imaginary part of 1/(F G), shape (k or 1, m, n).
    :param stable: integral gains up to which the loop is stable, shape (k, m).
    """
    x, y = parts
    p, lead = rest
    square = x * x + y * y
    rooms = [r * r * square - (p + c * x) ** 2 for c, r in bounds.circles]
    edges = []
    for (c, _), room in zip(bounds.circles, rooms, strict=True):
        room = np.where(np.isfinite(room), room, 0.0)
        root = w * np.sqrt(np.maximum(room, 0.0))
        middle = w * (lead + c * y)
        low, high = middle - root, middle + root
        # An ellipse below ki = 0, or where no loop is stable, does not matter.
        forbids = (room > 0.0) & (high > 0.0) & (low < stable[..., None])
        column = np.asarray(forbids.any(axis=(0, 1)))
        # The neighbours show where the envelope bends.
        column[1:] |= column[:-1].copy()
        column[:-1] |= column[1:].copy()
        forbids = forbids[..., column]
        edges.append(
            (
                np.log(w[column]),
                np.where(forbids, low[..., column], math.inf),
                np.where(forbids, high[..., column], -math.inf),
            )
        )
    limit, below = _highest_gap(edges, stable)
    # Between the frequencies the envelope is a little lower.
    refined = limit
    for log_w, low, _ in edges:
        if log_w.size > 2:
            above = np.where(low > 0.5 * (below + limit)[..., None], low, math.inf)
            refined = np.minimum(refined, _least(above, log_w))
    return np.where(limit > 0.0, refined, limit), below


def first_crossing(distance: FloatArray, ki: FloatArray, kp: FloatArray) -> FloatArray:
    """Return the least positive integral gain at which a closed-loop pole is on the axis.

    :param distance: kp + x, zero where some ki brings the loop to -1, shape (k, m, n).
    :param ki: which one that would be, shape (k, m, n).
    :param kp: proportional gains, shape (k,).
    :return: shape (k, m); infinite: none.
    """
    before, after = distance[..., :-1], distance[..., 1:]
    crosses = (before > 0.0) != (after > 0.0)
    share = before / (before - after)
    at = ki[..., :-1] + share * (ki[..., 1:] - ki[..., :-1])
    # Within one cell of the marginal proportional gain the sign of ki is not known.
    near = np.maximum(np.abs(before), np.abs(after)) < _NEAR * kp[:, None, None]
    marginal = crosses & near & ((ki[..., :-1] > 0.0) != (ki[..., 1:] > 0.0))
    at = np.where(marginal, 0.0, at)
    found = np.where(crosses & ((at > 0.0) | marginal), at, math.inf)
    # A grid of one frequency, below which a sampled loop has no other, gives no limit.
    return np.asarray(found.min(axis=-1, initial=math.inf))


def _highest_gap(
    edges: list[tuple[FloatArray, FloatArray, FloatArray]], start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the highest gap below ``start`` that no interval reaches into.

    Narrow gaps are ignored: they are caused by the distance between frequencies.

    :param edges: abscissae, lower and upper ends of intervals, the ends of shape (k, m, n).
    :param start: shape (k, m); infinite: above all intervals.
    :return: upper and lower ends, shape (k, m); an upper one not positive: there is none.
    """
    value, ends = start.copy(), np.zeros(start.shape)
    active = np.ones(start.shape, dtype=bool)
    while True:
        # Only those that moved are looked at again.
        at, here = value[active], [(low[active], high[active]) for _, low, high in edges]
        lower, below = at, np.zeros(at.shape)
        for low, high in here:
            under = low < at[:, None]
            inside = under & (high >= at[:, None])
            found = np.where(inside, low, math.inf).min(axis=-1, initial=math.inf)
            lower = np.minimum(lower, found)
            below = np.maximum(below, np.where(under, high, 0.0).max(axis=-1, initial=0.0))
        ends[active] = below
        covered = lower < at
        narrow = ~covered & (below > _NARROW * at)
        moved = (covered | narrow) & (at > 0.0)
        if not np.any(moved):
            return value, ends
        value[active] = np.where(moved, np.where(narrow, below, lower), at)
        active[active] = moved


def _least(values: FloatArray, x: FloatArray) -> FloatArray:
    """Return the least value along the last axis, of the parabola through it and its neighbours.

    :param values: shape (k, m, n).
    :param x: abscissae, shape (n,), increasing.
    """
    i = np.clip(np.argmin(values, axis=-1), 1, x.size - 2)
    a, b, c = (np.take_along_axis(values, (i + d)[..., None], -1)[..., 0] for d in (-1, 0, 1))
    least = np.minimum(np.minimum(a, b), c)
    left, right = x[i] - x[i - 1], x[i + 1] - x[i]
    slope_left, slope_right = (b - a) / left, (c - b) / right
    curvature = (slope_right - slope_left) / (left + right)
    slope = slope_left + curvature * left
    bottom = b - 0.25 * slope**2 / curvature
    inside = (slope_left < 0.0) & (slope_right > 0.0) & np.isfinite(bottom)
    return np.where(inside, np.minimum(bottom, least), least)


def design_grid(model: TransferFunction, frequency: float, period: float = 0.0) -> FloatArray:
    """Return the frequencies at which bounds are tested [rad/s].

    :param model: the process.
    :param frequency: about which the loop is closed [rad/s].
    :param period: of the samples, to half whose frequency the grid goes [s]; 0: continuous.
    """
    parts = [
        frequency * np.geomspace(low, high, count)
        for low, high, count in ((1e-3, 0.1, 70), (0.1, 10.0, 220), (10.0, 100.0, 60))
    ]
    if model.dead_time > 0.0:
        # With derivative action a lag of first order lets every turn pass alike, up to the filter.
        flat = len(model.time_constants) + model.integrators - len(model.zeros) <= 1
        turns = np.arange(0.1, (24.0 if flat else 8.0) * math.pi, 0.2) / model.dead_time
        parts.append(turns[turns < 300.0 * frequency])
    for c in (*model.zeros, *model.time_constants):
        if c.imag > 0.0 and abs(c.real) < 0.5 * abs(c):
            width = abs(c.real) / abs(c)
            around = (1.0 + width * np.linspace(-6.0, 6.0, 49)) / abs(c)
            parts.append(around[around > 0.0])
    if period == 0.0:
        return np.unique(np.concatenate(parts))
    top = math.pi / period
    parts.append(top * (1.0 - np.geomspace(1e-6, 0.5, 60)))
    if top > 100.0 * frequency:
        parts.append(np.geomspace(100.0 * frequency, top, 60)[:-1])
    found = np.unique(np.concatenate(parts))
    return found[(found < top) & (found >= 1e-3 * frequency)]
