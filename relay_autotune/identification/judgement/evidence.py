# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the checks look at: the record, the selected model, the models it allows, the gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.identification.judgement.difference import Difference
from relay_autotune.identification.result import Identification
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.excitation import changes_within
from relay_autotune.record.record import Record

# Number of time constants within which an unstable process leaves any rest.
MOST_GROWTH = 7.0


@dataclass(frozen=True, eq=False)
class Loop:
    """The gains that are to be judged, as far as checks need them.

    :param controller: -command per measurement at complex frequencies s [u/y].
    :param ms_around: Ms with the processes that the record allows, each a model and what the
        record shows beside it; inf: unstable; empty: they are not known.
    :param asked: Ms that was asked of the gains, or theirs on the model where that is larger.
    :param pace_asked: True: how fast the loop is was asked for.
    """

    controller: Callable[[ComplexArray], ComplexArray]
    ms_around: FloatArray
    asked: float
    pace_asked: bool = False


@dataclass(frozen=True, eq=False)
class Evidence:
    """One experiment with its results.

    :param record: the samples.
    :param found: the selected model, with its uncertainty, its fit and its limit cycle.
    :param difference: what the record shows beside the model; None: it cannot tell.
    :param settled: True if the record has a limit cycle whose last cycles agree.
    :param loop: the gains; None: there are none yet.
    """

    record: Record
    found: Identification
    difference: Difference | None = None
    settled: bool = False
    loop: Loop | None = None

    @property
    def shown(self) -> float:
        """Time for which the fitted samples show answers to the command [s]."""
        time, fitted = self.record.time, self.found.fitted
        if len(fitted) == len(time) and np.isfinite(fitted).any():
            time = time[np.isfinite(fitted)]
        changes = changes_within(self.record.input(), self.record.time)
        begin = np.min(changes, initial=time[-1])
        return float(time[-1] - max(begin, time[0]))

    def growth(self, model: TransferFunction) -> float:
        """Return the longest time of a constant command in time constants of a model's growth.

        :param model: any; 0 where it does not grow by itself.
        """
        growing = [-t.real for t in model.time_constants if t.real < 0.0]
        return self.longest_stay / min(growing) if growing else 0.0

    @cached_property
    def longest_stay(self) -> float:
        """Longest time within the record for which the command stood still [s]."""
        time, changes = self.record.time, self.record.input().times
        inside = changes[(changes > time[0]) & (changes < time[-1])]
        return float(np.max(np.diff(np.concatenate((time[:1], inside, time[-1:])))))
