# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Numbers of any message type, compared with the serialization of rosbags."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from relay_autotune.bag.bag_file import McapFile
from relay_autotune.bag.cdr import Decoder
from relay_autotune.bag.definitions import (
    Channel,
    installed_prefixes,
    message_type,
    types_from_ros2msg,
)
from relay_autotune.bag.field_path import Number, Repeated, Text, numeric_paths
from relay_autotune.bag.topics import Topics, named_field, only_field
from relay_autotune.errors import BagError, SelectionError

STAMP = 1_790_000_000_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)


def write(path, type_name, definition, payloads, *, encoding="ros2msg", **options):
    """Write messages of one type to /topic, one each millisecond."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2", "test")
        schema = writer.register_schema(type_name, encoding, definition.encode())
        channel = writer.register_channel("/topic", "cdr", schema)
        for k, data in enumerate(payloads):
            stamp = STAMP + k * 10**6
            writer.add_message(channel, stamp + 77, bytes(data), stamp, k)
        writer.finish()
    return path


def read(path, name, clock="publish"):
    """Return a signal with the notes about it."""
    with McapFile(path) as file:
        signal = Topics(path, [file], clock).signals([name])[name]
        return signal, (*signal.notes, *file.notes)


def made(type_name, *messages):
    """Return the definition that rosbag2 would store, and the messages serialized."""
    text, _ = STORE.generate_msgdef(type_name, ros_version=2)
    return text, [STORE.serialize_cdr(message, type_name) for message in messages]


def ros(type_name, *values):
    return STORE.types[type_name](*values)


def header(k, frame="base"):
    return ros("std_msgs/msg/Header", ros("builtin_interfaces/msg/Time", 1000 + k, 5 + k), frame)


def imu(k, frame="imu"):
    vector = lambda *v: ros("geometry_msgs/msg/Vector3", *map(float, v))  # noqa: E731
    covariance = np.arange(9.0) + k
    return ros(
        "sensor_msgs/msg/Imu",
        header(k, frame),
        ros("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
        covariance,
        vector(k, 2, 3),
        covariance,
        vector(4, 5 * k, 6),
        covariance,
    )


@pytest.mark.parametrize("frames", [["imu"], ["a", "bcd", "", "efghi"]])
def test_a_component_of_a_vector_behind_a_header(tmp_path, frames):
    text, data = made("sensor_msgs/msg/Imu", *(imu(k, frames[k % len(frames)]) for k in range(40)))
    path = write(tmp_path / "bag.mcap", "sensor_msgs/msg/Imu", text, data)
    signal, notes = read(path, "/topic:linear_acceleration.y")
    np.testing.assert_array_equal(signal.values, 5.0 * np.arange(40))
    np.testing.assert_array_equal(signal.time_ns, STAMP + np.arange(40) * 10**6)
    assert notes == ()
    signal, _ = read(path, "/topic:orientation_covariance[3]")
    np.testing.assert_array_equal(signal.values, 3.0 + np.arange(40))


def test_the_three_clocks(tmp_path):
    text, data = made("sensor_msgs/msg/Imu", *map(imu, range(5)))
    path = write(tmp_path / "bag.mcap", "sensor_msgs/msg/Imu", text, data)
    name, k = "/topic:angular_velocity.x", np.arange(5)
    assert read(path, name)[0].time_ns.tolist() == (STAMP + k * 10**6).tolist()
    assert read(path, name, "log")[0].time_ns.tolist() == (STAMP + k * 10**6 + 77).tolist()
    stamped = (1000 + k) * 10**9 + 5 + k
    assert read(path, name, "header")[0].time_ns.tolist() == stamped.tolist()


def test_a_topic_without_a_header_keeps_its_publish_times(tmp_path):
    text, data = made("std_msgs/msg/Float64", ros("std_msgs/msg/Float64", 1.0))
    path = write(tmp_path / "bag.mcap", "std_msgs/msg/Float64", text, data)
    signal, notes = read(path, "/topic", "header")
    assert signal.time_ns.tolist() == [STAMP]
    assert notes == (
        "the messages of /topic have no header; the times at which they were published are used "
        "instead",
    )


def test_an_element_of_a_sequence_behind_strings(tmp_path):
    name = "x_msgs/msg/Labelled"
    text = "std_msgs/Header header\nstring[] labels\nfloat64[] position\nfloat64[] velocity\n"
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, name))
    labels = [["a"], ["left", "right_wheel"], [], ["x", "yy", "zzz"]]
    messages = [
        store.types[name](
            header(k),
            labels[k % 4],
            np.arange(len(labels[k % 4])) + 10.0 * k,
            np.arange(k % 3) - 1.0 * k,
        )
        for k in range(40)
    ]
    data = [store.serialize_cdr(message, name) for message in messages]
    path = write(tmp_path / "bag.mcap", name, store.generate_msgdef(name)[0], data)
    for field in ("position", "velocity"):
        for index in (0, 1):
            signal, notes = read(path, f"/topic:{field}[{index}]")
            expected = [(k, getattr(m, field)) for k, m in enumerate(messages)]
            expected = [(k, v[index]) for k, v in expected if v.size > index]
            np.testing.assert_array_equal(signal.values, [v for _, v in expected])
            np.testing.assert_array_equal(signal.time_ns, [STAMP + k * 10**6 for k, _ in expected])
            assert f"{40 - len(expected)} of 40 messages" in notes[0]


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("Float64", [1.5, -2.5e300]),
        ("Float32", [1.5, -2.25]),
        ("Bool", [True, False]),
        ("Byte", [0, 100]),
        ("Char", [0, 255]),
        *((f"Int{n}", [-(2 ** (n - 1)), 2 ** (n - 1) - 1]) for n in (8, 16, 32, 64)),
        *((f"UInt{n}", [0, 2**n - 1]) for n in (8, 16, 32, 64)),
    ],
)
def test_every_single_number(tmp_path, name, values):
    full = f"std_msgs/msg/{name}"
    text, data = made(full, *(ros(full, value) for value in values))
    path = write(tmp_path / "bag.mcap", full, text, data)
    signal, _ = read(path, "/topic")
    np.testing.assert_array_equal(signal.values, [float(v) for v in values])
    big = [STORE.serialize_cdr(ros(full, v), full, little_endian=False) for v in values]
    path = write(tmp_path / "mixed.mcap", full, text, [*data, *big])
    np.testing.assert_array_equal(read(path, "/topic")[0].values, [float(v) for v in values * 2])


def test_a_temperature_needs_no_field(tmp_path):
    full = "sensor_msgs/msg/Temperature"
    text, data = made(full, *(ros(full, header(k), 20.0 + k, 0.1) for k in range(3)))
    path = write(tmp_path / "bag.mcap", full, text, data)
    np.testing.assert_array_equal(read(path, "/topic")[0].values, [20.0, 21.0, 22.0])
    np.testing.assert_array_equal(read(path, "/topic:variance")[0].values, [0.1] * 3)
    with McapFile(path) as file:
        topics = Topics(path, [file])
        assert topics.single_numbers() == ["/topic"]
        assert (topics.unit("/topic"), topics.unit("/topic:variance")) == ("°C", "")


IDL = """================================================================================
IDL: x_msgs/msg/Reading
#include "x_msgs/msg/Inner.idl"
module x_msgs {
  module msg {
    struct Reading {
      string name;
      x_msgs::msg::Inner inner;
      sequence<float> list;
      double last;
    };
  };
};
================================================================================
IDL: x_msgs/msg/Inner
module x_msgs {
  module msg {
    typedef short short__3[3];
    struct Inner {
      boolean on;
      short__3 three;
    };
  };
};
"""


def test_definitions_in_idl(tmp_path):
    store = get_typestore(Stores.EMPTY)
    msg = "string name\nx_msgs/Inner inner\nfloat32[] list\nfloat64 last\n"
    store.register(get_types_from_msg(msg, "x_msgs/msg/Reading"))
    store.register(get_types_from_msg("bool on\nint16[3] three\n", "x_msgs/msg/Inner"))
    reading, inner = (store.types[f"x_msgs/msg/{n}"] for n in ("Reading", "Inner"))
    data = [
        store.serialize_cdr(
            reading(
                "n" * k,
                inner(bool(k % 2), np.array([k, -k, 7], np.int16)),
                np.arange(k, dtype=np.float32),
                0.5 * k,
            ),
            "x_msgs/msg/Reading",
        )
        for k in range(20)
    ]
    path = write(tmp_path / "bag.mcap", "x_msgs/msg/Reading", IDL, data, encoding="ros2idl")
    k = np.arange(20)
    for field, expected in (("inner.on", k % 2), ("inner.three[1]", -k), ("last", 0.5 * k)):
        np.testing.assert_array_equal(read(path, f"/topic:{field}")[0].values, expected)


def test_the_definitions_that_ros_generates_in_idl(tmp_path):
    names = ["sensor_msgs/msg/Imu", "std_msgs/msg/Header", "builtin_interfaces/msg/Time"]
    names += ["geometry_msgs/msg/Quaternion", "geometry_msgs/msg/Vector3"]
    files = [
        next(
            p / "share" / f"{n}.idl"
            for p in installed_prefixes()
            if (p / "share" / f"{n}.idl").exists()
        )
        for n in names
    ]
    text = "".join(
        f"{'=' * 80}\nIDL: {n}\n{path.read_text()}" for n, path in zip(names, files, strict=True)
    )
    _, data = made("sensor_msgs/msg/Imu", *map(imu, range(9)))
    path = write(tmp_path / "bag.mcap", "sensor_msgs/msg/Imu", text, data, encoding="ros2idl")
    signal, _ = read(path, "/topic:linear_acceleration.y")
    np.testing.assert_array_equal(signal.values, 5.0 * np.arange(9))


# --- any type at all


BASES = ("bool", "int8", "uint16", "int32", "uint64", "float32", "float64", "string")


@st.composite
def definitions(draw):
    """Return a definition of T, and of I within it."""
    forms = st.sampled_from(["{0} {1}", "{0}[] {1}", "{0}[3] {1}", "{0}[<=4] {1}"])
    inner = [(draw(forms), draw(st.sampled_from(BASES))) for _ in range(draw(st.integers(1, 4)))]
    outer = [
        (draw(forms), draw(st.sampled_from((*BASES, "x_msgs/I"))))
        for _ in range(draw(st.integers(1, 6)))
    ]
    texts = [
        "".join(form.format(base, f"f{k}") + "\n" for k, (form, base) in enumerate(fields))
        for fields in (outer, inner)
    ]
    return f"{texts[0]}{'=' * 80}\nMSG: x_msgs/I\n{texts[1]}"


def random_value(rng, store, kind, what):
    if kind.name == "NAME":
        return random_message(rng, store, what)
    if kind.name == "BASE":
        name = what[0]
        if name == "string":
            return "é" * int(rng.integers(0, 5))
        if name == "bool":
            return bool(rng.integers(0, 2))
        number = np.frombuffer(rng.bytes(8), dtype=name)[0]
        return number.item() if np.isfinite(number) else 0.0
    (item_kind, item), count = what
    count = count if kind.name == "ARRAY" else int(rng.integers(0, 4))
    items = [random_value(rng, store, item_kind, item) for _ in range(count)]
    if item_kind.name == "BASE" and item[0] != "string":
        return np.array(items, dtype=item[0])
    return items


def random_message(rng, store, type_name):
    fields = store.fielddefs[type_name][1]
    values = [random_value(rng, store, kind, what) for _, (kind, what) in fields]
    return store.types[type_name](*values)


def at_path(message, path):
    """Return what a path leads to; None where a sequence ends before."""
    for step in path.replace("[0]", ".0").strip(".").split("."):
        if step == "0":
            if len(message) == 0:
                return None
            message = message[0]
        else:
            message = getattr(message, step)
    return float(message)


@pytest.mark.long
@given(text=definitions(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_every_number_of_any_type(text, seed):
    rng = np.random.default_rng(seed)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "x_msgs/msg/T"))
    messages = [random_message(rng, store, "x_msgs/msg/T") for _ in range(8)]
    data = [
        bytes(store.serialize_cdr(m, "x_msgs/msg/T", little_endian=bool(rng.integers(0, 2))))
        for m in messages
    ]
    root = message_type(channel("x_msgs/msg/T", text))
    content = b"head of a record" + b"".join(data)
    begin = 16 + np.cumsum([0, *map(len, data)])
    for path in numeric_paths(root):
        values, good = named_field(root, path, "/t").read(content, begin[:-1], begin[1:])
        expected = [at_path(message, path) for message in messages]
        assert good.tolist() == [v is not None for v in expected], path
        np.testing.assert_array_equal(
            values[good].astype(float), [v for v in expected if v is not None]
        )


def plain(value):
    """Return a decoded message as lists of names, numbers and texts."""
    if hasattr(value, "__dict__"):
        return {k: plain(v) for k, v in vars(value).items() if k != "__msgtype__"}
    return [plain(item) for item in value] if isinstance(value, (list, np.ndarray)) else value


@pytest.mark.long
@given(text=definitions(), seed=st.integers(0, 2**32 - 1), cut=st.integers(1, 4))
@settings(max_examples=60, deadline=None)
def test_whole_messages_of_any_type(text, seed, cut):
    rng = np.random.default_rng(seed)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "x_msgs/msg/T"))
    messages = [random_message(rng, store, "x_msgs/msg/T") for _ in range(4)]
    data = [
        bytes(store.serialize_cdr(m, "x_msgs/msg/T", little_endian=bool(rng.integers(0, 2))))
        for m in messages
    ]
    decoder = Decoder(message_type(channel("x_msgs/msg/T", text)), " of /t")
    ours = map(decoder.decoded, [*data, data[0] + bytes(7)])
    assert [plain(m) for m in ours] == [plain(m) for m in (*messages, messages[0])]
    with pytest.raises(BagError, match="of /t does not fit its definition"):
        decoder.decoded(data[0][:-cut])


def test_fields_of_the_installed_definitions():
    """Those of ROS have comments, defaults, constants and bounds in all the forms there are."""
    paths = [
        path
        for prefix in installed_prefixes()
        for path in prefix.glob("share/*/msg/*.msg")
        if path.read_text().strip()
    ]
    assert paths
    for path in paths:
        name = f"{path.parts[-3]}/msg/{path.stem}"
        ours = types_from_ros2msg(path.read_text(), name)
        expected = get_types_from_msg(path.read_text(), name)
        assert {
            k: [(name, told(kind)) for name, kind in fields] for k, fields in ours.items()
        } == {
            k: [(name, told_by_rosbags(kind)) for name, kind in fields]
            for k, (_, fields) in expected.items()
        }


def told(kind):
    """Return a type of ours with numbers and names alone."""
    if isinstance(kind, Number):
        return kind.name
    if isinstance(kind, Text):
        return "wstring" if kind.wide else "string"
    return (told(kind.item), kind.count) if isinstance(kind, Repeated) else ("of", kind.name)


def told_by_rosbags(kind):
    """Return a type of rosbags in the same form; the bound of a sequence does not matter."""
    number, what = int(kind[0]), kind[1]
    if number == 1:
        return "byte" if what[0] == "octet" else what[0]
    if number == 2:
        return ("of", what)
    return (told_by_rosbags(what[0]), what[1] if number == 3 else None)


@pytest.mark.parametrize(
    "line",
    ["float64", "float64 1a", "float64[ a", "float64[x] a", "float64[-1] a", "float64 a!", "= a",
     "float64[1]] a", "float64 a=1 = b\n===", "<html> a", "MSG: x/msg/B"],
)  # fmt: skip
def test_lines_that_are_no_field(line):
    with pytest.raises(BagError, match="makes no sense"):
        message_type(channel("x/msg/A", f"float64 a\n{line}\n"))


def channel(type_name, text, schema_encoding="ros2msg", encoding="cdr"):
    return Channel(1, "/t", type_name, encoding, schema_encoding, text.encode())


# --- definitions that make no sense


SEPARATOR = "=" * 80
DEEP = "".join(f"{SEPARATOR}\nMSG: x/A{k}\nx/A{k + 1} a\nx/A{k + 1} b\n" for k in range(1, 200))

# Each name stands for a sequence of the one before.
NESTED = (
    "typedef double t0;"
    + "".join(f"typedef sequence<t{k}> t{k + 1};" for k in range(3000))
    + "module x { module msg { struct A { t3000 a; }; }; };"
)


@pytest.mark.parametrize(
    ("text", "encoding", "sentence"),
    [
        (f"x/B b\n{SEPARATOR}\nMSG: x/B\nx/A a\n", "ros2msg", "holds itself"),
        ("x/B b\n", "ros2msg", "x/msg/B is missing"),
        (f"x/A1 a\n{DEEP}", "ros2msg", "types deep, or holds itself"),
        ("", "ros2msg", "it is empty"),
        ("float64", "ros2msg", "makes no sense"),
        ("float64[0] a\n", "ros2msg", "makes no sense"),
        ("float64[99999999999999999999] a\n", "ros2msg", "makes no sense"),
        ("struct {", "ros2idl", "makes no sense"),
        (NESTED, "ros2idl", "an array lies 41 types deep"),
        ("message A {}", "protobuf", "it is in 'protobuf'; expected 'ros2msg' or 'ros2idl'"),
        ("x" * 2_000_000, "ros2msg", "it has 2000000 bytes"),
        ("float64 a\n" * 5_001, "ros2msg", "more than 5000 fields"),
    ],
)
def test_definitions_that_make_no_sense(text, encoding, sentence):
    with pytest.raises(BagError, match=sentence):
        message_type(channel("x/msg/A", text, encoding))


def test_definitions_that_are_no_text():
    bad = Channel(1, "/t", "x/msg/A", "cdr", "ros2msg", b"float64 \xff")
    with pytest.raises(BagError, match="it is not UTF-8"):
        message_type(bad)


def test_messages_of_other_encodings_are_named_with_a_way_out(tmp_path):
    with pytest.raises(BagError, match=r"encoded as 'json'; expected 'cdr', .* as a CSV file"):
        message_type(channel("x/msg/A", "float64 a\n", encoding="json"))
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Level", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/level", "json", schema), 1, b"{}", 1)
        writer.finish()
    with McapFile(path) as file:
        assert Topics(path, [file], "publish").listing() == "/level (Level, encoded as 'json')"


def test_a_field_behind_too_many_others_is_refused_quickly():
    layers = "".join(
        f"{SEPARATOR}\nMSG: x/A{k}\nx/A{k + 1}[9] a\nx/A{k + 1}[9] b\n" for k in range(1, 9)
    )
    root = message_type(
        channel("x/msg/A", f"x/A1 a\nfloat64 last\n{layers}{SEPARATOR}\nMSG: x/A9\nstring s\n")
    )
    data = b"\0\1\0\0" + bytes(10_000)
    with pytest.raises(BagError, match="too far into a message"):
        named_field(root, "last", "/t").read(data, np.array([0]), np.array([len(data)]))


# --- messages that do not fit


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_messages_of_any_bytes_are_left_out_or_read(data):
    text = "string[] names\nfloat64[] list\nx/B[] b\n" + f"{SEPARATOR}\nMSG: x/B\nint8 i\n"
    root = message_type(channel("x/msg/A", text))
    messages = data.draw(st.lists(st.binary(max_size=60), min_size=1, max_size=6))
    messages = [b"\0\1" + m for m in messages]
    content = b"".join(messages) + bytes(40)
    ends = np.cumsum([len(m) for m in messages])
    begins = ends - [len(m) for m in messages]
    for path in ("names", "list[0]", "list[7]", "b[1].i"):
        if path != "names":
            values, good = named_field(root, path, "/t").read(content, begins, ends)
            assert values.size == good.size == len(messages)


def test_fields_that_are_not_there_are_refused_with_those_that_are():
    text, _ = made("sensor_msgs/msg/Imu")
    root = message_type(channel("sensor_msgs/msg/Imu", text))
    assert only_field(root) is None
    for field, sentence in (
        ("linear.x", r"no field 'linear.x'; it has orientation.x, orientation.y"),
        ("orientation", r"is not a number; expected the name of one, such as orientation.x"),
        ("orientation_covariance[9]", r"an array of 9 elements ends at \[8\]"),
        ("orientation..x", "is not the name of a field"),
        ("", "holds several numbers; name one, as in /t:orientation.x"),
        ("header.frame_id", "is not a number"),
    ):
        with pytest.raises(SelectionError, match=sentence):
            named_field(root, field, "/t")


# --- chunks and indexes of all kinds


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("options", [{}, {"use_statistics": False}, {"index_types": 0}])
def test_with_and_without_an_index(tmp_path, compression, options):
    from mcap.writer import IndexType

    if "index_types" in options:
        options = {"index_types": IndexType.NONE}
    text, data = made("sensor_msgs/msg/Imu", *map(imu, range(300)))
    path = write(
        tmp_path / "bag.mcap",
        "sensor_msgs/msg/Imu",
        text,
        data,
        compression=compression,
        chunk_size=5000,
        **options,
    )
    signal, notes = read(path, "/topic:linear_acceleration.y")
    np.testing.assert_array_equal(signal.values, 5.0 * np.arange(300))
    assert notes == ()


def test_a_file_compressed_as_a_whole(tmp_path):
    import zstandard

    text, data = made("sensor_msgs/msg/Imu", *map(imu, range(300)))
    plain = write(tmp_path / "bag.mcap", "sensor_msgs/msg/Imu", text, data)
    squeezed = zstandard.ZstdCompressor().compress(plain.read_bytes())
    path = tmp_path / "bag_0.mcap.zstd"
    path.write_bytes(squeezed)
    signal, notes = read(path, "/topic:linear_acceleration.y")
    np.testing.assert_array_equal(signal.values, 5.0 * np.arange(300))
    assert notes == ()
    text, data = made("sensor_msgs/msg/Imu", *map(imu, range(3000)))
    plain = write(
        plain, "sensor_msgs/msg/Imu", text, data, compression=CompressionType.NONE, chunk_size=9999
    )
    squeezed = zstandard.ZstdCompressor().compress(plain.read_bytes())
    path.write_bytes(squeezed[: len(squeezed) // 2])
    signal, notes = read(path, "/topic:linear_acceleration.y")
    assert 500 < len(signal) < 2500
    np.testing.assert_array_equal(signal.values, 5.0 * np.arange(len(signal)))
    assert "unfinished recording" in notes[0]


def test_a_bomb_is_refused(tmp_path, monkeypatch):
    import zstandard

    monkeypatch.setattr("relay_autotune.bag.source.UNSUSPICIOUS", 30 << 20)

    stream = io.BytesIO()
    block = bytes(1 << 20)
    with zstandard.ZstdCompressor().stream_writer(stream, closefd=False) as writer:
        writer.write(b"\x89MCAP0\r\n")
        for _ in range(40):
            writer.write(block)
    path = tmp_path / "bomb.mcap.zstd"
    path.write_bytes(stream.getvalue())
    assert len(stream.getvalue()) < 10**4
    with pytest.raises(BagError, match="expands to more than 31457280 bytes, over 1000 times"):
        McapFile(path)
