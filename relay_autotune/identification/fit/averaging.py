"""Uncertainty that knows that the structure was chosen."""

from __future__ import annotations

import math
from collections.abc import Sequence

from relay_autotune.identification.combinations import point_of
from relay_autotune.identification.result import Identification, Rival, ultimate_std


def averaged_point(
    found: Identification, support: float, rivals: Sequence[Rival]
) -> tuple[float, float]:
    """Return the standard deviations of K_u and w_u over all structures with support.

    About the chosen model's value x, with the weights w_m of the structures,

        var = sum_m w_m (var_m + (x_m - x)^2)

    (Buckland, Burnham and Augustin 1997): what one structure leaves open, and how far they
    differ.

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
        point = point_of(rival.model) if rival.parameters else (math.nan, math.nan)
        if not math.isfinite(point[0]) or point[0] * own[0] < 0.0:
            continue
        theirs = ultimate_std(rival.build, rival.values, rival.covariance, *point)
        if not all(math.isfinite(s) for s in theirs):
            continue
        total += rival.support
        for k in (0, 1):
            sums[k] += rival.support * (theirs[k] ** 2 + (point[k] - own[k]) ** 2)
    if not total > 0.0:
        return stds
    return math.sqrt(sums[0] / total), math.sqrt(sums[1] / total)
