# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Processes that are a model and a response beside it, compared with what they are the sum of."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from relay_autotune.analysis import analyse
from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.judgement.difference import Difference, difference, widened
from relay_autotune.identification.methods import identify
from relay_autotune.identification.result import identified
from relay_autotune.loop.analysis import Loop, analyse_loop
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.laws import LAWS
from relay_autotune.process.model_set import ModelErrors, ModelSet
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import PiecewiseConstant, Record
from relay_autotune.tuning.ensemble import ms_on_each
from relay_autotune.tuning.robust import robust
from relay_autotune.tuning.task import DesignTask

MODEL = TransferFunction.fopdt(1.0, 10.0, 3.0)
TRUTH = TransferFunction.fopdt(1.6, 14.0, 4.0)
STEP = PiecewiseConstant(np.zeros(1), np.ones(1), 0.0)
# So low that they do not vanish within these tests.
LOWEST = 1e-12


def errors(count=1):
    """Return the difference of the two processes, on lags that show it well."""
    lags = np.concatenate((np.linspace(0.0, 30.0, 301), np.geomspace(30.0, 300.0, 200)[1:]))
    beside = response(TRUTH, lags, STEP) - response(MODEL, lags, STEP)
    return ModelErrors(lags, np.tile(np.diff(beside), (count, 1)), LOWEST)


def test_a_model_and_its_error_are_the_process():
    w = np.geomspace(1e-3, 3.0, 50)
    found = ModelSet((MODEL,), errors=errors())(1j * w)[:, 0]
    np.testing.assert_allclose(found, TRUTH(1j * w), atol=2e-3 * TRUTH.gain)


@pytest.mark.parametrize(("period", "delay"), [(0.7, 0), (0.7, 2), (5.0, 1)])
def test_held_errors_have_the_response_of_their_samples(period, delay):
    beside = errors()
    w = np.linspace(0.01, 0.95, 40) * math.pi / period
    # The response to a held step, sample by sample, and its transform.
    samples = np.arange(0.0, 320.0, period)
    rises = np.concatenate(([0.0], np.cumsum(beside.rises[0])))
    steps = np.diff(np.interp(samples, beside.lags, rises), prepend=0.0)
    late = np.exp(-1j * np.outer(w, samples + delay * period))
    found = beside.held(1j * w, period, delay)[:, 0]
    np.testing.assert_allclose(found, late @ steps, atol=1e-6)


def test_what_is_slower_than_the_record_is_left_to_the_model():
    slow = ModelErrors(errors().lags, errors().rises, lowest=1e-3)
    for period in (0.0, 1.0):
        found = ModelSet((MODEL,), period, errors=slow)(np.array([1e-6j]))
        assert abs(found[0, 0]) == pytest.approx(MODEL.gain, rel=1e-2)


@pytest.mark.parametrize("period", [0.0, 0.5])
@pytest.mark.parametrize(("kc", "stable"), [(1.5, True), (6.0, False)])
def test_the_ms_with_an_error_is_that_of_the_process(period, kc, stable):
    gains = Controller(kc, 12.0)
    law = LAWS["pid_controller"].at(gains, period) if period else gains
    (found,) = ms_on_each(law, ModelSet((MODEL,), period, errors=errors()))
    (truth,) = ms_on_each(law, ModelSet((TRUTH,), period))
    assert math.isfinite(truth) == stable
    assert found == pytest.approx(truth, rel=5e-3)


@pytest.mark.long
def test_a_resonance_that_outlasts_the_model_is_shown_beside_it():
    """A fifth of a flexible link's answer was noise, and the gains had an Ms of 35 with it."""
    fast, noise = 0.03, 0.003
    pairs = [
        [complex(damping, side * math.sqrt(1.0 - damping**2)) / w for side in (1.0, -1.0)]
        for w, damping in ((15.5, 0.15), (14.0, 0.15))
    ]
    link = TransferFunction(1.0, tuple(pairs[0]), (fast, *pairs[1]), 0, 0.017)
    time = 0.005 * np.arange(2000)
    command = np.where(time < 0.5, 0.0, np.where(time < 5.0, 1.0, 0.2))
    y = response(link, time, PiecewiseConstant.from_samples(time, command))
    y += noise * np.random.default_rng(0).standard_normal(time.size)
    record = Record(time, y, command)
    found = identify(record)
    assert found.model.response_time < 0.1
    shown = difference(found, record)
    assert shown is not None
    assert shown.residual == pytest.approx(noise, rel=0.4)
    gains = analyse(record).best_gains
    assert gains is not None and analyse_loop(gains, link).ms < 1.4


def test_the_design_holds_on_the_models_with_their_errors():
    around = DesignTask(model=MODEL, models=(MODEL,) * 20, errors=errors(20))
    gains, _ = robust(around)
    assert Loop(gains, TRUTH).ms() == pytest.approx(1.4, rel=0.01)
    # Without them it would not.
    assert Loop(robust(DesignTask(model=MODEL))[0], TRUTH).ms() > 1.8


def test_the_interval_of_the_ultimate_gain_holds_what_is_shown_beside_the_model():
    beside = errors()
    (rises,) = beside.rises
    none = np.zeros((rises.size, 1))
    shown = Difference(beside.lags, rises, none, 0.0, 0.0, LOWEST, none[:, 0], 0.0)
    found = replace(
        identified("waveform", Estimate.of_model(MODEL), 2.0),
        ultimate_gain_std=0.0,
        ultimate_frequency_std=0.0,
    )
    wide, truth = widened(found, shown), ultimate_point(TRUTH)
    assert truth is not None
    gain = abs(math.log(truth.gain / found.ultimate_gain)) * found.ultimate_gain
    assert wide.ultimate_gain_std == pytest.approx(gain, rel=0.01)
    frequency = abs(math.log(truth.frequency / found.ultimate_frequency))
    assert wide.ultimate_frequency_std == pytest.approx(
        frequency * found.ultimate_frequency, rel=0.02
    )
    nothing = replace(shown, mean=np.zeros(rises.size))
    assert widened(found, nothing).ultimate_gain_std < 1e-4 * found.ultimate_gain
