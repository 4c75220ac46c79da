# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A judged model with all that is needed to design other gains for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from relay_autotune.identification.judgement.evidence import Evidence, Loop
from relay_autotune.identification.judgement.table import LOOP_CHECKS
from relay_autotune.tuning import DesignOptions, DesignTask, Gains
from relay_autotune.tuning.ensemble import ensemble_peaks
from relay_autotune.verdict import NOT_JUDGED, Finding, Judgement, judge


@dataclass(frozen=True)
class Shaping:
    """A model for which gains may be designed, and how these are judged.

    :param task: the process, the models around it, and what was asked of the first gains.
    :param evidence: the experiment and its model; None: the model was not identified.
    :param findings: of the checks of the model.
    """

    task: DesignTask
    evidence: Evidence | None = None
    findings: tuple[Finding, ...] = ()

    def asking(self, options: DesignOptions) -> Shaping:
        """Return the same with other options; those given decide how gains are judged, too.

        :param options: what is asked of the gains.
        """
        task, others = replace(self.task, options=options), self.task.options
        loops = [(each.law, each.sample_period, each.loop_delay) for each in (options, others)]
        if loops[0] == loops[1]:
            # The models around are those of the same loop, and so are their responses.
            task.__dict__.update(around=self.task.around, exact=self.task.exact)
        return replace(self, task=task)

    def judgement(self, gains: Gains) -> Judgement:
        """Return the judgement of an experiment with some gains.

        :param gains: designed for the task, with any set-point weight.
        """
        if self.evidence is None:
            return NOT_JUDGED
        loop = Loop(
            controller=gains,
            ms_of=lambda models: ensemble_peaks(gains, self.task.set_of(models)).ms,
            ms=gains.ms,
            ms_95=gains.ms_95,
            added_delay=self.task.options.added_delay,
        )
        found = judge(LOOP_CHECKS, self.evidence.with_loop(loop))
        return Judgement((*self.findings, *found))
