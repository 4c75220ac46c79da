# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Experiments for the tests of the report."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from relay_autotune.analysis import Analysis, analyse
from relay_autotune.identification import Known
from relay_autotune.process.sampled_relay import simulate_sampled_relay
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import Outcome, Record, RelaySettings
from relay_autotune.report import figures, page
from relay_autotune.verdict import Judgement

MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)
SETTINGS = RelaySettings(setpoint=50.0, baseline=30.0, amplitude=3.0, bias=0.9, hysteresis=0.1)


def only(monkeypatch: pytest.MonkeyPatch, *keys: str) -> None:
    """Limit reports to some of their figures, for tests of something else."""
    chosen = tuple(plate for plate in figures.PLATES if plate.key in keys)
    for module in (figures, page):
        monkeypatch.setattr(module, "PLATES", chosen)


def relay_record(*, outcome: Outcome = Outcome.COMPLETED, reason: str = "") -> Record:
    """Record a biased relay on 1.65 e^(-10 s)/(1 + 20 s), with noise."""
    noise = np.random.default_rng(5).normal(0.0, 0.02, 700)
    found = simulate_sampled_relay(MODEL, SETTINGS, period=0.4, noise=noise)
    return Record(
        time=found.time,
        measurement=found.measurement,
        command=found.command,
        settings=SETTINGS,
        noise_std=0.02,
        cycle_start=found.cycle_start,
        outcome=outcome,
        reason=reason,
        experiment_id="run-1",
        start=1_790_000_000.0,
    )


@functools.cache
def completed() -> Analysis:
    """Return an experiment that gave a model and gains."""
    return analyse(relay_record(), known=Known(structure="fopdt"))


def aborted(reason: str = "the operator pressed the button") -> Analysis:
    """Return an experiment that gave a model and no gains."""
    found = completed()
    record = replace(found.record, outcome=Outcome.ABORTED, reason=reason)
    why = f"the experiment was aborted: no gains. {reason}"
    judgement = replace(found.judgement, refused=why)
    return replace(
        found, record=record, gains=(), recommended=None, reason=why, judgement=judgement
    )


def fruitless(reason: str = "found no response to the command") -> Analysis:
    """Return an experiment without a model."""
    return Analysis(
        completed().record, completed().cycles, reason=reason, judgement=Judgement(refused=reason)
    )
