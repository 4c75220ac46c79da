# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A test that ends once it knows enough: when it is looked at, and whether what it says holds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relay_autotune.analysis import RunningFit, Task, analyse, model_so_far
from relay_autotune.experiment.early_end import MS, ULTIMATE_GAIN, EarlyEnd, FitProgress
from relay_autotune.experiment.experiment import RelayExperiment
from relay_autotune.experiment.parameters import ExperimentParameters
from relay_autotune.experiment.phases import Facts
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.process.virtual_process import Disturbances, VirtualProcess
from relay_autotune.record.record import Outcome
from relay_autotune.tuning.task import DesignOptions

PERIOD = 0.03


@dataclass
class Progress:
    """An experiment as far as the early end asks for it."""

    elapsed: float = 10.0
    switches: int = 2
    cycle_count: int = 0
    facts: Facts = field(default_factory=lambda: Facts(sign=1, kicked_at=2.0))


def _known_to(width: float) -> FitProgress:
    return FitProgress(ultimate_gain=-4.0, ultimate_gain_std=4.0 * width / 1.96)


def test_it_is_looked_at_at_switches_from_the_first_half_cycle_on():
    early = EarlyEnd(ULTIMATE_GAIN, 0.02)
    for switches, elapsed, due in (
        (0, 8.0, False),
        (1, 9.0, False),
        (2, 10.0, True),
        # A relay that chatters tells nothing new.
        (3, 10.1, False),
        (4, 10.2, True),
        (5, 12.0, True),
    ):
        running = Progress(switches=switches, elapsed=elapsed)
        assert early.is_due(running) is due
        if due:
            early.look(running)
            assert not early.is_due(running)


@given(width=st.floats(0.0201, 10.0))
def test_between_switches_it_waits_for_an_answer_and_longer_the_wider_the_interval(width):
    early = EarlyEnd(ULTIMATE_GAIN, 0.02)
    early.look(Progress(elapsed=12.0))
    much_later = Progress(elapsed=1000.0)
    assert not early.is_due(much_later)
    assert early.judge(much_later, _known_to(width)) is None
    # Ten seconds after the kick; an interval as T^-3 would be narrow enough no earlier.
    earliest = 10.0 * min(max((width / 0.02) ** (1.0 / 3.0), 1.02), 1.15)
    assert not early.is_due(Progress(elapsed=2.0 + 0.999 * earliest))
    assert early.is_due(Progress(elapsed=2.0 + 1.001 * earliest))


@pytest.mark.parametrize(
    "found",
    [
        FitProgress(),
        FitProgress(ultimate_gain=1.0),
        FitProgress(ultimate_gain=0.0, ultimate_gain_std=0.0),
        FitProgress(ultimate_gain=1.0, ultimate_gain_std=math.inf),
        _known_to(0.0201),
        replace(_known_to(0.0201), ms=1.4, ms_low=1.39, ms_high=1.41),
    ],
)
def test_what_is_not_known_well_enough_ends_nothing(found):
    assert EarlyEnd(ULTIMATE_GAIN, 0.02).judge(Progress(), found) is None


def test_the_reason_names_what_was_sought():
    known = EarlyEnd(ULTIMATE_GAIN, 0.02).judge(Progress(), _known_to(0.0199))
    assert "K_u is within 0.0199 of it" in str(known)
    found = FitProgress(ms=1.4, ms_low=1.386, ms_high=1.414)
    known = EarlyEnd(MS, 0.02).judge(Progress(), found)
    assert "predicted Ms is within 0.01 of it" in str(known)
    assert EarlyEnd(MS, 0.02).judge(Progress(), replace(found, ms_high=math.inf)) is None
    assert EarlyEnd(ULTIMATE_GAIN, 0.02).judge(Progress(), found) is None


def _ended(
    model: TransferFunction, sought: str, wanted: float
) -> tuple[RelayExperiment, FitProgress]:
    """Run a noisy test until it knows enough, as relay_node and identifier_node do together."""
    parameters = ExperimentParameters(amplitude=1.0, process_gain_sign=1, max_cycles=40)
    tune = RelayExperiment(parameters, 0.0, until_converged=False)
    plant = VirtualProcess(model, disturbances=Disturbances(noise_std=0.02), seed=3)
    early, fit = EarlyEnd(sought, wanted), RunningFit()
    found = FitProgress()
    for k in range(20_000):
        plant.command(tune.step(k * PERIOD, plant.measure(k * PERIOD)))
        if tune.finished:
            break
        if early.is_due(tune):
            early.look(tune)
            found = fit.fit(tune.record(), Task(), sought, wanted).finding
            reason = early.judge(tune, found)
            if reason:
                tune.conclude(reason)
                break
    return tune, found


@pytest.mark.nightly
def test_a_test_of_three_lags_ends_early_and_its_interval_is_true():
    # No FOPDT explains this process: the structure has to be chosen on the way.
    model = TransferFunction.lag_n(1.0, 1.0, 3, 0.5)
    tune, found = _ended(model, ULTIMATE_GAIN, 0.02)
    assert tune.outcome is Outcome.COMPLETED
    assert "as narrow as asked" in tune.reason
    # Three cycles that agree take at least these three.
    assert tune.cycle_count < 3
    truth = ultimate_point(model).gain
    # The median of a normal error is a third of this interval; three times it is 1 in 1e8.
    assert abs(found.ultimate_gain / truth - 1.0) < 3.0 * 0.02
    record = tune.record()
    assert analyse(record, alone=True).best_gains is not None


@pytest.mark.nightly
def test_the_predicted_ms_holds_on_the_process():
    model = TransferFunction.fopdt(1.0, 1.0, 0.5)
    tune, found = _ended(model, MS, 0.04)
    assert "predicted Ms is within" in tune.reason
    assert 0.5 * (found.ms_high - found.ms_low) <= 0.04 * found.ms
    gains = analyse(tune.record(), alone=True).best_gains
    options = DesignOptions(sample_period=PERIOD)
    loop = replace(model, dead_time=model.dead_time + options.added_delay)
    true_ms = analyse_loop(gains, loop).ms
    # Twice the interval either way: four standard deviations.
    assert abs(true_ms / found.ms - 1.0) < 2.0 * 0.04


@pytest.mark.nightly
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_quick_fits_never_end_a_test_that_a_choice_would_not(seed):
    model = TransferFunction.lag_n(1.0, 1.0, 2, 0.3)
    noise = 0.05 * np.random.default_rng(seed).standard_normal(2000)
    tune = RelayExperiment(
        ExperimentParameters(amplitude=1.0, process_gain_sign=1), 0.0, until_converged=False
    )
    plant = VirtualProcess(model)
    for k in range(200):
        plant.command(tune.step(k * PERIOD, plant.measure(k * PERIOD) + noise[k]))
    fit = RunningFit()
    first = fit.fit(tune.record(), Task(), ULTIMATE_GAIN, 1e-4)
    for k in range(200, 210):
        plant.command(tune.step(k * PERIOD, plant.measure(k * PERIOD) + noise[k]))
    record = tune.record()
    again = fit.fit(record, Task(), ULTIMATE_GAIN, 1e-4)
    # Nothing is that well known, so that the structure is the one chosen before.
    assert (again.model.structure, again.model.model.order) == (
        first.model.structure,
        first.model.model.order,
    )
    generous = fit.fit(record, Task(), ULTIMATE_GAIN, 10.0)
    assert generous.finding == model_so_far(record).finding
