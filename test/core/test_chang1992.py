# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Chang et al.'s equations against the paper's worked cases, simulations and exact records."""

from __future__ import annotations

import math

import numpy as np
import pytest
from forward import peak_of_harmonics
from hypothesis import given, settings
from hypothesis import strategies as st
from relay_runs import simulate_relay
from sampled_relay import exact_limit_cycle, simulate_sampled_relay
from worked_cases import cases

from relay_autotune.errors import IdentificationError, ParameterError
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.limit_cycle import SymmetricCycle
from relay_autotune.identification.methods import identify
from relay_autotune.identification.methods.chang import chang_from_numbers, identify_chang
from relay_autotune.identification.methods.lags import (
    EXACT,
    MIXED,
    Wave,
    equal,
    fundamental,
    level,
    peak,
    slope_sign,
    solutions,
    with_amplitude,
)
from relay_autotune.process.structures import SOPDT, TWO_EQUAL_ONE
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings

EXAMPLE = {name: exact for name, _, exact, _ in cases("chang.ex1")}

# Models 1 to 5 and one of the general order, with gain 2.
PROCESSES = [
    TransferFunction.fopdt(2.0, 3.0, 1.0),
    TransferFunction.fopdt(2.0, 1.0, 8.0),
    TransferFunction.lag_n(2.0, 3.0, 2, 1.0),
    TransferFunction.lag_n(2.0, 3.0, 3, 1.0),
    TransferFunction.lag_n(2.0, 3.0, 6, 0.1),
    TransferFunction.sopdt(2.0, (3.0, 1.0), 0.5),
    TransferFunction.sopdt(2.0, (300.0, 0.2), 0.5),
    TWO_EQUAL_ONE.build((2.0, 1.0, 5.0, 0.5)),
    TWO_EQUAL_ONE.build((2.0, 10.0, 3.0, 2.0)),
    TWO_EQUAL_ONE.build((2.0, 3.0, 3.02, 1.0)),
]
RELAY = 0.7


def time_constant_from_period(
    order: int, period: float, dead_time: float, at_switch: float = 0.0
) -> float:
    """Return tau of equal lags of gain 1 under a relay of amplitude 1."""
    return equal(order, SymmetricCycle(period, 1.0, 1.0, at_switch, dead_time), 1.0)[1]


def gain_and_time_constant(
    order: int,
    period: float,
    amplitude: float,
    dead_time: float,
    relay: float,
    hysteresis: float = 0.0,
) -> tuple[float, float]:
    """Return K and tau of equal lags."""
    return equal(order, SymmetricCycle(period, amplitude, relay, hysteresis, dead_time))


def time_constant_from_amplitude(
    order: int, period: float, relative: float, wave: Wave = MIXED
) -> float:
    """Return tau of equal lags."""
    return with_amplitude((1.0 / order,) * order, period, relative, wave)[0]


def unequal(
    structure, period: float, dead_time: float, relative: float, at_switch: float, wave: Wave
) -> list[tuple[float, ...]]:
    """Return the time constants of model 4 or 5 of gain 1 under a relay of amplitude 1."""
    cycle = SymmetricCycle(period, relative, 1.0, at_switch, dead_time)
    return [found[1:] for found in solutions(structure, cycle, 1.0, wave)]


def _lags(model: TransferFunction) -> tuple[float, ...]:
    return tuple(t.real for t in model.time_constants)


def _cycle(model: TransferFunction, share: float) -> tuple[float, float, float]:
    """Period, amplitude, and a hysteresis of some share of the ideal relay's amplitude."""
    ideal = exact_limit_cycle(model, RelaySettings(0.0, 0.0, RELAY))
    epsilon = share * ideal.peak_max
    found = exact_limit_cycle(model, RelaySettings(0.0, 0.0, RELAY, 0.0, epsilon))
    return found.period, found.peak_max, epsilon


@pytest.mark.parametrize(
    ("name", "inputs", "exact", "tol"), cases("chang.eq8", "chang.eq9", "chang.eq10")
)
def test_equations_8_to_10(name, inputs, exact, tol):
    p = inputs
    truth = min(exact["roots"])
    assert time_constant_from_period(p["n"], p["P"], p["D"]) == pytest.approx(truth, rel=tol)
    assert peak((truth,) * p["n"], p["P"]) == pytest.approx(p["a_over_Kh"], rel=tol)


def test_equation_10_is_not_unique_and_the_smallest_root_is_taken():
    ((_, inputs, exact, _),) = cases("chang.eq10.tau5.D30")
    period, part = inputs["P"], 1.0 - 2.0 * inputs["D"] / inputs["P"]
    for root in exact["roots"]:
        assert abs(level((root,) * 3, period, part)) < 1e-9
    larger, smaller = sorted(exact["roots"], reverse=True)
    assert slope_sign((larger,) * 3, period, part) < 0.0 < slope_sign((smaller,) * 3, period, part)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("chang.eq11", "chang.eq12"))
def test_equations_11_and_12(name, inputs, exact, tol):
    t1, t2, period = inputs["tau1"], inputs["tau2"], exact["P"]
    m, t = 1.0 - 2.0 * inputs["D"] / period, 0.5 * period
    equal = "eq12" in name
    lags = (t1, t1, t2) if equal else (t1, t2)
    assert abs(level(lags, period, m)) < tol
    a, b = 1.0 / t1, 1.0 / t2
    ea, eb = math.exp(-a * t), math.exp(-b * t)
    eam, ebm = math.exp(-a * m * t), math.exp(-b * m * t)
    if equal:
        printed = (
            -((a - b) ** 2) * (1 + ea) ** 2 * (1 + eb) / 2
            + a * b * t * (a - b) * eam * ((1 - m) * ea - m) * (1 + eb)
            - b * (2 * a - b) * (1 + ea) * (1 + eb) * eam
            + a**2 * (1 + ea) ** 2 * ebm
        )
        scale = (a + b) ** 2
    else:
        printed = t1 * (2 * eam / (1 + ea) - 1) - t2 * (2 * ebm / (1 + eb) - 1)
        scale = t1 + t2
    assert abs(printed) < tol * scale


@pytest.mark.long
@pytest.mark.parametrize("share", [0.0, pytest.param(0.1, marks=pytest.mark.nightly), 0.4])
@pytest.mark.parametrize("model", PROCESSES, ids=str)
def test_the_generalised_equations_return_the_process(model, share):
    period, amplitude, epsilon = _cycle(model, share)
    lags, dead_time, h = _lags(model), model.dead_time, model.gain * RELAY
    relative, at_switch = amplitude / h, epsilon / h
    assert level(lags, period, 1.0 - 2.0 * dead_time / period) == pytest.approx(
        at_switch, abs=1e-9
    )
    assert peak(lags, period) == pytest.approx(relative, rel=1e-9)
    if model.structure == "sopdt":
        (found,) = unequal(SOPDT, period, dead_time, relative, at_switch, EXACT)
        assert found == pytest.approx(lags, rel=1e-7)
    elif model.structure == "two_equal_one":
        found = unequal(TWO_EQUAL_ONE, period, dead_time, relative, at_switch, EXACT)
        away = [abs(a / lags[0] - 1.0) + abs(b / lags[2] - 1.0) for a, b in found]
        assert min(away) < 1e-6
    else:
        n, tau = len(lags), lags[0]
        by_period = time_constant_from_period(n, period, dead_time, at_switch)
        by_amplitude = time_constant_from_amplitude(n, period, relative, EXACT)
        both = gain_and_time_constant(n, period, amplitude, dead_time, RELAY, epsilon)
        assert by_period == pytest.approx(tau, rel=1e-9)
        assert by_amplitude == pytest.approx(tau, rel=1e-9)
        assert both == pytest.approx((model.gain, tau), rel=1e-9)


@pytest.mark.long
def test_the_papers_iteration_over_harmonics_converges_to_the_exact_time_constant():
    period, amplitude, _ = _cycle(PROCESSES[2], 0.0)
    relative = amplitude / (2.0 * RELAY)
    tau = time_constant_from_amplitude(2, period, relative)
    assert abs(tau / 3.0 - 1.0) > 0.01
    for _ in range(10):
        ratio = peak_of_harmonics((tau, tau), period, 100) / fundamental((tau, tau), period)
        tau = time_constant_from_amplitude(2, period, relative / ratio)
    assert tau == pytest.approx(3.0, rel=1e-6)
    assert time_constant_from_amplitude(2, period, relative, EXACT) == pytest.approx(tau, rel=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_equations_21_to_23(n):
    # Eq 23 with the exponent 3/2.
    w, tau = 0.4, 5.0
    a = 4.0 / math.pi / (1.0 + (w * tau) ** 2) ** (n / 2)
    assert time_constant_from_amplitude(n, 2.0 * math.pi / w, a) == pytest.approx(tau, rel=1e-12)


@pytest.mark.parametrize("case", cases("chang.fig3")[0][2], ids=lambda c: f"D={c['D']}")
def test_figure_3(case):
    model = TransferFunction.fopdt(1.65, 20.0, case["D"])
    cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0))
    assert cycle.period == pytest.approx(case["P"], rel=1e-7)
    assert cycle.peak_max == pytest.approx(case["a_over_h"], rel=1e-7)
    tau = time_constant_from_period(1, case["P"], case["D"])
    point = ultimate_point(TransferFunction.fopdt(1.65, tau, case["D"]))
    assert 100.0 * (point.gain / case["Ku_true"] - 1.0) == pytest.approx(
        case["Ku_err_eq8_pct"], abs=1e-7
    )


@pytest.mark.parametrize("case", cases("chang.fig4")[0][2], ids=lambda c: f"D={c['D']}")
def test_figure_4(case):
    period, relative, dead_time = case["P"], case["a_over_h"] / 37.3, case["D"]
    truth = (case["Ku_true"], case["wu_true"])
    (exact,) = unequal(SOPDT, period, dead_time, relative, 0.0, EXACT)
    assert exact == pytest.approx((7200.0, 2.0), rel=1e-6)
    (literal,) = unequal(SOPDT, period, dead_time, relative, 0.0, MIXED)
    errors = []
    for lags in (exact, literal):
        point = ultimate_point(TransferFunction.sopdt(37.3, lags, dead_time))
        found = (point.gain, point.frequency)
        errors.append([abs(f / t - 1.0) for f, t in zip(found, truth, strict=True)])
    assert max(errors[0]) < 1e-6
    # The first harmonic alone is off, but less than eqs 1 and 2 are.
    assert errors[1][0] < abs(case["Ku_err_atv_pct"]) / 100.0
    assert errors[1][1] < 0.02


def test_one_lag_is_refused_outside_its_existence():
    with pytest.raises(IdentificationError, match=r"no stable FOPDT .* between 2\.5 s and 5 s"):
        time_constant_from_period(1, 10.0, 2.4999)
    with pytest.raises(IdentificationError, match="no stable FOPDT"):
        gain_and_time_constant(1, 10.0, 1.0, 2.4, 1.0)
    with pytest.raises(IdentificationError, match="less than half the period"):
        time_constant_from_period(1, 10.0, 5.0)
    # With a hysteresis a smaller dead time will do.
    assert time_constant_from_period(1, 10.0, 2.0, 0.1) > 0.0
    gain, tau = gain_and_time_constant(1, 10.0, 1.0, 2.4, 1.0, 0.1)
    again = exact_limit_cycle(
        TransferFunction.fopdt(gain, tau, 2.4), RelaySettings(0.0, 0.0, 1.0, 0.0, 0.1)
    )
    assert (again.period, again.peak_max) == pytest.approx((10.0, 1.0), rel=1e-9)


@pytest.mark.long
def test_numbers_that_cannot_be_are_refused():
    with pytest.raises(IdentificationError, match="amplitude"):
        time_constant_from_amplitude(1, 10.0, 1.5, EXACT)
    with pytest.raises(IdentificationError, match="amplitude"):
        time_constant_from_amplitude(1, 10.0, 1.5)
    with pytest.raises(IdentificationError, match="hysteresis"):
        time_constant_from_period(1, 10.0, 3.0, 1.2)
    with pytest.raises(IdentificationError, match="hysteresis"):
        gain_and_time_constant(1, 10.0, 1.0, 3.0, 1.0, 1.0)
    period, amplitude, _ = _cycle(PROCESSES[0], 0.0)
    with pytest.raises(IdentificationError, match="less lag"):
        unequal(SOPDT, period, 1.2, amplitude / (2.0 * RELAY), 0.0, EXACT)
    period, amplitude, _ = _cycle(PROCESSES[3], 0.0)
    with pytest.raises(IdentificationError, match="more lag"):
        unequal(SOPDT, period, 1.0, amplitude / (2.0 * RELAY), 0.0, EXACT)
    period, amplitude, _ = _cycle(PROCESSES[4], 0.0)
    with pytest.raises(IdentificationError, match="more lag"):
        unequal(TWO_EQUAL_ONE, period, 0.1, amplitude / (2.0 * RELAY), 0.0, EXACT)


@pytest.mark.nightly
@settings(deadline=None, max_examples=40)
@given(
    order=st.integers(1, 8),
    ratio=st.floats(0.01, 20.0),
    share=st.floats(0.0, 0.6),
    unit=st.sampled_from([1e-6, 1.0, 1e6]),
)
def test_equal_lags_come_back_at_any_dead_time(order, ratio, share, unit):
    """Of many roots the one that a relay starts is found."""
    model = TransferFunction.lag_n(1.0, unit, order, ratio * unit)
    ideal = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0))
    epsilon = share * ideal.peak_max
    cycle = exact_limit_cycle(model, RelaySettings(0.0, 0.0, 1.0, 0.0, epsilon))
    found = time_constant_from_period(order, cycle.period, ratio * unit, epsilon)
    assert found == pytest.approx(unit, rel=1e-6)


def _record(
    model: TransferFunction, share: float = 0.0, *, noise: float = 0.0, bias: float = 0.0
) -> Record:
    swing = exact_limit_cycle(
        TransferFunction(
            abs(model.gain), (), model.time_constants, 0, model.dead_time, model.structure
        ),
        RelaySettings(0.0, 0.0, 1.0),
    ).peak_max
    relay = RelaySettings(
        5.0, 40.0, 1.0, bias, share * swing, 0.3, reverse_acting=model.gain < 0.0
    )
    run = simulate_relay(model, relay, cycles=7, time=7 * 800)
    return run.record(noise_std=noise * swing, rng=np.random.default_rng(3))


@pytest.mark.long
@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.nightly), 0.2])
@pytest.mark.parametrize("model", [PROCESSES[k] for k in (0, 3, 5, 7, 1, 2, 4, 8)], ids=str)
def test_records_with_gain_and_dead_time_known(model, share):
    found = identify_chang(_record(model, share), Known(gain=2.0, dead_time=model.dead_time))
    assert found.structure == model.structure
    assert len(found.model.time_constants) == len(model.time_constants)
    truth = [t for i, t in enumerate(_lags(model)) if i == 0 or t != _lags(model)[i - 1]]
    assert found.values == pytest.approx([2.0, *truth, model.dead_time], rel=0.015)
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=4e-3)
    if share:
        assert any("for an ideal relay" in w for w in found.warnings)


@pytest.mark.long
@pytest.mark.parametrize("gain", [2.0, -2.0])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_records_of_an_unknown_gain(order, gain):
    make = TransferFunction.fopdt if order == 1 else TransferFunction.lag_n
    model = make(gain, 3.0, *(() if order == 1 else (order,)), 1.0)
    found = identify(_record(model, 0.1), "chang", Known(dead_time=1.0))
    assert len(found.model.time_constants) == order
    assert found.values == pytest.approx([gain, 3.0, 1.0], rel=0.01)
    assert any("without the gain the structure is not checked" in w for w in found.warnings)


@pytest.mark.long
@pytest.mark.parametrize(
    ("order", "source"), [(1, "the sharp peak"), (2, "the first response"), (3, "first response")]
)
def test_the_dead_time_is_read_from_the_record(order, source):
    model = TransferFunction(2.0, (), (3.0,) * order, 0, 1.0)
    found = identify_chang(_record(model), Known(gain=2.0))
    assert found.values[-1] == pytest.approx(1.0, abs=0.04)
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=0.03)
    assert any(source in w for w in found.warnings)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_noisy_record(share):
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    swing = 0.65
    relay = RelaySettings(0.0, 0.0, 1.0, 0.0, share * swing)
    noise = 0.05 * swing * np.random.default_rng(5).standard_normal(1800)
    record = simulate_sampled_relay(model, relay, period=0.2, noise=noise)
    found = identify_chang(record, Known(gain=1.65, dead_time=10.0))
    assert found.structure == "fopdt"
    truth = ultimate_point(model)
    assert found.ultimate_gain == pytest.approx(truth.gain, rel=0.05)
    assert found.ultimate_frequency == pytest.approx(truth.frequency, rel=0.01)
    assert 0.0 < found.ultimate_gain_std < 0.1 * truth.gain
    assert found.std[0] == 0.0
    assert found.ci95_low[1] < 20.0 < found.ci95_high[1]


def test_a_biased_relay_is_refused():
    record = _record(PROCESSES[0], bias=0.3)
    with pytest.raises(IdentificationError, match=r"bias of 0\.3.*wang_biased"):
        identify_chang(record)


def test_a_gain_of_the_wrong_sign_is_refused():
    with pytest.raises(IdentificationError, match="wrong sign"):
        identify_chang(_record(PROCESSES[0]), Known(gain=-2.0))


def test_a_record_that_is_no_relay_test_is_refused():
    time = np.linspace(0.0, 10.0, 100)
    step = Record(time, np.minimum(time, 5.0), np.where(time > 1.0, 1.0, 0.0))
    with pytest.raises(IdentificationError, match="whole cycle"):
        identify_chang(step)


def _example() -> SymmetricCycle:
    exact = EXAMPLE["chang.ex1.limitcycle"]
    return SymmetricCycle(exact["P"], exact["a"], 0.04, 0.0, 10.0)


def test_the_papers_example_from_its_numbers():
    found = chang_from_numbers(_example(), Known(gain=1.65))
    assert found.structure == "fopdt"
    assert found.values == pytest.approx([1.65, EXAMPLE["chang.ex1.tau_eq8"], 10.0], rel=1e-9)
    exact = EXAMPLE["chang.ex1.ultimate"]
    assert found.ultimate_gain == pytest.approx(exact["Ku"], rel=1e-9)
    assert found.ultimate_frequency == pytest.approx(exact["wu"], rel=1e-9)
    assert found.warnings == ()
    assert np.all(np.isnan(found.std))


def test_a_structure_that_does_not_fit_is_said_to():
    found = chang_from_numbers(_example(), Known(gain=1.65, structure="lag_n", order=2))
    assert found.structure == "lag_n"
    assert any("do not agree on lag_n of order 2" in w for w in found.warnings)
    with pytest.raises(IdentificationError, match="no structure 'ipdt'"):
        chang_from_numbers(_example(), Known(gain=1.65, structure="ipdt"))
    with pytest.raises(IdentificationError, match="needs its order"):
        chang_from_numbers(_example(), Known(gain=1.65, structure="lag_n"))
    with pytest.raises(ParameterError, match="leave one of the two out"):
        Known(gain=1.65, structure="sopdt", order=3)
    with pytest.raises(IdentificationError, match="needs the gain"):
        chang_from_numbers(_example(), Known(structure="sopdt"))
