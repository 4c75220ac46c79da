"""Fits of one running experiment after another look at it, each no more work than it needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

from relay_autotune.analysis import Analysis, model_so_far, prediction_so_far
from relay_autotune.experiment.early_end import MS
from relay_autotune.identification import DEFAULT_METHOD, Identification, Known
from relay_autotune.identification.known import NOTHING
from relay_autotune.record.record import Record
from relay_autotune.tuning import DEFAULT_RULE, DesignOptions

# The structure is chosen anew at the latest when the record has grown by this share.
_CHOSEN_ANEW = 1.1


@dataclass(frozen=True)
class Task:
    """What is asked of the fits.

    :param method: the method whose model counts.
    :param rule: the rule whose gains the predicted Ms is of.
    :param known: what is known of the process beforehand.
    :param options: what is asked of the controller.
    """

    method: str = DEFAULT_METHOD
    rule: str = DEFAULT_RULE
    known: Known = NOTHING
    options: DesignOptions | None = None


class RunningFit:
    """Fit the record of an experiment that still runs, again and again.

    Choosing among all structures takes ten times as long as fitting one. The structure of the
    last choice is fitted first; where its interval alone is wider than what would end the
    experiment, the spread between the structures cannot make it narrower, and the choice waits.
    """

    def __init__(self) -> None:
        self._chosen: Identification | None = None
        self._duration = 0.0

    def fit(self, record: Record, task: Task, sought: str, wanted: float) -> Analysis:
        """Return the model of the record so far, and of Ms where that is sought.

        :param record: of the experiment so far.
        :param task: what is asked.
        :param sought: whose interval ends the experiment, one of
            :data:`~relay_autotune.experiment.early_end.SOUGHT`.
        :param wanted: half its width over the value.
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
