# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The range of integral gains that the models around a process allow."""

from __future__ import annotations

import math

import numpy as np

from relay_autotune.arrays import FloatArray, IntArray
from relay_autotune.tuning.candidates import Candidates
from relay_autotune.tuning.frontier import Bounds, Responses

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
        highs, _ = self._largest_ki(bounds, c)
        order = np.argsort(highs[0], kind="stable")
        return Surroundings(self._responses, order[: _FIRST * (self._outside + 1)])

    def with_failed(self, bounds: Bounds, c: Candidates) -> Surroundings | None:
        """Return these models and all others on which a controller fails; None: no others.

        :param bounds: on the sensitivities.
        :param c: the controller.
        """
        if self._order.size == self._responses.count:
            return None
        highs, lows = self._largest_ki(bounds, c)
        fails = np.flatnonzero((highs[0] < _SAME * c.ki) | (lows[0] >= c.ki))
        new = np.setdiff1d(fails, self._order)
        if fails.size <= self._outside or not new.size:
            return None
        return Surroundings(self._responses, np.concatenate((new, self._order)))

    def _largest_ki(self, bounds: Bounds, c: Candidates) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the range that each of all models leaves, shape (k, m)."""
        kp, td, tf = (x.astype(np.float32) for x in (c.kp, c.td, c.tf))
        return self._responses.largest_ki(bounds, kp, td, tf)

    def limits(
        self,
        bounds: Bounds,
        kp: FloatArray,
        td: FloatArray,
        tf: FloatArray,
        upper: FloatArray,
        least: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the largest integral gains and the least, shape (k,).

        :param bounds: on the sensitivities.
        :param kp: proportional gains, positive, shape (k,).
        :param td: derivative times [s], shape (k,).
        :param tf: time constants of the filter [s], shape (k,).
        :param upper: the largest integral gain on the process itself, shape (k,).
        :param least: gains below this are of no interest, shape (k,).
        :return: the largest is -inf if there is none, or none of interest.
        """
        outside = self._outside
        split = _FIRST * (outside + 1)
        first, rest = self._order[:split], self._order[split:]
        highs, lows = self._responses.largest_ki(bounds, kp, td, tf, first)
        # The other models can only lower it.
        useful = np.minimum(upper, np.sort(highs, axis=1)[:, outside]) > least
        largest, lowest = np.full(upper.shape, -math.inf), np.zeros(upper.shape)
        if not useful.any():
            return largest, lowest
        highs, lows = highs[useful], lows[useful]
        if rest.size:
            few = kp[useful], td[useful], tf[useful]
            more = self._responses.largest_ki(bounds, *few, rest)
            highs, lows = (np.hstack(both) for both in zip((highs, lows), more, strict=True))
            self._order = self._order[np.argsort(highs[0], kind="stable")]
        ends = np.minimum(upper[useful], np.sort(highs, axis=1)[:, outside])
        fails = ((highs < ends[:, None]) | (lows >= ends[:, None])).sum(axis=1)
        largest[useful] = np.where(fails <= outside, ends, -math.inf)
        lowest[useful] = np.sort(lows, axis=1)[:, -1 - outside]
        return largest, lowest
