# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Nothing that a file declares is trusted."""

from __future__ import annotations

import os
import struct
import sys
import time
import tracemalloc

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from made_bags import REPOSITORY, START
from mcap.writer import CompressionType, Writer

from relay_autotune.bag import mcap_records, source
from relay_autotune.bag.bag_file import McapFile
from relay_autotune.bag.definitions import Channel, message_type
from relay_autotune.bag.field_path import numeric_paths
from relay_autotune.bag.topics import Topics, named_field
from relay_autotune.bag.writer import encode_float64
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.recordings import read_experiments

sys.path.insert(0, str(REPOSITORY / "benchmarks"))
fuzz_framing = pytest.importorskip("fuzz_framing")

COUNT = 400


def write(path, *, compression=CompressionType.NONE, other=0, times=None, **options):
    """Write /x in chunks of 2000 bytes, each followed by one of /other where that is asked for."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=compression, **options)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        x = writer.register_channel("/x", "cdr", schema)
        y = writer.register_channel("/other", "cdr", schema)
        for k in range(COUNT):
            stamp = START + k * 10**6 if times is None else times[k]
            writer.add_message(x, stamp, encode_float64(float(k)), stamp, k)
            if other and k % 46 == 45:
                writer.flush()
                writer.add_message(y, stamp, b"\0\1\0\0" + b"image" * other, stamp, k)
                writer.flush()
        writer.finish()
    return path


def read(path, **limits):
    """Return the values of /x, and what was said."""
    with McapFile(path, **limits) as file:
        topics = Topics(path, [file])
        signal = topics.signals(["/x"])["/x"]
        return signal.values, file.notes


def chunks(data):
    """Yield where each chunk begins."""
    at = 8
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 6:
            yield at
        at += 9 + length


def records(data, wanted):
    """Yield where each record of an opcode begins in the file."""
    at = 8
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == wanted:
            yield at
        at += 9 + length


def test_chunks_without_the_topic_are_neither_read_nor_expanded(tmp_path):
    path = write(tmp_path / "bag.mcap", compression=CompressionType.ZSTD, other=500)
    data = bytearray(path.read_bytes())
    ruined = 0
    for at in chunks(data):
        if struct.unpack_from("<Q", data, at + 9 + 16)[0] > 2200:
            data[at + 60 : at + 70] = bytes(10)
            ruined += 1
    assert ruined == COUNT // 46
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert notes == []


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_that_declares_too_much_takes_no_memory(tmp_path, compression):
    path = write(tmp_path / "bag.mcap", compression=compression)
    data = bytearray(path.read_bytes())
    second = list(chunks(data))[1]
    struct.pack_into("<Q", data, second + 9 + 16, 2**40)
    path.write_bytes(data)
    tracemalloc.start()
    values, notes = read(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 20e6
    assert 300 < values.size < COUNT
    assert "declares 1099511627776 bytes, more than the 268435456 that --max-chunk" in notes[0]


def test_a_frame_that_holds_more_than_its_chunk_declares_is_not_expanded(tmp_path):
    path = write(tmp_path / "bag.mcap", compression=CompressionType.ZSTD)
    data = path.read_bytes()
    first = next(chunks(data))
    (length,) = struct.unpack_from("<Q", data, first + 1)
    bomb = zstandard.ZstdCompressor().compress(bytes(200 << 20))
    head = data[first + 9 : first + 9 + 28] + struct.pack("<I", 4) + b"zstd"
    body = head + struct.pack("<Q", len(bomb)) + bomb
    # Behind the first chunk nothing is where the index says, so that the file is gone through.
    path.write_bytes(
        data[:first] + struct.pack("<BQ", 6, len(body)) + body + data[first + 9 + length :]
    )
    tracemalloc.start()
    values, notes = read(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 20e6
    assert COUNT - 50 < values.size < COUNT
    assert any("does not hold as many" in note for note in notes)


def test_chunks_that_together_expand_too_far_are_refused(tmp_path, monkeypatch):
    """Each chunk may be within its limit where all of them are not."""
    path = write(tmp_path / "bag.mcap", compression=CompressionType.ZSTD)
    monkeypatch.setattr(source, "MOST_EXPANSION", 0)
    monkeypatch.setattr(source, "UNSUSPICIOUS", 4000)
    with pytest.raises(BagError, match="expands to more than 4000 bytes"):
        read(path)
    monkeypatch.setattr(source, "UNSUSPICIOUS", 1 << 20)
    np.testing.assert_array_equal(read(path)[0], np.arange(COUNT))


def test_a_file_that_nothing_can_be_expanded_into_is_told(tmp_path, monkeypatch):
    """Where no temporary file could be made, that came as a defect."""
    path = write(tmp_path / "bag.mcap")
    packed = tmp_path / "bag.mcap.zstd"
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    np.testing.assert_array_equal(read(packed)[0], np.arange(COUNT))

    def refused(**_):
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr(source.tempfile, "TemporaryFile", refused)
    with pytest.raises(BagError, match=r"^cannot expand .*: No usable temporary directory found$"):
        read(packed)


def _bag_of(*records):
    """Return a bag without a summary whose one chunk, compressed, has these records too."""

    def record(opcode, body):
        return struct.pack("<BQ", opcode, len(body)) + body

    def sized(data):
        return struct.pack("<I", len(data)) + data

    schema = struct.pack("<H", 1) + sized(b"std_msgs/msg/Float64") + sized(b"ros2msg")
    declared = record(3, schema + sized(b"float64 data\n"))
    channel = struct.pack("<HH", 1, 1) + sized(b"/x") + sized(b"cdr") + sized(b"")
    content = declared + record(4, channel) + b"".join(records)
    data = zstandard.ZstdCompressor(1).compress(content)
    head = struct.pack("<QQQI", 0, 0, len(content), 0) + sized(b"zstd")
    body = head + struct.pack("<Q", len(data)) + data
    return b"\x89MCAP0\r\n" + record(6, body)


_NOTHING = struct.pack("<BQ", 0x80, 0)
_MESSAGE = struct.pack("<BQHIQQ", 5, 34, 1, 0, START, START) + encode_float64(1.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("records", "said"),
    [
        ([_NOTHING * 200_000], "with more records than messages that they can be"),
        ([_NOTHING + b"\x80\1" + bytes(8)] * 100_000, "with more records than messages"),
        ([struct.pack("<BQ", 3, 0) * 60_000, bytes(2_000_000)], "more than 50000 schemas"),
        ([_MESSAGE * 160_000], "more than 100000 messages in"),
        (
            [
                struct.pack("<BQHIQ", 3, 40_000_000, k, 4, 0) + bytes(40_000_000 - 14)
                for k in (2, 3)
            ],
            "more than 5000000 bytes of them",
        ),
    ],
    ids=["nothing", "little", "no schemas", "messages", "large schemas"],
)
def test_a_small_file_that_asks_for_much_is_refused(tmp_path, monkeypatch, records, said):
    monkeypatch.setattr(source, "MOST_MESSAGES", 100_000)
    monkeypatch.setattr(mcap_records, "MOST_DECLARED", 5_000_000)
    path = tmp_path / "a.mcap"
    path.write_bytes(_bag_of(*records))
    assert path.stat().st_size < 20_000
    size = sum(map(len, records))
    tracemalloc.start()
    with pytest.raises(BagError, match=said):
        read(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 4 * size + (4 << 20)


def test_messages_of_many_channels_take_no_longer(tmp_path):
    """Looked for one channel after the other, they took hours."""
    path = tmp_path / "a.mcap"
    others = [
        struct.pack("<BQHIQQ", 5, 34, number, 0, START, START) + encode_float64(2.0)
        for number in range(2, 60_000)
    ]
    path.write_bytes(_bag_of(*others * 4, _MESSAGE))
    begin = time.process_time()
    values, notes = read(path)
    assert time.process_time() - begin < 3.0
    assert values.tolist() == [1.0]
    assert any("channels that it does not declare" in note for note in notes)


@pytest.mark.long
def test_messages_between_records_of_no_use_take_no_longer(tmp_path):
    """All that follows was looked at for each of them: a file of 2 MB took half an hour."""
    path = tmp_path / "a.mcap"
    path.write_bytes(_bag_of() + (_MESSAGE + _NOTHING) * 3000)
    begin = time.process_time()
    values, _ = read(path)
    assert time.process_time() - begin < 4.0
    assert values.tolist() == [1.0] * 3000


def test_large_chunks_are_not_in_memory_together(tmp_path):
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        x = writer.register_channel("/x", "cdr", schema)
        for k in range(8):
            writer.add_message(x, START + k, encode_float64(float(k)) + bytes(10 << 20), START)
        writer.finish()
    tracemalloc.start()
    values, _ = read(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(values, np.arange(8))
    # The one before is held until the next one has been expanded.
    assert most < 25 << 20


def test_a_message_index_that_leads_elsewhere_is_not_believed(tmp_path):
    path = write(tmp_path / "bag.mcap")
    data = bytearray(path.read_bytes())
    indexes = list(records(data, 7))
    # Out of the chunk; to the middle of a message; to another channel; twice to one message.
    struct.pack_into("<Q", data, indexes[0] + 15 + 8, 2**50)
    struct.pack_into("<Q", data, indexes[1] + 15 + 8, 5)
    struct.pack_into("<H", data, indexes[2] + 9, 77)
    struct.pack_into("<Q", data, indexes[3] + 15 + 8 + 16, 0)
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert len(notes) == 4
    assert all("has a bad message index" in note for note in notes)


@pytest.mark.parametrize("what", ["offset", "length", "index", "overlap"])
def test_a_chunk_index_that_leads_elsewhere_is_not_believed(tmp_path, what):
    path = write(tmp_path / "bag.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    index = list(records(data, 8))
    place = index[2] + 9
    if what == "offset":
        struct.pack_into("<Q", data, place + 16, 2**62)
    elif what == "length":
        struct.pack_into("<Q", data, place + 24, 2**64 - 1)
    elif what == "index":
        struct.pack_into("<Q", data, place + 32 + 4 + 2, 2**60)
    else:
        data[place + 16 : place + 32] = data[index[1] + 25 : index[1] + 41]
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert notes == []


def test_a_checksum_that_is_wrong_costs_its_chunk_alone(tmp_path):
    path = write(tmp_path / "bag.mcap")
    data = bytearray(path.read_bytes())
    data[next(chunks(data)) + 100] ^= 1
    path.write_bytes(data)
    values, notes = read(path)
    assert 300 < values.size < COUNT
    assert "the checksum of a chunk is wrong" in notes[0]


def test_the_faults_of_a_file_that_was_cut_are_not_all_listed(tmp_path, monkeypatch):
    monkeypatch.setattr(source, "MOST_NOTES", 3)
    path = write(tmp_path / "bag.mcap", other=1)
    data = bytearray(path.read_bytes())
    _, *damaged = chunks(data)
    assert len(damaged) > 5
    for at in damaged:
        data[at + 100] ^= 1
    path.write_bytes(data[:-20])
    _, notes = read(path)
    assert len(notes) == 5
    assert "has more faults, which are not listed" in notes[-2]
    assert "unfinished recording" in notes[-1]


def test_times_beyond_every_clock(tmp_path):
    times = [2**64 - 1 - k for k in range(COUNT)]
    values, _ = read(write(tmp_path / "bag.mcap", times=times))
    assert values.size == COUNT


def test_times_that_go_backwards_are_put_in_order(tmp_path):
    times = [START + (k ^ 1) * 10**6 for k in range(COUNT)]
    path = write(tmp_path / "bag.mcap", times=times)
    values, _ = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT) ^ 1)


def test_a_file_that_shrinks_while_it_is_read(tmp_path):
    path = write(tmp_path / "bag.mcap")
    with McapFile(path) as file:
        with path.open("r+b") as other:
            other.truncate(5000)
        found = Topics(path, [file]).signals(["/x"])["/x"]
        assert 0 < len(found) < COUNT
        assert file.notes


def without_summary(data):
    """Return a file whose footer tells of no summary, so that it is gone through."""
    foot = len(data) - 8 - 20
    assert data[foot - 9] == 2
    return data[:foot] + bytes(20) + data[foot + 20 :]


@pytest.mark.long
@given(
    turns=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 60)), min_size=1, max_size=80),
    chunk_size=st.sampled_from((1, 90, 700, 10**6)),
    compression=st.sampled_from(list(CompressionType)),
    wanted=st.sets(st.sampled_from(("/a", "/b", "/c")), min_size=1),
)
@settings(max_examples=60, deadline=None)
def test_the_index_and_the_chunks_say_the_same(
    tmp_path_factory, turns, chunk_size, compression, wanted
):
    path = tmp_path_factory.mktemp("index") / "bag.mcap"
    names = ("/a", "/b", "/c")
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, compression=compression)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        ids = [writer.register_channel(name, "cdr", schema) for name in names]
        for k, (which, more) in enumerate(turns):
            data = encode_float64(float(k)) + bytes(more)
            writer.add_message(ids[which], START + k, data, START + k)
        writer.finish()
    cut = path.with_name("cut.mcap")
    cut.write_bytes(without_summary(path.read_bytes()))
    for file in (path, cut):
        with McapFile(file) as opened:
            topics = Topics(file, [opened])
            found = topics.signals(sorted(wanted & set(topics.types())))
            assert opened.notes == []
        for name, signal in found.items():
            expected = [float(k) for k, (which, _) in enumerate(turns) if names[which] == name]
            assert signal.values.tolist() == expected


@pytest.mark.parametrize(
    ("place", "form", "value"),
    [
        (1, "<Q", 10),  # a record too short for what it holds
        (25, "<Q", 4),  # a chunk within the magic
        (25, "<Q", 2**64 - 60),  # start and length that together seem small
        (33, "<Q", 9),  # no room for a chunk
        (41, "<I", 2**32 - 1),  # a list beyond the record
        (41, "<I", 7),  # one that ends within an entry
        (47, "<Q", 8),  # a message index before its chunk
        (55, "<Q", 2**64 - 2),  # message indexes beyond the data
    ],
)
def test_a_chunk_index_out_of_bounds_sends_through_the_file(tmp_path, place, form, value):
    path = write(tmp_path / "bag.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    index = list(records(data, 8))[1]
    # One channel in each chunk.
    assert struct.unpack_from("<I", data, index + 41) == (10,)
    struct.pack_into(form, data, index + place, value)
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert notes == []


def test_message_indexes_of_other_topics_are_not_read(tmp_path):
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        ids = [writer.register_channel(name, "cdr", schema) for name in ("/y", "/x", "/z")]
        for k in range(COUNT):
            for channel in ids:
                writer.add_message(channel, START + k, encode_float64(float(k)), START + k)
        writer.finish()
    data = bytearray(path.read_bytes())
    for at in records(data, 7):
        if struct.unpack_from("<H", data, at + 9)[0] != ids[1]:
            data[at + 15 : at + 30] = bytes(range(15))
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert notes == []


# --- valid framing that lies inside it


@pytest.mark.long
@pytest.mark.parametrize("part", range(4))
def test_bags_that_lie(tmp_path, part):
    seeds = fuzz_framing.seeds_once()
    path = tmp_path / "bag.mcap"
    for number in range(60 * part, 60 * (part + 1)):
        path.write_bytes(fuzz_framing.made(number, seeds))
        said = fuzz_framing.judge(path, number)
        assert said in ("read", "read, with a note", "refused"), number


@pytest.mark.parametrize("left", [0, 10])
def test_messages_that_an_index_leaves_out_are_read_all_the_same(tmp_path, left):
    path = write(tmp_path / "bag.mcap")
    data = bytearray(path.read_bytes())
    for at in records(data, 7):
        struct.pack_into("<I", data, at + 11, 16 * left)
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert any("has a bad message index" in note and f"it lists {left}" in note for note in notes)


def test_an_index_of_another_channel_hides_nothing(tmp_path):
    path = write(tmp_path / "bag.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    second = list(records(data, 7))[1]
    (channel,) = struct.unpack_from("<H", data, second + 9)
    struct.pack_into("<H", data, second + 9, channel + 1)
    # The index at the end says so as well, so that its chunk would be left alone.
    chunk_index = list(records(data, 8))[1]
    struct.pack_into("<H", data, chunk_index + 45, channel + 1)
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert any("has a bad message index" in note for note in notes)


def test_a_message_that_is_listed_twice_hides_no_other(tmp_path):
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
        ids = [writer.register_channel(name, "cdr", schema) for name in ("/x", "/other")]
        # The first chunk has the declarations, too, and is too large to be joined to the next one.
        writer.add_message(ids[0], START, encode_float64(0.0) + bytes(1 << 20), START)
        writer.flush()
        for channel in ids:
            writer.add_message(channel, START, encode_float64(1.0), START)
        writer.finish()
    data = bytearray(path.read_bytes())
    # What lists the message of /x now lists that of the other, which has as many bytes.
    *_, of_x, of_other = records(data, 7)
    data[of_x : of_x + 31] = data[of_other : of_other + 31]
    path.write_bytes(data)
    values, notes = read(path)
    assert values.tolist() == [0.0, 1.0]
    assert any("has a bad message index" in note for note in notes)


def test_statistics_that_differ_are_said(tmp_path):
    path = write(tmp_path / "bag.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, next(records(data, 11)) + 9 + 48, COUNT - 7)
    path.write_bytes(data)
    values, notes = read(path)
    assert values.size == COUNT
    assert notes == [f"bag.mcap says that it has {COUNT - 7} messages of /x; it has {COUNT}"]


def test_a_summary_that_names_a_channel_differently_is_said(tmp_path):
    path = write(tmp_path / "bag.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    at = data.rindex(b"/other")
    data[at : at + 6] = b"/OTHER"
    path.write_bytes(data)
    _, notes = read(path)
    assert any("bag.mcap contradicts itself: channel 2" in note for note in notes)


def test_a_type_that_the_summary_lacks_is_found_among_the_data(tmp_path):
    path = write(tmp_path / "bag.mcap", enable_crcs=False)
    data = bytearray(path.read_bytes())
    *_, in_summary = records(data, 3)
    struct.pack_into("<H", data, in_summary + 9, 9)
    path.write_bytes(data)
    values, notes = read(path)
    np.testing.assert_array_equal(values, np.arange(COUNT))
    assert notes == []


def channel(text, encoding="ros2msg"):
    """Return a channel of a type x_msgs/msg/T of a definition."""
    return Channel(1, "/t", "x_msgs/msg/T", "cdr", encoding, text.encode())


def doubling(depth, last):
    """Return a definition in which each type holds the next one twice."""
    parts = ["x_msgs/A0 header\nx_msgs/A0 b\n"]
    for k in range(depth):
        inner = f"x_msgs/A{k + 1}" if k + 1 < depth else last
        parts.append(f"{'=' * 80}\nMSG: x_msgs/A{k}\n{inner} a\n{inner} b\n")
    return "".join(parts)


def test_types_that_double_are_gone_through_once():
    assert list(numeric_paths(message_type(channel(doubling(38, "string"))))) == []
    root = message_type(channel(doubling(38, "float64")))
    with pytest.raises(SelectionError, match=r"name one, as in /t:b\.a\.a"):
        named_field(root, "", "/t")
    with pytest.raises(SelectionError, match="'header' of /t is not a number"):
        named_field(root, "header", "/t")


@pytest.mark.parametrize(
    "text",
    [
        "const long A = " + "(" * 500 + "1" + ")" * 500 + ";",
        "module a { " * 500,
        "struct S { " + "sequence<" * 500 + "double" + ">" * 500 + " data; };",
        "@a(" * 500,
        '@a("\x1b',
    ],
)
def test_definitions_in_idl_that_nest_without_end(text):
    with pytest.raises(BagError, match=r"makes no sense|is missing"):
        message_type(channel(text, "ros2idl"))


@pytest.mark.parametrize("name", ["bag.mcap", "log.csv"])
def test_a_pipe_or_a_device_is_no_recording(tmp_path, name):
    pipe = tmp_path / name
    os.mkfifo(pipe)
    with pytest.raises(BagError, match="is no regular file"):
        read_experiments(pipe)
    pipe.unlink()
    pipe.symlink_to("/dev/zero")
    with pytest.raises(BagError, match="is no regular file"):
        read_experiments(pipe)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("t,y,u\n0,1,2\n1,2,3,4\n", "line 3: 4 cells, but 3 columns"),
        ("t,y,y\n0,1,2\n1,2,3\n", "2 columns named 'y'"),
    ],
)
def test_a_csv_whose_lines_do_not_fit_its_header(tmp_path, text, complaint):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(BagError, match=complaint):
        read_experiments(path)
