# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `thyagarajan` on records, from end to end."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from relay_runs import simulate_relay
from sampled_relay import simulate_sampled_relay

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.process.structures import UNSTABLE_FOPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings

pytestmark = pytest.mark.long


def record_of(model, hysteresis=0.0, noise=0.0, seed=3, cycles=6, samples=1200, **relay):
    settings = RelaySettings(5.0, 40.0, 1.0, hysteresis=hysteresis, **relay)
    run = simulate_relay(model, settings, cycles=cycles, time=samples)
    std = noise * float(np.mean(np.abs(run.measurement - 5.0))) * math.sqrt(math.pi / 2.0)
    return run.record(noise_std=std, rng=np.random.default_rng(seed))


def thyagarajan(record, **known):
    return identify(record, "thyagarajan", Known(**known))


@pytest.mark.parametrize("hysteresis", [0.0, 0.1])
@pytest.mark.parametrize("gain", [1.65, -1.65])
def test_a_fopdt_record(gain, hysteresis):
    record = record_of(
        TransferFunction.fopdt(gain, 20.0, 10.0), hysteresis, reverse_acting=gain < 0.0
    )
    found = thyagarajan(record)
    assert found.structure == "fopdt"
    assert found.values == pytest.approx([gain, 20.0, 10.0], rel=1e-5)
    assert found.ultimate_gain == pytest.approx(math.copysign(2.3072017362581048, gain), rel=1e-5)
    assert "category 1a" in found.warnings[0]
    # the paper's own equations are beside it where they differ
    literal = [w for w in found.warnings if "as in the paper" in w]
    assert len(literal) == (hysteresis > 0.0)


def test_an_unstable_record():
    found = thyagarajan(record_of(UNSTABLE_FOPDT.build((1.0, 1.0, 0.3)), 0.03))
    assert found.structure == "unstable_fopdt"
    assert found.values == pytest.approx([1.0, 1.0, 0.3], rel=1e-4)
    assert "unstable" in found.warnings[0]


def test_a_rectangular_record_is_taken_for_fopdt():
    model = TransferFunction.lag_n(1.0, 1.0, 3, 10.0)
    found = thyagarajan(record_of(model, 0.1))
    assert found.structure == "fopdt"
    assert "category 1b" in found.warnings[0]
    # The first harmonic, as in the paper, would be 17 % off.
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=5e-3)
    assert found.values[0] == pytest.approx(1.0, rel=5e-3)


@pytest.mark.nightly
def test_a_slowly_growing_record_is_taken_for_two_lags():
    model = TransferFunction.lag_n(1.0, 25.0, 2, 0.05)
    record = record_of(model, cycles=60, samples=8000)
    found = thyagarajan(record)
    assert (found.structure, found.model.order) == ("lag_n", 2)
    assert found.model.dead_time == pytest.approx(0.001 * found.values[1])
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=0.1)
    text = " ".join(found.warnings)
    assert "eq 25" in text
    assert "D/tau = 0.001 is an assumption" in text
    # With the dead time known, nothing is assumed.
    known = thyagarajan(record, dead_time=0.05)
    assert known.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=0.03)


def test_a_record_of_high_order():
    model = TransferFunction.lag_n(1.0, 6.0, 8, 0.6)
    record = record_of(model, 0.05)
    found = thyagarajan(record)
    assert (found.structure, found.model.order) == ("lag_n", 5)
    assert "eq 28" in " ".join(found.warnings)
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=0.05)
    true = thyagarajan(record, structure="lag_n", order=8, dead_time=0.6)
    assert true.values == pytest.approx([1.0, 6.0, 0.6], rel=3e-3)


@pytest.mark.nightly
@pytest.mark.parametrize("noise", [0.05, 0.1])
def test_noise_is_averaged_and_reported(noise):
    model = TransferFunction.fopdt(1.65, 20.0, 10.0)
    true = np.array([1.65, 20.0, 10.0])
    found = [thyagarajan(record_of(model, 0.1, noise, seed)) for seed in range(8)]
    errors = np.array([f.values / true - 1.0 for f in found])
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < 1.2 * noise)
    inside = [(f.ci95_low <= true) & (true <= f.ci95_high) for f in found]
    assert np.mean(inside) > 0.7
    ultimate = [f.ultimate_gain / 2.3072017362581048 - 1.0 for f in found]
    assert math.sqrt(np.mean(np.square(ultimate))) < 0.3 * noise


def test_a_sampled_relay_that_sees_the_noise():
    model = TransferFunction.fopdt(1.0, 2.0, 1.0)
    noise = 0.03 * np.random.default_rng(5).standard_normal(4000)
    record = simulate_sampled_relay(
        model, RelaySettings(3.0, 1.0, 1.0, 0.0, 0.09), period=0.01, noise=noise
    )
    found = thyagarajan(record)
    assert found.structure == "fopdt"
    assert found.values == pytest.approx([1.0, 2.0, 1.0], rel=0.1)
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=0.03)


def test_a_dead_time_that_the_relay_added_is_not_the_processs():
    found = thyagarajan(record_of(TransferFunction.fopdt(1.0, 2.0, 1.0), 0.1, extra_delay=0.5))
    assert found.values == pytest.approx([1.0, 2.0, 1.0], rel=1e-4)


def test_a_peak_at_a_quarter_of_the_period_tells_gain_over_time_constant_only():
    model = TransferFunction.fopdt(100.0, 100.0, 1.0)
    found = thyagarajan(record_of(model, 0.3, 0.1, cycles=5))
    assert found.structure == "ipdt"
    assert found.values == pytest.approx([1.0, 1.0], rel=0.05)
    assert "biased relay would determine" in found.warnings[0]
    assert found.ultimate_gain == pytest.approx(ultimate_point(model).gain, rel=0.05)


@pytest.mark.parametrize(
    ("structure", "order", "orders"), [("fopdt", 0, 1), ("lag_n", 2, 2), ("lag_n", 0, 5)]
)
def test_the_structure_may_be_given(structure, order, orders):
    record = record_of(TransferFunction.lag_n(1.0, 6.0, 8, 0.6), 0.05)
    found = thyagarajan(record, structure=structure, order=order)
    assert found.structure == structure
    assert found.model.order == orders


def test_what_it_cannot_use_is_refused():
    record = record_of(TransferFunction.fopdt(1.0, 2.0, 1.0), 0.1)
    with pytest.raises(IdentificationError, match="no structure 'ipdt'"):
        thyagarajan(record, structure="ipdt")
    with pytest.raises(IdentificationError, match="no unstable FOPDT"):
        thyagarajan(record, structure="unstable_fopdt")
    biased = record_of(TransferFunction.fopdt(1.0, 2.0, 1.0), 0.1, bias=0.3)
    with pytest.raises(IdentificationError, match="bias"):
        thyagarajan(biased)
    time = np.linspace(0.0, 10.0, 100)
    step = Record(time, np.minimum(time, 5.0), np.where(time > 1.0, 1.0, 0.0))
    with pytest.raises(IdentificationError, match="whole cycle"):
        thyagarajan(step)


def test_settings_are_inferred_where_there_are_none():
    record = record_of(TransferFunction.fopdt(1.65, 20.0, 10.0), 0.1, samples=4000)
    found = thyagarajan(replace(record, settings=None))
    assert found.values == pytest.approx([1.65, 20.0, 10.0], rel=0.02)


def test_an_unsettled_record_is_remarked():
    model = TransferFunction.lag_n(1.0, 25.0, 2, 0.05)
    found = thyagarajan(record_of(model, cycles=4, samples=2000))
    assert any("had not settled" in w for w in found.warnings)


def test_unequal_halves_are_remarked():
    model, settings = TransferFunction.fopdt(1.0, 2.0, 1.0), RelaySettings(5.0, 0.0, 1.0, 0, 0.1)
    run = simulate_relay(model, settings, cycles=6, operating_point=4.8, time=1200)
    assert any("half periods differ" in w for w in thyagarajan(run.record()).warnings)


@pytest.mark.parametrize("method", ["thyagarajan", "luyben_step"])
def test_nonsense_is_refused_or_identified_but_never_an_accident(method):
    rng = np.random.default_rng(0)
    for k in range(120):
        n = int(rng.choice([3, 5, 12, 30, 100]))
        time = np.cumsum(rng.exponential(0.1, n))
        y = (
            np.zeros(n),
            rng.standard_normal(n),
            np.sin(3.0 * time) + k % 3,
            1e9 * rng.standard_normal(n),
            np.round(np.sin(3.0 * time)),
        )[k % 5]
        command = np.where((np.arange(n) // int(rng.integers(1, 20))) % 2 == 0, 1.0, -1.0)
        starts = tuple(int(i) for i in np.flatnonzero(np.diff(command) > 0.0) + 1)
        relay = RelaySettings(0.0, 0.0, 1.0, hysteresis=0.1 * (k % 2), reverse_acting=k % 7 == 0)
        record = Record(time, y, command, settings=relay, cycle_start=starts if k % 4 else ())
        try:
            found = identify(record, method)
        except IdentificationError as refusal:
            assert len(str(refusal)) > 30
        else:
            assert np.all(np.isfinite(found.values))
