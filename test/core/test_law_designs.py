# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Gains that are designed for the law that will run them."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.law import LawRate
from relay_autotune.loop.laws import LAWS
from relay_autotune.process.model_set import ModelSet
from relay_autotune.process.structures import INTEGRATOR_LAG, UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning import design, tune
from relay_autotune.tuning.frontier import Bounds, Candidates, Responses
from relay_autotune.tuning.task import DesignOptions, DesignTask

PROCESSES = {
    "fopdt": TransferFunction.fopdt(0.9, 2.0, 0.8),
    "negative": TransferFunction.fopdt(-3.0, 1.0, 4.0),
    "inverse": TransferFunction(1.0, (-0.3,), (1.0, 1.0, 1.0)),
    "integrating": INTEGRATOR_LAG.build((0.3, 0.5, 0.7)),
    "oscillating": TransferFunction.oscillator(1.0, 2.0, 0.5, 0.5),
    "without dead time": TransferFunction(2.0, (), (3.0,)),
}


def asked(law, period, **more):
    return DesignOptions(law=law, sample_period=period, **more)


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "process", "period", "kind"),
    [
        ("pid_controller", "fopdt", 0.05, "pid"),
        ("pid_controller", "fopdt", 1.2, "pi"),
        ("control_toolbox_legacy", "fopdt", 1.2, "pid"),
        ("simple_pid", "negative", 0.7, "pid"),
        ("arduino_pid_v1", "oscillating", 0.3, "pi"),
        ("klipper_heater", "inverse", 0.3, "pid"),
        ("ardupilot_rate", "integrating", 0.2, "pid"),
        ("iec_61131_3_pid", "inverse", 0.4, "pid"),
        ("esphome_pid", "fopdt", 0.1, "pid"),
        ("oscat_ft_pid", "without dead time", 0.5, "pi"),
        ("px4_rate", "without dead time", 0.5, "pi"),
        ("controller_node", "integrating", 0.6, "pid"),
    ],
)
def test_the_bounds_hold_on_the_exact_loop_and_one_is_met(law, process, period, kind):
    model = PROCESSES[process]
    options = asked(law, period, controller=kind)
    gains = tune(model, options=options)
    loop = Loop(LAWS[law].at(gains, period), model)
    assert loop.unstable_poles == 0
    (found, _), mt = loop.margins(), options.largest_mt(model)
    assert gains.ms == pytest.approx(max(found.ms, 1.0))
    assert found.ms < 1.4 * 1.001
    assert found.mt < mt * 1.001
    assert found.ms > 1.4 * 0.995 or found.mt > mt * 0.995
    assert (gains.law, gains.law_period) == (law, period)


@pytest.mark.long
@pytest.mark.parametrize(
    "law", ["pid_controller", pytest.param("marlin_heater", marks=pytest.mark.nightly)]
)
def test_no_other_gains_within_the_bounds_have_a_clearly_smaller_error(law):
    model, period = PROCESSES["fopdt"], 0.2
    gains = tune(model, options=asked(law, period, controller="pid"))
    rng = np.random.default_rng(5)
    tried = 0
    for size in (0.02, 0.1, 0.3):
        for p, i, d in np.exp(size * rng.standard_normal((20, 3))):
            ki = gains.i * i
            kp = gains.kc * p
            other = Controller(kp, kp / ki, gains.td * d, gains.tf)
            loop = Loop(LAWS[law].at(other, period), model)
            found, frequency = loop.margins()
            if loop.unstable_poles or found.ms > 1.4 or found.mt > 1.4:
                continue
            tried += 1
            figures = loop.figures(frequency)
            assert figures.iae_load > 0.985 * gains.iae_load
    assert tried > 10


@pytest.mark.long
def test_a_named_law_matters_at_a_slow_rate():
    """The same gains on another law than theirs miss the bound by far."""
    model, period = PROCESSES["fopdt"], 0.8
    gains = tune(model, options=asked("control_toolbox_legacy", period, controller="pid"))
    other = Loop(LAWS["klipper_heater"].at(gains, period), model).performance()
    assert other.ms > 1.6


@pytest.mark.long
def test_bounds_hold_on_the_models_around_it_too():
    model, period = PROCESSES["fopdt"], 0.4
    rng = np.random.default_rng(3)
    around = tuple(
        TransferFunction.fopdt(0.9 * g, 2.0 * t, 0.8 * d)
        for g, t, d in np.exp(0.15 * rng.standard_normal((40, 3)))
    )
    task = DesignTask(model=model, options=asked("simple_pid", period), models=around)
    gains = design(task, "robust")
    ms = [Loop(LAWS["simple_pid"].at(gains, period), m).ms() for m in around]
    assert sum(value > 1.4 * 1.002 for value in ms) <= 2
    assert gains.ms_95 == pytest.approx(np.sort(ms)[-3], rel=2e-3)
    assert tune(model, options=task.options).i > 1.1 * gains.i


@pytest.mark.nightly
def test_noise_in_the_command_is_limited_as_far_as_the_law_has_a_filter():
    model, period = PROCESSES["fopdt"], 0.05
    noisy = {"noise_std": 0.02, "amplitude": 1.0, "controller": "pid"}
    for law in ("klipper_heater", "simple_pid"):
        gains = tune(model, options=asked(law, period, **noisy))
        assert gains.noise_gain * 0.02 < 0.1 * 1.1
        assert (gains.tf > 0.0) is (law != "simple_pid")
    assert "no filter to set" in " ".join(gains.warnings)
    unstable = UNSTABLE_FOPDT.build((1.0, 1.0, 0.2))
    gains = tune(unstable, options=asked("pid_controller", 0.02, **noisy))
    assert "the noise is not limited" in gains.reason
    assert gains.ms < 1.41


@pytest.mark.long
def test_what_a_law_cannot_do_is_said():
    model = PROCESSES["fopdt"]
    rate = tune(model, options=asked("px4_rate", 0.1, controller="pid"))
    assert rate.td == 0.0
    assert any("px4_rate does worse than a controller with filter" in w for w in rate.warnings)
    (cost,) = tune(model, options=asked("simple_pid", 0.05, controller="pid")).warnings
    assert re.search(r"[\d.]+ times the noise in the command.*; it has no filter to set", cost)
    rule = tune(model, rule="tyreus_luyben", options=asked("px4_rate", 0.1, controller="pid"))
    assert rule.td == 0.0
    assert rule.ms > 1.1 * tune(model, "tyreus_luyben", options=asked("simple_pid", 0.1)).ms
    with pytest.raises(TuningError, match="positive gains only"):
        tune(PROCESSES["negative"], options=asked("marlin_heater", 0.5))
    with pytest.raises(TuningError, match="give sample_period"):
        tune(model, options=DesignOptions(law="simple_pid"))


@pytest.mark.long
def test_our_own_law_by_its_name_is_near_the_continuous_design():
    model = PROCESSES["fopdt"]
    options = asked("controller_node", 0.05, controller="pid")
    exact, before = tune(model, options=options), tune(model, options=replace(options, law=""))
    for name in ("kc", "ti", "td", "tf", "ms", "iae_load", "noise_gain"):
        assert getattr(exact, name) == getattr(before, name)
    assert before.law == ""


def test_every_law_can_be_asked_for():
    for name in LAWS:
        assert asked(name, 0.1).rate == LawRate(LAWS[name], 0.1)


def test_a_pole_that_is_unstable_below_the_grid_leaves_gains():
    """Seen from the grid it is an integrator; its loop begins far left of -1."""
    law, period, kp = LAWS["simple_pid"], 0.2, 2.0
    model = TransferFunction(-2148.0, (), (-22540.0, 0.82), 0, 0.79)
    grid = np.geomspace(0.01, 0.99 * math.pi / period, 3000)
    responses = Responses(ModelSet((model,)), grid, 1.0, LawRate(law, period))
    none = np.zeros(1)
    highs, _ = responses.largest_ki(Bounds(1.8), Candidates(np.array([kp]), none, none, none))
    ki = float(highs[0, 0])
    # The backward integral takes half a sample from the proportional gain.
    gains = Controller(kp - 0.5 * period * ki, (kp - 0.5 * period * ki) / ki)
    assert Loop(law.at(gains, period), model).ms() == pytest.approx(1.8, rel=1e-3)


def test_where_an_inverse_overflows_the_limits_are_right_and_nobody_is_warned():
    model = TransferFunction(1.0, (), (1.0, 0.9, 0.8, 0.7))
    found = []
    for precision in (np.float32, np.float64):
        grid = np.geomspace(1e-9, 1e8, 900).astype(precision)
        kp, tf = np.array([[0.1], [1e6]], precision)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            tried = Candidates(kp, kp, 0.0 * kp, tf)
            highs, _ = Responses(ModelSet((model,)), grid, 1.0).largest_ki(Bounds(1.6), tried)
        found.append(highs[0, 0])
    assert found[0] == pytest.approx(found[1], rel=1e-3)
