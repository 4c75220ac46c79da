# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The bags of the folder bags/ stay readable, and say what they have always said."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from analysed import analysed_once
from made_bags import REPOSITORY, assert_same_record
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

from relay_autotune.bag.bag_file import McapFile
from relay_autotune.bag.signals import Selection
from relay_autotune.bag.topics import Topics
from relay_autotune.record.record import Outcome, Record, RelaySettings
from relay_autotune.recordings import interrupted_experiment, read_experiments
from relay_autotune.tuning import design
from relay_autotune.tuning.task import DesignTask

BAGS = REPOSITORY / "bags"

# The samples of each bag: their number, and a digest of time, measurement and command.
SAMPLES = {
    "biased_relay": (919, "ec873ee2098494cf"),
    "unbiased_relay_with_noise": (969, "314460789292e882"),
    "step_test": (1200, "ab0ef164b9298a82"),
}
# What gain, time constant and dead time were said to be, and the process that it was.
FOUND = {
    "biased_relay": ((1.65, 20.0, 10.0), (1.65, 20.0, 10.0), 1e-9),
    "unbiased_relay_with_noise": (
        (1.6511267145672335, 20.03995370112971, 9.992946014401884),
        (1.65, 20.0, 10.0),
        0.01,
    ),
    "step_test": (
        (0.8000692971171547, 12.000770343349572, 3.4053020768756235),
        (0.8, 12.0, 3.4),
        0.01,
    ),
}


def the_record(name: str) -> Record:
    (record,) = read_experiments(BAGS / name).experiments
    return record


def live_result(name: str, type_name: str) -> object:
    """Return the last message of a type, by the definition in the bag."""
    (path,) = (BAGS / name).glob("*.mcap")
    with McapFile(path) as file:
        return Topics(path, [file]).decoded(type_name)[-1]


@pytest.mark.parametrize("name", SAMPLES)
def test_the_samples_are_those_that_were_recorded(name):
    record = the_record(name)
    digest = hashlib.sha256()
    for column in (record.time, record.measurement, record.command):
        digest.update(column.astype("<f8").tobytes())
    assert (len(record), digest.hexdigest()[:16]) == SAMPLES[name]


@pytest.mark.long
@pytest.mark.parametrize("name", FOUND)
def test_the_process_is_found_again(name):
    said, true, tolerance = FOUND[name]
    model = analysed_once(the_record(name), alone=True).model
    np.testing.assert_allclose(model.values, said, rtol=1e-6)
    np.testing.assert_allclose(model.values, true, rtol=tolerance)


@pytest.mark.parametrize("name", ["biased_relay", "unbiased_relay_with_noise"])
def test_replay_says_what_the_live_identifier_said(name):
    gains = live_result(name, "relay_autotune_msgs/msg/PidGains")
    found = analysed_once(the_record(name), alone=True)
    model = live_result(name, "relay_autotune_msgs/msg/TransferFunction")
    assert list(model.parameters) == list(found.model.parameters)
    np.testing.assert_allclose(
        [model.gain, *model.time_constants, model.dead_time, model.ultimate_gain],
        [*found.model.values, found.model.ultimate_gain],
        rtol=1e-9,
    )
    # The default rule of that day, which did not count the sampling as dead time.
    again = design(DesignTask(model=found.model.model), gains.rule)
    for field in ("kc", "ti", "p", "i"):
        assert getattr(gains, field) == pytest.approx(getattr(again, field), rel=1e-9)


@pytest.mark.parametrize("name", ["biased_relay", "unbiased_relay_with_noise"])
def test_the_samples_alone_tell_the_experiment(name):
    """So does a bag of a killed node, which lacks the record at the end."""
    expected = the_record(name)
    (path,) = (BAGS / name).glob("*.mcap")
    with McapFile(path) as file:
        (found,) = interrupted_experiment(Topics(BAGS / name, [file]))
    assert_same_record(found, expected, stamps=1e-12)
    assert found.settings == expected.settings
    assert found.cycle_start == expected.cycle_start
    assert found.start == expected.start


def test_settings_and_outcome_of_the_biased_relay():
    record = the_record("biased_relay")
    assert record.settings == RelaySettings(40.0, 2.0, 1.0, bias=0.3, sample_period=0.2)
    assert record.outcome == Outcome.COMPLETED
    assert record.cycle_start == (390, 566, 742, 918)
    assert record.experiment_id
    assert record.lost_samples == 0


def test_the_step_test_is_found_without_naming_its_topics():
    recording = read_experiments(BAGS / "step_test")
    assert "--measurement /reactor/temperature --command /reactor/heater" in recording.notes[0]
    (record,) = recording.experiments
    np.testing.assert_array_equal(record.input().values, [45.0, 38.0])
    assert record.settings is None


@pytest.mark.parametrize("bag", sorted(p.parent for p in BAGS.glob("*/metadata.yaml")))
def test_others_can_read_them(bag: Path):
    with Reader(bag) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert reader.message_count == sum(counts.values())
        assert min(counts.values()) > 0
        assert all(c.msgdef.data for c in reader.connections)


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.STORAGE])
def test_a_users_own_recording_of_the_loop_replays_too(tmp_path, mode):
    """Written by another program, in another namespace, beside other topics."""
    name = "unbiased_relay_with_noise"
    writer = Writer(tmp_path / "mine", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with Reader(BAGS / name) as reader, writer:
        to = {
            c.id: writer.add_connection(
                f"/tank{c.topic}", c.msgtype, msgdef=c.msgdef.data, rihs01=c.digest
            )
            for c in reader.connections
        }
        for connection, log_time, data in reader.messages():
            writer.write(to[connection.id], log_time, data)
    (found,) = read_experiments(tmp_path / "mine").experiments
    assert_same_record(found, the_record(name))
    pair = Selection("/tank/measurement", "/tank/command")
    (alone,) = read_experiments(tmp_path / "mine", pair).experiments
    # The command goes back at the last sample, behind which there is no response.
    np.testing.assert_array_equal(alone.measurement, found.measurement[:-1])
    assert alone.settings is None
