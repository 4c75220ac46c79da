# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Controllers that a search compares, the noise in their command, and the range of their gains.

Measurement noise in the command, without feedback through the loop, and the filter for it.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.loop.law import LawRate, Smoothing, taps_of
from relay_autotune.loop.sampled import filter_elements
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import Crossing, first_stable
from relay_autotune.tuning.frontier import Bounds, Candidates, Responses

# Grid of filter time constant over sampling period, for interpolation.
_RATIOS = np.geomspace(1e-3, 1e4, 141)
# Time constants of a filter on the derivative alone that are tried, in periods.
_TRIED = np.concatenate(([0.0], np.geomspace(1.05, 1e3, 80)))


@lru_cache(maxsize=8)
def _moments(smoothing: Smoothing) -> tuple[FloatArray, FloatArray]:
    """Return filters in periods, and what each leaves of white noise of variance 1.

    :param smoothing: of the derivative, or of the measurement.
    :return: time constants of the filter, shape (n,); var(yf), cov(yf, h yf') and var(h yf') for
        each, shape (3, n).
    """
    if not smoothing.on_measurement:
        tried = _TRIED if smoothing.adjustable else _TRIED[:1]
        taps = [taps_of(smoothing.slope(tf, 1.0), tf, 1.0) for tf in tried.tolist()]
        return tried, np.array([(1.0, t[0], t @ t) for t in taps]).T
    motion = np.array(filter_elements(_RATIOS, 1.0, np)).T
    turn, past, present = motion[:, :4].reshape(-1, 2, 2), motion[:, 4:6], motion[:, 6:]
    # Scaled to the filter's time constant, both states have one order of magnitude.
    size = np.stack((np.ones(_RATIOS.size), _RATIOS), axis=1)
    turn, past, present = turn * size[:, :, None] / size[:, None, :], past * size, present * size
    # State and next sample are correlated only by the sample before.
    shared = _outer((turn @ present[..., None])[..., 0], past)
    drive = _outer(past, past) + _outer(present, present) + shared + shared.swapaxes(1, 2)
    twice = turn[:, :, None, :, None] * turn[:, None, :, None, :]
    operator = np.eye(4) - twice.reshape(-1, 4, 4)
    covariance = np.linalg.solve(operator, drive.reshape(-1, 4, 1))
    scale = np.stack((size[:, 0], _RATIOS, _RATIOS**2))
    return _RATIOS, covariance[:, [0, 1, 3], 0].T / scale


def _outer(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the outer products of vectors, shape (n, 2, 2)."""
    return np.asarray(left[:, :, None] * right[:, None, :])


def filters_of(
    rate: LawRate, td: FloatArray, largest: FloatArray, filter_ratio: float
) -> FloatArray:
    """Return the filter that each controller needs at a law [s], shape (k,).

    :param rate: the law and its period.
    :param td: derivative times [s], shape (k,).
    :param largest: largest standard deviation of the command per that of the noise, over the
        proportional gain, shape (k,); infinite: no limit.
    :param filter_ratio: largest td/tf.
    :return: infinite: no usable time constant is enough.
    """
    h, smoothing, least = rate.period, rate.law.smoothing, td / filter_ratio
    if smoothing.on_measurement and np.isinf(largest).all():
        return least
    tried, (value, mixed, slope) = _moments(smoothing)
    lead = (td / h)[:, None]
    gains = np.sqrt(value + 2.0 * lead * mixed + lead**2 * slope)
    keeps = gains <= largest[:, None]
    if not smoothing.on_measurement:
        if smoothing.adjustable:
            # A filter as fast as one period is none.
            keeps &= tried * h >= np.where(least > h, least, 0.0)[:, None]
        return np.where(keeps.any(axis=1), tried[keeps.argmax(axis=1)] * h, math.inf)
    # Beyond some time constant the noise gain only falls.
    first = np.where(keeps.any(axis=1), keeps.argmax(axis=1), tried.size)
    inside = np.clip(first, 1, tried.size - 1)
    rows = np.arange(td.size)
    above, below = np.log(gains[rows, inside - 1]), np.log(gains[rows, inside])
    share = np.clip((above - np.log(largest)) / np.maximum(above - below, 1e-300), 0.0, 1.0)
    steps = np.log(tried)
    found = np.exp(steps[inside - 1] + share * (steps[inside] - steps[inside - 1])) * h
    found = np.where(first == 0, 0.0, found)
    return np.maximum(least, np.where(first == tried.size, math.inf, found))


def stable_gains(
    model: TransferFunction, grid: FloatArray, td: float, tf: float
) -> tuple[float, float] | None:
    """Return the first range of proportional gains that keeps ``kp (1 + td s) F G`` stable.

    Each crossing of the negative real axis moves a pair of closed-loop poles to the right where
    the phase falls with frequency, to the left where it rises; the count starts from the process'
    own. Crossings are interpolated on the grid: a range to search in, not a proof.

    :param model: the process.
    :param grid: rad/s, shape (n,), increasing, fine enough to follow the phase.
    :param td: derivative time [s].
    :param tf: time constant of the filter [s].
    :return: lower and upper end, both >= 0, the upper one infinite where no gain is too large;
        None: no gain stabilises the loop.
    """
    filtered = 1.0 + 1j * grid * tf - 0.5 * (grid * tf) ** 2
    phase = model.phase(grid) + np.arctan(grid * td) - np.angle(filtered)
    size = np.log(np.abs(model(1j * grid) * (1.0 + 1j * grid * td) / filtered))
    turns = (phase + math.pi) / (2.0 * math.pi)
    level = np.floor(turns)
    cells = np.flatnonzero(np.diff(level) != 0.0)
    target = np.maximum(level[cells], level[cells + 1])
    change = turns[cells + 1] - turns[cells]
    share = (target - turns[cells]) / change
    gains = np.exp(-(size[cells] + share * (size[cells + 1] - size[cells])))
    moved = np.where(change < 0.0, 2, -2)
    crossings = map(Crossing, gains.tolist(), grid[cells].tolist(), moved.tolist())
    found = first_stable(model, crossings, td - tf)
    if found is None:
        return None
    low, end = found
    return low, math.inf if end is None else end.gain


_SHARE = 0.95
# The first models to be asked are this factor times the number that may exceed a bound.
_FIRST = 3
# Single precision, and a frequency grid that depends on the models asked together, change a limit
# by up to this factor.
_SAME = 1.0 - 1e-5


def allowed_outside(count: int) -> int:
    """Return how many of ``count`` models may exceed a bound."""
    return int((1.0 - _SHARE) * count + 1e-9)


class Surroundings:
    """Models around a process, on all but 5 % of which bounds have to hold.

    :param responses: of the models.
    :param asked: which of them are asked; None: all. The number of models on which the bounds
        may fail is 5 % of all in either case.
    """

    def __init__(self, responses: Responses, asked: IntArray | None = None) -> None:
        self._responses = responses
        # The models that left the smallest range for earlier controllers come first.
        self._order = np.arange(responses.count) if asked is None else asked
        self._outside = allowed_outside(responses.count)

    def hardest(self, bounds: Bounds, c: Candidates) -> Surroundings:
        """Return the few models that leave a controller the smallest range of integral gains.

        :param bounds: on the sensitivities.
        :param c: the controller.
        """
        highs, _ = self._responses.largest_ki(bounds, c.single())
        order = np.argsort(highs[0], kind="stable")
        return Surroundings(self._responses, order[: _FIRST * (self._outside + 1)])

    def with_failed(self, bounds: Bounds, c: Candidates) -> Surroundings | None:
        """Return these models and all others on which a controller fails; None: no others.

        :param bounds: on the sensitivities.
        :param c: the controller.
        """
        if self._order.size == self._responses.count:
            return None
        highs, lows = self._responses.largest_ki(bounds, c.single())
        fails = np.flatnonzero((highs[0] < _SAME * c.ki) | (lows[0] >= c.ki))
        new = np.setdiff1d(fails, self._order)
        if fails.size <= self._outside or not new.size:
            return None
        return Surroundings(self._responses, np.concatenate((new, self._order)))

    def limits(
        self, bounds: Bounds, c: Candidates, upper: FloatArray, least: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the largest integral gains and the least, shape (k,).

        :param bounds: on the sensitivities.
        :param c: the controllers, k of them.
        :param upper: the largest integral gain on the process itself, shape (k,).
        :param least: gains below this are of no interest, shape (k,).
        :return: the largest is -inf if there is none, or none of interest.
        """
        outside = self._outside
        split = _FIRST * (outside + 1)
        first, rest = self._order[:split], self._order[split:]
        c = c.single()
        highs, lows = self._responses.largest_ki(bounds, c, first)
        # The other models can only lower it.
        useful = np.minimum(upper, np.sort(highs, axis=1)[:, outside]) > least
        largest, lowest = np.full(upper.shape, -math.inf), np.zeros(upper.shape)
        if not useful.any():
            return largest, lowest
        highs, lows = highs[useful], lows[useful]
        if rest.size:
            more = self._responses.largest_ki(bounds, c[useful], rest)
            highs, lows = (np.hstack(both) for both in zip((highs, lows), more, strict=True))
            self._order = self._order[np.argsort(highs[0], kind="stable")]
        ends = np.minimum(upper[useful], np.sort(highs, axis=1)[:, outside])
        fails = ((highs < ends[:, None]) | (lows >= ends[:, None])).sum(axis=1)
        largest[useful] = np.where(fails <= outside, ends, -math.inf)
        lowest[useful] = np.sort(lows, axis=1)[:, -1 - outside]
        return largest, lowest
