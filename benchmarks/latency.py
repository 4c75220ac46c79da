# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""Added latency of relay_node against a bare node that only echoes, side by side in one run.

Usage, after `. ./env.sh`:

    python3 benchmarks/latency.py [--seconds 60] [--rate 1000] [--phases 6] [--joints 0] [--quick]

Three processes besides this one: a sender that publishes measurements at a fixed rate, whatever
becomes of them; the installed relay_node in the midst of a tune, recording; and a bare rclpy node
that publishes what it receives. The sender feeds one of the two at a time, in phases that take
turns, so that both meet the same machine. The latency of a sample is from just before its
measurement is published to the arrival of its command here. With --joints the measurement is the
position of the last joint of a JointState, found by its name, and the command its element of an
array of all joints. The table is Markdown; the exit status is 1 if a target is missed. With
--quick a few seconds are run and the status is 0.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
DEEP = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.RELIABLE)
TARGETS = {"median": 1.5, "p99": 2.0, "p99.9": 3.0}
SETTLE = 0.5


def measurement(t: float) -> float:
    """Return a signal that rests and then swings through the relay's band once a second."""
    return 0.0 if t < SETTLE + 0.2 else math.sin(2.0 * math.pi * (t - SETTLE - 0.2))


def types(joints: int) -> tuple[Any, Any]:
    """Return the types of measurement and command."""
    return (JointState, Float64MultiArray) if joints else (Float64, Float64)


def of_joints(joints: int) -> list[str]:
    """Return the relay's parameters for the last one of some joints; 0: none."""
    if not joints:
        return []
    others = ", ".join("0.0" for _ in range(joints))
    given = {
        "measurement_type": "sensor_msgs/msg/JointState",
        "measurement_field": f"position[joint_{joints - 1}]",
        "command_type": "std_msgs/msg/Float64MultiArray",
        "command_field": f"data[{joints - 1}]",
        "command_message": f"'{{data: [{others}]}}'",
    }
    return [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]


def echo(joints: int) -> None:
    """Run the bare node."""
    rclpy.init()
    node = Node("echo", namespace="bare")
    measured, commanded = types(joints)
    publisher = node.create_publisher(commanded, "command", QOS)

    def answer(message: JointState) -> None:
        value = message.position[message.name.index(f"joint_{joints - 1}")]
        publisher.publish(Float64MultiArray(data=[*[0.0] * (joints - 1), value]))

    node.create_subscription(measured, "measurement", answer if joints else publisher.publish, QOS)
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


def send(rate: float, joints: int) -> None:
    """Run the sender: for each line "namespace count file" publish and note the times."""
    rclpy.init()
    node = Node("sender")
    publishers = {
        name: node.create_publisher(types(joints)[0], f"/{name}/measurement", QOS)
        for name in ("bare", "tuned")
    }
    message, names = Float64(), [f"joint_{k}" for k in range(joints)]
    print("ready", flush=True)
    for line in sys.stdin:
        name, count, file = line.split()
        publisher = publishers[name]
        sent = np.zeros(int(count), dtype=np.int64)
        start = time.monotonic()
        for k in range(sent.size):
            wait = start + k / rate - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)
            value = measurement(k / rate)
            if joints:
                message = JointState(name=names, position=[*[0.0] * (joints - 1), value])
            else:
                message.data = value
            sent[k] = time.monotonic_ns()
            publisher.publish(message)
        np.save(file, sent)
        print("sent", flush=True)


class Bench:
    """Starts the processes, runs the phases and keeps the times."""

    def __init__(
        self, rate: float, folder: Path, environment: dict[str, str], joints: int = 0
    ) -> None:
        self.folder = folder
        self.rate = rate
        self.arrived: dict[str, list[int]] = {"bare": [], "tuned": []}
        rclpy.init()
        self.node = Node("bench")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        for name, times in self.arrived.items():
            topic = f"/{name}/command"
            self.node.create_subscription(types(joints)[1], topic, self._noting(times), DEEP)
        this = [sys.executable, __file__, "--joints", str(joints)]
        start = {"env": environment, "text": True}
        self.processes = [
            subprocess.Popen([*this, "--role", "echo"], **start),
            subprocess.Popen(
                [
                    *("relay_node", "--ros-args", "-r", "__ns:=/tuned", "--log-level", "warn"),
                    *("-p", "amplitude:=1.0", "-p", "baseline:=0.0", "-p", "hysteresis:=0.1"),
                    *("-p", f"settle_time:={SETTLE}", "-p", "process_gain_sign:=1"),
                    *("-p", "min_cycles:=1000", "-p", "max_cycles:=1000"),
                    # The sine does not grow with the levels, as behind a clipped actuator.
                    *("-p", "command_min:=-1.5", "-p", "command_max:=1.5"),
                    *("-p", "measurement_timeout:=1000.0", "-p", "model_timeout:=0.0"),
                    *("-p", f"record_directory:={folder}"),
                    *of_joints(joints),
                ],
                **start,
            ),
        ]
        self.sender = subprocess.Popen(
            [*this, "--role", "send", "--rate", str(rate)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            **start,
        )
        self.processes.append(self.sender)
        assert self.sender.stdout is not None
        self.sender.stdout.readline()

    @staticmethod
    def _noting(times: list[int]) -> Any:
        append, now = times.append, time.monotonic_ns

        def note(_: Any) -> None:
            append(now())

        return note

    def until(self, condition: Any, timeout: float, what: str) -> None:
        """Spin until a condition holds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise SystemExit(f"latency: {what} did not happen within {timeout:g} s")
            self.executor.spin_once(timeout_sec=0.1)

    def send(self, name: str, count: int) -> np.ndarray:
        """Let the sender publish; return when each measurement was sent."""
        file = self.folder / f"sent_{time.monotonic_ns()}.npy"
        assert self.sender.stdin is not None
        self.sender.stdin.write(f"{name} {count} {file}\n")
        self.sender.stdin.flush()
        first = len(self.arrived[name])
        end = time.monotonic() + count / self.rate + 2.0
        while time.monotonic() < end and len(self.arrived[name]) < first + count:
            self.executor.spin_once(timeout_sec=0.1)
        assert self.sender.stdout is not None
        self.sender.stdout.readline()
        return np.load(file)

    def tune(self, start: bool) -> None:
        """Start or abort a tune."""
        from std_srvs.srv import Trigger

        from relay_autotune_msgs.srv import StartTune

        kind, name = (StartTune, "start_tune") if start else (Trigger, "abort")
        client = self.node.create_client(kind, f"/tuned/relay_node/{name}")
        self.until(client.service_is_ready, 20.0, "the relay's services")
        future = client.call_async(kind.Request())
        self.until(future.done, 10.0, f"answer of {name}")
        answer = future.result()
        if start and not answer.accepted:
            raise SystemExit(f"latency: {answer.reason}")
        self.node.destroy_client(client)

    def phase(self, name: str, count: int) -> tuple[np.ndarray, int]:
        """Run one phase; return its latencies [ms] and how many samples were lost."""
        if name == "tuned":
            # Make sure that the relay's answers come from a tune.
            self.send(name, 1)
            self.tune(start=True)
        first = len(self.arrived[name])
        sent = self.send(name, count)
        arrived = np.array(self.arrived[name][first:][:count])
        if name == "tuned":
            self.tune(start=False)
            # The safe command and its repeats do not count as answers.
            self.until(lambda: len(self.arrived[name]) > first + arrived.size, 5.0, "abort")
        lost = count - arrived.size
        return (arrived - sent[: arrived.size]) * 1e-6, lost

    def close(self) -> None:
        """End what was started."""
        assert self.sender.stdin is not None
        self.sender.stdin.close()
        for process in self.processes[:-1]:
            process.terminate()
        for process in self.processes:
            process.wait(10)


def table(latencies: dict[str, np.ndarray], lost: dict[str, int]) -> tuple[str, bool]:
    """Return the table in Markdown, and whether all targets are met."""

    def statistics(values: np.ndarray) -> dict[str, float]:
        return {
            "median": float(np.median(values)),
            "p99": float(np.percentile(values, 99.0)),
            "p99.9": float(np.percentile(values, 99.9)),
            "max": float(np.max(values)),
        }

    bare, tuned = (statistics(latencies[name]) for name in ("bare", "tuned"))
    lines = [
        "| node | samples | lost | median [ms] | p99 [ms] | p99.9 [ms] | max [ms] |",
        "|---|---|---|---|---|---|---|",
    ]
    for title, name, row in (("bare echo", "bare", bare), ("relay_node", "tuned", tuned)):
        cells = " | ".join(f"{row[key]:.3f}" for key in row)
        lines.append(f"| {title} | {latencies[name].size} | {lost[name]} | {cells} |")
    ratios = {key: tuned[key] / bare[key] for key in bare}
    lines.append(f"| ratio | | | {' | '.join(f'{ratios[key]:.2f}' for key in ratios)} |")
    targets = " | ".join(f"<= {TARGETS[key]:g}" if key in TARGETS else "" for key in ratios)
    lines.append(f"| target | | 0 | {targets} |")
    met = not lost["tuned"] and all(ratios[key] <= TARGETS[key] for key in TARGETS)
    return "\n".join(lines), met


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="for each node [s]")
    parser.add_argument("--rate", type=float, default=1000.0, help="measurements a second")
    parser.add_argument("--phases", type=int, default=6, help="turns of each node")
    parser.add_argument("--quick", action="store_true", help="a few seconds, only to see it run")
    parser.add_argument("--joints", type=int, default=0, help="of a JointState; 0: a Float64")
    parser.add_argument("--role", choices=("echo", "send"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == "echo":
        echo(options.joints)
        return 0
    if options.role == "send":
        send(options.rate, options.joints)
        return 0
    from ros_domain import free_domain

    if options.quick:
        options.seconds, options.phases = 1.5, 1
    count = int(options.seconds * options.rate / options.phases)
    latencies: dict[str, list[np.ndarray]] = {"bare": [], "tuned": []}
    lost = {"bare": 0, "tuned": 0}
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        bench = Bench(options.rate, Path(folder), dict(os.environ), options.joints)
        try:
            bench.until(lambda: len(bench.arrived["bare"]) >= 0, 1.0, "start")
            connected = time.monotonic() + 3.0
            bench.until(lambda: time.monotonic() > connected, 5.0, "discovery")
            for _ in range(options.phases):
                for name in ("bare", "tuned"):
                    found, missing = bench.phase(name, count)
                    latencies[name].append(found)
                    lost[name] += missing
        finally:
            bench.close()
            rclpy.try_shutdown()
    text, met = table({name: np.concatenate(parts) for name, parts in latencies.items()}, lost)
    print(text)
    return 0 if met or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
