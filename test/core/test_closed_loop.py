"""The sampled closed loop against the continuous one."""

from __future__ import annotations

import numpy as np
import pytest

from relay_autotune.errors import TuningError
from relay_autotune.models import TransferFunction
from relay_autotune.tuning import Controller, analyse_loop
from relay_autotune.tuning.analysis import load_response
from relay_autotune.tuning.closed_loop import simulate_closed_loop

MODEL = TransferFunction.fopdt(1.65, 20.0, 10.0)
GAINS = Controller(0.67, 21.1)


def test_the_load_response_tends_to_the_continuous_one():
    run = simulate_closed_loop(GAINS, MODEL, period=0.02, duration=200.0, load=1.0)
    time, error = load_response(GAINS, MODEL, 250.0)
    continuous = -np.interp(run.time, time, error)
    assert np.abs(run.measurement - continuous).max() < 5e-3 * continuous.max()
    iae = float(np.sum(np.abs(run.measurement)) * 0.02)
    assert iae == pytest.approx(analyse_loop(GAINS, MODEL).iae_load, rel=5e-3)


def test_the_loop_settles_at_the_set_point_against_a_load():
    run = simulate_closed_loop(
        GAINS, MODEL, period=0.5, duration=600.0, setpoint=2.0, load=0.3, load_time=250.0
    )
    assert run.measurement[-1] == pytest.approx(2.0, abs=1e-3)
    assert run.command[-1] == pytest.approx(2.0 / 1.65 - 0.3, abs=1e-3)
    before = run.measurement[run.time < 250.0]
    assert before[-1] == pytest.approx(2.0, abs=1e-2)


def test_derivative_action_is_refused():
    with pytest.raises(TuningError, match="PI control"):
        simulate_closed_loop(Controller(1.0, 2.0, 0.5), MODEL, period=0.1, duration=1.0)
