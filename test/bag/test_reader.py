# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Experiments read back from bags of every condition."""

from __future__ import annotations

import contextlib
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_bags import (
    REPOSITORY,
    START,
    assert_same_record,
    definition,
    experiment_message,
    relay_record,
    serialize,
    write_pair,
    write_samples,
)
from mcap.writer import CompressionType, Writer

from relay_autotune.bag.definitions import CYCLE, EXPERIMENT, Definition, installed_prefixes
from relay_autotune.bag.reader import read
from relay_autotune.bag.signals import Selection
from relay_autotune.bag.writer import BagWriter, Topic, encode_float64
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.record.record import Outcome, Record
from relay_autotune.recordings import DEFAULTS, read_experiments, read_records

FACTS = {"experiment_id": "run-1", "measurement": "/measurement", "command": "/command"}
LOOP = [Topic("/measurement"), Topic("/command")]


def write_experiments(path, folder, *records, topic="/relay_experiment", text=None):
    """Write records as RelayExperiment messages, by today's or another definition."""
    text = text or definition(EXPERIMENT, folder).text
    topics = [*LOOP, Topic(topic, EXPERIMENT, definition=Definition(text))]
    with BagWriter(path, topics, start_ns=START, custom=FACTS) as bag:
        for number, record in enumerate(records):
            write_samples(bag, record)
            data = serialize(EXPERIMENT, text, experiment_message(record))
            stamp = START + (number + 1) * 10**11
            bag.write(topic, stamp, stamp, data)


def test_a_recorded_experiment_comes_back_whole(tmp_path):
    record = relay_record()
    write_experiments(tmp_path / "bag", tmp_path, record)
    (found,) = read_experiments(tmp_path / "bag").experiments
    assert_same_record(found, record)
    for name in ("settings", "cycle_start", "outcome", "reason", "experiment_id", "noise_std"):
        assert getattr(found, name) == getattr(record, name)
    assert found.start == record.start


def test_the_topic_may_have_any_name_and_repeats_count_once(tmp_path):
    record = relay_record()
    write_experiments(tmp_path / "bag", tmp_path, record, record, topic="/plant/a/finished")
    assert len(read_experiments(tmp_path / "bag").experiments) == 1


def test_several_experiments_in_one_bag(tmp_path):
    records = [relay_record(experiment_id=name) for name in ("a", "b", "c")]
    write_experiments(tmp_path / "bag", tmp_path, *records)
    found = read_experiments(tmp_path / "bag").experiments
    assert [record.experiment_id for record in found] == ["a", "b", "c"]


def test_an_experiment_without_samples_is_said(tmp_path):
    empty = experiment_message(relay_record())
    empty.time = empty.measurement = empty.command = []
    empty.receive_time = empty.command_time = []
    empty.cycle_start, empty.reason = [], "no measurement arrived"
    text = definition(EXPERIMENT, tmp_path).text
    topics = [Topic("/relay_experiment", EXPERIMENT, definition=Definition(text))]
    with BagWriter(tmp_path / "bag", topics, start_ns=START) as bag:
        bag.write("/relay_experiment", START, START, serialize(EXPERIMENT, text, empty))
    with pytest.raises(BagError, match=r"at least one sample.*no measurement arrived"):
        read_experiments(tmp_path / "bag")


def test_an_old_bag_whose_experiment_lacks_fields(tmp_path):
    record = relay_record()
    text = definition(EXPERIMENT, tmp_path).text
    old = "".join(
        line
        for line in text.splitlines(keepends=True)
        if not line.startswith(("uint32 lost_samples", "float64 noise_std", "bool reverse_acting"))
    )
    assert old.count("\n") == text.count("\n") - 3
    write_experiments(tmp_path / "bag", tmp_path, record, text=old)
    (found,) = read_experiments(tmp_path / "bag").experiments
    assert_same_record(found, record)
    assert np.isnan(found.noise_std)
    assert found.lost_samples == 0
    assert found.settings == record.settings


def test_a_bag_of_tomorrow_whose_experiment_has_more_fields(tmp_path):
    record = relay_record()
    text = definition(EXPERIMENT, tmp_path).text
    new = text.replace("string reason", "float64[] disturbance\nstring site\nstring reason", 1)
    message = experiment_message(record)
    message.disturbance, message.site = [1.0, 2.0], "elsewhere"
    topics = [Topic("/x", EXPERIMENT, definition=Definition(new))]
    with BagWriter(tmp_path / "bag", topics, start_ns=START) as bag:
        bag.write("/x", START, START, serialize(EXPERIMENT, new, message))
    (found,) = read_experiments(tmp_path / "bag").experiments
    assert_same_record(found, record)


@pytest.mark.parametrize("type_name", [EXPERIMENT, CYCLE])
def test_every_field_of_today_has_a_default(tmp_path, type_name):
    """Who adds a field to the message must say what it means where it is missing."""
    from rosbags.typesys import get_types_from_msg

    types = get_types_from_msg(definition(type_name, tmp_path).text, type_name)

    def names(of_type, defaults):
        assert {name for name, _ in types[of_type][1]} == set(defaults)
        for name, (kind, what) in types[of_type][1]:
            if kind.name == "NAME" and what in types:
                names(what, defaults[name])

    names(type_name, DEFAULTS[type_name])


def test_an_experiment_whose_definition_is_in_idl(tmp_path):
    """A recorder that has the IDL files alone writes these into the bag."""
    record = relay_record()
    ours = ("RelayExperiment", "RelaySettings", "Reason")
    names = [f"relay_autotune_msgs/msg/{name}" for name in ours]
    names += ["std_msgs/msg/Header", "builtin_interfaces/msg/Time"]
    files = [prefix / "share" / f"{n}.idl" for n in names for prefix in installed_prefixes()]
    found = [f"{'=' * 80}\nIDL: {f.stem}\n{f.read_text()}" for f in files if f.exists()]
    text = definition(EXPERIMENT, tmp_path).text
    data = serialize(EXPERIMENT, text, experiment_message(record))
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema(EXPERIMENT, "ros2idl", "".join(found).encode())
        channel = writer.register_channel("/relay_experiment", "cdr", schema)
        writer.add_message(channel, START, bytes(data), START)
        writer.finish()
    assert_same_record(read_experiments(tmp_path / "bag.mcap").experiments[0], record)


def test_a_definition_of_nonsense_is_a_sentence(tmp_path):
    record = relay_record()
    text = definition(EXPERIMENT, tmp_path).text
    data = serialize(EXPERIMENT, text, experiment_message(record))
    for wrong in ("float64 ( x", "no_msgs/Nothing thing\n", "float64[] time\n"):
        shutil.rmtree(tmp_path / "bag", ignore_errors=True)
        topics = [Topic("/x", EXPERIMENT, definition=Definition(wrong))]
        with BagWriter(tmp_path / "bag", topics, start_ns=START) as bag:
            bag.write("/x", START, START, data)
        with pytest.raises(BagError, match=r"makes no sense|does not fit its definition"):
            read_experiments(tmp_path / "bag")


@pytest.mark.parametrize("extra", [1, 8, 12])
def test_bytes_after_a_message_do_not_matter(tmp_path, extra):
    """ROS 2 serializes empty sequences with room for elements that are not there."""
    record = relay_record()
    text = definition(EXPERIMENT, tmp_path).text
    data = serialize(EXPERIMENT, text, experiment_message(record)) + bytes(extra)
    topics = [Topic("/x", EXPERIMENT, definition=Definition(text))]
    with BagWriter(tmp_path / "bag", topics, start_ns=START) as bag:
        bag.write("/x", START, START, data)
    assert_same_record(read_experiments(tmp_path / "bag").experiments[0], record)


@pytest.mark.parametrize("missing", [1, 4, 100, 5000])
def test_a_message_that_is_cut_is_a_sentence(tmp_path, missing):
    text = definition(EXPERIMENT, tmp_path).text
    data = serialize(EXPERIMENT, text, experiment_message(relay_record()))[:-missing]
    topics = [Topic("/x", EXPERIMENT, definition=Definition(text))]
    with BagWriter(tmp_path / "bag", topics, start_ns=START) as bag:
        bag.write("/x", START, START, data)
    with pytest.raises(BagError, match="does not fit its definition"):
        read_experiments(tmp_path / "bag")


# --- recordings that were cut short


def write_cut(path, folder, record, *, with_cycle=True):
    """Write what relay_node had written when it was killed."""
    text = definition(CYCLE, folder).text
    topics = [*LOOP, Topic("/relay_cycle", CYCLE, definition=Definition(text))]
    bag = BagWriter(path, topics, start_ns=START, custom=FACTS)
    write_samples(bag, record)
    if with_cycle:
        message = SimpleNamespace(**DEFAULTS[CYCLE])
        message.header = experiment_message(record).header
        message.settings = experiment_message(record).settings
        bag.write("/relay_cycle", START, START, serialize(CYCLE, text, message))
    bag.flush()
    return bag


@pytest.mark.parametrize("finished", [True, False])
def test_an_experiment_without_its_end_is_rebuilt(tmp_path, finished):
    record = relay_record()
    bag = write_cut(tmp_path / "bag", tmp_path, record)
    if finished:
        bag.close()
    (found,) = read_experiments(tmp_path / "bag").experiments
    assert_same_record(found, record, stamps=1e-9)
    assert found.settings == record.settings
    assert found.outcome == Outcome.ABORTED
    assert found.reason.startswith("the recording ends without the experiment's end (after 39.9")
    assert found.experiment_id == "run-1"
    assert found.start == pytest.approx(record.start, abs=1e-6)


def test_a_rebuilt_record_has_the_input_that_the_process_saw(tmp_path):
    record = relay_record()
    write_cut(tmp_path / "bag", tmp_path, record)
    (found,) = read_experiments(tmp_path / "bag").experiments
    np.testing.assert_allclose(found.input().times, record.input().times, atol=3e-9)
    np.testing.assert_array_equal(found.input().values, record.input().values)


def test_without_a_cycle_there_are_no_settings(tmp_path):
    write_cut(tmp_path / "bag", tmp_path, relay_record(), with_cycle=False)
    (found,) = read_experiments(tmp_path / "bag").experiments
    assert found.settings is None
    assert found.outcome == Outcome.ABORTED


def test_a_sample_without_its_answer_is_left_out(tmp_path):
    record = relay_record(50)
    with BagWriter(tmp_path / "bag", LOOP, start_ns=START, custom=FACTS) as bag:
        write_samples(bag, record)
        late = START + 5_000_000_000
        bag.write("/measurement", late, late, encode_float64(1.0))
    (found,) = read_experiments(tmp_path / "bag").experiments
    assert_same_record(found, record, stamps=1e-9)


def test_a_bag_cut_before_the_first_sample(tmp_path):
    BagWriter(tmp_path / "bag", LOOP, start_ns=START, custom=FACTS)
    with pytest.raises(BagError, match="holds no topic; unfinished recording"):
        read_experiments(tmp_path / "bag")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("compression", "step"),
    [
        (CompressionType.ZSTD, 3),
        (CompressionType.ZSTD, 1),
        (CompressionType.LZ4, 1),
        (CompressionType.NONE, 1),
    ],
)
def test_torn_anywhere_it_gives_what_came_before_or_a_sentence(tmp_path, compression, step):
    whole = tmp_path / "whole.mcap"
    record = relay_record(8)
    with whole.open("wb") as file:
        writer = Writer(file, chunk_size=150, compression=compression)
        writer.start("ros2", "test")
        writer.add_metadata("relay_autotune", FACTS)
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        ids = [writer.register_channel(t.name, "cdr", schema) for t in LOOP]
        for t, y, u in zip(record.time, record.measurement, record.command, strict=True):
            stamp = START + round(t * 1e9)
            for channel, value in zip(ids, (y, u), strict=True):
                writer.add_message(channel, stamp, encode_float64(value), stamp)
        writer.finish()
    data = whole.read_bytes()
    torn = tmp_path / "torn.mcap"
    longest = 0
    torn.touch()
    for size in (*range(0, len(data), step), len(data)):
        # Some bytes more: a file that is written anew each time waits for the disk.
        with torn.open("ab") as file:
            file.write(data[torn.stat().st_size : size])
        try:
            recording = read_experiments(torn)
        except BagError as error:
            assert "\n" not in str(error)
            assert longest == 0, "a longer file gave less"
            continue
        (found,) = recording.experiments
        assert len(found) >= longest
        longest = len(found)
        np.testing.assert_array_equal(found.measurement, record.measurement[:longest])
        np.testing.assert_array_equal(found.command, record.command[:longest])
        if size < len(data):
            assert any("unfinished recording" in note for note in recording.notes), size
    assert longest == 8


def test_torn_without_chunks(tmp_path):
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        ids = [writer.register_channel(t.name, "cdr", schema) for t in LOOP]
        for k in range(200):
            for channel, value in zip(ids, (k % 17, k // 20 % 2), strict=True):
                writer.add_message(channel, k + 1, encode_float64(float(value)), k + 1)
        writer.finish()
    data = path.read_bytes()
    (found,) = read_experiments(path).experiments
    assert len(found) == 200
    end = data.rindex(encode_float64(float(199 % 17)))
    path.write_bytes(data[: end + 5])
    recording = read_experiments(path)
    assert len(recording.experiments[0]) == 199
    assert "398 messages" in recording.notes[0]


def test_zeros_at_the_end_are_a_tear(tmp_path):
    write_cut(tmp_path / "bag", tmp_path, relay_record())
    path = tmp_path / "bag" / "bag_0.mcap"
    path.write_bytes(path.read_bytes() + bytes(4096))
    assert len(read_experiments(tmp_path / "bag").experiments[0]) == 400


def test_a_damaged_chunk_is_left_out_and_said(tmp_path):
    k = np.arange(300)
    with BagWriter(tmp_path / "bag", LOOP, start_ns=START) as bag:
        for i in k:
            stamp = START + int(i) * 10**9
            bag.write("/measurement", stamp, stamp, encode_float64(float(i % 19)))
            bag.write("/command", stamp, stamp, encode_float64(float(i // 30 % 2)))
            if i % 100 == 99:
                bag.flush()
    path = tmp_path / "bag" / "bag_0.mcap"
    data = bytearray(path.read_bytes())
    data[data.index(encode_float64(150 % 19), data.index(encode_float64(18.0)) + 9000) + 5] ^= 255
    path.write_bytes(data)
    recording = read_experiments(tmp_path / "bag")
    # Nobody knows when the command changed in it, so that an experiment ends there.
    assert sum(map(len, recording.experiments)) == 200
    assert any("is damaged at byte" in n and "checksum" in n for n in recording.notes)


@pytest.mark.long
@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_flipped_bytes_never_break_the_reader(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("flipped") / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=300, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        ids = [writer.register_channel(t.name, "cdr", schema, {"a": "b"}) for t in LOOP]
        for k in range(20):
            for channel in ids:
                writer.add_message(channel, k + 1, encode_float64(float(k % 5)), k + 1)
        writer.finish()
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    with contextlib.suppress(BagError):
        read_experiments(path)


# --- files that are something else


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", r"is empty \(0 bytes\)"),
        (b"\x89MCA", "holds only the first 4 bytes of an MCAP file"),
        (b"\x89MCAP0\r\n", "holds no topic; unfinished recording"),
        (b"hello, world, this is text", r"not an MCAP file: it begins with b'hello, w'"),
        (b"SQLite format 3\0" + bytes(100), "not an MCAP file: it is an SQLite file"),
        (b"#ROSBAG V2.0\n", "a ROS 1 bag"),
        (b"PK\x03\x04\x14\0", "a zip archive, as workbooks are; save the table as CSV"),
        (b"MATLAB 5.0 MAT-file", "a MATLAB file; save time, measurement and command as CSV"),
        (b"\x28\xb5\x2f\xfd0000000", r"is not a recording: bag\.mcap cannot be expanded"),
    ],
)
def test_a_file_that_is_no_recording(tmp_path, content, sentence):
    (tmp_path / "bag.mcap").write_bytes(content)
    with pytest.raises(BagError, match=sentence):
        read_experiments(tmp_path / "bag.mcap")


def test_a_recording_that_is_not_there(tmp_path):
    with pytest.raises(BagError, match=r"nowhere does not exist; expected a recording"):
        read_experiments(tmp_path / "nowhere")


def test_directories_without_a_bag(tmp_path):
    with pytest.raises(BagError, match=r" is empty; expected a rosbag2 directory"):
        read_experiments(tmp_path)
    (tmp_path / "notes.txt").write_bytes(b"")
    with pytest.raises(BagError, match=r"holds no \.mcap or \.db3 file, but notes\.txt; "):
        read_experiments(tmp_path)
    (tmp_path / "old_0.db3").write_bytes(b"")
    with pytest.raises(BagError, match=r"old_0\.db3 is empty"):
        read_experiments(tmp_path)


def test_metadata_may_be_missing_or_stale(tmp_path):
    write_experiments(tmp_path / "bag", tmp_path, relay_record())
    (tmp_path / "bag" / "metadata.yaml").write_text("relative_file_paths: [/etc/passwd]\n")
    assert len(read_experiments(tmp_path / "bag").experiments) == 1
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert len(read_experiments(tmp_path / "bag").experiments) == 1


def test_split_files_are_one_recording(tmp_path):
    parts = [tmp_path / f"part{i}" for i in range(11)]
    for i, part in enumerate(parts):
        times = [i * 10.0 + k for k in range(10)]
        write_pair(part, [(t, t % 7.0) for t in times], [(i * 10.0 + 3.5, float(i % 2))])
    (tmp_path / "bag").mkdir()
    for i, part in enumerate(parts):
        shutil.copy(part / f"part{i}_0.mcap", tmp_path / "bag" / f"bag_{i}.mcap")
    (found,) = read_experiments(tmp_path / "bag").experiments
    # What came before the first command answers nothing.
    np.testing.assert_array_equal(found.measurement, np.arange(3.0, 110.0) % 7.0)


# --- recordings of others


def held(times, values, at):
    """Return the command in force at some times, by definition."""
    return np.array([values[np.flatnonzero(times <= t)[-1]] for t in at])


@pytest.mark.nightly
@given(data=st.data())
@settings(max_examples=80, deadline=None)
def test_the_input_of_a_foreign_pair_equals_its_commands(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    instants = st.lists(st.integers(0, 10**10), min_size=12, max_size=60, unique=True)
    t = np.array(sorted(data.draw(instants)), dtype=np.int64)
    c = np.array(sorted(data.draw(instants)), dtype=np.int64)
    y = np.arange(t.size) % 5 * 1.5
    u = np.array(data.draw(st.lists(st.integers(0, 3), min_size=c.size, max_size=c.size)), float)
    if c[0] > t[-1] or np.all(u == u[0]):
        return
    write_pair(
        folder / "bag",
        list(zip(t / 1e9, y, strict=True)),
        list(zip(c / 1e9, u, strict=True)),
    )
    everything = Selection("/measurement", "/command", start=0.0)
    (found,) = read_experiments(folder / "bag", everything).experiments
    origin = round(found.start * 1e9 - START)
    seen = found.input()
    middles = (c[:-1] + c[1:]) / 2
    at = np.append(middles, c[-1] + 1.0)
    np.testing.assert_array_equal(seen((at - t[-len(found)]) / 1e9), held(c, u, at))
    assert found.time[0] == 0.0
    assert abs(origin - t[-len(found)]) < 1000
    # The answer of a sample is what holds when the next one is taken.
    later = t[-len(found) :][1:] - 1
    np.testing.assert_array_equal(found.command[:-1], held(c, u, np.maximum(later, c[0])))


def test_one_answer_for_each_sample_needs_no_other_input(tmp_path):
    samples = [(k * 0.1, float(k % 9)) for k in range(100)]
    answers = [(k * 0.1 + 0.003, float(k // 10 % 2)) for k in range(100)]
    write_pair(tmp_path / "bag", samples, answers)
    (found,) = read_experiments(tmp_path / "bag").experiments
    assert found.held_input is None
    np.testing.assert_allclose(found.input().times, np.arange(1, 10) + 0.003, atol=1e-9)


def test_commands_before_the_first_sample_are_known(tmp_path):
    samples = [(10.0 + k * 0.1, float(k % 9)) for k in range(100)]
    write_pair(tmp_path / "bag", samples, [(0.0, 1.0), (4.0, 2.0), (12.0, 3.0)])
    (found,) = read_experiments(tmp_path / "bag").experiments
    np.testing.assert_allclose(found.input().times, [-6.0, 2.0])
    assert found.input().initial == 1.0


def test_the_chosen_pair_is_named_with_its_reason(tmp_path):
    samples = [(k * 0.1, float(k % 29)) for k in range(100)]
    write_pair(tmp_path / "bag", samples, [(0.0, 1.0), (5.0, 2.0)], ("/tank/level", "/tank/valve"))
    note, *_ = read_experiments(tmp_path / "bag").notes
    assert note == (
        "using --measurement /tank/level --command /tank/valve: /tank/level varies over 29 "
        "values in 100 messages; /tank/valve two levels, 1 switches in 2 messages"
    )


def write_many(path, topics):
    with BagWriter(path, [Topic(name) for name in topics], start_ns=START) as bag:
        for name, values in topics.items():
            for k, value in enumerate(values):
                stamp = START + k * 10**8
                bag.write(name, stamp, stamp, encode_float64(float(value)))


RAMP = [k % 31 for k in range(100)]
SQUARE = [k // 10 % 2 for k in range(100)]


def test_a_pair_in_one_namespace_outdoes_one_across_two(tmp_path):
    write_many(tmp_path / "bag", {"/a/x": RAMP, "/a/w": SQUARE, "/b/z": RAMP})
    (note,) = read_experiments(tmp_path / "bag").notes
    assert note.startswith("using --measurement /a/x --command /a/w")


def test_set_points_and_a_controllers_wishes_are_no_command(tmp_path):
    write_many(
        tmp_path / "bag",
        {
            "/measurement": RAMP,
            "/command": SQUARE,
            "/setpoint": SQUARE,
            "/controller_command": SQUARE,
        },
    )
    assert len(read_experiments(tmp_path / "bag").notes) == 1


def test_two_pairs_are_listed_and_none_is_chosen(tmp_path):
    write_many(tmp_path / "bag", {"/temperature": RAMP, "/heater_1": SQUARE, "/heater_2": SQUARE})
    with pytest.raises(SelectionError) as caught:
        read_experiments(tmp_path / "bag")
    lines = str(caught.value).splitlines()
    assert "2 pairs of topics" in lines[0]
    assert [line.split("  # ")[0].strip() for line in lines[1:]] == [
        "--measurement /temperature --command /heater_1",
        "--measurement /temperature --command /heater_2",
    ]
    found = read_experiments(tmp_path / "bag", Selection(command="/heater_2"))
    assert "--measurement /temperature --command /heater_2" in found.notes[0]


def test_no_pair_lists_the_topics_with_what_they_look_like(tmp_path):
    write_many(tmp_path / "bag", {"/a": RAMP, "/c": [5.0] * 20})
    with pytest.raises(
        SelectionError, match=r"no pair of topics .*/c \(std_msgs/msg/Float64, con"
    ):
        read_experiments(tmp_path / "bag")


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        ("/temperature", r"2 pairs .*\n.*--command /b .*\n.*--command /c "),
        ("/a", r"4 pairs .*/b \(std_msgs/msg/Float64, varies .*; name two with"),
    ],
)
def test_what_steps_may_be_the_set_point_of_a_command_that_varies(tmp_path, measured, said):
    # The names do not tell which of two is the command, and a set-point gives a model of the loop.
    write_many(tmp_path / "bag", {measured: RAMP, "/b": RAMP[::-1], "/c": [1.0] * 30 + [2.0] * 60})
    with pytest.raises(SelectionError, match=said):
        read_experiments(tmp_path / "bag")


def test_a_topic_that_is_not_there_lists_those_that_are(tmp_path):
    write_many(tmp_path / "bag", {"/a": RAMP, "/b": SQUARE})
    with pytest.raises(
        SelectionError, match=r"no topic '/x' for the measurement; it has /a \(std"
    ):
        read_experiments(tmp_path / "bag", Selection("/x", "/b"))


def test_another_type_is_refused_by_name(tmp_path):
    own = Definition("string x\n")
    with BagWriter(
        tmp_path / "bag", [Topic("/x", "x_msgs/msg/X", definition=own), *LOOP], start_ns=START
    ) as bag:
        bag.write("/x", START, START, encode_float64(1.0))
    with pytest.raises(SelectionError, match="/x is of type x_msgs/msg/X, which holds no num"):
        read_experiments(tmp_path / "bag", Selection("/x", "/command"))


def test_the_same_topic_twice_is_refused(tmp_path):
    write_many(tmp_path / "bag", {"/a": RAMP})
    with pytest.raises(SelectionError, match="named as measurement and as command"):
        read_experiments(tmp_path / "bag", Selection("/a", "a:data"))


@pytest.mark.parametrize(
    ("measurement", "command", "sentence"),
    [
        ([3.0] * 50, SQUARE, r"the measurement /y is constant \(3 in all of 50 values\)"),
        (RAMP, [2.0] * 9, r"the command /u never changes \(2 in all of 9 values\)"),
        ([*RAMP, float("nan")], SQUARE, r"the measurement /y is nan at 10 s \(1 of 101"),
        (RAMP, [0.0, float("inf")], r"the command /u is inf at 0.1 s"),
        ([*RAMP, -1e300], SQUARE, r"the measurement /y is -1e\+300 at 10 s .*beyond 1e\+100"),
        ([], SQUARE, "the measurement /y holds no value"),
    ],
)
def test_signals_from_which_nothing_can_be_learnt(tmp_path, measurement, command, sentence):
    write_many(tmp_path / "bag", {"/y": measurement, "/u": command, "/other": RAMP})
    with pytest.raises(BagError, match=sentence):
        read_experiments(tmp_path / "bag", Selection("/y", "/u"))


def test_recordings_of_different_times_do_not_make_a_pair(tmp_path):
    write_pair(
        tmp_path / "bag", [(float(k), k % 7) for k in range(50)], [(100.0, 1.0), (101.0, 2.0)]
    )
    with pytest.raises(BagError, match=r"begins 51 s after the last sample"):
        read_experiments(tmp_path / "bag", Selection("/measurement", "/command"))


def test_clocks_that_disagree_are_aligned_by_the_recorder(tmp_path):
    with BagWriter(tmp_path / "bag", LOOP, start_ns=START) as bag:
        for k in range(100):
            log = START + k * 10**8
            bag.write("/measurement", log, log - 5 * 10**9, encode_float64(float(k % 29)))
            bag.write("/command", log + 10**6, log + 10**6, encode_float64(float(k // 10 % 2)))
    recording = read_experiments(tmp_path / "bag")
    np.testing.assert_allclose(
        recording.experiments[0].input().times, np.arange(1, 10) + 0.001, atol=1e-9
    )
    assert "differ by 5.000 s" in recording.notes[1]


def test_publish_times_that_go_backwards_give_way_to_log_times(tmp_path):
    with BagWriter(tmp_path / "bag", LOOP, start_ns=START) as bag:
        for k in range(100):
            log = START + k * 10**8
            bag.write("/measurement", log, log - k // 50 * 10**10, encode_float64(float(k % 29)))
            bag.write("/command", log, 0, encode_float64(float(k // 10 % 2)))
    recording = read_experiments(tmp_path / "bag")
    np.testing.assert_allclose(recording.experiments[0].time, np.arange(100) * 0.1)
    assert "publish times of /measurement go backwards" in recording.notes[1]


def test_big_endian_values(tmp_path):
    with BagWriter(tmp_path / "bag", LOOP, start_ns=START) as bag:
        for k in range(100):
            stamp = START + k * 10**8
            big = b"\x00\x00\x00\x00" + np.array([k % 29], dtype=">f8").tobytes()
            bag.write("/measurement", stamp, stamp, big)
            bag.write("/command", stamp, stamp, encode_float64(float(k // 10 % 2)))
    (found,) = read_experiments(tmp_path / "bag").experiments
    np.testing.assert_array_equal(found.measurement, np.arange(100) % 29)


@pytest.mark.parametrize("data", [b"", b"\x00\x01\x00\x00", b"\x00\x09\x00\x00" + bytes(8)])
def test_values_that_are_no_float64(tmp_path, data):
    with BagWriter(tmp_path / "bag", LOOP, start_ns=START) as bag:
        bag.write("/measurement", START, START, data)
    with pytest.raises(BagError, match="none of the 1 messages of /measurement fits"):
        read_experiments(tmp_path / "bag", Selection("/measurement", "/command"))


# --- a part of a recording


def test_a_window_keeps_the_history_of_the_command(tmp_path):
    samples = [(k * 0.1, float(k % 29)) for k in range(100)]
    write_pair(tmp_path / "bag", samples, [(0.0, 1.0), (2.0, 2.0), (5.0, 3.0)])
    part = Selection(start=3.0, end=6.0)
    (found,) = read_experiments(tmp_path / "bag", part).experiments
    assert len(found) == 31
    assert found.time[0] == 0.0
    np.testing.assert_allclose(found.input().times, [-1.0, 2.0], atol=1e-9)
    assert found.start == pytest.approx((START + 3 * 10**9) / 1e9)


def test_a_window_of_an_experiment_keeps_its_cycles(tmp_path):
    write_experiments(tmp_path / "bag", tmp_path, relay_record())
    (found,) = read_experiments(tmp_path / "bag", Selection(start=7.95)).experiments
    assert isinstance(found, Record)
    assert found.cycle_start == (0, 80, 160, 240)


def test_a_window_without_samples_is_refused(tmp_path):
    write_many(tmp_path / "bag", {"/measurement": RAMP, "/command": SQUARE})
    with pytest.raises(SelectionError, match=r"no sample lies between --start 50 s.*9\.9 s long"):
        read_experiments(tmp_path / "bag", Selection(start=50.0))


def test_one_function_reads_columns_of_a_bag_and_of_a_text():
    folder, text = REPOSITORY / "bags" / "step_test", REPOSITORY / "bags" / "heater.csv"
    y, u = "/reactor/temperature", "/reactor/heater"
    (record,) = read_records(folder, measurement=y, command=u)
    found = read(folder, [y], clock="publish")[y]
    np.testing.assert_array_equal(found.values[-len(record) :], record.measurement)
    assert set(read(folder)) == {y, u}
    columns = read(text)
    (log,) = read_records(text)
    y, u = columns
    np.testing.assert_allclose(columns[y].time_ns / 1e9, log.time + columns[y].time_ns[0] / 1e9)
    np.testing.assert_array_equal(columns[y].values, log.measurement)
    np.testing.assert_array_equal(read(text, [u])[u].values, columns[u].values)
    with pytest.raises(SelectionError, match="has no column 'nothing'"):
        read(text, ["nothing"])
    for meant in ("temperature", y[4:9]):
        with pytest.raises(SelectionError, match=re.escape(f"did you mean {y!r}?")):
            read(text, [meant])


@pytest.mark.parametrize("given", [None, 3, [], [None], b"log.csv"])
def test_what_is_no_path_gets_a_sentence(given):
    for function in (read, read_records):
        with pytest.raises(BagError, match="is read from its path, a text, found"):
            function(given)


def test_the_readme_of_the_reader_runs(capsys, monkeypatch):
    page = (REPOSITORY / "relay_autotune" / "bag" / "README.md").read_text()
    monkeypatch.chdir(REPOSITORY)
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(code, {})
    assert capsys.readouterr().out.startswith("[")
