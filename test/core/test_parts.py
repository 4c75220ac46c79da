# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Parts of one recording that contradict each other, or do not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from sampled_relay import simulate_sampled_relay

from relay_autotune.analysis import agreed, analyse
from relay_autotune.identification.known import Known
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings
from relay_autotune.result import Analysis
from relay_autotune.verdict import Verdict


@cache
def part(gain: float, seed: int) -> Analysis:
    """Analyse a relay test of gain e^(-10 s)/(20 s + 1)."""
    settings = RelaySettings(
        setpoint=0.0,
        baseline=0.0,
        amplitude=1.0,
        bias=0.3,
        hysteresis=0.1,
        reverse_acting=gain < 0,
    )
    noise = np.random.default_rng(seed).normal(0.0, 0.01, 900)
    model = TransferFunction.fopdt(gain, 20.0, 10.0)
    record = simulate_sampled_relay(model, settings, period=0.25, noise=noise)
    return analyse(record, alone=True, known=Known(structure="fopdt"))


@pytest.fixture
def first() -> Analysis:
    return part(1.65, 1)


@pytest.mark.long
def test_parts_that_agree_stay_as_they_are(first):
    both = (first, part(1.65, 2))
    assert agreed(both) == both
    assert {each.verdict for each in both} == {Verdict.TRUSTED}
    assert agreed(()) == ()


@pytest.mark.nightly
@pytest.mark.parametrize(("gain", "verdict"), [(2.5, Verdict.DOUBTFUL), (-1.65, Verdict.NONE)])
def test_of_parts_that_contradict_each_other_none_is_trusted(first, gain, verdict):
    other = part(gain, 2)
    assert other.verdict is Verdict.TRUSTED
    found = agreed((first, other, first))
    assert {each.verdict for each in found} == {verdict}
    assert {each.best_gains is None for each in found} == {verdict is Verdict.NONE}
    assert "contradict each other: the ultimate gain is" in found[0].judgement.reason
    assert "in part 1 and" in found[0].judgement.reason


@pytest.mark.nightly
def test_a_part_without_gains_contradicts_none(first):
    refused = replace(part(-1.65, 2), gains=())
    assert agreed((first, refused)) == (first, refused)
