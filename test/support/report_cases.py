# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Experiments for the tests of the report."""

from __future__ import annotations

from dataclasses import replace

import pytest
from analysed import completed

from relay_autotune.record.record import Outcome
from relay_autotune.report import figures, page
from relay_autotune.result import Analysis
from relay_autotune.verdict import Judgement


def only(monkeypatch: pytest.MonkeyPatch, *keys: str) -> None:
    """Limit reports to some of their figures, for tests of something else."""
    chosen = tuple(plate for plate in figures.PLATES if plate.key in keys)
    for module in (figures, page):
        monkeypatch.setattr(module, "PLATES", chosen)


def aborted(reason: str = "the operator pressed the button") -> Analysis:
    """Return an experiment that gave a model and no gains."""
    found = completed()
    record = replace(found.record, outcome=Outcome.ABORTED, reason=reason)
    why = f"the experiment was aborted: no gains. {reason}"
    judgement = replace(found.judgement, refused=why)
    return replace(found, record=record, gains=(), reason=why, judgement=judgement)


def fruitless(reason: str = "found no response to the command") -> Analysis:
    """Return an experiment without a model."""
    return Analysis(completed().record, reason=reason, judgement=Judgement(refused=reason))
