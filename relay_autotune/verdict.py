# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The judgement of an experiment: one finding for each check, and one verdict from all."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from relay_autotune.errors import ParameterError, look_up
from relay_autotune.quantities import result_field
from relay_autotune.text import digits

if TYPE_CHECKING:
    from relay_autotune.identification.judgement.evidence import Evidence


class Verdict(enum.IntEnum):
    """Whether gains may be used; the values are those of TransferFunction.msg and PidGains.msg.

    TRUSTED: every check passed. DOUBTFUL: there are gains, but check a warning first. NONE: there
    are no gains. UNKNOWN: not judged, as while an experiment runs.
    """

    UNKNOWN = 0
    TRUSTED = 1
    DOUBTFUL = 2
    NONE = 3


class Result(enum.IntEnum):
    """Result of one check; smaller is better."""

    PASSED = 0
    DOUBTFUL = 1
    FAILED = 2


@dataclass(frozen=True)
class Measured:
    """Measurement of a check on one experiment.

    :param value: in the check's unit; NaN: not known, which is doubtful.
    :param detail: further text for the sentence, such as names; it replaces ``{detail}``. Of a
        value that is not known: why.
    :param remedy: what to do; empty: what the check says.
    """

    value: float
    detail: str = ""
    remedy: str = ""


def not_known(why: str, remedy: str = "") -> Measured:
    """Return the measurement of a check that applies, but cannot be made: that is no pass.

    :param why: what is missing, as the end of a sentence.
    :param remedy: what to do; empty: what the check says.
    """
    return Measured(math.nan, why, remedy)


@dataclass(frozen=True)
class Check:
    """One row of the table of checks. A larger number is always worse.

    :param name: name in documents and tests.
    :param title: title for people.
    :param what: the measured quantity, for the guide.
    :param unit: unit of the number; "" for a pure number.
    :param doubtful: the result is doubtful above this number; inf: never.
    :param failed: there are no gains above this number; inf: never.
    :param sentence: text for a result that did not pass; ``{value}``, ``{limit}`` and
        ``{detail}`` are filled in.
    :param remedy: what to do then.
    :param measure: returns the number; None if the check does not apply to the experiment.
    """

    name: str
    title: str
    what: str
    unit: str
    sentence: str
    remedy: str
    measure: Callable[[Evidence], Measured | None]
    doubtful: float = math.inf
    failed: float = math.inf

    def __call__(self, evidence: Evidence) -> Finding | None:
        """Return what the check finds; None if it does not apply.

        :param evidence: the experiment with its results.
        """
        measured = self.measure(evidence)
        if measured is None:
            return None
        value = measured.value
        result = Result.PASSED
        if value > self.doubtful or math.isnan(value):
            result = Result.DOUBTFUL
        if value > self.failed:
            result = Result.FAILED
        limit = self.failed if result is Result.FAILED else min(self.doubtful, self.failed)
        found = Finding(self.name, self.title, self.what, value, self.unit, limit, result)
        if result is Result.PASSED:
            return found
        if math.isnan(value):
            said = f"{self.title} could not be checked: {measured.detail}"
            return replace(found, sentence=said, remedy=measured.remedy or self.remedy)
        number = f"{value:g}" if math.isinf(value) else digits(value, 3)
        said = self.sentence.format(value=number, limit=digits(limit, 3), detail=measured.detail)
        return replace(found, sentence=said, remedy=self.remedy)


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    name: str = result_field()
    """Name of the check."""
    title: str = result_field()
    """Title of the check."""
    what: str = result_field()
    """The measured quantity."""
    value: float = result_field(nan=True, null=math.inf)
    """The measured number; NaN: not computed."""
    unit: str = result_field()
    """Unit of value and limit."""
    limit: float = result_field(nan=True, null=math.inf)
    """Largest value of a check that passes; where it failed, of one that does not fail."""
    result: Result = result_field()
    """Result of the check."""
    sentence: str = result_field("", "")
    """Meaning of a result that did not pass; empty: it passed."""
    remedy: str = result_field("", "")
    """What to do then."""

    @property
    def said(self) -> str:
        """Finding and remedy in one sentence."""
        return f"{self.sentence}: {self.remedy}"


@dataclass(frozen=True)
class Judgement:
    """Findings of all checks, and whether the gains may be used.

    :param findings: findings of the checks that apply, in the order of the table.
    :param refused: why there are no gains, independent of the checks; empty: gains are allowed.
    :param judged: False: no check was made, as while an experiment runs.
    """

    findings: tuple[Finding, ...] = ()
    refused: str = ""
    judged: bool = True

    @property
    def worst(self) -> Finding | None:
        """The first finding with the worst result; None where all passed."""
        found = max(self.findings, key=lambda f: f.result, default=None)
        return None if found is None or found.result is Result.PASSED else found

    @property
    def passed(self) -> str:
        """How many of the checks have passed, such as "15 of 15 checks passed"."""
        count = sum(f.result is Result.PASSED for f in self.findings)
        return f"{count} of {len(self.findings)} checks passed"

    @property
    def contradicted(self) -> bool:
        """Whether the record contradicts the model: a check failed."""
        return any(f.result is Result.FAILED for f in self.findings)

    @property
    def verdict(self) -> Verdict:
        """The verdict from all findings."""
        if not self.judged:
            return Verdict.UNKNOWN
        if self.refused or self.contradicted:
            return Verdict.NONE
        return Verdict.TRUSTED if self.worst is None else Verdict.DOUBTFUL

    @property
    def reason(self) -> str:
        """Why the verdict is not better and what to do, in one sentence; empty: trusted."""
        if self.refused:
            return self.refused
        worst = self.worst
        return "" if worst is None else worst.said


NOT_JUDGED = Judgement(judged=False)


def judge(checks: Sequence[Check], evidence: Evidence) -> tuple[Finding, ...]:
    """Return the findings of the checks that apply.

    :param checks: rows of the table.
    :param evidence: the experiment with its analysis.
    """
    return tuple(found for check in checks if (found := check(evidence)) is not None)


def verdict_named(name: str) -> Verdict:
    """Return the verdict with a name.

    :raises ParameterError: if the name is unknown.
    """
    return look_up({v.name.lower(): v for v in Verdict}, name, "verdict", ParameterError)
