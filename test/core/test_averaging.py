"""The spread between structures: what rivals add to the uncertainty of K_u."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_autotune.identification.fit.averaging import averaged_point
from relay_autotune.identification.result import Rival, with_uncertainty
from relay_autotune.models import TransferFunction

# 2 s of lag and 2 s of dead time, each gain and constant known to 1 %.
_VALUES = np.array([1.0, 2.0, 2.0])
_FOUND = with_uncertainty(
    "waveform",
    lambda v: TransferFunction.fopdt(*v),
    ("gain", "time_constant", "dead_time"),
    _VALUES,
    np.diag((0.01 * _VALUES) ** 2),
)


def _second_order(small: float, std: float) -> Rival:
    """Return a rival with one more lag, which the data cannot tell from dead time."""
    values = np.array([1.0, 2.0, small, 2.0 - small])
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = _FOUND.covariance[:2, :2]
    covariance[3, 3] = _FOUND.covariance[2, 2]
    along = np.array([0.0, 0.0, 1.0, -1.0])
    covariance += std**2 * np.outer(along, along)

    def build(v):
        return TransferFunction.sopdt(v[0], (v[1], v[2]), v[3])

    names = ("gain", "time_constant_1", "time_constant_2", "dead_time")
    return Rival(build(values), 0.3, build, names, values, covariance)


def test_a_rival_that_differs_widens_the_interval_by_its_distance():
    plain = _FOUND.ultimate_gain_std
    rival = _second_order(0.5, 0.01)
    gain_std, _ = averaged_point(_FOUND, 0.7, [rival])
    distance = abs(-1.0 / rival.model(1j * _phase_crossover(rival.model)).real)
    distance -= _FOUND.ultimate_gain
    assert gain_std == pytest.approx(math.sqrt(plain**2 + 0.3 * distance**2), rel=0.1)


def _phase_crossover(model: TransferFunction) -> float:
    w = np.linspace(0.3, 2.0, 200_001)
    return float(w[np.argmin(np.abs(model.phase(w) + math.pi))])


@pytest.mark.parametrize("std", [0.0, 1.0, 1e2, 1e4])
def test_a_lag_too_small_to_be_seen_leaves_the_interval_as_it_is(std):
    # A lag of 1 ms is the same as a dead time of 1 ms, however uncertain the first order says
    # that both are.
    gain_std, frequency_std = averaged_point(_FOUND, 0.7, [_second_order(1e-3, std)])
    assert gain_std == pytest.approx(_FOUND.ultimate_gain_std, rel=0.02)
    assert frequency_std == pytest.approx(_FOUND.ultimate_frequency_std, rel=0.02)
