# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What may be asked of a controller, and what is refused with the limit that was crossed."""

from __future__ import annotations

import math

import pytest

from relay_autotune.errors import TuningError
from relay_autotune.loop.gains import Controller
from relay_autotune.process.structures import IPDT
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.tuning.task import DesignOptions, DesignTask, cautions


@pytest.mark.parametrize(
    ("asked", "limit"),
    [
        ({"ms": 1.19}, "1.2 to 4"),
        ({"ms": 4.01}, "1.2 to 4"),
        ({"ms": math.nan}, "1.2 to 4"),
        ({"mt": 1.0}, "above 1"),
        ({"mt": math.inf}, "finite"),
        ({"controller": "pd"}, "one of auto, pi, pid"),
        ({"sample_period": -1.0}, "at least 0 s"),
        ({"loop_delay": math.nan}, "at least 0 s"),
        ({"noise_std": -1.0}, "NaN where it is not given"),
        ({"amplitude": math.inf}, "NaN where it is not given"),
        ({"noise_share": 0.0}, "above 0"),
        ({"filter_ratio": math.nan}, "above 0"),
        ({"resonance": -2.0}, "above 0"),
        ({"closed_loop_time": 0.0}, "above 0 s"),
        ({"phase_peak": -120.0}, "between -3.14159 and -1.5708 rad"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_its_limit(asked, limit):
    with pytest.raises(TuningError, match=limit):
        DesignOptions(**asked)


def test_the_bound_on_the_complementary_sensitivity_follows_the_process():
    stable, integrating = TransferFunction.fopdt(1.0, 1.0, 1.0), IPDT.build((1.0, 1.0))
    assert DesignOptions().largest_mt(stable) == 1.4
    # +2 dB
    assert DesignOptions().largest_mt(integrating) == pytest.approx(10**0.1, rel=2e-3)
    assert DesignOptions(mt=1.7).largest_mt(integrating) == 1.7


def test_a_held_sample_lags_by_half_a_period():
    assert DesignOptions(sample_period=0.2, loop_delay=0.3).added_delay == pytest.approx(0.4)
    assert DesignTask(model=IPDT.build((1.0, 1.0))).options.added_delay == 0.0


@pytest.mark.parametrize(("td", "ends"), [(9.0, ", or ask for controller pi"), (0.0, "")])
def test_a_command_full_of_noise_is_told_with_the_option_that_helps(td, ends):
    process = TransferFunction(0.6, time_constants=(40.0, 12.0), dead_time=8.0)
    asked = DesignOptions(sample_period=0.1, noise_std=5.0, amplitude=1.0)
    task, controller = DesignTask(model=process, options=asked), Controller(0.5, 60.0, td, 0.5)
    (told,) = cautions(controller, task.loop(controller).performance(), task)
    assert told.endswith(f"filter the measurement{ends}")
    assert DesignOptions(controller="pi").controller == "pi"


@pytest.mark.parametrize(("period", "asks"), [(0.1, False), (100.0, True)])
def test_a_period_in_milliseconds_is_asked_about(period, asks):
    process = TransferFunction(0.6, time_constants=(40.0, 12.0), dead_time=8.0)
    task = DesignTask(model=process, options=DesignOptions(sample_period=period))
    controller = Controller(0.5, 60.0)
    said = cautions(controller, task.loop(controller).performance(), task)
    assert any("is the sampling period in seconds?" in each for each in said) is asks
