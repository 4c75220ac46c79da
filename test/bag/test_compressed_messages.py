# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Bags whose messages were compressed one by one (`ros2 bag record --compression-mode message`).

The library rosbags writes such directories too, with their metadata.yaml, independently of rosbag2
and of what is tested.
"""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import zstandard
from made_bags import (
    START,
    assert_same_record,
    definition,
    experiment_message,
    relay_record,
    serialize,
    write_samples,
)
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from relay_autotune.bag.bag_file import McapFile
from relay_autotune.bag.definitions import EXPERIMENT, Definition
from relay_autotune.bag.topics import Topics
from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.errors import BagError
from relay_autotune.recordings import read_experiments

COUNT = 200


def write_with_rosbags(path, *, mode=CompressionMode.MESSAGE):
    """Write /x as 0, 1, 2 ... and /w, a square wave."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Float64"
    bag = RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        topics = [bag.add_connection(name, kind, typestore=store) for name in ("/x", "/w")]
        for k in range(COUNT):
            for topic, value in zip(topics, (float(k), float(k // 20 % 2)), strict=True):
                data = store.serialize_cdr(store.types[kind](data=value), kind)
                bag.write(topic, START + k * 10**8, data)
    return path


def compress_again(source, path):
    """Write the messages of an MCAP file, each of them compressed, and no footer."""
    squeeze = zstandard.ZstdCompressor(level=1).compress
    with source.open("rb") as old, path.open("wb") as new:
        reader, writer = make_reader(old), Writer(new)
        writer.start("ros2", "test")
        for about in reader.iter_metadata():
            writer.add_metadata(about.name, about.metadata)
        ids = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in ids:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(channel.topic, "cdr", kind)
            times = (message.log_time, message.publish_time)
            writer.add_message(ids[channel.id], times[0], squeeze(message.data), times[1])
        writer.flush()
    return path


def write_payload(path, payload):
    """Write serialized messages on /x."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        x = writer.register_channel("/x", "cdr", schema)
        for k, data in enumerate(payload):
            writer.add_message(x, START + k, data, START + k)
        writer.finish()
    return path


def read(path, **limits):
    """Return the values of /x, and what was said."""
    with McapFile(path, **limits) as file:
        return Topics(path, [file]).signals(["/x"])["/x"].values, file.notes


def test_a_directory_that_rosbags_wrote(tmp_path):
    bag = write_with_rosbags(tmp_path / "bag")
    assert "compression_mode: message" in (bag / "metadata.yaml").read_text().lower()
    found = read_experiments(bag)
    plain = write_with_rosbags(tmp_path / "plain", mode=CompressionMode.NONE)
    for record, expected in zip(
        found.experiments, read_experiments(plain).experiments, strict=True
    ):
        assert_same_record(record, expected)
    values, notes = read(next(bag.glob("*.mcap")))
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert notes == []


def test_an_experiment_and_what_is_left_of_one_that_was_cut_short(tmp_path):
    """Messages of several topics keep their order, by which an answer follows its sample."""
    facts = {"experiment_id": "run-1", "measurement": "/measurement", "command": "/command"}
    record, text = relay_record(), definition(EXPERIMENT, tmp_path).text
    topics = [Topic("/measurement"), Topic("/command")]
    own = Topic("/relay_experiment", EXPERIMENT, definition=Definition(text))
    for name, whole in (("whole", True), ("cut", False)):
        chosen = [*topics, own] if whole else topics
        with BagWriter(tmp_path / name, chosen, start_ns=START, custom=facts) as bag:
            write_samples(bag, record)
            if whole:
                data = serialize(EXPERIMENT, text, experiment_message(record))
                bag.write(own.name, START + 10**11, START + 10**11, data)
        path = tmp_path / f"{name}.mcap"
        compress_again(tmp_path / name / f"{name}_0.mcap", path)
        (found,) = read_experiments(path).experiments
        assert_same_record(found, record, stamps=0.0 if whole else 1e-9)
        assert ("ends without the experiment's end" in found.reason) is not whole


def test_one_that_declares_too_much_takes_no_memory(tmp_path):
    squeeze = zstandard.ZstdCompressor().compress
    bomb = squeeze(bytes(200 << 20))
    path = write_payload(tmp_path / "bag.mcap", [squeeze(encode_float64(1.0)), bomb])
    tracemalloc.start()
    values, notes = read(path, largest_chunk=1 << 20)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 20e6
    assert values.tolist() == [1.0]
    (note,) = notes
    assert "compressed messages of /x that cannot be expanded" in note
    assert (
        f"it declares {200 << 20} bytes, more than the {1 << 20} that --max-chunk allows" in note
    )


@pytest.mark.long
def test_many_large_ones_are_not_in_memory_together(tmp_path):
    squeeze = zstandard.ZstdCompressor().compress
    large = [squeeze(encode_float64(float(k)) + bytes(10 << 20)) for k in range(30)]
    path = write_payload(tmp_path / "bag.mcap", large)
    tracemalloc.start()
    values, notes = read(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 80e6
    assert (values.tolist(), notes) == ([float(k) for k in range(30)], [])


def test_frames_of_nonsense_are_left_out_and_said(tmp_path):
    squeeze = zstandard.ZstdCompressor().compress
    whole = squeeze(encode_float64(1.0))
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(12))
    nonsense = [whole[:4], whole[:-3], whole[:5] + b"\xff" * 9, streamed, squeeze(b"")]
    path = write_payload(tmp_path / "bag.mcap", [whole, *nonsense, encode_float64(2.0), whole])
    values, notes = read(path)
    assert values.tolist() == [1.0, 2.0, 1.0]
    assert len(notes) == 1


def test_another_compression_is_told(tmp_path):
    path = write_payload(tmp_path / "bag.mcap", [b"\x78\x9c" + bytes(20)])
    with pytest.raises(BagError, match="compressed one by one, and not by zstd, convert the bag"):
        read(path)
