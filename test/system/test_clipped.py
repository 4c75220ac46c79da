# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""An actuator that goes less far than it is told, of which nobody knows: the tune fails."""

from __future__ import annotations

from typing import Any

import pytest
from loop_rig import Rig

from relay_autotune_msgs.msg import RelayExperiment


@pytest.mark.parametrize(
    ("amplitude", "known"),
    [
        (100.0, {"initial_command": 2.5}),
        pytest.param(20.0, {"baseline": 3.0}, marks=pytest.mark.nightly),
        pytest.param(20.0, {"initial_command": 0.5}, marks=pytest.mark.nightly),
        (20.0, {"baseline": 0.0}),
    ],
)
def test_levels_that_a_clipped_actuator_does_not_follow_never_complete(
    rig: Rig, amplitude: float, known: dict[str, Any]
) -> None:
    (baseline,) = known.values()
    experiments = rig.listen("relay_experiment", RelayExperiment)
    rig.plant(
        mode="lockstep",
        sample_period=0.2,
        structure="fopdt",
        gain=1.65,
        time_constants=[20.0],
        dead_time=10.0,
        operating_point=[40.0, baseline],
        noise_std=0.02,
        command_min=0.0,
        command_max=5.0,
        seed=11,
    )
    rig.relay(sample_period=0.2, amplitude=amplitude, **known)
    answer = rig.tune()
    assert "for the first cycle between" in answer.reason
    rig.until(lambda: experiments, "the record", 120.0)
    assert experiments[-1].outcome == RelayExperiment.FAILED, experiments[-1].reason
    if baseline > 0.0:
        assert "the actuator is clipped" in experiments[-1].reason
