# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""The texts of a rosbag2 directory: metadata.yaml (version 9) and QoS profiles."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

# "Infinite" in rmw: the largest seconds and nanoseconds of a signed 64-bit number of nanoseconds.
_INFINITE = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True)
class Qos:
    """The quality of service that a publisher offered, in the words of rosbag2.

    :param reliability: ``reliable`` or ``best_effort``.
    :param durability: ``volatile`` or ``transient_local``.
    :param history: ``keep_last`` or ``keep_all``.
    :param depth: messages kept, with keep_last.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "keep_last"
    depth: int = 10


@dataclass(frozen=True)
class TopicSummary:
    """One topic of a bag with the number of its messages."""

    name: str
    type: str
    qos: Qos
    type_hash: str
    message_count: int


def qos_yaml(qos: Qos) -> str:
    """Return the profile as the one-item YAML list that rosbag2 keeps for a topic."""
    lines = [
        f"history: {qos.history}",
        f"depth: {qos.depth}",
        f"reliability: {qos.reliability}",
        f"durability: {qos.durability}",
        *_duration("deadline"),
        *_duration("lifespan"),
        "liveliness: automatic",
        *_duration("liveliness_lease_duration"),
        "avoid_ros_namespace_conventions: false",
    ]
    return "- " + "\n  ".join(lines)


def _duration(name: str) -> list[str]:
    return [f"{name}:", f"  sec: {_INFINITE['sec']}", f"  nsec: {_INFINITE['nsec']}"]


def metadata_yaml(
    file_name: str,
    topics: Sequence[TopicSummary],
    *,
    start_ns: int,
    duration_ns: int,
    custom: Mapping[str, str],
    ros_distro: str,
) -> str:
    """Return the text of metadata.yaml, without the outermost key.

    :param file_name: the bag's only data file, relative to its folder.
    :param topics: the topics, each with its count.
    :param start_ns: log time of the first message [ns since the epoch].
    :param duration_ns: from there to the last one [ns].
    :param custom: the bag's custom_data.
    :param ros_distro: name of the ROS distribution.
    """
    count = sum(topic.message_count for topic in topics)
    # A JSON string is a YAML string, whatever it holds.
    lines = [
        "version: 9",
        "storage_identifier: mcap",
        "duration:",
        f"  nanoseconds: {duration_ns}",
        "starting_time:",
        f"  nanoseconds_since_epoch: {start_ns}",
        f"message_count: {count}",
        "topics_with_message_count:" + ("" if topics else " []"),
    ]
    for topic in topics:
        lines += [
            "  - topic_metadata:",
            f"      name: {json.dumps(topic.name)}",
            f"      type: {json.dumps(topic.type)}",
            "      serialization_format: cdr",
            "      offered_qos_profiles:",
            *("        " + line for line in qos_yaml(topic.qos).splitlines()),
            f"      type_description_hash: {json.dumps(topic.type_hash)}",
            f"    message_count: {topic.message_count}",
        ]
    lines += [
        'compression_format: ""',
        'compression_mode: ""',
        "relative_file_paths:",
        f"  - {json.dumps(file_name)}",
        "files:",
        f"  - path: {json.dumps(file_name)}",
        "    starting_time:",
        f"      nanoseconds_since_epoch: {start_ns}",
        "    duration:",
        f"      nanoseconds: {duration_ns}",
        f"    message_count: {count}",
    ]
    if custom:
        lines.append("custom_data:")
        lines += [f"  {json.dumps(k)}: {json.dumps(str(v))}" for k, v in custom.items()]
    else:
        lines.append("custom_data: ~")
    lines.append(f"ros_distro: {json.dumps(ros_distro)}")
    return "\n".join(lines) + "\n"


def metadata_file(information: str) -> str:
    """Return the content of the file metadata.yaml around the text of `metadata_yaml`."""
    body = "".join(f"  {line}\n" for line in information.splitlines())
    return "rosbag2_bagfile_information:\n" + body
