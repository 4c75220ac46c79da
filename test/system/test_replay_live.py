# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A recording gives the same result in replay, by ~/identify, and played into the nodes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_rig import RELIABLE, Rig
from made_bags import REPOSITORY
from make_bags import record_tune
from ros_domain import free_domain
from std_msgs.msg import Float64

from relay_autotune.analysis import analyse
from relay_autotune.bag.signals import Selection
from relay_autotune.exchange.messages import fill_experiment
from relay_autotune.identification.known import Known
from relay_autotune.identification.methods import identify
from relay_autotune.record.record import PiecewiseConstant, Record
from relay_autotune.recordings import read_experiments
from relay_autotune.result import Analysis
from relay_autotune_msgs.msg import PidGains, RelayExperiment, TransferFunction
from relay_autotune_msgs.srv import Identify

BAG = REPOSITORY / "bags" / "unbiased_relay_with_noise"
PLAYER = Path(__file__).parents[1] / "support" / "bag_player.py"
# The bag's 190 s take 5 s.
RATE = 40.0


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with free_domain() as domain:
        rig = Rig(domain, tmp_path_factory.mktemp("replay_live"))
        try:
            rig.identifier(structure="")
            yield rig
        finally:
            rig.close()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a tune with the present messages, so that a player can publish the bytes."""
    bag = tmp_path_factory.mktemp("recorded") / "bag"
    record_tune(bag, plant={"noise_std": 0.02, "seed": 11}, relay={"bias_ratio": 0.0})
    return bag


@pytest.fixture(scope="module")
def replayed() -> Analysis:
    (record,) = read_experiments(BAG).experiments
    return analyse(record)


def assert_same(model: Any, gains: Any, expected: Analysis) -> None:
    """Compare messages with a replay to the last digit."""
    identification, best = expected.model, expected.best_gains
    assert identification is not None
    assert best is not None
    assert model.gain == identification.model.gain
    assert model.dead_time == identification.model.dead_time
    assert list(model.denominator) == list(identification.model.denominator)
    assert model.ultimate_gain == identification.ultimate_gain
    assert (gains.kc, gains.ti, gains.td, gains.ms) == (best.kc, best.ti, best.td, best.ms)


def test_the_service_gives_every_model_and_every_gain(rig: Rig, replayed: Analysis) -> None:
    request = Identify.Request(experiment=RelayExperiment())
    fill_experiment(request.experiment, replayed.record)
    answer = rig.call(Identify, "identifier_node/identify", request)
    assert (answer.success, answer.reason) == (True, "")
    assert [m.method for m in answer.models] == [m.method for m in replayed.models]
    assert [g.rule for g in answer.gains] == [g.rule for g in replayed.gains]
    assert_same(answer.models[answer.selected], answer.gains[answer.recommended], replayed)


def test_the_service_refuses_with_a_reason(rig: Rig) -> None:
    answer = rig.call(Identify, "identifier_node/identify", Identify.Request())
    assert not answer.success
    assert "at least one sample" in answer.reason
    request = Identify.Request(method="guess")
    fill_experiment(request.experiment, read_experiments(BAG).experiments[0])
    answer = rig.call(Identify, "identifier_node/identify", request)
    assert "unknown method 'guess'" in answer.reason


@pytest.mark.nightly
def test_a_bag_played_into_the_nodes_gives_what_replay_gives(rig: Rig, recorded: Path) -> None:
    (record,) = read_experiments(recorded).experiments
    replayed = analyse(record)
    models = rig.listen("transfer_function", TransferFunction)
    gains = rig.listen("pi_gains", PidGains)
    heard: list[tuple[str, int, float]] = []
    for topic in ("measurement", "command"):

        def note(message: Any, info: dict[str, Any], topic: str = topic) -> None:
            heard.append((topic, info["source_timestamp"], message.data))

        rig.node.create_subscription(Float64, topic, note, RELIABLE)
    rig._launch("player", [sys.executable, str(PLAYER), str(recorded), str(RATE)], (), {})
    # The record comes in one message, so the time of its arrival does not matter.
    rig.until(lambda: gains and models and models[-1].final, "model and gains", 60.0)
    assert_same(models[-1], gains[-1], replayed)

    # The stamps of the samples are the times of the playback.
    both = Selection("/measurement", "/command", start=0.0)
    (again,) = read_experiments(recorded, both).experiments
    rig.until(lambda: sum(t == "measurement" for t, _, _ in heard) >= len(again), "all samples")
    fopdt = Known(structure="fopdt")
    played = identify(played_record(heard), "waveform", fopdt)
    expected = identify(again, "waveform", fopdt)
    found, true = played.model, expected.model
    # A sample may be some milliseconds late on a busy machine, times RATE.
    assert found.gain == pytest.approx(true.gain, rel=0.1)
    assert found.dead_time == pytest.approx(true.dead_time, abs=1.0)
    assert played.ultimate_gain == pytest.approx(expected.ultimate_gain, rel=0.1)


def played_record(heard: list[tuple[str, int, float]]) -> Record:
    """Join the received samples, in the time of the bag."""
    times = {
        topic: np.array([stamp for name, stamp, _ in heard if name == topic]) for topic in TOPICS
    }
    values = {
        topic: np.array([value for name, _, value in heard if name == topic]) for topic in TOPICS
    }
    origin = times["measurement"][0]
    seconds = {topic: (stamps - origin) / 1e9 * RATE for topic, stamps in times.items()}
    held = PiecewiseConstant.from_samples(seconds["command"], values["command"])
    return Record(
        time=seconds["measurement"],
        measurement=values["measurement"],
        command=held(seconds["measurement"]),
        held_input=held,
    )


TOPICS = ("measurement", "command")
