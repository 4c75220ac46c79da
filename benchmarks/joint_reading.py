# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Time of reading a robot's joints by name: `python3 benchmarks/joint_reading.py [--quick]`.

A bag of ten minutes with seven joints at 500 Hz, as sensor_msgs/JointState and an array of
commands, once with the joints in one order and once in another order in each message. The same
bag without names is read by the joints' places.
"""

from __future__ import annotations

import argparse
import random
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from markdown import table, three
from mcap.writer import Writer
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from relay_autotune.bag.bag_file import McapFile
from relay_autotune.bag.definitions import find_definition
from relay_autotune.bag.pairing import named_pair
from relay_autotune.bag.signals import Selection
from relay_autotune.bag.topics import Topics

JOINTS = tuple(f"arm_joint_{k}" for k in range(7))
MESSAGES, QUICK_MESSAGES = 300_000, 1_000
PERIOD_NS = 2_000_000
START = 1_790_000_000_000_000_000
TURNS = 5


def written(path: Path, count: int, order: Callable[[], Sequence[int]], *, named: bool) -> Path:
    """Write a bag in which a joint's velocity is its place and the number of the message."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "benchmark")
        channels = []
        for topic, kind in (
            ("/joint_states", "sensor_msgs/msg/JointState"),
            ("/arm/commands", "std_msgs/msg/Float64MultiArray"),
        ):
            text = find_definition(kind).text.encode()
            schema = writer.register_schema(kind, "ros2msg", text)
            channels.append(writer.register_channel(topic, "cdr", schema))
        for k in range(count):
            places = order()
            names = [JOINTS[p] for p in places] if named else []
            velocity = [float(k + 1000 * p) for p in places]
            states = JointState(name=names, position=velocity, velocity=velocity)
            commands = Float64MultiArray(data=[float(k // 300 % 2)] * len(JOINTS))
            for channel, message in zip(channels, (states, commands), strict=True):
                stamp = START + PERIOD_NS * k
                writer.add_message(channel, stamp, serialize_message(message), stamp, k)
        writer.finish()
    return path


def seconds(path: Path, work: Callable[[Topics], None], turns: int) -> float:
    """Return the processor's time for a piece of work with a bag, the median of turns."""
    taken = []
    for _ in range(turns):
        begin = time.process_time()
        with McapFile(path) as file:
            work(Topics(path, [file]))
        taken.append(time.process_time() - begin)
    return statistics.median(taken)


def of(names: Sequence[str], truth: float) -> Callable[[Topics], None]:
    """Return the reading of joints' velocities, of which the first has to be right."""

    def work(topics: Topics) -> None:
        values = topics.signals(names)[names[0]].values
        assert np.array_equal(values, truth + np.arange(values.size))

    return work


def found(topics: Topics) -> None:
    """Find measurement and command of one joint."""
    named_pair(topics, Selection("/joint_states:velocity", joint=JOINTS[3], joint_order=JOINTS))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small bag: does it run?")
    quick = parser.parse_args().quick
    count, turns = (QUICK_MESSAGES, 1) if quick else (MESSAGES, TURNS)
    in_order, chance = range(len(JOINTS)), random.Random(1)
    every = [f"/joint_states:velocity[{joint}]" for joint in JOINTS]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for title, order, named in (
            ("one order", lambda: in_order, True),
            ("another order in each message", lambda: chance.sample(in_order, 7), True),
            ("no names, by place", lambda: in_order, False),
        ):
            path = written(Path(folder) / "bag.mcap", count, order, named=named)
            one, all_of = every[3:4], every
            if not named:
                all_of = [f"/joint_states:velocity[{k}]" for k in in_order]
                one = all_of[3:4]
            times = [seconds(path, of(one, 3000.0), turns), seconds(path, of(all_of, 0.0), turns)]
            search = three(seconds(path, found, turns)) if named else ""
            rows.append((title, *map(three, times), search))
    print(f"Processor's time [s] for {count:,} joint states of 7 joints; median of {turns}:\n")
    heads = ("joints", "one read", "seven read", "one found with its command and read")
    print(table(heads, rows))


if __name__ == "__main__":
    main()
