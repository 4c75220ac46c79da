# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Publish a bag's messages at their times, as `ros2 bag play` does: `bag_player.py BAG RATE`.

It replaces that command where only the wheels of rclpy are installed. It publishes the recorded
bytes on their topics, in order of their log times, with the intervals divided by the rate. It
starts once each topic has as many subscribers as the third argument says.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import rclpy
from mcap.reader import make_reader
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from std_msgs.msg import Float64

from relay_autotune_msgs.msg import RelayCycle, RelayExperiment

KINDS: dict[str, Any] = {
    "std_msgs/msg/Float64": Float64,
    "relay_autotune_msgs/msg/RelayCycle": RelayCycle,
    "relay_autotune_msgs/msg/RelayExperiment": RelayExperiment,
}


def main() -> None:
    (path,), rate = Path(sys.argv[1]).glob("*.mcap"), float(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node("bag_player")
    waiting: list[tuple[int, str, Any]] = []
    publishers: dict[str, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            kind = None if schema is None else KINDS.get(schema.name)
            if kind is None:
                continue
            if channel.topic not in publishers:
                qos = QoSProfile(depth=1000)
                if "transient_local" in channel.metadata["offered_qos_profiles"]:
                    qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
                publishers[channel.topic] = node.create_publisher(kind, channel.topic, qos)
            data = deserialize_message(message.data, kind)
            waiting.append((message.log_time, channel.topic, data))
    while any(publisher.get_subscription_count() == 0 for publisher in publishers.values()):
        rclpy.spin_once(node, timeout_sec=0.05)
    begin, first = time.monotonic(), waiting[0][0]
    for stamp, topic, message in waiting:
        time.sleep(max(0.0, begin + (stamp - first) / 1e9 / rate - time.monotonic()))
        publishers[topic].publish(message)
    while True:
        # Stay alive, so that latched messages remain available to the test.
        rclpy.spin_once(node, timeout_sec=1.0)


if __name__ == "__main__":
    main()
