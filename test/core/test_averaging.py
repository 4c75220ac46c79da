# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The spread between structures: what rivals add to the uncertainty of K_u."""

from __future__ import annotations

import math

import numpy as np
import pytest
from relay_runs import simulate_relay

from relay_autotune.identification.estimate import Estimate
from relay_autotune.identification.result import Identification, identified
from relay_autotune.identification.waveform.findings import point_stds
from relay_autotune.identification.waveform.fit_covariance import Fit, estimate_of
from relay_autotune.identification.waveform.problem import problem_of
from relay_autotune.identification.waveform.separable import evaluate
from relay_autotune.process.structures import FOPDT, SOPDT, SOPDT_ZERO, Structure
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.process.ultimate import ultimate_point
from relay_autotune.record.record import RelaySettings

# 2 s of lag and 2 s of dead time, each gain and constant known to 1 %.
_VALUES = np.array([1.0, 2.0, 2.0])
_FOUND = identified("waveform", Estimate.of(FOPDT, _VALUES, np.diag((0.01 * _VALUES) ** 2)))


@pytest.mark.long
def test_draws_of_one_structure_give_its_own_deviation():
    own = list(_FOUND.estimate.draws(1000, np.random.default_rng(1)))
    stds = point_stds(_FOUND, own)
    expected = (_FOUND.ultimate_gain_std, _FOUND.ultimate_frequency_std)
    assert stds == pytest.approx(expected, rel=0.05)


def test_a_rival_that_differs_widens_the_interval_by_its_distance():
    own = list(_FOUND.estimate.draws(70, np.random.default_rng(1)))
    rival = SOPDT.build((1.0, 2.0, 0.5, 1.5))
    point = ultimate_point(rival)
    assert point is not None
    distance = math.log(point.gain / _FOUND.ultimate_gain)
    plain = point_stds(_FOUND, own)[0] / _FOUND.ultimate_gain
    gain_std, _ = point_stds(_FOUND, [*own, *[rival] * 30])
    expected = math.sqrt(0.7 * plain**2 + 0.3 * distance**2)
    assert gain_std / _FOUND.ultimate_gain == pytest.approx(expected, rel=1e-6)


def _fit_of(structure: Structure, theta: np.ndarray, noise: float) -> Identification:
    """Return two lags of 3 s and 1 s of dead time as a structure has them at theta."""
    process, relay = TransferFunction.sopdt(2.0, (3.0, 3.0), 1.0), RelaySettings(0.0, 0.0, 1.0)
    run = simulate_relay(process, relay, cycles=5, time=800)
    assert run.command is not None
    error = noise * np.random.default_rng(4).standard_normal(run.time.size)
    problem = problem_of([(run.time, run.measurement + error, run.command)], structure)
    state = evaluate(problem, theta)
    estimate = estimate_of(problem, state, Fit(problem, state, (), 1.0))
    assert estimate is not None
    return identified("waveform", estimate)


@pytest.mark.parametrize("noise", [1e-3, 1e-6, 1e-9])
def test_what_data_cannot_tell_apart_leaves_open_no_more_together(noise):
    # A zero of next to nothing is the same as less dead time: each of the two is open, hardly
    # what they do together.
    theta = np.array((math.log(3.0), 0.0, 1.0))
    plain = _fit_of(SOPDT, theta, noise)
    found = _fit_of(SOPDT_ZERO, theta, noise)
    i, j = (found.parameters.index(name) for name in ("zero", "dead_time"))
    assert abs(found.values[i]) < 10.0 * noise
    assert found.std[i] > 10.0 * noise
    assert found.std[j] == pytest.approx(found.std[i], rel=0.05)
    along = np.zeros(len(found.parameters))
    along[i] = along[j] = 1.0
    shared = math.sqrt(along @ found.covariance @ along)
    assert math.isfinite(shared)
    assert np.allclose(found.covariance, found.covariance.T, rtol=1e-12)
    spread = np.linalg.eigvalsh(found.covariance)
    assert spread.min() > -1e-12 * spread.max()
    assert plain.ultimate_gain_std > 0.0
    rounding = 1e-6
    assert found.ultimate_gain_std < 1.5 * plain.ultimate_gain_std + rounding
