# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A tune of ten minutes at 1 kHz under a full load of the processors, beside a bare echo node.

Usage, after `. ./env.sh`:

    python3 benchmarks/endurance.py [--seconds 600] [--rate 1000] [--load 2] [--nice 0] [--quick]

The installed plant_node, relay_node and identifier_node form a loop; a bare rclpy node, which
publishes what it receives, listens to the same measurement. Processes that only spin load the two
processors to which all are bound. The latency of a command is from the measurement's source stamp
to just after the command was published, as relay_node's record and the echo node note it. Memory
is what relay_node has resident. The table is Markdown; the exit status is 1 if a target is missed.
With --quick a few seconds are run and the status is 0.
"""

from __future__ import annotations

import argparse
import array
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from markdown import table
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from relay_autotune_msgs.msg import RelayExperiment
from relay_autotune_msgs.srv import StartTune

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

CORES = 2
QUICK = 6.0
QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TIMES, AND = 2, 5
MOST_MEMORY = 5.0
# The record has five numbers for a sample; the cycles kept for late subscribers have three.
RECORD_BYTES, CYCLE_BYTES = 5 * 8, 3 * 8
# Memory is measured after this share of the tune: buffers of a fixed size are full by then.
WARM = 0.2
MEGA = 1e6
# So slow that a stall of the machine does not change how it oscillates.
PLANT = {
    "structure": "fopdt",
    "gain": 1.0,
    "time_constants": [20.0],
    "dead_time": 2.0,
    "noise_std": 0.005,
}
TUNE = {
    "amplitude": 1.0,
    "baseline": 0.0,
    "initial_command": 0.0,
    "process_gain_sign": 1,
    "min_cycles": 1000,
    "max_cycles": 1000,
    "measurement_timeout": 60.0,
    "model_timeout": 5.0,
    # A processor under full load keeps a node waiting for longer than the usual 100 samples last.
    "qos_overrides./tuned/measurement.subscription.depth": 1000,
}


def echo(file: Path) -> None:
    """Run the bare node; keep the times of each sample and of its answer."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    ended: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: ended.append(number))
    node = Node("echo", namespace="bare")
    publisher = node.create_publisher(Float64, "command", QOS)
    source, sent, number = (array.array("q") for _ in range(3))

    def answer(message: Float64, info: dict[str, Any]) -> None:
        publisher.publish(message)
        sent.append(time.time_ns())
        source.append(info["source_timestamp"])
        number.append(info["publication_sequence_number"])

    node.create_subscription(Float64, "/tuned/measurement", answer, QOS)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not ended:
        executor.spin_once(timeout_sec=0.1)
    np.savez(file, source=source, sent=sent, number=number)


def spin() -> None:
    """Load a processor."""
    while True:
        pass


def resident(pid: int) -> int:
    """Return the resident memory of a process [bytes]."""
    pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@dataclass
class Watched:
    """Observations from outside while the tune ran."""

    samples: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    experiment: RelayExperiment | None = None
    running: bool = False


class Bench:
    """Starts the processes, runs the tune and keeps what is to be known."""

    def __init__(
        self, rate: float, load: int, nice: int, folder: Path, environment: dict[str, str]
    ) -> None:
        self.rate, self.folder = rate, folder
        self.watched = Watched()
        rclpy.init()
        self.node = Node("bench")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.node.create_subscription(
            RelayExperiment, "/tuned/relay_experiment", self._on_experiment, LATCHED
        )
        # A publisher without subscribers would have less to do.
        self.node.create_subscription(Float64, "/bare/command", self._on_echo, QOS)
        this = [sys.executable, __file__, "--role"]
        self.echo_file = folder / "echo.npz"
        plant = PLANT | {"sample_period": 1.0 / rate}
        tune = TUNE | {"record_directory": str(folder)}
        commands = {
            "echo": [*this, "echo", "--file", str(self.echo_file)],
            "relay": _node("relay_node", tune),
            "identifier": _node("identifier_node", {}),
            "plant": _node("plant_node", plant),
            **{f"load {k}": [*this, "spin", "--nice", str(nice)] for k in range(load)},
        }
        self.processes = {
            name: subprocess.Popen(command, env=environment) for name, command in commands.items()
        }

    def _on_echo(self, _: Float64) -> None:
        self.watched.running = True

    def _on_experiment(self, message: RelayExperiment) -> None:
        self.watched.experiment = message

    def until(self, condition: Any, timeout: float, what: str) -> None:
        """Spin until a condition holds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise SystemExit(f"endurance: {what} did not happen within {timeout:g} s")
            self.executor.spin_once(timeout_sec=0.1)

    def call(self, kind: Any, name: str) -> Any:
        """Call a service of relay_node."""
        client = self.node.create_client(kind, f"/tuned/relay_node/{name}")
        self.until(client.service_is_ready, 60.0, "the relay's services")
        future = client.call_async(kind.Request())
        self.until(future.done, 60.0, f"answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def run(self, seconds: float) -> None:
        """Run the tune."""
        self.until(lambda: self.watched.running, 60.0, "a measurement")
        self.until(self._starts, 60.0, "a tune")
        begin = time.monotonic()
        while (elapsed := time.monotonic() - begin) < seconds:
            self.watched.samples.append(elapsed * self.rate)
            self.watched.memory.append(resident(self.processes["relay"].pid))
            end = time.monotonic() + min(1.0, seconds - elapsed)
            while time.monotonic() < end:
                self.executor.spin_once(timeout_sec=0.1)
            if self.watched.experiment is not None:
                raise SystemExit(f"endurance: the tune ended, {self.watched.experiment.reason}")
        self.call(Trigger, "abort")
        self.until(lambda: self.watched.experiment is not None, 60.0, "the record")

    def _starts(self) -> bool:
        answer = self.call(StartTune, "start_tune")
        if not answer.accepted:
            time.sleep(0.5)
        return bool(answer.accepted)

    def close(self) -> None:
        """End what was started."""
        for name, process in self.processes.items():
            if process.poll() is None:
                process.send_signal(signal.SIGKILL if name.startswith("load") else signal.SIGINT)
        for process in self.processes.values():
            process.wait(60)


def _node(name: str, parameters: dict[str, Any]) -> list[str]:
    given = [f"{key}:={value}" for key, value in parameters.items()]
    options = [part for value in given for part in ("-p", value)]
    return [name, "--ros-args", "-r", "__ns:=/tuned", "--log-level", "error", *options]


def latencies(bench: Bench) -> tuple[dict[str, NDArray[np.float64]], dict[str, int]]:
    """Return the time from each sample to its answer [ms], and how many samples were lost."""
    record = bench.watched.experiment
    assert record is not None
    start = record.header.stamp.sec * 10**9 + record.header.stamp.nanosec
    tuned = (np.array(record.command_time) - np.array(record.time)) * 1e3
    noted = np.load(bench.echo_file)
    end = start + round(record.time[-1] * 1e9)
    same = (noted["source"] >= start - 1000) & (noted["source"] <= end + 1000)
    number = noted["number"][same]
    missing = int(number[-1] - number[0] + 1 - number.size)
    bare = (noted["sent"] - noted["source"])[same] * 1e-6
    return {"bare echo": bare, "relay_node": tuned}, {
        "bare echo": missing,
        "relay_node": record.lost_samples,
    }


def report(bench: Bench, seconds: float, load: int) -> tuple[str, bool]:
    """Return the tables, and whether all targets are met."""
    record = bench.watched.experiment
    assert record is not None
    found, lost = latencies(bench)
    period = 1e3 / bench.rate
    late = {name: int(np.sum(values > period)) for name, values in found.items()}
    most = TIMES * late["bare echo"] + AND
    rows = [
        (
            *(name, values.size, lost[name], late[name]),
            *(f"{v:.2f}" for v in (*np.percentile(values, (50.0, 99.0, 99.9)), values.max())),
        )
        for name, values in found.items()
    ]
    rows.append(("target", "", 0, f"<= {most}", "", "", "", ""))
    headings = (
        *("node", "samples", "lost", f"later than {period:g} ms"),
        *("median [ms]", "p99 [ms]", "p99.9 [ms]", "max [ms]"),
    )
    watched = bench.watched
    achieved = found["relay_node"].size / (record.time[-1] - record.time[0])
    samples = np.array(watched.samples) * achieved / bench.rate
    memory = np.array(watched.memory)
    warm = samples >= WARM * samples[-1]
    slope = float(np.polyfit(samples[warm], memory[warm], 1)[0])
    beyond = slope - RECORD_BYTES - CYCLE_BYTES
    sizes = (
        ("all", slope),
        ("the record: five numbers a sample", RECORD_BYTES),
        ("the cycles kept for late subscribers: three numbers a sample", CYCLE_BYTES),
        ("beyond these", beyond),
    )
    text = "\n\n".join(
        (
            f"{seconds:g} s at {bench.rate:g} Hz ({achieved:.1f} achieved), "
            f"{len(record.cycle_start) - 1} cycles, {CORES} processors, {load} spinning "
            f"processes; load average {os.getloadavg()[0]:.1f} at the end.",
            table(headings, rows),
            table(
                ("growth of relay_node's memory", "MB per million samples"),
                [(name, f"{size:.1f}") for name, size in sizes],
            ),
            f"Target: less than {MOST_MEMORY:g} MB per million samples beyond the record.",
        )
    )
    met = late["relay_node"] <= most and not record.lost_samples and beyond < MOST_MEMORY
    return text, met


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="of the tune [s]")
    parser.add_argument("--rate", type=float, default=1000.0, help="measurements a second")
    parser.add_argument("--load", type=int, default=2, help="spinning processes")
    parser.add_argument("--nice", type=int, default=0, help="niceness of the spinning processes")
    parser.add_argument("--quick", action="store_true", help="a few seconds, only to see it run")
    parser.add_argument("--role", choices=("echo", "spin"), help=argparse.SUPPRESS)
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == "echo":
        echo(options.file)
        return 0
    if options.role == "spin":
        os.nice(options.nice)
        spin()
    from ros_domain import free_domain

    if options.quick:
        options.seconds, options.load = QUICK, 0
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        bench = Bench(options.rate, options.load, options.nice, Path(folder), dict(os.environ))
        try:
            bench.run(options.seconds)
        finally:
            bench.close()
            rclpy.try_shutdown()
        text, met = report(bench, options.seconds, options.load)
    print(text)
    return 0 if met or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
