# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Analysed experiments for tests, of the core alone."""

from __future__ import annotations

import functools
import pickle
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
from sampled_relay import simulate_sampled_relay

from relay_autotune.analysis import analyse
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import Identification
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.reasons import NONE
from relay_autotune.record.record import Outcome, Record, RelaySettings
from relay_autotune.result import Analysis
from relay_autotune.verdict import Check, Judgement, Measured, judge

MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)
SETTINGS = RelaySettings(setpoint=50.0, baseline=30.0, amplitude=3.0, bias=0.9, hysteresis=0.1)


def relay_record(
    *, outcome: Outcome = Outcome.COMPLETED, reason: str = "", name: str = "run-1"
) -> Record:
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
        experiment_id=name,
        start=1_790_000_000.0,
    )


_OF_NO_MODEL: dict[str, Any] = {
    "experiment_id": "", "start": 0.0, "outcome": Outcome.COMPLETED, "reason": "", "why": NONE
}  # fmt: skip
_MODELS: dict[bytes, Identification] = {}
_FOUND: dict[bytes, Analysis] = {}


def identified_once(record: Record, *asked: Any) -> Identification:
    """Identify a record, once for all tests.

    :param record: the experiment.
    :param asked: further arguments of `identify`.
    """
    # Whose test it was, when, and how it is said to have ended make no other model.
    key = pickle.dumps((replace(record, **_OF_NO_MODEL), asked))
    if key not in _MODELS:
        _MODELS[key] = identify(record, *asked)
    return _MODELS[key]


def analysed_once(record: Record, *, tell: object = None, **task: Any) -> Analysis:
    """Analyse a record, once for all tests: equal records give equal numbers.

    A record with other rules or options is designed for anew, with the models that were found.

    :param record: the experiment.
    :param tell: not told anything.
    :param task: further arguments of `analyse`.
    """
    key = pickle.dumps((record, sorted(task.items())))
    if key not in _FOUND:
        with patch("relay_autotune.analysis.identify", identified_once):
            _FOUND[key] = analyse(record, **task)
    return _FOUND[key]


def analysed_anew(record: Record, **task: Any) -> Analysis:
    """Analyse a record whatever was found before, and remember its models."""
    with (
        patch(f"{__name__}._MODELS", {}) as models,
        patch("relay_autotune.analysis.identify", identified_once),
    ):
        found = analyse(record, **task)
    _MODELS.update(models)
    return found


@functools.cache
def completed() -> Analysis:
    """Return an experiment that gave a model and gains."""
    return analyse(relay_record(), known=Known(structure="fopdt"))


def swing_check(value: float | None, *, doubtful: float = 1.0, failed: float = 2.0) -> Check:
    """Return a check whose measured number is `value`."""
    measured = None if value is None else Measured(value, "in the cycles")
    return Check(
        name="swing",
        title="Swing",
        what="height of the swing",
        unit="m",
        doubtful=doubtful,
        failed=failed,
        sentence="the swing is {value} m {detail}, more than {limit} m",
        remedy="hold it",
        measure=lambda _: measured,
    )


def doubted() -> Analysis:
    """Return the completed experiment with a check that is doubtful."""
    found = completed()
    judgement = Judgement((*found.judgement.findings, *judge((swing_check(1.5),), None)))
    return replace(found, judgement=judgement)
