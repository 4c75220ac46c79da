# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What identifier_node is told of the process, and the two experiments of the method li."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.parameter import Parameter
from relay_runs import simulate_relay

from relay_autotune.analysis import KNOWN, PARAMETERS, known_from
from relay_autotune.cli.own_nodes import free_domain
from relay_autotune.errors import ParameterError
from relay_autotune.exchange.messages import fill_experiment
from relay_autotune.identification.known import Known
from relay_autotune.loop.analysis import Loop
from relay_autotune.loop.gains import Controller
from relay_autotune.loop.laws import LAWS
from relay_autotune.nodes.identifier import IdentifierNode
from relay_autotune.nodes.lifetime import Executor
from relay_autotune.process.transfer_function import TransferFunction
from relay_autotune.record.record import RelaySettings
from relay_autotune_msgs.msg import RelayCycle, RelayExperiment

PROCESS = TransferFunction.lag_n(2.0, 3.0, 2, 1.0)
NOTHING = {entry.name: entry.default for entry in KNOWN}


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[IdentifierNode]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with free_domain() as domain:
        rclpy.init(domain_id=domain)
        made = IdentifierNode()
        executor = Executor(made)
        yield made
        executor.shutdown(timeout_sec=0.0)
        made.destroy_node()
        rclpy.try_shutdown()


def work_off(node: IdentifierNode) -> None:
    """Let the node do all that it has begun, as its process does."""
    deadline = time.monotonic() + 120.0
    more = True
    while more or node._is_busy:
        busy = node.executor.turn(0.0 if more else 0.05)
        more = node.work(idle=not busy)
        assert time.monotonic() < deadline


def experiment(extra_delay: float) -> Any:
    relay = RelaySettings(5.0, 1.0, 0.7, 0.0, 0.1, extra_delay)
    run = simulate_relay(PROCESS, relay, cycles=8, time=1600)
    message = RelayExperiment()
    fill_experiment(message, run.record())
    message.experiment_id = f"with {extra_delay:g} s"
    return message


def test_nothing_is_known_unless_it_is_given() -> None:
    found = known_from(NOTHING)
    assert math.isnan(found.gain)
    assert (found.structure, found.order) == ("", 0)
    given = {"known_gain": 2.0, "known_dead_time": 1.0, "structure": "lag_n", "order": 2}
    assert known_from({**given, "loss": "huber"}) == Known(2.0, 1.0, "lag_n", 2, "huber")
    with pytest.raises(ParameterError, match="gain is 0, expected any number"):
        known_from({**NOTHING, "known_gain": 0.0})


@pytest.mark.nightly
def test_li_takes_the_last_two_experiments_and_facts_reach_the_methods(
    node: IdentifierNode,
) -> None:
    models: list[Any] = []
    node._models.publish = models.append
    node._gains.publish = lambda message: None
    node.set_parameters([Parameter("method", value="li")])
    node._on_experiment(experiment(0.0))
    work_off(node)
    assert models == []
    node._on_experiment(experiment(1.5))
    work_off(node)
    assert [m.method for m in models] == ["li"]
    assert models[0].experiment_id == "with 1.5 s"
    assert models[0].structure == "lag_n"
    assert models[0].gain == pytest.approx(2.0, rel=0.02)
    told = {"method": "chang", "known_gain": 2.0, "known_dead_time": 1.0, "structure": "lag_n"}
    node.set_parameters([Parameter(name, value=value) for name, value in told.items()])
    node.set_parameters([Parameter("order", value=2)])
    node._on_experiment(experiment(0.0))
    work_off(node)
    assert models[1].method == "chang"
    assert list(models[1].time_constants) == pytest.approx([3.0, 3.0], rel=0.01)
    refused = node.set_parameters([Parameter("known_gain", value=0.0)])[0]
    assert not refused.successful
    assert "known_gain is 0, expected" in refused.reason
    refused = node.set_parameters([Parameter("loss", value="huber")])[0]
    assert not refused.successful
    assert "loss is not used by the method chang" in refused.reason
    assert {entry.name for entry in KNOWN} <= {entry.name for entry in PARAMETERS}


@pytest.mark.long
def test_gains_are_for_the_law_of_the_parameter(
    node: IdentifierNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(node._models, "publish", lambda message: None)
    monkeypatch.setattr(node._gains, "publish", told.append)
    refused = node.set_parameters([Parameter("law", value="pid")])[0]
    assert not refused.successful
    assert "klipper_heater" in refused.reason
    # With the structure given no others are compared, which is not what this is about.
    chosen = {"law": "control_toolbox_legacy", "sample_period": 0.8, "structure": "lag_n"}
    node.set_parameters([Parameter(name, value=value) for name, value in chosen.items()])
    node.set_parameters([Parameter("order", value=2)])
    node._on_experiment(experiment(0.0))
    work_off(node)
    (gains,) = told
    assert "for control_toolbox_legacy every 0.8 s" in gains.reason
    law = LAWS["control_toolbox_legacy"].at(Controller(gains.kc, gains.ti, gains.td), 0.8)
    assert Loop(law, PROCESS).ms() == pytest.approx(gains.ms, rel=1e-3)


@pytest.mark.nightly
def test_progress_is_answered_with_what_is_sought(
    node: IdentifierNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(node._models, "publish", told.append)
    # The choice among structures takes seconds, and is not what this is about.
    node.set_parameters([Parameter("structure", value="lag_n"), Parameter("order", value=2)])
    progress = experiment(0.0)
    progress.outcome = RelayExperiment.UNKNOWN
    progress.sought, progress.sought_width = "ms", 0.02
    node._on_progress(progress)
    work_off(node)
    (model,) = told
    assert not model.final
    # Without noise all is known, and the gains keep the Ms that they are designed for.
    assert model.ms == pytest.approx(1.4, rel=0.01)
    assert model.ms_low <= model.ms <= model.ms_high < 1.42
    # Its cycles, which come besides, tell nothing more.
    cycle = RelayCycle(experiment_id=progress.experiment_id)
    node._on_cycle(cycle)
    work_off(node)
    assert len(told) == 1

    progress.sought = "ultimate_gain"
    node._on_progress(progress)
    work_off(node)
    assert told[-1].ultimate_gain_std < 0.01 * told[-1].ultimate_gain
    assert math.isnan(told[-1].ms)
