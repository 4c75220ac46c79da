# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Search for the controller with the smallest IAE over a grid of gains, as an independent check.

Nothing of the search in `relay_autotune.tuning` is used: the bounds are tested loop by loop on a
grid of frequencies, and so is stability, by the number of turns of the loop. Only the integrated
errors come from there; the callers compute those of the best controllers again, accurately.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relay_autotune.loop.gains import Controller
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.tuning.frontier import Candidates
from relay_autotune.tuning.search import Search

FloatArray = NDArray[np.float64]

# Steps of kc, ti and td in the first grid, and in those around its best points.
FIRST = {False: (36, 36), True: (20, 20, 12)}
NEXT = {False: (13, 13), True: (9, 9, 9)}
ROUNDS = 4
_CHUNK = 1500


@dataclass(frozen=True)
class Judge:
    """Whether controllers keep the bounds on a process.

    :param model: the process.
    :param ms: bound on the sensitivity.
    :param mt: bound on the complementary sensitivity.
    :param filter_ratio: td/tf.
    """

    model: TransferFunction
    ms: float
    mt: float
    filter_ratio: float = 10.0

    def keeps(self, kp: FloatArray, ki: FloatArray, td: FloatArray) -> NDArray[np.bool_]:
        """Return which controllers make a stable loop within the bounds, shape (k,)."""
        w = self._grid()
        s = 1j * w
        process = self.model.process_sign * self.model(s)
        kept = np.zeros(kp.size, dtype=bool)
        for begin in range(0, kp.size, _CHUNK):
            part = slice(begin, begin + _CHUNK)
            p, i, d = (x[part, None] for x in (kp, ki, td))
            f = s * d / self.filter_ratio
            loop = (p * (1.0 + d * s) + i / s) / (1.0 + f + 0.5 * f * f) * process
            distance = np.abs(1.0 + loop)
            within = (distance.min(axis=1) >= 1.0 / self.ms) & (
                (np.abs(loop) / distance).max(axis=1) <= self.mt
            )
            # 1 + L times s/(s + 1): no pole at zero, so that the turning of it is finite.
            integrators = 1 + self.model.integrators
            value = (1.0 + loop) * (s / (s + w[0] * 1e3)) ** integrators
            value = np.concatenate((value.real[:, :1] + 0j, value, np.ones((len(value), 1))), 1)
            turns = np.angle(value[:, 1:] / value[:, :-1]).sum(axis=1) / math.pi
            poles = sum(1 for t in self.model.time_constants if t.real < 0.0)
            kept[part] = within & (np.rint(turns) == poles)
        return kept

    def _grid(self) -> FloatArray:
        frequency = _frequency(self.model)
        parts = [np.geomspace(1e-4 * frequency, 3e2 * frequency, 420)]
        if self.model.dead_time > 0.0:
            parts.append(np.arange(0.05, 250.0, 0.17) / self.model.dead_time)
        return np.unique(np.concatenate(parts))


def _frequency(model: TransferFunction) -> float:
    point = ultimate_point(model)
    return point.frequency if point else 1.0 / min(abs(t) for t in model.time_constants)


def best_on_a_grid(
    judge: Judge, near: Controller, iae: float, *, spread: float
) -> Controller | None:
    """Return the best controller on grids over all gains, or None where none may beat ``near``.

    A controller whose integrated error, ``1/ki``, is larger than ``iae`` cannot have a smaller
    absolute one, and is not looked at.

    :param judge: the process and the bounds.
    :param near: the centre of the first grid.
    :param iae: of ``near`` after a unit step of the load [y s/u].
    :param spread: factor up and down to which the first grid reaches.
    """
    model, derivative = judge.model, near.td > 0.0
    centre = np.log([abs(near.kc), near.ti, *([near.td] if derivative else [])])
    reach = np.full(centre.size, math.log(spread))
    counts = FIRST[derivative]
    best: FloatArray | None = None
    least = 1.02 * iae
    for _ in range(ROUNDS):
        axes = [
            c + r * np.linspace(-1.0, 1.0, n)
            for c, r, n in zip(centre, reach, counts, strict=True)
        ]
        points = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=1)
        kp, ti = np.exp(points[:, 0]), np.exp(points[:, 1])
        td = np.exp(points[:, 2]) if derivative else np.zeros(kp.size)
        worth = ti / kp < least
        points, kp, ti, td = points[worth], kp[worth], ti[worth], td[worth]
        kept = judge.keeps(kp, kp / ti, td)
        points, kp, ti, td = points[kept], kp[kept], ti[kept], td[kept]
        if kp.size:
            tf = td / judge.filter_ratio
            iaes = Search(model).iaes(Candidates(kp, kp / ti, td, tf))
            k = int(np.argmin(iaes))
            if iaes[k] < least:
                best, least = points[k], float(iaes[k])
        if best is not None:
            centre = best
        reach = reach * 2.0 / (np.array(counts) - 1) * (1.0 if best is not None else 3.0)
        counts = NEXT[derivative]
    if best is None:
        return None
    kc, ti_best, *rest = np.exp(best).tolist()
    td_best = rest[0] if rest else 0.0
    return Controller(model.process_sign * kc, ti_best, td_best, td_best / judge.filter_ratio)
