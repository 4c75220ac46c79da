# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""What BagWriter writes, read by others' readers."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import yaml
from made_bags import REPOSITORY, START, definition
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from relay_autotune.bag import writer as writer_module
from relay_autotune.bag.definitions import Definition, find_definition
from relay_autotune.bag.writer import BagWriter, Qos, Topic, encode_float64
from relay_autotune.errors import BagError
from relay_autotune.recordings import read_experiments

FLOAT64 = "std_msgs/msg/Float64"


def fill(path, count=100, **options):
    latched = Qos(durability="transient_local", depth=7)
    topics = [Topic("/measurement"), Topic("/command", qos=latched)]
    with BagWriter(path, topics, start_ns=START, **options) as bag:
        for k in range(count):
            stamp = START + k * 1_000_000
            bag.write("/measurement", stamp + 500, stamp, encode_float64(k / 7.0))
            bag.write("/command", stamp + 900, stamp + 900, encode_float64(-k / 7.0))
            if k % 30 == 29:
                bag.flush()


def test_rosbags_reads_what_was_written(tmp_path):
    fill(tmp_path / "bag")
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 200
        values = {"/measurement": [], "/command": []}
        for connection, log_time, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            values[connection.topic].append((log_time, message.data))
        qos = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
        digests = {c.digest for c in reader.connections}
    assert values["/measurement"] == [(START + k * 1_000_000 + 500, k / 7.0) for k in range(100)]
    assert values["/command"] == [(START + k * 1_000_000 + 900, -k / 7.0) for k in range(100)]
    assert qos["/command"].durability.name == "TRANSIENT_LOCAL"
    assert qos["/command"].depth == 7
    assert qos["/measurement"].reliability.name == "RELIABLE"
    assert digests == {store.hash_rihs01(FLOAT64)}


def test_mcap_reads_what_was_written(tmp_path):
    fill(tmp_path / "bag", custom={"experiment_id": "x"})
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        found = [
            (channel.topic, message.publish_time, schema.name, schema.encoding)
            for schema, channel, message in reader.iter_messages()
        ]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        channels = reader.get_summary().channels.values()
    assert len(found) == 200
    assert found[0] == ("/measurement", START, FLOAT64, "ros2msg")
    assert metadata["relay_autotune"] == {"experiment_id": "x"}
    inner = yaml.safe_load(metadata["rosbag2"]["serialized_metadata"])
    assert inner["message_count"] == 200
    for channel in channels:
        assert channel.message_encoding == "cdr"
        (profile,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
        assert profile["history"] == "keep_last"
        assert channel.metadata["topic_type_hash"].startswith("RIHS01_")


def test_metadata_is_version_9(tmp_path):
    fill(tmp_path / "bag", custom={"who's": 'said "so": #1'})
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == ["bag_0.mcap"]
    assert information["starting_time"]["nanoseconds_since_epoch"] == START + 500
    assert information["duration"]["nanoseconds"] == 99 * 1_000_000 + 400
    assert information["custom_data"] == {"who's": 'said "so": #1'}
    topics = information["topics_with_message_count"]
    assert [t["message_count"] for t in topics] == [100, 100]
    (profile,) = topics[1]["topic_metadata"]["offered_qos_profiles"]
    assert profile["durability"] == "transient_local"
    assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    assert "&" not in text
    assert not list((tmp_path / "bag").glob("*.tmp"))


def test_metadata_is_there_from_the_start(tmp_path):
    bag = BagWriter(tmp_path / "bag", [Topic("/m")], start_ns=START)
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    assert information["rosbag2_bagfile_information"]["relative_file_paths"] == ["bag_0.mcap"]
    bag.close()


def test_nothing_is_overwritten(tmp_path):
    fill(tmp_path / "bag")
    before = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    with pytest.raises(BagError, match="exists already, not overwriting"):
        BagWriter(tmp_path / "bag", [Topic("/m")], start_ns=START)
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes() == before


def test_a_folder_that_cannot_be_made_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match=r"cannot make the bag .*: Not a directory"):
        BagWriter(tmp_path / "file" / "bag", [Topic("/m")], start_ns=START)


def test_an_unknown_topic_and_a_closed_bag_are_refused(tmp_path):
    bag = BagWriter(tmp_path / "bag", [Topic("/m")], start_ns=START)
    with pytest.raises(BagError, match=r"/x is not a topic of the bag .* which has /m"):
        bag.write("/x", 1, 1, b"")
    bag.close()
    bag.close()
    with pytest.raises(BagError, match="closed already"):
        bag.write("/m", 1, 1, b"")


def test_a_definition_that_is_not_installed_is_said(tmp_path):
    with pytest.raises(BagError, match=r"definition of no_msgs/msg/Thing is not installed"):
        BagWriter(tmp_path / "bag", [Topic("/m", "no_msgs/msg/Thing")], start_ns=START)
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize("part", [0, 1, 5000])
def test_a_full_disk_costs_only_what_was_not_flushed(tmp_path, monkeypatch, part):
    bag = BagWriter(tmp_path / "bag", [Topic("/measurement"), Topic("/command")], start_ns=START)
    for k in range(100):
        bag.write("/measurement", START + k, START + k, encode_float64(k % 11))
        bag.write("/command", START + k, START + k, encode_float64(k % 2))
    bag.flush()
    room = [part]
    write = os.write

    def full(file, data):
        if not room[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        size = min(room[0], len(data))
        room[0] -= size
        return write(file, data[:size])

    monkeypatch.setattr(writer_module.os, "write", full)
    for k in range(1000):
        bag.write("/command", START + k, START + k, encode_float64(k))
    with pytest.raises(BagError, match=r"has stopped: No space left on device; what was written"):
        bag.flush()
    with pytest.raises(BagError, match="No space left"):
        bag.write("/command", START, START, encode_float64(0.0))
    bag.close()
    monkeypatch.undo()
    record = read_experiments(tmp_path / "bag").experiments[0]
    np.testing.assert_array_equal(record.measurement, np.arange(100) % 11)


def test_a_disk_that_fills_at_the_end_is_said(tmp_path, monkeypatch):
    bag = BagWriter(tmp_path / "bag", [Topic("/m")], start_ns=START)
    bag.write("/m", START, START, encode_float64(1.0))
    bag.flush()

    def full(file, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer_module.os, "write", full)
    with pytest.raises(BagError, match="No space left on device"):
        bag.close()
    bag.close()


KILLED = """
import os, signal
from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
bag = BagWriter({path!r}, [Topic("/measurement"), Topic("/command")], start_ns={start})
for k in range(5000):
    stamp = {start} + k * 1_000_000
    bag.write("/measurement", stamp, stamp, encode_float64(float(k % 13)))
    bag.write("/command", stamp, stamp, encode_float64(float(k // 100 % 2)))
    if k == 3999:
        bag.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_writer_leaves_all_that_was_flushed(tmp_path):
    code = KILLED.format(path=str(tmp_path / "bag"), start=START)
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=60)
    assert done.returncode == -signal.SIGKILL
    assert (tmp_path / "bag" / "metadata.yaml").exists()
    recording = read_experiments(tmp_path / "bag")
    assert len(recording.experiments[0]) == 4000
    assert "unfinished recording" in recording.notes[0]
    assert "8000 messages until 3.999 s" in recording.notes[0]


def test_definitions_come_with_all_they_need(tmp_path):
    text = definition("relay_autotune_msgs/msg/RelayExperiment", tmp_path).text
    blocks = text.split("=" * 80 + "\nMSG: ")
    assert [block.splitlines()[0] for block in blocks[1:]] == [
        "std_msgs/msg/Header",
        "relay_autotune_msgs/msg/Reason",
        "relay_autotune_msgs/msg/RelaySettings",
        "builtin_interfaces/msg/Time",
    ]


def test_constants_comments_and_bounds_are_no_dependencies(tmp_path):
    folder = tmp_path / "share" / "a_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "A.msg").write_text(
        "# Other comment\nuint8 LIMIT=3\nstring<=4[<=2] names\nB[<=3] parts # C c\nfloat64[2] x\n"
    )
    (folder / "B.msg").write_text("bool ok\n")
    found = find_definition("a_msgs/msg/A", [tmp_path])
    assert found.text.count("MSG: ") == 1
    assert found.type_hash == ""


def test_float64_is_known_without_any_package(tmp_path):
    assert "float64 data" in find_definition(FLOAT64, [tmp_path]).text
    assert find_definition(FLOAT64, [tmp_path]).type_hash == get_typestore(
        Stores.ROS2_JAZZY
    ).hash_rihs01(FLOAT64)


def test_a_definition_can_be_given(tmp_path):
    own = Definition("float64 x\n", "RIHS01_" + "0" * 64)
    with BagWriter(
        tmp_path / "bag", [Topic("/x", "x_msgs/msg/X", definition=own)], start_ns=START
    ) as bag:
        bag.write("/x", START, START, encode_float64(1.5))
    with Reader(tmp_path / "bag") as reader:
        assert reader.connections[0].msgdef.data == "float64 x\n"
