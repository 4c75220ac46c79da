# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Several bags on one timeline, and directories as recorders leave them."""

from __future__ import annotations

import numpy as np
import pytest
import zstandard
from made_bags import write_pair

from relay_autotune.bag.signals import Selection
from relay_autotune.errors import SelectionError
from relay_autotune.recordings import read_experiments

ALL = Selection("/measurement", "/command", start=0.0)

# metadata.yaml of rosbag2 from Humble to Kilted: QoS as text with numbers, then as a list with
# words; the hash of a type since version 6, the distribution since 7.
METADATA = {
    "humble": 'version: 5\noffered_qos_profiles: "- history: 1\\n  depth: 10"',
    "iron": 'version: 7\noffered_qos_profiles: "- history: 1\\n  depth: 10"\nros_distro: iron',
    "jazzy": "version: 9\noffered_qos_profiles:\n  - history: keep_last\nros_distro: jazzy",
    "kilted": "version: 10\nsomething_new: {a: [1, 2]}\nros_distro: kilted",
}


def part(path, first, last):
    """Write ten messages a second of both topics, from one second to another."""
    k = range(10 * first, 10 * last)
    write_pair(
        path,
        [(i / 10, i % 31) for i in k],
        [(i / 10 + 0.01, i // 40 % 2) for i in k],
    )
    return path


def test_two_bags_are_one_recording_in_any_order(tmp_path):
    a, b = part(tmp_path / "a", 0, 10), part(tmp_path / "b", 10, 20)
    for paths in ([a, b], [b, a]):
        (found,) = read_experiments(paths, ALL).experiments
        np.testing.assert_array_equal(found.measurement, np.arange(200) % 31)
        np.testing.assert_allclose(found.time, np.arange(200) / 10, atol=1e-9)


def test_csv_files_are_not_joined(tmp_path):
    with pytest.raises(SelectionError, match="CSV files cannot be joined"):
        read_experiments([tmp_path / "a.csv", tmp_path / "b.csv"])


@pytest.mark.parametrize("distribution", METADATA)
def test_the_metadata_of_every_distribution_does(tmp_path, distribution):
    bag = part(tmp_path / "bag", 0, 10)
    text = METADATA[distribution].replace("\n", "\n  ")
    (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  {text}\n")
    (found,) = read_experiments(bag, ALL).experiments
    assert len(found) == 100


def test_a_split_bag_with_files_compressed_as_a_whole(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    for number in range(3):
        made = part(tmp_path / f"p{number}", 10 * number, 10 * number + 10)
        data = (made / f"p{number}_0.mcap").read_bytes()
        # As rosbag2 does; of the last one both are there.
        (bag / f"bag_{number}.mcap.zstd").write_bytes(zstandard.compress(data))
        if number == 2:
            (bag / f"bag_{number}.mcap").write_bytes(data)
    (found,) = read_experiments(bag, ALL).experiments
    np.testing.assert_array_equal(found.measurement, np.arange(300) % 31)
