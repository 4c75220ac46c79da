# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Repeated fits of a running experiment, with as little work as possible."""

from __future__ import annotations

from dataclasses import dataclass, replace

from relay_autotune.analysis import model_so_far, prediction_so_far
from relay_autotune.experiment.early_end import MS
from relay_autotune.identification.known import NOTHING, Known
from relay_autotune.identification.methods import DEFAULT_METHOD
from relay_autotune.identification.result import Identification
from relay_autotune.record.record import Record
from relay_autotune.result import Analysis
from relay_autotune.tuning import DEFAULT_RULE, DesignOptions

# The structure is chosen again at the latest when the record has grown by this factor.
_CHOSEN_ANEW = 1.1


@dataclass(frozen=True)
class Task:
    """How to identify a record and to design a controller for it.

    :param method: the method of the selected model.
    :param rule: the rule whose gains count.
    :param known: known values of the process.
    :param options: design options of the controller; None: the defaults.
    """

    method: str = DEFAULT_METHOD
    rule: str = DEFAULT_RULE
    known: Known = NOTHING
    options: DesignOptions | None = None


class RunningFit:
    """Fit the record of a running experiment repeatedly.

    Choosing among all structures takes ten times as long as fitting one. So the last chosen
    structure is fitted first. If its interval is already too wide to end the experiment, the
    spread between the structures would only widen it, and the choice is skipped.
    """

    def __init__(self) -> None:
        self._chosen: Identification | None = None
        self._duration = 0.0

    def fit(self, record: Record, task: Task, sought: str, wanted: float) -> Analysis:
        """Return the model of the record so far, with the predicted Ms if that is sought.

        :param record: the record so far.
        :param task: settings of the fit.
        :param sought: the quantity whose interval ends the experiment, one of
            :data:`~relay_autotune.experiment.early_end.SOUGHT`.
        :param wanted: half the interval's width over the value.
        :raises RelayAutotuneError: if method or rule are unknown.
        """
        facts = task.known
        chosen = self._chosen
        choosing = task.method == DEFAULT_METHOD and not facts.structure
        if choosing and chosen is not None and record.duration < _CHOSEN_ANEW * self._duration:
            order = chosen.estimate.structure.given_order
            facts = replace(facts, structure=chosen.structure, order=order)
            again = self._analyse(record, task, facts, sought)
            if again.model is not None and not again.finding.width(sought) <= wanted:
                return again
        found = self._analyse(record, task, task.known, sought)
        if choosing:
            self._chosen, self._duration = found.model, record.duration
        return found

    def _analyse(self, record: Record, task: Task, known: Known, sought: str) -> Analysis:
        if sought != MS:
            return model_so_far(record, method=task.method, known=known)
        return prediction_so_far(
            record, method=task.method, rule=task.rule, known=known, options=task.options
        )
