"""What the checks look at: the record, the model that counts, its rivals, the gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from relay_autotune.identification.judgement.direction import OtherDirection, other_direction
from relay_autotune.identification.result import Identification
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome, Record

ComplexArray = NDArray[np.complexfloating]


@dataclass(frozen=True)
class Loop:
    """The gains that are to be judged, as far as checks need them.

    :param controller: -command per measurement at complex frequencies s [u/y].
    :param ms_on: Ms of the loop that these gains make with a model; inf: it is unstable.
    :param ms: Ms on the model that counts.
    :param ms_95: Ms that 95 % of the models within its uncertainty stay below.
    """

    controller: Callable[[ComplexArray], ComplexArray]
    ms_on: Callable[[TransferFunction], float]
    ms: float
    ms_95: float


@dataclass(frozen=True)
class Evidence:
    """One experiment with what was made of it.

    :param record: the samples.
    :param found: the model that counts, with its uncertainty, its fit and its limit cycle.
    :param beside: number of parameters that were estimated beside the model, as those of a load.
    :param free: True if the structure was chosen from the data, False if it was given.
    :param samples: True if the model was fitted to the samples themselves.
    :param loop: the gains; None: there are none yet.
    """

    record: Record
    found: Identification
    beside: int = 0
    free: bool = True
    samples: bool = True
    loop: Loop | None = None

    @cached_property
    def other(self) -> OtherDirection | None:
        """The best model of the other direction than the relay's; None: it is not asked for."""
        ended_well = self.record.outcome in (Outcome.COMPLETED, Outcome.UNKNOWN)
        relay = self.record.settings is not None and ended_well
        if not (relay and self.samples and self.free):
            return None
        return other_direction(self.found, self.record, beside=self.beside)
