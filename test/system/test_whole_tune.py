# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A whole tune of installed executables, in lockstep and with /clock."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_rig import Rig
from ros_domain import free_domain

from relay_autotune.exchange.messages import record_from_message
from relay_autotune_msgs.msg import PidGains, RelayCycle, RelayExperiment, TransferFunction

GAIN, TIME_CONSTANT, DEAD_TIME = 1.65, 20.0, 10.0
PERIOD = 0.1
GAIN_FIELDS = (
    *("kc", "ti", "td", "tf", "b", "p", "i", "d"),
    *("ms", "ms_95", "mt", "gain_margin", "phase_margin", "delay_margin", "iae_load"),
)


class Results:
    """The messages of one tune."""

    def __init__(self, rig: Rig) -> None:
        self.cycles = rig.listen("relay_cycle", RelayCycle)
        self.experiments = rig.listen("relay_experiment", RelayExperiment)
        self.models = rig.listen("transfer_function", TransferFunction)
        self.gains = rig.listen("pi_gains", PidGains)


def tune_in_lockstep(rig: Rig, **plant: Any) -> tuple[Results, Path]:
    results = Results(rig)
    rig.plant(
        mode="lockstep",
        sample_period=PERIOD,
        structure="fopdt",
        gain=GAIN,
        time_constants=[TIME_CONSTANT],
        dead_time=DEAD_TIME,
        operating_point=[40.0, 2.0],
        **plant,
    )
    relay = rig.relay(amplitude=1.0, baseline=2.0, sample_period=PERIOD)
    rig.identifier(structure="")
    answer = rig.tune()
    rig.until(lambda: results.gains, "gains")
    # They come by topics of their own.
    rig.until(lambda: results.models and results.models[-1].final, "the final model")
    rig.until(lambda: "is closed with model and gains" in relay.log, "closed bag")
    return results, rig.bag(answer)


def replay(*arguments: str) -> dict[str, Any]:
    done = subprocess.run(
        [shutil.which("replay") or "replay", "--json", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    document: dict[str, Any] = json.loads(done.stdout)
    return document


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Results, Path]]:
    """Return a rig after a tune in lockstep, what its nodes said, and the bag."""
    with free_domain() as domain:
        rig = Rig(domain, tmp_path_factory.mktemp("tuned"))
        try:
            results, bag = tune_in_lockstep(rig)
            # In lockstep it would go on as fast as the processor can.
            next(each for each in rig.processes if each.name == "plant_node").end()
            yield rig, results, bag
        finally:
            rig.close()


def test_lockstep_finds_the_process_and_replays_to_the_same_digits(
    tuned: tuple[Rig, Results, Path],
) -> None:
    _, results, bag = tuned
    model, gains = results.models[-1], results.gains[-1]
    assert model.final
    assert model.gain == pytest.approx(GAIN, rel=1e-6)
    assert list(model.time_constants) == pytest.approx([TIME_CONSTANT], rel=1e-6)
    assert model.dead_time == pytest.approx(DEAD_TIME, rel=1e-6)
    experiment = results.experiments[-1]
    assert experiment.outcome == RelayExperiment.COMPLETED
    assert experiment.settings.baseline == 2.0
    assert experiment.lost_samples == 0
    ids = {m.experiment_id for m in (*results.cycles, experiment, model, gains)}
    assert ids == {bag.name}
    # No sample is missing in lockstep.
    assert list(experiment.time) == [k * PERIOD for k in range(len(experiment.time))]
    assert [c.index for c in results.cycles] == list(range(len(experiment.cycle_start) - 1))

    shown = replay(str(bag))["experiments"][-1]
    again = shown["models"][shown["selected"]]
    assert again["gain"] == model.gain
    assert again["time_constants"] == list(model.time_constants)
    assert again["dead_time"] == model.dead_time
    assert [again["std"][name] for name in model.parameters] == list(model.std)
    recommended = shown["gains"][shown["recommended"]]
    assert recommended["rule"] == gains.rule
    for name in GAIN_FIELDS:
        assert recommended[name] == getattr(gains, name), name


@pytest.mark.nightly
def test_lockstep_gives_the_same_numbers_every_time(tmp_path: Path) -> None:
    seen = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        with free_domain() as domain:
            rig = Rig(domain, folder)
            try:
                results, _ = tune_in_lockstep(rig, noise_std=0.01, seed=7)
            finally:
                rig.close()
        seen.append(results)
    first, second = seen
    for field in ("time", "measurement", "command", "cycle_start", "noise_std"):
        assert getattr(first.experiments[-1], field) == getattr(second.experiments[-1], field)
    for name in ("gain", "time_constants", "dead_time", "covariance", "ultimate_gain"):
        assert getattr(first.models[-1], name) == getattr(second.models[-1], name)
    for name in GAIN_FIELDS:
        assert getattr(first.gains[-1], name) == getattr(second.gains[-1], name)


def test_cycles_that_came_late_join_to_the_record(tuned: tuple[Rig, Results, Path]) -> None:
    rig, results, _ = tuned
    late = rig.listen("relay_cycle", RelayCycle)
    rig.until(lambda: len(late) == len(results.cycles), "latched cycles")
    whole = record_from_message(results.experiments[-1])
    joined = np.concatenate([np.array(c.measurement)[:-1] for c in late])
    assert np.array_equal(joined, whole.measurement[: joined.size])


def test_simulated_time_from_end_to_end(rig: Rig) -> None:
    results = Results(rig)
    # 4 simulated seconds and 80 samples per second.
    rig.plant(
        mode="clock",
        speed=4.0,
        sample_period=0.05,
        structure="fopdt",
        gain=2.0,
        time_constants=[1.0],
        dead_time=0.5,
    )
    rig.relay(use_sim_time=True, amplitude=1.0, baseline=0.0, hysteresis=0.05)
    rig.identifier(use_sim_time=True)
    rig.tune()
    rig.until(lambda: results.gains, "gains")
    experiment, model = results.experiments[-1], results.models[-1]
    # Times are the simulated clock's: multiples of the sample period, not of the wall.
    steps = np.diff(np.array(experiment.time)) / 0.05
    assert np.allclose(steps, np.round(steps), atol=1e-6)
    assert experiment.header.stamp.sec < 1000
    # A measurement may be handled before the /clock message of its own time.
    assert model.gain == pytest.approx(2.0, rel=0.05)
    assert model.time_constants[0] == pytest.approx(1.0, rel=0.1)
    assert model.dead_time == pytest.approx(0.5, abs=0.06)
