# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Two loops tune at once, each in its namespace; one of them ends early."""

from __future__ import annotations

from typing import Any

import pytest
from loop_rig import Rig

from relay_autotune_msgs.msg import PidGains, RelayExperiment, TransferFunction
from relay_autotune_msgs.srv import StartTune

# K_u of K e^(-D s)/(tau s + 1): |1 + j w tau|/K at the root of w D + atan(w tau) = pi.
LOOPS = {
    "kiln": {
        "plant": {"gain": 2.0, "time_constants": [0.2], "dead_time": 0.1, "noise_std": 0.01},
        "relay": {"stop_when": "confident", "confidence": 0.05, "min_cycles": 40},
        "ultimate_gain": 1.9034,
    },
    "tank": {
        "plant": {"gain": -0.5, "time_constants": [0.3], "dead_time": 0.06, "noise_std": 0.003},
        "relay": {},
        "ultimate_gain": -17.005,
    },
}


class Loop:
    """The nodes of one namespace and what they publish."""

    def __init__(self, rig: Rig, name: str) -> None:
        self.rig, self.name = rig, name
        facts: dict[str, Any] = LOOPS[name]
        space = ("-r", f"__ns:=/{name}")
        self.experiments = rig.listen(f"{name}/relay_experiment", RelayExperiment)
        self.models = rig.listen(f"{name}/transfer_function", TransferFunction)
        self.gains = rig.listen(f"{name}/pi_gains", PidGains)
        rig.start("plant_node", *space, structure="fopdt", sample_period=0.005, **facts["plant"])
        rig.relay(
            *space,
            amplitude=0.5,
            baseline=0.0,
            settle_time=0.5,
            max_cycles=40,
            measurement_timeout=5.0,
            **facts["relay"],
        )
        rig.identifier(*space)
        self.truth = facts["ultimate_gain"]

    def start(self) -> None:
        def accepted() -> Any:
            answer = self.rig.call(
                StartTune, f"/{self.name}/relay_node/start_tune", StartTune.Request()
            )
            return answer if answer.accepted else self.rig.run_for(0.1)

        self.answer = self.rig.until(accepted, f"start of {self.name}")


@pytest.mark.nightly
def test_two_loops_tune_at_once(rig: Rig) -> None:
    loops = [Loop(rig, name) for name in LOOPS]
    for loop in loops:
        loop.start()
    for loop in loops:
        rig.until(lambda loop=loop: loop.gains, f"gains of {loop.name}", timeout=60.0)
        (experiment,) = loop.experiments
        assert experiment.outcome == RelayExperiment.COMPLETED, experiment.reason
        ids = {m.experiment_id for m in (*loop.experiments, *loop.models, *loop.gains)}
        assert ids == {loop.answer.experiment_id}
        assert loop.models[-1].final
        # A busy machine delays the plant's steps, and the delay is part of the measured loop.
        assert loop.models[-1].ultimate_gain == pytest.approx(loop.truth, rel=0.25)
    confident = loops[0].experiments[0]
    assert "interval of K_u is within" in confident.reason
    assert len(confident.cycle_start) < 40
    # Relay and identifier communicate by topic: the last model before the end was accurate enough.
    early = [m for m in loops[0].models if not m.final][-1]
    assert 1.96 * early.ultimate_gain_std / early.ultimate_gain <= 0.05
