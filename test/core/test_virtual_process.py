# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The simulated process against the closed form of a first-order step response."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_autotune.errors import ParameterError
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.virtual_process import (
    Actuator,
    Disturbances,
    Plant,
    VirtualProcess,
)

MODEL = TransferFunction.fopdt(2.0, 5.0, 1.3)


def step_response(t: float) -> float:
    return 2.0 * (1.0 - math.exp(-(t - 1.3) / 5.0)) if t > 1.3 else 0.0


def test_it_rests_at_its_operating_point() -> None:
    process = VirtualProcess(MODEL, rest_measurement=20.0, rest_command=3.0)
    assert [process.measure(0.5 * k) for k in range(10)] == [20.0] * 10


def test_a_step_between_samples_is_answered_exactly() -> None:
    process = VirtualProcess(MODEL, rest_measurement=20.0, rest_command=3.0)
    process.measure(1.0)
    process.command(3.5, 1.25)
    for t in (1.5, 2.5, 4.0, 9.0):
        assert process.measure(t) == pytest.approx(20.0 + 0.5 * step_response(t - 1.25), abs=1e-12)


def test_a_load_enters_at_its_own_instant_and_drift_adds() -> None:
    process = VirtualProcess(
        MODEL, disturbances=Disturbances(load_time=0.7, load_size=-1.0, drift=0.1)
    )
    for t in (0.0, 1.0, 3.0, 8.0):
        assert process.measure(t) == pytest.approx(0.1 * t - step_response(t - 0.7), abs=1e-12)


def test_the_actuator_stands_before_the_model() -> None:
    process = VirtualProcess(MODEL, actuator=Actuator(0.0, maximum=0.25))
    process.command(1.0)
    assert process.measure(6.0) == pytest.approx(0.25 * step_response(6.0), abs=1e-12)


def test_noise_is_reproducible_and_of_the_size_asked_for() -> None:
    def samples(seed: int) -> np.ndarray:
        process = VirtualProcess(MODEL, disturbances=Disturbances(noise_std=0.3), seed=seed)
        return np.array([process.measure(0.01 * k) for k in range(4000)])

    first = samples(1)
    assert np.array_equal(first, samples(1))
    assert not np.array_equal(first, samples(2))
    # The standard deviation of 4,000 samples is within 1.1 % with a probability of 68 %.
    assert np.std(first) == pytest.approx(0.3, rel=0.05)


def test_quantisation_leaves_multiples_of_its_step() -> None:
    process = VirtualProcess(MODEL, disturbances=Disturbances(quantisation=0.25))
    process.command(1.0)
    values = [process.measure(0.3 * k) for k in range(60)]
    assert all(v == 0.25 * round(v / 0.25) for v in values)
    assert max(abs(v - step_response(0.3 * k)) for k, v in enumerate(values)) <= 0.125 + 1e-12


@pytest.mark.parametrize("name", ["noise_std", "quantisation", "load_time"])
def test_a_negative_size_is_refused(name: str) -> None:
    with pytest.raises(ParameterError, match=f"{name} is -0.1, expected at least 0"):
        Disturbances(**{name: -0.1})


@pytest.mark.parametrize("name", ["load_size", "drift"])
def test_an_infinite_disturbance_is_refused(name: str) -> None:
    with pytest.raises(ParameterError, match=f"{name} is inf, expected a finite number"):
        Disturbances(**{name: math.inf})


def test_a_command_shows_no_rounding_when_it_arrives() -> None:
    """A relay without hysteresis would take it for the answer, and its sign for the gain's."""
    model = TransferFunction(0.547, (-0.418,), (1.06, 2.3), 1, 0.1)
    for height in np.linspace(0.1, 3.0, 40):
        plant = Plant(model)
        assert plant.advance(0.1, height) == 0.0
        assert plant.advance(0.2, height) < 0.0
