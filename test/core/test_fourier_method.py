# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The method `fourier` against processes whose frequency response is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from relay_runs import simulate_relay
from sampled_relay import exact_limit_cycle

from relay_autotune.errors import IdentificationError
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import METHODS, identify
from relay_autotune.process.structures import (
    INTEGRATOR_INVERSE,
    INTEGRATOR_LAG,
    IPDT,
    UNSTABLE_FOPDT,
)
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import Record, RelaySettings

FOPDT = TransferFunction.fopdt(1.65, 20.0, 10.0)
RELAY = RelaySettings(5.0, 40.0, 1.0, 0.0, 0.1)


def _record(
    model: TransferFunction,
    relay: RelaySettings = RELAY,
    *,
    noise: float = 0.0,
    seed: int = 0,
    cycles: int = 6,
    samples: int = 400,
    rest: int = 0,
) -> Record:
    """Return an ideal experiment, after a number of samples at rest."""
    period = exact_limit_cycle(model, relay, tolerance=1e-6).period / samples
    time = period * np.arange(samples * cycles)
    run = simulate_relay(model, relay, cycles=cycles + 2, time=time)
    rng = np.random.default_rng(seed)
    record = run.record(noise_std=noise, rng=rng)
    if rest == 0:
        return record
    before = relay.setpoint + noise * rng.standard_normal(rest)
    return replace(
        record,
        time=np.concatenate((time[0] - period * np.arange(rest, 0, -1), record.time)),
        measurement=np.concatenate((before, record.measurement)),
        command=np.concatenate((np.full(rest, relay.baseline), record.command)),
        receive_time=np.empty(0),
        command_time=np.empty(0),
        cycle_start=tuple(c + rest for c in record.cycle_start),
        held_input=record.input(),
    )


def _response(model: TransferFunction, frequency: float) -> complex:
    return complex(model(1j * frequency))


@pytest.mark.parametrize("gain", [1.65, -1.65])
def test_points_and_model_of_a_fopdt_process(gain):
    model = TransferFunction.fopdt(gain, 20.0, 10.0)
    found = identify(_record(model, replace(RELAY, reverse_acting=gain < 0.0)), "fourier")
    assert found.structure == "fopdt"
    assert found.values == pytest.approx([gain, 20.0, 10.0], rel=3e-3)
    truth = ultimate_point(model)
    assert found.ultimate_gain == pytest.approx(truth.gain, rel=5e-4)
    assert found.ultimate_frequency == pytest.approx(truth.frequency, rel=5e-4)
    assert [round(p.frequency / found.points[0].frequency) for p in found.points] == [
        1,
        3,
        5,
        7,
        9,
    ]
    for point in found.points:
        assert abs(point.value - _response(model, point.frequency)) < 3.0 * point.std


def test_a_biased_relay_tells_even_harmonics_and_the_static_gain():
    relay = replace(RELAY, bias=0.3)
    blind = identify(_record(FOPDT, relay, noise=0.05), "fourier")
    rested = identify(_record(FOPDT, relay, noise=0.05, rest=2000), "fourier")
    numbers = [round(p.frequency / rested.points[0].frequency) for p in rested.points]
    assert numbers[:3] == [1, 2, 3]
    # Without samples at rest the harmonics alone tell the gain, which are small.
    assert rested.std[0] < 0.6 * blind.std[0]
    assert abs(rested.values[0] - 1.65) < 3.0 * rested.std[0]


@pytest.mark.long
@pytest.mark.parametrize(
    "model",
    [
        TransferFunction.lag_n(1.0, 6.0, 8, 0.6),
        TransferFunction.oscillator(1.0, 1.0, 0.4, 0.5),
        INTEGRATOR_INVERSE.build((0.547, 0.418, 1.06, 0.1)),
    ],
)
def test_the_ultimate_point_needs_no_structure(model):
    found = identify(_record(model, RelaySettings(0.0, 0.0, 1.0, 0.0, 0.02), cycles=10), "fourier")
    truth = ultimate_point(model)
    assert found.ultimate_gain == pytest.approx(truth.gain, rel=0.03)
    assert found.ultimate_frequency == pytest.approx(truth.frequency, rel=0.02)
    assert any("another structure" in text for text in found.warnings)


@pytest.mark.long
@pytest.mark.parametrize(
    ("model", "known"),
    [
        (IPDT.build((0.5, 1.0)), Known(structure="ipdt")),
        (INTEGRATOR_LAG.build((0.5, 2.0, 1.0)), Known(structure="integrator_lag")),
        (UNSTABLE_FOPDT.build((1.0, 1.0, 0.3)), Known(structure="unstable_fopdt")),
        (TransferFunction.lag_n(1.0, 2.0, 3, 1.0), Known(structure="lag_n", order=3)),
        (TransferFunction.lag_n(1.0, 2.0, 3, 1.0), Known(order=3, gain=1.0, dead_time=1.0)),
    ],
)
def test_structures_that_are_known(model, known):
    record = _record(model, RelaySettings(0.0, 0.0, 1.0, 0.0, 0.02), cycles=10)
    found = identify(record, "fourier", known)
    assert found.structure == model.structure
    assert found.model.gain == pytest.approx(model.gain, rel=0.02)
    assert found.model.dead_time == pytest.approx(model.dead_time, rel=0.02)
    if known.gain == 1.0:
        assert found.std[0] == found.std[2] == 0.0


@pytest.mark.nightly
def test_the_deviations_are_those_over_seeds():
    truth = ultimate_point(FOPDT)
    scores = []
    for seed in range(30):
        found = identify(_record(FOPDT, noise=0.1, seed=seed, samples=150), "fourier")
        scores.append(
            (
                (found.ultimate_gain - truth.gain) / found.ultimate_gain_std,
                (found.ultimate_frequency - truth.frequency) / found.ultimate_frequency_std,
                (found.values[2] - 10.0) / found.std[2],
            )
        )
        assert not any("another structure" in text for text in found.warnings)
    spread = np.sqrt(np.mean(np.array(scores) ** 2, axis=0))
    # The root mean square of 30 draws of unit variance is within 0.65 and 1.35 (99.5 %).
    assert np.all((spread > 0.65) & (spread < 1.35))


def test_what_it_cannot_do_it_refuses():
    record = _record(FOPDT)
    with pytest.raises(IdentificationError, match="whole cycle"):
        identify(replace(record, cycle_start=(), settings=RELAY), "fourier")
    with pytest.raises(IdentificationError, match="sample faster"):
        identify(_record(FOPDT, samples=8), "fourier")
    with pytest.raises(IdentificationError, match="uncertain by"):
        identify(_record(FOPDT, noise=30.0), "fourier")
    with pytest.raises(IdentificationError, match="wrong sign"):
        identify(record, "fourier", Known(gain=-1.65))
    with pytest.raises(IdentificationError, match="no structure 'sopdt'"):
        identify(record, "fourier", Known(structure="sopdt"))
    assert "fourier" in METHODS
