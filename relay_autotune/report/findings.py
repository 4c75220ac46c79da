# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The words of a report: the verdict, its checks, the numbers, and what remains uncertain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from relay_autotune.record.record import Outcome
from relay_autotune.report.case import Case
from relay_autotune.text import date_text, digits
from relay_autotune.verdict import Finding, Result, Verdict

Tone = Literal["good", "warn", "bad"]

_MARKS: dict[Tone, str] = {"good": "\N{CHECK MARK}", "warn": "!", "bad": "\N{MULTIPLICATION X}"}
_OUTCOMES = {
    Outcome.UNKNOWN: "recorded elsewhere",
    Outcome.COMPLETED: "completed",
    Outcome.ABORTED: "aborted",
    Outcome.FAILED: "failed",
}
_TONES: dict[Result, Tone] = {
    Result.PASSED: "good", Result.DOUBTFUL: "warn", Result.FAILED: "bad",
}  # fmt: skip
_VERDICTS: dict[Verdict, tuple[str, Tone]] = {
    Verdict.TRUSTED: ("gains ready to use", "good"),
    Verdict.DOUBTFUL: ("doubtful gains: read first what to look at", "warn"),
    Verdict.NONE: ("model, but no gains", "bad"),
    Verdict.UNKNOWN: ("not judged", "warn"),
}


@dataclass(frozen=True)
class Chip:
    """The outcome of an experiment in a few words.

    :param text: for people.
    :param tone: how good it is.
    """

    text: str
    tone: Tone


@dataclass(frozen=True)
class Check:
    """One reason to trust a result or not to.

    :param name: what was looked at.
    :param value: what was found.
    :param meaning: what that means.
    :param tone: how good it is.
    """

    name: str
    value: str
    meaning: str
    tone: Tone

    @property
    def mark(self) -> str:
        """A sign that shows the tone without colour."""
        return _MARKS[self.tone]


@dataclass(frozen=True)
class Number:
    """A number of the experiment with its name.

    :param name: what it is.
    :param text: the number with its unit.
    """

    name: str
    text: str


def verdict_of(case: Case) -> Chip:
    """Return the verdict on an experiment.

    :param case: the experiment.
    """
    if case.model is None:
        return Chip("nothing identified", "bad")
    return Chip(*_VERDICTS[case.judgement.verdict])


def facts_of(case: Case, *, with_id: bool) -> tuple[str, ...]:
    """Return where and when the experiment was recorded, and how it ended.

    :param case: the experiment.
    :param with_id: False if the page names its id elsewhere.
    """
    found = [_OUTCOMES[case.outcome]]
    if with_id and case.experiment_id:
        found.append(case.experiment_id)
    if case.start:
        found.append(date_text(case.start))
    length = f"{digits(case.duration)} s"
    if case.samples:
        length += f", {case.samples} samples"
        if case.lost_samples:
            length += f", {case.lost_samples} lost"
    return (*found, length)


def warnings_of(case: Case) -> tuple[str, ...]:
    """Return the sentences that must be read before anything else.

    :param case: the experiment.
    """
    doubtful = case.judgement.verdict is Verdict.DOUBTFUL
    found = [f.said for f in case.judgement.findings if f.sentence] if doubtful else []
    found += case.model.warnings if case.model is not None else ()
    if case.best_gains is not None:
        found += case.best_gains.warnings
    disturbed = [c.index + 1 for c in case.cycles if c.disturbed]
    if disturbed:
        which = ", ".join(map(str, disturbed))
        found.append(f"Cycle {which} was disturbed and is left out of the averages.")
    return tuple(found)


def checks_of(case: Case) -> tuple[Check, ...]:
    """Return the checks of the result.

    :param case: the experiment.
    """
    return tuple(_check(found) for found in case.judgement.findings)


def _check(found: Finding) -> Check:
    unit = f" {found.unit}" if found.unit else ""
    meaning = found.said if found.sentence else f"{found.what[0].upper()}{found.what[1:]}"
    return Check(
        found.title,
        f"{_number(found.value)}{unit}, at most {_number(found.limit)}{unit}",
        f"{meaning}.",
        _TONES[found.result],
    )


def _number(value: float) -> str:
    return f"{value:g}" if math.isinf(value) else digits(value, 3)


def numbers_of(case: Case) -> tuple[Number, ...]:
    """Return the numbers of the limit cycle.

    :param case: the experiment.
    """
    cycle = case.limit_cycle
    if cycle is None:
        return ()
    found = [
        Number("period", f"{digits(cycle.period)} s"),
        Number("high / low", f"{digits(cycle.period_high)} s / {digits(cycle.period_low)} s"),
        Number("measurement", f"{digits(cycle.peak_min)} to {digits(cycle.peak_max)} y"),
        Number("cycles averaged", f"{len(cycle.cycles)}"),
        Number("limit cycle", "settled" if cycle.converged else "still changing"),
    ]
    if case.settings is not None:
        found += [
            Number("relay", f"±{digits(case.settings.amplitude)} u"),
            Number("bias", f"{digits(case.settings.bias)} u"),
            Number("hysteresis", f"±{digits(case.settings.hysteresis)} y"),
        ]
    return tuple(found)


def doubts_of(case: Case) -> tuple[str, ...]:
    """Return what remains uncertain, in sentences.

    :param case: the experiment.
    """
    model = case.model
    if model is None:
        return ()
    found = []
    for estimate in model.estimates:
        if not estimate.determined:
            found.append(
                f"The {estimate.title} is between {digits(estimate.low)} and "
                f"{digits(estimate.high)} {estimate.unit}: more than 20 % to either side."
            )
    if model.rivals:
        share = 100.0 * sum(r.support for r in model.rivals)
        found.append(
            f"Other structures hold {digits(share, 2)} % of the support; they are listed below."
        )
    if not found:
        found.append("Nothing: every parameter is determined, and no other structure is a rival.")
    return tuple(found)
