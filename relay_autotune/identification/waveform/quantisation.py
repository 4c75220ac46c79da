"""The step of a sensor that reports on a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_MOST = 20_000
# Values on a grid come again: of so many samples each, on average.
_TIMES_EACH = 3.0
_ROUNDED = 1e-3


def quantisation_step(measurement: FloatArray) -> float:
    """Return the step of the grid on which all values lie; 0 if there is none.

    :param measurement: the samples [y], shape (n,).
    """
    some = measurement[:: max(1, measurement.size // _MOST)]
    levels = np.unique(some)
    if levels.size < 2 or _TIMES_EACH * levels.size > some.size:
        return 0.0
    gaps = np.diff(levels)
    # Decimal numbers are on their grid to rounding only.
    rounding = 1e-9 * float(np.abs(levels).max())
    gaps = gaps[gaps > rounding]
    if gaps.size == 0:
        return 0.0
    step = float(gaps.min())
    multiples = gaps / step
    on_grid = np.abs(multiples - np.round(multiples)) <= _ROUNDED + rounding / step
    return step if bool(np.all(on_grid)) else 0.0
