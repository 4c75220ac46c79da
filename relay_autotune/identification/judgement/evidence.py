# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What the checks look at: the record, the selected model, its rivals, the gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from relay_autotune.arrays import ComplexArray, FloatArray
from relay_autotune.errors import ModelError
from relay_autotune.identification.judgement.direction import OtherDirection, other_direction
from relay_autotune.identification.judgement.refits import Part, halves, plain_models
from relay_autotune.identification.judgement.visible import VisibleError, visible_error
from relay_autotune.identification.result import Identification
from relay_autotune.identification.waveform.plausibility import is_unseen
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome, Record

# Number of time constants within which an unstable process leaves any rest.
MOST_GROWTH = 7.0
# Largest residual of a rival relative to the model's, and its least share of the support.
_AS_WELL = 1.1
_WORTH_HEARING = 0.01


@dataclass(frozen=True)
class Loop:
    """The gains that are to be judged, as far as checks need them.

    :param controller: -command per measurement at complex frequencies s [u/y].
    :param ms_of: Ms of the loops that these gains make with models; inf: unstable.
    :param ms: Ms on the selected model.
    :param ms_95: Ms that 95 % of the models within its uncertainty stay below.
    :param added_delay: dead time of the loop beside the process's own [s].
    """

    controller: Callable[[ComplexArray], ComplexArray]
    ms_of: Callable[[Sequence[TransferFunction]], FloatArray]
    ms: float
    ms_95: float
    added_delay: float = 0.0


@dataclass(frozen=True)
class Evidence:
    """One experiment with its results.

    :param record: the samples.
    :param found: the selected model, with its uncertainty, its fit and its limit cycle.
    :param beside: number of parameters that were estimated beside the model, as those of a load.
    :param free: True if the structure was chosen from the data, False if it was given.
    :param samples: True if the model was fitted to the samples themselves.
    :param others: other methods' models of the record, with the quality of their fit.
    :param settled: True if the record has a limit cycle whose last cycles agree.
    :param loop: the gains; None: there are none yet.
    :param driven: the record with the estimated load added to its command; None: no load.
    """

    record: Record
    found: Identification
    beside: int = 0
    free: bool = True
    samples: bool = True
    others: tuple[Identification, ...] = ()
    settled: bool = False
    loop: Loop | None = None
    driven: Record | None = None

    def with_loop(self, loop: Loop) -> Evidence:
        """Return the same experiment with some gains, and what was computed without them.

        :param loop: the gains.
        """
        found = replace(self, loop=loop)
        for name in ("visible", "rivals", "halves", "plain"):
            found.__dict__[name] = getattr(self, name)
        return found

    @cached_property
    def other(self) -> OtherDirection | None:
        """The best model of the opposite direction to the relay's; None: not needed."""
        ended_well = self.record.outcome in (Outcome.COMPLETED, Outcome.UNKNOWN)
        relay = self.record.settings is not None and ended_well
        if not (relay and self.samples and self.free):
            return None
        return other_direction(self.found, self.record, beside=self.beside)

    @cached_property
    def visible(self) -> VisibleError | None:
        """What the record shows of the model's error; None where it cannot tell."""
        try:
            return visible_error(self.found.model, self.record)
        except (ModelError, np.linalg.LinAlgError):
            return None

    @cached_property
    def rivals(self) -> tuple[TransferFunction, ...]:
        """Other models that explain the record nearly as well."""
        most = _AS_WELL * self.found.fit.residual_rms
        models = (
            *(r.model for r in self.found.rivals if r.support > _WORTH_HEARING),
            *(m.model for m in self.others if m.fit.residual_rms <= most),
        )
        interval = self.record.mean_interval
        return tuple(
            m
            for m in models
            if self.growth(m) <= MOST_GROWTH and not is_unseen(m, interval, self.record.duration)
        )

    @cached_property
    def halves(self) -> tuple[Part, ...]:
        """The models that each half of the record allows in the chosen structure; may be empty."""
        if not self.samples:
            return ()
        try:
            return halves(self.found, self.driven or self.record)
        except (ModelError, np.linalg.LinAlgError):
            return ()

    @cached_property
    def plain(self) -> tuple[TransferFunction, ...]:
        """Plain models of the whole record that explain it as well; may be empty."""
        if not self.samples:
            return ()
        try:
            return plain_models(self.found, self.driven or self.record)
        except (ModelError, np.linalg.LinAlgError):
            return ()

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
