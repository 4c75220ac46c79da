# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Recordings of rosbag2 in SQLite."""

from __future__ import annotations

import sqlite3
import time

import numpy as np
import pytest
import zstandard

from relay_autotune.bag import bag_file
from relay_autotune.bag.bag_file import SqliteFile
from relay_autotune.bag.signals import Selection
from relay_autotune.bag.topics import Topics
from relay_autotune.bag.writer import encode_float64
from relay_autotune.errors import BagError, SelectionError
from relay_autotune.recordings import read_experiments

NAMES = Selection("/y", "/u")
DEFINITION = "float64 data\n"


def bag(path, first=0, last=60, *, definitions=True, pack=bytes):
    database = sqlite3.connect(path)
    database.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
        " serialization_format TEXT, offered_qos_profiles TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        " data BLOB);"
    )
    if definitions:
        database.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT,"
            " encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)"
        )
        database.execute(
            "INSERT INTO message_definitions VALUES(1, ?, 'ros2msg', ?, '')",
            ("std_msgs/msg/Float64", DEFINITION),
        )
    for number, name in ((1, "/y"), (2, "/u")):
        database.execute(
            "INSERT INTO topics VALUES(?, ?, 'std_msgs/msg/Float64', 'cdr', '')", (number, name)
        )
    for k in range(first, last):
        stamp = 1_790_000_000_000_000_000 + k * 100_000_000
        for topic, value in ((1, k % 7 + 0.5), (2, float(k // 5 % 2))):
            database.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)",
                (topic, stamp, pack(encode_float64(value))),
            )
    database.commit()
    database.close()
    return path


def check(path):
    (record,) = read_experiments(path, Selection("/y", "/u", start=0.0)).experiments
    np.testing.assert_allclose(record.time, np.arange(60) * 0.1, atol=1e-9)
    np.testing.assert_array_equal(record.measurement, np.arange(60) % 7 + 0.5)
    np.testing.assert_allclose(record.input().times, np.arange(5, 60, 5) * 0.1, atol=1e-9)
    assert record.start == 1_790_000_000.0


def test_a_single_file(tmp_path):
    check(bag(tmp_path / "a.db3"))


def test_a_file_without_definitions_uses_those_that_are_installed(tmp_path):
    check(bag(tmp_path / "a.db3", definitions=False))


def test_a_directory_of_split_files(tmp_path):
    bag(tmp_path / "bag_0.db3", 0, 20)
    bag(tmp_path / "bag_1.db3", 20, 45)
    bag(tmp_path / "bag_2.db3", 45, 60)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    check(tmp_path)


def test_messages_that_are_compressed_one_by_one(tmp_path):
    check(bag(tmp_path / "a.db3", pack=zstandard.ZstdCompressor().compress))


def test_a_file_that_is_compressed_as_a_whole(tmp_path):
    plain = bag(tmp_path / "a.db3")
    packed = tmp_path / "b.db3.zstd"
    packed.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    check(packed)


def test_what_is_no_such_file_is_a_sentence(tmp_path):
    (tmp_path / "a.db3").write_bytes(b"no database at all")
    with pytest.raises(BagError, match="is not a rosbag2 file in SQLite"):
        read_experiments(tmp_path / "a.db3", NAMES)
    whole = bag(tmp_path / "b.db3").read_bytes()
    (tmp_path / "c.db3").write_bytes(whole[:100] + b"\xff" * 4000)
    with pytest.raises(BagError, match="cannot be read as a rosbag2 file in SQLite"):
        read_experiments(tmp_path / "c.db3", NAMES)
    other = sqlite3.connect(tmp_path / "d.db3")
    other.executescript(
        "CREATE TABLE topics(id INTEGER);"
        "CREATE VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
        " SELECT x AS id FROM c;"
    )
    other.close()
    with pytest.raises(BagError, match="without the tables topics and messages"):
        read_experiments(tmp_path / "d.db3", NAMES)


def refused(path, *statements):
    """Return why a bag is refused after some statements."""
    database = sqlite3.connect(path)
    database.executescript("; ".join(statements))
    database.close()
    with pytest.raises(BagError) as raised:
        read_experiments(path, NAMES)
    return str(raised.value)


def test_an_index_of_the_file_is_not_trusted(tmp_path):
    path = bag(tmp_path / "a.db3")
    database = sqlite3.connect(path)
    # As a recorder that was killed between two pages may leave it.
    whole = "CREATE INDEX timestamp_idx ON messages(timestamp ASC)"
    database.execute(f"{whole} WHERE id % 2")
    database.execute("PRAGMA writable_schema = ON")
    database.execute("UPDATE sqlite_master SET sql = ? WHERE name = 'timestamp_idx'", (whole,))
    database.commit()
    database.close()
    check(path)


def test_messages_that_were_not_written_in_the_order_of_their_times(tmp_path):
    path = bag(tmp_path / "a.db3")
    database = sqlite3.connect(path)
    database.execute("UPDATE messages SET id = id + 1000 WHERE id % 3 = 0")
    database.commit()
    database.close()
    check(path)


@pytest.mark.parametrize("value", ["'one'", "NULL", "9e999", "2.5", "x'31'", "2"])
def test_a_topic_without_a_number_of_its_own_is_a_sentence(tmp_path, value):
    said = refused(
        bag(tmp_path / "a.db3"),
        "ALTER TABLE topics RENAME TO old",
        "CREATE TABLE topics AS SELECT * FROM old",
        f"UPDATE topics SET id = {value} WHERE id = 1",
    )
    assert "expected a whole number that no other topic has" in said


def test_columns_that_are_computed_are_refused(tmp_path):
    said = refused(
        bag(tmp_path / "a.db3"),
        "ALTER TABLE messages RENAME TO old",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        " data BLOB GENERATED ALWAYS AS (zeroblob(200000000)))",
        "INSERT INTO messages SELECT id, topic_id, timestamp FROM old",
    )
    assert "a table messages with columns that are computed" in said


@pytest.mark.long
def test_more_topics_than_a_recorder_has_are_refused(tmp_path):
    said = refused(
        bag(tmp_path / "a.db3"),
        "WITH RECURSIVE n(k) AS (SELECT 3 UNION ALL SELECT k + 1 FROM n WHERE k < 50010)"
        " INSERT INTO topics SELECT k, '/t' || k, 'x', 'cdr', '' FROM n",
    )
    assert "declares more than 50000 topics" in said


@pytest.mark.nightly
def test_many_topics_take_no_longer_and_are_not_paired(tmp_path):
    path = bag(tmp_path / "a.db3")
    database = sqlite3.connect(path)
    numbers = "WITH RECURSIVE n(k) AS (SELECT 3 UNION ALL SELECT k + 1 FROM n WHERE k < 10000)"
    database.execute(
        f"{numbers} INSERT INTO topics SELECT k, '/t' || k, 'std_msgs/msg/Float64', 'cdr', '' "
        "FROM n"
    )
    database.execute(
        f"{numbers} INSERT INTO messages SELECT k + 1000, k, 1790000000000000000, ? FROM n",
        (encode_float64(1.0),),
    )
    database.commit()
    database.close()
    begin = time.process_time()
    check(path)
    with pytest.raises(SelectionError, match="has 10000 topics whose messages are about one numb"):
        read_experiments(path)
    with SqliteFile(path) as file:
        found = Topics(path, [file]).signals()
    assert len(found) == 10_000
    assert time.process_time() - begin < 5.0


def test_types_without_number_are_not_all_looked_for_on_the_disk(tmp_path, monkeypatch):
    path = bag(tmp_path / "a.db3")
    database = sqlite3.connect(path)
    database.execute(
        "WITH RECURSIVE n(k) AS (SELECT 3 UNION ALL SELECT k + 1 FROM n WHERE k < 5000)"
        " INSERT INTO topics SELECT k, '/t' || k, 'x_msgs/msg/T' || k, 'cdr', '' FROM n"
    )
    database.commit()
    database.close()
    sought = []
    real = bag_file.find_definition
    monkeypatch.setattr(bag_file, "find_definition", lambda k: sought.append(k) or real(k))
    check(path)
    assert len(sought) == 1000


@pytest.mark.parametrize("begin", [bytes.fromhex("d9d505f920a163d7"), bytes(8)])
def test_a_change_that_was_cut_is_said(tmp_path, begin):
    path = bag(tmp_path / "a.db3")
    (tmp_path / "a.db3-journal").write_bytes(begin + bytes(504))
    notes = read_experiments(path, NAMES).notes
    assert any("was cut within a change" in note for note in notes) == any(begin)


def test_pages_that_lead_to_the_same_rows_again_and_again_end(tmp_path, monkeypatch):
    """Each row of a real file takes bytes of it."""
    monkeypatch.setattr(bag_file, "MOST_STEPS_OF_SQLITE", 0)
    monkeypatch.setattr(bag_file, "STEPS_OF_SQLITE_PER_BYTE", 0.1)
    found = read_experiments(bag(tmp_path / "a.db3", 0, 4000), Selection("/y", "/u", start=0.0))
    assert found.notes == ("a.db3 cannot be read to its end (interrupted)",)
