# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Uncertainty of K_u and w_u that includes the choice of the structure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from relay_autotune.arrays import FloatArray
from relay_autotune.identification.combinations import point_of
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.result import Identification, Rival

# Largest deviation of a rival's value for which the first order holds: relative to the value, and
# of a dead time or a zero, in radians at the ultimate frequency.
_FARTHEST_RATIO = 2.0
_FARTHEST_PHASE = 1.0


def averaged_point(
    found: Identification, support: float, rivals: Sequence[Rival]
) -> tuple[float, float]:
    """Return the standard deviations of K_u and w_u over all structures with support.

    About the chosen model's value x, with the weights w_m of the structures,

        var = sum_m w_m (var_m + (x_m - x)^2)

    (Buckland, Burnham and Augustin 1997): the variance within each structure, and the distance
    between them.

    :param found: the chosen model.
    :param support: its weight.
    :param rivals: those with a covariance count.
    """
    own = (found.ultimate_gain, found.ultimate_frequency)
    stds = (found.ultimate_gain_std, found.ultimate_frequency_std)
    if not all(math.isfinite(x) for x in (*own, *stds)):
        return stds
    total = support
    sums = [support * std**2 for std in stds]
    for rival in rivals:
        root = rival.estimate.root
        if root is None or not np.all(np.isfinite(root)):
            continue
        point = point_of(rival.model)
        if not math.isfinite(point[0]) or point[0] * own[0] < 0.0:
            continue
        theirs = _within_reach(rival.estimate, root, point[1]).ultimate_std(*point)
        if not all(math.isfinite(s) for s in theirs):
            continue
        total += rival.support
        for k in (0, 1):
            sums[k] += rival.support * (theirs[k] ** 2 + (point[k] - own[k]) ** 2)
    if not total > 0.0:
        return stds
    return math.sqrt(sums[0] / total), math.sqrt(sums[1] / total)


def _within_reach(rival: Estimate, root: FloatArray, frequency: float) -> Estimate:
    """Return an estimate with its covariance limited to where the first order holds.

    A lag or a zero far below the sampling period can hardly be told from dead time. To first
    order its standard deviation may then exceed the whole record, and so would that of K_u, a
    curved function of both. Each value therefore has a prior of covariance L, far wider than that
    of a value that the data show. With it the covariance S becomes
    ``(S^-1 + L^-1)^-1 = L^1/2 U s^2/(1 + s^2) U' L^1/2``, with the singular values s of the root
    of S over that of L.

    :param rival: the estimate.
    :param root: of its covariance.
    :param frequency: w_u [rad/s].
    """
    phase = _FARTHEST_PHASE / frequency
    limits = [
        _FARTHEST_RATIO * abs(value) if parameter.logarithmic else phase
        for parameter, value in zip(rival.structure.parameters, rival.values, strict=True)
    ]
    size = np.maximum(np.array(limits), 1e-12 * phase)
    axes, std, _ = np.linalg.svd(root / size[:, None], full_matrices=False)
    root = size[:, None] * axes * (std / np.sqrt(1.0 + std**2))
    return Estimate.of_root(rival.structure, rival.values, root)
