# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Luyben's rules, and the exact gain of a resonance, against the worked cases and a grid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from worked_cases import PROCESSES, cases

from relay_autotune.errors import TuningError
from relay_autotune.loop.analysis import analyse_loop
from relay_autotune.loop.gains import Controller, SeriesForm, series_form
from relay_autotune.process.structures import INTEGRATOR_INVERSE, INTEGRATOR_LAG, IPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.rules.luyben2003 import (
    derivative,
    gain,
    integral_time,
    luyben2003,
    luyben2003_p,
    resonant_gain,
)
from relay_autotune.tuning.task import DesignOptions, DesignTask

DRUM = PROCESSES["Luyben int+inv"]


def task(model: TransferFunction, **asked) -> DesignTask:
    return DesignTask(model=model, options=DesignOptions(**asked))


def product(first: TransferFunction, second: TransferFunction) -> TransferFunction:
    return TransferFunction(
        first.gain * second.gain,
        first.zeros + second.zeros,
        first.time_constants + second.time_constants,
        first.integrators + second.integrators,
        first.dead_time + second.dead_time,
    )


def eq_11(kc: float, ti: float, td: float, alpha: float = 0.1) -> TransferFunction:
    """Return Luyben's controller, with its first-order filter."""
    return TransferFunction(kc / ti, (ti, td), (alpha * td,), 1)


def test_the_integral_time():
    (_, inputs, exact, tol), *_ = cases("luyben.tauI")
    assert inputs["D"] == DRUM.dead_time
    assert integral_time(DRUM, -2.0 * math.pi / 3.0) == pytest.approx(
        exact["tauI_120deg"], rel=tol
    )
    assert integral_time(DRUM, -2.09) == pytest.approx(exact["tauI_2p09rad"], rel=tol)


def test_of_the_two_gains_the_upper_one():
    (_, inputs, exact, tol), *_ = cases("luyben.Kc_PI")
    found = resonant_gain(Controller(1.0, inputs["tauI"]).loop(DRUM), inputs["dB"])
    assert found == pytest.approx(exact["upper"], rel=tol)
    for size in (exact["upper"], exact["lower"]):
        mt = analyse_loop(Controller(size, inputs["tauI"]), DRUM).mt
        assert 20.0 * math.log10(mt) == pytest.approx(inputs["dB"], rel=tol)


TABLE_1 = cases("luyben.T1.ti")


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), TABLE_1, ids=[c[0] for c in TABLE_1])
def test_table_1(name, inputs, exact, tol):
    controller = eq_11(1.0, inputs["tauI"], inputs["tauD"], inputs["alpha"])
    found = resonant_gain(product(controller, DRUM), inputs["dB"])
    assert found == pytest.approx(exact, rel=tol), name


@pytest.mark.long
def test_the_optimum_of_table_1():
    (_, _, exact, tol), *_ = cases("luyben.T1.optimum")
    for share, case in ((0.5, exact["ti11_5"]), (0.25, exact["ti5_75"])):
        ti = share * 23.0

        def size(td: float, ti: float = ti) -> float:
            return resonant_gain(product(eq_11(1.0, ti, td), DRUM), 2.0)

        assert size(case["tauD"]) == pytest.approx(case["Kc"], rel=tol)
        # The second-order filter of the controller costs 1 % of the gain.
        found = derivative(DRUM, share, 23.0, 2.0)
        assert found.td == pytest.approx(case["tauD"], rel=0.02)
        assert 0.985 * case["Kc"] < found.kc < case["Kc"]
        for near in (0.97, 1.03):
            other = SeriesForm(1.0, ti, near * found.td).isa()
            assert resonant_gain(other.loop(DRUM), 2.0) < found.kc


def test_an_integral_time_may_be_too_short_for_the_resonance():
    assert gain(DRUM, 15.0, 2.0) == pytest.approx(0.700, abs=5e-4)
    with pytest.raises(TuningError, match="too short"):
        gain(DRUM, 14.0, 2.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("model", "kind"),
    [
        (DRUM, "pi"),
        (DRUM, "pid"),
        (INTEGRATOR_INVERSE.build((-0.547, 0.418, 1.06, 0.1)), "pi"),
        (IPDT.build((0.5, 2.0)), "pi"),
        (INTEGRATOR_LAG.build((3.0, 2.0, 0.5)), "pi"),
        (INTEGRATOR_LAG.build((-3.0, 2.0, 0.5)), "pid"),
    ],
)
def test_the_loop_has_the_resonance_that_was_asked_for(model, kind):
    found, reason = luyben2003(task(model, controller=kind))
    loop = analyse_loop(found, model)
    assert 20.0 * math.log10(loop.mt) == pytest.approx(2.0, abs=1e-6)
    assert "-120 degrees" in reason
    if kind == "pid":
        assert series_form(found).alpha == pytest.approx(0.1)


def test_angle_and_decibels_are_free():
    asked = {"phase_peak": math.radians(-135.0), "resonance": 4.0}
    found, _ = luyben2003(task(DRUM, **asked))
    assert found.ti < luyben2003(task(DRUM))[0].ti
    w = np.geomspace(1e-3, 10.0, 200_001)
    loop = found.loop(DRUM)
    assert np.degrees(loop.phase(w).max()) == pytest.approx(-135.0, abs=1e-4)
    value = loop(1j * w)
    assert 20.0 * np.log10(np.abs(value / (1.0 + value)).max()) == pytest.approx(4.0, abs=1e-4)


def test_proportional_action_alone_for_an_ordinary_level():
    found, reason = luyben2003_p(task(IPDT.build((-2.0, 3.0))))
    assert (found.ti, found.td) == (0.0, 0.0)
    assert found.kc < 0.0
    w = np.geomspace(1e-3, 3.0, 100_001)
    value = found.loop(IPDT.build((-2.0, 3.0)))(1j * w)
    assert 20.0 * np.log10(np.abs(value / (1.0 + value)).max()) == pytest.approx(2.0, abs=1e-4)
    assert "offset" in reason


@pytest.mark.parametrize(
    ("ti", "model"),
    [
        (4.0, TransferFunction.lag_n(1.0, 1.0, 5, 0.5)),
        (8.0, IPDT.build((0.5, 1.0))),
        (2.0, TransferFunction.oscillator(1.0, 1.0, 0.3, 0.4)),
    ],
)
def test_the_exact_gain_against_a_grid_of_gains(ti, model):
    loop = Controller(1.0, ti).loop(model)
    found = resonant_gain(loop, 3.0)
    w = np.geomspace(1e-3, 30.0, 50_001)
    value = loop(1j * w)

    def peak(k: float) -> float:
        return 20.0 * math.log10(np.abs(k * value / (1.0 + k * value)).max())

    assert peak(found) == pytest.approx(3.0, abs=1e-4)
    assert peak(1.001 * found) > 3.0 > peak(0.999 * found)
