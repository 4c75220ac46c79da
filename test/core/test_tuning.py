# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Analysis against worked loops; gains that carry what the model does not say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from relay_runs import simulate_relay
from worked_cases import PROCESSES, cases

from relay_autotune.control.controller import simulate_closed_loop
from relay_autotune.errors import TuningError
from relay_autotune.identification.known import Known
from relay_autotune.identification.waveform.method import identify_waveform
from relay_autotune.loop.analysis import analyse_loop, is_stable
from relay_autotune.loop.gains import Controller
from relay_autotune.process.response import response
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import PiecewiseConstant, Record, RelaySettings
from relay_autotune.tuning import design, tune
from relay_autotune.tuning.ensemble import ensemble
from relay_autotune.tuning.of_record import task_of_record
from relay_autotune.tuning.task import DesignOptions, DesignTask


def _controller(name: str, inputs: dict[str, float]) -> Controller:
    td = float(name.split("Td=")[1]) if "Td=" in name else 0.0
    return Controller(inputs["Kc"], inputs["Ti"], td, td / 10.0)


DESIGNS = cases("design.")


@pytest.mark.long
@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), DESIGNS, ids=[d[0] for d in DESIGNS])
def test_worked_loops(name, inputs, exact, tol):
    controller, model = _controller(name, inputs), PROCESSES[inputs["process"]]
    assert is_stable(controller, model) is exact["stable"]
    if not exact["stable"]:
        with pytest.raises(TuningError, match="unstable"):
            analyse_loop(controller, model)
        return
    found = analyse_loop(controller, model)
    assert found.ms == pytest.approx(exact["Ms"], rel=tol)
    assert found.iae_load == pytest.approx(exact["IAE_load"], rel=tol)


def test_forms_convert():
    controller = Controller(2.0, 4.0, 0.5)
    assert (controller.p, controller.i, controller.d) == (2.0, 0.5, 1.0)
    assert Controller(2.0, 0.0).i == 0.0


def test_the_controller_is_what_its_formula_says():
    s = 1j * np.logspace(-2, 2, 20)
    c = Controller(2.0, 4.0, 0.5, 0.05)
    yf = 1.0 / (1.0 + 0.05 * s + (0.05 * s) ** 2 / 2.0)
    np.testing.assert_allclose(
        c.transfer_function()(s), 2.0 * (1.0 + 1.0 / (4.0 * s) + 0.5 * s) * yf, rtol=1e-9
    )


@pytest.mark.parametrize("bad", [(math.nan, 1.0), (math.inf, 1.0), (0.0, 1.0), (1.0, -1.0)])
def test_no_controller_is_made_of_impossible_numbers(bad):
    with pytest.raises(TuningError):
        Controller(*bad)


def _identified(noise: float):
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    relay = RelaySettings(5.0, 40.0, 1.0, 0.3, 0.1)
    run = simulate_relay(model, relay, cycles=4, time=800)
    record = run.record(noise_std=noise, rng=np.random.default_rng(0))
    return identify_waveform(record, Known(structure="fopdt"))


@pytest.mark.long
def test_the_ensemble_of_a_covariance_has_its_spread():
    # A method that gives a covariance alone, as the published ones do.
    found = replace(_identified(0.1), draws=())
    models = ensemble(found, 2000, rng=np.random.default_rng(1))
    dead_times = [m.dead_time for m in models]
    gains = [m.gain for m in models]
    assert np.std(dead_times) == pytest.approx(found.std[2], rel=0.1)
    assert np.std(np.log(gains)) == pytest.approx(found.std[0] / found.values[0], rel=0.1)
    assert models == ensemble(found, 2000, rng=np.random.default_rng(1))


@pytest.mark.long
def test_gains_carry_the_robustness_of_the_uncertain_model():
    sharp, vague = _identified(0.001), _identified(0.15)
    for found in (sharp, vague):
        models = ensemble(found, rng=np.random.default_rng(0))
        gains = tune(found, "thyagarajan", models)
        assert gains.ms_95 >= gains.ms
        assert gains.rule == "thyagarajan"
        if found is sharp:
            assert gains.ms_95 == pytest.approx(gains.ms, rel=0.01)
        else:
            assert gains.ms_95 > 1.02 * gains.ms


@pytest.mark.long
def test_the_parallel_form_has_a_prediction_of_its_own():
    oven = TransferFunction.fopdt(0.62, 110.2, 15.9)
    gains = tune(oven, options=DesignOptions(controller="pid"))
    alone = Controller(gains.kc, gains.ti, gains.td)
    # A derivative by differences acts half a period late, which 0.1 s makes little of.
    run = simulate_closed_loop(alone, oven, period=0.1, duration=300.0, setpoint=1.0)
    assert gains.bare.overshoot == pytest.approx(float(run.measurement.max()) - 1.0, abs=0.005)
    assert gains.bare.overshoot > 2.0 * gains.overshoot
    pi = tune(oven, rule="simc")
    assert (pi.b, pi.tf, pi.bare) == (1.0, 0.0, None)


def test_gains_for_a_model_that_is_hardly_known_are_refused():
    found = _identified(0.05)
    wild = tuple(TransferFunction.fopdt(1.65, 20.0, d) for d in np.linspace(5.0, 60.0, 50))
    with pytest.raises(TuningError, match="too uncertain"):
        tune(found, "thyagarajan", wild)


def test_gains_of_less_than_a_sample_are_told_as_an_integral_controller():
    fast = TransferFunction.fopdt(2.0, 0.01, 0.05)
    gains = design(DesignTask(model=fast, options=DesignOptions(sample_period=0.1)), "robust")
    assert gains.ti < 0.1
    assert f"an integral controller, i = {gains.i:.4g} u/(y s)" in gains.reason
    slow = design(
        DesignTask(model=replace(fast, time_constants=(5.0,)), options=DesignOptions()), "robust"
    )
    assert "integral controller" not in slow.reason


def test_what_moves_slowly_is_no_noise_to_the_design():
    """The drift of a room that a model leaves kept its gains four times too calm."""
    rng, time = np.random.default_rng(3), np.arange(0.0, 1200.0)
    u = PiecewiseConstant(np.array([100.0, 500.0, 900.0]), np.array([1.0, 0.0, 1.0]), 0.0)
    process = TransferFunction.sopdt(2.0, (60.0, 10.0), 5.0)
    slow = np.cumsum(rng.normal(0.0, 0.01, time.size))
    y = response(process, time, u) + slow + rng.normal(0.0, 0.005, time.size)
    record = Record(time=time, measurement=y, command=u(time))
    found = identify_waveform(record)
    task = task_of_record(found, record, DesignOptions(), None)
    assert found.fit.residual_rms > 0.03
    assert task.options.noise_std == pytest.approx(0.008, rel=0.2)
