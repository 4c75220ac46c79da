# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the user knows of the process before it is identified."""

from __future__ import annotations

import math
from dataclasses import dataclass

from relay_autotune.errors import ParameterError
from relay_autotune.process.structures import TABLE
from relay_autotune.quantities import check, quantity

LOSSES = ("squares", "huber", "tukey")
_MOST_LAGS = 20


@dataclass(frozen=True)
class Known:
    """Facts about the process that a method may need and a record may not tell.

    >>> from relay_autotune import Known
    >>> facts = Known(gain=1.65, structure="fopdt")
    >>> facts.gain, facts.structure
    (1.65, 'fopdt')

    :raises ParameterError: if a value is out of its range, the gain is zero, or the structure has
        another order than the one given.
    """

    gain: float = quantity(math.nan, "y/u", zero=False).means(
        "Static gain of the process, in y/(u s) if it integrates; NaN: to be found, which atv, "
        "and chang with unequal lags, cannot do."
    )
    dead_time: float = quantity(math.nan, "s", lower=0.0).means(
        "Dead time of the process; NaN: to be found."
    )
    structure: str = quantity("", choices=("", *TABLE)).means(
        "Structure of the model; empty: chosen by the method."
    )
    order: int = quantity(0, lower=0, upper=_MOST_LAGS).means(
        "Number of equal lags, for lag_n; 0: to be found."
    )
    loss: str = quantity(LOSSES[0], choices=LOSSES).means(
        "Loss function of the waveform fit; huber and tukey tolerate many outliers."
    )

    def __post_init__(self) -> None:
        check(self, ParameterError)
        row = TABLE.get(self.structure)
        if row and not row.any_order and self.order not in (0, row.order):
            raise ParameterError(
                f"the structure {self.structure} has {row.order} lags, but the order given is "
                f"{self.order}: leave one of the two out"
            )


NOTHING = Known()
