# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Wang's methods against the paper's worked cases and on exact records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from forward import fopdt_limit_cycle
from relay_runs import simulate_relay
from sampled_relay import simulate_sampled_relay
from worked_cases import cases

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.limit_cycle.fold import switched_at
from relay_autotune.identification.limit_cycle.fourier import cycle_means, frequency_point
from relay_autotune.identification.methods.fourier import identify_fourier
from relay_autotune.identification.methods.wang import (
    FopdtCycle,
    fopdt_from_biased,
    fopdt_from_unbiased,
    fopdt_with_gain,
    identify_biased,
    identify_unbiased,
)
from relay_autotune.process.structures import IPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("wang.T1"))
def test_equations_2_to_5(name, inputs, exact, tol):
    p = inputs
    cycle = fopdt_limit_cycle(p["K"], p["T"], p["L"], p["mu"], p["mu0"], p["eps"])
    found = (cycle.high, cycle.low, cycle.up, cycle.down)
    assert found == pytest.approx([exact[k] for k in ("Tu1", "Tu2", "Au", "Ad")], rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("wang.T2"))
def test_biased_relay(name, inputs, exact, tol):
    p = inputs
    cycle = FopdtCycle(p["Tu1"], p["Tu2"], p["Au"], p["Ad"])
    found = fopdt_from_biased(cycle, p["K"], p["mu"], p["mu0"], p["eps"])
    assert found == pytest.approx((exact["K"], exact["T"], exact["L"]), rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("wang.T3"))
def test_biased_relay_on_higher_order(name, inputs, exact, tol):
    p, relay = inputs, inputs["relay"]
    cycle = FopdtCycle(p["Tu1"], p["Tu2"], p["Au"], p["Ad"])
    found = fopdt_from_biased(cycle, 1.0, relay["mu"], relay["mu0"], relay["eps"])
    assert found == pytest.approx(exact["m,m"], rel=tol)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("wang.T4"))
def test_unbiased_relay(name, inputs, exact, tol):
    p = inputs
    found = fopdt_from_unbiased(p["Tu"], p["A"], p["A0"], p["mu"], p["eps"])
    assert found == pytest.approx((exact["K"], exact["T"], exact["L"]), rel=tol)


def test_no_limit_cycle_is_refused():
    with pytest.raises(IdentificationError, match="eq 7"):
        fopdt_from_biased(FopdtCycle(1.0, 1.0, 5.0, -0.1), 1.0, 1.0, 0.3, 0.1)
    with pytest.raises(IdentificationError, match="no stable FOPDT"):
        fopdt_from_unbiased(1.0, 10.0, 0.1, 1.0, 0.0)


def _record(gain: float, bias: float, samples: int = 20_001) -> Record:
    model = TransferFunction.fopdt(gain, 20.0, 10.0)
    relay = RelaySettings(5.0, 40.0, 1.0, bias, 0.1, reverse_acting=gain < 0.0)
    return simulate_relay(model, relay, cycles=5, time=samples).record()


@pytest.mark.parametrize("gain", [1.65, -1.65])
@pytest.mark.parametrize("bias", [0.3, -0.2])
def test_a_dense_record_of_a_biased_relay(gain, bias):
    found = identify_biased(_record(gain, bias))
    assert found.values == pytest.approx([gain, 20.0, 10.0], rel=2e-3)
    assert found.ultimate_gain == pytest.approx(np.sign(gain) * 2.3072017362581048, rel=2e-3)
    assert found.structure == "fopdt"


@pytest.mark.parametrize("gain", [1.65, -1.65])
def test_a_dense_record_of_an_unbiased_relay(gain):
    found = identify_unbiased(_record(gain, 0.0))
    assert found.values == pytest.approx([gain, 20.0, 10.0], rel=1e-2)


def test_each_relay_refuses_the_other():
    with pytest.raises(IdentificationError, match="biased relay"):
        identify_biased(_record(1.65, 0.0, 2001))
    with pytest.raises(IdentificationError, match="wang_biased"):
        identify_unbiased(_record(1.65, 0.3, 2001))


def test_eight_cycles_average_the_noise():
    model = TransferFunction.fopdt(1.0, 2.0, 1.0)
    relay = RelaySettings(3.0, 1.0, 1.0, 0.3, 0.1)
    noise = 0.02 * np.random.default_rng(7).standard_normal(3600)
    record = simulate_sampled_relay(model, relay, period=0.01, noise=noise)
    found = identify_biased(record)
    assert found.values == pytest.approx([1.0, 2.0, 1.0], rel=0.1)
    assert np.all(np.isfinite(found.std))
    assert np.all(found.std > 0.0)


def test_a_record_that_is_no_relay_test_is_refused():
    time = np.linspace(0.0, 10.0, 100)
    step = Record(time, np.minimum(time, 5.0), np.where(time > 1.0, 1.0, 0.0))
    for method in (identify_biased, identify_unbiased):
        with pytest.raises(IdentificationError, match="whole cycle"):
            method(step)


@pytest.mark.parametrize("harmonic", [1, 3, 5])
def test_frequency_points_of_any_process(harmonic):
    model = TransferFunction.lag_n(2.0, 1.0, 3, 0.7)
    relay = RelaySettings(0.0, 0.0, 1.0, 0.1, 0.05)
    record = simulate_relay(model, relay, cycles=14, time=40_001).record()
    point = frequency_point(record, switched_at(record, record.cycle_start[9:]), harmonic)
    # A harmonic is small beside the fundamental, and so is what the samples tell of it.
    assert point.value == pytest.approx(
        complex(model(1j * point.frequency)), rel=1e-5 * harmonic**4
    )


def test_means_over_whole_cycles_give_the_static_gain():
    record = _record(1.65, 0.3)
    y, u = cycle_means(record, *switched_at(record, record.cycle_start)[[0, -1]])
    assert (y - 5.0) / (u - 40.0) == pytest.approx(1.65, rel=1e-5)


def test_without_whole_cycles_there_is_no_point():
    record = replace(_record(1.65, 0.3, 501), cycle_start=())
    with pytest.raises(IdentificationError, match="whole cycle"):
        identify_fourier(record)


@pytest.mark.parametrize(("name", "inputs", "exact", "tol"), cases("wang.T4"))
def test_unbiased_relay_with_a_known_gain(name, inputs, exact, tol):
    p = inputs
    found = fopdt_with_gain(exact["K"], p["Tu"], p["A"], p["mu"], p["eps"])
    assert found == pytest.approx((exact["K"], exact["T"], exact["L"]), rel=tol)


@pytest.mark.long
@pytest.mark.parametrize(("method", "bias"), [(identify_biased, 0.3), (identify_unbiased, 0.0)])
@pytest.mark.parametrize("gain", [1.65, -1.65])
def test_a_known_gain_is_used(method, bias, gain):
    found = method(_record(gain, bias), Known(gain=gain))
    assert found.values[0] == gain
    assert found.values == pytest.approx([gain, 20.0, 10.0], rel=1e-3)
    with pytest.raises(IdentificationError):
        method(_record(gain, bias, 2001), Known(gain=-gain))


def test_the_mean_command_of_an_integrating_process_tells_no_gain():
    # Biased or not, what goes in must come out again over a cycle.
    model = IPDT.build((0.5, 1.0))
    relay = RelaySettings(5.0, 40.0, 1.0, 0.3, 0.1)
    run = simulate_relay(model, relay, cycles=8, time=np.arange(0.0, 40.0, 0.01))
    with pytest.raises(IdentificationError, match=r"eq 6.*integrating process"):
        identify_biased(run.record())


@pytest.mark.parametrize("seed", range(4))
def test_noise_does_not_raise_the_peaks(seed):
    # Raw peaks made every such record fail: its noise-to-signal ratio is 0.1.
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    relay = RelaySettings(0.0, 0.0, 1.0)
    run = simulate_relay(model, relay, cycles=8, time=np.arange(0.0, 200.0, 0.2))
    record = run.record(noise_std=0.05, rng=np.random.default_rng(seed))
    found = identify_unbiased(record)
    assert found.ultimate_gain == pytest.approx(2.3072017362581048, rel=0.02)
    assert found.ultimate_frequency == pytest.approx(0.18365972031521258, rel=0.02)


def _rested(noise: float, seed: int) -> Record:
    """Return a biased test after 40 samples at rest."""
    model = TransferFunction.fopdt(1.0, 2.0, 1.0)
    relay = RelaySettings(3.0, 1.0, 1.0, 0.3, 0.1)
    run = simulate_relay(model, relay, cycles=8, time=np.arange(0.0, 24.0, 0.02))
    record, rest = run.record(), 40
    y = np.concatenate((np.full(rest, 3.0), record.measurement))
    return replace(
        record,
        time=np.concatenate((-0.02 * np.arange(rest, 0, -1), record.time)),
        measurement=y + noise * np.random.default_rng(seed).standard_normal(y.size),
        command=np.concatenate((np.full(rest, 1.0), record.command)),
        receive_time=np.empty(0),
        command_time=np.empty(0),
        noise_std=noise,
        cycle_start=tuple(c + rest for c in record.cycle_start),
        held_input=record.input(),
    )


@pytest.mark.nightly
def test_the_error_of_the_steady_state_is_one_of_the_gain():
    # The true rest is known here, so that what is left is that of its 40 noisy samples.
    scores, shares = [], []
    for seed in range(16):
        record = _rested(0.05, seed)
        found = identify_biased(record)
        y, u = cycle_means(record, *switched_at(record, record.cycle_start)[[0, -1]])
        rest = record.measurement[:41].mean()
        assert found.values[0] == pytest.approx((y - rest) / (u - 1.0), rel=0.02)
        scores.append((found.values[0] - 1.0) / found.std[0])
        shares.append(0.05 / np.sqrt(41.0) / (u - 1.0) / found.std[0])
    # Nearly all of the uncertainty, and of the right size: 0.5 to 1.5 hold 99.5 % of such rms.
    assert np.median(shares) > 0.6
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.5


@pytest.mark.nightly
def test_noise_that_makes_a_lag_look_like_an_integrator_leaves_the_ultimate_point():
    # The amplitude is 0.1 % below that of an integrator, and the noise of the peaks is larger.
    model, relay = TransferFunction.fopdt(1.0, 1.0, 0.1), RelaySettings(0.0, 0.0, 1.0, 0.0, 0.0)
    truth = ultimate_point(model)
    run = simulate_relay(model, relay, cycles=7, time=0.0019 * np.arange(1000))
    rng, held, like = np.random.default_rng(4), 0, 0
    for _ in range(12):
        found = identify_unbiased(run.record(noise_std=0.006, rng=rng))
        assert found.ultimate_gain == pytest.approx(truth.gain, rel=0.1)
        held += abs(found.ultimate_gain - truth.gain) < 3.0 * found.ultimate_gain_std
        # What is hardly in the data has a wide interval.
        if found.warnings:
            like += 1
            assert found.std[0] > 0.1 * found.values[0]
    assert held >= 10
    assert 2 <= like <= 10


def test_an_exact_integrator_is_refused():
    relay = RelaySettings(0.0, 0.0, 1.0, 0.0, 0.0)
    run = simulate_relay(IPDT.build((1.0, 1.0)), relay, cycles=9, time=np.arange(0.0, 30.0, 0.02))
    with pytest.raises(IdentificationError, match="no stable FOPDT"):
        identify_unbiased(run.record())
