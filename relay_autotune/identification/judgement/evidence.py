# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the checks look at: the record, the selected model, the models it allows, the gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.identification.judgement.difference import Difference
from relay_autotune.identification.result import Identification
from relay_autotune.record.moves import changes_within, left_by_one_sine, longest_stay
from relay_autotune.record.record import Record


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
        begin = time[0] if self.found.moved_before else np.min(changes, initial=time[-1])
        return float(time[-1] - max(begin, time[0]))

    @property
    def left_by_one_sine(self) -> float:
        """What the steady answer to a command of one sine leaves [y]; NaN: there is no such."""
        return left_by_one_sine(self.record.time, self.record.measurement, self.record.input())

    @property
    def growth(self) -> float:
        """Longest time of a constant command in time constants of the model's growth."""
        stay = longest_stay(self.record.time, self.record.input())
        return self.found.model.growth_in(stay)
