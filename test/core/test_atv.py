# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The original ATV against worked cases and the describing function itself."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from relay_runs import simulate_relay
from sampled_relay import exact_limit_cycle
from worked_cases import cases

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.methods import identify
from relay_autotune.identification.methods.chang import (
    atv_from_numbers,
    identify_atv,
    ultimate_estimate,
)
from relay_autotune.identification.methods.lags import (
    FIRST,
    equal,
    solutions,
    with_amplitude,
)
from relay_autotune.process.structures import SOPDT, TWO_EQUAL_ONE, equal_lags
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings

LAGS = [
    (equal_lags(1), (3.0,)),
    (equal_lags(2), (3.0,)),
    (equal_lags(3), (3.0,)),
    (equal_lags(5), (3.0,)),
    (SOPDT, (3.0, 1.0)),
    (TWO_EQUAL_ONE, (1.0, 5.0)),
    (TWO_EQUAL_ONE, (10.0, 3.0)),
]


def test_equation_13():
    ((_, inputs, exact, tol),) = cases("chang.ex1.tau_eq13")
    _, found = equal(1, SymmetricCycle(inputs["P"], 1.0, 1.0, 0.0, inputs["D"]), wave=FIRST)
    assert found == pytest.approx(exact, rel=tol)


def test_equation_21():
    ((_, inputs, exact, tol),) = cases("chang.ex1.tau_eq21")
    relative = inputs["a"] / (inputs["K"] * inputs["h"])
    assert with_amplitude((1.0,), inputs["P"], relative, FIRST) == pytest.approx([exact], rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("atv.wang.T2"))
def test_the_atv_column_of_wangs_table_2(name, inputs, exact, tol):
    model = TransferFunction.fopdt(inputs["K"], inputs["T"], inputs["L"])
    cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, inputs["h"]))
    relative = cycle.peak_max / (inputs["K"] * inputs["h"])
    assert with_amplitude((1.0,), cycle.period, relative, FIRST) == pytest.approx([exact], rel=tol)


@pytest.mark.parametrize("figure", ["chang.fig3", "chang.fig4"])
def test_errors_of_equations_1_and_2(figure):
    ((_, _, rows, _),) = cases(figure)
    for row in rows:
        k_u, w_u = ultimate_estimate(SymmetricCycle(row["P"], row["a_over_h"], 1.0, 0.0, 0.0))
        errors = (100.0 * (k_u / row["Ku_true"] - 1.0), 100.0 * (w_u / row["wu_true"] - 1.0))
        wanted = (row["Ku_err_atv_pct"], row["wu_err_atv_pct"])
        assert errors == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("epsilon", [0.0, 0.1])
@pytest.mark.parametrize(("model", "constants"), LAGS, ids=lambda v: getattr(v, "name", str(v)))
def test_a_limit_cycle_of_the_describing_function_gives_the_process(model, constants, epsilon):
    dead_time, relay = 0.5, 0.7
    process = model.build(np.array((2.0, *constants, dead_time)))
    # Where -1/N crosses the frequency response: N's argument is asin(epsilon/a).
    amplitude, w = _describing_function(process, relay, epsilon)
    cycle = SymmetricCycle(2.0 * math.pi / w, amplitude, relay, epsilon, dead_time)
    found = atv_from_numbers(cycle, Known(gain=2.0, structure=model.name, order=model.order))
    every = [found.values[1:-1]]
    if model == TWO_EQUAL_ONE:
        every = [np.array(s[1:]) for s in solutions(model, cycle, 2.0, FIRST)]
    assert min(np.abs(s / constants - 1.0).max() for s in every) < 1e-9
    if epsilon == 0.0 and model != TWO_EQUAL_ONE:
        assert found.ultimate_gain == pytest.approx(ultimate_point(process).gain, rel=1e-9)
        chosen = atv_from_numbers(cycle, Known(gain=2.0))
        assert (chosen.structure, chosen.model.order) in {
            (model.name, len(process.time_constants)),
            ("lag_n", 5),
        }


def _describing_function(process: TransferFunction, relay: float, epsilon: float):
    from scipy.optimize import brentq

    def amplitude(w: float) -> float:
        return 4.0 * relay / math.pi * abs(complex(process(1j * w)))

    def excess(w: float) -> float:
        share = min(epsilon / amplitude(w), 1.0)
        return float(process.phase(w)) + math.pi - math.asin(share)

    w = brentq(excess, 1e-3, ultimate_point(process).frequency * 1.001, xtol=1e-300, rtol=1e-15)
    value = complex(process(1j * w))
    assert cmath.phase(-value) == pytest.approx(math.asin(epsilon / amplitude(w)), abs=1e-9)
    return amplitude(w), w


def test_the_mean_of_phase_and_magnitude():
    ((_, inputs, exact, _),) = cases("chang.ex1.limitcycle")
    cycle = SymmetricCycle(exact["P"], exact["a"], inputs["h"], 0.0, inputs["D"])
    found = atv_from_numbers(cycle, Known(gain=inputs["K"]))
    parts = [c[2] for c in cases("chang.ex1.tau_eq13", "chang.ex1.tau_eq21")]
    assert found.values == pytest.approx([1.65, sum(parts) / 2.0, 10.0], rel=1e-9)
    k_u, w_u = ultimate_estimate(cycle)
    assert (found.ultimate_gain, found.ultimate_frequency) == (k_u, w_u)
    assert found.warnings == ()


def test_without_the_gain_phase_and_magnitude_are_used_up():
    ((_, inputs, exact, _),) = cases("chang.ex1.limitcycle")
    cycle = SymmetricCycle(exact["P"], exact["a"], inputs["h"], 0.0, inputs["D"])
    found = atv_from_numbers(cycle, Known())
    assert found.values[1] == pytest.approx(cases("chang.ex1.tau_eq13")[0][2], rel=1e-9)
    point = ultimate_point(found.model)
    assert (point.gain, point.frequency) == pytest.approx(ultimate_estimate(cycle), rel=1e-9)
    assert any("structure is not checked" in w for w in found.warnings)


def test_numbers_that_cannot_be_are_refused():
    def at(dead_time: float, hysteresis: float = 0.0) -> SymmetricCycle:
        return SymmetricCycle(10.0, 1.0, 1.0, hysteresis, dead_time)

    with pytest.raises(IdentificationError, match="less than half the period"):
        equal(1, at(5.0), wave=FIRST)
    with pytest.raises(IdentificationError, match="not above the hysteresis"):
        equal(1, at(1.0, 1.0), wave=FIRST)
    with pytest.raises(IdentificationError, match=r"of 1 equal lags .* misread"):
        # A phase of more than a quarter turn is left.
        equal(1, at(2.4), wave=FIRST)
    with pytest.raises(IdentificationError, match="gain given is too small"):
        with_amplitude((1.0,), 10.0, 1.3, FIRST)
    for model in (SOPDT, TWO_EQUAL_ONE):
        with pytest.raises(IdentificationError, match="less lag than fopdt"):
            solutions(model, at(4.0), 2.0, FIRST)
    with pytest.raises(IdentificationError, match="needs the gain"):
        atv_from_numbers(SymmetricCycle(10.0, 1.0, 1.0, 0.0, 1.0), Known(structure="sopdt"))


def _record(model: TransferFunction, epsilon: float = 0.0, bias: float = 0.0) -> Record:
    relay = RelaySettings(5.0, 40.0, 1.0, bias, epsilon, reverse_acting=model.gain < 0.0)
    return simulate_relay(model, relay, cycles=6, time=4801).record()


@pytest.mark.parametrize("gain", [1.65, -1.65])
def test_a_record(gain):
    model = TransferFunction.fopdt(gain, 20.0, 10.0)
    found = identify(_record(model), "atv", Known(gain=gain, dead_time=10.0))
    row = next(r for r in cases("chang.fig3")[0][2] if r["D"] == 10)
    truth = ultimate_point(model)
    error = 100.0 * (found.ultimate_gain / truth.gain - 1.0)
    assert error == pytest.approx(row["Ku_err_atv_pct"], abs=0.3)
    assert found.values == pytest.approx([gain, 16.2, 10.0], rel=0.01)
    assert found.ultimate_gain_std < 0.01 * abs(truth.gain)


def test_a_hysteresis_keeps_the_limit_cycle_off_the_ultimate_point():
    model = TransferFunction.lag_n(2.0, 3.0, 3, 1.0)
    found = identify_atv(_record(model, 0.2), Known(gain=2.0, dead_time=1.0))
    # The describing function is good for three lags, once it knows of the hysteresis.
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=0.02)
    assert any("eqs 1 and 2 give K_u" in w for w in found.warnings)


def test_a_biased_relay_is_refused():
    with pytest.raises(IdentificationError, match="bias"):
        identify_atv(_record(TransferFunction.fopdt(2.0, 3.0, 1.0), 0.1, 0.3))
