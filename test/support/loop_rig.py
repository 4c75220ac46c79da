# Copyright 2026 the developers of relay_autotune
# SPDX-License-Identifier: Apache-2.0

"""A loop of installed executables as processes over DDS, and a node that observes it."""

from __future__ import annotations

import fcntl
import math
import os
import shutil
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from forked import Forked, can_fork
from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_domain import mapped_segments, release_unfinished, remove_leftovers

from relay_autotune_msgs.srv import StartTune

LATCHED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
RELIABLE = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.RELIABLE)

# Deadline for a busy machine; a passing test does not wait for it.
PATIENCE = 60.0


class Onlooker(Node):
    """A node of few parts: each wait for a message looks at all of them."""

    def __init__(self, context: Context) -> None:
        super().__init__(
            "onlooker", context=context, start_parameter_services=False, enable_rosout=False
        )

    def create_publisher(self, *given: Any, **named: Any) -> Any:
        named["event_callbacks"] = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(*given, **named)

    def create_subscription(self, *given: Any, **named: Any) -> Any:
        named["event_callbacks"] = SubscriptionEventCallbacks(use_default_callbacks=False)
        return super().create_subscription(*given, **named)


class Process:
    """One executable, its log, and its leftover shared memory."""

    def __init__(
        self,
        name: str,
        command: list[str],
        environment: dict[str, str],
        log: Path,
        output: int | None = None,
    ):
        self.name = name
        self.log_path = log
        self.segments: set[Path] = set()
        # A terminal becomes the controlling terminal of the process.
        own = output is not None and os.isatty(output)
        self._process: Forked | subprocess.Popen[bytes]
        if output is None and can_fork(command, environment):
            log.touch()
            self._process = Forked(command, environment, log)
            return
        with log.open("wb") as file:
            self._process = subprocess.Popen(
                command,
                env=environment,
                stdout=file if output is None else output,
                stderr=subprocess.STDOUT,
                start_new_session=own,
                preexec_fn=(lambda: fcntl.ioctl(1, termios.TIOCSCTTY, 0)) if own else None,
            )

    @property
    def log(self) -> str:
        return self.log_path.read_text(errors="replace")

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def signal(self, number: int) -> None:
        if number == signal.SIGKILL:
            self.segments |= mapped_segments(self._process.pid)
        self._process.send_signal(number)

    def wait(self, timeout: float = PATIENCE) -> int:
        return self._process.wait(timeout)

    def end(self) -> None:
        if self.running:
            self.signal(signal.SIGTERM)
        try:
            self.wait(6.0)
        except subprocess.TimeoutExpired:
            self.signal(signal.SIGKILL)
            self.wait()


class Rig:
    """Start executables in a domain of their own, and end all of them."""

    def __init__(self, domain: int, folder: Path) -> None:
        # The run before may have been ended by a signal.
        release_unfinished()
        self.domain = domain
        self.folder = folder
        self.records = folder / "records"
        self.processes: list[Process] = []
        self.clients: dict[str, Any] = {}
        self.environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / "ros_log"),
            "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
        }
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Onlooker(self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    # Processes.

    def start(
        self, executable: str, *arguments: str, output: int | None = None, **parameters: Any
    ) -> Process:
        """Start an installed executable with parameters and further ROS arguments.

        :param output: its output, a pipe or a terminal; None: its log.
        """
        if executable == "controller_node":
            # Each test has its own folder: gains proven in one must not affect the next.
            parameters.setdefault("record_directory", str(self.records))
        return self._launch(executable, [_path(executable)], arguments, parameters, output)

    def start_command(self, executable: str, *words: str, output: int | None = None) -> Process:
        """Start an installed command with its own words.

        :param output: a terminal for it; None: its log.
        """
        return self._begin(executable, [_path(executable), *words], output)

    def start_python(self, name: str, code: str, **parameters: Any) -> Process:
        """Start Python code instead of an executable."""
        return self._launch(name, [sys.executable, "-c", code], (), parameters)

    def _launch(
        self,
        name: str,
        command: list[str],
        arguments: tuple[str, ...],
        parameters: dict[str, Any],
        output: int | None = None,
    ) -> Process:
        ros = ["--ros-args", *arguments]
        for key, value in parameters.items():
            ros += ["-p", f"{key}:={_yaml(value)}"]
        return self._begin(name, [*command, *ros], output)

    def _begin(self, name: str, command: list[str], output: int | None) -> Process:
        log = self.folder / f"{len(self.processes)}_{name}.log"
        process = Process(name, command, self.environment, log, output)
        self.processes.append(process)
        return process

    def plant(self, **parameters: Any) -> Process:
        return self.start("plant_node", **parameters)

    def relay(self, *arguments: str, **parameters: Any) -> Process:
        parameters.setdefault("record_directory", str(self.records))
        return self.start("relay_node", *arguments, **parameters)

    def identifier(self, *arguments: str, **parameters: Any) -> Process:
        """Start an identifier_node; to choose among structures, which takes seconds, give ""."""
        parameters.setdefault("structure", "fopdt")
        return self.start("identifier_node", *arguments, **parameters)

    # Observing.

    def listen(self, topic: str, kind: Any, qos: QoSProfile = LATCHED) -> list[Any]:
        """Return a list that collects the messages of a topic."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def until(self, condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> Any:
        """Spin until a condition holds and return its value; fail at the deadline."""
        deadline = time.monotonic() + timeout
        while True:
            value = condition()
            if value:
                return value
            if time.monotonic() > deadline:
                raise AssertionError(f"{what}: not within {timeout:g} s\n{self.logs()}")
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, kind: Any, name: str, request: Any, again: float = PATIENCE) -> Any:
        """Call a service and return its answer.

        :param again: ask again after this time, since an answer may be lost [s].
        """
        # Keep the client: discovery takes longer than the call.
        client = self.clients.get(name)
        if client is None:
            client = self.clients[name] = self.node.create_client(kind, name)
            self.be_known_to(name.rpartition("/")[0])
        self.until(client.service_is_ready, f"service {name}")
        return self.until(lambda: self._answer(client, request, again), f"answer of {name}")

    def be_known_to(self, node: str) -> None:
        """Wait until a node has discovered all clients made so far.

        Until then its answers are lost. It discovers them in the order in which they were made, so
        an answer to the last one shows that it knows the others.
        """
        last = self.node.create_client(GetParameters, f"{node}/get_parameters")
        self._parameters(last)
        self.node.destroy_client(last)

    def values(self, node: str, *names: str) -> list[Any]:
        """Return parameters of a node."""
        name = f"{node}/get_parameters"
        if name not in self.clients:
            self.clients[name] = self.node.create_client(GetParameters, name)
        return self._parameters(self.clients[name], *names)

    def _parameters(self, client: Any, *names: str) -> list[Any]:
        """Ask for parameters, and again each second, since an answer may be lost."""
        self.until(client.service_is_ready, f"service {client.srv_name}")
        answer = self.until(
            lambda: self._answer(client, GetParameters.Request(names=names), 1.0),
            f"answer of {client.srv_name}",
        )
        return [parameter_value_to_python(value) for value in answer.values]

    def _answer(self, client: Any, request: Any, wait: float) -> Any:
        """Return the answer of a service; None if none has come after a time [s]."""
        future = client.call_async(request)
        end = time.monotonic() + wait
        while not future.done() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
        return future.result() if future.done() else None

    def ask_for_tune(self, node: str = "relay_node", **request: Any) -> Any:
        name = f"{node}/start_tune"
        return self.call(StartTune, name, StartTune.Request(**request), again=15.0)

    def tune(self, **request: Any) -> Any:
        """Start a tune as soon as the processes have found each other; return the answer."""

        def accepted() -> Any:
            answer = self.ask_for_tune(**request)
            if answer.accepted:
                return answer
            # Only these reasons may delay a start: an ended node of another test may stay in the
            # graph for a moment.
            transient = (
                "no measurement", "no command", "use_sim_time", "/command is also",
                "/measurement is published by", "2 nodes have the name",
            )  # fmt: skip
            assert answer.reason.startswith(transient), answer.reason
            self.run_for(0.1)
            return None

        return self.until(accepted, "start of a tune")

    def run_for(self, seconds: float) -> None:
        """Take messages for a time, to check that something does not happen."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)

    def bag(self, answer: Any) -> Path:
        return self.records / answer.experiment_id

    def logs(self) -> str:
        return "\n".join(f"--- {p.log_path.name}\n{p.log[-4000:]}" for p in self.processes)

    def close(self) -> None:
        """End every process, then the observer, and remove the leftovers of killed processes."""
        for process in self.processes:
            if process.running:
                process.signal(signal.SIGTERM)
        for process in self.processes:
            process.end()
        self.executor.shutdown(timeout_sec=0.0)
        self.node.destroy_node()
        self.context.try_shutdown()
        release_unfinished()
        killed = {path for process in self.processes for path in process.segments}
        if killed:
            remove_leftovers(self.domain, killed)


def _path(executable: str) -> str:
    path = shutil.which(executable)
    if path is None:
        raise RuntimeError(f"{executable} is not on the PATH; source env.sh")
    return path


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        if math.isnan(value):
            return ".nan"
        if math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
        text = repr(value)
        return text if "." in text else text.replace("e", ".0e")
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_yaml(v) for v in value)}]"
    return str(value) or "''"
